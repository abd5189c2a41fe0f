"""``trajectory.json``: the poses of six cameras over the frames of a scene."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.schema.document import parse_object
from stereogenbench_data.schema.nodes import (
    Node,
    axes_of,
    camera_of,
    is_number,
    require_six_cameras,
    unit_m,
)
from stereogenbench_data.schema.problems import Problems, brief
from stereogenbench_data.schema.records import RotationKind, Trajectory
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.schema.rotations import (
    COMPONENTS,
    Form,
    Representation,
    complain_of,
    components_of,
    find_rotation,
    representation_of,
    rotation_matrices,
    unit_quaternions,
)
from stereogenbench_data.schema.spellings import AXES

_RECORDED_AS: dict[Form, tuple[RotationKind, tuple[int, ...]]] = {
    "rotator": ("rotator_deg", (3,)),
    "quaternion": ("quaternion_xyzw", (4,)),
    "matrix": ("matrix", (3, 3)),
}


@dataclass(frozen=True, slots=True)
class _Pose:
    """One camera in one frame: its centre and its rotation, with their unchecked components."""

    frame: int
    camera: int
    location: Node
    centre: list[Any]
    rotation: Node
    form: Form
    turn: list[Any]


def parse_trajectory(text: bytes, *, where: str) -> Trajectory:
    """Return the poses that a ``trajectory.json`` records, unrounded and in its own world axes.

    Any number of frames is read; frames are ordered by their index, cameras by theirs.
    Quaternions are normalised; angles become degrees; a matrix that is said to work on row
    vectors, or to be stored by columns, is transposed.

    Args:
        text: The file's bytes.
        where: The file's path, for messages.

    Raises:
        SchemaError: If the file does not follow the format; every problem is told.

    Source: the paper's appendix on the file schema.
    """
    problems = Problems(where)
    root = Node(parse_object(text, where=where), "$", problems)
    metres = unit_m(root)
    require_six_cameras(root)
    representation = representation_of(root)
    names = root.find("camera_order")
    order = names.value if names is not None and isinstance(names.value, list) else []
    poses: list[_Pose] = []
    for frame, node in enumerate(_frames(root)):
        poses += _poses(node, frame=frame, order=order, representation=representation)
    centres = _numbers([(pose.location, pose.centre) for pose in poses], count=3)
    form = _common_form(poses, representation)
    rotations = _rotations(poses, form)
    problems.require_none()
    rows = np.lexsort(([pose.camera for pose in poses], [pose.frame for pose in poses]))
    kind, shape = _RECORDED_AS[form]
    if form == "rotator":
        rotations = rotations * representation.degrees_in_unit
    return Trajectory(
        locations=_frozen(centres[rows].reshape(-1, CAMERA_COUNT, 3)),
        unit_m=metres,
        rotations=_frozen(rotations[rows].reshape(-1, CAMERA_COUNT, *shape)),
        rotation_kind=kind,
    )


def _frozen(values: np.ndarray) -> np.ndarray:
    values = np.ascontiguousarray(values)
    values.setflags(write=False)
    return values


def _frames(root: Node) -> list[Node]:
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
    places: dict[int, Node] = {}
    for frame, index in zip(frames, indices, strict=True):
        if index is None:
            frame.require("frame_index")
            continue
        place = index.integer()
        if place in places:
            index.complain(f"frame {place} was already given at {places[place].path}")
        places.setdefault(place, frame)
    missing = sorted(set(range(len(places))) - set(places))
    if missing:
        shown = ", ".join(map(str, missing[:8])) + (", ..." if len(missing) > 8 else "")
        entries.complain(
            f"frames must be numbered from 0 without a gap; there are {len(places)} numbers up "
            f"to {max(places)}, and none is {shown}"
        )
    return [places[place] for place in sorted(places)]


def _poses(
    frame_node: Node, *, frame: int, order: list[Any], representation: Representation
) -> list[_Pose]:
    entries = frame_node.require("cameras")
    if entries is None:
        return []
    cameras: dict[int, Node] = {}
    for camera, node in _cameras(entries, order):
        if camera in cameras:
            node.complain(f"camera {camera} was already given at {cameras[camera].path}")
        cameras.setdefault(camera, node)
    missing = sorted(set(range(CAMERA_COUNT)) - set(cameras))
    if missing:
        entries.complain(f"has no pose of camera {', '.join(map(str, missing))}")
    poses = []
    for camera, node in cameras.items():
        location, rotation = node.require("location"), find_rotation(node, representation)
        if location is None or rotation is None:
            continue
        centre = axes_of(location.value, AXES["location"])
        turn = components_of(rotation.value, representation)
        if centre is None:
            location.complain(f"must be {{x, y, z}} or [x, y, z], found {brief(location.value)}")
        if turn is None:
            complain_of(rotation, representation)
        if centre is not None and turn is not None:
            poses.append(_Pose(frame, camera, location, centre, rotation, *turn))
    return poses


def _cameras(entries: Node, order: list[Any]) -> list[tuple[int, Node]]:
    """Return the camera that each entry of a frame is about; entries about none are noted."""
    if isinstance(entries.value, dict):
        keyed = [
            (
                Node(
                    int(key) if key.isdecimal() and key.isascii() and len(key) < 7 else key,
                    entries.child(key).path,
                    entries.problems,
                ).camera(),
                entries.child(key),
            )
            for key in entries.value
        ]
        for _, node in keyed:
            if not isinstance(node.value, dict):
                node.complain(f"must be an object, found {brief(node.value)}")
        return [(camera, node) for camera, node in keyed if isinstance(node.value, dict)]
    return [
        (camera, node)
        for place, node in enumerate(entries.objects())
        if (camera := _camera(node, order[place] if place < len(order) else None)) is not None
    ]


def _camera(node: Node, listed: object) -> int | None:
    """Return the camera of an entry: by its index, its name, or the file's camera order."""
    before = len(node.problems)
    index, name = node.find("camera_index"), node.find("camera_name")
    if index is not None:
        camera = index.camera()
        named = None if name is None else camera_of(name.value)
        if named is not None and named != camera:
            node.complain(f"camera_index is {camera} and the name is that of camera {named}")
    elif name is not None:
        camera = name.camera()
    elif listed is not None:
        camera = Node(listed, node.path, node.problems).camera()
    else:
        node.require("camera_index")
    return None if len(node.problems) > before else camera


def _numbers(values: list[tuple[Node, list[Any]]], *, count: int) -> Float64[np.ndarray, "n count"]:
    """Return components as float64; each that is no finite number is noted and becomes 0."""
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


def _common_form(poses: list[_Pose], representation: Representation) -> Form:
    """Return the form of all rotations; note each that has another."""
    form = representation.form or (poses[0].form if poses else "rotator")
    says = (
        f"rotation_representation is {brief(representation.name)}"
        if representation.form
        else f"that of the first pose is a {form}"
    )
    for pose in poses:
        if pose.form != form:
            pose.rotation.complain(f"is a {pose.form}, but {says}")
    return form


def _rotations(poses: list[_Pose], form: Form) -> np.ndarray:
    """Return the rotations that have the common form, checked to be rotations."""
    alike = [(pose.rotation, pose.turn) for pose in poses if pose.form == form]
    before = len(alike[0][0].problems) if alike else 0
    values = _numbers(alike, count=COMPONENTS[form])
    if form == "rotator" or not alike or len(alike[0][0].problems) > before:
        return values
    checked, bad = (unit_quaternions if form == "quaternion" else rotation_matrices)(values)
    for row, complaint in bad.items():
        alike[row][0].complain(complaint)
    return checked
