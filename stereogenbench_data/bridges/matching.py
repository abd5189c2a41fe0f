"""Stereo matching: items as RAFT-Stereo, IGEV-Stereo, UniMatch and DynamicStereo train on them.

Each class takes what `StereoPairs` takes, except fields, and gives the items that the project's
training loop unpacks: their order, signs, dtypes, value ranges and rule of validity. Disparity is
in pixels of the picture as resized and cropped, x_right = x_left - d.

>>> from stereogenbench_data.bridges.matching import RaftStereo
>>> train = RaftStereo(getfixture("small_release"), split="train", pairs="all", frames="all")
>>> for _, *data_blob in train.loader(batch_size=2):
...     image1, image2, flow, valid = data_blob
...     break
>>> flow.shape, valid.shape
(torch.Size([2, 1, 64, 64]), torch.Size([2, 64, 64]))
"""

from typing import Any, Final, Unpack

import numpy as np
import torch

from stereogenbench_data.bridges.adapted import AdaptedPairs, Item
from stereogenbench_data.datasets.mapped import PAIRS_DEFAULTS, Data, PairsOptions
from stereogenbench_data.errors import FieldError, SelectionError
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.selection.signatures import list_options

RaftItem = tuple[list[str], torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]
"""Names, image1, image2, flow, valid."""

LIMIT_PX: Final = 512.0
"""The disparity from which RAFT-Stereo and what derives from it call a pixel not valid."""

IMAGENET_MEAN: Final = (0.485, 0.456, 0.406)
IMAGENET_STD: Final = (0.229, 0.224, 0.225)


def to_raft_stereo(sample: Sample, *, valid_below_px: float = LIMIT_PX) -> RaftItem:
    """Return (names, image1, image2, flow, valid) as RAFT-Stereo's datasets give them.

    Args:
        sample: With the fields left, right, disparity, valid, scene, pair and frame_index.
        valid_below_px: Pixels of this disparity and more are not valid: 512 in RAFT-Stereo.

    Returns:
        Names of the left picture, the right picture and the ground truth, which stand for the
        paths of files; images float32 (3, H, W) of 0 to 255; flow float32 (1, H, W), the negative
        disparity; valid float32 (H, W) of 0 and 1.

    Raises:
        FieldError: If a field is missing.

    Source: princeton-vl/RAFT-Stereo, core/stereo_datasets.py.
    """
    left, right, disparity, valid, scene, pair, frame = _taken_from(
        sample, "left", "right", "disparity", "valid", "scene", "pair", "frame_index"
    )
    first, second = (f"{scene}/cam_{camera:02d}" for camera in pair.tolist())
    names = [
        f"{each}/{int(frame):03d}" for each in (f"{first}_rgb", f"{second}_rgb", f"{first}_depth")
    ]
    is_valid = valid[0] & (disparity[0].abs() < valid_below_px)
    return names, left.float(), right.float(), 0 - disparity, is_valid.float()


def to_torchvision(sample: Sample) -> tuple[Any, ...]:
    """Return (left, right, disparity, valid) as torchvision's stereo matching datasets give them.

    Args:
        sample: With the fields left, right, disparity and valid.

    Returns:
        Images uint8 tensors (3, H, W); disparity float32 numpy (1, H, W), positive;
        valid bool numpy (H, W).

    Raises:
        FieldError: If a field is missing.

    Source: torchvision.datasets._stereo_matching.
    """
    left, right, disparity, valid = _taken_from(sample, "left", "right", "disparity", "valid")
    return left, right, disparity.numpy(), valid[..., 0, :, :].numpy()


def _taken_from(sample: Sample, *names: str) -> tuple[Any, ...]:
    """Return fields of a sample, in the order of their names.

    Raises:
        FieldError: If a field is missing.
    """
    missing = [name for name in names if name not in sample]
    if missing:
        raise FieldError(
            f"the sample has no {', '.join(missing)}: ask StereoPairs for fields={names}."
        )
    return tuple(sample[name] for name in names)


class _LeftToRight(AdaptedPairs[Item]):
    """Items whose first view is the left one: the networks look for it there."""

    @list_options(PAIRS_DEFAULTS)
    def __init__(self, data: Data, **options: Unpack[PairsOptions]) -> None:
        super().__init__(data, **options)
        index, pairs = self.pairs.index, self.pairs.plan.pairs
        places_m, number = index.column("lateral_m")[pairs.row], np.arange(len(pairs))
        first, second = pairs.source, pairs.targets[:, 0]
        crossed = np.flatnonzero(places_m[number, second] < places_m[number, first])
        if len(crossed):
            where = crossed[0]
            raise SelectionError(
                f"{index.column('key')[pairs.row[where]]}: camera {first[where]} is the first of a "
                f"pair and stands to the right of camera {second[where]} (so do {len(crossed)} "
                f"pairs of {len(pairs)}), and {type(self).__name__} is trained on positive "
                f"disparities: give the other direction, or transform=HorizontalFlip(1.0)."
            )


