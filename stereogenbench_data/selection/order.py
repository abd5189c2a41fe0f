"""The order of an epoch: which samples make up batch n, as arithmetic on integers.

The order is a pure function of the selection's scenes and samples, the seed, the epoch, the batch
size, the lanes and the open scenes; ranks and workers are not in it. Scenes are permuted and laid
end to end; lane l holds a run of that tape and gives the batches n with n mod lanes = l. A lane
deals its scenes to as many tracks as it keeps scenes open, and merges the tracks so that each
advances evenly, at a pace of its own, to the lane's end. Within a scene samples ascend: a process
that gets every batch of a lane opens each video once and reads it forwards once. Lanes hold equal
numbers of samples, so a lane's end may cut a scene in two: lanes - 1 scenes at the most.

Random numbers are the raw stream of PCG64, which numpy keeps the same for ever.
"""

import heapq
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from jaxtyping import Float64, Int64, UInt64

from stereogenbench_data.errors import SelectionError

ORDER_VERSION: Final = 2
"""Changes whenever the same arguments give another order; a saved state names it."""

LANES: Final = 4
LANES_OF_LARGE: Final = 2
"""Where scenes are so large that memory limits how many are open: two workers have a lane each."""

OPEN_SCENES: Final = 16
"""Fewer open scenes than this make batches of small size too much alike."""

DRIFT: Final = 0.1
"""How far a track's pace may differ from the mean, so that tracks do not run in step."""

_TAG: Final = 0x0D3B

OrderKind = Literal["shuffled", "sequential"]
Tail = Literal["drop", "wrap", "uneven"]
Numbers = Int64[np.ndarray, " n"]


