"""Shared batch buffers: samples are written where their batch will be, and the memory is reused.

Fresh memory costs more than what is written into it, as the system clears it page by page. So the
buffers of a batch are reused once nobody holds any part of it. In the process that trains these
are arrays of its own. A worker process has a few slots of shared memory, each for one batch: it
writes a batch into a free slot and sends a `BatchHandle`, a few hundred bytes that say what lies
where. Unpickled in the process that trains, a handle is the batch itself, over the same memory;
when the last tensor over it is gone, that process marks the slot as free.

What keeps a batch unchanged while somebody holds it:

- Slots belong to one worker process, so to one pass. Two passes never share any.
- A worker writes into a slot only if its own last view of it is gone, too.
- Only the process that opened a batch gives its slot back. A fork of it does not.
- A batch that is open while its process forks keeps its slot for good, as the child may read it:
  the worker takes new memory instead.
- Where no slot is free, a batch gets memory of its own.

Where references are not counted, memory is reused later or never, but not too early. The option
``buffers="fresh"`` of the datasets gives each batch memory of its own.
"""

import itertools
import math
import multiprocessing
import os
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, Literal, NamedTuple, get_args

import numpy as np
import torch
from torch.utils.data import default_collate, get_worker_info

from stereogenbench_data.datasets.batches import SharedNumbers
from stereogenbench_data.errors import FieldError, SelectionError
from stereogenbench_data.samples.fields import Allocate, Sample

Buffers = Literal["reused", "fresh"]
"""Whether the memory of batches is reused once nobody holds it."""

SLOTS: Final = 3
"""Slots of a worker: two batches that are made or on their way, and one that the loop holds."""

KEPT_BUFFERS: Final = 3
"""Buffers of a process that are kept for each field: a loop holds one while another is made."""

_ALIGNED: Final = 64

_WORKERS, _SENT, _RETIRED = 0, 1, 2
"""State of a slot: free for the worker, in use by the training process, or retired."""


