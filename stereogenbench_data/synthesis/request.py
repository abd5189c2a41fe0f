"""A request for synthetic scenes: which scenes, and how their files are written."""

import math
from dataclasses import dataclass, field
from typing import Final, Literal, get_args

from stereogenbench_data.errors import SynthesisError
from stereogenbench_data.schema.release import (
    FAMILIES,
    FRAME_COUNT,
    IMAGE_SIZE_PX,
    SEEN_MAP_FOLDER,
    Split,
    Subset,
)
from stereogenbench_data.selection.spelling import did_you_mean

RotationForm = Literal["rotator", "quaternion_xyzw", "quaternion_wxyz", "matrix"]

SENSOR_MM: Final = (23.76, 23.76)
"""Width and height of the sensor, where a renderer has no others."""
LARGEST_UNITS: Final = 65535
"""The largest number of stored depth, which means "no depth"."""
_UNSEEN_MAP_FOLDER: Final = "MapUnseenInTrain"
_LARGEST_PX: Final = 8192
_FOCAL_RANGE_MM: Final = (4.0, 1000.0)
"""Shorter lenses see 140 degrees and more; longer ones frame a subject beyond the depth's range."""
_UNIT_RANGE_M: Final = (1 / LARGEST_UNITS, 1.0)
"""The smallest unit reaches to 1 m in 16 bits."""


@dataclass(frozen=True, slots=True)
class ExportContract:
    """How the files of scenes are written. The defaults are as in a scene rendered elsewhere.

    Attributes:
        rotation: How ``trajectory.json`` records rotations.
        depth_unit_m: Metres in one stored unit of depth, at most 1; such that 16 bits reach to
            1 m at least. Farther depth, and the sky, are stored as 65535, "no depth".
        depth_tag: Container tag for the unit; None writes no tag.

    Raises:
        SynthesisError: If a value is unknown or out of range.
    """

    rotation: RotationForm = "rotator"
    depth_unit_m: float = 0.001
    depth_tag: str | None = "DEPTH_SCALE"

    def __post_init__(self) -> None:
        """Refuse values that cannot be written."""
        _require_choice("rotation", self.rotation, choices=get_args(RotationForm))
        _require_range("depth_unit_m", self.depth_unit_m, *_UNIT_RANGE_M)


@dataclass(frozen=True, slots=True)
class SynthRequest:
    """The scenes to render. Scene i does not depend on the number of scenes.

    Attributes:
        family: ``IPD_Gaussian``, ``Uniform`` or ``Pairwise_Uniform`` (in train only).
        scenes: The number of scenes, which are numbered from 0.
        size_px: Width of the pictures, even; ``height_px`` is the same where it is None.
        frames: The number of frames, at 15 Hz.
        seed: Determines all random choices, together with a scene's number and folder.
        split: ``train`` or ``eval``, of which ``subset`` says the kind of maps.
        map_name: The map of the scenes, which names their folder; or several, of which each
            proposal draws one.
        focal_mm: The focal length, 4 to 1,000; None for a random one in 18..85 mm per scene.
        contract: How the files are written.

    Raises:
        SynthesisError: If a value is unknown or out of range.
    """

    family: str = "IPD_Gaussian"
    scenes: int = 1
    size_px: int = IMAGE_SIZE_PX
    height_px: int | None = None
    frames: int = FRAME_COUNT
    seed: int = 0
    split: Split = "train"
    subset: Subset = "seen_map"
    map_name: str | tuple[str, ...] = "SynthStage"
    focal_mm: float | None = None
    contract: ExportContract = field(default_factory=ExportContract)

    def __post_init__(self) -> None:
        """Refuse values that no scene can have."""
        _require_choice("family", self.family, choices=FAMILIES)
        _require_choice("split", self.split, choices=get_args(Split))
        _require_choice("subset", self.subset, choices=get_args(Subset))
        _require_split(self)
        _require_range("scenes", self.scenes, 1, math.inf)
        _require_range("frames", self.frames, 1, math.inf)
        _require_range("seed", self.seed, 0, math.inf)
        for name, value in zip(("size_px", "height_px"), self.picture_px, strict=True):
            _require_range(name, value, 2, _LARGEST_PX)
            if value % 2:
                raise SynthesisError(
                    f"{name} must be even (yuv420p halves the colour), got {value}."
                )
        _require_maps(self.maps)
        if self.focal_mm is not None:
            _require_range("focal_mm", self.focal_mm, *_FOCAL_RANGE_MM)

    @property
    def picture_px(self) -> tuple[int, int]:
        """Width and height of the pictures."""
        return self.size_px, self.size_px if self.height_px is None else self.height_px

    @property
    def maps(self) -> tuple[str, ...]:
        """The maps that proposals draw from."""
        return (self.map_name,) if isinstance(self.map_name, str) else self.map_name

    @property
    def stream(self) -> str:
        """What tells the random numbers of this request from others of the same seed."""
        return self.folder("+".join(self.maps))

    def folder(self, map_name: str) -> str:
        """Return the folder of a map's scenes below the root, with forward slashes."""
        if self.split == "train":
            return f"train/{self.family}/{map_name}"
        subset = SEEN_MAP_FOLDER if self.subset == "seen_map" else _UNSEEN_MAP_FOLDER
        return f"eval/{subset}/{self.family}/{map_name}"

    def key(self, index: int, *, map_name: str | None = None) -> str:
        """Return the key of a scene, its whole path below the root; by default in the first map."""
        return f"{self.folder(map_name or self.maps[0])}/scene_{index:06d}"


def _require_split(request: SynthRequest) -> None:
    if request.split == "eval" and request.family == "Pairwise_Uniform":
        raise SynthesisError(
            "family Pairwise_Uniform exists only in train: choose split train, or family "
            "IPD_Gaussian or Uniform."
        )
    if request.split == "train" and request.subset == "unseen_map":
        raise SynthesisError(
            "subset unseen_map is of maps that train does not have: choose split eval, or leave "
            "out the subset."
        )


def _require_maps(names: tuple[str, ...]) -> None:
    for name in names or ("",):
        if not (name.isascii() and name.replace("_", "").isalnum()):
            raise SynthesisError(f"map_name must be letters, digits and underscores, got {name!r}.")
    if len(set(names)) < len(names):
        raise SynthesisError(f"map_name has a map twice: {', '.join(names)}.")


def _require_choice(name: str, value: object, *, choices: tuple[object, ...]) -> None:
    if value not in choices:
        hint = did_you_mean(str(value), map(str, choices))
        raise SynthesisError(
            f"{name} must be one of {', '.join(map(str, choices))}, got {value!r}{hint}"
        )


def _require_range(name: str, value: float, least: float, most: float) -> None:
    if not least <= value <= most:
        raise SynthesisError(f"{name} must be from {least:.6g} to {most:.6g}, got {value!r}.")
