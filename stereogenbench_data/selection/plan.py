"""The plan of a dataset: from a sample's number to its scene, cameras and frames, and nothing more.

Samples are numbered scene by scene; within a scene window by window, so that reading in order
decodes every stream once; within a window pair by pair, so that pairs share their frames. A window
is the frames of one sample: one frame, or a clip of several.

Parts may be balanced: pairs by their baselines, scenes by families and maps. The release's
baselines follow what passed its filters (short gaps are the most frequent); the paper asks those
who need a uniform distribution to subsample. Source: the appendix on realised baselines.
"""

import hashlib
import operator
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any, Final, Literal, NamedTuple, TypedDict, Unpack

import numpy as np
from jaxtyping import Float64, Int64

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import BASELINE_BINS, CAMERA_COUNT, baseline_bin
from stereogenbench_data.schema.text import counted
from stereogenbench_data.selection.filters import (
    BaselineSpec,
    Direction,
    PairList,
    PairsSpec,
    SceneFilters,
    baselines_cm,
    choose_pairs,
    filter_scenes,
    require_whole,
    whole_number,
)
from stereogenbench_data.selection.options import split_options
from stereogenbench_data.selection.order import Runs
from stereogenbench_data.selection.signatures import list_options

Balance = Literal["bins", "log_baseline"]
LOG_STRATA = 16


def balanced(
    baselines_cm: Float64[np.ndarray, " n"], *, by: Balance, limit: int | None, seed: int
) -> Int64[np.ndarray, " m"]:
    """Return the places, ascending, of a subsample with equally many baselines of each stratum.

    It is drawn once, for all epochs: what it leaves out is never seen. Another seed draws another.

    Args:
        baselines_cm: Baselines in cm.
        by: "bins": the strata are the paper's baseline bins; "log_baseline": 16 equally wide
            intervals of log-baseline over the range at hand. Empty strata do not count.
        limit: How many to draw in all; the strata's shares differ by at most one, and the first
            strata that have enough get that one more. None draws as many from each stratum as the
            smallest one has.
        seed: The draw's seed.

    Raises:
        SelectionError: If a stratum has fewer baselines than its share of the limit, or the limit
            is no whole number, or less than one for each.
    """
    strata = _strata(baselines_cm, by=by)
    found = np.unique(strata).tolist()
    members = [np.flatnonzero(strata == stratum) for stratum in found]
    counts = np.array([*map(len, members)])
    poorest = int(counts.min())
    most = poorest * len(found) + int((counts > poorest).sum())
    limit = poorest * len(found) if limit is None else require_whole("limit", limit, least=1)
    if limit < len(found):
        raise SelectionError(
            f"limit={limit} is less than one pair for each of {len(found)} strata."
        )
    if limit > most:
        stratum = found[int(counts.argmin())]
        name = f"stratum {stratum + 1} of {LOG_STRATA} of log-baseline"
        if by == "bins":
            name = f"the bin {list(BASELINE_BINS)[stratum]} cm"
        raise SelectionError(
            f"balance={by!r}, limit={limit}: {-(-limit // len(found))} pairs are wanted of {name}, "
            f"which has {poorest}; the most that balances is {most}."
        )
    generator = np.random.default_rng(np.random.SeedSequence((seed, 0xBA1A)))
    share, more = divmod(limit, len(found))
    has_more = counts > share
    shares = share + (has_more & (np.cumsum(has_more) <= more))
    drawn = [
        generator.choice(places, size=size, replace=False)
        for places, size in zip(members, shares.tolist(), strict=True)
    ]
    return np.sort(np.concatenate(drawn))


def _few(count: int, *, limit: int, seed: int) -> Int64[np.ndarray, " n"]:
    """Return the places of a draw of pairs, ascending; a larger one holds those of a smaller one.

    Raises:
        SelectionError: If the limit is no whole number from 1, or more than there are.
    """
    if require_whole("limit", limit, least=1) > count:
        raise SelectionError(f"limit={limit}, and the selection has {counted(count, 'pair')}.")
    generator = np.random.default_rng(np.random.SeedSequence((seed, 0xFE3)))
    return np.sort(generator.permutation(count)[:limit])


