"""Each camera compared with the others, to find single files that are wrong.

A match of two pictures is judged twice, by the depth of either camera. In correct data both explain
as many matches; wrong depth of one camera explains fewer, or differs in scale from the other. A
problem of a picture (its rows do not align, it shows another moment) appears in all pairs of its
camera, by either depth.

The reference is the largest group of cameras that agree with one another, if it is the majority.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.audit.contract.fitting import voted
from stereogenbench_data.audit.contract.hypotheses import LAGS, Hypothesis, Question
from stereogenbench_data.audit.contract.matching import FrameMatch, SceneFrames
from stereogenbench_data.audit.contract.scoring import Pair, ScoredContract, sample_along_rows
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.schema.text import counted

LEAST_SHARE: Final = 0.5
"""Least share of a camera's matches with its neighbours that its depth must explain."""
MOST_LOG_SCALE: Final = 0.005
MOST_ROWS_PX: Final = 0.25
MOST_COLUMNS_PX: Final = 0.4
"""Limits beyond which a camera differs from the others: scale of its depth, rows, columns."""
_LEAST_DEFICIT: Final = 0.12
"""Least share of matches that a camera's pairs lack, compared with other pairs as wide."""
_LEAST_ASYMMETRY: Final = 0.1
"""Where rigs are wide, right depth of a camera explains up to 5 % less than that of the other."""
_LEAST_GAIN: Final = 0.01
_LEAST_CLOSED: Final = 1 / 3
"""Least share of the points lacking that another reading of a camera's depth must explain."""
_LEAST_AWAY: Final = 0.25
"""Two depths of a point agree if their disparities differ by fewer pixels."""
_GAIN_ERRORS: Final = 5.0
"""About 90 readings are tried in a scene, so 3 standard errors occur by chance."""
_LEAST_LEAD: Final = 1.1
"""How many times as much the right lag of a camera's pictures explains as the next best."""
_FEWEST_MATCHES: Final = 100
_NARROWEST: Final = 2
_ROWS_BESIDE: Final = 2
_MAJORITY: Final = CAMERA_COUNT // 2 + 1


@dataclass(frozen=True, slots=True)
class CameraFigures:
    """One camera compared with the others.

    Attributes:
        camera: The number in its files' names.
        matches: Pixels found both in its pictures and in those of its two nearest neighbours.
        agreement: Share of them that its own depth explains to a pixel; nan if untested.
        depth_scale: Its depth over that of the reference cameras at the same points.
        row_px: How far its pictures are shifted down, against the reference cameras.
    """

    camera: int
    matches: int
    agreement: float
    depth_scale: float
    row_px: float

    @property
    def is_tested(self) -> bool:
        """Whether there were enough matches to judge it."""
        return self.matches >= _FEWEST_MATCHES and math.isfinite(self.agreement)


