"""A batch in parts: each worker makes its own samples of every batch, which are put together.

A rank's workers share the streams of its batches out (`EpochOrder.workers_of`), so each video is
decoded by one worker, whatever their number, and a rank's memory does not grow with them. Tasks go
through torch's own queues, in order: task b W + w is worker w's part of batch b. A worker whose
part is empty answers at once.

The first batch comes as plain arrays and tells where fields lie in a slot; until it has come, tasks
are empty. From then on a task names a slot of the `BatchMemory` of its pass, where workers write
their samples side by side. What does not fit there, such as pictures of another size, comes as
plain arrays, and the batch is stacked of them.

A batch on its way is in one place, `PartedBatches`. Whoever takes it out there, the loop or torch's
thread that pins memory, decides what becomes of its slot.
"""

import copy
import itertools
import traceback
import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from torch.utils.data import get_worker_info
from torch.utils.data._utils.pin_memory import pin_memory

from stereogenbench_data.datasets.batch_buffers import (
    BatchMemory,
    Buffers,
    Layout,
    collate,
    to_tensors,
)
from stereogenbench_data.datasets.batches import EpochBatch, GlobalBatches
from stereogenbench_data.datasets.division import WorkerShare
from stereogenbench_data.errors import StereoGenBenchError
from stereogenbench_data.samples.fields import Allocate, Sample
from stereogenbench_data.samples.load import Work

_NOTHING: Final = EpochBatch((), epoch=0)

_FILLER: Final = -1
"""The number of what is dealt while nothing else may be."""


class BatchPart(NamedTuple):
    """A worker's task: its samples of a batch.

    Attributes:
        batch: The samples.
        places: The places of the batch where they belong.
        key: The number of the pass, and of the batch in it.
        slot: Where to write them; None where they are sent.
        layout: Where fields lie in this slot and in those of later tasks; None once it was told.
    """

    batch: EpochBatch
    places: list[int]
    key: tuple[int, int]
    slot: int | None = None
    layout: Layout | None = None


@dataclass(slots=True)
class MadePart:
    """What a worker made of its part.

    Attributes:
        key: The number of the pass, and of the batch in it.
        places: Where its samples belong.
        samples: The samples; of those in the slot the texts alone.
        is_in_slot: Whether everything else of them is in the slot.
        work: What the worker has done since its part before.
        failed: The place of a sample that could not be loaded, and why.
        is_pinned: Whether torch's thread has put it into its batch.
    """

    key: tuple[int, int]
    places: list[int]
    samples: list[Sample] = field(default_factory=list)
    is_in_slot: bool = True
    work: Work | None = None
    failed: tuple[int, StereoGenBenchError] | None = None
    is_pinned: bool = False

    def pin_memory(self) -> "MadePart":
        """Put it into its batch, which is copied to pinned memory if it is whole now.

        torch's thread calls this with what comes from workers.
        """
        parted = _parted.get(self.key[0])
        if parted is not None and self.key[1] != _FILLER:
            parted.add(self, pinned=True)
        self.is_pinned = True
        return self


def memory_of(task: BatchPart) -> BatchMemory:
    """Return the slots for a task that this process has dealt to itself."""
    return _parted[task.key[0]].memory


def make_part(
    task: BatchPart,
    memory: BatchMemory,
    load: Callable[[Callable[[int], Allocate]], Iterator[Sample]],
) -> MadePart:
    """Make the samples of a task, in its slot if it has one.

    Args:
        task: The task.
        memory: The slots.
        load: Yields the samples as arrays and texts. It is given what allocates their arrays, by
            their places in the task.
    """
    made = MadePart(task.key, task.places)
    arrays = {} if task.slot is None else memory.arrays(task.slot)

    def of_place(number: int) -> Allocate:
        def allocate(name: str, shape: tuple[int, ...], dtype: Any) -> Any:
            whole = arrays.get(name)
            if whole is None or whole.shape[1:] != shape or whole.dtype != dtype:
                made.is_in_slot = False
                return np.empty(shape, dtype=dtype)
            return whole[task.places[number], ...]

        return allocate

    try:
        for sample in load(of_place):
            made.samples.append(sample)
    except StereoGenBenchError as error:
        # Of a batch the first row's error is raised, whichever worker has met it.
        if get_worker_info() is not None:
            error.add_note(traceback.format_exc())
        made.failed = task.places[len(made.samples)], error
        made.samples.clear()
        return made
    if made.is_in_slot:
        made.samples = [
            {name: value for name, value in each.items() if isinstance(value, str)}
            for each in made.samples
        ]
    elif arrays:
        # The slot may soon be another batch's.
        made.samples = [copy.deepcopy(each) for each in made.samples]
    return made


def part_as_made(made: MadePart) -> MadePart:
    """Send what a worker has made as it is: the ``collate_fn`` of workers."""
    return made


@dataclass(slots=True)
class Making:
    """How a loader's batches are made of samples, and what was done for them.

    Attributes:
        collate_fn: Makes a batch of samples, in the process that trains.
        buffers: Whether a batch may lie in its slot.
        layout: Where fields lie in a slot; None until the first batch has told.
        work: What workers have done, in all passes.
    """

    collate_fn: Callable[[list[Sample]], Any]
    buffers: Buffers
    layout: Layout | None = None
    work: Work = field(default_factory=Work)


@dataclass(slots=True)
class _Coming:
    """A batch on its way: how many samples it has, its slot, and what has come of it.

    ``whole`` is the batch where it was put together already. ``failures`` are the places of samples
    that could not be loaded, and why.
    """

    count: int
    slot: int | None
    parts: list[MadePart] = field(default_factory=list)
    whole: Any = None
    failures: list[tuple[int, StereoGenBenchError]] = field(default_factory=list)


