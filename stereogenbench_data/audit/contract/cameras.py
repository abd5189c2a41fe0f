"""Each camera compared with the others, to find single files that are wrong.

A match of two pictures is judged twice, by the depth of either camera. In correct data both explain
as many matches; wrong depth of one camera explains fewer, or differs in scale from the other. A
problem of a picture (its rows do not align, it shows another moment) appears in all pairs of its
camera, by either depth.

The reference is the largest group of cameras that agree with one another, if it is the majority.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.audit.contract.fitting import voted_scale
from stereogenbench_data.audit.contract.hypotheses import Hypothesis, Question
from stereogenbench_data.audit.contract.matching import FrameMatch, SceneFrames, match_rows
from stereogenbench_data.audit.contract.scoring import Pair, ScoredContract, sample_along_rows
from stereogenbench_data.audit.geometry.picture_check import Luma
from stereogenbench_data.schema.release import CAMERA_COUNT

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
_LEAST_LATER: Final = 0.03
_LEAST_AWAY: Final = 0.25
"""Two depths of a point agree if their disparities differ by fewer pixels."""
_GAIN_ERRORS: Final = 5.0
"""About 90 readings are tried in a scene, so 3 standard errors occur by chance."""
_FEWEST_MATCHES: Final = 100
_NARROWEST: Final = 2
_ROWS_BESIDE: Final = 2
_FARTHEST_FRAMES: Final = 30
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
        column_px: How far they are shifted to the right, against what depth predicts.
    """

    camera: int
    matches: int
    agreement: float
    depth_scale: float
    row_px: float
    column_px: float

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
    column_px: float
    log_scale: float
    rms_px: float

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
        self._partner: dict[int, FrameMatch] = {}
        by_pair: dict[Pair, list[tuple[FrameMatch, FrameMatch]]] = {}
        for here, there in zip(matches[::2], matches[1::2], strict=True):
            self._partner |= {id(here): there, id(there): here}
            by_pair.setdefault(here.pair, []).append((here, there))
        found = {pair: self._beside(pair, both) for pair, both in by_pair.items()}
        self._pairs = {pair: beside for pair, beside in found.items() if beside is not None}

    def check(self) -> CameraCheck:
        """Return every camera's figures and problems."""
        if not self._pairs:
            return CameraCheck()
        scales, scale_problems = self._scales()
        rows_px, row_problems = self._shifts(
            {p: b.row_px for p, b in self._pairs.items()}, MOST_ROWS_PX, ("lower", "higher")
        )
        columns_px, column_problems = self._shifts(
            {p: b.column_px for p, b in self._pairs.items()},
            MOST_COLUMNS_PX,
            ("to the right", "to the left"),
        )
        figures = []
        for camera, shifts in enumerate(zip(scales, rows_px, columns_px, strict=True)):
            nearest = self._of(camera)[:_NARROWEST]
            count = sum(beside.count for beside in nearest)
            explained = sum(beside.count * beside.near[camera] for beside in nearest)
            share = explained / count if count else math.nan
            figures.append(CameraFigures(camera, count, share, *shifts))
        problems = dict(column_problems)
        for camera in sorted({*row_problems, *self._behind()}):
            problems[camera] = self._picture_problem(
                camera, rows_px[camera], row_problems.get(camera)
            )
        problems |= self._depth_problems(scales, scale_problems, beside=set(problems))
        found = [problems[camera] for camera in sorted(problems)] or self._width_problems()
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
        agreed = near[0] & near[1]
        either = near[0] | near[1]
        column_px, _ = _median((found - (by_left + by_right) / 2)[agreed])
        predicted = ((left_px + right_px) / 2)[agreed]
        rms_px = float(np.sqrt((predicted**2).mean())) if agreed.any() else 0.0
        wide = np.abs(predicted) > max(rms_px / 2, 2.0)
        log_scale, _ = _median(np.log(np.maximum(found[agreed][wide] / predicted[wide], 1e-3)))
        return _Beside(
            pair=pair,
            width_m=abs(self._views.baseline_m(both[0][0], hypothesis)),
            count=len(found),
            near={pair[0]: float(near[0].mean()), pair[1]: float(near[1].mean())},
            log_ratio=log_ratio,
            ratio_error=ratio_error,
            row_px=float(upward[either].sum() / max(steep[either].sum(), 1e-6)),
            column_px=column_px,
            log_scale=log_scale,
            rms_px=rms_px,
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

    def _shifts(
        self, values: dict[Pair, float], most_px: float, directions: tuple[str, str]
    ) -> tuple[list[float], dict[int, str]]:
        """Return how far each camera's pictures are shifted, and the cameras shifted too far."""
        levels, group = _levels(values, dict.fromkeys(values, most_px))
        words = {
            camera: f"pictures of camera {camera} are {abs(value):.1f} px {directions[value < 0]}"
            for camera, value in enumerate(levels)
            if abs(value) > most_px
        }
        return levels, _or_all(words, group, f"pictures ({directions[0]} or {directions[1]})")

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

    def _picture_problem(self, camera: int, row_px: float, row_problem: str | None) -> str:
        """Return what is wrong with a camera's pictures, by the reading that fits best."""
        behind = set(self._behind()) - {camera}
        own = self._of(camera)
        neighbour = next((beside for beside in own if not set(beside.pair) & behind), own[0])
        (other,) = set(neighbour.pair) - {camera}
        matches = [match for match in self._matches if (match.left, match.right) == (other, camera)]
        middle = matches[len(matches) // 2]
        frames = self._views.scene.frames
        as_it_is = self._views.band(middle.frame, camera)
        now = self._share([(middle, as_it_is)])
        readings = [
            (self._share([(middle, turned(as_it_is))]), words) for words, turned in _TURNED.items()
        ]
        if row_problem is not None:
            rows = int(np.rint(row_px)) or int(np.sign(row_px))
            readings.append((self._share([(middle, np.roll(as_it_is, -rows, axis=0))]), ""))
        for lag in range(-_FARTHEST_FRAMES, _FARTHEST_FRAMES + 1):
            usable = [match for match in matches if 0 <= match.frame + lag < frames]
            if lag and usable:
                match = min(usable, key=lambda each: abs(each.frame - middle.frame))
                share = self._share([(match, self._views.band(match.frame + lag, camera))])
                readings.append((share, _lateness(lag)))
        share, words = max(readings, default=(0.0, ""))
        elsewhere = self._share_elsewhere(matches)
        # With small disparities another place also explains a problem of rows.
        if elsewhere > share + _LEAST_DEFICIT:
            share, words = elsewhere, _ELSEWHERE
        wanted = max(
            (beside.share for pair, beside in self._pairs.items() if camera not in pair),
            default=1.0,
        )
        if share < max(0.7 * wanted, now + _LEAST_DEFICIT / 2):
            found = f", perhaps {row_problem.split(' are ')[1]}" if row_problem else ""
            return (
                f"pictures of camera {camera} do not fit those of the others, by the depth of "
                f"either: other rows, another moment or another place{found}"
            )
        if words == _ELSEWHERE:
            return f"camera {camera} {words}"
        return f"pictures of camera {camera} are {words}" if words else row_problem or ""

    def _share_elsewhere(self, matches: Sequence[FrameMatch]) -> float:
        """Return the share of matches that depth explains if the cameras stand elsewhere."""
        found, predicted = [], []
        for match in matches:
            prediction = self._views.predicted(match, self._contract.hypothesis)
            if prediction is not None:
                found.append(match.matched_px[prediction[1]])
                predicted.append(prediction[0][prediction[1]])
        if not sum(map(len, found)):
            return 0.0
        found_px, predicted_px = np.concatenate(found), np.concatenate(predicted)
        # The two may even stand in the other order.
        aways = [
            voted_scale(found_px, sign * predicted_px) * sign * predicted_px - found_px
            for sign in (1, -1)
        ]
        return max(float((np.abs(away) < matches[0].grain_px).mean()) for away in aways)

    def _share(self, matches: Sequence[tuple[FrameMatch, Luma]]) -> float:
        """Return the share of matches with given right pictures that depth explains."""
        near, count = 0, 0
        hypothesis = self._contract.hypothesis
        for match, right in matches:
            found = match_rows(self._views.band(match.frame, match.left), right)
            file = hypothesis.depth_file(match.left)
            frame = min(max(match.frame + hypothesis.frame_lag, 0), self._views.scene.frames - 1)
            units, known = self._views.depth(frame, file)
            place = found.rows, found.columns
            number = np.where(known[place], units[place], 1).astype(np.float64)
            predicted = self._contract.scale * self._views.disparity_of(
                number, match, hypothesis, place=place, file=file
            )
            near += int((np.abs(predicted - found.disparity_px) < found.grain_px).sum())
            count += len(found.rows)
        return near / count if count else 0.0

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
        lagged: dict[str, int] = {}
        readings: list[tuple[str, Float64[np.ndarray, " matches"]]] = [
            (
                f"{subject} is {scale:.4g} x that of the others",
                self._shares(matches, hypothesis, factor=scale),
            )
        ]
        for question in _READINGS:
            for other in hypothesis.alternatives(question):
                words = _READINGS[question].format(getattr(other, question))
                factor = self._own_factor(matches, other) if question == "form" else 1.0
                words = f"{subject} fits better {words}"
                if question == "frame_lag":
                    lagged[words] = other.frame_lag
                readings.append((words, self._shares(matches, other, factor=factor)))
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
        if best in lagged:
            lag = hypothesis.frame_lag - lagged[best]
            if self._is_late(camera, lag):
                return f"pictures of camera {camera} are {_lateness(lag)}"
        return best

    def _is_late(self, camera: int, lag: int) -> bool:
        """Tell whether a camera's pictures lag rather than its depth.

        Late pictures fit earlier depth. If they are late, a later picture fits the depth of the
        neighbours better.
        """
        (neighbour,) = set(self._of(camera)[0].pair) - {camera}
        matches = [
            match
            for match in self._matches
            if (match.left, match.right) == (neighbour, camera)
            and 0 <= match.frame + lag < self._views.scene.frames
        ]
        now, then = (
            self._share([(match, self._views.band(match.frame + by, camera)) for match in matches])
            for by in (0, lag)
        )
        return then > now + _LEAST_LATER

    def _own_factor(self, matches: Sequence[FrameMatch], hypothesis: Hypothesis) -> float:
        """Return the factor that most of a camera's matches agree on."""
        ratios = []
        for match in matches:
            predicted = self._views.predicted(match, hypothesis)
            if predicted is not None:
                disparity_px, known = predicted
                ratio = match.matched_px[known] / (self._contract.scale * disparity_px[known])
                ratios.append(ratio[ratio > 0])
        positive = np.concatenate(ratios) if ratios else np.ones(1)
        return math.exp(float(np.median(np.log(positive)))) if len(positive) else 1.0

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
        is multiplied by ``factor``.
        """
        shares = np.full(len(matches), np.nan)
        for place, match in enumerate(matches):
            predicted = self._views.predicted(match, hypothesis, depth_file=file)
            other = self._views.predicted(self._partner[id(match)], self._contract.hypothesis)
            if predicted is not None and other is not None:
                known = predicted[1] & other[1]
                expected_px = -self._contract.scale * other[0][known]
                away = self._contract.scale * factor * predicted[0][known] - expected_px
                allowed = _LEAST_AWAY * match.grain_px + 2 * self._depth_step * np.abs(expected_px)
                shares[place] = float((np.abs(away) < allowed).mean()) if known.any() else np.nan
        return shares

    def _width_problems(self) -> list[str]:
        """Return which pairs disagree with the others on their width, and their common camera."""
        wide = {
            pair: beside for pair, beside in self._pairs.items()
            if beside.rms_px > 2.0 and beside.share >= LEAST_SHARE
        }  # fmt: skip
        if len(wide) < _MAJORITY or self._contract.offsets_px:
            return []
        middle = float(np.median([beside.log_scale for beside in wide.values()]))
        off = {
            pair: beside.log_scale - middle
            for pair, beside in wide.items()
            if abs(beside.log_scale - middle) > max(0.01, 0.25 / beside.rms_px)
        }
        if not off:
            return []
        common = set.intersection(*map(set, off))
        words = ", ".join(f"{a}-{b} by {math.expm1(v):+.1%}" for (a, b), v in off.items())
        whose = f": camera {common.pop()} {_ELSEWHERE}" if len(common) == 1 else ""
        return [f"distances between cameras disagree: {words}{whose}"]


_TURNED: Final[dict[str, Callable[[Luma], Luma]]] = {
    "mirrored": lambda band: band[:, ::-1],
    "upside down": lambda band: band[::-1],
    "turned by 180 degrees": lambda band: band[::-1, ::-1],
}
_ELSEWHERE: Final = "is not at its recorded position, or its pictures are shifted"
_READINGS: Final[dict[Question, str]] = {
    "frame_lag": "with a lag of {:+d} frames", "flip": "flipped ({})", "form": "as {} depth",
    "kind": "along the {}",
}  # fmt: skip


def _lateness(lag: int) -> str:
    return f"{abs(lag)} frame{'s' if abs(lag) > 1 else ''} {'late' if lag > 0 else 'early'}"


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
        there, inside = sample_along_rows(right, rows, place)
        above, _ = sample_along_rows(right, rows - 1, place)
        below, _ = sample_along_rows(right, rows + 1, place)
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
