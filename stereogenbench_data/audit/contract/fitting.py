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
    Free,
    Pair,
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
_LARGEST_BENT: Final[dict[object, float]] = {"scale": 0.1, "ray": 0.5}
"""Largest steps while the power of the ray is fitted, which moves wide disparities far."""
_FEWEST_USABLE: Final = 10
_NEAR_PX: Final = 3 * _TOLERANCE_PX
"""Matches further from the prediction are not used to refine it."""


@dataclass(frozen=True, slots=True, eq=False)
class _Term:
    """The pixels of a frame match where depth is known, and the disparity predicted there.

    ``log_ray`` is the logarithm of each ray's length to depth 1, ``large_px`` the 90th percentile
    of the predicted disparities' size. ``sign`` is 1 if the pixels are those of the file with the
    lower number, from which offsets are counted, else -1.
    """

    match: FrameMatch
    predicted_px: Points
    log_ray: Points
    large_px: float
    sign: int


@dataclass(frozen=True, slots=True)
class _Lengths:
    """What is fitted: disparity is scale * predicted * ray ** bend, and an offset for each pair."""

    scale: float
    offsets_px: dict[Pair, float]
    bend: float = 0.0


_Unknown = Literal["scale", "ray"] | Pair


def fit_hypothesis(
    views: SceneFrames, matches: Sequence[FrameMatch], hypothesis: Hypothesis, *, free: Free
) -> ScoredContract:
    """Return a hypothesis with the scale and the offsets that explain the pictures best."""
    terms = _fit_terms(views, matches, hypothesis) if free else []
    if not terms:
        return score_hypothesis(views, matches, hypothesis)
    unknowns: list[_Unknown] = ["scale"] if "scale" in free else []
    unknowns += _pairs(terms) if "offset" in free else []
    lengths, errors = _refined(views, terms, _start(terms, free=free), unknowns)
    return score_hypothesis(
        views, matches, hypothesis, scale=lengths.scale, offsets_px=lengths.offsets_px,
        scale_error=errors.get("scale", math.inf),
    )  # fmt: skip


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
            large_px = float(np.percentile(np.abs(predicted_px), 90))
            sign = 1 if match.left < match.right else -1
            terms.append(_Term(known, predicted_px, log_ray, large_px, sign))
    return terms


def _pairs(terms: Iterable[_Term]) -> list[Pair]:
    return list(dict.fromkeys(term.match.pair for term in terms))


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
    """Return the disparities found and predicted, counted from the files with the lower number."""
    found, predicted = zip(
        *((term.sign * term.match.matched_px, term.sign * term.predicted_px) for term in terms),
        strict=True,
    )
    return np.concatenate(found), np.concatenate(predicted)


def _start(terms: Sequence[_Term], *, free: Free) -> _Lengths:
    """Return a scale and offsets from the matches alone."""
    scale = _voted_scale(*_joined(terms)) if "scale" in free else 1.0
    offsets_px = {}
    for pair in _pairs(terms) if "offset" in free else ():
        found, predicted = _joined(term for term in terms if term.match.pair == pair)
        offsets_px[pair] = _densest(found - scale * predicted)
    return _Lengths(scale, offsets_px)


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


def _densest(values: Points) -> float:
    """Return where most values lie, to half a pixel or better."""
    places = np.round(values * 4)
    numbers, counts = np.unique(places, return_counts=True)
    tallest = numbers[counts.argsort()[-8:]] / 4
    best = max(tallest, key=lambda place: _agreement(values, np.full_like(values, place)))
    near = values[np.abs(values - best) < _TOLERANCE_PX]
    return float(np.median(near))


def _refined(
    views: SceneFrames, terms: Sequence[_Term], lengths: _Lengths, unknowns: Sequence[_Unknown]
) -> tuple[_Lengths, dict[_Unknown, float]]:
    """Return the lengths after Gauss-Newton steps, and the errors of log(scale), bend, offsets."""
    errors: dict[_Unknown, float] = {}
    is_bent = "ray" in unknowns
    for _ in range(_STEPS):
        normals = np.zeros((len(terms), len(unknowns), len(unknowns)))
        rights = np.zeros((len(terms), len(unknowns)))
        for number, term in enumerate(terms):
            grown_px = lengths.scale * term.predicted_px * np.exp(lengths.bend * term.log_ray)
            shift_px = term.match.shift_px(lengths.offsets_px)
            difference, slope, weight = _compared(views, term, grown_px + shift_px)
            if weight is not None:
                moved: dict[_Unknown, Points] = {"scale": grown_px, "ray": grown_px * term.log_ray,
                         term.match.pair: np.full(len(slope), term.sign)}  # fmt: skip
                columns = np.stack([
                    slope * moved.get(name, np.zeros(len(slope))) for name in unknowns
                ])  # fmt: skip
                normals[number] = (columns * weight) @ columns.T
                rights[number] = (columns * weight) @ difference
        step, spread = _solved(normals, rights)
        errors = dict(zip(unknowns, spread.tolist(), strict=True))
        changes = dict(zip(unknowns, step.tolist(), strict=True))
        moves_px = (_moved_px(term, lengths.scale, changes) for term in terms)
        moved_px = max(moves_px, default=0.0)
        part = 1.0 if is_bent else min(1.0, _LARGEST_STEP_PX / max(moved_px, 1e-12))
        largest: dict[object, float] = _LARGEST_BENT if is_bent else {"scale": 0.3}
        offsets_px = dict(lengths.offsets_px)
        for name, change in changes.items():
            most = largest.get(name, _LARGEST_STEP_PX if is_bent else math.inf)
            changes[name] = float(np.clip(part * change, -most, most))
            if isinstance(name, tuple):
                offsets_px[name] = offsets_px.get(name, 0.0) + changes[name]
        scale = lengths.scale * math.exp(changes.get("scale", 0.0))
        lengths = _Lengths(scale, offsets_px, lengths.bend + changes.get("ray", 0.0))
        if moved_px < 5e-3:
            break
    return lengths, errors


def _moved_px(term: _Term, scale: float, changes: Mapping[_Unknown, float]) -> float:
    """Return how far a step moves a term's matches with large disparities."""
    ray = float(term.log_ray.max()) * changes.get("ray", 0.0)
    grown_px = scale * term.large_px * (changes.get("scale", 0.0) + ray)
    return abs(grown_px + changes.get(term.match.pair, 0.0))


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

    @property
    def interval(self) -> tuple[float, float]:
        """The power and half its 95 % interval, its systematic error included."""
        return self.power, math.hypot(1.96 * self.error, _RAY_BIAS)


def ray_power(
    views: SceneFrames, matches: Sequence[FrameMatch], contract: ScoredContract
) -> RayPower:
    """Return the power that fits the pictures best, together with the scale and the offsets."""
    terms = _fit_terms(views, matches, contract.hypothesis)
    start = _Lengths(contract.scale, contract.offsets_px)
    fitted, errors = _refined(views, terms, start, ["scale", "ray", *contract.offsets_px])
    return RayPower(fitted.bend + (contract.hypothesis.kind == "ray"), errors["ray"])
