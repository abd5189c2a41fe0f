"""Each camera compared with the others, to find single files that are wrong.

A match of two pictures is judged twice, by the depth of either camera. In correct data both explain
as many matches; wrong depth of one camera explains fewer, or differs in scale from the other. A
problem of a picture (it is shifted, shows another moment, or was taken elsewhere than recorded)
appears in all pairs of its camera, by either depth.

The reference is the largest group of cameras that agree with one another, if it is the majority:
else no camera is named. Shares of matches depend on what a pair sees, too, so a camera is named by
them only if no other lacks nearly as many.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64

from stereogenbench_data.audit.contract import limits
from stereogenbench_data.audit.contract.hypotheses import LAGS, Hypothesis, Question
from stereogenbench_data.audit.contract.row_matches import FrameMatch, Points, SceneFrames
from stereogenbench_data.audit.contract.scoring import (
    Pair,
    ScoredContract,
    sample_along_rows,
)
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.schema.text import counted

_REFINED: Final = 4
"""So often the shift is taken anew, of the matches that the one before explains."""
_NARROWEST: Final = 2
_ROWS_BESIDE: Final = 2
_MAJORITY: Final = CAMERA_COUNT // 2 + 1


@dataclass(frozen=True, slots=True)
class CameraCheck:
    """How well each camera fits a contract.

    Attributes:
        agreement: Share of the matches of neighbouring cameras that depth explains to a pixel; nan
            if no camera has enough of them.
        untested: Cameras with too few matches in the pictures of their two nearest neighbours.
        unexplained: Cameras whose depth explains less than half of their matches.
        problems: What is wrong with single cameras, in words; each names its camera, unless no
            majority of cameras agrees.
    """

    agreement: float = math.nan
    untested: tuple[int, ...] = tuple(range(CAMERA_COUNT))
    unexplained: tuple[int, ...] = ()
    problems: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class CameraPairStats:
    """Two cameras: their matches of all frames, and what either camera's depth predicts.

    ``near`` is the share of matches that each camera's depth explains. ``share`` is the share that
    the better of the two explains if all matches are moved by what they are off in the middle,
    ``across_px``, and ``row_px`` how much further down they are. ``alike`` is the share of those
    that either explains so in which the two depths agree.
    """

    pair: Pair
    width_m: float
    count: int
    near: Mapping[int, float]
    alike: float
    log_ratio: float
    ratio_error: float
    row_px: float
    across_px: float
    share: float


@dataclass(frozen=True, slots=True, eq=False)
class CameraComparison:
    """Compares each camera of a scene with the others.

    Attributes:
        views: The scene.
        matches: Frame matches, by turns from either side.
        contract: A contract with its scale fitted.
        depth_step: The `relative_step` of stored depth.
    """

    views: SceneFrames
    matches: Sequence[FrameMatch]
    contract: ScoredContract
    depth_step: float

    def check(self) -> CameraCheck:
        """Return how well each camera fits, and what is wrong with it."""
        by_pair: dict[Pair, list[tuple[FrameMatch, FrameMatch]]] = {}
        for here, there in zip(self.matches[::2], self.matches[1::2], strict=True):
            by_pair.setdefault(here.pair, []).append((here, there))
        found = (self._beside(both) for both in by_pair.values())
        pairs = [beside for beside in found if beside is not None]
        if not pairs:
            return CameraCheck()
        nearest = {camera: _of(pairs, camera)[:_NARROWEST] for camera in range(CAMERA_COUNT)}
        counts = {camera: sum(each.count for each in own) for camera, own in nearest.items()}
        explained = {
            camera: sum(each.count * each.near[camera] for each in own)
            for camera, own in nearest.items()
        }
        tested = [camera for camera, count in counts.items() if count >= limits.FEWEST_OF_CAMERA]
        return CameraCheck(
            agreement=sum(explained[each] for each in tested)
            / sum(counts[each] for each in tested),
            untested=tuple(camera for camera in counts if camera not in tested),
            unexplained=tuple(
                each for each in tested if explained[each] < limits.LEAST_SHARE * counts[each]
            ),
            problems=tuple(self._problems(pairs)),
        )

    def _problems(self, pairs: Sequence[CameraPairStats]) -> list[str]:
        """Return what is wrong with single cameras."""
        # In other pairs matches are false, and what is compared has nothing in common.
        clear = [beside for beside in pairs if beside.share >= limits.LEAST_SHARE]
        problems = {
            camera: f"depth of camera {camera} agrees with that of the others in {alike:.0%} of "
            f"the matches, where theirs agree in {usual:.0%}"
            for camera, alike, usual in _behind(
                clear, lambda beside: beside.alike, least=limits.LEAST_UNLIKE
            )
        }
        most = max(limits.MOST_LOG_SCALE, self.depth_step / 4)
        bounds = {beside.pair: max(most, 4 * beside.ratio_error) for beside in clear}
        least = min(max(bounds.values(), default=most), 0.02)
        # Disparity is inverse to depth: hence the sign.
        ratios = {beside.pair: -beside.log_ratio for beside in clear}
        logs, doubts = _levels(ratios, bounds, "scale of depth", least=least)
        problems |= {
            camera: f"depth of camera {camera} is {math.exp(log):.4g} x that of the others"
            for camera, log in enumerate(logs)
            if abs(log) > least
        }
        # The more matches are false, the more they move the middle.
        bounds = {beside.pair: limits.MOST_SHIFT_PX / beside.share**2 for beside in clear}
        rows = {beside.pair: beside.row_px for beside in clear}
        across = {beside.pair: beside.across_px for beside in clear}
        down_px, unsure = _levels(rows, bounds, "rows of pictures")
        right_px, more = _levels(across, bounds, "places or columns of pictures")
        behind = _behind(pairs, lambda beside: beside.share, least=limits.LEAST_DEFICIT)
        shifted = np.abs([down_px, right_px]).max(axis=0) > limits.MOST_SHIFT_PX
        odd_pictures = {*np.flatnonzero(shifted).tolist(), *(camera for camera, *_ in behind)}
        if unsure or more:
            odd_pictures = set()
        in_both = [match for match in self.matches if match.pair in bounds]
        for camera in set(range(CAMERA_COUNT)) - odd_pictures:
            better = self._better_depth(camera, in_both, scale=math.exp(logs[camera]))
            problems |= {camera: better} if better else {}
        for camera in odd_pictures:
            late = self._late_by(camera, pairs)
            when = f"{counted(abs(late), 'frame')} {'late' if late > 0 else 'early'}"
            problems[camera] = (
                f"pictures of camera {camera} are {when}, or its recorded place is wrong"
                if late
                else _picture_problem(camera, down_px[camera], right_px[camera])
            )
        return [*(problems[camera] for camera in sorted(problems)), *doubts, *unsure, *more]

    def _beside(self, both: Sequence[tuple[FrameMatch, FrameMatch]]) -> CameraPairStats | None:
        """Return what a pair's matches of all frames show, from either side; None if too few."""
        parts = []
        hypothesis, scale = self.contract.hypothesis, self.contract.scale
        for here, there in both:
            mine, theirs = (self.views.predicted(match, hypothesis) for match in (here, there))
            if mine is None or theirs is None:
                continue
            known = mine[1] & theirs[1]
            predicted = scale * mine[0], -scale * theirs[0]
            parts.append([
                part[known] for part in (*predicted, here.matched_px, *_row_terms(self.views, here))
            ])  # fmt: skip
        if not parts or sum(len(part[0]) for part in parts) < limits.FEWEST_OF_CAMERA:
            return None
        left_px, right_px, found, upward, steep = map(np.concatenate, zip(*parts, strict=True))
        first = both[0][0]
        near = np.abs(left_px - found) < first.grain_px, np.abs(right_px - found) < first.grain_px
        usable = left_px * right_px > 0
        log_ratio, ratio_error = _median(np.log(left_px[usable] / right_px[usable]))
        moved = [_moved(found, predicted, first.grain_px) for predicted in (left_px, right_px)]
        either = moved[0][1] | moved[1][1]
        allowed_px = self._allowed_px(first, right_px)
        return CameraPairStats(
            pair=first.pair,
            width_m=abs(self.views.baseline_m(first, hypothesis)),
            count=len(found),
            near={pair: float(side.mean()) for pair, side in zip(first.pair, near, strict=True)},
            alike=float(
                (np.abs(left_px - right_px) < allowed_px)[either].sum() / max(either.sum(), 1)
            ),
            log_ratio=log_ratio,
            ratio_error=ratio_error,
            row_px=float(upward[either].sum() / max(steep[either].sum(), 1e-6)),
            across_px=min((away_px for away_px, _ in moved), key=abs),
            share=max(float(explained.mean()) for _, explained in moved),
        )

    def _allowed_px(self, match: FrameMatch, disparity_px: Points) -> Points:
        """Return how far apart the disparities of two depths of a point may be."""
        least_px = limits.MOST_APART_PX * match.grain_px
        allowed_px: Points = least_px + 2 * self.depth_step * np.abs(disparity_px)
        return allowed_px

    def _late_by(self, camera: int, pairs: Sequence[CameraPairStats]) -> int:
        """Return by how many frames a camera's pictures are late, 0 if no lag explains them."""
        (other,) = set(_of(pairs, camera)[0].pair) - {camera}
        counts = {lag: np.zeros(2) for lag in LAGS}
        for frame, lag in itertools.product(
            dict.fromkeys(match.frame for match in self.matches), LAGS
        ):
            match = self.views.matched_later(frame, other, camera, lag=lag)
            predicted = (
                None if match is None else self.views.predicted(match, self.contract.hypothesis)
            )
            if match is not None and predicted is not None:
                away_px = self.contract.scale * predicted[0] - match.matched_px
                near = np.abs(away_px[predicted[1]]) < match.grain_px
                counts[lag] += near.sum(), near.size
        first, second = sorted(LAGS, key=lambda lag: -counts[lag][0])[:2]
        explained, found = counts[first]
        usual = max((each.share for each in pairs if camera not in each.pair), default=1.0)
        is_ahead = explained > limits.LEAST_LEAD * counts[second][0]
        return first if is_ahead and explained > (usual - limits.LEAST_DEFICIT) * found else 0

    def _better_depth(self, camera: int, matches: Sequence[FrameMatch], *, scale: float) -> str:
        """Return in words a lag, flip or other file that explains a camera's depth clearly better.

        The depth as it is counts with the scale that was found for it. A reading explains the
        points at which it agrees with the other camera's depth: depth agrees more sharply with
        depth than with matches, some of which are wrong.
        """
        hypothesis = self.contract.hypothesis
        both = zip(matches[::2], matches[1::2], strict=True)
        sides = [pair if pair[0].left == camera else pair[::-1] for pair in both
                 if camera in pair[0].pair]  # fmt: skip

        def shares(
            read: Hypothesis, *, file: int | None = None, factor: float = 1.0
        ) -> Float64[np.ndarray, " matches"]:
            found = np.full(len(sides), np.nan)
            for place, (here, there) in enumerate(sides):
                mine = self.views.predicted(here, read, depth_file=file)
                theirs = self.views.predicted(there, hypothesis)
                if mine is not None and theirs is not None and (known := mine[1] & theirs[1]).any():
                    expected_px = -self.contract.scale * theirs[0][known]
                    away_px = self.contract.scale * factor * mine[0][known] - expected_px
                    allowed_px = self._allowed_px(here, expected_px)
                    found[place] = float((np.abs(away_px) < allowed_px).mean())
            return found

        now, best, most = shares(hypothesis, factor=scale), "", 0.0
        readings = [
            (f"fits better {fits.format(getattr(other, question))}", shares(other))
            for question, fits in _READINGS.items()
            for other in hypothesis.alternatives(question)
        ] + [
            (
                f"fits worse than that of file {file} does in its place",
                shares(hypothesis, file=file),
            )
            for file in range(CAMERA_COUNT)
            if file != hypothesis.depth_file(camera)
        ]
        for words, explained in readings:  # the simplest first
            gain, is_clear = _gain(explained, now)
            if is_clear and gain > most + limits.LEAST_GAIN * bool(best):
                best, most = f"depth of camera {camera} {words}", gain
        return best


