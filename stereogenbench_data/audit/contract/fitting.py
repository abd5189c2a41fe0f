"""A contract's scale and offsets, found from matches and refined on the pictures.

The ratios of found to predicted disparities vote for a scale, which needs no starting value. Robust
Gauss-Newton steps on the difference of the pictures then refine it (Lucas and Kanade, 1981, with
disparity as a scale and an offset of the predicted one).

Planar and ray depth differ by a few per cent towards the corners, and by less with a long lens.
Their scores in dB hardly differ then, and a slightly different unit explains most of the rest. So
`ray_power` fits, beside the scale, the power of the ray's length with which disparity grows: 0 is
depth along the optical axis, 1 along the ray.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Float32, Float64

from stereogenbench_data.audit.contract.hypotheses import Hypothesis
from stereogenbench_data.audit.contract.matching import FrameMatch, Points, SceneFrames
from stereogenbench_data.audit.contract.scoring import (
    LEAST_ERRORS,
    Pair,
    ScoredContract,
    sample_with_slope,
    score_hypothesis,
)
from stereogenbench_data.schema.records import DepthKind

Free = Literal["nothing", "scale", "offset", "both"]

_TOLERANCE_PX: Final = 1.0
_BIN: Final = 0.02
_LOG_RANGE: Final = 32.0
_STEPS: Final = 10
_LARGEST_STEP_PX: Final = 1.0
_DRAWS: Final = 300
_FEWEST_USABLE: Final = 10
_NEAR_PX: Final = 3 * _TOLERANCE_PX
"""Matches further from the prediction are not used to refine it."""


@dataclass(frozen=True, slots=True, eq=False)
class _Term:
    """The pixels of a frame match where depth is known, and the disparity predicted there.

    ``large_px`` is the 90th percentile of the predicted disparities' size. ``sign`` is 1 if the
    pixels are those of the file with the lower number, from which offsets are counted, else -1.
    """

    match: FrameMatch
    predicted_px: Points
    large_px: float
    sign: int


def fit_hypothesis(
    views: SceneFrames, matches: Sequence[FrameMatch], hypothesis: Hypothesis, *, free: Free
) -> ScoredContract:
    """Return a hypothesis with the scale and the offsets that explain the pictures best."""
    terms = [] if free == "nothing" else _fit_terms(views, matches, hypothesis)
    if not terms:
        return score_hypothesis(views, matches, hypothesis)
    scale, offsets_px, error = _refined(views, terms, *_start(terms, free=free), free=free)
    return score_hypothesis(
        views, matches, hypothesis, scale=scale, offsets_px=offsets_px, scale_error=error
    )


def _fit_terms(
    views: SceneFrames, matches: Sequence[FrameMatch], hypothesis: Hypothesis
) -> list[_Term]:
    """Return the frame matches for which a hypothesis predicts anything, with its predictions."""
    terms = []
    for match in matches:
        predicted = views.predicted(match, hypothesis)
        if predicted is not None and predicted[1].any():
            disparity_px, known = predicted
            predicted_px = disparity_px[known]
            large_px = float(np.percentile(np.abs(predicted_px), 90))
            sign = 1 if match.left < match.right else -1
            terms.append(_Term(match.at(known), predicted_px, large_px, sign))
    return terms


def voted_agreement(
    views: SceneFrames, matches: Sequence[FrameMatch], hypothesis: Hypothesis
) -> float:
    """Return how many matches a hypothesis explains at the scale that most of them agree on."""
    terms = _fit_terms(views, matches, hypothesis)
    if not terms:
        return 0.0
    found, predicted = _joined(terms)
    return _agreement(found, voted_scale(found, predicted) * predicted)


def _joined(terms: Iterable[_Term]) -> tuple[Points, Points]:
    """Return the disparities found and predicted, counted from the files with the lower number."""
    found, predicted = zip(
        *((term.sign * term.match.matched_px, term.sign * term.predicted_px) for term in terms),
        strict=True,
    )
    return np.concatenate(found), np.concatenate(predicted)


def _start(terms: Sequence[_Term], *, free: Free) -> tuple[float, dict[Pair, float]]:
    """Return a scale and offsets from the matches alone."""
    if free == "scale":
        return voted_scale(*_joined(terms)), {}
    by_pair = {
        pair: _joined(term for term in terms if term.match.pair == pair)
        for pair in dict.fromkeys(term.match.pair for term in terms)
    }
    scale = 1.0
    if free == "both":
        most_matches = max(terms, key=lambda term: len(term.predicted_px)).match.pair
        scale = _drawn_scale(*by_pair[most_matches])
    return scale, {
        pair: _densest(found - scale * predicted) for pair, (found, predicted) in by_pair.items()
    }


def _agreement(found: Points, predicted: Points) -> float:
    """Return how many matches a prediction explains; a near one counts nearly 1."""
    away = (found - predicted) / _TOLERANCE_PX
    return float((1 / (1 + away * away)).sum())


def voted_scale(found: Points, predicted: Points) -> float:
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


def _drawn_scale(found: Points, predicted: Points) -> float:
    """Return the scale of the line, with any offset, on which most matches lie."""
    rng = np.random.default_rng(0)
    first, second = rng.integers(len(found), size=(2, _DRAWS))
    apart = predicted[first] - predicted[second]
    wide = np.abs(apart) > 0
    first, second, apart = first[wide], second[wide], apart[wide]
    scales = (found[first] - found[second]) / apart
    best, most = 1.0, -1.0
    few = rng.integers(len(found), size=min(len(found), 1500))
    for scale, anchor in zip(scales, first, strict=True):
        if scale > 0:
            shift = found[anchor] - scale * predicted[anchor]
            agree = _agreement(found[few], scale * predicted[few] + shift)
            best, most = (float(scale), agree) if agree > most else (best, most)
    return best


def _densest(values: Points) -> float:
    """Return where most values lie, to half a pixel or better."""
    places = np.round(values * 4)
    numbers, counts = np.unique(places, return_counts=True)
    tallest = numbers[counts.argsort()[-8:]] / 4
    best = max(tallest, key=lambda place: _agreement(values, np.full_like(values, place)))
    near = values[np.abs(values - best) < _TOLERANCE_PX]
    return float(np.median(near))


def _refined(
    views: SceneFrames,
    terms: Sequence[_Term],
    scale: float,
    offsets_px: dict[Pair, float],
    *,
    free: Free,
) -> tuple[float, dict[Pair, float], float]:
    """Return scale and offsets after Gauss-Newton steps, and the error of log(scale)."""
    pairs = list(dict.fromkeys(term.match.pair for term in terms))
    fits_scale = free in ("scale", "both")
    unknowns = [*(["scale"] if fits_scale else []), *(pairs if free in ("offset", "both") else [])]
    error = math.inf
    for _ in range(_STEPS):
        normals, rights = _equations(views, terms, scale, offsets_px, unknowns=unknowns)
        step, spread = _solved(normals, rights)
        limit = max(_moved_px(term, scale, step, unknowns) for term in terms)
        step *= min(1.0, _LARGEST_STEP_PX / max(limit, 1e-12))
        for name, change in zip(unknowns, step, strict=True):
            if isinstance(name, tuple):
                offsets_px = offsets_px | {name: offsets_px.get(name, 0.0) + float(change)}
            else:
                scale *= math.exp(float(np.clip(change, -0.3, 0.3)))
        if fits_scale:
            error = float(spread[0])
        if limit < 5e-3:
            break
    return scale, offsets_px, error


def _moved_px(term: _Term, scale: float, step: Points, unknowns: Sequence[object]) -> float:
    """Return how far a step moves a term's matches with large disparities."""
    of_unknown: dict[object, float] = {"scale": scale * term.large_px, term.match.pair: 1.0}
    changes = zip(unknowns, step.tolist(), strict=True)
    return float(abs(sum(of_unknown.get(name, 0.0) * change for name, change in changes)))


