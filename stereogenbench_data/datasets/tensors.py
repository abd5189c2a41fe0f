"""From arrays to tensors, and from samples to a batch."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch.utils.data import default_collate

from stereogenbench_data.errors import FieldError
from stereogenbench_data.samples.fields import Sample


def to_tensors(sample: Sample) -> Sample:
    """Return a sample whose arrays and numbers are tensors of the same dtype; texts stay."""
    return {
        name: value
        if isinstance(value, str)
        else torch.from_numpy(np.require(value, requirements=("C", "W")))
        for name, value in sample.items()
    }


def collate(samples: Sequence[Sample]) -> dict[str, Any]:
    """Stack samples into a batch: what torch's own ``default_collate`` does, with a named reason.

    Args:
        samples: Samples of one dataset, with the same fields.

    Returns:
        Tensors with a batch axis in front; texts as lists.

    Raises:
        FieldError: If a field has another shape in one sample than in the first, as where scenes
            of several sizes, or sweeps with several numbers of views, are put in one batch.
    """
    first = samples[0]
    for sample in samples[1:]:
        for name, value in sample.items():
            if isinstance(value, torch.Tensor) and value.shape != first[name].shape:
                raise FieldError(
                    f"{name} is {tuple(value.shape)} in {sample.get('__key__', 'one sample')} and "
                    f"{tuple(first[name].shape)} in {first.get('__key__', 'the first')}: give "
                    "size=(height, width), or batch sweeps one by one."
                )
    return {name: _stacked([sample[name] for sample in samples]) for name in first}


def _stacked(values: list[Any]) -> Any:
    """Return values as one tensor: without a copy where they lie side by side in memory."""
    first = values[0]
    if not isinstance(first, torch.Tensor):
        return default_collate(values)
    memory, start = first.untyped_storage().data_ptr(), first.storage_offset()
    are_neighbours = all(
        value.untyped_storage().data_ptr() == memory
        and value.storage_offset() == start + place * first.numel()
        and value.is_contiguous()
        and value.dtype == first.dtype
        for place, value in enumerate(values)
    )
    if not are_neighbours:
        return default_collate(values)
    return first.as_strided((len(values), *first.shape), (first.numel(), *first.stride()))
