"""How a trajectory's numbers may be read as poses: one list of forms.

A file names its form by keys (``pitch``, ``qw``, ``world_to_camera``) and by texts
(``rotation_representation``). That is a hint: `readings` yields what fits the hints first, then the
others, and `index.evidence` keeps those that the rig's geometry confirms. All become poses in
Unreal's axes: left-handed, x forward, y right, z up; a right-handed world is mirrored as a whole,
cameras with it, so that no picture is.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.geometry.pose import (
    CameraPoses,
    nearest_rotation,
    rotation_from_quaternion_xyzw,
    rotation_from_rotator_deg,
)
from stereogenbench_data.schema.declaration import PosesAt
from stereogenbench_data.schema.pose_search import RecordedPoses
from stereogenbench_data.schema.text import shortened
from stereogenbench_data.schema.trajectory import Block, read_block
from stereogenbench_data.schema.units import UNITS_M

TOLERANCE: Final = 1e-3
"""How far a quaternion's norm may be from 1, and a matrix from orthonormal."""

_LOCATION: Final = {
    "location", "position", "translation", "loc", "pos", "center", "centre", "origin", "t",
    "trans", "xyz", "tvec",
}  # fmt: skip
_ROTATION: Final = {
    "rotation", "rotator", "orientation", "euler", "quaternion", "quat", "rot", "q", "r",
    "angle", "angles", "rotmat", "matrix", "rotvec", "rvec", "qvec", "pyr", "rpy",
}  # fmt: skip
_NO_POSE: Final = {
    "scale", "scale3d", "velocity", "forward", "up", "right", "target", "lookat", "color",
    "relative", "local", "character", "subject", "intrinsics", "intrinsic", "k", "look", "focus",
}  # fmt: skip

AXES: Final[dict[str, tuple[tuple[int, int], ...]]] = {
    "unreal": ((0, 1), (1, 1), (2, 1)),
    "opencv": ((2, 1), (0, 1), (1, -1)),
    "opengl": ((2, -1), (0, 1), (1, 1)),
    "ros": ((0, 1), (1, -1), (2, 1)),
    "pytorch3d": ((2, 1), (0, -1), (1, 1)),
}
"""Of which columns of a camera's rotation, with which sign, are forward, right and up. Blender's
cameras are those of OpenGL. PyTorch3D's are OpenCV's upside down, with left and right exchanged: so
these are tried only where a file names them."""