@dataclass(frozen=True, slots=True)
class CameraCheck:
    """How well each camera fits a contract.

    Attributes:
        cameras: Figures of all six cameras; empty if no pair has enough matches.
        problems: What is wrong with single cameras, in words; each names its camera.
    """

    cameras: tuple[CameraFigures, ...] = ()
    problems: tuple[str, ...] = ()

    @property
    def agreement(self) -> float:
        """Share of the matches of neighbouring cameras that is explained; nan if untested."""
        tested = [figures for figures in self.cameras if figures.is_tested]
        count = sum(figures.matches for figures in tested)
        explained = sum(figures.matches * figures.agreement for figures in tested)
        return explained / count if count else math.nan

    @property
    def untested(self) -> tuple[int, ...]:
        """Cameras with too few matches in other pictures."""
        tested = {figures.camera for figures in self.cameras if figures.is_tested}
        return tuple(camera for camera in range(CAMERA_COUNT) if camera not in tested)

    @property
    def unexplained(self) -> tuple[int, ...]:
        """Cameras whose depth explains less than half of their matches."""
        return tuple(
            figures.camera
            for figures in self.cameras
            if figures.is_tested and figures.agreement < LEAST_SHARE
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Beside:
    """Two cameras: their matches of all frames, and what either camera's depth predicts."""

    pair: Pair
    width_m: float
    count: int
    near: Mapping[int, float]
    log_ratio: float
    ratio_error: float
    row_px: float

    @property
    def share(self) -> float:
        """The share of matches that the better of the two depths explains."""
        return max(self.near.values())


class CameraComparison:
    """Compares a scene's cameras under one contract."""

    def __init__(
        self,
        views: SceneFrames,
        matches: Sequence[FrameMatch],
        contract: ScoredContract,
        *,
        depth_step: float,
    ) -> None:
        """Take frame matches, by turns from either side, and a contract with its scale fitted."""
        self._views = views
        self._matches = matches
        self._contract = contract
        self._depth_step = depth_step
        self._most_log_scale = max(MOST_LOG_SCALE, depth_step / 4)
        self._partner: dict[FrameMatch, FrameMatch] = {}
        by_pair: dict[Pair, list[tuple[FrameMatch, FrameMatch]]] = {}
        for here, there in zip(matches[::2], matches[1::2], strict=True):
            self._partner |= {here: there, there: here}
            by_pair.setdefault(here.pair, []).append((here, there))
        found = {pair: self._beside(pair, both) for pair, both in by_pair.items()}
        self._pairs = {pair: beside for pair, beside in found.items() if beside is not None}

    def check(self) -> CameraCheck:
        """Return every camera's figures and problems."""
        if not self._pairs:
            return CameraCheck()
        scales, scale_problems = self._scales()
        rows_px, row_problems = self._shifts()
        figures = []
        for camera, shifts in enumerate(zip(scales, rows_px, strict=True)):
            nearest = self._of(camera)[:_NARROWEST]
            count = sum(beside.count for beside in nearest)
            explained = sum(beside.count * beside.near[camera] for beside in nearest)
            share = explained / count if count else math.nan
            figures.append(CameraFigures(camera, count, share, *shifts))
        problems = {}
        for camera in sorted({*row_problems, *self._behind()}):
            problems[camera] = self._picture_problem(camera, row_problems.get(camera))
        problems |= self._depth_problems(scales, scale_problems, beside=set(problems))
        found = [problems[camera] for camera in sorted(problems)]
        return CameraCheck(tuple(figures), tuple(found))

    def _beside(self, pair: Pair, both: Sequence[tuple[FrameMatch, FrameMatch]]) -> _Beside | None:
        parts = []
        hypothesis, scale = self._contract.hypothesis, self._contract.scale
        for here, there in both:
            mine = self._views.predicted(here, hypothesis)
            theirs = self._views.predicted(there, hypothesis)
            if mine is None or theirs is None:
                continue
            known = mine[1] & theirs[1]
            shift_px = here.shift_px(self._contract.offsets_px)
            rows = _row_terms(self._views, here)
            parts.append([
                part[known]
                for part in (scale * mine[0] + shift_px, shift_px - scale * theirs[0],
                             scale * mine[0], -scale * theirs[0], here.matched_px, *rows)
            ])  # fmt: skip
        if not parts or sum(len(part[0]) for part in parts) < _FEWEST_MATCHES:
            return None
        by_left, by_right, left_px, right_px, found, upward, steep = map(
            np.concatenate, zip(*parts, strict=True)
        )
        grain_px = both[0][0].grain_px
        near = np.abs(by_left - found) < grain_px, np.abs(by_right - found) < grain_px
        usable = left_px * right_px > 0
        log_ratios = np.log(left_px[usable] / right_px[usable])
        log_ratio, ratio_error = _median(log_ratios)
        either = near[0] | near[1]
        return _Beside(
            pair=pair,
            width_m=abs(self._views.baseline_m(both[0][0], hypothesis)),
            count=len(found),
            near={pair[0]: float(near[0].mean()), pair[1]: float(near[1].mean())},
            log_ratio=log_ratio,
            ratio_error=ratio_error,
            row_px=float(upward[either].sum() / max(steep[either].sum(), 1e-6)),
        )

    def _of(self, camera: int) -> list[_Beside]:
        """Return a camera's pairs, the narrowest first."""
        own = [beside for pair, beside in self._pairs.items() if camera in pair]
        return sorted(own, key=lambda beside: beside.width_m)

    def _scales(self) -> tuple[list[float], dict[int, str]]:
        """Return each camera's depth over that of the reference, and the cameras that differ."""
        # Disparity is inverse to depth: hence the sign.
        values = {pair: -beside.log_ratio for pair, beside in self._pairs.items()}
        limits = {
            pair: max(self._most_log_scale, 4 * beside.ratio_error)
            for pair, beside in self._pairs.items()
        }
        logs, group = _levels(values, limits)
        least = max(limits.values(), default=0.0)
        words = {
            camera: f"depth of camera {camera} is {math.exp(value):.4g} x that of the others"
            for camera, value in enumerate(logs)
            if abs(value) > min(least, 0.02)
        }
        return [math.exp(value) for value in logs], _or_all(words, group, "scale of depth")

    def _shifts(self) -> tuple[list[float], dict[int, str]]:
        """Return how far down each camera's pictures are, and the cameras that are too far."""
        values = {pair: beside.row_px for pair, beside in self._pairs.items()}
        levels, group = _levels(values, dict.fromkeys(values, MOST_ROWS_PX))
        words = {
            camera: f"pictures of camera {camera} are {abs(px):.1f} px "
            f"{'higher' if px < 0 else 'lower'}"
            for camera, px in enumerate(levels)
            if abs(px) > MOST_ROWS_PX
        }
        return levels, _or_all(words, group, "rows of pictures")

    def _behind(self) -> Iterator[int]:
        """Yield cameras all of whose pairs explain fewer matches than other pairs as wide."""
        for camera in range(CAMERA_COUNT):
            deficits = []
            for beside in self._of(camera):
                others = [
                    other.share
                    for pair, other in self._pairs.items()
                    if camera not in pair and other.width_m >= 0.9 * beside.width_m
                ]
                if others:
                    deficits.append(max(others) - beside.share)
            if len(deficits) >= _NARROWEST and min(deficits) > _LEAST_DEFICIT:
                yield camera

    def _picture_problem(self, camera: int, row_problem: str | None) -> str:
        """Return what is wrong with a camera's pictures."""
        late = self._late_by(camera)
        if late:
            word = "late" if late > 0 else "early"
            return f"pictures of camera {camera} are {counted(abs(late), 'frame')} {word}"
        explained = max(beside.share for beside in self._of(camera))
        if row_problem is not None and explained >= LEAST_SHARE:
            return row_problem
        found = f", perhaps {row_problem.split(' are ')[1]}" if row_problem else ""
        return (
            f"pictures of camera {camera} do not fit those of the others, by the depth of "
            f"either: other rows, another moment or another place{found}"
        )

    def _late_by(self, camera: int) -> int:
        """Return by how many frames a camera's pictures are late, 0 if no lag explains them."""
        nearest = self._of(camera)[0]
        (other,) = set(nearest.pair) - {camera}
        frames = dict.fromkeys(match.frame for match in self._matches)
        counts = {lag: np.zeros(2) for lag in LAGS}
        for frame, lag in itertools.product(frames, LAGS):
            match = self._views.matched_later(frame, other, camera, lag=lag)
            if match is None:
                continue
            predicted = self._views.predicted(match, self._contract.hypothesis)
            if predicted is not None:
                away_px = self._contract.scale * predicted[0] - match.matched_px
                near = np.abs(away_px[predicted[1]]) < match.grain_px
                counts[lag] += near.sum(), near.size
        first, second = sorted(LAGS, key=lambda lag: -counts[lag][0])[:2]
        explained, found = counts[first]
        usual = max((each.share for each in self._pairs.values() if camera not in each.pair),
                    default=1.0)  # fmt: skip
        is_ahead = explained > _LEAST_LEAD * counts[second][0]
        return first if is_ahead and explained > (usual - _LEAST_DEFICIT) * found else 0

    def _depth_problems(
        self, scales: Sequence[float], scale_problems: dict[int, str], *, beside: set[int]
    ) -> dict[int, str]:
        """Return cameras whose depth explains too little, and what would explain more."""
        problems = {}
        offsets_px = self._contract.offsets_px
        for camera in sorted(set(range(CAMERA_COUNT)) - beside):
            pairs = self._of(camera)
            is_shifted = bool(offsets_px) and all(
                abs(offsets_px.get(each.pair, math.inf)) >= MOST_COLUMNS_PX for each in pairs
            )
            if is_shifted or not pairs:
                continue
            own = [
                each for each in pairs
                if not (set(each.pair) - {camera}) & (beside | set(scale_problems))
            ] or pairs  # fmt: skip
            behind = [
                each.near[camera] - next(n for c, n in each.near.items() if c != camera)
                for each in own
            ]
            better = self._better_depth(camera, scale=scales[camera])
            if better:
                problems[camera] = better
            elif camera in scale_problems:
                problems[camera] = scale_problems[camera]
            elif float(np.median(behind)) < -_LEAST_ASYMMETRY:
                problems[camera] = (
                    f"depth of camera {camera} explains {own[0].near[camera]:.0%} of the matches "
                    f"of which that of its neighbour explains {own[0].share:.0%}"
                )
        return problems

    def _better_depth(self, camera: int, *, scale: float) -> str:
        """Return, in words, another reading of a camera's depth that explains clearly more."""
        hypothesis = self._contract.hypothesis
        matches = [match for match in self._matches if match.left == camera]
        now = self._shares(matches, hypothesis)
        subject = f"depth of camera {camera}"
        readings: list[tuple[str, Float64[np.ndarray, " matches"]]] = [
            (
                f"{subject} is {scale:.4g} x that of the others",
                self._shares(matches, hypothesis, factor=scale),
            )
        ]
        for question in _READINGS:
            for other in hypothesis.alternatives(question):
                words = _READINGS[question].format(getattr(other, question))
                words = f"{subject} fits better {words}"
                readings.append((words, self._shares(matches, other)))
        for file in range(CAMERA_COUNT):
            if file != hypothesis.depth_file(camera):
                readings.append(
                    (
                        f"{subject} fits worse than that of file {file} does in its place",
                        self._shares(matches, hypothesis, file=file),
                    )
                )
        best, most = "", 0.0
        for words, shares in readings:
            gain, is_clear = _gain(shares, now)
            # The first ones are the simplest.
            if is_clear and gain > most + _LEAST_GAIN * bool(best):
                best, most = words, gain
        return best

    def _shares(
        self,
        matches: Sequence[FrameMatch],
        hypothesis: Hypothesis,
        *,
        file: int | None = None,
        factor: float = 1.0,
    ) -> Float64[np.ndarray, " matches"]:
        """Return for each frame match the share where a reading agrees with the other's depth.

        Depth agrees more sharply with depth than with matches, some of which are wrong. Disparity
        is multiplied by ``factor``; another form of depth has a factor of its own.
        """
        if hypothesis.form != self._contract.hypothesis.form:
            factor = voted(self._views, matches, hypothesis)[0] / self._contract.scale
        shares = np.full(len(matches), np.nan)
        for place, match in enumerate(matches):
            predicted = self._views.predicted(match, hypothesis, depth_file=file)
            other = self._views.predicted(self._partner[match], self._contract.hypothesis)
            if predicted is not None and other is not None:
                known = predicted[1] & other[1]
                expected_px = -self._contract.scale * other[0][known]
                away = self._contract.scale * factor * predicted[0][known] - expected_px
                allowed = _LEAST_AWAY * match.grain_px + 2 * self._depth_step * np.abs(expected_px)
                shares[place] = float((np.abs(away) < allowed).mean()) if known.any() else np.nan
        return shares


_READINGS: Final[dict[Question, str]] = {
    "frame_lag": "with a lag of {:+d} frames", "flip": "flipped ({})", "form": "as {} depth",
    "kind": "along the {}",
}  # fmt: skip


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
    values: Mapping[Pair, float], limits: Mapping[Pair, float]
) -> tuple[list[float], set[int]]:
    """Return each camera's level from differences (first less second), and the reference group.

    The largest group of cameras that agree is at 0; the others are at their median difference
    from it.
    """
    group = {camera: {camera} for camera in range(CAMERA_COUNT)}
    for pair, value in values.items():
        if abs(value) <= limits[pair]:
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
        levels.append(
            0.0 if camera in largest or not differences else float(np.median(differences))
        )
    return levels, largest


def _or_all(words: dict[int, str], group: set[int], what: str) -> dict[int, str]:
    """Return the words, or that cameras disagree if no majority of them agrees."""
    if not words or len(group) >= _MAJORITY:
        return words
    return dict.fromkeys(words, f"cameras disagree in {what}, and no majority of them agrees")


def _gain(
    better: Float64[np.ndarray, " n"], worse: Float64[np.ndarray, " n"]
) -> tuple[float, bool]:
    """Return by how much one set of shares is larger on average, and whether that is certain."""
    gains = better - worse
    gains = gains[np.isfinite(gains)]
    if len(gains) < _NARROWEST + 1:
        return 0.0, False
    mean, error = float(gains.mean()), float(gains.std(ddof=1)) / math.sqrt(len(gains))
    lacking = 1 - float(np.nanmean(worse))
    return mean, mean > max(_LEAST_GAIN, _LEAST_CLOSED * lacking, _GAIN_ERRORS * error)
