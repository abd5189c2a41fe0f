"""How well a contract explains pictures, in dB, how certain a difference is, and the best scale.

A contract's score are the squared differences of the pictures after the warp. `Scorer.gain`
compares scores in one scene; `pooled` takes several scenes together.

The ratios of found to predicted disparities vote for a scale, which needs no starting value. Robust
Gauss-Newton steps on the difference of the pictures then refine it (Lucas and Kanade, 1981, with
disparity as a multiple of the predicted one).

Planar and ray depth differ by a few per cent towards the corners, and by less with a long lens.
Their scores in dB hardly differ then, and a slightly different unit explains most of the rest. So
`Scorer.ray_power` fits, beside the scale, the power of the ray's length with which disparity grows:
0 is depth along the optical axis, 1 along the ray.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from jaxtyping import Float32, Float64

from stereogenbench_data.audit.contract import limits
from stereogenbench_data.audit.contract.hypotheses import Hypothesis
from stereogenbench_data.audit.contract.row_matches import (
    SIDE_CELLS,
    FrameMatch,
    Points,
    SceneFrames,
)
from stereogenbench_data.audit.geometry.picture_check import Luma
from stereogenbench_data.schema.records import DepthKind

NORMAL_975: Final = 1.96
_FEWEST_PARTS: Final = 3
_FEW_VIEWS: Final = 1.2
"""A standard error from n views counts 1 + 1.2 / (n - 2) times, which is Student's t to 2 %."""


@dataclass(frozen=True, slots=True)
class Gain:
    """By how many dB one contract is better than another, in one scene or in several.

    Attributes:
        mean_db: The mean difference; nan for nothing to compare.
        error_db: Its standard error, the smaller of two estimates; the search uses it.
        least_db: Smaller differences are not believed.
        wide_db: The larger estimate of the error, for intervals; None if there is one estimate.
    """

    mean_db: float
    error_db: float
    least_db: float = limits.LEAST_DB
    wide_db: float | None = None

    @property
    def interval_error_db(self) -> float:
        """The standard error that intervals have."""
        return self.error_db if self.wide_db is None else self.wide_db

    @property
    def low_db(self) -> float:
        """The lower end of the 95 % interval."""
        return self.mean_db - NORMAL_975 * self.interval_error_db

    def is_clear(
        self, *, least_db: float | None = None, errors: float = limits.LEAST_ERRORS
    ) -> bool:
        """Tell whether the difference is large and certain enough to be believed."""
        least = self.least_db if least_db is None else least_db
        return self.mean_db >= max(least, errors * self.error_db)


SURE: Final = Gain(1.0, 0.0)
"""The shape of disparity over the picture decides, however few dB it makes."""

NOTHING: Final = Gain(math.nan, math.inf)
"""Nothing was compared."""


def weighted_mean(
    values: Sequence[float], errors: Sequence[float], *, least: float
) -> tuple[float, float]:
    """Return the mean weighted by 1 / error^2, and its standard error, of one value or more.

    It is at least as certain as each of its parts. Smaller errors count as ``least``.
    """
    floored = np.maximum(errors, least)
    # Relative weights, so that errors that are all infinite still give the mean.
    precision = (
        (floored.min() / floored) ** 2 if np.isfinite(floored).any() else np.ones(len(values))
    )
    mean = float(precision @ np.asarray(values) / precision.sum())
    return mean, float(floored.min() / math.sqrt(precision.sum()))


def pooled(scenes: Sequence[Gain]) -> Gain:
    """Return the mean over scenes, weighted by how certain each is; `NOTHING` for no scenes."""
    tested = [scene for scene in scenes if math.isfinite(scene.mean_db)]
    if not tested:
        return NOTHING
    mean_db, error_db = weighted_mean(
        [scene.mean_db for scene in tested],
        [scene.interval_error_db for scene in tested],
        least=limits.LEAST_ERROR_DB,
    )
    least_db = max(scene.least_db for scene in tested)
    return Gain(mean_db, error_db, least_db)