def _equations(
    views: SceneFrames,
    terms: Sequence[_Term],
    scale: float,
    offsets_px: dict[Pair, float],
    *,
    unknowns: Sequence[object],
) -> tuple[Float64[np.ndarray, "terms k k"], Float64[np.ndarray, "terms k"]]:
    """Return each frame match's normal equations for log(scale) and the pairs' offsets."""
    normals = np.zeros((len(terms), len(unknowns), len(unknowns)))
    rights = np.zeros((len(terms), len(unknowns)))
    for number, term in enumerate(terms):
        disparity_px = scale * term.predicted_px + term.match.shift_px(offsets_px)
        difference, slope, weight = _compared(views, term, disparity_px)
        if weight is None:
            continue
        # A frame match depends on the scale and on its own pair's offset.
        columns = {
            place: slope * scale * term.predicted_px if name == "scale" else term.sign * slope
            for place, name in enumerate(unknowns)
            if name in ("scale", term.match.pair)
        }
        _add_columns(normals[number], rights[number], columns, weight=weight, difference=difference)
    return normals, rights


def _compared(
    views: SceneFrames, term: _Term, disparity_px: Points
) -> tuple[Float32[np.ndarray, " n"], Float32[np.ndarray, " n"], Float64[np.ndarray, " n"] | None]:
    """Return right less left at a disparity, the mean slope of both, and each pixel's weight.

    The weight is robust, and 0 for pixels that leave the picture or whose match is elsewhere. It
    is None if too few pixels are left.
    """
    match = term.match
    there, slope, inside = sample_with_slope(
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


def _add_columns(
    normals: Float64[np.ndarray, "k k"],
    rights: Float64[np.ndarray, " k"],
    columns: Mapping[int, Points],
    *,
    weight: Points,
    difference: Float32[np.ndarray, " n"],
) -> None:
    """Fill in one frame match's weighted normal equations, from its derivatives by unknown."""
    for place, column in columns.items():
        rights[place] = (column * weight * difference).sum()
        for other, beside in columns.items():
            normals[place, other] = (column * weight * beside).sum()


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


_RAY_STEPS: Final = 5
_LARGEST_RAY_STEP: Final = 0.5
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

    @property
    def interval(self) -> tuple[float, float]:
        """The power and half its 95 % interval, its systematic error included."""
        return self.power, math.hypot(1.96 * self.error, _RAY_BIAS)


def ray_power(
    views: SceneFrames, matches: Sequence[FrameMatch], contract: ScoredContract
) -> RayPower:
    """Return the power that fits the pictures best, together with the scale and the offsets."""
    terms = _fit_terms(views, matches, contract.hypothesis)
    pairs = list(contract.offsets_px)
    log_scale, bend = math.log(contract.scale), 0.0
    offsets_px = dict(contract.offsets_px)
    error = math.inf
    for _ in range(_RAY_STEPS):
        normals = np.zeros((len(terms), 2 + len(pairs), 2 + len(pairs)))
        rights = np.zeros((len(terms), 2 + len(pairs)))
        for number, term in enumerate(terms):
            match = term.match
            log_ray = np.log(views.ray_per_planar[match.rows, match.columns])
            grown_px = term.predicted_px * np.exp(log_scale + bend * log_ray)
            difference, slope, weight = _compared(
                views, term, grown_px + match.shift_px(offsets_px)
            )
            if weight is None:
                continue
            columns = {0: slope * grown_px, 1: slope * grown_px * log_ray}
            if match.pair in offsets_px:
                columns[2 + pairs.index(match.pair)] = term.sign * slope
            _add_columns(
                normals[number], rights[number], columns, weight=weight, difference=difference
            )
        step, spread = _solved(normals, rights)
        log_scale += float(np.clip(step[0], -0.1, 0.1))
        bend += float(np.clip(step[1], -_LARGEST_RAY_STEP, _LARGEST_RAY_STEP))
        for pair, change in zip(pairs, step[2:], strict=True):
            offsets_px[pair] += float(np.clip(change, -1.0, 1.0))
        error = float(spread[1])
    return RayPower(bend + (contract.hypothesis.kind == "ray"), error)