def _moved(found: Points, predicted: Points, grain_px: int) -> tuple[float, Bool[np.ndarray, " n"]]:
    """Return how far matches are off in the middle, and which are explained if all are moved so.

    A shifted picture moves all alike, a camera elsewhere than recorded in proportion.
    """
    away_px = float(np.median(found - predicted))
    # Of false matches, which are few, most lie on one side.
    for _ in range(_REFINED):
        near = np.abs(found - predicted - away_px) < grain_px
        away_px = float(np.median((found - predicted)[near])) if near.any() else away_px
    ahead = found * predicted > 0
    factor = float(np.median(found[ahead] / predicted[ahead])) if ahead.any() else 1.0
    tries = predicted, predicted + away_px, factor * predicted
    explained = (np.abs(found - each) < grain_px for each in tries)
    return away_px, max(explained, key=lambda each: int(each.sum()))


def _of(pairs: Sequence[CameraPairStats], camera: int) -> list[CameraPairStats]:
    """Return a camera's pairs, the narrowest first."""
    own = [beside for beside in pairs if camera in beside.pair]
    return sorted(own, key=lambda beside: beside.width_m)


def _behind(
    pairs: Sequence[CameraPairStats], share: Callable[[CameraPairStats], float], *, least: float
) -> Iterator[tuple[int, float, float]]:
    """Yield cameras all of whose pairs have smaller shares than other pairs as wide.

    A camera is left out if some pair of it lacks less than half of what another camera's pairs
    typically do: a wrong camera makes a part of its neighbours' pairs wrong. The shares of the pair
    that lacks least, and of the best one without the camera, come with it.
    """
    found: dict[int, list[tuple[float, float, float]]] = {}
    for camera in range(CAMERA_COUNT):
        for beside in _of(pairs, camera):
            others = [
                share(other) for other in pairs
                if camera not in other.pair and other.width_m >= 0.9 * beside.width_m
            ]  # fmt: skip
            if others:
                own, best = share(beside), max(others)
                found.setdefault(camera, []).append((best - own, own, best))
    typical = {camera: float(np.median(each, axis=0)[0]) for camera, each in found.items()}
    for camera, each in found.items():
        lack, own, best = min(each)
        most = max((typical[other] for other in typical if other != camera), default=0.0)
        if len(each) >= _NARROWEST and lack > max(least, most / 2):
            yield camera, own, best


