"""From arrays to tensors, from samples to a batch, and from batches to a device."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
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


def to_device(
    batches: Iterable[Mapping[str, Any]], device: torch.device | str | int
) -> Iterator[dict[str, Any]]:
    """Yield the batches of one pass on a device; on CUDA, copied while it computes.

    There each batch is copied on a stream of its own as soon as the loop asks for it, beside what
    the loop has queued so far; what the loop queues next waits for the copy. So copies overlap
    with computing where the loop runs ahead of the device: read losses now and then, not at every
    step. Give the loader ``pin_memory=True``: copies of other memory make the loop wait. No batch
    is taken before it is asked for, so the loader's ``state_dict`` counts what the loop has seen.

    Args:
        batches: A loader, or what else yields flat batches.
        device: Where tensors go; what is no tensor stays as it is. On the processor, tensors that
            are there already are given as they are.
    """
    target = torch.device(device)
    if target.type != "cuda":
        for batch in batches:
            yield _sent(batch, target)
        return
    copies = torch.cuda.Stream(target)
    for batch in batches:
        with torch.cuda.stream(copies):
            moved = _sent(batch, target)
        consumer = torch.cuda.current_stream(target)
        consumer.wait_stream(copies)
        for value in moved.values():
            if isinstance(value, torch.Tensor):
                # Its memory is the copies' stream's, which may reuse it only after the consumer.
                value.record_stream(consumer)
        yield moved


def _sent(batch: Mapping[str, Any], device: torch.device) -> dict[str, Any]:
    return {
        name: value.to(device, non_blocking=True) if isinstance(value, torch.Tensor) else value
        for name, value in batch.items()
    }


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
