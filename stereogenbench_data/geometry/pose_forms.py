"""How a trajectory's numbers may be read as poses: one list of forms.

A file names its form by keys (``pitch``, ``qw``, ``world_to_camera``) and by texts
(``rotation_representation``). That is a hint: `readings` yields what fits the hints first, then the
others, and `index.evidence` keeps those that the rig's geometry confirms. All become poses in
Unreal's axes: left-handed, x forward, y right, z up; a right-handed world is mirrored as a whole,
cameras with it, so that no picture is.
"""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.errors import GeometryError
from stereogenbench_data.geometry.pose import (
    nearest_rotation,
    rotation_from_quaternion_xyzw,
    rotation_from_rotator_deg,
)
from stereogenbench_data.schema.quantities import UNITS_M
from stereogenbench_data.schema.records import Trajectory
from stereogenbench_data.schema.trajectory import Block, RecordedPoses

TOLERANCE: Final = 1e-3
"""How far a quaternion's norm may be from 1, and a matrix from orthonormal."""

_LOCATION: Final = {
    "location", "position", "translation", "loc", "pos", "center", "centre", "origin", "t",
    "trans", "xyz",
}  # fmt: skip
_ROTATION: Final = {
    "rotation", "rotator", "orientation", "euler", "quaternion", "quat", "rot", "q", "r",
    "angles", "rotmat", "matrix",
}  # fmt: skip
_NO_POSE: Final = {
    "scale", "scale3d", "velocity", "forward", "up", "right", "target", "lookat", "color",
}  # fmt: skip

AXES: Final[dict[str, tuple[tuple[int, int], ...]]] = {
    "unreal": ((0, 1), (1, 1), (2, 1)),
    "opencv": ((2, 1), (0, 1), (1, -1)),
    "opengl": ((2, -1), (0, 1), (1, 1)),
    "ros": ((0, 1), (1, -1), (2, 1)),
}
"""Of which columns of a camera's rotation, with which sign, are forward, right and up. Blender's
cameras are those of OpenGL."""

_ALIASES: Final = {
    "blender": "opengl", "gl": "opengl", "nerf": "opengl", "cv": "opencv", "colmap": "opencv",
    "ue": "unreal", "ue4": "unreal", "ue5": "unreal", "rotator": "unreal",
}  # fmt: skip
_FROM_CAMERA: Final = ("c2w", "camera_to_world", "cam_to_world", "world_from_cam", "cam2world",
                       "camera2world", "matrix_world", "world_from_camera")  # fmt: skip
_FROM_WORLD: Final = ("w2c", "world_to_camera", "world_to_cam", "cam_from_world", "world2cam",
                      "world2camera", "extrinsic", "camera_from_world", "view_matrix")  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """Poses as one form reads them.

    Attributes:
        name: What the form is, for people and for the index.
        tier: 0 if it is what the file names, 1 if it fits what it names, 2 for the other forms.
        trajectory: The poses, with the unit that the file states, else nan metres.
    """

    name: str
    tier: int
    trajectory: Trajectory


def readings(
    recorded: RecordedPoses,
    *,
    only: str | None = None,
    named: Callable[[str], bool] | None = None,
) -> Iterator[Reading]:
    """Yield the readings of recorded numbers, those that the file names first.

    Args:
        recorded: The numbers.
        only: The name of the one reading that is wanted.
        named: Returns whether conventions name a reading; these then stand for the file's own.
    """
    found = [
        (each.tier if named is None else 0 if named(each.name) else max(1, each.tier), each)
        for each in _all_readings(recorded, named)
    ]
    for tier, each in sorted(found, key=lambda pair: pair[0]):
        if only is None or each.name == only:
            made = each.make()
            if made is not None:
                yield Reading(each.name, tier, made)


