"""The batches of an epoch for one rank, as a torch sampler; passes over them, and their position.

A position is an epoch and how many of its batches are consumed, counted over all ranks. Each `Pass`
counts what was taken of it. `Passes` says where the next one begins and which one a state is of.
Workers see the epoch through shared memory, and those that are spawned the rows of an index, too.
"""

import copy
import itertools
import math
import multiprocessing
import os
import sys
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from multiprocessing.context import get_spawning_popen
from multiprocessing.reduction import ForkingPickler
from multiprocessing.sharedctypes import RawArray
from typing import Any, Final, Literal, NamedTuple, Protocol, TypedDict, Unpack
from weakref import WeakKeyDictionary

import numpy as np
import pyarrow as pa
import torch
import torch.distributed
from torch.utils.data import Sampler, get_worker_info

from stereogenbench_data.errors import SelectionError, StateError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.fields import Stream
from stereogenbench_data.samples.load import OPEN_STREAMS
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.selection.filters import require_options, whole_number
from stereogenbench_data.selection.order import (
    ORDER_VERSION,
    DropLast,
    EpochOrder,
    Numbers,
    OrderRule,
    Runs,
    groups_for,
    last_batch,
    open_runs_for,
    rank_share,
    usual_groups,
)
from stereogenbench_data.selection.plan import Plan

_rows: Final[WeakKeyDictionary[SceneIndex, torch.Tensor]] = WeakKeyDictionary()
"""The rows of each index that was sent to other processes, laid out once."""
_OURS_OR_TORCH: Final = frozenset({__name__.partition(".")[0], "torch"})


class RepeatedEpochWarning(UserWarning):
    """A second pass draws the same random frames and transforms, or has the same order."""


def users_level() -> int:
    """Return the stack level of a caller's warning that is neither this package's nor torch's."""
    frame, level = sys._getframe(1), 1
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] in _OURS_OR_TORCH:
        frame, level = frame.f_back, level + 1
    return level


class SharedNumbers:
    """Whole numbers of which running workers see every change.

    The workers of the process that made them have the same numbers, however they are started. Any
    other copy has numbers of its own, which its own workers share: by `copy`, by pickle, or in a
    process that was forked or spawned as another rank.
    """

    def __init__(self, numbers: Sequence[int]) -> None:
        """Begin with these numbers.

        The standard library keeps those of a process in few open files, though it may have
        thousands of datasets.
        """
        self._owner, self._shared = os.getpid(), RawArray("q", list(numbers))

    @property
    def _numbers(self) -> Any:
        if self._owner != os.getpid():
            parent = multiprocessing.parent_process()
            started_by = None if get_worker_info() is None or parent is None else parent.pid
            if started_by != self._owner:
                self._owner, self._shared = os.getpid(), RawArray("q", self._shared[:])
        return self._shared

    def __getitem__(self, place: int) -> int:
        """Return a number."""
        number: int = self._numbers[place]
        return number

    def __setitem__(self, place: int, number: int) -> None:
        """Change a number for all processes."""
        self._numbers[place] = number

    def __iter__(self) -> Iterator[int]:
        """Yield all numbers."""
        yield from self._numbers

    def clear(self) -> None:
        """Set all of them to 0."""
        self._numbers[:] = [0] * len(self._numbers)

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what a copy is made from: these numbers, in a process that is being started."""
        shared = self._numbers
        if get_spawning_popen() is None:
            return SharedNumbers, (shared[:],)
        return object.__new__, (SharedNumbers,), {"_owner": self._owner, "_shared": shared}


class SharedEpoch:
    """The epoch that a dataset draws random frames and transforms for, as all its workers see it.

    torch's own `DataLoader` makes passes of the same epoch until one is set, so each would draw the
    same random frames and transforms. The first sample that any process draws in an epoch is
    watched; the process that draws it again warns, once. A copy has an epoch of its own.
    """

    def __init__(self, epoch: int = 0) -> None:
        """Begin at an epoch that was never set, with no sample watched."""
        self._numbers = SharedNumbers([epoch, 0])
        self._watched = SharedNumbers([-1, -1, 0])  # epoch and sample, and whether it was told
        self._ended: tuple[OrderRule, int, int] | None = None
        self._ended_by, self._was_told = 0, False

    @property
    def value(self) -> int:
        """The epoch, from 0."""
        return self._numbers[0]

    @property
    def times_set(self) -> int:
        """How often it was set."""
        return self._numbers[1]

    def set(self, epoch: int) -> None:
        """Go to an epoch.

        Raises:
            SelectionError: If it is not a whole number from 0.
        """
        self._numbers[0] = require_epoch(epoch)
        self._numbers[1] += 1

    def mark_drawn(self, numbers: Sequence[int], *, epoch: int, dataset: object) -> None:
        """Take random samples as drawn, and warn if the watched one is drawn again.

        Args:
            numbers: The samples.
            epoch: Their epoch.
            dataset: What draws them, for the warning.
        """
        watched, marked = self._watched, hash((epoch, self.times_set))
        if watched[0] != marked and numbers:
            watched[1], watched[0] = numbers[0], marked
        elif watched[1] in numbers and not watched[2]:
            watched[2] = 1
            warnings.warn(
                f"{dataset!r} is read by torch's own DataLoader, and samples of epoch {epoch} "
                "come a second time, with the same random frames and transforms. If this is "
                "another pass, call set_epoch(epoch) before each, or use StereoPairs(...)"
                ".loader(...), whose every pass is of the next epoch. A sampler that draws with "
                "replacement repeats samples within a pass, and that changes nothing.",
                RepeatedEpochWarning,
                stacklevel=users_level(),
            )

    def mark_ended(self, rule: OrderRule, *, loader: int) -> None:
        """Take a pass of the dataset's epoch as ended: its order, and the number of its loader."""
        self._ended, self._ended_by = (rule, self.value, self.times_set), loader

    def mark_begun(self, rule: OrderRule, *, loader: int) -> None:
        """Warn, once, where another loader has ended the same pass of the dataset's epoch."""
        is_again = self._ended == (rule, self.value, self.times_set)
        if is_again and self._ended_by != loader and not self._was_told:
            self._was_told = True
            warnings.warn(
                f"a new loader repeats epoch {self.value} of the loader before it: the same order, "
                "random frames and transforms. Make the loader once, before the loop over epochs: "
                "each of its passes is of the next epoch. Or call set_epoch(epoch) of the dataset, "
                "or of the new loader, before each pass.",
                RepeatedEpochWarning,
                stacklevel=users_level(),
            )


