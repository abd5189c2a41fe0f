"""The six cameras of a synthetic scene: their gaps, the path of their rig, their poses.

World axes are Unreal's: left-handed, x forward, y right, z up. A rotator (pitch, yaw, roll) in
degrees turns camera axes (forward, right, up) into world axes by Rz(yaw) Ry(-pitch) Rx(-roll).
Scene axes have their own origin and heading: the subject is at (0, 0) and the cameras are at
negative x, in metres. World axes differ from them by an offset and a yaw, which affect only poses.
"""

from dataclasses import dataclass
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
_UNIFORM_SPAN_CM: Final = 77.0
_PAIRWISE_RANGE_CM: Final = (5.0, 200.0)
_PAIRWISE_SPAN_CM: Final = (180.0, 200.0)
_PAIRWISE_CANDIDATES: Final = 48
_GAPS: Final = CAMERA_COUNT - 1
_LOOK_HEIGHT_M: Final = 0.95

Gaps = Float64[np.ndarray, "5"]
Vector = Float64[np.ndarray, "3"]


def random_gaps_cm(family: str, *, rng: np.random.Generator) -> Gaps:
    """Return five random gaps between neighbouring cameras, from left to right, in cm.

    - ``IPD_Gaussian``: each from a normal (6.38, 0.5) truncated to [4.5, 8.5] cm.
    - ``Uniform``: each from U[1, 150] cm; the rig is then kept with probability
      exp(-span / 77 cm), else sampled again. The rejection stands for the release's checks of
      collision, visibility and framing, which wide rigs fail more often. Median, mean and standard
      deviation are 44, 53 and 39 cm; in the release's train split they are 43, 53 and 39.
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
        while True:
            gaps = rng.uniform(*_UNIFORM_RANGE_CM, _GAPS)
            if rng.random() < np.exp(-gaps.sum() / _UNIFORM_SPAN_CM):
                return gaps
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


@dataclass(frozen=True, slots=True, eq=False)
class CameraPath:
    """The position and the direction of the middle of the rig at any time.

    Attributes:
        distance_m: Distance between the rig and the middle of the subject's walk.
        amplitudes: Amplitudes of six oscillations: azimuth (deg), distance (fraction of it),
            height (m), roll (deg), and the look-at point to the side (m) and upwards (m).
        periods_s: Period of each oscillation.
        phases: Phase of each oscillation, in radians.
        height_m: Mean height above the subject's feet.
        follow_m_s: Speed of the look-at point to the right, after the subject.
    """

    distance_m: float
    amplitudes: Float64[np.ndarray, "6"]
    periods_s: Float64[np.ndarray, "6"]
    phases: Float64[np.ndarray, "6"]
    height_m: float
    follow_m_s: float

    def rotator_deg(self, moment_s: float) -> Vector:
        """Return pitch, yaw and roll in scene axes."""
        _, _, _, roll_deg, aside_m, up_m = self._oscillations(moment_s)
        target = np.array([0.0, aside_m + self.follow_m_s * moment_s, _LOOK_HEIGHT_M + up_m])
        x, y, z = target - self.centre_m(moment_s)
        return np.array([*np.degrees([np.arctan2(z, np.hypot(x, y)), np.arctan2(y, x)]), roll_deg])

    def centre_m(self, moment_s: float) -> Vector:
        """Return the middle of the rig in scene axes."""
        azimuth_deg, stretch, up_m, *_ = self._oscillations(moment_s)
        azimuth, distance_m = np.radians(azimuth_deg), self.distance_m * (1 + stretch)
        x_m, y_m = -distance_m * np.cos(azimuth), distance_m * np.sin(azimuth)
        return np.array([x_m, y_m, self.height_m + up_m])

    def _oscillations(self, moment_s: float) -> Float64[np.ndarray, "6"]:
        angles = 2 * np.pi * moment_s / self.periods_s + self.phases
        values: Float64[np.ndarray, 6] = self.amplitudes * np.sin(angles)
        return values


def random_path(rng: np.random.Generator, *, distance_m: float, follow_m_s: float) -> CameraPath:
    """Return a random path that varies yaw, pitch and roll and keeps the subject in the picture."""
    largest = np.array([9.0, 0.05, 0.035 * distance_m, 3.5, 0.03 * distance_m, 0.02 * distance_m])
    return CameraPath(
        distance_m=distance_m,
        amplitudes=largest * rng.uniform(0.6, 1.0, 6),
        periods_s=rng.uniform(4.0, 9.0, 6),
        phases=rng.uniform(0, 2 * np.pi, 6),
        height_m=_LOOK_HEIGHT_M + distance_m * rng.uniform(0.08, 0.15),
        follow_m_s=follow_m_s,
    )


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
