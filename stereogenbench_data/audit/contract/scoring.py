"""How well a contract explains pictures, in dB, and how certain a difference is.

A contract's score are the squared differences of the pictures after the warp. `evidence` compares
scores in one scene; `pooled` takes several scenes together.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from jaxtyping import Float32, Float64

from stereogenbench_data.audit.contract.hypotheses import Hypothesis
from stereogenbench_data.audit.contract.matching import (
    SIDE_CELLS,
    FrameMatch,
    Points,
    SceneFrames,
)
from stereogenbench_data.audit.geometry.picture_check import Luma

LEAST_DB: Final = 0.15
"""Smaller mean differences, which interpolation and codecs cause, are not believed."""
LEAST_DB_ELSEWHERE: Final = 0.4
"""The same between contracts that read depth elsewhere (lag, order, flip) or in another form: with
small disparities interpolation alone causes 0.3 dB between neighbouring lags."""
LEAST_ERRORS: Final = 3.0
NORMAL_975: Final = 1.96
_FEW_VIEWS: Final = 1.2
"""A standard error from n views counts 1 + 1.2 / (n - 2) times, which is Student's t to 2 %."""
_LEAST_ERROR_DB: Final = 1e-3


@dataclass(frozen=True, slots=True)
class Evidence:
    """By how many dB one contract is better than another in one scene.

    Attributes:
        mean_db: The mean difference.
        error_db: Its standard error, the smaller of two estimates; the search uses it.
        by_shape: Whether the shape of disparity over the picture decides for this contract; None
            if it does not decide.
        least_db: Smaller differences are not believed.
        wide_db: The larger estimate of the error; intervals use it.
    """

    mean_db: float
    error_db: float
    by_shape: bool | None = None
    least_db: float = LEAST_DB
    wide_db: float | None = None

    def is_clear(self, *, least_db: float | None = None, errors: float = LEAST_ERRORS) -> bool:
        """Tell whether the difference is large and certain enough to be believed."""
        if self.by_shape is not None:
            return self.by_shape
        least = self.least_db if least_db is None else least_db
        return self.mean_db >= max(least, errors * self.error_db)


@dataclass(frozen=True, slots=True)
class Gain:
    """The difference in dB of one scene or of several, with its 95 % confidence interval.

    Attributes:
        mean_db: The mean, weighted by how certain each scene is; nan for nothing to compare.
        low_db: Lower end.
        high_db: Upper end.
        is_clear: Whether the difference may be believed.
        by_shape: Whether the shape of disparity decides, however few dB it makes.
        margin_db: How far the interval must be from 0 to confirm.
    """

    mean_db: float
    low_db: float
    high_db: float
    is_clear: bool
    by_shape: bool = False
    margin_db: float = LEAST_DB

    @property
    def is_excluded(self) -> bool:
        """Whether the other answer is excluded: the whole interval is beyond the margin."""
        return self.by_shape or self.low_db >= self.margin_db


def weighted_mean(
    values: Sequence[float], errors: Sequence[float], *, least: float
) -> tuple[float, float]:
    """Return the mean weighted by 1 / error^2, and its standard error; nan and inf for no values.

    It is at least as certain as each of its parts. Smaller errors count as ``least``.
    """
    if not len(values):
        return math.nan, math.inf
    floored = np.maximum(errors, least)
    # Relative weights, so that errors that are all infinite still give the mean.
    precision = (
        (floored.min() / floored) ** 2 if np.isfinite(floored).any() else np.ones(len(values))
    )
    mean = float(precision @ np.asarray(values) / precision.sum())
    return mean, float(floored.min() / math.sqrt(precision.sum()))


def pooled(scenes: Sequence[Evidence]) -> Gain:
    """Return the mean over scenes.

    It is clear if it is clear in some scene and its opposite in none, or if the mean is: one scene
    rules out an answer for all with the same contract, even if the others show nothing (such as a
    lag where nothing moves).
    """
    tested = [scene for scene in scenes if math.isfinite(scene.mean_db)]
    wide_db = [scene.error_db if scene.wide_db is None else scene.wide_db for scene in tested]
    mean_db, error_db = weighted_mean(
        [scene.mean_db for scene in tested], wide_db, least=_LEAST_ERROR_DB
    )
    low_db, high_db = mean_db - NORMAL_975 * error_db, mean_db + NORMAL_975 * error_db
    least_db = max((scene.least_db for scene in tested), default=LEAST_DB)
    against = (replace(scene, mean_db=-scene.mean_db) for scene in tested if scene.by_shape is None)
    is_clear = any(scene.is_clear() for scene in tested) or (
        len(tested) > 1 and mean_db >= least_db and low_db > 0
    )
    is_opposed = any(scene.is_clear() for scene in against)
    return Gain(
        mean_db, low_db, high_db, is_clear and not is_opposed,
        by_shape=any(scene.by_shape for scene in tested), margin_db=least_db,
    )  # fmt: skip


_FEWEST_POINTS = 40
_FEWEST_CELLS = 3
_FINE_CAP = 0.05
_SMALLEST = 1e-6
Pair = tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class ScoredContract:
    """A contract and its score.

    Attributes:
        hypothesis: Its answers.
        scale: Measured disparity over that at the declared unit: the unit is declared / scale.
        scale_error: Standard error of log(scale), inf if it was not fitted.
        errors: For each frame match the capped squared difference at each pixel; nan where the
            contract predicts nothing.
        is_scaled: Whether the scale was fitted.
    """

    hypothesis: Hypothesis
    scale: float
    scale_error: float
    errors: list[Float32[np.ndarray, " n"]] = field(repr=False)
    is_scaled: bool = False