class BatchArrays:
    """The fields of samples of one shape: one tensor each, of which a sample is a slice.

    Attributes:
        count: How many samples there are.
    """

    def __init__(self, count: int, take: Callable[[str, int], torch.Tensor]) -> None:
        """Begin without fields; ``take`` returns memory for a field, by its name and size."""
        self.count = count
        self._arrays: dict[str, np.ndarray] = {}
        self._slices: dict[str, tuple[torch.Tensor, ...]] = {}
        self._take = take

    def of_sample(self, number: int) -> Allocate:
        """Return what gives the arrays that one sample's fields are written into."""

        def allocate(name: str, shape: tuple[int, ...], dtype: Any) -> Any:
            whole = self._whole(name, shape, np.dtype(dtype))
            if whole.shape[1:] != shape:
                return np.empty(shape, dtype=dtype)
            return whole[number, ...]

        return allocate

    def as_tensors(self, number: int, sample: Sample) -> Sample:
        """Return a sample with tensors for arrays, slices of the batch's where it was written."""
        tensors: Sample = {}
        for name, value in sample.items():
            if isinstance(value, str):
                tensors[name] = value
            else:
                same = self._arrays[name].shape[1:] == value.shape
                tensors[name] = self._slices[name][number] if same else torch.from_numpy(value)
        return tensors

    def _whole(self, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> np.ndarray:
        if name not in self._arrays:
            flat = self._take(name, self.count * math.prod(shape) * dtype.itemsize)
            kind = torch.from_numpy(np.empty(0, dtype=dtype)).dtype
            whole = flat.view(kind).view(self.count, *shape)
            self._arrays[name], self._slices[name] = whole.numpy(), whole.unbind()
        return self._arrays[name]


class BatchBuffers:
    """Where the batches of a dataset are made, in each process by itself.

    A copy that is pickled or forked into a worker begins with no slots, and makes its own.
    """

    def __init__(self, kind: Buffers = "reused") -> None:
        """Begin with none.

        Raises:
            SelectionError: If there is no such kind.
        """
        if kind not in get_args(Buffers):
            known = ", ".join(map(repr, get_args(Buffers)))
            raise SelectionError(f"buffers must be one of {known}, got {kind!r}.")
        self.kind = kind
        self._free: dict[str, list[np.ndarray]] = {}
        self._slots: _WorkerSlots | None = None

    def allocate(self, count: int) -> BatchArrays:
        """Return the arrays for a batch of ``count`` samples."""
        if self.kind == "fresh":
            return BatchArrays(count, fresh_bytes)
        if self._slots is not None:
            return self._slots.allocate(count)
        in_worker = get_worker_info() is not None
        return BatchArrays(count, fresh_bytes if in_worker else self._take)

    @property
    def makes_batches(self) -> bool:
        """Whether `collate` makes the batches of this worker process, as it has before."""
        return self._slots is not None

    def collate(self, samples: Sequence[Sample]) -> Any:
        """Return samples as a batch; in a worker, as a handle if they lie in a slot.

        Raises:
            FieldError: If a field has another shape in one sample than in the first.
        """
        if self.kind == "fresh" or get_worker_info() is None:
            return collate(samples)
        if self._slots is None:
            self._slots = _WorkerSlots()
        return self._slots.collate(samples)

    def _take(self, name: str, size_bytes: int) -> torch.Tensor:
        free = self._free.setdefault(name, [])
        buffer = None
        while free and buffer is None:
            # Taking from a list is atomic: no two threads get the same buffer.
            buffer = free.pop()
            buffer = buffer if len(buffer) == size_bytes else None
        if buffer is None:
            buffer = np.empty(size_bytes, dtype=np.uint8)
        # The view lives as long as any tensor over it does, however it was sliced.
        view = buffer.view()
        weakref.finalize(view, _give_back, free, buffer).atexit = False
        return torch.from_numpy(view)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what another process makes buffers of its own from."""
        return BatchBuffers, (self.kind,)


def _give_back(free: list[np.ndarray], buffer: np.ndarray) -> None:
    if len(free) < KEPT_BUFFERS:
        free.append(buffer)


def fresh_bytes(name: str, size_bytes: int) -> torch.Tensor:
    """Return new memory for a field: in a worker such that it is not copied when it is sent."""
    del name
    if get_worker_info() is None:
        return torch.empty(size_bytes, dtype=torch.uint8)
    # As torch's own collate does.
    storage = torch.UntypedStorage._new_shared(size_bytes)
    return torch.empty(0, dtype=torch.uint8).set_(storage)


class BufferSpec(NamedTuple):
    """Where a field of a batch lies in a slot, in bytes from its beginning."""

    dtype: torch.dtype
    shape: tuple[int, ...]
    start: int
    stop: int


class SlotOwner(NamedTuple):
    """A worker process: its pid and a random token, because pids are reused."""

    pid: int
    token: bytes


class BatchHandle(NamedTuple):
    """A batch that lies in a worker's slot; unpickling it gives the batch.

    Attributes:
        owner: The worker.
        slot: The number of the slot.
        status: int64 (SLOTS,), shared: whose each slot is. With new memory, else None.
        memory: The slot's memory where the receiver does not know it yet, else None.
        fields: What lies where, or the field itself where it is no tensor; in order.
    """

    owner: SlotOwner
    slot: int
    status: torch.Tensor | None
    memory: torch.Tensor | None
    fields: dict[str, Any]

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what the batch is made from where it arrives."""
        return _open_batch, tuple(self)


class _WorkerSlots:
    """A worker's end of its slots."""

    def __init__(self) -> None:
        self._owner = SlotOwner(os.getpid(), os.urandom(8))
        self._status = SharedNumbers([_WORKERS] * SLOTS).tensor
        self._memory = [torch.empty(0, dtype=torch.uint8)] * SLOTS
        self._is_known = [False] * SLOTS
        self._views: list[Callable[[], Any]] = [lambda: None] * SLOTS
        self._layout: dict[str, BufferSpec] = {}
        self._slot: int | None = None

    def allocate(self, count: int) -> BatchArrays:
        """Return the arrays for the next batch, in a free slot if there is one."""
        self._slot = self._free_slot() if self._layout else None
        if self._slot is None:
            return BatchArrays(count, fresh_bytes)
        view = self._memory[self._slot].numpy()
        self._views[self._slot] = weakref.ref(view)
        whole = torch.from_numpy(view)

        def take(name: str, size_bytes: int) -> torch.Tensor:
            spec = self._layout.get(name)
            if spec is None or spec.stop - spec.start != size_bytes:
                return fresh_bytes(name, size_bytes)
            return whole[spec.start : spec.stop]

        return BatchArrays(count, take)

    def collate(self, samples: Sequence[Sample]) -> Any:
        """Return samples as a handle, or as a plain batch where they do not lie in a slot."""
        batch = collate(samples)
        slot, self._slot = self._slot, None
        if slot is None or not self._holds(slot, batch):
            self._layout = self._layout or _layout_of(batch)
            return batch
        new = not self._is_known[slot]
        self._is_known[slot] = True
        self._status[slot] = _SENT
        return BatchHandle(
            self._owner,
            slot,
            status=self._status if new else None,
            memory=self._memory[slot] if new else None,
            fields={name: self._layout.get(name, value) for name, value in batch.items()},
        )

    def _free_slot(self) -> int | None:
        """Return a slot that nobody holds, None where all are held."""
        for slot in range(SLOTS):
            status = int(self._status[slot])
            if status == _SENT or self._views[slot]() is not None:
                continue
            if status == _RETIRED or not len(self._memory[slot]):
                size_bytes = max(spec.stop for spec in self._layout.values())
                self._memory[slot] = fresh_bytes("", size_bytes)
                self._is_known[slot] = False
                self._status[slot] = _WORKERS
            return slot
        return None

    def _holds(self, slot: int, batch: dict[str, Any]) -> bool:
        """Return whether all tensors of a batch lie in the slot where the layout says."""
        start = self._memory[slot].data_ptr()
        return all(
            name in self._layout
            and value.data_ptr() == start + self._layout[name].start
            and (value.dtype, tuple(value.shape)) == self._layout[name][:2]
            for name, value in batch.items()
            if isinstance(value, torch.Tensor)
        )


def _layout_of(batch: dict[str, Any]) -> dict[str, BufferSpec]:
    """Return a place for each tensor of a batch, one after another."""
    layout: dict[str, BufferSpec] = {}
    end = 0
    for name, value in batch.items():
        if isinstance(value, torch.Tensor):
            layout[name] = BufferSpec(value.dtype, tuple(value.shape), end, end + value.nbytes)
            end += -(-value.nbytes // _ALIGNED) * _ALIGNED
    return layout


class _OpenBatch(NamedTuple):
    """A batch that this process, or the one that it was forked from, has opened."""

    pid: int
    status: torch.Tensor
    slot: int


_opened: Final[dict[SlotOwner, tuple[torch.Tensor, dict[int, torch.Tensor]]]] = {}
"""Status and memory of the slots that this process has batches from."""

_open_batches: Final[dict[int, _OpenBatch]] = {}
"""The open batches. Who takes one out of here decides what becomes of its slot."""

_count: Final = itertools.count()


def _open_batch(
    owner: SlotOwner,
    slot: int,
    status: torch.Tensor | None,
    memory: torch.Tensor | None,
    fields: dict[str, Any],
) -> dict[str, Any]:
    """Return the batch of a handle; the slot is given back when none of its tensors is left."""
    if status is not None and memory is not None:
        if owner not in _opened:
            running = {process.pid for process in multiprocessing.active_children()}
            forget_slots({each.pid for each in _opened if each.pid not in running})
            _opened[owner] = (status, {})
        _opened[owner][1][slot] = memory
    statuses, memories = _opened[owner]
    # The array lives as long as any tensor over it does, however it was sliced.
    array = memories[slot].numpy()
    number = next(_count)
    _open_batches[number] = _OpenBatch(os.getpid(), statuses, slot)
    weakref.finalize(array, _release, number).atexit = False
    whole = torch.from_numpy(array)
    return {
        name: whole[spec.start : spec.stop].view(spec.dtype).view(spec.shape)
        if isinstance(spec, BufferSpec)
        else spec
        for name, spec in fields.items()
    }


def _release(number: int) -> None:
    """Give the slot of a batch back to its worker, if this process opened the batch."""
    held = _open_batches.pop(number, None)
    if held is not None and held.pid == os.getpid():
        held.status[held.slot] = _WORKERS


def _retire_slots_of_open_batches() -> None:
    """Keep the slots of all open batches for good: a child is about to be forked that has them."""
    for number in tuple(_open_batches):
        held = _open_batches.pop(number, None)
        if held is not None and held.pid == os.getpid():
            held.status[held.slot] = _RETIRED


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_retire_slots_of_open_batches)


def forget_slots(pids: set[int]) -> None:
    """Let go of the slots of worker processes that have ended; open batches keep their memory."""
    for owner in tuple(_opened):
        if owner.pid in pids:
            _opened.pop(owner, None)


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
