"""Shared batch buffers: samples are written where their batch will be, and the memory is reused.

Fresh memory costs more than what is written into it, as the system clears it page by page. So the
buffers of a batch are reused once nobody holds any part of it. Without worker processes these are
arrays of the process. With a loader's workers they are slots of one `BatchMemory`, each for one
batch: the process that trains owns it and gives a slot out with the tasks of a batch, each worker
writes its own samples there, and what comes back are texts, and what has no place in the slot. When
the last tensor over a slot is gone, the slot is free.

What keeps a batch unchanged while somebody holds it:

- The memory belongs to the workers of one pass, or of one loader whose workers persist.
- Only the process that owns it says which slots are free; no state of a slot is shared.
- A batch that is open while its process forks keeps its slot for good, as the child may read it.
- Who takes a batch out of those on their way decides what becomes of its slot, once.

Where references are not counted, memory is reused later or never, but not too early. The option
``buffers="fresh"`` of the datasets gives each batch memory of its own, which is copied out of its
slot.
"""

import itertools
import math
import mmap
import os
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from multiprocessing import reduction
from numbers import Number
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, get_args

import numpy as np
import torch
from torch.utils.data import default_collate, get_worker_info

from stereogenbench_data.errors import FieldError, SelectionError, StorageError
from stereogenbench_data.samples.fields import Allocate, Sample

Buffers = Literal["reused", "fresh"]
"""Whether the memory of batches is reused once nobody holds it."""

KEPT_BUFFERS: Final = 3
"""Buffers of a process that are kept for each field: a loop holds one while another is made."""

_ALIGNED: Final = 64

_SHARED: Final = Path("/dev/shm")
"""Where torch's shared memory lies on Linux."""

_SLOT_BYTES: Final = 1 << 36
"""Slots lie so far apart in their file, of which the system keeps only what was written."""