def is_ruled_out(scenes: Sequence[Gain]) -> bool:
    """Tell whether another contract is clearly worse in some scene or on average.

    The opposite must be clear in no scene. So one scene rules out an answer for all with the same
    contract, even if the others show nothing (such as a lag where nothing moves).
    """
    together = pooled(scenes)
    is_clear = any(each.is_clear() for each in scenes) or (
        len(scenes) > 1 and together.mean_db >= together.least_db and together.low_db > 0
    )
    opposite = (replace(each, mean_db=-each.mean_db) for each in scenes)
    return is_clear and not any(each.is_clear() for each in opposite)


_SMALLEST: Final = 1e-6
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


def _mean_db(ours: np.ndarray, theirs: np.ndarray) -> Float64[np.ndarray, " k"]:
    """Return the mean over frame matches (the first axis) of the ratio of two sums, in dB."""
    ratios = np.maximum(theirs, _SMALLEST) / np.maximum(ours, _SMALLEST)
    mean: Float64[np.ndarray, " k"] = 10 * np.log10(ratios).mean(axis=0)
    return mean


_TOLERANCE_PX: Final = 1.0
_BIN: Final = 0.02
_LOG_RANGE: Final = 32.0
_STEPS: Final = 10
_LARGEST_STEP_PX: Final = 1.0
_LARGEST_STEPS: Final = {1: np.array([0.3]), 2: np.array([0.1, 0.5])}
"""Largest steps of log(scale) and of the ray's power, by how many of them are fitted."""
_FEWEST_USABLE: Final = 10
_NEAR_PX: Final = 3 * _TOLERANCE_PX
"""Matches further from the prediction are not used to refine it."""


@dataclass(frozen=True, slots=True, eq=False)
class _Term:
    """The pixels of a frame match where depth is known, and the disparity predicted there.

    ``basis`` (2, n) is what log(scale) and the power of the ray add to the logarithm of disparity:
    1, and the logarithm of each ray's length to depth 1. ``large_px`` is the 90th percentile of
    the predicted disparities' size.
    """

    match: FrameMatch
    predicted_px: Points
    basis: Float64[np.ndarray, "2 n"]
    large_px: float


def _joined(terms: Iterable[_Term]) -> tuple[Points, Points]:
    """Return the disparities found and predicted."""
    found, predicted = zip(
        *((term.match.matched_px, term.predicted_px) for term in terms), strict=True
    )
    return np.concatenate(found), np.concatenate(predicted)


def _agreement(found: Points, predicted: Points) -> float:
    """Return how many matches a prediction explains; a near one counts nearly 1."""
    away = (found - predicted) / _TOLERANCE_PX
    return float((1 / (1 + away * away)).sum())


def _voted_scale(found: Points, predicted: Points) -> float:
    """Return the scale, among those that the ratios propose, on which most matches agree."""
    usable = (found * predicted > 0) & (np.abs(found) > 0.1)
    if not usable.any():
        return 1.0
    ratios = np.log(found[usable] / predicted[usable])
    weights = np.minimum(np.abs(found[usable]), 5.0)
    bins = int(2 * _LOG_RANGE / _BIN)
    votes, edges = np.histogram(ratios, bins=bins, range=(-_LOG_RANGE, _LOG_RANGE), weights=weights)
    smooth = np.convolve(votes, [1, 2, 3, 2, 1], mode="same")
    best = smooth.argsort()[-12:]
    scales = [1.0, *np.exp((edges[best] + edges[best + 1]) / 2), math.exp(np.median(ratios))]
    return float(max(scales, key=lambda scale: _agreement(found, scale * predicted)))


def _solved(
    normals: Float64[np.ndarray, "terms k k"], rights: Float64[np.ndarray, "terms k"]
) -> tuple[Points, Points]:
    """Return the step and its standard errors, from the disagreement of frame matches."""
    total = normals.sum(axis=0)
    inverse = np.linalg.pinv(total, rcond=1e-12)
    step = inverse @ rights.sum(axis=0)
    left_over = rights - normals @ step
    count = len(rights)
    spread = np.full(len(step), np.inf)
    if count > 1:
        cover = inverse @ (left_over.T @ left_over) @ inverse * count / (count - 1)
        known = np.diag(total) > 0
        spread[known] = np.sqrt(np.maximum(np.diag(cover), 0))[known]
    return step, spread