def _picture_problem(camera: int, down_px: float, right_px: float) -> str:
    """Return what is wrong with a camera's pictures, which are shifted by so much."""
    shifts = [
        f"{abs(px):.1f} px {ways[px > 0]}"
        for px, *ways in ((right_px, "further left", "further right"), (down_px, "higher", "lower"))
        if abs(px) > limits.MOST_SHIFT_PX
    ]
    if shifts and abs(right_px) <= limits.MOST_SHIFT_PX:
        return f"pictures of camera {camera} are {shifts[0]}, or show another moment"
    shift = " and ".join(shifts) or "other rows"
    return (
        f"pictures of camera {camera} do not fit those of the others, by the depth of "
        f"either: {shift}, another moment or another place, or its recorded place is wrong"
    )


_READINGS: Final[dict[Question, str]] = {
    "frame_lag": "with a lag of {:+d} frames", "flip": "flipped ({})",
}  # fmt: skip


def _gain(
    better: Float64[np.ndarray, " n"], worse: Float64[np.ndarray, " n"]
) -> tuple[float, bool]:
    """Return by how much one set of shares is larger on average, and whether that is certain."""
    gains = (better - worse)[np.isfinite(better - worse)]
    if len(gains) < _NARROWEST + 1:
        return 0.0, False
    mean, error = float(gains.mean()), float(gains.std(ddof=1)) / math.sqrt(len(gains))
    lacking = 1 - float(np.nanmean(worse))
    return mean, mean > max(
        limits.LEAST_GAIN, limits.LEAST_CLOSED * lacking, limits.GAIN_ERRORS * error
    )