@dataclass(frozen=True, slots=True)
class OrderRule:
    """What an order depends on beside the selection and the epoch.

    Attributes:
        batch_size: Samples in a batch.
        seed: The seed of the order.
        lanes: Into how many lanes the scenes are parted; fewer where a lane would have fewer scenes
            than a batch can show.
        open_scenes: How many scenes a lane interleaves. Fewer than `OPEN_SCENES` are never
            exceeded. From there on there may be more, up to twice as many where a lane has fewer
            than twice as many, so that its tracks are equally long and batches equally mixed.
        kind: "shuffled", or "sequential": by the samples' numbers.
    """

    batch_size: int
    seed: int = 0
    lanes: int = LANES
    open_scenes: int = OPEN_SCENES
    kind: OrderKind = "shuffled"

    def __post_init__(self) -> None:
        """Refuse what orders nothing."""
        for name, least in (("batch_size", 1), ("seed", 0), ("lanes", 1), ("open_scenes", 1)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise SelectionError(f"{name} must be a whole number from {least}, got {value!r}.")
        if self.kind not in ("shuffled", "sequential"):
            raise SelectionError(f"order must be 'shuffled' or 'sequential', got {self.kind!r}.")

    def lanes_of(self, lengths: Numbers) -> int:
        """Return into how many lanes scenes of so many samples are parted.

        So few that the longest scene need not come twice in a batch, but two at least, of two
        scenes each, so that two processes need not decode the same; and a divisor of ``lanes``, so
        that processes that share ``lanes`` out share these too.
        """
        if self.kind == "sequential":
            return 1
        as_long_as_the_longest = round(int(lengths.sum()) / int(lengths.max()))
        shown = min(self.batch_size, self.open_scenes)
        at_least = 2 if as_long_as_the_longest >= 4 else 1
        most = min(self.lanes, max(at_least, as_long_as_the_longest // shown))
        return max(lanes for lanes in range(1, most + 1) if self.lanes % lanes == 0)

    def in_effect(self, lengths: Numbers) -> "OrderRule":
        """Return what the order of scenes of so many samples depends on: equal for equal orders.

        With few scenes other lanes and open scenes are used than were asked for; a sequential
        order depends on the batch size alone.
        """
        if self.kind == "sequential":
            return OrderRule(self.batch_size, lanes=1, open_scenes=1, kind="sequential")
        most = self._most_scenes(lengths)
        all_are_open = self.tracks_of(most) == most
        return replace(
            self,
            lanes=self.lanes_of(lengths),
            open_scenes=len(lengths) if all_are_open else self.open_scenes,
        )

    def tracks_of(self, scenes: int) -> int:
        """Return how many of a lane's scenes are open at a time."""
        if self.open_scenes < OPEN_SCENES:
            return min(scenes, self.open_scenes)
        return -(-scenes // max(1, scenes // self.open_scenes))

    def most_open(self, lengths: Numbers) -> int:
        """Return a bound on the scenes that one lane of a selection has open at a time."""
        most = self._most_scenes(lengths)
        if self.open_scenes < OPEN_SCENES:
            return self.tracks_of(most)
        in_turn = max(1, most // self.open_scenes // 2)
        return min(most, self.open_scenes + self.open_scenes // in_turn)

    def _most_scenes(self, lengths: Numbers) -> int:
        """Return a bound on the scenes of a lane: the shortest ones, and parts of two others."""
        samples = int(lengths.sum())
        batches_of_all = -(-samples // self.batch_size)
        turns = -(-batches_of_all // self.lanes_of(lengths))
        longest_lane = min(samples, turns * self.batch_size)
        whole = int((np.cumsum(np.sort(lengths)) <= longest_lane - 2).sum())
        return min(len(lengths), whole + 2)


class EpochOrder:
    """The batches of one epoch by their number; a lane is worked out when first asked for.

    Attributes:
        samples: How many samples the epoch has.
        batches: How many batches it has, the last of which may be short.
        lanes: How many lanes it has.
    """

    def __init__(self, first_sample: Int64[np.ndarray, " s1"], rule: OrderRule, *, epoch: int):
        """Take the number of each scene's first sample, with that of all samples at the end."""
        self.rule = rule
        self.epoch = epoch
        self.samples = int(first_sample[-1])
        self.batches = -(-self.samples // rule.batch_size)
        self.lanes = rule.lanes_of(np.diff(first_sample))
        self._first_sample = first_sample
        self._lanes: dict[int, Numbers] = {}

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
        turn, lane = divmod(number, self.lanes)
        return self.lane(lane)[turn * size : (turn + 1) * size]

    def full_batch(self, number: int) -> Numbers:
        """Return a batch that is never short: after the last sample the epoch starts again."""
        size = self.rule.batch_size
        own = self.batch(number) if number < self.batches else np.empty(0, dtype=np.int64)
        places = (np.arange(number * size + len(own), (number + 1) * size)) % self.samples
        again = [self.batch(place // size)[place % size] for place in places.tolist()]
        return np.concatenate([own, np.array(again, dtype=np.int64)])

    def lane(self, lane: int) -> Numbers:
        """Return all samples of a lane, in its order."""
        if lane not in self._lanes:
            self._lanes[lane] = self._ordered(lane)
        return self._lanes[lane]

    def scenes_of(self, numbers: Int64[np.ndarray, "*n"]) -> Int64[np.ndarray, "*n"]:
        """Return the place of each sample's scene in the selection."""
        scenes: Int64[np.ndarray, "*n"] = (
            np.searchsorted(self._first_sample, numbers, side="right") - 1
        )
        return scenes

    def _ordered(self, lane: int) -> Numbers:
        begins, lengths = self._pieces(lane)
        if len(lengths) == 0:
            return np.empty(0, dtype=np.int64)
        count = self.rule.tracks_of(len(lengths))
        track = _dealt(lengths, tracks=count)
        draws = _uniform(self._raw(2 * count, stream=lane + 1))
        numbers, times = [], []
        for number, (phase, pace) in enumerate(zip(draws[:count], draws[count:], strict=True)):
            pieces = np.flatnonzero(track == number)
            found = _runs(begins[pieces], lengths[pieces])
            place = (np.arange(len(found)) + phase) / len(found)
            numbers.append(found)
            times.append(place + DRIFT * (2 * pace - 1) * place * (1 - place))
        merged = np.argsort(np.concatenate(times), kind="stable")
        ordered: Numbers = np.concatenate(numbers)[merged]
        return ordered

    def _pieces(self, lane: int) -> tuple[Numbers, Numbers]:
        """Return first sample and length of each scene, or part of one, on a lane's run of tape."""
        cuts = np.concatenate([[0], np.cumsum(self._lane_sizes())])
        low, high = int(cuts[lane]), int(cuts[lane + 1])
        scenes = np.argsort(self._raw(len(self._first_sample) - 1, stream=0), kind="stable")
        lengths = np.diff(self._first_sample)[scenes]
        ends = np.cumsum(lengths)
        starts = ends - lengths
        inside = (ends > low) & (starts < high)
        skipped = np.maximum(low - starts[inside], 0)
        taken = np.minimum(ends[inside], high) - np.maximum(starts[inside], low)
        return self._first_sample[scenes[inside]] + skipped, taken

    def _lane_sizes(self) -> Numbers:
        """Return how many samples each lane has: whole batches, but for the epoch's last."""
        size = self.rule.batch_size
        turns = (self.batches - np.arange(self.lanes) + self.lanes - 1) // self.lanes
        sizes: Numbers = turns * size
        sizes[(self.batches - 1) % self.lanes] -= self.batches * size - self.samples
        return sizes

    def _raw(self, count: int, *, stream: int) -> UInt64[np.ndarray, " n"]:
        entropy = (self.rule.seed, self.epoch, _TAG, stream + 1)
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


def _dealt(lengths: Numbers, *, tracks: int) -> Numbers:
    """Return each piece's track: the longest first, each to the track that has least."""
    track = np.empty(len(lengths), dtype=np.int64)
    loads = [(0, number) for number in range(tracks)]
    for piece in np.argsort(-lengths, kind="stable").tolist():
        load, number = loads[0]
        heapq.heapreplace(loads, (load + int(lengths[piece]), number))
        track[piece] = number
    return track


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
