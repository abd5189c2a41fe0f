"""A proposal: everything about a scene that is drawn at random before a filter has looked at it.

Proposal n of scene i has a random stream of its own, which follows from the request's seed and
folder, i and n alone. So a proposal is the same wherever and whenever it is drawn.
"""

import zlib
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.schema.release import CAMERA_COUNT, CAMERA_PAIRS
from stereogenbench_data.synthesis.request import SynthRequest

_PARTS: Final = ("draw", "map", "spawn", "path")
_IPD_CM: Final = {"loc": 6.38, "scale": 0.5}
_IPD_RANGE_CM: Final = (4.5, 8.5)
_UNIFORM_RANGE_CM: Final = (1.0, 150.0)
_PAIRWISE_RANGE_CM: Final = (5.0, 200.0)
_PAIRWISE_SPAN_CM: Final = (180.0, 200.0)
_PAIRWISE_CANDIDATES: Final = 48
_GAPS: Final = CAMERA_COUNT - 1

Gaps = Float64[np.ndarray, "5"]


def random_gaps_cm(family: str, *, rng: np.random.Generator) -> Gaps:
    """Return five random gaps between neighbouring cameras, from left to right, in cm.

    - ``IPD_Gaussian``: each from a normal (6.38, 0.5) truncated to [4.5, 8.5] cm.
    - ``Uniform``: each from U[1, 150] cm, with median 75.5 cm. Wide rigs fail the filters more
      often, so the gaps of accepted scenes are smaller; in the release's train split their median
      is 43 cm.
    - ``Pairwise_Uniform``: of 48 rigs the one whose 15 sorted distances are closest to evenly
      spaced ones in [5, 200] cm.

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
    low, high = _PAIRWISE_RANGE_CM
    even = low + (high - low) * (np.arange(len(CAMERA_PAIRS)) + 0.5) / len(CAMERA_PAIRS)
    rigs = []
    for _ in range(_PAIRWISE_CANDIDATES):
        span = rng.uniform(*_PAIRWISE_SPAN_CM)
        rigs.append(low + rng.dirichlet(np.ones(_GAPS)) * (span - _GAPS * low))
    return min(rigs, key=lambda gaps: np.abs(np.sort(pair_distances_cm(gaps)) - even).max())


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
class Rig:
    """Six cameras side by side.

    Attributes:
        lateral_m: The distance of each camera to the right of the rig's middle.
        picture_at_1m: Width and height of what a camera sees one metre away, around its axis.
    """

    lateral_m: Float64[np.ndarray, "6"]
    picture_at_1m: tuple[float, float]

    def eyes(
        self, centres_m: Float64[np.ndarray, "n 3"], axes: Float64[np.ndarray, "n 3 3"]
    ) -> Float64[np.ndarray, "n 6 3"]:
        """Return the six camera centres of poses."""
        eyes: Float64[np.ndarray, "n 6 3"] = (
            centres_m[:, None] + self.lateral_m[:, None] * axes[:, None, :, 1]
        )
        return eyes


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """One proposal of one scene.

    Attributes:
        index: The scene's number.
        number: The proposal's number among those of the scene, from 0.
        map_name: The map.
        character: Name of the subject.
        animation: Name of its motion.
        sensor_mm: Width and height of the sensor.
        focal_mm: The focal length of all six cameras.
        places_cm: The distance of each camera to the right of camera 0.
        offset_cm: Where the map's origin lies in the recorded world.
    """

    request: SynthRequest
    index: int
    number: int
    map_name: str
    character: str
    animation: str
    sensor_mm: tuple[float, float]
    focal_mm: float
    places_cm: Float64[np.ndarray, "6"]
    offset_cm: Float64[np.ndarray, "3"]

    @property
    def key(self) -> str:
        """The scene's whole path below the root."""
        return self.request.key(self.index, map_name=self.map_name)

    @property
    def focal_px(self) -> tuple[float, float]:
        """Focal lengths along the picture's width and height."""
        width_px, height_px = self.request.picture_px
        width_mm, height_mm = self.sensor_mm
        return self.focal_mm / width_mm * width_px, self.focal_mm / height_mm * height_px

    @property
    def rig(self) -> Rig:
        """The six cameras, as filters and paths need them."""
        width_mm, height_mm = self.sensor_mm
        return Rig(
            (self.places_cm - self.places_cm[-1] / 2) / 100,
            (width_mm / self.focal_mm, height_mm / self.focal_mm),
        )

    @property
    def span_m(self) -> float:
        """The distance from the first camera to the last."""
        return float(self.places_cm[-1]) / 100

    def rng(self, part: str) -> np.random.Generator:
        """Return the random stream of a part: "map", "spawn" or "path"."""
        return random_stream(self.request, index=self.index, number=self.number, part=part)


def random_stream(
    request: SynthRequest, *, index: int, number: int, part: str
) -> np.random.Generator:
    """Return the random stream of a part of a proposal: "draw", "map", "spawn" or "path"."""
    entropy = (request.seed, zlib.crc32(request.stream.encode()), index, number)
    return np.random.default_rng(np.random.SeedSequence((*entropy, _PARTS.index(part))))
