"""``trajectory.json``: the poses of six cameras over the frames of a scene.

Nothing about a rotation is guessed. Its numbers are read as the file's ``rotation_representation``
says; a file without one must have {pitch, yaw, roll}, which Unreal writes in degrees.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.schema.document import JsonValue, brief, camera_of, is_number
from stereogenbench_data.schema.parse import require_six_cameras, unit_m
from stereogenbench_data.schema.records import RotationKind, Trajectory
from stereogenbench_data.schema.release import CAMERA_COUNT

TOLERANCE: Final = 1e-3
"""How far a quaternion's norm may be from 1, and a matrix from orthonormal."""


@dataclass(frozen=True, slots=True)
class _Representation:
    """How a file writes rotations.

    Attributes:
        kind: What `Trajectory.rotations` holds.
        shape: The shape of one rotation there.
        form: The form of one rotation in the file, for messages.
        order: For each component of a quaternion x, y, z, w, its place in the file's list.
    """

    kind: RotationKind
    shape: tuple[int, ...]
    form: str
    order: tuple[int, ...] = ()


_ROTATOR: Final = _Representation("rotator_deg", (3,), "{pitch, yaw, roll} in degrees")
REPRESENTATIONS: Final[dict[str, _Representation]] = {
    "unreal_rotator_degrees": _ROTATOR,
    "quaternion_xyzw": _Representation("quaternion_xyzw", (4,), "a list x, y, z, w", (0, 1, 2, 3)),
    "quaternion_wxyz": _Representation("quaternion_xyzw", (4,), "a list w, x, y, z", (1, 2, 3, 0)),
    "matrix_3x3": _Representation("matrix", (3, 3), "three rows of three numbers"),
}
"""By the name in ``rotation_representation``. The first stands in a scene that was rendered
elsewhere; the others are those that `synthesis.export` writes, as the paper leaves them open."""


@dataclass(frozen=True, slots=True)
class _Pose:
    """One camera in one frame: its centre and its rotation, with their unchecked components."""

    frame: int
    camera: int
    location: JsonValue
    centre: list[Any]
    rotation: JsonValue
    turn: list[Any]


def parse_trajectory(text: bytes, *, where: str) -> Trajectory:
    """Return the poses that a ``trajectory.json`` records, unrounded and in its own world axes.

    Any number of frames is read. Frames and cameras are ordered by their indices. Quaternions are
    normalised.

    Args:
        text: The file's bytes.
        where: The file's path, for messages.

    Raises:
        SchemaError: If the file does not follow the format; the message lists every problem.

    Source: the paper's appendix on the file schema.
    """
    root = JsonValue.parse(text, where=where)
    metres = unit_m(root)
    require_six_cameras(root)
    representation = _representation(root.find("rotation_representation"))
    poses = [
        pose
        for frame, node in enumerate(_frames(root))
        for pose in _poses(node, frame=frame, representation=representation)
    ]
    centres = _numbers([(pose.location, pose.centre) for pose in poses], count=3)
    rotations = _rotations(poses, representation)
    root.problems.require_none()
    rows = np.lexsort(([pose.camera for pose in poses], [pose.frame for pose in poses]))
    return Trajectory(
        locations=_frozen(centres[rows].reshape(-1, CAMERA_COUNT, 3)),
        unit_m=metres,
        rotations=_frozen(rotations[rows].reshape(-1, CAMERA_COUNT, *representation.shape)),
        rotation_kind=representation.kind,
    )


def _frozen(values: np.ndarray) -> np.ndarray:
    values = np.ascontiguousarray(values)
    values.setflags(write=False)
    return values


def _representation(name: JsonValue | None) -> _Representation:
    if name is None:
        return _ROTATOR
    if isinstance(name.value, str) and name.value in REPRESENTATIONS:
        return REPRESENTATIONS[name.value]
    name.complain(f"must be one of {', '.join(REPRESENTATIONS)}, found {brief(name.value)}")
    return _ROTATOR


def _frames(root: JsonValue) -> list[JsonValue]:
    """Return the frames in the order of their indices, which must run from 0 without a gap."""
    entries = root.require("frames")
    if entries is None:
        return []
    frames = entries.objects()
    if isinstance(entries.value, list) and not entries.value:
        entries.complain("has no frame")
    indices = [frame.find("frame_index") for frame in frames]
    if all(index is None for index in indices):
        return frames
    places: dict[int, JsonValue] = {}
    for frame, index in zip(frames, indices, strict=True):
        if index is None:
            frame.require("frame_index")
            continue
        place = index.integer()
        if place in places:
            index.complain(f"frame {place} is already at {places[place].path}")
        places.setdefault(place, frame)
    missing = sorted(set(range(len(places))) - set(places))
    if missing:
        shown = ", ".join(map(str, missing[:8])) + (", ..." if len(missing) > 8 else "")
        entries.complain(
            f"frames must be numbered from 0 without a gap; there are {len(places)} numbers up "
            f"to {max(places)}, without {shown}"
        )
    return [places[place] for place in sorted(places)]


