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

from collections.abc import Callable
from functools import partial
from typing import Final, Literal, Unpack

import numpy as np
import torch

from stereogenbench_data.bridges.adapted import AdaptedPairs, Item, PairsOptions
from stereogenbench_data.datasets.adapters import to_raft_stereo
from stereogenbench_data.datasets.mapped import Data
from stereogenbench_data.errors import SelectionError
from stereogenbench_data.samples.fields import Sample

RaftItem = tuple[list[str], torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]
"""Names, image1, image2, flow, valid."""

LIMIT_PX: Final = 512.0
"""The disparity from which RAFT-Stereo and what derives from it call a pixel not valid."""

IMAGENET_MEAN: Final = (0.485, 0.456, 0.406)
IMAGENET_STD: Final = (0.229, 0.224, 0.225)

_RAFT_FIELDS: Final = ("left", "right", "disparity", "valid", "scene", "pair", "frame_index")


class _LeftToRight(AdaptedPairs[Item]):
    """Items whose first view is the left one: the networks look for it there."""

    def __init__(
        self,
        data: Data,
        *,
        fields: tuple[str, ...],
        adapt: Callable[[Sample], Item],
        frames: Literal["frame", "clip"],
        options: PairsOptions,
    ) -> None:
        super().__init__(data, fields=fields, adapt=adapt, frames=frames, options=options)
        index, pairs = self.pairs.index, self.pairs.plan.pairs
        places_m, number = index.column("lateral_m")[pairs.row], np.arange(len(pairs))
        first, second = pairs.source, pairs.targets[:, 0]
        crossed = np.flatnonzero(places_m[number, second] < places_m[number, first])
        if len(crossed):
            where = crossed[0]
            direction = options.get("direction", "left_to_right")
            cure = (
                "leave it out. transform=HorizontalFlip(1.0) shows the right camera's view first, "
                "mirrored."
                if direction == "right_to_left"
                else "give direction='right_to_left' for such scenes."
            )
            raise SelectionError(
                f"{index.column('key')[pairs.row[where]]}: with direction={direction!r} camera "
                f"{first[where]} is the first of a pair and stands to the right of camera "
                f"{second[where]} (so do {len(crossed)} pairs of {len(pairs)}). Their disparities "
                f"are negative, and {type(self).__name__} is trained on positive ones: {cure}"
            )


def _igev_item(sample: Sample, *, valid_below_px: float) -> RaftItem:
    names, left, right, _, valid = to_raft_stereo(sample, valid_below_px=valid_below_px)
    return names, left, right, sample["disparity"], valid


class RaftStereo(_LeftToRight[RaftItem]):
    """Items of RAFT-Stereo's datasets: (names, image1, image2, flow, valid).

    The first item is a list of three names, which stand for the paths of the left picture, the
    right picture and the ground truth. Images are float32 (3, H, W) of 0 to 255; flow is float32
    (1, H, W), the negative disparity; valid is float32 (H, W), 1 where depth was measured and
    disparity is below ``valid_below_px``. Selective-RAFT takes the same, with 1024 px.

    Source: princeton-vl/RAFT-Stereo, core/stereo_datasets.py and train_stereo.py.
    """

    _item: Callable[..., RaftItem] = staticmethod(to_raft_stereo)

    def __init__(
        self, data: Data, *, valid_below_px: float = LIMIT_PX, **options: Unpack[PairsOptions]
    ) -> None:
        """Select the samples; no video is opened before the first item is asked for.

        Args:
            data: As for `StereoPairs`.
            valid_below_px: Pixels of this disparity and more are not valid.
            **options: As for `StereoPairs`; ``frames`` are single frames.

        Raises:
            SelectionError: If nothing matches, or samples are clips, sweeps or right to left.
            StereoGenBenchError: As `StereoPairs` does.
        """
        super().__init__(
            data,
            fields=_RAFT_FIELDS,
            adapt=partial(self._item, valid_below_px=valid_below_px),
            frames="frame",
            options=options,
        )