class _Limited(_LeftToRight[Item]):
    """Items that call pixels of large disparity not valid."""

    @list_options(PAIRS_DEFAULTS)
    def __init__(
        self, data: Data, *, valid_below_px: float = LIMIT_PX, **options: Unpack[PairsOptions]
    ) -> None:
        """Select the samples; no video is opened before the first item is asked for.

        Args:
            data: As for `StereoPairs`.
            valid_below_px: Pixels of this disparity and more are not valid.
            **options: As for `StereoPairs`, except fields.

        Raises:
            SelectionError: If nothing matches, or samples are sweeps, right to left, or clips where
                single frames are needed, or the reverse.
            StereoGenBenchError: As `StereoPairs` does.
        """
        super().__init__(data, **options)
        self.valid_below_px = valid_below_px


class RaftStereo(_Limited[RaftItem]):
    """Items of RAFT-Stereo's datasets: (names, image1, image2, flow, valid).

    The first item is a list of three names, which stand for the paths of the left picture, the
    right picture and the ground truth. Images are float32 (3, H, W) of 0 to 255; flow is float32
    (1, H, W), the negative disparity; valid is float32 (H, W), 1 where depth was measured and
    disparity is below ``valid_below_px``. Selective-RAFT takes the same, with 1024 px.

    Source: princeton-vl/RAFT-Stereo, core/stereo_datasets.py and train_stereo.py.
    """

    fields = ("left", "right", "disparity", "valid", "scene", "pair", "frame_index")

    def item(self, sample: Sample) -> RaftItem:
        """Return the five."""
        return to_raft_stereo(sample, valid_below_px=self.valid_below_px)


class IgevStereo(RaftStereo):
    """Items of IGEV-Stereo's datasets: those of RAFT-Stereo, with positive disparity for flow.

    Selective-IGEV takes the same, with 1024 px.

    Source: gangweix/IGEV, IGEV-Stereo/core/stereo_datasets.py and train_stereo.py.
    """

    def item(self, sample: Sample) -> RaftItem:
        """Return the five."""
        names, left, right, _, valid = super().item(sample)
        return names, left, right, sample["disparity"], valid


class UniMatch(_LeftToRight[dict[str, torch.Tensor]]):
    """Items of UniMatch's stereo datasets: dicts of ``left``, ``right`` and ``disp``.

    As the training loop takes them: pictures float32 (3, H, W), normalised by ImageNet's mean and
    standard deviation; disparity float32 (H, W), positive, 0 where it is not known.

    Source: autonomousvision/unimatch, dataloader/stereo and main_stereo.py.
    """

    fields = ("left", "right", "disparity")

    def item(self, sample: Sample) -> dict[str, torch.Tensor]:
        """Return the dict."""
        mean, std = (torch.tensor(each)[:, None, None] for each in (IMAGENET_MEAN, IMAGENET_STD))
        views = {name: (sample[name].float() / 255 - mean) / std for name in ("left", "right")}
        return views | {"disp": sample["disparity"][0]}


class DynamicStereo(_Limited[dict[str, torch.Tensor]]):
    """Items of DynamicStereo's datasets: dicts of ``img``, ``disp`` and ``valid_disp``, of clips.

    ``frames`` are clips, such as ("clips", 5). Pictures are float32 (T, 2, 3, H, W) of 0 to 255,
    left before right; disparity is float32 (T, 2, 1, H, W), negative in both views; ``valid_disp``
    is float32 (T, 2, H, W), 1 where depth was measured and disparity is neither 0 nor
    ``valid_below_px`` and more. BiDAStereo and StereoAnyVideo take the same.

    Source: facebookresearch/dynamic_stereo, datasets/dynamic_stereo_datasets.py and train.py.
    """

    fields = ("left", "right", "disparity", "disparity_right", "valid", "valid_right")
    frames = "clip"

    def item(self, sample: Sample) -> dict[str, torch.Tensor]:
        """Return the dict."""
        disparity, valid, pictures = (
            torch.stack([sample[left], sample[right]], dim=1)
            for left, right in (
                ("disparity", "disparity_right"), ("valid", "valid_right"), ("left", "right"),
            )
        )  # fmt: skip
        is_valid = valid & (disparity.abs() < self.valid_below_px) & (disparity != 0)
        return {
            "img": pictures.float(),
            "disp": 0 - disparity,
            "valid_disp": is_valid[:, :, 0].float(),
        }
