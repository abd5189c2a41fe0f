"""A contract's scale, found from matches and refined on the pictures.

The ratios of found to predicted disparities vote for a scale, which needs no starting value. Robust
Gauss-Newton steps on the difference of the pictures then refine it (Lucas and Kanade, 1981, with
disparity as a multiple of the predicted one).

Planar and ray depth differ by a few per cent towards the corners, and by less with a long lens.
Their scores in dB hardly differ then, and a slightly different unit explains most of the rest. So
`ray_power` fits, beside the scale, the power of the ray's length with which disparity grows: 0 is
depth along the optical axis, 1 along the ray.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float32, Float64

from stereogenbench_data.audit.contract.hypotheses import Hypothesis
from stereogenbench_data.audit.contract.matching import FrameMatch, Points, SceneFrames
from stereogenbench_data.audit.contract.scoring import (
    LEAST_ERRORS,
    ScoredContract,
    sample_along_rows,
    score_hypothesis,
)
from stereogenbench_data.schema.records import DepthKind

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


def fit_scale(
    views: SceneFrames, matches: Sequence[FrameMatch], hypothesis: Hypothesis
) -> ScoredContract:
    """Return a hypothesis with the scale that explains the pictures best."""
    terms = _fit_terms(views, matches, hypothesis)
    if not terms:
        return score_hypothesis(views, matches, hypothesis)
    (log_scale,), (error,) = _refined(views, terms, [math.log(_voted_scale(*_joined(terms)))])
    return score_hypothesis(
        views, matches, hypothesis, scale=math.exp(log_scale), scale_error=error
    )


def _fit_terms(
    views: SceneFrames, matches: Sequence[FrameMatch], hypothesis: Hypothesis
) -> list[_Term]:
    """Return the frame matches for which a hypothesis predicts anything, with its predictions."""
    terms = []
    for match in matches:
        predicted = views.predicted(match, hypothesis)
        if predicted is not None and predicted[1].any():
            known = match.at(predicted[1])
            predicted_px = predicted[0][predicted[1]]
            log_ray = np.log(views.ray_per_planar[known.rows, known.columns])
            basis = np.stack([np.ones_like(log_ray), log_ray])
            large_px = float(np.percentile(np.abs(predicted_px), 90))
            terms.append(_Term(known, predicted_px, basis, large_px))
    return terms


def voted(
    views: SceneFrames, matches: Sequence[FrameMatch], hypothesis: Hypothesis
) -> tuple[float, float]:
    """Return the scale of a hypothesis that most matches agree on, and how many it explains."""
    terms = _fit_terms(views, matches, hypothesis)
    if not terms:
        return 1.0, 0.0
    found, predicted = _joined(terms)
    scale = _voted_scale(found, predicted)
    return scale, _agreement(found, scale * predicted)


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


def _refined(
    views: SceneFrames, terms: Sequence[_Term], start: Sequence[float]
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
            difference, slope, weight = _compared(views, term, grown_px)
            if weight is not None:
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
    views: SceneFrames, term: _Term, disparity_px: Points
) -> tuple[Float32[np.ndarray, " n"], Float32[np.ndarray, " n"], Float64[np.ndarray, " n"] | None]:
    """Return right less left at a disparity, the mean slope of both, and each pixel's weight.

    The weight is robust, and 0 for pixels that leave the picture or whose match is elsewhere. It
    is None if too few pixels are left.
    """
    match = term.match
    there, slope, inside = sample_along_rows(
        views.band(match.frame, match.right), match.rows, match.columns - disparity_px
    )
    difference = there - match.brightness
    slope = (slope + match.slope) / 2
    usable = inside & (np.abs(disparity_px - match.matched_px) < _NEAR_PX)
    if usable.sum() < _FEWEST_USABLE:
        return difference, slope, None
    spread = 1.4826 * float(np.median(np.abs(difference[usable]))) + 1e-3
    weight: Float64[np.ndarray, " n"] = (
        usable / (1 + (difference.astype(np.float64) / (2 * spread)) ** 2) ** 2 / spread**2
    )
    return difference, slope, weight


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


_RAY_BIAS: Final = 0.15
"""Systematic error of the power; up to 0.19 was measured at long focal lengths."""


@dataclass(frozen=True, slots=True)
class RayPower:
    """The power of the ray's length, and its standard error."""

    power: float
    error: float

    @property
    def kind(self) -> DepthKind | None:
        """The kind of depth, None if the power is uncertain or near neither 0 nor 1."""
        doubt = _RAY_BIAS + LEAST_ERRORS * self.error
        if not abs(self.power - 0.5) > doubt:
            return None
        kind: DepthKind = "ray" if self.power > 0.5 else "planar"
        away = self.power - (1 if kind == "ray" else 0)
        return kind if abs(away) <= 2 * _RAY_BIAS + LEAST_ERRORS * self.error else None


def ray_power(
    views: SceneFrames, matches: Sequence[FrameMatch], contract: ScoredContract
) -> RayPower:
    """Return the power that fits the pictures best, together with the scale."""
    terms = _fit_terms(views, matches, contract.hypothesis)
    if not terms:
        return RayPower(0.0, math.inf)
    (_, bend), (_, error) = _refined(views, terms, [math.log(contract.scale), 0.0])
    return RayPower(bend + (contract.hypothesis.kind == "ray"), error)
