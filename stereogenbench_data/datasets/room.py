"""Room for batches: samples are written where their batch will be, and memory is used again.

Memory that a process has just been given costs more than what is written into it, for the system
clears it page by page. So a batch's memory is kept, and is used for another batch once nobody else
holds any of it.
"""

import math
import sys
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import torch
from torch.utils.data import get_worker_info

from stereogenbench_data.samples.load import Sample

KEPT_BUFFERS: Final = 3
"""Buffers kept for each field: a loop holds one batch while the next one is made."""

_KNOWN_HERE: Final = 3
"""How many references to a buffer there are while `Memory` looks at one that nobody else has."""


def shared_bytes(size_bytes: int) -> torch.Tensor:
    """Return bytes that are not copied when they are sent to another process."""
    storage = torch.UntypedStorage._new_shared(size_bytes)  # type: ignore[no-untyped-call]  # as torch's own collate does
    return torch.empty(0, dtype=torch.uint8).set_(storage)


class Memory:
    """Buffers of one process that are handed out again when nothing refers to them any more."""

    def __init__(self) -> None:
        """Begin with none."""
        self._buffers: dict[str, list[np.ndarray]] = {}

    def take(self, name: str, size_bytes: int) -> torch.Tensor:
        """Return a buffer of bytes, whatever is in it."""
        if get_worker_info() is not None:
            return shared_bytes(size_bytes)
        kept = self._buffers.setdefault(name, [])
        kept[:] = [buffer for buffer in kept if len(buffer) == size_bytes]
        for buffer in kept:
            if sys.getrefcount(buffer) == _KNOWN_HERE:
                return torch.from_numpy(buffer)
        fresh = np.empty(size_bytes, dtype=np.uint8)
        if len(kept) < KEPT_BUFFERS:
            kept.append(fresh)
        return torch.from_numpy(fresh)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what another process makes a memory of its own from."""
        return Memory, ()


class BatchRoom:
    """Room for the fields of so many samples of one shape, each a slice of one tensor.

    Attributes:
        count: How many samples there are.
        tensors: The whole fields so far.
    """

    def __init__(self, count: int, take: Callable[[str, int], torch.Tensor]) -> None:
        """Make room for ``count`` samples, of bytes taken for a field when it is first known."""
        self.count = count
        self.tensors: dict[str, torch.Tensor] = {}
        self._take = take

    def at(self, number: int) -> Callable[[str, tuple[int, ...], Any], Any]:
        """Return the room of one sample."""

        def room(name: str, shape: tuple[int, ...], dtype: Any) -> Any:
            whole = self._whole(name, shape, np.dtype(dtype))
            if tuple(whole.shape[1:]) != shape:
                return np.empty(shape, dtype=dtype)
            return whole[number].numpy()

        return room

    def put(self, number: int, name: str, value: torch.Tensor) -> torch.Tensor:
        """Return a value as a sample's slice of the field, written there."""
        place = self._whole(name, tuple(value.shape), value.numpy().dtype)[number]
        return place.copy_(value)

    def as_tensors(self, number: int, sample: Sample) -> Sample:
        """Return a sample with tensors for arrays, slices of the batch's where it was written."""
        return {name: self._as_tensor(number, name, value) for name, value in sample.items()}

    def _as_tensor(self, number: int, name: str, value: Any) -> Any:
        if isinstance(value, str):
            return value
        whole = self.tensors[name]
        same = tuple(whole.shape[1:]) == value.shape
        return whole[number] if same else torch.from_numpy(value)

    def _whole(self, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> torch.Tensor:
        if name not in self.tensors:
            flat = self._take(name, self.count * math.prod(shape) * dtype.itemsize)
            kind = torch.from_numpy(np.empty(0, dtype=dtype)).dtype
            self.tensors[name] = flat.view(kind).view(self.count, *shape)
        return self.tensors[name]