def _row_terms(
    views: SceneFrames, match: FrameMatch
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Return how far down the left picture is shifted at each match: numerator and denominator.

    One step of Lucas and Kanade along the column, over five rows, at the disparity that was found.
    """
    left, right = (views.band(match.frame, match.left), views.band(match.frame, match.right))
    place = match.columns - match.matched_px
    numerator, denominator = np.zeros(len(place)), np.zeros(len(place))
    for beside in range(-_ROWS_BESIDE, _ROWS_BESIDE + 1):
        rows = np.clip(match.rows + beside, 1, len(left) - 2)
        there, _, inside = sample_along_rows(right, rows, place)
        above, below = (sample_along_rows(right, rows + by, place)[0] for by in (-1, 1))
        own = (left[rows + 1, match.columns] - left[rows - 1, match.columns]) / 2
        slope = ((below - above) / 2 + own) / 2
        numerator += np.where(inside, slope * (there - left[rows, match.columns]), 0)
        denominator += np.where(inside, slope * slope, 0)
    return numerator, denominator


def _median(values: Float64[np.ndarray, " n"]) -> tuple[float, float]:
    """Return the median and its standard error by the spread; nan and inf for no values."""
    if not len(values):
        return math.nan, math.inf
    middle = float(np.median(values))
    return middle, 1.4826 * float(np.median(np.abs(values - middle))) / math.sqrt(len(values))


def _levels(
    values: Mapping[Pair, float],
    bounds: Mapping[Pair, float],
    what: str,
    *,
    least: float = limits.MOST_SHIFT_PX,
) -> tuple[list[float], list[str]]:
    """Return each camera's level from differences (first less second), and doubts.

    The largest group of cameras that agree is at 0; the others are at their median difference
    from it, or at 0 if only one pair shows it. If it is no majority and some level is beyond
    ``least``, all are at 0 and a doubt says so.
    """
    group = {camera: {camera} for camera in range(CAMERA_COUNT)}
    for pair, value in values.items():
        if abs(value) <= bounds[pair]:
            joined = group[pair[0]] | group[pair[1]]
            for camera in joined:
                group[camera] = joined
    largest = max(group.values(), key=len)
    levels = []
    for camera in range(CAMERA_COUNT):
        differences = [
            value if camera == pair[0] else -value
            for pair, value in values.items()
            if camera in pair and (set(pair) - {camera}) <= largest and math.isfinite(value)
        ]
        is_odd = camera not in largest and len(differences) >= _NARROWEST
        levels.append(float(np.median(differences)) if is_odd else 0.0)
    if len(largest) < _MAJORITY and max(map(abs, levels)) > least:
        return [0.0] * CAMERA_COUNT, [f"cameras disagree in {what}, and no majority of them agrees"]
    return levels, []
