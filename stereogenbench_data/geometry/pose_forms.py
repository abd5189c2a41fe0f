"""How a trajectory's numbers may be read as poses: one list of forms.

A file of conventions may state any of them. Where none is stated, `readings` yields those that are
settled: rotators in degrees, quaternions and matrices on Unreal's axes, or on those that the file
itself names. Its keys and texts (``rotation_representation``) are a hint: what fits them comes
first, and `pose_evidence` keeps what the rig's geometry confirms. All become poses in Unreal's
axes: left-handed, x forward, y right, z up; a right-handed world is mirrored as a whole, cameras
with it, so that no picture is.
"""

import itertools
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import Any, Final, Literal

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
from stereogenbench_data.schema.places import place_at
from stereogenbench_data.schema.pose_search import RecordedPoses, places_in
from stereogenbench_data.schema.text import shortened
from stereogenbench_data.schema.trajectory import Block, named, read_block, shown_key
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
_FROM_WORLD: Final = (
    "w2c", "world_to_cam", "world2cam", "cam_from_world", "camera_from_world", "extrinsic",
    "view_matrix",
)  # fmt: skip
_ORDERS: Final = frozenset({"xyzw", "wxyz", "pitchyawroll", "rollpitchyaw", "pyr", "rpy"})

AXES: Final[dict[str, tuple[tuple[int, int], ...]]] = {
    "unreal": ((0, 1), (1, 1), (2, 1)),
    "opencv": ((2, 1), (0, 1), (1, -1)),
    "opengl": ((2, -1), (0, 1), (1, 1)),
    "ros": ((0, 1), (1, -1), (2, 1)),
    "pytorch3d": ((2, 1), (0, -1), (1, 1)),
}
"""Of which columns of a camera's rotation, with which sign, are forward, right and up. Blender's
cameras are those of OpenGL. PyTorch3D's are OpenCV's upside down, with left and right exchanged."""


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """Poses as one form reads them.

    Attributes:
        name: What the form is, for people and for the index.
        tier: 0 if it is what the file names, 1 if it fits what it names, 2 for the other forms.
        poses: The poses, with the unit that the file states, else nan metres.
        at: Where they stand and their form.
    """

    name: str
    tier: int
    poses: CameraPoses
    at: PosesAt


def readings(
    recorded: RecordedPoses,
    *,
    forms: Literal["settled", "all"] = "settled",
    axes: Collection[str] = (),
) -> Iterator[Reading]:
    """Yield the readings of recorded numbers, those that the file names first.

    Args:
        recorded: The numbers.
        forms: Those that are settled, or all that a file of conventions may state.
        axes: The axes of cameras that may be; () for those that the file names, else Unreal's.
    """
    own = axes or sorted(recorded.hints & {*AXES}) or ["unreal"]
    blocks = [block for block in recorded.blocks if not block.words & _NO_POSE]
    places = [b for b in blocks if _is_place(b)
              and (b.words & _LOCATION or (b.components and not b.words & _ROTATION))]  # fmt: skip
    has_rotators = any(block.components == _ROTATOR for block in blocks)
    found = []
    for turn in blocks:
        is_rotator = turn.components == _ROTATOR
        for kind, each in itertools.product(
            _kinds(turn), ["unreal"] if is_rotator and not axes else own
        ):
            said = recorded.hints | turn.words
            if forms == "all" or _is_settled(kind.split(), turn.unit, said):
                tier = _tier(turn, kind.split(), said)
                tier = max(tier, 1) if has_rotators and not is_rotator else tier
                holds_places = turn.values.shape[2:] in _WITH_PLACES
                of_turn = [None] if holds_places else places
                found += [(tier, turn, place, kind, each) for place in of_turn if place is not turn]
    for tier, turn, place, kind, each in sorted(found, key=itemgetter(0)):
        stated = UNITS_M.get((place or turn).unit, recorded.unit_m)
        poses = _read(turn, place, kind.split(), each, np.nan if stated is None else stated)
        if poses is not None:
            location = None if place is None else place.at.rotation
            at = replace(turn.at, location=location, form=kind, axes=each)
            yield Reading(_name(turn, place, kind, each), tier, poses, at)


def _name(turn: Block, place: Block | None, kind: str, axes: str) -> str:
    where = turn.key if place is None else f"{place.key} and {turn.key}"
    unit = (place or turn).unit
    return f"{where}: {kind}, {axes} axes" + (f", {unit}" if unit in UNITS_M else "")