def _strata(baselines_cm: Float64[np.ndarray, " n"], *, by: Balance) -> Int64[np.ndarray, " n"]:
    if by == "bins":
        order = list(BASELINE_BINS)
        return np.array([order.index(baseline_bin(value)) for value in baselines_cm])
    if by != "log_baseline":
        raise SelectionError(f"balance must be 'bins' or 'log_baseline', got {by!r}.")
    logs = np.log(baselines_cm)
    width = max(float(np.ptp(logs)) / LOG_STRATA, np.finfo(np.float64).tiny)
    strata: Int64[np.ndarray, " n"] = ((logs - logs.min()) // width).astype(np.int64)
    strata[strata == LOG_STRATA] = LOG_STRATA - 1
    return strata


def balanced_share(
    index: SceneIndex,
    rows: Sequence[int],
    sizes_bytes: Sequence[int],
    *,
    scenes: int | None = None,
    max_bytes: int | None = None,
) -> Int64[np.ndarray, " n"]:
    """Return the rows, ascending, of a share of scenes.

    Families take turns, in each family its maps, and in each map its scenes, in an order that
    depends on their names alone. So a share of more scenes holds that of fewer.

    Args:
        index: What the rows are of.
        rows: The scenes to choose from.
        sizes_bytes: How many bytes each of them takes.
        scenes: How many to choose.
        max_bytes: How many bytes those that are chosen may take together.

    Raises:
        SelectionError: If there are fewer scenes, or no scene fits into the bytes.
    """
    if scenes is not None and scenes > len(rows):
        raise SelectionError(
            f"{index.where}: {counted(scenes, 'scene')} wanted, and {len(rows)} can be chosen. "
            f"Ask for fewer, or widen the filters."
        )
    columns = (index.column(name) for name in ("family", "map_name", "key"))
    families, maps, keys = (column[np.asarray(rows)].tolist() for column in columns)
    tree: dict[str, dict[str, list[int]]] = {}
    for place in sorted(range(len(rows)), key=lambda place: _drawn(keys[place])):
        tree.setdefault(families[place], {}).setdefault(maps[place], []).append(place)
    order = _in_turns(
        _in_turns(tree[family][name] for name in sorted(tree[family], key=_drawn))
        for family in sorted(tree, key=_drawn)
    )
    if max_bytes is not None:
        smallest = min(sizes_bytes)
        if smallest > max_bytes:
            raise SelectionError(
                f"{index.where}: no scene fits into {max_bytes:,} bytes: the smallest takes "
                f"{smallest:,}. Allow more, or take fewer cameras."
            )
        order = [place for place in order if sizes_bytes[place] <= max_bytes]
        taken = np.cumsum([sizes_bytes[place] for place in order])
        order = order[: int(np.searchsorted(taken, max_bytes, side="right"))]
    return np.sort(np.asarray(rows, dtype=np.int64)[order[:scenes]])


def _in_turns(lists: Iterable[Sequence[int]]) -> list[int]:
    """Return the elements of lists, the first of each, then the second of each, and so on."""
    return [each for turn in zip_longest(*lists) for each in turn if each is not None]


def _drawn(text: str) -> bytes:
    return hashlib.sha256(f"0 {text}".encode()).digest()


FramesSpec = (
    Literal["first", "all"]
    | int
    | Sequence[int]
    | tuple[Literal["every"], int]
    | tuple[Literal["random"], int]
    | tuple[Literal["clips"], int, int, int]
    | tuple[Literal["random clips"], int, int, int]
)


@dataclass(frozen=True, slots=True)
class Chosen:
    """The named frames, one a window."""

    frames: tuple[int, ...]
    is_clip: bool = False

    def count(self, frames: int) -> int:
        """Return the number of named frames, all of which the scene must have."""
        if max(self.frames) >= frames:
            raise SelectionError(
                f"frame {max(self.frames)} is asked for of a scene with {frames} frames, "
                f"0 to {frames - 1}. {_leave_out(max(self.frames) + 1)}"
            )
        return len(self.frames)

    def window(self, number: int, *, frames: int, draw: Sequence[int]) -> tuple[int, ...]:
        """Return one named frame."""
        return (self.frames[number],)


@dataclass(frozen=True, slots=True)
class Every:
    """Every k-th frame from frame 0, one a window."""

    step: int
    is_clip: bool = False

    def count(self, frames: int) -> int:
        """Return the number of k-th frames."""
        return -(-frames // self.step)

    def window(self, number: int, *, frames: int, draw: Sequence[int]) -> tuple[int, ...]:
        """Return one frame."""
        return (number * self.step,)


@dataclass(frozen=True, slots=True)
class Clips:
    """Clips of ``length`` frames, ``stride`` frames apart, a clip starting every ``step`` frames.

    A clip that would reach beyond the last frame is not taken.
    """

    length: int
    stride: int = 1
    step: int = 1
    is_clip: bool = True

    def count(self, frames: int) -> int:
        """Return how many clips fit; a scene in which none fits is refused."""
        span = (self.length - 1) * self.stride + 1
        if span > frames:
            raise SelectionError(
                f"a clip of {self.length} frames with stride {self.stride} spans {span} frames; "
                f"a scene has {frames}. {_leave_out(span)}"
            )
        return (frames - span) // self.step + 1

    def window(self, number: int, *, frames: int, draw: Sequence[int]) -> tuple[int, ...]:
        """Return the frames of one clip."""
        start = number * self.step
        return tuple(range(start, start + self.length * self.stride, self.stride))


@dataclass(frozen=True, slots=True)
class Random:
    """n different windows of each scene, drawn from others anew for every epoch, ascending."""

    n: int
    drawn_from: Every | Clips = Every(1)

    @property
    def is_clip(self) -> bool:
        """Whether they are clips."""
        return self.drawn_from.is_clip

    def count(self, frames: int) -> int:
        """Return n, for which a scene must have enough windows."""
        there = self.drawn_from.count(frames)
        if self.n > there:
            what = f"{there} clips" if self.is_clip else f"{there} frames"
            raise SelectionError(
                f"{self.n} windows a scene are to be drawn at random, more than the {what} of a "
                f"scene: ask for fewer. {_leave_out(frames + self.n - there)}"
            )
        return self.n

    def window(self, number: int, *, frames: int, draw: Sequence[int]) -> tuple[int, ...]:
        """Return one of the windows drawn."""
        generator = np.random.default_rng(np.random.SeedSequence(tuple(draw)))
        there = self.drawn_from.count(frames)
        drawn = int(np.sort(generator.choice(there, size=self.n, replace=False))[number])
        return self.drawn_from.window(drawn, frames=frames, draw=draw)


Windows = Chosen | Every | Random | Clips
"""A rule that gives the windows of a scene with a known number of frames.

``is_clip`` says whether a sample has a time axis, ``count(frames)`` how many windows a scene of so
many frames has, and ``window(number, frames=, draw=)`` the frames of one; ``draw`` seeds what is
drawn at random.
"""


def run_starts(windows: Windows, *, frames: int, key_frames: Sequence[int]) -> tuple[int, ...]:
    """Return the windows with which runs begin: groups of windows that decode by themselves.

    A run holds the windows whose first frames lie between two key frames, with `LEAST_RUN` frames
    or more from the one to the other. Windows drawn at random, of which only the number is known
    before, are dealt evenly to as many runs.
    """
    count = windows.count(frames)
    cuts = [0]
    for key in key_frames:
        if min(key - cuts[-1], frames - key) >= LEAST_RUN:
            cuts.append(key)
    if isinstance(windows, Random):
        runs = min(count, len(cuts))
        return tuple(count * number // runs for number in range(runs))
    first = [windows.window(number, frames=frames, draw=(0,))[0] for number in range(count)]
    run = np.searchsorted(cuts, first, side="right")
    return tuple(np.flatnonzero(np.diff(run, prepend=-1)).tolist())


def key_distance(windows: Windows, *, key_frames: Sequence[int]) -> int:
    """Return how many windows lie between those that are key frames, 1 if that is not regular."""
    apart = np.unique(np.diff(key_frames))
    if isinstance(windows, Every) and len(apart) == 1 and apart[0] % windows.step == 0:
        return int(apart[0]) // windows.step
    return 1


def _leave_out(min_frames: int) -> str:
    return f"To leave shorter scenes out, give min_frames={min_frames}."


def parse_frames(spec: Any) -> Windows:
    """Return the windows that a user's ``frames=`` asks for.

    Args:
        spec: "first", "all", a frame number, a sequence of them, ("every", k), ("random", n),
            ("clips", length), ("clips", length, stride) or ("clips", length, stride, step);
            stride is 1 and step is the clip's span where left out, so that clips do not overlap.
            ("random clips", n, length) or ("random clips", n, length, stride): n clips that start
            anywhere. Or any `Windows`.

    Raises:
        SelectionError: If it is another form, or a number in it is out of range.
    """
    if isinstance(spec, Windows):
        return spec
    if isinstance(spec, str) and spec in ("first", "all"):
        return Every(1) if spec == "all" else Chosen((0,))
    parts = [spec] if isinstance(spec, str | bool) or whole_number(spec) is not None else spec
    if isinstance(parts, Sequence | np.ndarray) and len(parts) > 0:
        if not isinstance(parts[0], str):
            frames = tuple(require_whole("frames", number, least=0) for number in parts)
            if len(set(frames)) < len(frames):
                raise SelectionError(f"frames={spec!r} names a frame twice.")
            return Chosen(tuple(sorted(frames)))
        match parts[0], [require_whole("frames", number, least=1) for number in parts[1:]]:
            case "every", [step]:
                return Every(step)
            case "random", [n]:
                return Random(n)
            case "clips", [length, *more] if len(more) <= 2:
                stride = more[0] if more else 1
                step = more[1] if len(more) == 2 else (length - 1) * stride + 1
                return Clips(length, stride, step)
            case "random clips", [n, length, *more] if len(more) <= 1:
                return Random(n, Clips(length, more[0] if more else 1))
    raise SelectionError(
        f"frames={spec!r} is not understood; use 'first', 'all', a frame number, a list of them, "
        "('every', k), ('random', n), ('clips', length, stride, step) or ('random clips', n, "
        "length, stride)."
    )


LEAST_RUN: Final = 24
"""So many frames a run has at least: where key frames lie closer, opening would cost too much, and
batches would hardly be mixed better."""


class PairOptions(TypedDict, total=False):
    """Which pairs of a scene. A subsample is the same in every epoch.

    Attributes:
        pairs: "primary" (the default, one a scene), "adjacent" (5), "all" (15), one or several
            pairs of camera numbers (left, right) or texts "left-right", or "sweep", the primary
            left view with all views to its right in one sample.
        direction: "left_to_right", the default: the left camera's pixels have the disparity.
            "right_to_left": the right camera's, with negative disparity and baseline.
        baseline_cm: A closed range in cm, or names of the paper's bins, such as "[10,30)".
        balance: "bins" or "log_baseline": a subsample with as many pairs in each of the paper's
            bins, or in each of 16 equal steps of the logarithm of the baseline.
        limit: How many pairs the subsample has; alone, it draws them from all, as for few-shot
            training.
    """

    pairs: PairsSpec
    direction: Direction
    baseline_cm: BaselineSpec | None
    balance: Balance | None
    limit: int | None


class Selection(SceneFilters, PairOptions, total=False):
    """Everything that a selection of pair samples can ask for."""

    frames: FramesSpec


SELECTION_DEFAULTS: Final = Selection(
    pairs="primary", direction="left_to_right", baseline_cm=None, balance=None, limit=None,
    frames="first",
)  # fmt: skip
"""What a selection takes unless it says otherwise; each filter lets every scene pass."""


class Address(NamedTuple):
    """Where one sample comes from.

    ``run`` numbers what is decoded in one go, where samples are read in the order of an epoch.
    """

    row: int
    source: int
    targets: tuple[int, ...]
    frames: tuple[int, ...]
    run: int = 0


class Step(NamedTuple):
    """A sample that will be read, and whether its videos are wanted no more after it."""

    address: Address
    ends_run: bool


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """The samples of a selection, as arithmetic: `len` and `locate`.

    Attributes:
        pairs: The chosen pairs, scene after scene.
        windows: The rule that gives a scene's windows.
        scene_rows: (s,) int64, rows of the scenes, ascending.
        first_pair: (s + 1,) int64, where each scene's pairs begin in ``pairs``.
        first_sample: (s + 1,) int64, the number of each scene's first sample.
        runs: The runs of samples between key frames, which decode by themselves.
        frame_counts: (s,) int64, the frames of each scene.
        scene_seeds: (s,) int64, a number for each scene that depends on its key alone.
        seed: The seed of what is drawn at random.
    """

    pairs: PairList
    windows: Windows
    scene_rows: Int64[np.ndarray, " s"]
    first_pair: Int64[np.ndarray, " s1"]
    first_sample: Int64[np.ndarray, " s1"]
    runs: Runs
    frame_counts: Int64[np.ndarray, " s"]
    scene_seeds: Int64[np.ndarray, " s"]
    seed: int

    def __len__(self) -> int:
        return int(self.first_sample[-1])

    def without(self, index: SceneIndex, rows: Sequence[int]) -> "Plan":
        """Return the plan without some scenes, by their rows."""
        kept = self.pairs[~np.isin(self.pairs.row, rows)]
        return _plan(index, kept, windows=self.windows, seed=self.seed)

    @property
    def digest(self) -> str:
        """A sha256 of the selection, in hex: the same for the same samples by the same numbers."""
        digest = hashlib.sha256(f"{self.windows!r} {self.seed}".encode())
        for numbers in (
            self.pairs.source,
            self.pairs.targets,
            self.scene_rows,
            self.first_pair,
            self.first_sample,
            self.runs.first_sample,
            self.frame_counts,
            self.scene_seeds,
        ):
            digest.update(f" {numbers.shape} ".encode())
            digest.update(np.ascontiguousarray(numbers, dtype="<i8").tobytes())
        return digest.hexdigest()

    def locate(self, number: int, *, epoch: int, group: int = 0) -> Address:
        """Return where a sample comes from; only random frames depend on the epoch.

        Args:
            number: The sample.
            epoch: The epoch that it is read in.
            group: The shuffle group that reads it. A run that is parted between two groups is
                decoded in each: a process that reads both would go to and fro in one.

        Raises:
            IndexError: If there is no such sample.
        """
        number = operator.index(number)
        if not 0 <= number < len(self):
            raise IndexError(f"no sample {number}: there are {len(self)}")
        scene = int(self.first_sample.searchsorted(number, side="right")) - 1
        first, last = int(self.first_pair[scene]), int(self.first_pair[scene + 1])
        window, pair = divmod(number - int(self.first_sample[scene]), last - first)
        frames = self.windows.window(
            window,
            frames=int(self.frame_counts[scene]),
            draw=(self.seed, epoch, int(self.scene_seeds[scene])),
        )
        targets = self.pairs.targets[first + pair]
        return Address(
            row=int(self.scene_rows[scene]),
            source=int(self.pairs.source[first + pair]),
            targets=tuple(int(target) for target in targets if target >= 0),
            frames=frames,
            run=group * len(self.runs.pairs)
            + int(self.runs.first_sample.searchsorted(number, side="right"))
            - 1,
        )


@list_options(SELECTION_DEFAULTS)
def plan_pairs(index: SceneIndex, *, seed: int = 0, **selection: Unpack[Selection]) -> Plan:
    """Return the plan of a selection of pair samples.

    Raises:
        SelectionError: If nothing matches, naming what left nothing and what there is; or if the
            seed is not a whole number from 0.
    """
    seed = require_whole("seed", seed, least=0)
    chosen, filters = split_options({**SELECTION_DEFAULTS, **selection}, PairOptions)
    windows = parse_frames(filters.pop("frames"))
    balance, limit = chosen.pop("balance"), chosen.pop("limit")
    # What is left are filters, whose names and values are checked there.
    pairs = choose_pairs(index, filter_scenes(index, filters), **chosen)
    if balance is not None:
        if pairs.targets.shape[1] != 1:
            raise SelectionError(f"balance={balance!r} needs single pairs, not a sweep.")
        found = baselines_cm(index, pairs)[:, 0]
        pairs = pairs[balanced(found, by=balance, limit=limit, seed=seed)]
    elif limit is not None:
        pairs = pairs[_few(len(pairs.row), limit=limit, seed=seed)]
    return _plan(index, pairs, windows=windows, seed=seed)


def plan_views(
    index: SceneIndex,
    *,
    cameras: Sequence[int] | Literal["all", "each"],
    frames: FramesSpec,
    seed: int,
    filters: SceneFilters,
) -> Plan:
    """Return the plan of samples of several cameras at once, or of each camera by itself.

    The first of ``cameras`` is a sample's source, the others are its targets; with "each" a
    sample has a source and no target.

    Raises:
        SelectionError: If nothing matches, naming what left nothing and what there is; or if a
            camera does not exist or is given twice, or the seed is not a whole number from 0.
    """
    seed = require_whole("seed", seed, least=0)
    if isinstance(cameras, str) and cameras == "each":
        views = np.arange(CAMERA_COUNT, dtype=np.int8)[:, None]
    else:
        views = np.array([_require_cameras(cameras)], dtype=np.int8)
    rows = filter_scenes(index, filters)
    views = np.tile(views, (len(rows), 1))
    pairs = PairList(
        row=np.repeat(rows, len(views) // len(rows)), source=views[:, 0], targets=views[:, 1:]
    )
    return _plan(index, pairs, windows=parse_frames(frames), seed=seed)


def _require_cameras(cameras: Any) -> tuple[int, ...]:
    """Return camera numbers, in the order given."""
    if isinstance(cameras, str) and cameras == "all":
        return tuple(range(CAMERA_COUNT))
    found: tuple[Any, ...] = (cameras,)
    if isinstance(cameras, Sequence | np.ndarray):
        found = tuple(np.asarray(cameras, dtype=object).tolist())
    numbers = tuple(number for number in map(whole_number, found) if number is not None)
    is_each_once = 0 < len(found) == len(set(numbers))
    if not is_each_once or not set(numbers) <= set(range(CAMERA_COUNT)):
        raise SelectionError(
            f"cameras must be 'all', 'each' or different numbers of 0 to {CAMERA_COUNT - 1}, "
            f"got {cameras!r}."
        )
    return numbers


def _plan(index: SceneIndex, pairs: PairList, *, windows: Windows, seed: int) -> Plan:
    scene_rows, starts = np.unique(pairs.row, return_index=True)
    first_pair = np.append(starts, len(pairs)).astype(np.int64)
    frame_counts = index.column("frames")[scene_rows].astype(np.int64)
    keys = index.column("key")[scene_rows]
    pairs_of = np.diff(first_pair)
    kinds, kind_of_row = index.key_frames()
    alike = list(zip(frame_counts.tolist(), kind_of_row[scene_rows].tolist(), strict=True))
    of_kind = {}
    for frames, kind in sorted(set(alike)):
        try:
            count = windows.count(frames)
        except SelectionError as error:
            same = [key for key, each in zip(keys, alike, strict=True) if each == (frames, kind)]
            others = f" and {len(same) - 1} more" if len(same) > 1 else ""
            raise SelectionError(f"{same[0]}{others}: {error}") from error
        of_kind[frames, kind] = (
            count,
            run_starts(windows, frames=frames, key_frames=kinds[kind]),
            key_distance(windows, key_frames=kinds[kind]),
        )
    counts, starts_of, distances = zip(*(of_kind[each] for each in alike), strict=True)
    first_sample = np.concatenate([[0], np.cumsum(pairs_of * counts)]).astype(np.int64)
    runs = [len(each) for each in starts_of]
    pairs_of_run = np.repeat(pairs_of, runs)
    first_of_run = np.repeat(first_sample[:-1], runs) + np.concatenate(starts_of) * pairs_of_run
    return Plan(
        pairs=pairs,
        windows=windows,
        scene_rows=scene_rows,
        first_pair=first_pair,
        first_sample=first_sample,
        runs=Runs(
            np.append(first_of_run, first_sample[-1]), pairs_of_run, np.repeat(distances, runs)
        ),
        frame_counts=frame_counts,
        scene_seeds=np.array([zlib.crc32(str(key).encode()) for key in keys], dtype=np.int64),
        seed=seed,
    )