_ALIASES: Final = {
    "gltf": "opengl",
    "blender": "opengl", "gl": "opengl", "nerf": "opengl", "cv": "opencv", "colmap": "opencv",
    "ue": "unreal", "ue4": "unreal", "ue5": "unreal", "rotator": "unreal",
}  # fmt: skip
_FROM_CAMERA: Final = (
    "c2w", "camera_to_world", "cam_to_world", "world_from_cam", "cam2world", "camera2world",
    "matrix_world", "world_from_camera",
)  # fmt: skip
_FROM_WORLD: Final = (
    "w2c", "world_to_camera", "world_to_cam", "cam_from_world", "world2cam", "world2camera",
    "extrinsic", "camera_from_world", "view_matrix", "colmap",
    "tvec", "rvec", "qvec",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """Poses as one form reads them.

    Attributes:
        name: What the form is, for people and for the index.
        tier: 0 if it is what the file names, 1 if it fits what it names, 2 for the other forms;
            3 more for axes that it does not name.
        is_named: Whether the file names the camera's axes; pitch, yaw and roll are Unreal's words.
        poses: The poses, with the unit that the file states, else nan metres.
        at: Where they stand and their form.
    """

    name: str
    tier: int
    is_named: bool
    poses: CameraPoses
    at: PosesAt


def readings(recorded: RecordedPoses, *, only: str | None = None) -> Iterator[Reading]:
    """Yield the readings of recorded numbers, those that the file names first.

    Args:
        recorded: The numbers.
        only: The name of the one reading that is wanted.
    """
    hints = _hints(recorded)
    named_axes = hints & {*AXES}
    blocks = [block for block in recorded.blocks if not block.words & _NO_POSE]
    places = [b for b in blocks if b.values.shape[2:] == (3,)
              and b.components not in (_ROTATOR, ("rx", "ry", "rz"))
              and (b.words & _LOCATION or (b.components and not b.words & _ROTATION))]  # fmt: skip
    forms = []
    for turn, axes in itertools.product(blocks, AXES):
        if axes == "pytorch3d" and axes not in hints:
            continue
        has_place = turn.values.shape[2:] in ((4, 4), (16,), (3, 4), (12,))
        for kind, place in itertools.product(_kinds(turn), [None] if has_place else places):
            if place is not turn:
                forms.append((_tier(turn, kind.split(), axes, hints), turn, place, kind, axes))
    for tier, turn, place, kind, axes in sorted(forms, key=lambda form: form[0]):
        where = turn.key if place is None else f"{place.key} and {turn.key}"
        name, unit = f"{where}: {kind}, {axes} axes", (place or turn).unit
        unit_m = np.nan if recorded.unit_m is None else recorded.unit_m
        if unit in UNITS_M:
            name, unit_m = f"{name}, {unit}", UNITS_M[unit]
        if only is None or name == only:
            poses = _read(turn, place, kind.split(), axes, unit_m)
            if poses is not None:
                own_axes = named_axes or ({"unreal"} if turn.components == _ROTATOR else ())
                location = None if place is None else place.at.rotation
                at = replace(turn.at, location=location, form=kind, axes=axes)
                yield Reading(name, tier, axes in own_axes, poses, at)


def poses_at(document: dict[str, Any], at: PosesAt, *, where: str) -> tuple[str, CameraPoses]:
    """Return the poses of a ``trajectory.json`` where they are declared, and the reading's name.

    Args:
        document: The file as parsed JSON.
        at: Where they stand, in which form; without a unit they have nan metres.
        where: The file's path, for messages.

    Raises:
        SchemaError: If they do not stand there, or are not of this form.
    """
    turn = read_block(document, at, str(at.rotation), where=where)
    place = None if at.location is None else read_block(document, at, at.location, where=where)
    form = str(at.form)
    kind = next((each for each in _kinds(turn) if form in (each, _short(each))), "")
    if not kind or at.axes not in AXES:
        raise SchemaError(
            f"{where}: {at.rotation} is not of the form {shortened(form)!r} with "
            f"{shortened(str(at.axes))!r} axes that the conventions state below [poses]: for these "
            f"numbers there are {', '.join(_kinds(turn)) or 'no forms'}, with the axes "
            f"{', '.join(AXES)}."
        )
    unit_m = np.nan if at.unit is None else UNITS_M[at.unit]
    poses = _read(turn, place, kind.split(), at.axes, unit_m)
    if poses is None:
        raise SchemaError(
            f"{where}: {at.rotation} has numbers that are no rotations of the form {form!r}. "
            f"Correct [poses]."
        )
    where_read = turn.key if place is None else f"{place.key} and {turn.key}"
    unit = (place or turn).unit
    name = f"{where_read}: {kind}, {at.axes} axes" + (f", {unit}" if unit in UNITS_M else "")
    return name, poses


def _short(kind: str) -> str:
    """Return a form as it may be written, as its components have names or one order.

    >>> _short("rotator pitch yaw roll deg"), _short("quaternion xyzw")
    ('rotator deg', 'quaternion')
    """
    return kind.replace(" pitch yaw roll", "").replace(" xyzw", "")


def _read(
    turn: Block, place: Block | None, kind: list[str], axes: str, unit_m: float
) -> CameraPoses | None:
    """Return the poses of a form, None where the numbers are not such rotations."""
    values = turn.values
    places = values[..., 3] if place is None else place.values
    if kind[0] == "matrix":
        values, places = _parted(values, kind, places)
    turns = _rotations(values, kind, turn.components)
    if turns is None:
        return None
    if "w2c" in kind:
        turns = np.swapaxes(turns, -1, -2)
        places = -(turns @ places[..., None])[..., 0]
    turns = np.stack([sign * turns[..., :, column] for column, sign in AXES[axes]], axis=-1)
    hands = np.linalg.det(turns)
    if not (np.isfinite(places).all() and (hands.flat[0] * hands > 0).all()):
        return None
    if hands.flat[0] < 0:  # The world has the other hand: all is mirrored, the cameras too.
        turns, places = turns * _MIRROR[:, None], places * _MIRROR
    is_exact = kind[0] in ("quaternion", "rotator") and axes == "unreal" and "w2c" not in kind
    turns = turns if is_exact else nearest_rotation(turns)
    return CameraPoses.from_unreal(np.ascontiguousarray(places), turns, unit_m=unit_m)


_ROTATOR: Final = ("pitch", "yaw", "roll")
_MIRROR: Final = np.array([1.0, -1.0, 1.0])


def _parted(
    values: np.ndarray, names: list[str], place: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotations and the translations of matrices, written in any shape."""
    sides = {16: (4, 4), 12: (3, 4), 9: (3, 3)}.get(values.shape[-1])
    if values.ndim == 3 and sides is not None:
        values = values.reshape(*values.shape[:-1], *sides)
    if "rows" in names:  # vectors are rows: the transpose
        values = np.swapaxes(values, -1, -2)
    return values[..., :3, :3], values[..., :3, 3] if values.shape[-1] == 4 else place


def _rotations(
    values: np.ndarray, kind: list[str], components: tuple[str, ...]
) -> Float64[np.ndarray, "*n 3 3"] | None:
    """Return the rotations, or of matrices reflections, that numbers are in a form; else None."""
    if kind[0] == "matrix":
        products = values @ np.swapaxes(values, -1, -2)
        if not (np.abs(products - np.eye(3)) <= TOLERANCE).all():
            return None
        signs = np.sign(np.linalg.det(values))[..., None, None]
        return np.asarray(nearest_rotation(values * signs) * signs)
    if kind[0] == "quaternion":
        values = values[..., [kind[1].index(each) for each in "xyzw"]]
        norms = np.sqrt(np.sum(np.square(values), axis=-1, keepdims=True))
        is_unit = (np.abs(norms - 1) <= TOLERANCE).all()
        return rotation_from_quaternion_xyzw(values / norms) if is_unit else None
    if kind[0] == "rotator" and components != _ROTATOR:
        values = values[..., [kind.index(each) - 1 for each in _ROTATOR]]
    degrees = np.rad2deg(values) if "rad" in kind else values
    is_angle = np.abs(degrees).max(initial=0) <= _MOST_TURNS_DEG
    return _ANGLES[kind[0]](degrees) if is_angle else None


_MOST_TURNS_DEG: Final = 1e5


def _from_vectors_deg(vectors_deg: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3 3"]:
    """Return the rotations by the lengths of vectors, in degrees, about their directions."""
    halves = np.deg2rad(vectors_deg) / 2
    lengths = np.linalg.norm(halves, axis=-1, keepdims=True)
    return rotation_from_quaternion_xyzw(
        np.concatenate([halves * np.sinc(lengths / np.pi), np.cos(lengths)], axis=-1)
    )


def _from_euler_deg(xyz_deg: Float64[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 3 3"]:
    """Return Rz(z) Ry(y) Rx(x), as Blender and ROS write angles."""
    return rotation_from_rotator_deg(xyz_deg[..., [1, 2, 0]] * np.array([-1.0, 1.0, -1.0]))


_ANGLES: Final = {
    "rotator": rotation_from_rotator_deg, "euler": _from_euler_deg, "vector": _from_vectors_deg,
}  # fmt: skip


def _hints(recorded: RecordedPoses) -> frozenset[str]:
    found = recorded.hints | {_ALIASES[hint] for hint in recorded.hints if hint in _ALIASES}
    is_of_rotators = any(block.components == _ROTATOR for block in recorded.blocks)
    if is_of_rotators and any("right_hand" in hint for hint in found):
        return (found | {"ros"}) - {"unreal"}  # as Unreal's, with y to the left
    return found


_KINDS: Final = (
    "rotator pitch yaw roll", "rotator roll pitch yaw", "euler x y z", "vector",
    "quaternion xyzw", "quaternion wxyz", "matrix c2w columns", "matrix c2w rows",
)  # fmt: skip
"""The forms. Angles are in degrees or radians; "w2c" takes the world's coordinates to the camera's,
and "rows" are matrices for row vectors."""


def _kinds(block: Block) -> list[str]:
    """Return the forms that numbers of this shape and these names can have."""
    shape, names = block.values.shape[2:], block.components
    units = ("deg", "rad")
    if names == _ROTATOR:
        kinds = [f"{_KINDS[0]} {unit}" for unit in units]
    elif shape == (3,) and (block.words & _ROTATION or names == ("rx", "ry", "rz")):
        kinds = [f"{kind} {unit}" for kind, unit in itertools.product(_KINDS[:4], units)]
        kinds += [f"{_KINDS[3]} {unit} w2c" for unit in units]
    elif shape == (4,):
        kinds = [*_KINDS[4:5]] if names else [*_KINDS[4:6]]
        kinds += [f"{kind} w2c" for kind in kinds]
    elif shape in ((3, 4), (12,)):
        kinds = [_KINDS[6], _KINDS[6].replace("c2w", "w2c")]
    elif shape in ((3, 3), (9,), (4, 4), (16,)):
        kinds = [*_KINDS[6:], *(kind.replace("c2w", "w2c") for kind in _KINDS[6:])]
    else:
        kinds = []
    return kinds


def _tier(block: Block, kind: list[str], axes: str, hints: frozenset[str]) -> int:
    """Return 0 for what the file names, 1 for what fits what it names, 2 for other forms.

    Other axes than the file names come after all of these. Where it names none, Unreal's come first
    in forms that fit, and all else is of one rank: what is not named must be the only one to pass.
    """
    said = hints | block.words
    text = "_".join(("", *(key for key in block.name if key != "*"), *sorted(said)))
    is_from_camera = any(f"_{word}" in text for word in _FROM_CAMERA)
    is_from_world = not is_from_camera and any(f"_{word}" in text for word in _FROM_WORLD)
    is_vector = kind[0] == "vector" and not block.unit.startswith("deg")
    is_rad = is_vector or block.unit.startswith("rad") or any(w.startswith("rad") for w in said)
    fits = is_from_world == ("w2c" in kind) and (
        kind[0] not in _ANGLES or ("rad" in kind) == is_rad
    )
    named_kinds = {each for each, names in _KIND_WORDS.items() if names & hints}
    tier = _form_tier(block, kind, said) if fits else 2
    if tier == 0 and named_kinds and kind[0] not in named_kinds:
        tier = 1
    named_axes = {*AXES} & hints
    if named_axes:
        is_denied = not fits and (is_from_camera or is_from_world)  # what it names is wrong, then
        return tier if axes in named_axes or is_denied else tier + 3
    return tier if axes == "unreal" else 2


def _form_tier(block: Block, kind: list[str], said: frozenset[str]) -> int:
    """Return whether a file names a form by its components, its order, or the word for it."""
    said_orders = _ORDERS & said or ({"wxyz"} if said & {"qvec", "colmap"} else set())
    if kind[0] == "matrix":
        return 2 if kind[2] == "rows" else 0
    if block.components in (_ROTATOR, ("qx", "qy", "qz", "qw")):
        return 0
    if kind[0] == "quaternion":
        return 0 if block.components or kind[1] in said_orders else 2 if said_orders else 1
    if kind[0] == "vector":
        return 0 if _KIND_WORDS["vector"] & said else 2
    own = {"".join(kind[1:4]), "".join(name[0] for name in kind[1:4])}
    return 0 if said_orders & own else 2 if said_orders or kind[0] == "euler" else 1


_ORDERS: Final = frozenset({"xyzw", "wxyz", "pitchyawroll", "rollpitchyaw", "pyr", "rpy", "xyz"})
_KIND_WORDS: Final = {
    "quaternion": {"quaternion", "quaternions", "quat"},
    "matrix": {"matrix", "matrices"},
    "rotator": {"rotator", "rotators", "euler"},
    "euler": {"euler"},
    "vector": {"rodrigues", "rotvec", "rvec", "vector", "axisangle"},
}