@dataclass(frozen=True, slots=True)
class RayPower:
    """The power of the ray's length, and its standard error."""

    power: float
    error: float

    @property
    def kind(self) -> DepthKind | None:
        """The kind of depth, None if the power is uncertain or near neither 0 nor 1."""
        doubt = limits.RAY_BIAS + limits.LEAST_ERRORS * self.error
        if not abs(self.power - 0.5) > doubt:
            return None
        kind: DepthKind = "ray" if self.power > 0.5 else "planar"
        away = self.power - (1 if kind == "ray" else 0)
        return kind if abs(away) <= 2 * limits.RAY_BIAS + limits.LEAST_ERRORS * self.error else None


@dataclass(frozen=True, slots=True, eq=False)
class Scorer:
    """Scores hypotheses on the frame matches of a scene."""

    views: SceneFrames
    matches: Sequence[FrameMatch]

    def score(self, hypothesis: Hypothesis, *, scale: float = 1.0) -> ScoredContract:
        """Return a contract's score on the frame matches of a scene.

        A pixel counts with its capped squared difference, or with the cap if it leaves the picture.
        """
        errors = []
        for match in self.matches:
            predicted = self.views.predicted(match, hypothesis)
            squares = np.full(len(match.rows), np.nan, dtype=np.float32)
            if predicted is not None:
                disparity_px, known = predicted
                there, _, inside = sample_along_rows(
                    self.views.band(match.frame, match.right),
                    match.rows,
                    match.columns - scale * disparity_px,
                )
                square = (there - match.brightness) ** 2
                capped = np.where(inside, np.minimum(square, match.cap), match.cap)
                squares[known] = capped[known]
            errors.append(squares)
        return ScoredContract(hypothesis, scale, math.inf, errors)

    def gain(
        self, better: ScoredContract, worse: ScoredContract, *, left_out: int | None = None
    ) -> Gain:
        """Return by how many dB one contract explains a scene better than another.

        Only pixels for which both predict something are compared, in the views that they do not
        read alike (an exchange of two cameras leaves the others as they are). Contracts that read
        the same depth (another unit, ray) differ a little at many pixels: there a pixel counts at
        most a small part of the cap, so that wrong matches do not outweigh it. Others (lag, order,
        flips) differ much at some pixels, which count in full.

        The pairs of a camera that is ``left_out`` do not count.

        There are two estimates of the error: one from the differences between views (a pair in a
        frame), which is large if some cameras are wrong; and a jackknife over parts of the picture,
        each left out of all views at once, which is large if only some parts matter (such as moving
        ones).
        """
        same_places = better.hypothesis.changed("kind", worse.hypothesis.kind) == worse.hypothesis
        share = limits.FINE_CAP if same_places else 1.0
        sums = np.zeros((2, 0, SIDE_CELLS**2))
        orders_differ = better.hypothesis.order != worse.hypothesis.order
        for match, low, high in zip(self.matches, better.errors, worse.errors, strict=True):
            if left_out in match.pair:
                continue
            if orders_differ and better.hypothesis.reads_alike(
                worse.hypothesis, left=match.left, right=match.right
            ):
                continue
            both = np.isfinite(low) & np.isfinite(high)
            if both.sum() >= limits.FEWEST_POINTS:
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
            return NOTHING
        ours, theirs = sums.sum(axis=-1, keepdims=True)
        used = sums.sum(axis=(0, 1)) > 0
        parts, views = int(used.sum()), sums.shape[1]
        errors_db = []
        if parts >= _FEWEST_PARTS:
            without = _mean_db(ours - sums[0][:, used], theirs - sums[1][:, used])
            errors_db.append(math.sqrt((parts - 1) * float(without.var())))
        if views >= _FEWEST_PARTS:
            each = _mean_db(ours[None, :, 0], theirs[None, :, 0])
            few = 1 + _FEW_VIEWS / (views - 2)
            errors_db.append(few * float(each.std(ddof=1)) / math.sqrt(views))
        return Gain(
            float(_mean_db(ours, theirs)[0]),
            min(errors_db, default=math.inf),
            least_db=limits.LEAST_DB if same_places else limits.LEAST_DB_ELSEWHERE,
            wide_db=max(errors_db, default=math.inf),
        )

    def fitted(self, hypothesis: Hypothesis) -> ScoredContract:
        """Return a hypothesis with the scale that explains the pictures best."""
        terms, log_scale, error = self._terms(hypothesis), 0.0, math.inf
        if terms:
            (log_scale,), (error,) = self._refined(terms, [math.log(_voted_scale(*_joined(terms)))])
        scored = self.score(hypothesis, scale=math.exp(log_scale))
        return replace(scored, scale_error=error, is_scaled=True)

    def most_explained(self, hypothesis: Hypothesis) -> float:
        """Return how many matches a hypothesis explains, at the scale on which most agree."""
        terms = self._terms(hypothesis)
        if not terms:
            return 0.0
        found, predicted = _joined(terms)
        return _agreement(found, _voted_scale(found, predicted) * predicted)

    def ray_power(self, contract: ScoredContract) -> RayPower:
        """Return the power that fits the pictures best, together with the scale."""
        terms = self._terms(contract.hypothesis)
        if not terms:
            return RayPower(0.0, math.inf)
        (_, bend), (_, error) = self._refined(terms, [math.log(contract.scale), 0.0])
        return RayPower(bend + (contract.hypothesis.kind == "ray"), error)

    def _terms(self, hypothesis: Hypothesis) -> list[_Term]:
        """Return the frame matches for which a hypothesis predicts anything, with what it is."""
        terms = []
        for match in self.matches:
            predicted = self.views.predicted(match, hypothesis)
            if predicted is not None and predicted[1].any():
                known = match.at(predicted[1])
                predicted_px = predicted[0][predicted[1]]
                log_ray = np.log(self.views.ray_per_planar[known.rows, known.columns])
                basis = np.stack([np.ones_like(log_ray), log_ray])
                large_px = float(np.percentile(np.abs(predicted_px), 90))
                terms.append(_Term(known, predicted_px, basis, large_px))
        return terms

    def _refined(
        self, terms: Sequence[_Term], start: Sequence[float]
    ) -> tuple[list[float], list[float]]:
        """Return log(scale), and the ray's power if it has a start too, after Gauss-Newton steps.

        Their standard errors come with them.
        """
        values = np.array(start)
        count = len(values)
        for _ in range(_STEPS):
            normals, rights = np.zeros((len(terms), count, count)), np.zeros((len(terms), count))
            for number, term in enumerate(terms):
                grown_px = term.predicted_px * np.exp(values @ term.basis[:count])
                difference, slope, weight = self._compared(term, grown_px)
                columns = slope * grown_px * term.basis[:count]
                normals[number] = (columns * weight) @ columns.T
                rights[number] = (columns * weight) @ difference
            step, errors = _solved(normals, rights)
            large_px = np.exp(values[0]) * np.array([term.large_px for term in terms])
            longest = np.array([term.basis[:count].max(axis=1) for term in terms])
            moved_px = float(np.abs(large_px * (longest @ step)).max())
            part = 1.0 if count > 1 else min(1.0, _LARGEST_STEP_PX / max(moved_px, 1e-12))
            values += np.clip(part * step, -_LARGEST_STEPS[count], _LARGEST_STEPS[count])
            if moved_px < 5e-3:
                break
        return values.tolist(), errors.tolist()

    def _compared(
        self, term: _Term, disparity_px: Points
    ) -> tuple[Float32[np.ndarray, " n"], Float32[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """Return right less left at a disparity, the mean slope of both, and each pixel's weight.

        The weight is robust, and 0 for pixels that leave the picture or whose match is elsewhere,
        and for all if too few are left.
        """
        match = term.match
        there, slope, inside = sample_along_rows(
            self.views.band(match.frame, match.right), match.rows, match.columns - disparity_px
        )
        difference = there - match.brightness
        slope = (slope + match.slope) / 2
        usable = inside & (np.abs(disparity_px - match.matched_px) < _NEAR_PX)
        if usable.sum() < _FEWEST_USABLE:
            return difference, slope, np.zeros(len(difference))
        spread = 1.4826 * float(np.median(np.abs(difference[usable]))) + 1e-3
        weight: Float64[np.ndarray, " n"] = (
            usable / (1 + (difference.astype(np.float64) / (2 * spread)) ** 2) ** 2 / spread**2
        )
        return difference, slope, weight
