"""The six cameras of a synthetic scene: the gaps of their rig, and their poses.

World axes are Unreal's: left-handed, x forward, y right, z up. A rotator (pitch, yaw, roll) in
degrees turns camera axes (forward, right, up) into world axes by Rz(yaw) Ry(-pitch) Rx(-roll).
World axes differ from a map's by an offset, which affects only recorded poses.
"""

from typing import Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.errors import SynthesisError
from stereogenbench_data.geometry.pose import rotation_from_rotator_deg
from stereogenbench_data.schema.release import CAMERA_COUNT, CAMERA_PAIRS

OFFSET_RANGE_CM: Final = 1e6
FOCAL_RANGE_MM: Final = (18.0, 85.0)

_IPD_CM: Final = {"loc": 6.38, "scale": 0.5}
_IPD_RANGE_CM: Final = (4.5, 8.5)
_UNIFORM_RANGE_CM: Final = (1.0, 150.0)
_PAIRWISE_RANGE_CM: Final = (5.0, 200.0)
_PAIRWISE_SPAN_CM: Final = (180.0, 200.0)
_PAIRWISE_CANDIDATES: Final = 48
_GAPS: Final = CAMERA_COUNT - 1

Gaps = Float64[np.ndarray, "5"]
Vector = Float64[np.ndarray, "3"]


def random_gaps_cm(family: str, *, rng: np.random.Generator) -> Gaps:
    """Return five random gaps between neighbouring cameras, from left to right, in cm.

    - ``IPD_Gaussian``: each from a normal (6.38, 0.5) truncated to [4.5, 8.5] cm.
    - ``Uniform``: each from U[1, 150] cm, with median 75.5 cm. Wide rigs fail the filters more
      often, so the gaps of accepted scenes are smaller; in the release's train split their median
      is 43 cm.
    - ``Pairwise_Uniform``: of 48 rigs the one whose 15 sorted distances are closest to evenly
      spaced ones in [5, 200] cm.

    Raises:
        SynthesisError: If the family is not one of these three.

    Source: the StereoGenBench paper, section 3 and its appendix on realised baselines.
    """
    if family == "IPD_Gaussian":
        low, high = _IPD_RANGE_CM
        kept = np.empty(0)
        while len(kept) < _GAPS:
            sampled = rng.normal(**_IPD_CM, size=_GAPS)
            kept = np.concatenate([kept, sampled[(sampled >= low) & (sampled <= high)]])
        return kept[:_GAPS]
    if family == "Uniform":
        return rng.uniform(*_UNIFORM_RANGE_CM, _GAPS)
    if family == "Pairwise_Uniform":
        low, high = _PAIRWISE_RANGE_CM
        even = low + (high - low) * (np.arange(len(CAMERA_PAIRS)) + 0.5) / len(CAMERA_PAIRS)
        rigs = []
        for _ in range(_PAIRWISE_CANDIDATES):
            span = rng.uniform(*_PAIRWISE_SPAN_CM)
            rigs.append(low + rng.dirichlet(np.ones(_GAPS)) * (span - _GAPS * low))
        return min(rigs, key=lambda gaps: np.abs(np.sort(pair_distances_cm(gaps)) - even).max())
    raise SynthesisError(
        f"family {family!r} is unknown: choose IPD_Gaussian, Uniform or Pairwise_Uniform."
    )


def pair_distances_cm(gaps_cm: Gaps) -> Float64[np.ndarray, "15"]:
    """Return the distance of every pair of `CAMERA_PAIRS`, in that order."""
    places = lateral_places_cm(gaps_cm)
    left, right = np.array(CAMERA_PAIRS).T
    distances_cm: Float64[np.ndarray, 15] = places[right] - places[left]
    return distances_cm


def lateral_places_cm(gaps_cm: Gaps) -> Float64[np.ndarray, "6"]:
    """Return the distance in cm of each camera to the right of camera 0."""
    return np.concatenate([[0.0], np.cumsum(gaps_cm)])


def quaternion_from_rotator(rotator_deg: Vector) -> Float64[np.ndarray, "4"]:
    """Return the unit quaternion x, y, z, w of a rotator."""
    half = np.radians(rotator_deg) / 2
    (sp, sy, sr), (cp, cy, cr) = np.sin(half), np.cos(half)
    x, y = cr * sp * sy - sr * cp * cy, -cr * sp * cy - sr * cp * sy
    z, w = cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy
    return np.array([x, y, z, w])


def rig_locations_cm(
    *,
    centre_cm: Vector,
    rotator_deg: Vector,
    places_cm: Float64[np.ndarray, "6"],
    offset_cm: Vector,
) -> Float64[np.ndarray, "6 3"]:
    """Return the six camera centres, along the rig's right axis around its middle.

    The world's offset is added last, so the error of distances between centres is at most the
    rounding of a coordinate of that size (1.2e-10 cm at 1e6 cm).
    """
    right = rotation_from_rotator_deg(rotator_deg)[:, 1]
    lateral_cm = places_cm - places_cm[CAMERA_COUNT - 1] / 2
    near_cm = centre_cm + lateral_cm[:, None] * right
    centres_cm: Float64[np.ndarray, "6 3"] = near_cm + offset_cm
    return centres_cm
