"""Samples in the conventions of others. Each takes one sample of `StereoPairs`, not a batch."""

from typing import Any

import torch

from stereogenbench_data.errors import FieldError
from stereogenbench_data.samples.fields import Sample


def to_raft_stereo(sample: Sample) -> tuple[torch.Tensor, ...]:
    """Return (image1, image2, flow, valid) as RAFT-Stereo's datasets give them.

    Args:
        sample: With the fields left, right, disparity and valid.

    Returns:
        Images float32 (3, H, W) of 0 to 255; flow float32 (1, H, W), the negative disparity;
        valid float32 (H, W) of 0 and 1. Every measured pixel is valid, however large its
        disparity (theirs drops 512 px and more).

    Raises:
        FieldError: If a field is missing.

    Source: princeton-vl/RAFT-Stereo, core/stereo_datasets.py.
    """
    left, right, disparity, valid = _taken(sample)
    return left.float(), right.float(), 0 - disparity, valid[..., 0, :, :].float()


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
    left, right, disparity, valid = _taken(sample)
    return left, right, disparity.numpy(), valid[..., 0, :, :].numpy()


def _taken(sample: Sample) -> tuple[torch.Tensor, ...]:
    names = ("left", "right", "disparity", "valid")
    missing = [name for name in names if name not in sample]
    if missing:
        raise FieldError(
            f"the sample has no {', '.join(missing)}: ask StereoPairs for fields={names}."
        )
    return tuple(sample[name] for name in names)
