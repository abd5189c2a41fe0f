"""A proposal: everything about a scene that is drawn at random before a filter has looked at it.

Proposal n of scene i has a random stream of its own, which follows from the request's seed and
folder, i and n alone. So a proposal is the same wherever and whenever it is drawn.
"""

import zlib
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.synthesis.cameras import (
    FOCAL_RANGE_MM,
    lateral_places_cm,
    random_gaps_cm,
)
from stereogenbench_data.synthesis.request import SynthRequest

_FIRST_LABEL: Final = 1000
_PARTS: Final = ("draw", "map", "spawn", "path")


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
    def label_number(self) -> int:
        """The number in the scene's label, which differs from that of its folder."""
        return _FIRST_LABEL + self.index

    @property
    def label(self) -> str:
        """The scene's label."""
        return f"{self.map_name}_scene_{self.label_number}"

    @property
    def focal_px(self) -> tuple[float, float]:
        """Focal lengths along the picture's width and height."""
        width_px, height_px = self.request.picture_px
        width_mm, height_mm = self.sensor_mm
        return self.focal_mm / width_mm * width_px, self.focal_mm / height_mm * height_px

    @property
    def picture_at_1m(self) -> tuple[float, float]:
        """Width and height in metres of what a camera sees one metre away."""
        return self.sensor_mm[0] / self.focal_mm, self.sensor_mm[1] / self.focal_mm

    @property
    def span_m(self) -> float:
        """The distance from the first camera to the last."""
        return float(self.places_cm[-1]) / 100

    def rng(self, part: str) -> np.random.Generator:
        """Return the random stream of a part: "map", "spawn" or "path"."""
        return _rng(self.request, index=self.index, number=self.number, part=part)


def draw_proposal(
    request: SynthRequest,
    *,
    index: int,
    number: int,
    characters: tuple[str, ...],
    animations: tuple[str, ...],
    sensors_mm: tuple[tuple[float, float], ...],
) -> Proposal:
    """Draw a proposal.

    Args:
        request: The scenes; its maps are drawn from with equal probability.
        index: The scene's number.
        number: The proposal's number.
        characters: Subjects to draw from.
        animations: Motions to draw from.
        sensors_mm: Sensors to draw from.
    """
    rng = _rng(request, index=index, number=number, part="draw")
    places_cm = lateral_places_cm(random_gaps_cm(request.family, rng=rng))
    focal_mm = float(rng.uniform(*FOCAL_RANGE_MM))
    return Proposal(
        request=request,
        index=index,
        number=number,
        map_name=request.maps[int(rng.integers(len(request.maps)))],
        character=characters[int(rng.integers(len(characters)))],
        animation=animations[int(rng.integers(len(animations)))],
        sensor_mm=sensors_mm[int(rng.integers(len(sensors_mm)))],
        focal_mm=focal_mm if request.focal_mm is None else request.focal_mm,
        places_cm=places_cm,
        offset_cm=rng.uniform(-1, 1, 3) * request.world_offset_cm,
    )


def _rng(request: SynthRequest, *, index: int, number: int, part: str) -> np.random.Generator:
    entropy = (request.seed, zlib.crc32(request.stream.encode()), index, number)
    return np.random.default_rng(np.random.SeedSequence((*entropy, _PARTS.index(part))))