class BatchArrays:
    """The fields of samples of one shape: one tensor each, of which a sample is a slice.

    Attributes:
        count: How many samples there are.
        holds_all: Whether every array that was asked for is a slice of them.
    """

    def __init__(self, count: int, take: Callable[[str, int], torch.Tensor | None]) -> None:
        """Begin without fields.

        Args:
            count: How many samples there are.
            take: Returns memory for a field, by its name and size; None where there is no place.
        """
        self.count = count
        self.holds_all = True
        self._arrays: dict[str, np.ndarray] = {}
        self._slices: dict[str, tuple[torch.Tensor, ...]] = {}
        self._take = take

    def of_sample(self, number: int) -> Allocate:
        """Return what gives the arrays that one sample's fields are written into."""

        def allocate(name: str, shape: tuple[int, ...], dtype: Any) -> Any:
            whole = self._whole(name, shape, np.dtype(dtype))
            if whole is None or whole.shape[1:] != shape:
                self.holds_all = False
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
                same = name in self._arrays and self._arrays[name].shape[1:] == value.shape
                tensors[name] = self._slices[name][number] if same else torch.from_numpy(value)
        return tensors

    def _whole(self, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Any:
        if name not in self._arrays:
            flat = self._take(name, self.count * math.prod(shape) * dtype.itemsize)
            if flat is None:
                return None
            kind = torch.from_numpy(np.empty(0, dtype=dtype)).dtype
            whole = flat.view(kind).view(self.count, *shape)
            self._arrays[name], self._slices[name] = whole.numpy(), whole.unbind()
        return self._arrays[name]


class BatchBuffers:
    """Where the batches of a dataset are made, in each process by itself.

    A copy that is pickled or forked into a worker begins with no buffers.

    Attributes:
        kind: Whether memory is reused.
        makes_batches: Whether `collate` makes the batches of this process, as it has before.
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
        self.makes_batches = False
        self._free: dict[str, list[np.ndarray]] = {}

    def allocate(self, count: int) -> BatchArrays:
        """Return the arrays for a batch of ``count`` samples."""
        is_fresh = self.kind == "fresh" or get_worker_info() is not None
        return BatchArrays(count, fresh_bytes if is_fresh else self._take)

    def collate(self, samples: Sequence[Sample]) -> dict[str, Any]:
        """Return samples as a batch, as `collate` does; more of them are expected.

        Raises:
            FieldError: If a field has another shape in one sample than in the first.
        """
        self.makes_batches = True
        return collate(samples)

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
    """Return new memory for a field: in a worker such that it is not copied when it is sent.

    Raises:
        StorageError: If shared memory is full.
    """
    del name
    if get_worker_info() is None:
        return torch.empty(size_bytes, dtype=torch.uint8)
    if _SHARED.is_dir() and (free := shutil.disk_usage(_SHARED).free) < size_bytes:
        # Writing beyond it would kill the worker.
        raise StorageError(
            f"{_SHARED}: has {free / 1e6:.0f} MB left, and a field of a batch takes "
            f"{size_bytes / 1e6:.0f} MB. Give the container more (--shm-size, or --ipc=host), take "
            "smaller batches, or use loader(...) of the dataset, whose batches need none of it."
        )
    # As torch's own collate does.
    storage = torch.UntypedStorage._new_shared(size_bytes)
    return torch.empty(0, dtype=torch.uint8).set_(storage)


class BufferSpec(NamedTuple):
    """Where a field of a batch lies in a slot.

    Attributes:
        dtype: Its type, as numpy writes it.
        shape: The shape of one sample's.
        start: Where it begins, in bytes.
        item_bytes: Of one sample.
    """

    dtype: str
    shape: tuple[int, ...]
    start: int
    item_bytes: int


class Layout(NamedTuple):
    """Where the fields of a batch lie in a slot.

    Attributes:
        samples: The samples of a full batch.
        fields: Where each field lies, None of texts; in the order of a batch's fields.
        size_bytes: Of a slot.
    """

    samples: int
    fields: dict[str, BufferSpec | None]
    size_bytes: int

    @classmethod
    def of_samples(cls, samples: Sequence[Sample], *, count: int) -> "Layout":
        """Return the layout of batches of such samples; of no field where their shapes differ."""
        fields: dict[str, BufferSpec | None] = {}
        end = 0
        for name, value in samples[0].items():
            fields[name] = None
            if isinstance(value, str):
                continue
            kinds = {(each[name].dtype, each[name].shape) for each in samples}
            array = value.numpy()
            fields[name] = BufferSpec(array.dtype.str, array.shape, end, array.nbytes)
            end += -(-count * array.nbytes // _ALIGNED) * _ALIGNED
            if len(kinds) > 1 or end > _SLOT_BYTES:
                return cls(count, {}, 0)
        return cls(count, fields, end)


class BatchMemory:
    """The slots of the batches that workers make: one file, which has no name and no state.

    The process that trains owns it. Workers get it when they start, and write into the slots that
    tasks name. On Linux the file is memory; elsewhere it is a temporary file.

    Attributes:
        layout: Where fields lie in the slots, as a worker was told.
    """

    layout: Layout | None = None

    def __init__(self, *, kept: int = 0, fd: int | None = None) -> None:
        """Begin with no slot.

        Args:
            kept: The memory of so many free slots is kept.
            fd: The open file; None makes one.
        """
        self._fd = _memory_file() if fd is None else fd
        self._kept = kept
        self._count = 0
        self._free: list[int] = []
        self._lent: dict[int, int] = {}
        self._maps: dict[int, mmap.mmap] = {}
        _memories.add(self)

    def take(self) -> int:
        """Return the number of a free slot."""
        if self._free:
            return self._free.pop()
        slot, self._count = self._count, self._count + 1
        os.ftruncate(self._fd, self._count * _SLOT_BYTES)
        return slot

    def give_back(self, slot: int) -> None:
        """Take a slot as free."""
        if len(self._free) >= self._kept and slot in self._maps and hasattr(mmap, "MADV_REMOVE"):
            self._maps[slot].madvise(mmap.MADV_REMOVE)
        self._free.append(slot)

    def bytes_of(self, slot: int, size_bytes: int) -> np.ndarray:
        """Return a slot's memory, uint8 (size_bytes,)."""
        held = self._maps.get(slot)
        if held is None or len(held) < size_bytes:
            while len(self._maps) > max(self._kept, _MOST_MAPPED):
                del self._maps[next(iter(self._maps))]
            held = mmap.mmap(self._fd, max(1, size_bytes), offset=slot * _SLOT_BYTES)
            self._maps[slot] = held
        return np.frombuffer(held, dtype=np.uint8, count=size_bytes)

    def arrays(self, slot: int, layout: Layout) -> BatchArrays:
        """Return the arrays of a batch in a slot."""
        whole = torch.from_numpy(self.bytes_of(slot, layout.size_bytes))

        def take(name: str, size_bytes: int) -> torch.Tensor | None:
            spec = layout.fields.get(name)
            if spec is None or layout.samples * spec.item_bytes != size_bytes:
                return None
            return whole[spec.start : spec.start + size_bytes]

        return BatchArrays(layout.samples, take)

    def batch(self, slot: int, layout: Layout, *, count: int) -> dict[str, torch.Tensor]:
        """Return the tensors of a batch in a slot, which is free when none of them is left.

        Each field is a tensor of its own, so that one that is saved does not take the others along.
        """
        # The array lives as long as any tensor over it does, however it was sliced.
        array = self.bytes_of(slot, layout.size_bytes)
        number = next(_numbers)
        self._lent[number] = slot
        weakref.finalize(array, _release, weakref.ref(self), number).atexit = False
        return {
            name: torch.from_numpy(
                array[spec.start : spec.start + count * spec.item_bytes]
                .view(spec.dtype)
                .reshape(count, *spec.shape)
            )
            for name, spec in layout.fields.items()
            if spec is not None
        }

    def close(self) -> None:
        """Close the file; batches that are held keep their memory."""
        self._maps.clear()
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def __del__(self) -> None:
        """Close the file when no reference is left."""
        self.close()

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what a worker that is started, not forked, opens the file from."""
        return _received, (reduction.DupFd(self._fd), self._kept)


_MOST_MAPPED: Final = 64
"""So many slots a process keeps mapped, where a loop holds ever more batches."""

_numbers: Final = itertools.count()

_memories: Final[weakref.WeakSet[BatchMemory]] = weakref.WeakSet()


def _memory_file() -> int:
    """Return an open file without a name."""
    if hasattr(os, "memfd_create"):
        with suppress(OSError):
            return os.memfd_create("stereogenbench batches")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def _received(fd: Any, kept: int) -> BatchMemory:
    return BatchMemory(fd=fd.detach(), kept=kept)


def _release(owner: Callable[[], BatchMemory | None], number: int) -> None:
    """Give the slot of a batch back, unless a fork may have it."""
    memory = owner()
    slot = None if memory is None else memory._lent.pop(number, None)
    if memory is not None and slot is not None:
        memory.give_back(slot)


def _keep_lent_slots() -> None:
    """Never use the slots of open batches again: a child is about to be forked that has them."""
    for memory in tuple(_memories):
        memory._lent.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_keep_lent_slots)


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
        samples: Samples with the same fields, of the same types.

    Returns:
        Tensors with a batch axis in front; texts as lists.

    Raises:
        FieldError: If a field has another shape in one sample than in the first, as where scenes
            of several sizes, or sweeps with several numbers of views, are put in one batch; if it
            has another type there or is missing, as beside samples of another dataset.
    """
    first = samples[0]
    for place, sample in enumerate(samples):
        for name in {**first, **sample}:
            here, there = _form(sample, name), _form(first, name)
            if here == there:
                continue
            cure = "give samples of several datasets the same fields, of the same types."
            if here[0] == there[0]:
                here, there = here[1:], there[1:]
                cure = "give size=(height, width), or batch sweeps one by one."
            told, told_first = (" ".join(map(str, each)) for each in (here, there))
            raise FieldError(
                f"{name} is {told} in {sample.get('__key__', f'sample {place} of the batch')} and "
                f"{told_first} in {first.get('__key__', 'sample 0 of the batch')}: {cure}"
            )
    return {name: _stacked([sample[name] for sample in samples]) for name in first}


def _form(sample: Sample, name: str) -> tuple[Any, ...]:
    """Return what the fields of a batch must have in common: their type, of arrays the shape."""
    if name not in sample:
        return ("missing",)
    value = sample[name]
    if isinstance(value, torch.Tensor | np.ndarray):
        return str(value.dtype), tuple(value.shape)
    kinds = {str: "a text", Number: "a number"}
    return (next((kinds[each] for each in kinds if isinstance(value, each)), type(value).__name__),)


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