@dataclass(frozen=True, slots=True, eq=False)
class _Form:
    """A location and a rotation, or a matrix, and how it is read."""

    name: str
    tier: int
    turn: Block
    place: Block | None
    kind: str
    axes: str
    unit_m: float

    def make(self) -> Trajectory | None:
        """Return the poses, None where the numbers are no rotations of this form."""
        try:
            turns, centres = self._read()
        except GeometryError:
            return None
        if not (np.isfinite(turns).all() and np.isfinite(centres).all()):
            return None
        if self.axes == "unreal" and self.kind.startswith("rotator pitch yaw roll deg"):
            return Trajectory(_frozen(centres), self.unit_m, _frozen(turns), "rotator_deg")
        if self.axes == "unreal" and self.kind.startswith("quaternion"):
            return Trajectory(_frozen(centres), self.unit_m, _frozen(turns), "quaternion_xyzw")
        if self.kind.startswith("rotator"):
            turns = rotation_from_rotator_deg(turns)
        elif self.kind.startswith("quaternion"):
            turns = rotation_from_quaternion_xyzw(turns)
        columns = [sign * turns[..., :, column] for column, sign in AXES[self.axes]]
        matrices = np.stack(columns, axis=-1)
        if np.linalg.det(matrices).flat[0] < 0:
            # The world has the other hand: all of it is mirrored, the cameras too.
            matrices = matrices * np.array([1.0, -1.0, 1.0])[:, None]
            centres = centres * np.array([1.0, -1.0, 1.0])
        if (np.linalg.det(matrices) < 0).any():
            return None
        return Trajectory(_frozen(centres), self.unit_m, _frozen(matrices), "matrix")

    def _read(self) -> tuple[np.ndarray, np.ndarray]:
        """Return rotations as they are written, in degrees or normalised, and centres."""
        if self.kind.startswith("matrix"):
            return _of_matrices(self.turn.values, self.kind.split(), self.place)
        values, names = self.turn.values, self.kind.split()
        if names[0] == "quaternion":
            order = [1, 2, 3, 0] if names[1] == "wxyz" else [0, 1, 2, 3]
            return _unit_quaternions(values[..., order]), _centres(self.place)
        if not self.turn.components:
            values = values[..., [names.index(each) - 1 for each in ("pitch", "yaw", "roll")]]
        degrees = np.rad2deg(values) if "rad" in names else values
        if not np.abs(degrees).max(initial=0) <= _MOST_TURNS_DEG:
            raise GeometryError("no angles")
        return degrees, _centres(self.place)