def require_epoch(epoch: int) -> int:
    """Return the number of an epoch.

    Raises:
        SelectionError: If it is not a whole number from 0.
    """
    whole = whole_number(epoch)
    if whole is None or not 0 <= whole < 2**63:
        raise SelectionError(f"an epoch is a whole number from 0, got {epoch!r}.")
    return whole


def _parted(index: SceneIndex) -> tuple[Any, ...]:
    table, rest = index.parted()
    if index not in _rows:
        sink = pa.BufferOutputStream()
        with pa.ipc.new_stream(sink, table.schema) as stream:
            stream.write_table(table)
        _rows[index] = torch.frombuffer(bytearray(sink.getvalue()), dtype=torch.uint8)
        _rows[index].share_memory_()
    return _joined, (_rows[index], rest)


def _joined(rows: torch.Tensor, rest: dict[str, Any]) -> SceneIndex:
    with pa.ipc.open_stream(pa.py_buffer(rows.numpy())) as stream:
        return SceneIndex.of_parts(stream.read_all(), rest)


# For processes of this machine alone: a plain pickle of an index holds its rows.
ForkingPickler.register(SceneIndex, _parted)


State = dict[str, Any]
"""A position: a flat dict of numbers and texts, which JSON and `torch.save` take."""

_STATES: Final = (
    "Pass what state_dict() of a loader, of EpochBatches or of a stream returned, unchanged."
)


_DIGESTS: Final = {
    "selection": "as many samples of as many scenes are selected, and other scenes, pairs, frames, "
    "or another seed",
    "index": "the index is another one: its files were changed, or indexed in another way",
}
"""What differs where nothing but a digest does."""


Position = tuple[int, int]
"""An epoch, and how many of its global batches are consumed."""


class EpochOptions(TypedDict, total=False):
    """How an epoch is ordered and divided among ranks.

    Attributes:
        seed: The seed of the order, the same on all ranks; that of the dataset if left out.
        rank: Whose batches these are, from 0. By default torch.distributed's rank, or 0 where it is
            not initialised.
        world_size: How many ranks there are. By default torch.distributed's world size, or 1.
        shuffle: Whether samples are shuffled, by default; False gives them by their numbers.
        drop_last: What happens to the epoch's last batches. True, the default of a shuffled order:
            each rank gets as many batches, all of them full; what is left over is dropped (see
            `EpochBatches.left_out`). False, the default otherwise: every sample exactly once; the
            last batch may be short, and ranks may differ by one batch. "pad": each rank gets as
            many full batches and no sample is left out; samples from the epoch's start fill up,
            marked in the field ``is_padding`` (batch,) bool.
        shuffle_groups: How many groups of scenes are shuffled separately, for ranks: batch n is of
            group n mod shuffle_groups. If left out 8, or fewer with larger batches, pictures or
            fewer scenes, raised to a multiple of the ranks; a state keeps it, and goes on with it
            under other ranks. A number that is given counts.
        open_scenes: The shuffle buffer, counted in scenes: how many each group interleaves. If left
            out, about 64 of all groups together, or a batch where that is more (with few scenes a
            few more), but of large pictures no more than about 3.6 GB of decoders hold: of
            1280x1280 pixels 64 with one pair a scene, and 17 with all pairs. Fewer take less memory
            and shuffle less well. A rank has those of its groups open, shared out among its
            workers.
        open_frames: How many neighbouring frames of each open scene are interleaved, where several
            samples show a frame (all pairs). A batch then shows more moments, and their pictures
            and depth stay in memory. If left out, as many as a batch has samples of an open scene,
            within 2 GB: 2 with all pairs of 1280x1280 pixels and a batch of 32, 1 with one pair a
            scene.
    """

    seed: int
    rank: int
    world_size: int
    shuffle: bool
    drop_last: DropLast
    shuffle_groups: int
    open_scenes: int
    open_frames: int


