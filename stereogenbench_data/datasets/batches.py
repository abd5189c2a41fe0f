"""The batches of an epoch for one rank, as a torch sampler; passes over them, and their position.

A position is an epoch and how many of its batches are consumed, counted over all ranks. Each `Pass`
counts what was taken of it. `Passes` says where the next one begins and which one a state is of.
"""

import copy
import itertools
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol, Unpack

import numpy as np
from torch.utils.data import Sampler

from stereogenbench_data.datasets.division import (
    WorkerShare,
    require_group,
    torchs_group,
)
from stereogenbench_data.datasets.epoch_rule import EPOCH_DEFAULTS, EpochOptions, fitting_rule
from stereogenbench_data.datasets.shared import SharedEpoch
from stereogenbench_data.errors import SelectionError, StateError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.selection.filters import require_whole, whole_number
from stereogenbench_data.selection.options import require_options
from stereogenbench_data.selection.order import (
    ORDER_VERSION,
    EpochOrder,
    Numbers,
    OrderRule,
    Runs,
    last_batch,
    rank_share,
)
from stereogenbench_data.selection.plan import Plan
from stereogenbench_data.selection.signatures import list_options

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


class EpochBatch(list[int]):
    """The numbers of a batch's samples, with the epoch that they are drawn for.

    Attributes:
        epoch: The epoch, of random frames and transforms, too; that of the dataset does not matter.
        is_padding: For each sample whether it fills up after the epoch's end; None where no sample
            ever does (without ``drop_last="pad"``).
        ends_of_runs: The samples after which their videos are wanted no more for now.
        number: Its number among the batches of all ranks; None for a batch outside of an epoch.
        group: The shuffle group that it is of.
        open_runs: How many runs who reads it has open at a time, at the most.
        open_frames: How many frames of each are kept.
    """

    is_padding: list[bool] | None = None
    ends_of_runs: Collection[int] = ()
    number: int | None = None
    group = 0
    open_runs = 0
    open_frames = 1

    def __init__(self, numbers: Iterable[int], *, epoch: int) -> None:
        """Hold the numbers of a batch outside of an epoch's order."""
        super().__init__(numbers)
        self.epoch = epoch

    def at(self, places: Sequence[int]) -> "EpochBatch":
        """Return the samples at some of its places as a batch."""
        part = EpochBatch([self[place] for place in places], epoch=self.epoch)
        part.__dict__ |= self.__dict__
        if self.is_padding is not None:
            part.is_padding = [self.is_padding[place] for place in places]
        return part


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
        epoch = require_whole("epoch", epoch, least=0)
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
        return (self._dataset_epoch.value, 0) if self._dataset_epoch_changed else self._next

    @property
    def position(self) -> Position:
        """The position that a state holds."""
        is_of_pass = self.latest is not None and not self._dataset_epoch_changed
        return self.latest.position if self.latest and is_of_pass else self.next_position

    @property
    def _dataset_epoch_changed(self) -> bool:
        """Whether the dataset was set an epoch that these passes have not followed."""
        return self._follows and self._times_set != self._dataset_epoch.times_set

    def begin(self, begun: Pass) -> None:
        """Record that a pass begins."""
        if self._dataset_epoch_changed:
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
        samples = order.full_batch(number) if self.is_padded else order.batch(number)
        batch = EpochBatch(samples.tolist(), epoch=epoch)
        batch.number, batch.group = number, number % order.groups
        batch.open_runs, batch.open_frames = order.open_runs(), self.rule.open_frames
        if number < order.batches:
            found = order.described(number)
            batch.ends_of_runs = found.samples[found.ends_run].tolist()
        if self.is_padded:
            places = range(number * size, (number + 1) * size)
            batch.is_padding = [place >= order.samples for place in places]
        return batch

    def workers_of(self, batch: EpochBatch, share: WorkerShare) -> Numbers:
        """Return which of a rank's workers decodes each sample of one of its batches."""
        number = batch.number or 0
        if share.of == "batches":
            return np.full(len(batch), number // share.world_size % share.workers)
        workers: Numbers = np.arange(len(batch)) % share.workers  # of what fills up the epoch
        order = self.order(batch.epoch)
        if number < order.batches:
            groups = share.groups(order)
            own = order.workers_of(number, groups=groups, workers=share.workers)
            workers[: len(own)] = own
        return workers

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy in another process needs; it computes the order itself."""
        return self.__dict__ | {"_order": None}


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

    @list_options(EPOCH_DEFAULTS)
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
        self.rank, self.world_size = require_group(options.get("rank"), options.get("world_size"))
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
        group = torchs_group()
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
            name
            for name, value in own.items()
            if type(state[name]) is not type(value) or state[name] != value
        ]
        if differing:
            told = [
                f"{name} is {own[name]!r} here and {state[name]!r} there"
                for name in differing
                if name not in _DIGESTS
            ] or [_DIGESTS[name] for name in differing]
            raise StateError(
                f"the state was saved for other batches: {'; '.join(told)}. Open the same "
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
    if not isinstance(value, int) or whole_number(value) is None or value < 0:
        raise StateError(f"the state's {name} is {value!r}, no whole number from 0. {_STATES}")
    if most is not None and value > most:
        raise StateError(f"the state's {name} is {value}, and there are {most}. {_STATES}")
    return value
