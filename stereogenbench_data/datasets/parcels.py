"""How a worker's batches come to the process that trains: in memory that both map, used again.

A worker has a few slots of shared memory, each for one batch. It writes a batch's samples into a
free slot and sends a `Parcel`, a few hundred bytes that say what lies where. The main process makes
tensors of it without a copy and, when the last of these is gone, marks the slot as free. Where none
is free, as when a loop keeps its batches, a batch gets memory of its own.
"""

import weakref
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import torch
from torch.utils.data import get_worker_info

from stereogenbench_data.datasets.room import BatchRoom, Memory, shared_bytes
from stereogenbench_data.datasets.shared import shared_full
from stereogenbench_data.datasets.tensors import collate
from stereogenbench_data.samples.load import Sample

SLOTS: Final = 3
"""Slots of a worker: two batches that are made or on their way, and one that the loop holds."""

_ALIGNED: Final = 64

_FREE, _NEW, _SENT = 0, 1, 2
"""What a slot is: free, about to be sent for the first time, or in use by either process."""


class Laid(NamedTuple):
    """Where a field of a batch lies in a slot."""

    dtype: torch.dtype
    shape: tuple[int, ...]
    start: int
    stop: int


class Parcel(NamedTuple):
    """A batch on its way.

    Attributes:
        worker: Whose it is.
        slot: In which slot its tensors lie.
        memory: The slot's memory, the first time that it is sent; then None.
        fields: What lies where, or the field itself where it is no tensor; in order.
    """

    worker: int
    slot: int
    memory: torch.Tensor | None
    fields: dict[str, Any]


class Shelf:
    """The slots of a loader's workers, of which each process uses its own end.

    Attributes:
        used: int64 (workers, slots) that all processes share: what each slot is.
    """

    def __init__(self, workers: int, *, used: torch.Tensor | None = None) -> None:
        """Begin with slots that take memory when they are first used.

        Args:
            workers: How many workers there are.
            used: What another process's end of the same slots has as ``used``.
        """
        self.used = shared_full((workers, SLOTS), 0) if used is None else used
        self._memory: dict[tuple[int, int], torch.Tensor] = {}
        self._layout: dict[str, Laid] = {}
        self._slot: int | None = None

    def room(self, count: int, memory: Memory) -> BatchRoom:
        """Return room for a worker's next batch, in a free slot if there is one."""
        self._slot = self._free_slot() if self._layout else None
        if self._slot is None:
            return BatchRoom(count, memory.take)
        held = self._memory[_worker(), self._slot]

        def take(name: str, size_bytes: int) -> torch.Tensor:
            laid = self._layout.get(name)
            if laid is None or laid.stop - laid.start != size_bytes:
                return memory.take(name, size_bytes)
            return held[laid.start : laid.stop]

        return BatchRoom(count, take)

    def packed(self, samples: Sequence[Sample]) -> Any:
        """Return a worker's samples as a parcel, or as a plain batch where they are in no slot."""
        batch = collate(samples)
        if self._slot is None or not self._holds(batch):
            self._layout = self._layout or _laid_out(batch)
            return batch
        key = (_worker(), self._slot)
        memory = self._memory[key] if self.used[key] == _NEW else None
        self.used[key] = _SENT
        return Parcel(*key, memory, {name: self._layout.get(name, batch[name]) for name in batch})

    def opened(self, parcel: Parcel) -> dict[str, Any]:
        """Return the batch of a parcel; its slot is free again when none of its tensors is left."""
        key = (parcel.worker, parcel.slot)
        if parcel.memory is not None:
            self._memory[key] = parcel.memory
        # The array lives as long as any tensor over it does, however it was sliced.
        array = self._memory[key].numpy()
        weakref.finalize(array, self.used.__setitem__, key, _FREE).atexit = False
        whole = torch.from_numpy(array)
        return {
            name: whole[laid.start : laid.stop].view(laid.dtype).view(laid.shape)
            if isinstance(laid, Laid)
            else laid
            for name, laid in parcel.fields.items()
        }

    def _free_slot(self) -> int | None:
        """Return a slot of this worker, marked as used; None where the main process has all."""
        for slot in range(SLOTS):
            key = (_worker(), slot)
            if key not in self._memory:
                size_bytes = max(laid.stop for laid in self._layout.values())
                self._memory[key] = shared_bytes(size_bytes)
                self.used[key] = _NEW
                return slot
            if self.used[key] == _FREE:
                self.used[key] = _SENT
                return slot
        return None

    def _holds(self, batch: dict[str, Any]) -> bool:
        """Return whether all tensors of a batch lie in the slot where the layout says."""
        held = self._memory[_worker(), self._slot or 0].data_ptr()
        return all(
            name in self._layout
            and value.data_ptr() == held + self._layout[name].start
            and (value.dtype, tuple(value.shape)) == self._layout[name][:2]
            for name, value in batch.items()
            if isinstance(value, torch.Tensor)
        )


def _laid_out(batch: dict[str, Any]) -> dict[str, Laid]:
    """Return a place for each tensor of a batch, one after another."""
    layout: dict[str, Laid] = {}
    end = 0
    for name, value in batch.items():
        if isinstance(value, torch.Tensor):
            layout[name] = Laid(value.dtype, tuple(value.shape), end, end + value.nbytes)
            end += -(-value.nbytes // _ALIGNED) * _ALIGNED
    return layout


def _worker() -> int:
    info = get_worker_info()
    return 0 if info is None else info.id
