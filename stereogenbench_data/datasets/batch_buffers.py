"""Batches in memory that is used again: samples are written where their batch will be.

Fresh memory costs more than what is written into it, as the system clears it page by page. So a
loader's batches lie in slots of a `BatchMemory`, each for one batch: the process that trains owns
it and gives a slot out with the tasks of a batch, each worker writes its own samples there, and
what comes back are texts, and what has no place in the slot. When the last tensor over a slot is
gone, the slot is free. Without worker processes the same process does both.

What keeps a batch unchanged while somebody holds it:

- The memory belongs to the workers of one pass, or of one loader whose workers persist.
- Only the process that owns it says which slots are free; no state of a slot is shared.
- A batch of workers that is open while its process forks keeps its slot for good, as the child may
  read it.
- Who takes a batch out of those on their way decides what becomes of its slot, once.

Where references are not counted, memory is reused later or never, but not too early. The option
``buffers="fresh"`` of the datasets gives each batch memory of its own, which is copied out of its
slot. torch's own `DataLoader` makes batches as of any other dataset.
"""

import mmap
import os
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from multiprocessing import reduction
from numbers import Number
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import torch
from torch.utils.data import default_collate

from stereogenbench_data.errors import FieldError
from stereogenbench_data.samples.fields import Sample

Buffers = Literal["reused", "fresh"]
"""Whether the memory of batches is reused once nobody holds it."""

_ALIGNED: Final = 64

_SLOT_BYTES: Final = 1 << 36
"""Slots lie so far apart in their file, of which the system keeps only what was written."""


class BufferSpec(NamedTuple):
    """Where a field of a batch lies in a slot.

    Attributes:
        dtype: Its type, as numpy writes it.
        shape: The shape of one sample's.
        start: Where it begins, in bytes.
        stop: Where that of a full batch ends.
    """

    dtype: str
    shape: tuple[int, ...]
    start: int
    stop: int


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
            stop = end + count * array.nbytes
            fields[name] = BufferSpec(array.dtype.str, array.shape, end, stop)
            end = -(-stop // _ALIGNED) * _ALIGNED
            if len(kinds) > 1 or end > _SLOT_BYTES:
                return cls(count, {}, 0)
        return cls(count, fields, end)

    def arrays(self, memory: np.ndarray) -> dict[str, np.ndarray]:
        """Return the fields of a full batch in a slot's memory, which they keep; without texts."""
        return {
            name: memory[spec.start : spec.stop].view(spec.dtype).reshape(-1, *spec.shape)
            for name, spec in self.fields.items()
            if spec is not None
        }


class BatchMemory:
    """The slots of the batches of one pass, or of a loader whose workers persist.

    The process that trains owns it. Workers get it when they start, and write into the slots that
    tasks name: it is one file, which has no name and no state. On Linux the file is memory;
    elsewhere it is a temporary file. Without workers it is memory of the process alone.

    Attributes:
        layout: Where fields lie in the slots, once it was told.
    """

    layout: Layout | None = None

    def __init__(self, *, kept: int, fd: int | None) -> None:
        """Begin with no slot.

        Args:
            kept: The memory of so many free slots is kept.
            fd: The open file; None without workers.
        """
        self._kept, self._fd = kept, fd
        self._count = 0
        self._free: list[int] = []
        self._lent: set[int] = set()
        self._maps: dict[int, mmap.mmap | memoryview] = {}
        _memories.add(self)

    def take(self) -> int:
        """Return the number of a free slot."""
        if self._free:
            return self._free.pop()
        slot, self._count = self._count, self._count + 1
        if self._fd is not None:
            os.ftruncate(self._fd, self._count * _SLOT_BYTES)
        return slot

    def give_back(self, slot: int) -> None:
        """Take a slot as free."""
        if len(self._free) >= self._kept and slot in self._maps:
            unused = self._maps.pop(slot)
            if isinstance(unused, mmap.mmap) and hasattr(mmap, "MADV_REMOVE"):
                unused.madvise(mmap.MADV_REMOVE)
        self._free.append(slot)

    def arrays(self, slot: int) -> dict[str, np.ndarray]:
        """Return the fields of a full batch in a slot; none before it is known where they lie."""
        return {} if self.layout is None else self.layout.arrays(self._bytes_of(slot, self.layout))

    def batch(self, slot: int, layout: Layout, *, count: int) -> dict[str, torch.Tensor]:
        """Return the tensors of a batch in a slot, which is free when none of them is left.

        Each field is a tensor of its own, so that one that is saved does not take the others along.
        """
        # The memory lives as long as any tensor over it does, however it was sliced.
        memory = self._bytes_of(slot, layout)
        self._lent.add(slot)
        weakref.finalize(memory, _release, weakref.ref(self), slot).atexit = False
        arrays = layout.arrays(memory)
        return {name: torch.from_numpy(array[:count]) for name, array in arrays.items()}

    def _bytes_of(self, slot: int, layout: Layout) -> np.ndarray:
        """Return an array over a slot's memory, uint8."""
        if slot not in self._maps:
            size_bytes = max(1, layout.size_bytes)
            if self._fd is None:
                self._maps[slot] = np.empty(size_bytes, dtype=np.uint8).data
            else:
                while len(self._maps) > max(self._kept, _MOST_MAPPED):
                    del self._maps[next(iter(self._maps))]
                self._maps[slot] = mmap.mmap(self._fd, size_bytes, offset=slot * _SLOT_BYTES)
        # All slices are based on this array, and none on what is below it, which is no array.
        return np.frombuffer(self._maps[slot], dtype=np.uint8)

    def close(self) -> None:
        """Close the file; batches that are held keep their memory."""
        self._maps.clear()
        fd, self._fd = self._fd, None
        if fd is not None:
            os.close(fd)

    def __del__(self) -> None:
        """Close the file when no reference is left."""
        self.close()

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what a worker that is started, not forked, opens the file from."""
        fd: Any = self._fd  # a worker's memory is a file
        return _received, (reduction.DupFd(fd), self._kept)


_MOST_MAPPED: Final = 64
"""So many slots of a file a process keeps mapped, where a loop holds ever more batches."""

_memories: Final[weakref.WeakSet[BatchMemory]] = weakref.WeakSet()


def memory_file() -> int:
    """Return an open file without a name."""
    if hasattr(os, "memfd_create"):
        with suppress(OSError):
            return os.memfd_create("stereogenbench batches")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def _received(fd: Any, kept: int) -> BatchMemory:
    return BatchMemory(fd=fd.detach(), kept=kept)


def _release(owner: Callable[[], BatchMemory | None], slot: int) -> None:
    """Give the slot of a batch back, unless a fork may have it."""
    memory = owner()
    if memory is not None and slot in memory._lent:
        memory._lent.discard(slot)
        memory.give_back(slot)


def _keep_lent_slots() -> None:
    """Never use the slots of open batches again: a child is about to be forked that has them.

    Of memory that is the process's alone a child has a copy.
    """
    for memory in tuple(_memories):
        if memory._fd is not None:
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
    batch: dict[str, Any] = default_collate([*samples])
    return batch


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