def _poses(frame_node: JsonValue, *, frame: int, representation: _Representation) -> list[_Pose]:
    entries = frame_node.require("cameras")
    if entries is None:
        return []
    cameras: dict[int, JsonValue] = {}
    for node in entries.objects():
        camera = _camera(node)
        if camera is None:
            continue
        if camera in cameras:
            node.complain(f"camera {camera} is already at {cameras[camera].path}")
        cameras.setdefault(camera, node)
    missing = sorted(set(range(CAMERA_COUNT)) - set(cameras))
    if missing:
        entries.complain(f"has no pose of camera {', '.join(map(str, missing))}")
    poses = []
    for camera, node in cameras.items():
        location, rotation = node.require("location"), node.require("rotation")
        if location is None or rotation is None:
            continue
        centre, turn = location.axes(("x", "y", "z")), _components(rotation, representation)
        if centre is None:
            location.complain(f"must be {{x, y, z}}, found {brief(location.value)}")
        if centre is not None and turn is not None:
            poses.append(_Pose(frame, camera, location, centre, rotation, turn))
    return poses


def _camera(node: JsonValue) -> int | None:
    """Return the camera of an entry by its index or else its name, None where that fails."""
    before = len(node.problems)
    index, name = node.find("camera_index"), node.find("camera_name")
    if index is not None:
        camera = index.camera()
        named = None if name is None else camera_of(name.value)
        if named is not None and named != camera:
            node.complain(f"camera_index is {camera} but camera_name is that of camera {named}")
    elif name is not None:
        camera = name.camera()
    else:
        node.require("camera_index")
    return None if len(node.problems) > before else camera


def _components(rotation: JsonValue, representation: _Representation) -> list[Any] | None:
    """Return the numbers of a rotation in the order kept, None where it has another form.

    They are pitch, yaw, roll; x, y, z, w; or nine elements by rows.
    """
    value = rotation.value
    if representation.kind == "rotator_deg":
        components = rotation.axes(("pitch", "yaw", "roll"))
    elif not isinstance(value, list) or len(value) != representation.shape[0]:
        components = None
    elif representation.kind == "quaternion_xyzw":
        components = [value[place] for place in representation.order]
    elif all(isinstance(row, list) and len(row) == 3 for row in value):
        components = [element for row in value for element in row]
    else:
        components = None
    if components is None:
        rotation.complain(
            f"must be {representation.form}, as rotation_representation says or by default, "
            f"found {brief(value)}"
        )
    return components


def _numbers(
    values: list[tuple[JsonValue, list[Any]]], *, count: int
) -> Float64[np.ndarray, "n count"]:
    """Return components as float64; record each that is not a finite number, and keep 0 for it."""
    flat = [component for _, components in values for component in components]
    if set(map(type, flat)) <= {float}:
        array = np.array(flat, dtype=np.float64).reshape(-1, count)
        if np.isfinite(array).all():
            return array
    for node, components in values:
        for component in components:
            if not is_number(component):
                node.complain(f"must hold finite numbers, found {brief(component)}")
    kept = [float(value) if is_number(value) else 0.0 for value in flat]
    return np.array(kept, dtype=np.float64).reshape(-1, count)


def _rotations(poses: list[_Pose], representation: _Representation) -> np.ndarray:
    """Return the rotations of the poses, checked to be rotations."""
    before = len(poses[0].rotation.problems) if poses else 0
    values = _numbers(
        [(pose.rotation, pose.turn) for pose in poses], count=int(np.prod(representation.shape))
    )
    is_checked = poses and len(poses[0].rotation.problems) == before
    if representation.kind == "rotator_deg" or not is_checked:
        return values
    check = _rotation_matrices if representation.kind == "matrix" else _unit_quaternions
    checked, bad = check(values)
    for row, complaint in bad.items():
        poses[row].rotation.complain(complaint)
    return checked


def _unit_quaternions(
    values: Float64[np.ndarray, "n 4"],
) -> tuple[Float64[np.ndarray, "n 4"], dict[int, str]]:
    """Return normalised quaternions, and a complaint for each row that is not nearly unit."""
    norms = np.sqrt(np.sum(np.square(values), axis=1))
    bad = {
        int(row): f"a quaternion must have length 1 within {TOLERANCE}, found {norms[row]:.6g}"
        for row in np.flatnonzero(np.abs(norms - 1) > TOLERANCE)
    }
    return values / np.where(norms > 0, norms, 1.0)[:, None], bad


def _rotation_matrices(
    values: Float64[np.ndarray, "n 9"],
) -> tuple[Float64[np.ndarray, "n 3 3"], dict[int, str]]:
    """Return 3 x 3 matrices, and a complaint for each row that is not nearly a rotation."""
    matrices = values.reshape(-1, 3, 3)
    products = matrices @ matrices.transpose(0, 2, 1)
    skews = np.max(np.abs(products - np.eye(3)), axis=(1, 2))
    bad = {
        int(row): f"a rotation matrix must be orthonormal within {TOLERANCE}, "
        f"found a deviation of {skews[row]:.3g}"
        for row in np.flatnonzero(skews > TOLERANCE)
    }
    mirrored = np.linalg.det(matrices) < 0
    return matrices, bad | {
        int(row): "the matrix mirrors (its determinant is negative); its columns must be the "
        "camera's forward, right and up axes in the world"
        for row in np.flatnonzero(mirrored)
        if int(row) not in bad
    }
