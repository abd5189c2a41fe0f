"""The order of an epoch: which samples make up batch n, as arithmetic on integers.

The order is a pure function of the selection's scenes and samples, the seed, the epoch, the batch
size, the shuffle groups and the open scenes; ranks and workers are not in it. A permutation of the
scenes, laid end to end, is cut into shuffle groups of equally many samples; group g gives the
batches n with n mod groups = g. A group deals its scenes to as many streams as it keeps scenes
open, and interleaves the streams so that each advances evenly, at a pace of its own, to the group's
end. Within a scene samples ascend: a process that gets every batch of a group opens each video once
and reads it forwards once. A cut between groups may part a scene: groups - 1 scenes at the most.

Random numbers are the raw stream of PCG64, which numpy keeps the same for ever.
"""

import heapq
from dataclasses import dataclass, replace
from typing import Final, Literal, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64, UInt64

from stereogenbench_data.errors import SelectionError

ORDER_VERSION: Final = 2
"""Changes whenever the same arguments give another order; a saved state names it."""

SHUFFLE_GROUPS: Final = 4
GROUPS_OF_LARGE: Final = 2
"""Where scenes are so large that memory limits how many are open: two workers have one each."""

OPEN_SCENES: Final = 16
"""Fewer open scenes than this make batches of small size too much alike."""

DRIFT: Final = 0.1
"""How far a stream's pace may differ from the mean, so that streams do not run in step."""

_TAG: Final = 0x0D3B

OrderKind = Literal["shuffled", "sequential"]
Tail = Literal["drop", "wrap", "uneven"]
Numbers = Int64[np.ndarray, " n"]