class PartedBatches:
    """The batches of one pass on their way: dealt to workers in parts, and put together."""

    def __init__(
        self,
        batches: Iterator[Any],
        of_all_ranks: GlobalBatches,
        share: WorkerShare,
        *,
        memory: BatchMemory,
        making: Making,
        before: "PartedBatches | None",
    ) -> None:
        """Deal nothing yet.

        Args:
            batches: The batches of the pass.
            of_all_ranks: Says which worker decodes which sample.
            share: Whose batches they are.
            memory: The slots.
            making: How batches are made of samples.
            before: The pass that the same workers served before. Its slots are free once torch has
                waited for them, which is when it asks for the first task.
        """
        self._batches, self._global_batches, self._share = batches, of_all_ranks, share
        self.memory, self._making, self._before = memory, making, before
        self._pass, self._due = next(_passes), 0
        self._told: Layout | None = None
        self._coming: dict[int, _Coming] = {}
        _parted[self._pass] = self

    def tasks(self) -> Iterator[BatchPart]:
        """Yield the tasks of all workers, batch by batch."""
        if self._before is not None:
            self._before._discard()
            self._before = None
        nothing = BatchPart(_NOTHING, [], (self._pass, _FILLER))
        for number, batch in enumerate(self._batches):
            while self._making.layout is None and number > 0:
                yield from [nothing] * self._share.workers
            yield from self._parts(batch, number)

    def _parts(self, batch: Any, number: int) -> list[BatchPart]:
        """Return a batch's tasks, one for each worker."""
        if not isinstance(batch, EpochBatch):
            batch = EpochBatch(batch, epoch=0)
        share, layout = self._share, self._making.layout
        worker_of = np.full(len(batch), number % share.workers)
        if batch.number is not None:
            worker_of = self._global_batches.workers_of(batch, share)
            batch.open_runs = share.open_runs(self._global_batches.order(batch.epoch))
        if layout is not None and (not layout.fields or layout.samples < len(batch)):
            layout = None
        slot = None if layout is None else self.memory.take()
        self._coming[number] = _Coming(len(batch), slot)
        places: list[list[int]] = [[] for _ in range(share.workers)]
        for place, worker in enumerate(worker_of.tolist()):
            places[worker].append(place)
        untold, key = None if layout is self._told else layout, (self._pass, number)
        self._told = layout or self._told
        return [
            BatchPart(batch.at(own) if own else _NOTHING, own, key, slot if own else None, untold)
            for own in places
        ]

    def next(self, results: Iterator[MadePart]) -> Any:
        """Return the next batch.

        Args:
            results: What workers send, in the order of the tasks.

        Raises:
            StopIteration: If there is none.
            StereoGenBenchError: If samples could not be loaded: the error of the first of them.
        """
        is_pinned, came = False, 0
        while came < self._share.workers:
            made = next(results)
            if made.key[1] == _FILLER:
                continue
            came, is_pinned = came + 1, made.is_pinned
            if not is_pinned:
                self.add(made)
        coming = self._coming.pop(self._due)
        self._due += 1
        if coming.whole is not None:
            return coming.whole
        return self._put_together(coming, pinned=is_pinned)

    def add(self, made: MadePart, *, pinned: bool = False) -> None:
        """Take a part that came from a worker."""
        coming = self._coming[made.key[1]]
        coming.parts.append(made)
        if made.failed is not None:
            coming.failures.append(made.failed)
        if made.work is not None:
            self._making.work.add(made.work)
        is_whole = pinned and len(coming.parts) == self._share.workers
        if is_whole and self._making.collate_fn is collate and not coming.failures:
            coming.whole = self._put_together(coming, pinned=True)

    def _put_together(self, coming: _Coming, *, pinned: bool) -> Any:
        """Return a batch all of whose parts have come."""
        slot, layout = coming.slot, self._making.layout
        if coming.failures:
            if slot is not None:
                self.memory.give_back(slot)
            raise min(coming.failures, key=lambda failure: failure[0])[1]
        rows: list[Sample] = [{}] * coming.count
        for part in coming.parts:
            for place, sample in zip(part.places, part.samples, strict=True):
                rows[place] = sample if part.is_in_slot else to_tensors(sample)
        in_slot = {each for part in coming.parts if part.is_in_slot for each in part.places}
        if slot is not None and layout is not None:
            tensors = self.memory.batch(slot, layout, count=coming.count)
            if self._making.buffers == "fresh":
                tensors = {name: tensor.clone() for name, tensor in tensors.items()}
            if self._making.collate_fn is collate and len(in_slot) == len(rows):
                texts = layout.fields.keys() - tensors
                batch = {
                    name: [row[name] for row in rows] if name in texts else tensors[name]
                    for name in layout.fields
                }
                return pin_memory(batch) if pinned else batch
            for place in in_slot:
                own = {name: tensor[place] for name, tensor in tensors.items()} | rows[place]
                rows[place] = {name: own[name] for name in layout.fields}
        if layout is None:
            size = self._global_batches.rule.batch_size
            self._making.layout = Layout.of_samples(rows, count=size)
        batch = self._making.collate_fn(rows)
        return pin_memory(batch) if pinned else batch

    def _discard(self) -> None:
        """Take the slots of what was not taken as free: no worker writes into them any more."""
        while self._coming:
            _, coming = self._coming.popitem()
            if coming.slot is not None and coming.whole is None:
                self.memory.give_back(coming.slot)


_passes: Final = itertools.count()

_parted: Final[weakref.WeakValueDictionary[int, PartedBatches]] = weakref.WeakValueDictionary()
"""The passes of this process by their numbers, for torch's thread that pins memory."""