def _is_place(block: Block) -> bool:
    named_turns = (_ROTATOR, ("rx", "ry", "rz"))
    return block.values.shape[2:] == (3,) and block.components not in named_turns


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
    kinds = _kinds(turn, is_rotation=True)
    # "rotator deg" and "quaternion" do, as components have names or one order.
    short = {each.replace(" pitch yaw roll", "").replace(" xyzw", ""): each
             for each in reversed(kinds)}  # fmt: skip
    kind = form if form in kinds else short.get(form, "")
    if not kind or at.axes not in AXES:
        raise SchemaError(
            f"{where}: {at.rotation} is not of the form {shortened(form)!r} with "
            f"{shortened(str(at.axes))!r} axes that the conventions state below [poses]: for these "
            f"numbers there are {', '.join(kinds) or 'no forms'}, with the axes "
            f"{', '.join(AXES)}."
        )
    unit_m = np.nan if at.unit is None else UNITS_M[at.unit]
    poses = _read(turn, place, kind.split(), at.axes, unit_m)
    if poses is None:
        raise SchemaError(
            f"{where}: {at.rotation} has numbers that are no rotations of the form {form!r}. "
            f"Correct [poses]."
        )
    return _name(turn, place, kind, at.axes), poses


def poses_named(document: dict[str, Any], name: str, *, where: str) -> CameraPoses:
    """Return the poses of a ``trajectory.json`` by the name of a reading, as an index has it.

    Raises:
        SchemaError: If the file has no poses of this name.
    """
    at = PosesAt.of_reading(name)
    found = [
        read_block(document, each, str(each.rotation), where=where)
        for each in places_in(document)
        if shown_key(named(place_at(str(each.rotation)))[0]) in (at.location, at.rotation)
    ]
    turns = [block for block in found if block.key == at.rotation and at.form in _kinds(block)]
    places = [block for block in found if block.key == at.location and _is_place(block)]
    for turn, place in itertools.product(turns, places if at.location else [None]):
        unit_m = np.nan if at.unit is None else UNITS_M[at.unit]
        poses = None if place is turn or at.axes not in AXES else _read(
            turn, place, str(at.form).split(), at.axes, unit_m
        )  # fmt: skip
        if poses is not None:
            return poses
    raise SchemaError(
        f"{where}: has no poses of the form {shortened(name, 200)}. Run `stereogenbench index` "
        f"again."
    )


def _read(
    turn: Block, place: Block | None, kind: list[str], axes: str, unit_m: float
) -> CameraPoses | None:
    """Return the poses of a form, None where the numbers are not such rotations."""
    values = turn.values
    places = values[..., 3] if place is None else place.values
    if len(places) != len(values):  # poses of other frames
        return None
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
_WITH_PLACES: Final = ((4, 4), (16,), (3, 4), (12,))
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


_KINDS: Final = (
    "rotator pitch yaw roll", "rotator roll pitch yaw", "euler x y z", "vector",
    "quaternion xyzw", "quaternion wxyz", "matrix c2w columns", "matrix c2w rows",
)  # fmt: skip
"""The forms. Angles are in degrees or radians; "w2c" takes the world's coordinates to the camera's,
and "rows" are matrices for row vectors."""


def _kinds(block: Block, *, is_rotation: bool = False) -> list[str]:
    """Return the forms that numbers of this shape and these names can have.

    Three numbers are angles where their key speaks of a rotation, or a file says that they are one.
    """
    shape, names = block.values.shape[2:], block.components
    units = ("deg", "rad")
    if names == _ROTATOR:
        kinds = [f"{_KINDS[0]} {unit}" for unit in units]
    elif shape == (3,) and (is_rotation or block.words & _ROTATION or names == ("rx", "ry", "rz")):
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


def _is_settled(kind: list[str], unit: str, said: Collection[str]) -> bool:
    """Return whether a form may be settled on; others are for files of conventions to state."""
    if kind[0] == "rotator":
        is_rad = unit.startswith("rad") or any(word.startswith("rad") for word in said)
        return ("rad" in kind) == is_rad
    return kind[0] == "matrix" or (kind[0] == "quaternion" and "w2c" not in kind)


def _tier(block: Block, kind: list[str], said: frozenset[str]) -> int:
    """Return 0 for what the file names, 1 for what fits what it names, 2 for other forms."""
    text = "_".join(("", *(key for key in block.name if key != "*"), *sorted(said)))
    if any(f"_{word}" in text for word in _FROM_WORLD) != ("w2c" in kind):
        return 2
    if kind[0] == "matrix":
        return 2 if kind[2] == "rows" else 0
    if block.components:
        return 0
    own = {"".join(kind[1:4]), kind[1], "".join(name[0] for name in kind[1:4])}
    return 0 if _ORDERS & said & own else 2 if _ORDERS & said else 1