@dataclass(frozen=True, slots=True)
class OrderRule:
    """What an order depends on, apart from the selection and the epoch.

    Attributes:
        batch_size: Samples in a batch.
        seed: The seed of the order.
        shuffle_groups: Into how many groups the scenes are parted; fewer where a group would have
            fewer scenes than a batch can show.
        open_scenes: How many scenes a group interleaves. Fewer than `OPEN_SCENES` are never
            exceeded. From there on there may be more, up to twice as many where a group has fewer
            than twice as many, so that its streams are equally long and batches equally mixed.
        kind: "shuffled", or "sequential": by the samples' numbers.
    """

    batch_size: int
    seed: int = 0
    shuffle_groups: int = SHUFFLE_GROUPS
    open_scenes: int = OPEN_SCENES
    kind: OrderKind = "shuffled"

    def __post_init__(self) -> None:
        """Require numbers in their ranges and a known kind."""
        options = {"batch_size": 1, "seed": 0, "shuffle_groups": 1, "open_scenes": 1}
        for name, least in options.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise SelectionError(f"{name} must be a whole number from {least}, got {value!r}.")
        if self.kind not in ("shuffled", "sequential"):
            raise SelectionError(f"order must be 'shuffled' or 'sequential', got {self.kind!r}.")

    def groups_of(self, lengths: Numbers) -> int:
        """Return into how many groups scenes of so many samples are parted.

        So few that the longest scene need not come twice in a batch, but two at least, of two
        scenes each, so that two processes need not decode the same; and a divisor of
        ``shuffle_groups``, so that processes that share those out share these too.
        """
        if self.kind == "sequential":
            return 1
        as_long_as_the_longest = round(int(lengths.sum()) / int(lengths.max()))
        shown = min(self.batch_size, self.open_scenes)
        at_least = 2 if as_long_as_the_longest >= 4 else 1
        most = min(self.shuffle_groups, max(at_least, as_long_as_the_longest // shown))
        return max(count for count in range(1, most + 1) if self.shuffle_groups % count == 0)

    def in_effect(self, lengths: Numbers) -> "OrderRule":
        """Return what the order of scenes of so many samples depends on: equal for equal orders.

        Few scenes have fewer groups and open scenes than requested; a sequential
        order depends on the batch size alone.
        """
        if self.kind == "sequential":
            return OrderRule(self.batch_size, shuffle_groups=1, open_scenes=1, kind="sequential")
        most = self._most_scenes(lengths)
        all_are_open = self.streams_of(most) == most
        return replace(
            self,
            shuffle_groups=self.groups_of(lengths),
            open_scenes=len(lengths) if all_are_open else self.open_scenes,
        )

    def streams_of(self, scenes: int) -> int:
        """Return how many of a group's scenes are open at a time: one in each stream."""
        if self.open_scenes < OPEN_SCENES:
            return min(scenes, self.open_scenes)
        return -(-scenes // max(1, scenes // self.open_scenes))

    def most_open(self, lengths: Numbers) -> int:
        """Return a bound on the scenes that one group of a selection has open at a time."""
        most = self._most_scenes(lengths)
        if self.open_scenes < OPEN_SCENES:
            return self.streams_of(most)
        in_turn = max(1, most // self.open_scenes // 2)
        return min(most, self.open_scenes + self.open_scenes // in_turn)

    def _most_scenes(self, lengths: Numbers) -> int:
        """Return a bound on the scenes of a group: the shortest ones, and parts of two others."""
        samples = int(lengths.sum())
        batches_of_all = -(-samples // self.batch_size)
        turns = -(-batches_of_all // self.groups_of(lengths))
        longest_group = min(samples, turns * self.batch_size)
        whole = int((np.cumsum(np.sort(lengths)) <= longest_group - 2).sum())
        return min(len(lengths), whole + 2)


class EpochOrder:
    """The batches of one epoch by their number; a group is ordered when first asked for.

    Attributes:
        samples: How many samples the epoch has.
        batches: How many batches it has, the last of which may be short.
        groups: How many shuffle groups it has.
    """

    def __init__(self, first_sample: Int64[np.ndarray, " s1"], rule: OrderRule, *, epoch: int):
        """Take the number of each scene's first sample, with that of all samples at the end."""
        self.rule = rule
        self.epoch = epoch
        self.samples = int(first_sample[-1])
        self.batches = -(-self.samples // rule.batch_size)
        self.groups = rule.groups_of(np.diff(first_sample))
        self._first_sample = first_sample
        self._groups: dict[int, Numbers] = {}

    def batch(self, number: int) -> Numbers:
        """Return the samples of a batch, in its order.

        Raises:
            IndexError: If there is no such batch.
        """
        if not 0 <= number < self.batches:
            raise IndexError(f"no batch {number}: the epoch has {self.batches}")
        size = self.rule.batch_size
        if self.rule.kind == "sequential":
            return np.arange(number * size, min(self.samples, (number + 1) * size))
        turn, group = divmod(number, self.groups)
        return self.group(group)[turn * size : (turn + 1) * size]

    def full_batch(self, number: int) -> Numbers:
        """Return a batch that is never short: after the last sample the epoch starts again."""
        size = self.rule.batch_size
        own = self.batch(number) if number < self.batches else np.empty(0, dtype=np.int64)
        places = (np.arange(number * size + len(own), (number + 1) * size)) % self.samples
        again = [self.batch(place // size)[place % size] for place in places.tolist()]
        return np.concatenate([own, np.array(again, dtype=np.int64)])

    def group(self, group: int) -> Numbers:
        """Return all samples of a shuffle group, in its order."""
        if group not in self._groups:
            self._groups[group] = self._ordered(group)
        return self._groups[group]

    def scenes_of(self, numbers: Int64[np.ndarray, "*n"]) -> Int64[np.ndarray, "*n"]:
        """Return the place of each sample's scene in the selection."""
        scenes: Int64[np.ndarray, "*n"] = (
            np.searchsorted(self._first_sample, numbers, side="right") - 1
        )
        return scenes

    def _ordered(self, group: int) -> Numbers:
        begins, lengths = self._pieces(group)
        if len(lengths) == 0:
            return np.empty(0, dtype=np.int64)
        count = self.rule.streams_of(len(lengths))
        stream = _assign(lengths, streams=count)
        draws = _uniform(self._raw(2 * count, part=group + 1))
        numbers, times = [], []
        for number, (phase, pace) in enumerate(zip(draws[:count], draws[count:], strict=True)):
            pieces = np.flatnonzero(stream == number)
            found = _runs(begins[pieces], lengths[pieces])
            place = (np.arange(len(found)) + phase) / len(found)
            numbers.append(found)
            times.append(place + DRIFT * (2 * pace - 1) * place * (1 - place))
        merged = np.argsort(np.concatenate(times), kind="stable")
        ordered: Numbers = np.concatenate(numbers)[merged]
        return ordered

    def _pieces(self, group: int) -> tuple[Numbers, Numbers]:
        """Return first sample and length of each scene, or part of one, of a group."""
        cuts = np.concatenate([[0], np.cumsum(self._group_sizes())])
        low, high = int(cuts[group]), int(cuts[group + 1])
        scenes = np.argsort(self._raw(len(self._first_sample) - 1, part=0), kind="stable")
        lengths = np.diff(self._first_sample)[scenes]
        ends = np.cumsum(lengths)
        starts = ends - lengths
        inside = (ends > low) & (starts < high)
        skipped = np.maximum(low - starts[inside], 0)
        taken = np.minimum(ends[inside], high) - np.maximum(starts[inside], low)
        return self._first_sample[scenes[inside]] + skipped, taken

    def _group_sizes(self) -> Numbers:
        """Return how many samples each group has: whole batches, but for the epoch's last."""
        size = self.rule.batch_size
        turns = (self.batches - np.arange(self.groups) + self.groups - 1) // self.groups
        sizes: Numbers = turns * size
        sizes[(self.batches - 1) % self.groups] -= self.batches * size - self.samples
        return sizes

    def _raw(self, count: int, *, part: int) -> UInt64[np.ndarray, " n"]:
        entropy = (self.rule.seed, self.epoch, _TAG, part + 1)
        raw: UInt64[np.ndarray, " n"] = np.random.PCG64(np.random.SeedSequence(entropy)).random_raw(
            count
        )
        return raw


def last_batch(
    samples: int, *, batch_size: int, tail: Tail, world_size: int, start: int = 0
) -> int:
    """Return the number at which an epoch ends: that of its last batch, plus one.

    Args:
        samples: How many samples the epoch has.
        batch_size: Samples in a batch.
        tail: "drop": whole batches only, equally many for each rank; "wrap": every sample, and
            samples again from the epoch's start until the last batch is whole and ranks are even;
            "uneven": every sample once.
        world_size: How many ranks share the batches.
        start: The batch from which these ranks go on.

    Raises:
        SelectionError: If the tail is none of these.
    """
    whole, all_of_them = samples // batch_size, -(-samples // batch_size)
    if tail == "drop":
        return start + max(0, whole - start) // world_size * world_size
    if tail == "wrap":
        return start + -(-max(0, all_of_them - start) // world_size) * world_size
    if tail == "uneven":
        return max(start, all_of_them)
    raise SelectionError(f"tail must be 'drop', 'wrap' or 'uneven', got {tail!r}.")


def rank_share(start: int, end: int, *, rank: int, world_size: int) -> range:
    """Return the batches of a rank from ``start`` on: each n with n mod world_size = rank."""
    return range(start + (rank - start) % world_size, end, world_size)


def _assign(lengths: Numbers, *, streams: int) -> Numbers:
    """Return each piece's stream: the longest piece first, each to the shortest stream."""
    stream = np.empty(len(lengths), dtype=np.int64)
    loads = [(0, number) for number in range(streams)]
    for piece in np.argsort(-lengths, kind="stable").tolist():
        load, number = loads[0]
        heapq.heapreplace(loads, (load + int(lengths[piece]), number))
        stream[piece] = number
    return stream


def _runs(begins: Numbers, lengths: Numbers) -> Numbers:
    """Return begin, begin + 1, ... of each run, one run after another."""
    offsets = np.cumsum(lengths) - lengths
    runs: Numbers = np.repeat(begins - offsets, lengths)
    runs += np.arange(len(runs))
    return runs


def _uniform(raw: UInt64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Return numbers from 0 up to 1 made of the upper 53 bits."""
    uniform: Float64[np.ndarray, " n"] = (raw >> np.uint64(11)) * 2.0**-53
    return uniform


class OrderQuality(NamedTuple):
    """How well an order shuffles.

    Attributes:
        fewest_scenes: Different scenes in the full batch that has fewest.
        mean_scenes: Different scenes in a full batch, on average.
        neighbour_correlation: Pearson's correlation between the numbers of samples that follow one
            another: 1 for the plan's own order, near 0 for a good shuffle.
    """

    fewest_scenes: int
    mean_scenes: float
    neighbour_correlation: float


def order_quality(order: EpochOrder, *, batches: int = 10_000) -> OrderQuality:
    """Return how well an order shuffles, from the first so many full batches of the epoch.

    >>> from stereogenbench_data.selection.order import EpochOrder, OrderRule
    >>> scenes = np.arange(65) * 81
    >>> order_quality(EpochOrder(scenes, OrderRule(16, kind="sequential"), epoch=0)).fewest_scenes
    1
    >>> order_quality(EpochOrder(scenes, OrderRule(16), epoch=0)).fewest_scenes
    14
    """
    full = min(batches, order.samples // order.rule.batch_size)
    numbers = np.array([order.batch(number) for number in range(full)])
    scenes = np.sort(order.scenes_of(numbers), axis=-1)
    different = 1 + (np.diff(scenes, axis=-1) != 0).sum(axis=-1)
    flat = numbers.ravel().astype(np.float64)
    correlation = np.corrcoef(flat[:-1], flat[1:])[0, 1]
    return OrderQuality(int(different.min()), float(different.mean()), float(correlation))