class EpochBatch(list[int]):
    """The numbers of a batch's samples, with the epoch that they are drawn for.

    Attributes:
        epoch: The epoch, of random frames and transforms, too; that of the dataset does not matter.
        is_padding: For each sample whether it fills up after the epoch's end; None where no sample
            ever does (without ``drop_last="pad"``).
        ends_of_runs: The samples after which their videos are wanted no more for now.
        number: Its number among the batches of all ranks; None for a batch outside of an epoch.
        group: The shuffle group that it is of.
        open_runs: How many runs of its group who reads it has open at a time.
        open_frames: How many frames of each are kept.
    """

    def __init__(
        self,
        numbers: Iterable[int],
        *,
        epoch: int,
        ends_of_runs: Collection[int] = (),
        number: int | None = None,
        group: int = 0,
    ) -> None:
        """Hold the numbers."""
        super().__init__(numbers)
        self.epoch = epoch
        self.is_padding: list[bool] | None = None
        self.ends_of_runs = ends_of_runs
        self.number = number
        self.group = group
        self.open_runs = 0
        self.open_frames = 1

    def at(self, places: Sequence[int]) -> "EpochBatch":
        """Return the samples at some of its places as a batch."""
        part = EpochBatch([self[place] for place in places], epoch=self.epoch)
        part.__dict__ |= self.__dict__
        if self.is_padding is not None:
            part.is_padding = [self.is_padding[place] for place in places]
        return part


class WorkerShare(NamedTuple):
    """Which samples of its rank's batches one of a rank's workers decodes.

    Attributes:
        rank: The rank, from 0.
        world_size: How many ranks there are.
        worker: The worker, from 0.
        workers: How many the rank has.
        of: "streams": those of its own streams, of every batch, as `EpochOrder.workers_of` deals
            them. "batches": all of every batch in turn.
    """

    rank: int
    world_size: int
    worker: int
    workers: int
    of: Literal["streams", "batches"]

    @property
    def batches_apart(self) -> int:
        """How far the numbers of two batches lie apart that it decodes one after the other."""
        return self.world_size * (self.workers if self.of == "batches" else 1)


@dataclass(eq=False)
class Pass:
    """One pass over batches of an epoch, and how many were taken.

    Attributes:
        epoch: The epoch.
        share: The global numbers of its batches.
        start: The global batch at which all ranks began.
        end: The global batch at which the epoch ends.
        world_size: How many ranks take turns.
        taken: How many of its batches were taken.
        part: How many samples of the next one were taken, where samples are taken one by one.
        is_read_ahead: Whether "taken" counts what was given out to another `DataLoader`, whose
            workers read ahead of its loop.
        is_exhausted: Whether its loop is over: the epoch is, for ranks with fewer batches, too.
    """

    epoch: int
    share: range
    start: int
    end: int
    world_size: int
    taken: int = 0
    part: int = 0
    is_read_ahead: bool = False
    is_exhausted: bool = False

    @property
    def is_complete(self) -> bool:
        """Whether all of its batches were taken."""
        return self.taken >= len(self.share)

    @property
    def position(self) -> Position:
        """The position after the batch taken last."""
        if self.is_exhausted:
            return self.epoch, self.end
        return self.epoch, min(self.start + self.taken * self.world_size, self.end)


_numbers: Final = itertools.count(1)


