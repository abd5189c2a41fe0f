"""Samples in the conventions of others. Each takes one sample of `StereoPairs`, not a batch."""

from typing import Any

import torch

from stereogenbench_data.errors import FieldError
from stereogenbench_data.samples.fields import Sample


def to_raft_stereo(
    sample: Sample, *, valid_below_px: float = 512.0
) -> tuple[list[str], torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
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
    left, right, disparity, valid, scene, pair, frame = taken_from(
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
    left, right, disparity, valid = taken_from(sample, "left", "right", "disparity", "valid")
    return left, right, disparity.numpy(), valid[..., 0, :, :].numpy()


def taken_from(sample: Sample, *names: str) -> tuple[Any, ...]:
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