def _of_matrices(
    values: np.ndarray, names: list[str], place: Block | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return world-from-camera rotations, or reflections, and centres of recorded matrices."""
    sides = {16: (4, 4), 12: (3, 4), 9: (3, 3)}.get(values.shape[-1])
    if values.ndim == 3 and sides is not None:
        values = values.reshape(*values.shape[:-1], *sides)
    if "rows" in names:  # vectors are rows: the transpose
        values = np.swapaxes(values, -1, -2)
    turns = _rotations(values[..., :3, :3])
    has_centres = values.shape[-1] == 4
    centres = values[..., :3, 3] if has_centres else _centres(place)
    if names[1] == "w2c":
        turns = np.swapaxes(turns, -1, -2)
        centres = -(turns @ centres[..., None])[..., 0] if has_centres else centres
    return turns, centres


_MOST_TURNS_DEG: Final = 1e5


def _frozen(values: np.ndarray) -> np.ndarray:
    values = np.ascontiguousarray(values)
    values.setflags(write=False)
    return values


def _centres(place: Block | None) -> np.ndarray:
    if place is None:
        raise GeometryError("no location")
    return place.values


def _unit_quaternions(values: Float64[np.ndarray, "*n 4"]) -> Float64[np.ndarray, "*n 4"]:
    norms = np.sqrt(np.sum(np.square(values), axis=-1, keepdims=True))
    if not (np.abs(norms - 1) <= TOLERANCE).all():
        raise GeometryError("no unit quaternions")
    return np.asarray(values / norms)


def _rotations(matrices: Float64[np.ndarray, "*n 3 3"]) -> Float64[np.ndarray, "*n 3 3"]:
    """Return the nearest rotations or reflections of matrices that are nearly such."""
    products = matrices @ np.swapaxes(matrices, -1, -2)
    if not (np.abs(products - np.eye(3)) <= TOLERANCE).all():
        raise GeometryError("no rotation matrices")
    signs = np.sign(np.linalg.det(matrices))[..., None, None]
    return np.asarray(nearest_rotation(matrices * signs) * signs)


def _all_readings(recorded: RecordedPoses, named: Callable[[str], bool] | None) -> Iterator[_Form]:
    hints = recorded.hints | {_ALIASES[hint] for hint in recorded.hints if hint in _ALIASES}
    blocks = [block for block in recorded.blocks if not block.words & _NO_POSE]
    places = [b for b in blocks if b.values.shape[-1] == 3 and b.values.ndim == 3
              and b.components not in (("pitch", "yaw", "roll"), ("rx", "ry", "rz"))
              and (b.words & _LOCATION or (b.components and not b.words & _ROTATION))]  # fmt: skip
    possible = _possible_axes(hints)
    for turn in blocks:
        for kind, needs_place in _kinds(turn):
            for place in places if needs_place else [None]:
                if place is turn:
                    continue
                for axes in AXES:
                    unit_m, unit = _unit(recorded, place or turn)
                    tier = _tier(turn, kind, axes, hints)
                    where = turn.key if place is None else f"{place.key} and {turn.key}"
                    name = f"{where}: {kind}, {axes} axes{unit}"
                    if axes not in possible and not (named is not None and named(name)):
                        continue
                    yield _Form(name, tier, turn, place, kind, axes, unit_m)


def _possible_axes(hints: frozenset[str]) -> list[str]:
    """Return the axes that a file may mean: those with left for right only where it names them."""
    said = [axes for axes in AXES if axes in hints]
    return said or [axes for axes in AXES if axes != "ros"]


def _unit(recorded: RecordedPoses, place: Block) -> tuple[float, str]:
    if place.unit in UNITS_M:
        return UNITS_M[place.unit], f", {place.unit}"
    return (np.nan, "") if recorded.unit_m is None else (recorded.unit_m, "")


def _kinds(block: Block) -> list[tuple[str, bool]]:
    """Return the forms that numbers of this shape can have, and whether they need a location."""
    shape = block.values.shape[2:]
    if block.components == ("pitch", "yaw", "roll"):
        return [(f"rotator pitch yaw roll {angle}", True) for angle in ("deg", "rad")]
    if shape == (3,) and (block.words & _ROTATION or block.components == ("rx", "ry", "rz")):
        orders = ("pitch yaw roll", "roll pitch yaw")
        return [
            (f"rotator {order} {angle}", True)
            for order, angle in itertools.product(orders, ("deg", "rad"))
        ]
    if shape == (4,):
        names: tuple[str, ...] = ("xyzw",) if block.components else ("xyzw", "wxyz")
        return [(f"quaternion {order}", True) for order in names]
    needs_place = shape in ((3, 3), (9,))
    if not needs_place and shape not in ((4, 4), (16,), (3, 4), (12,)):
        return []
    majors: tuple[str, ...] = ("columns",) if shape in ((3, 4), (12,)) else ("columns", "rows")
    return [
        (f"matrix {sense} {major}", needs_place)
        for sense, major in itertools.product(("c2w", "w2c"), majors)
    ]


def _tier(block: Block, kind: str, axes: str, hints: frozenset[str]) -> int:
    """Return 0 for what the file names, 1 for what fits what it names, 2 for other forms."""
    said_axes = {hint for hint in hints if hint in AXES} or {"unreal"}
    if axes not in said_axes:
        return 2
    own_words = hints | block.words
    names = kind.split()
    fits = {"rotator": _rotator_fits, "quaternion": _quaternion_fits, "matrix": _matrix_fits}
    tier = fits[names[0]](block, names, own_words)
    said_kinds = {each for each, said in _KIND_WORDS.items() if said & hints}
    return 1 if tier == 0 and said_kinds and names[0] not in said_kinds else tier


_KIND_WORDS: Final = {
    "quaternion": {"quaternion", "quaternions", "quat"},
    "matrix": {"matrix", "matrices"},
    "rotator": {"rotator", "rotators", "euler"},
}


def _rotator_fits(block: Block, names: list[str], said: frozenset[str]) -> int:
    is_rad = block.unit.startswith("rad") or any(word.startswith("rad") for word in said)
    if ("rad" in names) != is_rad:
        return 2
    if block.components == ("pitch", "yaw", "roll"):
        return 0
    said_orders = {"pitchyawroll", "rollpitchyaw", "pyr", "rpy"} & said
    own = {"".join(names[1:4]), "".join(name[0] for name in names[1:4])}
    return 0 if said_orders & own else 2 if said_orders else 1


def _quaternion_fits(block: Block, names: list[str], said: frozenset[str]) -> int:
    said_orders = {"xyzw", "wxyz"} & said
    if block.components or names[1] in said_orders:
        return 0
    return 2 if said_orders else 1


def _matrix_fits(block: Block, names: list[str], said: frozenset[str]) -> int:
    text = "_".join((*(key for key in block.name if key != "*"), *sorted(said)))
    senses = {"c2w"} if any(word in text for word in _FROM_CAMERA) else set()
    senses |= {"w2c"} if any(word in text for word in _FROM_WORLD) else set()
    is_turn_only = block.values.shape[2:] in ((3, 3), (9,))
    if names[1] not in (senses or ({"c2w"} if is_turn_only else {"c2w", "w2c"})):
        return 2
    if is_turn_only or senses:
        return 0 if names[2] == "columns" else 2
    return 1
