"""The order of an epoch: which samples make up batch n, as arithmetic on integers.

The order is a pure function of the selection's runs, the seed, the epoch and the rule; workers are
not in it. A run is what decodes by itself: the samples from one key frame of a scene to the next,
so a whole scene where its videos have one key frame. A permutation of the runs, laid end to end, is
cut into shuffle groups of equally many samples; group g gives the batches n with n mod groups = g,
so that ranks can share the groups out. A group deals its runs to streams, as many as the rule keeps
runs open, and interleaves the streams so that each advances evenly, at a pace of its own, to the
group's end. A stream starts inside its first run, at a moment of its own, and reads what lies
before it at its end: else the first batches would show first frames alone, and all streams would
stay in step.

Within a run moments ascend: a process that gets every sample of a stream decodes each run once, but
for what is skipped to reach the moment at which the stream starts. So a rank's workers share the
streams of its groups out (`EpochOrder.workers_of`). Where several samples show a moment (all
pairs), as many neighbouring moments are interleaved as the rule has open frames. A cut between
groups may part a run: groups - 1 runs at the most.

No more than a few thousand samples are ordered at a time, so memory and time until the first batch
grow with the runs, not with the samples. Random numbers are the raw stream of PCG64, which numpy
keeps the same for ever.
"""

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt64

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.selection.filters import require_whole

ORDER_VERSION: Final = 5
"""Changes whenever the same arguments give another order; a saved state names it."""

OPEN_SCENES: Final = 64
"""So many runs are open in all groups together, where memory allows it."""

SHUFFLE_GROUPS: Final = 8
"""Into so many groups the open runs are parted, where each then fills a batch."""

_EVEN_ROUNDS: Final = 8
"""With fewer runs a stream, as many more are open as make the streams equally long."""

_START: Final = 0.25
_START_RUNS: Final = 18
_START_SHARE: Final = 0.03
"""What lies before the start of a stream is decoded twice: on average a quarter of a run, and less
where that of all streams would be more than 18 runs and 3 % of all runs."""

DRIFT: Final = 0.1
"""How far a stream's pace may differ from the mean, so that streams do not run in step."""

_CHUNK: Final = 1 << 15
"""About this many samples of a group are ordered at a time."""

_MANY_RUNS: Final = 32
"""So many runs a stream are dealt out in their order; fewer so that streams are equally long."""

_TAG: Final = 0x0D3B
_MIX: Final = np.uint64(0x9E3779B97F4A7C15)
"""Fibonacci hashing: 2**64 over the golden ratio (Knuth, TAOCP 3, 6.4)."""

DropLast = bool | Literal["pad"]
"""What happens to the last batches of an epoch: see `last_batch`."""

Numbers = Int64[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, eq=False)
class Runs:
    """The runs of a selection, in the order of its samples.

    Attributes:
        first_sample: (r + 1,) int64, the number of each run's first sample, and how many there are.
        pairs: (r,) int64, how many samples show each moment of the run. The samples of a run are
            numbered moment by moment.
        key_distance: (r,) int64, how many moments lie between two of the run at which decoding can
            begin; 1 where that is not regular, or not known.
    """

    first_sample: Int64[np.ndarray, " r1"]
    pairs: Int64[np.ndarray, " r"]
    key_distance: Int64[np.ndarray, " r"]

    @property
    def lengths(self) -> Numbers:
        """How many samples each run has."""
        lengths: Numbers = np.diff(self.first_sample)
        return lengths