def sample_along_rows(
    band: Luma, rows: np.ndarray, columns: Points
) -> tuple[Float32[np.ndarray, " n"], Float32[np.ndarray, " n"], np.ndarray]:
    """Return a picture's values between pixels along rows, their slope, and which are inside it.

    By Catmull and Rom's cubic: linear interpolation would blur, which favours some places.
    """
    width = band.shape[1]
    inside = (columns >= 0) & (columns <= width - 1)
    place = np.minimum(np.where(inside, columns, 0.0), width - 2)
    low = place.astype(np.int64)
    t = (place - low).astype(np.float32)
    first = rows * width + low
    flat = band.ravel()
    here, there = flat[first], flat[first + 1]
    before = flat[first - (low > 0)]
    after = flat[first + 1 + (low < width - 2)]
    linear = (there - before) / 2
    square = before - 2.5 * here + 2 * there - after / 2
    cube = (after - before) / 2 + 1.5 * (here - there)
    value = here + t * (linear + t * (square + t * cube))
    return value, linear + t * (2 * square + 3 * t * cube), inside


def score_hypothesis(
    views: SceneFrames,
    matches: Sequence[FrameMatch],
    hypothesis: Hypothesis,
    *,
    scale: float = 1.0,
    scale_error: float = math.inf,
) -> ScoredContract:
    """Return a contract's score on the frame matches of a scene.

    A pixel counts with its capped squared difference, or with the cap if it leaves the picture.
    """
    errors = []
    for match in matches:
        predicted = views.predicted(match, hypothesis)
        squares = np.full(len(match.rows), np.nan, dtype=np.float32)
        if predicted is not None:
            disparity_px, known = predicted
            there, _, inside = sample_along_rows(
                views.band(match.frame, match.right),
                match.rows,
                match.columns - scale * disparity_px,
            )
            square = (there - match.brightness) ** 2
            capped = np.where(inside, np.minimum(square, match.cap), match.cap)
            squares[known] = capped[known]
        errors.append(squares)
    return ScoredContract(hypothesis, scale, scale_error, errors)


def evidence(
    matches: Sequence[FrameMatch], better: ScoredContract, worse: ScoredContract
) -> Evidence:
    """Return by how many dB one contract explains a scene better than another.

    Only pixels for which both predict something are compared, in the views that they do not read
    alike (an exchange of two cameras leaves the others as they are). Contracts that read the same
    depth (another unit, ray) differ a little at many pixels: there a pixel counts at most
    a small part of the cap, so that wrong matches do not outweigh it. Others (lag, order, flips)
    differ much at some pixels, which count in full.

    The error is the smaller of two: one from the differences between views (a pair in a frame),
    which is large if some cameras are wrong; and a jackknife over parts of the picture, each left
    out of all views at once, which is large if only some parts matter (such as moving ones).
    """
    same_places = better.hypothesis.changed("kind", worse.hypothesis.kind) == worse.hypothesis
    share = _FINE_CAP if same_places else 1.0
    sums = np.zeros((2, 0, SIDE_CELLS**2))
    orders_differ = better.hypothesis.order != worse.hypothesis.order
    for match, low, high in zip(matches, better.errors, worse.errors, strict=True):
        if orders_differ and better.hypothesis.reads_alike(
            worse.hypothesis, left=match.left, right=match.right
        ):
            continue
        both = np.isfinite(low) & np.isfinite(high)
        if both.sum() >= _FEWEST_POINTS:
            cells = [
                np.bincount(
                    match.cells[both],
                    weights=np.minimum(part[both], share * match.cap),
                    minlength=SIDE_CELLS**2,
                )
                for part in (low, high)
            ]
            sums = np.concatenate([sums, np.array(cells)[:, None]], axis=1)
    if sums.shape[1] == 0:
        return Evidence(math.nan, math.inf)
    ours, theirs = sums.sum(axis=-1, keepdims=True)
    used = sums.sum(axis=(0, 1)) > 0
    parts, views = int(used.sum()), sums.shape[1]
    errors = [math.inf]
    if parts >= _FEWEST_CELLS:
        without = _mean_db(ours - sums[0][:, used], theirs - sums[1][:, used])
        errors.append(math.sqrt((parts - 1) * float(without.var())))
    if views >= 3:
        each = _mean_db(ours[None, :, 0], theirs[None, :, 0])
        few = 1 + _FEW_VIEWS / (views - 2)
        errors.append(few * float(each.std(ddof=1)) / math.sqrt(views))
    least_db = LEAST_DB if same_places else LEAST_DB_ELSEWHERE
    finite = [error for error in errors if math.isfinite(error)]
    return Evidence(
        float(_mean_db(ours, theirs)[0]), min(errors), least_db=least_db,
        wide_db=max(finite, default=math.inf),
    )  # fmt: skip


def _mean_db(ours: np.ndarray, theirs: np.ndarray) -> Float64[np.ndarray, " k"]:
    """Return the mean over frame matches (the first axis) of the ratio of two sums, in dB."""
    ratios = np.maximum(theirs, _SMALLEST) / np.maximum(ours, _SMALLEST)
    mean: Float64[np.ndarray, " k"] = 10 * np.log10(ratios).mean(axis=0)
    return mean
