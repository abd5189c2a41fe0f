"""Six cameras in a row: how far apart, for each family of the release. Lengths are centimetres."""

from typing import Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.errors import SynthesisError
from stereogenbench_data.schema.release import CAMERA_COUNT, CAMERA_PAIRS

IPD_MEAN_CM: Final = 6.38
IPD_SD_CM: Final = 0.5
IPD_RANGE_CM: Final = (4.5, 8.5)
UNIFORM_RANGE_CM: Final = (1.0, 150.0)
PAIRWISE_RANGE_CM: Final = (5.0, 200.0)
FOCAL_RANGE_MM: Final = (18.0, 85.0)

_GAPS: Final = CAMERA_COUNT - 1
_SPAN_SCALE_CM: Final = 77.0
_PAIRWISE_SPAN_CM: Final = (180.0, 200.0)
_PAIRWISE_CANDIDATES: Final = 48

Gaps = Float64[np.ndarray, "5"]


def draw_gaps_cm(family: str, *, rng: np.random.Generator) -> Gaps:
    """Draw the five gaps between neighbouring cameras, from left to right.

    - ``IPD_Gaussian``: each from a normal (6.38, 0.5) cut to [4.5, 8.5] cm.
    - ``Uniform``: each from U[1, 150] cm; the rig is then kept with probability
      exp(-span / 77 cm), else drawn anew. It stands for the release's checks of collision,
      visibility and framing, which a wide rig fails more often: median, mean and standard
      deviation come out at 44, 53 and 39 cm, as in the release's train split (43, 53, 39).
    - ``Pairwise_Uniform``: of 48 rigs the one whose 15 distances spread most evenly over
      [5, 200] cm.

    Raises:
        SynthesisError: If the family is not one of these three.

    Source: the StereoGenBench paper, section 3 and its appendix on realised baselines.
    """
    if family == "IPD_Gaussian":
        return _truncated_normal(rng)
    if family == "Uniform":
        return _uniform_with_rejection(rng)
    if family == "Pairwise_Uniform":
        return _even_distances(rng)
    raise SynthesisError(
        f"family {family!r} has no rig: ask for IPD_Gaussian, Uniform or Pairwise_Uniform."
    )


def pair_distances_cm(gaps_cm: Gaps) -> Float64[np.ndarray, "15"]:
    """Return the distance of every pair of `CAMERA_PAIRS`, in that order."""
    places = lateral_places_cm(gaps_cm)
    left, right = np.array(CAMERA_PAIRS).T
    distances_cm: Float64[np.ndarray, 15] = places[right] - places[left]
    return distances_cm


def lateral_places_cm(gaps_cm: Gaps) -> Float64[np.ndarray, "6"]:
    """Return how far right of camera 0 each camera stands."""
    return np.concatenate([[0.0], np.cumsum(gaps_cm)])


def _truncated_normal(rng: np.random.Generator) -> Gaps:
    low, high = IPD_RANGE_CM
    kept = np.empty(0)
    while len(kept) < _GAPS:
        drawn = rng.normal(IPD_MEAN_CM, IPD_SD_CM, _GAPS)
        kept = np.concatenate([kept, drawn[(drawn >= low) & (drawn <= high)]])
    return kept[:_GAPS]


def _uniform_with_rejection(rng: np.random.Generator) -> Gaps:
    while True:
        gaps = rng.uniform(*UNIFORM_RANGE_CM, _GAPS)
        if rng.random() < np.exp(-gaps.sum() / _SPAN_SCALE_CM):
            return gaps


def _even_distances(rng: np.random.Generator) -> Gaps:
    """Keep the candidate whose sorted distances lie closest to evenly spaced ones."""
    low, high = PAIRWISE_RANGE_CM
    even = low + (high - low) * (np.arange(len(CAMERA_PAIRS)) + 0.5) / len(CAMERA_PAIRS)
    best, least = np.empty(0), np.inf
    for _ in range(_PAIRWISE_CANDIDATES):
        span = rng.uniform(*_PAIRWISE_SPAN_CM)
        free = rng.dirichlet(np.ones(_GAPS)) * (span - _GAPS * low)
        gaps = low + free
        deviation = float(np.abs(np.sort(pair_distances_cm(gaps)) - even).max())
        if deviation < least:
            best, least = gaps, deviation
    return best