@dataclass(frozen=True, slots=True)
class OrderRule:
    """What an order depends on, apart from the selection and the epoch.

    Attributes:
        batch_size: Samples in a batch.
        seed: The seed of the order.
        shuffle_groups: Into how many groups the runs are parted; fewer where a group would have
            fewer runs than a batch can show.
        open_scenes: How many runs a group interleaves; all of them, where it has fewer.
        open_frames: How many neighbouring moments of a run are interleaved, where several samples
            show a moment.
        shuffle: Whether the order is shuffled; otherwise it is that of the samples' numbers.
    """

    batch_size: int
    seed: int = 0
    shuffle_groups: int = SHUFFLE_GROUPS
    open_scenes: int = OPEN_SCENES // SHUFFLE_GROUPS
    open_frames: int = 1
    shuffle: bool = True

    def __post_init__(self) -> None:
        """Require numbers in their ranges."""
        for name in ("batch_size", "seed", "shuffle_groups", "open_scenes", "open_frames"):
            whole = require_whole(name, getattr(self, name), least=int(name != "seed"))
            object.__setattr__(self, name, whole)
        if not isinstance(self.shuffle, bool):
            raise SelectionError(f"shuffle must be True or False, got {self.shuffle!r}.")

    def groups_of(self, lengths: Numbers) -> int:
        """Return into how many groups runs of this many samples are parted.

        So few that the longest run need not come twice in a batch, but two at least, of two
        runs each, so that two ranks need not decode the same; and a divisor of
        ``shuffle_groups``, so that ranks that share those out share these too.
        """
        if not self.shuffle:
            return 1
        as_long_as_the_longest = _as_long_as_the_longest(lengths)
        shown = min(self.batch_size, self.open_scenes)
        at_least = 2 if as_long_as_the_longest >= 4 else 1
        most = min(self.shuffle_groups, max(at_least, as_long_as_the_longest // shown))
        return max(count for count in range(1, most + 1) if self.shuffle_groups % count == 0)

    def in_effect(self, runs: Runs) -> "OrderRule":
        """Return what the order of such runs depends on: equal for equal orders.

        Few runs have fewer groups and open runs than requested; an order that is not
        shuffled depends on the batch size alone.
        """
        if not self.shuffle:
            return OrderRule(self.batch_size, shuffle_groups=1, open_scenes=1, shuffle=False)
        shares_moments = bool((runs.pairs > 1).any())
        has_later_moments = bool((runs.lengths > runs.pairs).any())
        return replace(
            self,
            shuffle_groups=self.groups_of(runs.lengths),
            open_scenes=min(self.open_scenes, len(runs.pairs)),
            open_frames=self.open_frames if shares_moments and has_later_moments else 1,
        )


def usual_groups(*, batch_size: int, fitting: int) -> int:
    """Return into how many groups the open runs are parted, of as many runs as one may wish.

    About `OPEN_SCENES` runs are open in all: as 8 groups of 8 for batches of 8, as 4 of 16 for
    batches of 16. A power of two, so that 1, 2, 4 and 8 ranks have one order.

    Args:
        batch_size: Samples in a batch.
        fitting: How many open runs fit into the memory of a rank.
    """
    return _power_of_two(min(SHUFFLE_GROUPS, _open_in_all(batch_size, fitting) // batch_size))


def groups_for(runs: Runs, *, batch_size: int, fitting: int, world_size: int) -> int:
    """Return how many groups a selection has where nobody asks for a number of them.

    Groups are needed for ranks alone: the usual number, or fewer where a group would have fewer
    runs than a batch can show, is raised to a multiple of the ranks; not where there are fewer runs
    than all ranks' batches can show, so that ranks share groups, and decode the same.

    Args:
        runs: The runs of the selection.
        batch_size: Samples in a batch.
        fitting: How many open runs fit into the memory of a rank.
        world_size: How many ranks share the batches.
    """
    most = max(1, _as_long_as_the_longest(runs.lengths) // batch_size)
    usual = usual_groups(batch_size=batch_size, fitting=fitting)
    groups = _power_of_two(min(usual, most))
    if world_size > most:
        return groups
    return min(-(-groups // world_size), most // world_size) * world_size


def open_runs_for(runs: Runs, *, batch_size: int, fitting: int, groups: int) -> int:
    """Return how many runs each group has open where nobody asks for a number of them.

    With fewer than 8 runs a stream, there are more streams, so that all are equally long: else a
    run of the longer ones would come twice in a batch. Memory may not allow as many.

    Args:
        runs: The runs of the selection.
        batch_size: Samples in a batch.
        fitting: How many open runs fit into the memory of a rank.
        groups: The number of groups.
    """
    of_rank = min(groups, usual_groups(batch_size=batch_size, fitting=fitting))
    wanted, most = _open_in_all(batch_size, fitting) // of_rank, fitting // of_rank
    each = len(runs.pairs) / groups
    rounds = max(1, int(each // wanted))
    if rounds < _EVEN_ROUNDS:
        wanted = max(wanted, min(most, math.ceil(each / rounds)))
    return min(wanted, len(runs.pairs))


def _open_in_all(batch_size: int, fitting: int) -> int:
    return min(fitting, max(OPEN_SCENES, batch_size))


def _power_of_two(most: int) -> int:
    """Return the greatest power of two up to a number, 1 at the least."""
    return 1 << max(0, most.bit_length() - 1)


def _as_long_as_the_longest(lengths: Numbers) -> int:
    """Return how many runs as long as the longest there would be."""
    return round(int(lengths.sum()) / int(lengths.max()))


class OrderedBatch(NamedTuple):
    """A batch of an epoch: (n,) each.

    Attributes:
        samples: Its samples, in their order.
        ends_run: Which of them are the last that their group reads of a run.
        stream: From which stream of its group each comes; the run where nothing is shuffled.
    """

    samples: Numbers
    ends_run: Bool[np.ndarray, " n"]
    stream: Numbers


class EpochOrder:
    """The batches of one epoch by their number; a group is prepared when first asked for.

    Attributes:
        samples: How many samples the epoch has.
        batches: How many batches it has, the last of which may be short.
        groups: How many shuffle groups it has.
    """

    def __init__(self, runs: Runs, rule: OrderRule, *, epoch: int):
        """Take the runs of a selection."""
        self.rule = rule
        self.epoch = epoch
        self.runs = runs
        self.samples = int(runs.first_sample[-1])
        self.batches = -(-self.samples // rule.batch_size)
        self.groups = rule.groups_of(runs.lengths)
        self._groups: dict[int, _Group] = {}

    def batch(self, number: int) -> Numbers:
        """Return the samples of a batch, in its order.

        Raises:
            IndexError: If there is no such batch.
        """
        return self.described(number).samples

    def full_batch(self, number: int) -> Numbers:
        """Return a batch that is never short: after the last sample the epoch starts again."""
        size = self.rule.batch_size
        own = self.batch(number) if number < self.batches else np.empty(0, dtype=np.int64)
        places = (np.arange(number * size + len(own), (number + 1) * size)) % self.samples
        again = [self.batch(place // size)[place % size] for place in places.tolist()]
        return np.concatenate([own, np.array(again, dtype=np.int64)])

    def described(self, number: int) -> OrderedBatch:
        """Return a batch with what is known of its samples.

        Raises:
            IndexError: If there is no such batch.
        """
        if not 0 <= number < self.batches:
            raise IndexError(f"no batch {number}: the epoch has {self.batches}")
        size = self.rule.batch_size
        if not self.rule.shuffle:
            samples = np.arange(number * size, min(self.samples, (number + 1) * size))
            after = np.searchsorted(self.runs.first_sample, samples + 1)
            ends_run = self.runs.first_sample[after] == samples + 1
            return OrderedBatch(samples, ends_run, after - 1)
        turn, group = divmod(number, self.groups)
        found = self._group(group)
        return found.samples(turn * size, min(found.length, (turn + 1) * size))

    def open_runs(self, groups: Sequence[int] | None = None) -> int:
        """Return how many runs some groups, or all, have open at a time: one in each stream."""
        return sum(self._streams if groups is None else [self._streams[each] for each in groups])

    @cached_property
    def _streams(self) -> list[int]:
        """Into how many streams the runs of each group are dealt."""
        if not self.rule.shuffle:
            return [1]
        runs = [len(self._pieces(group).run) for group in range(self.groups)]
        return [min(self.rule.open_scenes, count) for count in runs]

    def workers_of(
        self, number: int, *, groups: Sequence[int], workers: int
    ) -> Int64[np.ndarray, " n"]:
        """Return which of a rank's workers decodes each sample of a batch.

        The streams of the rank's groups, group by group and in each by their first samples, are
        dealt to the workers in turn. So each video is decoded by one of them, and batches are
        shared evenly. Where nothing is shuffled, the runs are dealt.

        Args:
            number: The batch.
            groups: The groups that the rank reads.
            workers: How many workers it has.
        """
        streams = self.described(number).stream
        if not self.rule.shuffle:
            return streams % workers
        group = number % self.groups
        before = self.open_runs(groups[: groups.index(group)])
        places: Numbers = before + self._group(group).places_of_streams[streams]
        return places % workers

    def _group(self, group: int) -> "_Group":
        if group not in self._groups:
            self._groups[group] = _Group(self, self._pieces(group), group=group)
        return self._groups[group]

    @cached_property
    def _permuted(self) -> tuple[Numbers, Numbers]:
        """The runs in the order of the epoch, and how many samples they and those before have."""
        raw = self.raw(len(self.runs.pairs), part=0)
        runs: Numbers = np.argsort(raw, kind="stable")
        ends: Numbers = np.cumsum(self.runs.lengths[runs])
        return runs, ends

    def _pieces(self, group: int) -> "_Pieces":
        """Return the runs of a group, the first and last of which may be cut."""
        # Whole batches, but for the epoch's last.
        size = self.rule.batch_size
        sizes = (self.batches - np.arange(self.groups) + self.groups - 1) // self.groups * size
        sizes[(self.batches - 1) % self.groups] -= self.batches * size - self.samples
        cuts = np.concatenate([[0], np.cumsum(sizes)])
        low, high = int(cuts[group]), int(cuts[group + 1])
        if low == high:
            return _Pieces(*np.empty((3, 0), dtype=np.int64))
        runs, ends = self._permuted
        first = int(np.searchsorted(ends, low, side="right"))
        last = int(np.searchsorted(ends, high, side="left"))
        inside = runs[first : last + 1]
        begins = np.zeros(len(inside), dtype=np.int64)
        stops = self.runs.lengths[inside]
        stops[-1] -= int(ends[last]) - high
        begins[0] = low - (int(ends[first - 1]) if first else 0)
        return _Pieces(inside, begins, stops)

    def raw(self, count: int, *, part: int) -> UInt64[np.ndarray, " n"]:
        """Return random numbers of a part of the epoch."""
        entropy = (self.rule.seed, self.epoch, _TAG, part + 1)
        raw: UInt64[np.ndarray, " n"] = np.random.PCG64(np.random.SeedSequence(entropy)).random_raw(
            count
        )
        return raw


class _Pieces(NamedTuple):
    """Runs, or parts of them: (p,) int64 each, places from ``begin`` up to ``stop`` of the run."""

    run: Numbers
    begin: Numbers
    stop: Numbers


class _Group:
    """One shuffle group: streams of pieces, merged by the times of their samples.

    Sample i of a stream of n is due at time t = p + d p (1 - p), p = (i + offset) / n, where offset
    and d are the stream's own: from 0 to 1, ascending, as |d| < 1. Chunks of equal times are sorted
    when they are asked for; how many samples of a stream come before a chunk is had by inverting t.
    """

    def __init__(self, order: EpochOrder, pieces: _Pieces, *, group: int) -> None:
        self._runs = order.runs
        self._rule = order.rule
        self.length = int((pieces.stop - pieces.begin).sum())
        count = order.open_runs([group])
        # Numbers from 0 up to 1, made of the upper 53 bits.
        raw = order.raw(3 * count, part=group + 1).reshape(3, count)
        draws = (raw >> np.uint64(11)) * 2.0**-53
        self._offset, self._drift = draws[0], DRIFT * (2 * draws[1] - 1)
        self._salt = int(order.raw(1, part=-1)[0])
        dealt = _dealt(pieces, streams=count)
        streams = [_Pieces(*(each[places] for each in pieces)) for places in dealt]
        # Evenly spread over the streams, so that few streams are apart, too. Cubes spread nearly as
        # wide as the shares themselves, with a quarter before them instead of half.
        before = max(_START_RUNS, _START_SHARE * len(self._runs.pairs))
        before = min(_START, before / max(1, count * order.groups))
        starts = ((np.argsort(draws[2]) + draws[2]) / max(1, count)) ** (1 / before - 1)
        self._streams = [
            self._started(stream, share)
            for stream, share in zip(streams, starts.tolist(), strict=True)
        ]
        self._ends = [np.cumsum(stream.stop - stream.begin) for stream in self._streams]
        self._lengths = np.array([int(ends[-1]) for ends in self._ends], dtype=np.int64)
        self._before = self._samples_before()
        self._starts = self._before.sum(axis=1)
        self._chunks: dict[int, OrderedBatch] = {}

    @cached_property
    def places_of_streams(self) -> Numbers:
        """Where each stream stands where they are ordered by their first samples."""
        places = np.empty(len(self._lengths), dtype=np.int64)
        first = self._times(slice(None), np.zeros(len(places), dtype=np.int64))
        places[np.argsort(first, kind="stable")] = np.arange(len(places))
        return places

    def samples(self, start: int, stop: int) -> OrderedBatch:
        """Return samples of the group by their places."""
        found = []
        chunk = int(np.searchsorted(self._starts, start, side="right")) - 1
        while start < stop:
            begin = start - int(self._starts[chunk])
            end = min(stop, int(self._starts[chunk + 1])) - int(self._starts[chunk])
            found.append([each[begin:end] for each in self._chunk(chunk)])
            start, chunk = start + end - begin, chunk + 1
        return OrderedBatch(*map(np.concatenate, zip(*found, strict=True)))

    def _chunk(self, number: int) -> OrderedBatch:
        if number not in self._chunks:
            if len(self._chunks) > 1:
                del self._chunks[next(iter(self._chunks))]
            samples, ends, times = [], [], []
            counts = np.diff(self._before[number : number + 2], axis=0)[0]
            for stream, (low, high) in enumerate(
                zip(self._before[number], self._before[number + 1], strict=True)
            ):
                places = np.arange(low, high)
                times.append(self._times(stream, places))
                pieces, stops = self._streams[stream], self._ends[stream]
                piece = np.searchsorted(stops, places, side="right")
                place = pieces.stop[piece] - (stops[piece] - places)
                samples.append(self._in_run(pieces.run[piece], place))
                ends.append(places + 1 == stops[piece])
            merged = np.argsort(np.concatenate(times), kind="stable")
            streams = np.repeat(np.arange(len(counts)), counts)
            whole = np.concatenate(samples), np.concatenate(ends), streams
            self._chunks[number] = OrderedBatch(*(each[merged] for each in whole))
        return self._chunks[number]

    def _times(
        self, stream: int | slice, places: Int64[np.ndarray, "*n"]
    ) -> Float64[np.ndarray, "*n"]:
        share = (places + self._offset[stream]) / self._lengths[stream]
        times: Float64[np.ndarray, "*n"] = share + self._drift[stream] * share * (1 - share)
        return times

    def _samples_before(self) -> Int64[np.ndarray, "c1 s"]:
        """Return how many samples of each stream are due before each chunk, and in all."""
        chunks = max(1, round(self.length / _CHUNK))
        times = (np.arange(1, chunks) / chunks)[:, None]
        slope = 1 + self._drift
        share = 2 * times / (slope + np.sqrt(slope**2 - 4 * self._drift * times))
        before = np.ceil(share * self._lengths - self._offset).astype(np.int64)
        before = np.clip(before, 0, self._lengths)
        # The root is exact but for rounding: the times themselves decide.
        every = slice(None)
        while (late := (before > 0) & (self._times(every, before - 1) >= times)).any():
            before -= late
        while (early := (before < self._lengths) & (self._times(every, before) < times)).any():
            before += early
        none = np.zeros((1, len(self._lengths)), dtype=np.int64)
        return np.concatenate([none, before, self._lengths[None]])

    def _in_run(self, run: Numbers, place: Numbers) -> Numbers:
        """Return the sample at a place of a run: blocks of moments, each pair by pair.

        In a block the moments take turns with one pair after another, so each camera is read at
        ascending moments; blocks begin with different pairs.
        """
        first, pairs = self._runs.first_sample[run], self._runs.pairs[run]
        if (pairs == 1).all():
            plain: Numbers = first + place
            return plain
        moments = (self._runs.first_sample[run + 1] - first) // pairs
        block, inside = np.divmod(place, pairs * self._rule.open_frames)
        opened = np.minimum(self._rule.open_frames, moments - block * self._rule.open_frames)
        turn, within = np.divmod(inside, opened)
        moment = block * self._rule.open_frames + within
        mixed = (run.astype(np.uint64) + np.uint64(self._salt)) * _MIX
        first_pair = (mixed >> np.uint64(40)).astype(np.int64) + block
        samples: Numbers = first + moment * pairs + (first_pair + turn) % pairs
        return samples

    def _started(self, stream: _Pieces, share: float) -> _Pieces:
        """Return a stream that starts inside its first piece and ends with what lies before."""
        run, begin, stop = int(stream.run[0]), int(stream.begin[0]), int(stream.stop[0])
        pairs = int(self._runs.pairs[run])
        interleaved = self._rule.open_frames if pairs > 1 else 1
        block = pairs * math.lcm(interleaved, int(self._runs.key_distance[run]))
        start = round((begin + share * (stop - begin)) / block) * block
        if not begin < start < stop:
            return stream
        return _Pieces(
            np.append(stream.run, run),
            np.concatenate([[start], stream.begin[1:], [begin]]),
            np.append(stream.stop, start),
        )


def last_batch(
    samples: int, *, batch_size: int, drop_last: DropLast, world_size: int, start: int = 0
) -> int:
    """Return the number at which an epoch ends: that of its last batch, plus one.

    Args:
        samples: How many samples the epoch has.
        batch_size: Samples in a batch.
        drop_last: True: whole batches only, equally many for each rank; "pad": every sample, and
            samples again from the epoch's start until the last batch is whole and ranks are even;
            False: every sample once.
        world_size: How many ranks share the batches.
        start: The batch from which these ranks go on.

    Raises:
        SelectionError: If it is another word.
    """
    whole, all_of_them = samples // batch_size, -(-samples // batch_size)
    if drop_last is True:
        return start + max(0, whole - start) // world_size * world_size
    if drop_last == "pad":
        return start + -(-max(0, all_of_them - start) // world_size) * world_size
    if drop_last is False:
        return max(start, all_of_them)
    raise SelectionError(f"drop_last must be True, False or 'pad', got {drop_last!r}.")


def rank_share(start: int, end: int, *, rank: int, world_size: int) -> range:
    """Return the batches of a rank from ``start`` on: each n with n mod world_size = rank."""
    return range(start + (rank - start) % world_size, end, world_size)


def _dealt(pieces: _Pieces, *, streams: int) -> list[Numbers]:
    """Return the pieces of each stream: about equally many samples in each.

    Many pieces are cut into streams as they come. Of few, the longest goes first, each to the
    shortest stream.
    """
    lengths = pieces.stop - pieces.begin
    if streams == 0:
        return []
    if len(lengths) >= _MANY_RUNS * streams and lengths.max() * streams <= lengths.sum():
        ends = np.cumsum(lengths)
        shares = ends[-1] * np.arange(1, streams) // streams
        return np.split(np.arange(len(lengths)), np.searchsorted(ends, shares) + 1)
    dealt: list[list[int]] = [[] for _ in range(streams)]
    loads = [(0, number) for number in range(streams)]
    for piece in np.argsort(-lengths, kind="stable").tolist():
        load, number = loads[0]
        heapq.heapreplace(loads, (load + int(lengths[piece]), number))
        dealt[number].append(piece)
    return [np.sort(np.array(own, dtype=np.int64)) for own in dealt]