class Passes:
    """The passes over a rank's batches, one after another, or one within another.

    A pass ends with its last batch, or when its loop is left. The next one is then of the next
    epoch (a loader's), or of the same until another is set (a sampler's, as torch's samplers do).
    A pass that begins while another runs is of the same epoch.

    Attributes:
        latest: The pass whose position counts: of those that run the one begun last, or else the
            one that ended last; None where none has begun since the position was set.
    """

    latest: Pass | None

    def __init__(
        self,
        epoch: SharedEpoch,
        *,
        then: Literal["same epoch", "next epoch"],
        watched: OrderRule | None = None,
    ) -> None:
        """Begin with the epoch of a dataset.

        Args:
            epoch: The dataset's. A sampler sets it, too. A loader follows it until an epoch of its
                own is set.
            then: Which epoch follows a pass.
            watched: A loader's order, if another loader of this order would repeat something.
        """
        self._dataset_epoch = epoch
        self._watched, self._number = watched, next(_numbers)
        self._then = then
        self._follows = True
        self.go_to(epoch.value, 0)

    def go_to(self, epoch: int, start: int) -> None:
        """Let the next pass begin at a global batch of an epoch; passes that run count no more."""
        self._next: Position = (epoch, start)
        self._times_set = self._dataset_epoch.times_set
        self._running: list[Pass] = []
        self.latest = None

    def set(self, epoch: int, start: int = 0) -> None:
        """Go to a position at the user's request.

        Raises:
            SelectionError: If the epoch is not a whole number from 0.
        """
        epoch = require_epoch(epoch)
        if self._then == "same epoch":
            self._dataset_epoch.set(epoch)
        else:
            self._follows = False
        self.go_to(epoch, start)

    def set_epoch(self, epoch: int) -> None:
        """Go to the beginning of an epoch; where a state was loaded, stay in its epoch.

        Raises:
            SelectionError: If it is not a whole number from 0.
        """
        is_there = self.latest is None and self.next_position[0] == epoch
        self.set(epoch, self.next_position[1] if is_there else 0)

    @property
    def next_position(self) -> Position:
        """Where the next pass begins."""
        return (self._dataset_epoch.value, 0) if self._is_behind else self._next

    @property
    def position(self) -> Position:
        """The position that a state holds."""
        is_of_pass = self.latest is not None and not self._is_behind
        return self.latest.position if self.latest and is_of_pass else self.next_position

    @property
    def _is_behind(self) -> bool:
        """Whether the dataset was set an epoch that these passes have not followed."""
        return self._follows and self._times_set != self._dataset_epoch.times_set

    def begin(self, begun: Pass) -> None:
        """Record that a pass begins."""
        if self._is_behind:
            self.go_to(begun.epoch, 0)
        if self._watched and self._is_of_dataset(begun):
            self._dataset_epoch.mark_begun(self._watched, loader=self._number)
        self._next = begun.epoch, 0
        self._running.append(begun)
        self.latest = begun

    def end(self, ended: Pass) -> None:
        """Record that a pass is over, whole or not."""
        if ended not in self._running:
            return
        self._running.remove(ended)
        if self._watched and self._is_of_dataset(ended) and ended.taken > 1:  # no mere look
            self._dataset_epoch.mark_ended(self._watched, loader=self._number)
        if self._running:
            self.latest = self._running[-1]
        elif self._then == "next epoch":
            self._next = ended.epoch + 1, 0

    def _is_of_dataset(self, each: Pass) -> bool:
        """Whether a pass is of the whole epoch that the dataset is at."""
        return self._follows and (each.epoch, each.start) == (self._dataset_epoch.value, 0)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy needs: none of these passes is its own."""
        return self.__dict__ | {"_running": [], "latest": None}


class GlobalBatches:
    """The batches of all ranks, by their numbers.

    A dataset keeps them to read ahead. They do not know it: else it would refer to itself, and its
    videos would stay open after the last reference to it.
    """

    def __init__(self, rule: OrderRule, runs: Runs, *, is_padded: bool) -> None:
        """Take what the order depends on, and whether the last batches are filled up."""
        self.rule, self.runs, self.is_padded = rule, runs, is_padded
        self._order: EpochOrder | None = None

    def order(self, epoch: int) -> EpochOrder:
        """Return the order of an epoch; the last one is kept."""
        if self._order is None or self._order.epoch != epoch:
            self._order = EpochOrder(self.runs, self.rule, epoch=epoch)
        return self._order

    def batch(self, number: int, *, epoch: int) -> EpochBatch:
        """Return the samples of a batch."""
        order, size = self.order(epoch), self.rule.batch_size
        samples, ends_of_runs = np.empty(0, dtype=np.int64), list[int]()
        if number < order.batches:
            samples, ends_run, _ = order.described(number)
            ends_of_runs = samples[ends_run].tolist()
        batch = EpochBatch(
            (order.full_batch(number) if self.is_padded else samples).tolist(),
            epoch=epoch,
            ends_of_runs=ends_of_runs,
            number=number,
            group=number % order.groups,
        )
        batch.open_runs = order.streams(batch.group)
        batch.open_frames = self.rule.open_frames
        if self.is_padded:
            places = range(number * size, (number + 1) * size)
            batch.is_padding = [place >= order.samples for place in places]
        return batch

    def workers_of(self, batch: EpochBatch, share: WorkerShare) -> Numbers:
        """Return which of a rank's workers decodes each sample of one of its batches."""
        if batch.number is None or share.of == "batches":
            turn = (batch.number or 0) // share.world_size
            return np.full(len(batch), turn % share.workers)
        workers: Numbers = np.arange(len(batch)) % share.workers  # of what fills up the epoch
        order = self.order(batch.epoch)
        if batch.number < order.batches:
            groups = groups_of_rank(order.groups, share.rank, share.world_size)
            own = order.workers_of(batch.number, groups=groups, workers=share.workers)
            workers[: len(own)] = own
        return workers

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy in another process needs; it computes the order itself."""
        return self.__dict__ | {"_order": None}


def groups_of_rank(groups: int, rank: int, world_size: int) -> range:
    """Return the shuffle groups that a rank's batches are of."""
    apart = math.gcd(groups, world_size)
    return range(rank % apart, groups, apart)


class OrderedSamples(Protocol):
    """What `EpochBatches` asks of a dataset: its samples by number, and the epoch that it is at."""

    plan: Plan
    index: SceneIndex
    shared_epoch: SharedEpoch