class IgevStereo(RaftStereo):
    """Items of IGEV-Stereo's datasets: those of RAFT-Stereo, with positive disparity for flow.

    Selective-IGEV takes the same, with 1024 px.

    Source: gangweix/IGEV, IGEV-Stereo/core/stereo_datasets.py and train_stereo.py.
    """

    _item = staticmethod(_igev_item)


class UniMatch(_LeftToRight[dict[str, torch.Tensor]]):
    """Items of UniMatch's stereo datasets: dicts of ``left``, ``right`` and ``disp``.

    As the training loop takes them: pictures float32 (3, H, W), normalised by ImageNet's mean and
    standard deviation; disparity float32 (H, W), positive, 0 where it is not known.

    Source: autonomousvision/unimatch, dataloader/stereo and main_stereo.py.
    """

    def __init__(self, data: Data, **options: Unpack[PairsOptions]) -> None:
        """Select the samples; no video is opened before the first item is asked for.

        Args:
            data: As for `StereoPairs`.
            **options: As for `StereoPairs`; ``frames`` are single frames.

        Raises:
            SelectionError: If nothing matches, or samples are clips, sweeps or right to left.
            StereoGenBenchError: As `StereoPairs` does.
        """
        fields = ("left", "right", "disparity")
        super().__init__(data, fields=fields, adapt=_unimatch_item, frames="frame", options=options)


def _unimatch_item(sample: Sample) -> dict[str, torch.Tensor]:
    views = {name: _normalised(sample[name]) for name in ("left", "right")}
    return views | {"disp": sample["disparity"][0]}


def _normalised(picture: torch.Tensor) -> torch.Tensor:
    mean, std = (torch.tensor(values)[:, None, None] for values in (IMAGENET_MEAN, IMAGENET_STD))
    return (picture.float() / 255 - mean) / std


class DynamicStereo(_LeftToRight[dict[str, torch.Tensor]]):
    """Items of DynamicStereo's datasets: dicts of ``img``, ``disp`` and ``valid_disp``, of clips.

    Pictures are float32 (T, 2, 3, H, W) of 0 to 255, left before right; disparity is float32
    (T, 2, 1, H, W), negative in both views; ``valid_disp`` is float32 (T, 2, H, W), 1 where depth
    was measured and disparity is neither 0 nor ``valid_below_px`` and more. BiDAStereo and
    StereoAnyVideo take the same.

    Source: facebookresearch/dynamic_stereo, datasets/dynamic_stereo_datasets.py and train.py.
    """

    def __init__(
        self, data: Data, *, valid_below_px: float = LIMIT_PX, **options: Unpack[PairsOptions]
    ) -> None:
        """Select the samples; no video is opened before the first item is asked for.

        Args:
            data: As for `StereoPairs`.
            valid_below_px: Pixels of this disparity and more are not valid.
            **options: As for `StereoPairs`; ``frames`` are clips, such as ("clips", 5).

        Raises:
            SelectionError: If nothing matches, or samples are single frames, sweeps or right to
                left.
            StereoGenBenchError: As `StereoPairs` does.
        """
        super().__init__(
            data,
            fields=("left", "right", "disparity", "disparity_right", "valid", "valid_right"),
            adapt=partial(_dynamic_item, valid_below_px=valid_below_px),
            frames="clip",
            options=options,
        )


def _dynamic_item(sample: Sample, *, valid_below_px: float) -> dict[str, torch.Tensor]:
    disparity = torch.stack([sample["disparity"], sample["disparity_right"]], dim=1)
    valid = torch.stack([sample["valid"], sample["valid_right"]], dim=1)
    is_valid = valid & (disparity.abs() < valid_below_px) & (disparity != 0)
    return {
        "img": torch.stack([sample["left"], sample["right"]], dim=1).float(),
        "disp": 0 - disparity,
        "valid_disp": is_valid[:, :, 0].float(),
    }