class EpochBatches(Sampler[list[int]]):
    """A batch sampler: the samples of each batch of an epoch, for one rank.

    Its passes are of the same epoch until `set_epoch` is called, as with torch's samplers; each
    pass of a ``loader(...)`` is of the next epoch. The order depends only on the selection, the
    seed, the epoch, the batch size, the shuffle groups and the open scenes: never on workers, nor
    on ranks that divide the groups. Rank r gets the global batches n with n mod world_size = r.
    torchdata's ``StatefulDataLoader`` can save and load its
    position. torch's own `DataLoader` reads ahead: use the dataset's ``loader(...)``, which counts
    what the training loop has taken.

    >>> from stereogenbench_data import EpochBatches, StereoPairs
    >>> pairs = StereoPairs(getfixture("small_release"), frames="all")
    >>> shares = [EpochBatches(pairs, 4, rank=r, world_size=2, drop_last=False) for r in (0, 1)]
    >>> [len(share) for share in shares]
    [4, 3]
    >>> sorted(sum([*shares[0], *shares[1]], [])) == list(range(28))
    True

    Attributes:
        dataset: The samples.
        rule: What the order depends on.
        rank: Whose batches these are.
        world_size: How many ranks there are.
        drop_last: Whether what does not fill a batch of every rank is dropped.
        is_padded: Whether samples from the epoch's start fill up the last batches.
        of_all_ranks: The batches of all ranks, by their global numbers.
        passes: Where its passes are: the position.
    """

    def __init__(
        self,
        dataset: OrderedSamples,
        batch_size: int,
        **options: Unpack[EpochOptions],
    ) -> None:
        """Order the samples of a dataset; nothing is computed before the first batch.

        Args:
            dataset: Such as `StereoPairs`; its epoch is the epoch of the batches, and of all
                others made for the same dataset object. A ``loader(...)`` has its own.
            batch_size: Samples in a batch of one rank.
            **options: See `EpochOptions`.

        Raises:
            SelectionError: If an option is out of its range, or every batch would be dropped.
        """
        require_options(EpochBatches, options)
        if isinstance(dataset, Sampler):
            # So Lightning makes batches again. To predict, it takes the sampler of our loader.
            batches = getattr(dataset, "batches", None)
            if not isinstance(batches, EpochBatches):
                raise SelectionError(
                    f"EpochBatches orders a dataset such as StereoPairs by itself, and cannot take "
                    f"its order from a {type(dataset).__name__}. Lightning's overfit_batches puts "
                    "one in: use limit_train_batches=... (or overfit_batches) with "
                    "pairs.loader(..., shuffle=False)."
                )
            self.__setstate__(batches.__dict__)
            return
        self.dataset = dataset
        plan, self._options = dataset.plan, options
        self.rank, self.world_size = _require_group(options.get("rank"), options.get("world_size"))
        self.rule = fitting_rule(
            dataset.index, plan, batch_size, options, world_size=self.world_size
        )
        self._drop_last = options.get("drop_last", self.rule.shuffle)
        self.drop_last, self.is_padded = self._drop_last is True, self._drop_last == "pad"
        self._follows_the_group = "rank" not in options
        self.of_all_ranks = GlobalBatches(self.rule, plan.runs, is_padded=self.is_padded)
        self.passes = Passes(dataset.shared_epoch, then="same epoch")
        if self.end() == 0:
            raise SelectionError(
                f"drop_last=True drops all of {len(plan)} samples: they fill no batch of "
                f"{batch_size} for each of {self.world_size} ranks. Take a smaller batch_size, "
                "drop_last='pad' or drop_last=False."
            )

    @property
    def batch_size(self) -> int:
        """How many samples a full batch of one rank has."""
        return self.rule.batch_size

    @property
    def samples_of_epoch(self) -> int:
        """How many samples an epoch has, of all ranks."""
        return len(self.dataset.plan)

    @property
    def left_out(self) -> int:
        """How many samples of an epoch no rank gets: none without ``drop_last``."""
        return max(0, len(self.dataset.plan) - self.end() * self.rule.batch_size)

    def __len__(self) -> int:
        """The number of this rank's batches in a whole epoch."""
        return len(self.share(0))

    def __repr__(self) -> str:
        """Return a summary."""
        order = f"seed {self.rule.seed}" if self.rule.shuffle else "not shuffled"
        return (
            f"<{type(self).__name__}: {self.rule.batch_size} of {self.samples_of_epoch} samples a "
            f"batch, rank {self.rank} of {self.world_size}, {order}, "
            f"drop_last={self._drop_last!r}>"
        )

    def __iter__(self) -> Iterator[list[int]]:
        """Return this rank's batches of the current epoch, or what a loaded state left of it.

        The pass begins with its first batch.

        Raises:
            SelectionError: If Accelerate would share these batches among ranks a second time.
        """
        self.require_shared_once(self)
        following = self.next_pass()
        if following.is_complete:
            # torchdata's loader asks for no batch of a pass that it saved at its end.
            self.passes.begin(following)
            self.passes.end(following)
            return iter(())
        return self._batches_of_a_pass()

    def _batches_of_a_pass(self) -> Iterator[list[int]]:
        begun = self.next_pass()
        begun.is_read_ahead = True
        self.passes.begin(begun)
        try:
            for number in begun.share:
                begun.taken += 1
                if begun.is_complete:
                    self.passes.end(begun)
                yield self.of_all_ranks.batch(number, epoch=begun.epoch)
            begun.is_exhausted = True
        finally:
            self.passes.end(begun)

    def next_pass(self) -> Pass:
        """Return the pass that begins at the next position; it begins with its first batch."""
        return self.pass_from(*self.passes.next_position)

    def pass_from(self, epoch: int, start: int) -> Pass:
        """Return a pass over this rank's batches of an epoch from a global batch on."""
        return Pass(epoch, self.share(start), start, self.end(start), self.world_size)

    def set_epoch(self, epoch: int) -> None:
        """Go to another epoch, which begins at its beginning; the dataset goes with it.

        With the epoch of a state just loaded it changes nothing.

        Raises:
            SelectionError: If it is not a whole number from 0.
        """
        self.passes.set_epoch(epoch)

    def state_dict(self) -> State:
        """Return the position after the last batch that was given out."""
        return self.state_at(*self.passes.position)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go to a saved position: the next pass begins there, all later ones at the beginning.

        Raises:
            StateError: If it belongs to other samples or another order, naming what differs.
        """
        self.passes.set(*self.position_in(state))

    def end(self, start: int = 0) -> int:
        """Return the global number at which an epoch ends for ranks that go on from ``start``."""
        return last_batch(
            len(self.dataset.plan),
            batch_size=self.rule.batch_size,
            drop_last=self._drop_last,
            world_size=self.world_size,
            start=start,
        )

    def share(self, start: int) -> range:
        """Return the global numbers of this rank's batches from ``start`` on.

        Raises:
            SelectionError: If torch.distributed was initialised after these batches were made.
        """
        group = _group()
        if group is not None:
            self.require_group(*group)
        return rank_share(start, self.end(start), rank=self.rank, world_size=self.world_size)

    def require_group(self, rank: int, world_size: int) -> None:
        """Require that the batches were made for this rank and world, unless the user chose others.

        Raises:
            SelectionError: If they were made for another one before the processes were known.
        """
        if self._follows_the_group and (rank, world_size) != (self.rank, self.world_size):
            raise SelectionError(
                f"these batches were made for rank {self.rank} of {self.world_size}, and this "
                f"process is rank {rank} of {world_size} now. Make them after init_process_group "
                "(Accelerate: after Accelerator(); Lightning: in train_dataloader() of a module or "
                "data module), or give rank= and world_size=."
            )

    def require_shared_once(self, data: object) -> None:
        """Require that Accelerate does not divide these batches among processes a second time.

        Args:
            data: What it would divide: these batches, or a stream of their samples.

        Raises:
            SelectionError: If it does.
        """
        states = sys.modules.get("accelerate.state")
        if self.world_size == 1 or states is None:
            return
        active = states.GradientState().active_dataloader
        if active is None or isinstance(getattr(active, "batches", None), EpochBatches):
            return
        dataset = getattr(active, "dataset", None)
        sampler = getattr(active, "batch_sampler", None)
        wrapped = [getattr(dataset, "dataset", None), getattr(sampler, "batch_sampler", None)]
        if hasattr(active, "slice_fn"):
            # Process 0 alone reads for all.
            wrapped += [dataset, sampler]
        if any(each is data for each in wrapped):
            raise SelectionError(
                f"Accelerate shares these batches among {states.PartialState().num_processes} "
                f"processes, and this {type(data).__name__} gives rank {self.rank} of "
                f"{self.world_size} its share already: samples would be lost. Prepare "
                "pairs.loader(...) instead, which shares once and keeps its position, or do not "
                "prepare this loader."
            )

    def state_at(self, epoch: int, batches: int) -> State:
        """Return the state after a number of global batches of an epoch.

        After the last one that these ranks take, all are consumed: other ranks, for whom the epoch
        would end later, begin the next one.
        """
        return {
            "version": ORDER_VERSION,
            "epoch": epoch,
            "batches_consumed": self.batches_of_all if batches >= self.end() else batches,
            **self._identity(self.rule),
        }

    def position_in(self, state: Mapping[str, Any]) -> Position:
        """Return the epoch and the number of global batches that a state says are consumed.

        The shuffle groups are those of the state from now on, unless some were asked for.

        Raises:
            StateError: If it belongs to other samples or another order, naming what differs.
        """
        if not isinstance(state, Mapping):
            raise StateError(
                f"a state is a dict as state_dict() returns it, got {state!r:.60}: {_STATES}"
            )
        rule = self._rule_of(state)
        own = {"version": ORDER_VERSION, **self._identity(rule)}
        version = state.get("version", ORDER_VERSION)
        if type(version) is not int or version != ORDER_VERSION:
            raise StateError(
                f"the state is of version {version!r} of the order, and this release has version "
                f"{ORDER_VERSION}: the same seed gives other batches. Begin its epoch anew, "
                "set_epoch(epoch) without the state, or go on with the release that saved it."
            )
        missing = sorted({*own, "epoch", "batches_consumed"} - state.keys())
        if missing:
            raise StateError(
                f"the state has no {', '.join(missing)} (it has {', '.join(map(str, state))}). "
                f"{_STATES}"
            )
        differing = [
            f"{name} is {value!r} here and {state[name]!r} there"
            for name, value in own.items()
            if name not in _DIGESTS
            and (type(state[name]) is not type(value) or state[name] != value)
        ]
        if not differing:
            differing = [why for name, why in _DIGESTS.items() if state[name] != own[name]]
        if differing:
            raise StateError(
                f"the state was saved for other batches: {'; '.join(differing)}. Open the same "
                "data with the same selection and options, or begin the epoch anew without it."
            )
        position = (
            require_count(state, "epoch"),
            require_count(state, "batches_consumed", most=self.batches_of_all),
        )
        if rule != self.rule:
            self.rule = rule
            self.of_all_ranks = GlobalBatches(
                rule, self.dataset.plan.runs, is_padded=self.is_padded
            )
        return position

    def _rule_of(self, state: Mapping[str, Any]) -> OrderRule:
        """Return the rule with a state's shuffle groups, unless some were asked for."""
        groups = state.get("shuffle_groups")
        if "shuffle_groups" in self._options or type(groups) is not int or groups < 1:
            return self.rule
        if groups == self._identity(self.rule)["shuffle_groups"]:
            return self.rule
        options = EpochOptions(**{**self._options, "shuffle_groups": groups})
        dataset, size = self.dataset, self.rule.batch_size
        return fitting_rule(dataset.index, dataset.plan, size, options, world_size=self.world_size)

    @property
    def batches_of_all(self) -> int:
        """How many batches hold all samples of an epoch, those of all ranks."""
        return -(-len(self.dataset.plan) // self.rule.batch_size)

    def _identity(self, rule: OrderRule) -> State:
        """Return what must be the same when a state is saved and when it is loaded."""
        plan, index = self.dataset.plan, self.dataset.index
        rule = rule.in_effect(plan.runs)
        return {
            "seed": rule.seed,
            "batch_size": rule.batch_size,
            "shuffle_groups": rule.shuffle_groups,
            "open_scenes": rule.open_scenes,
            "open_frames": rule.open_frames,
            "shuffle": rule.shuffle,
            "drop_last": self._drop_last,
            "scenes": len(plan.scene_rows),
            "samples": len(plan),
            "selection": plan.digest,
            "index": index.digest,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Become a copy, with passes of its own."""
        self.__dict__.update(state)
        self.passes = copy.copy(self.passes)


def require_count(state: Mapping[str, Any], name: str, *, most: int | None = None) -> int:
    """Return a whole number from 0 of a state.

    Raises:
        StateError: If it is not a whole number, or more than there can be.
    """
    value = state.get(name)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise StateError(f"the state's {name} is {value!r}, no whole number from 0. {_STATES}")
    if most is not None and value > most:
        raise StateError(f"the state's {name} is {value}, and there are {most}. {_STATES}")
    return value


def _group() -> tuple[int, int] | None:
    """Return rank and world size as torch.distributed says, None where it is not initialised."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return None


class UnsharedRanksWarning(UserWarning):
    """Several ranks were started, and nothing tells their numbers, so each gets all batches."""


def _require_group(rank: int | None, world_size: int | None) -> tuple[int, int]:
    """Return rank and world size, given or as torch.distributed says."""
    if rank is None and world_size is None:
        group, ranks = _group(), os.environ.get("WORLD_SIZE", "")
        if group is None and ranks.isdecimal() and int(ranks) > 1 and get_worker_info() is None:
            warnings.warn(
                f"WORLD_SIZE says that {ranks} ranks were started, and there is no process group, "
                f"so each of them reads all batches. Make loaders after init_process_group, or "
                f"give rank= and world_size=; rank=0, world_size=1 reads all without a word.",
                UnsharedRanksWarning,
                stacklevel=4,
            )
        return group or (0, 1)
    numbers = whole_number(rank), whole_number(world_size)
    if numbers[0] is None or numbers[1] is None or not 0 <= numbers[0] < numbers[1]:
        raise SelectionError(
            f"rank must be a number from 0 below world_size, and both be given: got rank={rank!r}, "
            f"world_size={world_size!r}."
        )
    return numbers[0], numbers[1]


SPARE_FILES = 128
"""Open files that are left to everything else."""

RANK_BYTES: Final = 3_600_000_000
"""Memory for the open scenes of a rank, where nobody asks for a number of them."""

_DECODER_BYTES: Final = 17
"""Of a camera's decoders for each pixel: 12.6 of H.264 with its reference pictures, 4.3 of FFV1,
measured at 1280x1280."""

_KEPT_BYTES: Final = 4
"""Of the current picture and what is measured in it, kept for each pixel for other pairs."""

FRAMES_BYTES: Final = 2_000_000_000
"""Memory for further frames of a rank's open scenes, where several samples show one."""

_FRAME_BYTES: Final = 6
"""Of a further frame for each pixel: the picture, stored depth and where it is measured."""


class OpenVideosWarning(UserWarning):
    """More videos are needed at a time than this process may open: some are opened repeatedly."""


class RepeatedDecodingWarning(UserWarning):
    """Several processes read the same shuffle group, so each of them decodes its videos."""


class IdleWorkersWarning(UserWarning):
    """A loader has more workers than open scenes, so some have nothing to do."""


def warn_of_division(batches: EpochBatches, share: WorkerShare, *, videos_per_scene: int) -> None:
    """Warn where processes decode the same videos, have nothing to do, or may not open enough.

    Args:
        batches: The batches of a rank.
        share: How they are divided among its workers.
        videos_per_scene: How many videos of an open scene are read.
    """
    if not (batches.rule.shuffle and videos_per_scene):
        return
    order = batches.of_all_ranks.order(0)
    readers = share.world_size * (share.workers if share.of == "batches" else 1)
    groups = groups_of_rank(order.groups, share.rank, readers)
    open_scenes = sum(map(order.streams, groups))
    together, scenes = readers // math.gcd(order.groups, readers), len(order.runs.pairs)
    cure = "Use fewer ranks or a smaller batch_size: ranks times batch at most the scenes."
    is_avoidable = True
    if share.of == "batches":
        cure = "Use pairs.loader(...), whose workers share the videos out, or shuffle_groups="
        cure += f"{readers}, which is another order."
        is_avoidable = readers * batches.batch_size <= scenes
    if together > 1 and is_avoidable and order.runs.lengths.max() > 1:
        warnings.warn(
            f"every video is decoded {together} times, as {readers} processes read {order.groups} "
            f"shuffle groups of {scenes} runs of frames. {cure}",
            RepeatedDecodingWarning,
            stacklevel=users_level(),
        )
    if share.of == "streams":
        if share.workers > open_scenes:
            warnings.warn(
                f"{share.workers - open_scenes} of {share.workers} workers have nothing to do: a "
                f"rank has {open_scenes} scenes open at a time, and one worker decodes a scene. "
                f"Use num_workers={open_scenes}, or open_scenes="
                f"{-(-share.workers // len(groups))} where there are as many scenes.",
                IdleWorkersWarning,
                stacklevel=users_level(),
            )
        open_scenes = -(-open_scenes // share.workers)
    wanted, allowed = open_scenes * videos_per_scene, videos_allowed()
    if wanted > allowed:
        warnings.warn(
            f"up to {wanted} videos would be open at a time, and this process may open {allowed}: "
            "they will be closed and opened again, which is slow. Raise the limit (`ulimit -n "
            f"{wanted + SPARE_FILES}`), use more workers, or fewer open_scenes than "
            f"{batches.rule.open_scenes}.",
            OpenVideosWarning,
            stacklevel=users_level(),
        )


def videos_allowed() -> int:
    """Return how many videos this process may have open."""
    return max(OPEN_STREAMS, _most_files() - SPARE_FILES)


def fitting_rule(
    index: SceneIndex, plan: Plan, batch_size: int, options: EpochOptions, *, world_size: int
) -> OrderRule:
    """Return a rule with as many open scenes and frames as fit into the memory of a rank.

    They depend on the selected pairs and the stored size of their pictures alone, not on fields or
    workers, and on ranks only in that they share the groups out. What a user asks for counts
    instead.

    Raises:
        SelectionError: If an option is out of its range.
    """
    rule = OrderRule(
        batch_size, seed=options.get("seed", plan.seed), shuffle=options.get("shuffle", True)
    )
    rows, runs = plan.scene_rows, plan.runs
    shares_moments = bool((runs.pairs > 1).any())
    pixels = (index.column("image_width_px")[rows] * index.column("image_height_px")[rows]).max()
    of_cameras = int(pixels) * videos_per_scene(plan, frozenset({"source_rgb", "target_rgb"}))
    # About what the decoders of an open scene take, at the most.
    scene_bytes = of_cameras * (_DECODER_BYTES + (_KEPT_BYTES if shares_moments else 0))
    size, fitting = rule.batch_size, max(2, RANK_BYTES // max(1, scene_bytes))
    usual = groups_for(runs, batch_size=size, fitting=fitting, world_size=world_size)
    rule = replace(
        rule,
        shuffle_groups=options.get("shuffle_groups", usual),
        open_scenes=options.get("open_scenes", size),
    )
    groups = rule.groups_of(runs.lengths)
    if "open_scenes" not in options:
        wanted = open_runs_for(runs, batch_size=size, fitting=fitting, groups=groups)
        rule = replace(rule, open_scenes=wanted)
    frames = 1
    if shares_moments:
        of_rank = min(groups, usual_groups(batch_size=size, fitting=fitting))
        further = FRAMES_BYTES // max(1, of_rank * rule.open_scenes * of_cameras * _FRAME_BYTES)
        frames = max(1, min(1 + further, -(-size // rule.open_scenes)))
    return replace(rule, open_frames=options.get("open_frames", frames))


def _most_files() -> int:
    """Return how many files this process may open; 512 where the system does not say."""
    try:
        import resource
    except ImportError:
        return 512
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]


def videos_per_scene(plan: Plan, streams: frozenset[Stream]) -> int:
    """Return how many videos the samples of one scene are made from, at the most."""
    pairs = plan.pairs
    scene = np.repeat(np.arange(len(plan.scene_rows)), np.diff(plan.first_pair))
    used = np.zeros((len(plan.scene_rows), 2, CAMERA_COUNT), dtype=bool)
    for kind, suffix in enumerate(("rgb", "depth")):
        if f"source_{suffix}" in streams:
            used[scene, kind, pairs.source] = True
        if f"target_{suffix}" in streams:
            for targets in pairs.targets.T:
                there = targets >= 0
                used[scene[there], kind, targets[there]] = True
    return int(used.sum(axis=(1, 2)).max())
