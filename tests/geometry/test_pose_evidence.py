"""Poses in every form that the reader knows: read as the same poses, or refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.geometry import pose_evidence as evidence
from stereogenbench_data.geometry.pose import (
    OPENCV_FROM_UNREAL,
    CameraPoses,
    rotation_from_rotator_deg,
)
from stereogenbench_data.geometry.pose_evidence import (
    SidesError,
    declared_poses,
    settled_poses,
)
from stereogenbench_data.geometry.pose_forms import poses_named
from stereogenbench_data.schema.declaration import PosesAt
from stereogenbench_data.schema.records import Rig
from tests.servers.scene_fixtures import frames_of

PLACES_CM = np.array([0.0, 6.5, 19.0, 26.5, 60.0, 66.0])
RIG = Rig(
    32.5, 23.76, 23.76, 64, 64, None,
    tuple(PLACES_CM[b] - PLACES_CM[a] for a in range(6) for b in range(a + 1, 6)),
    (0, 1), "recorded",
)  # fmt: skip

CAMERAS = {
    "unreal": np.eye(3),
    "opencv": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
    "opengl": np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "ros": np.diag([1.0, -1.0, 1.0]),
    "pytorch3d": np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
}
"""A camera's x, y and z axes, as columns, in Unreal's forward, right and up."""
WORLDS = {"unreal": np.eye(3), "opencv": OPENCV_FROM_UNREAL, "opengl": np.diag([1.0, -1.0, 1.0]),
          "ros": np.diag([1.0, -1.0, 1.0]), "pytorch3d": CAMERAS["pytorch3d"].T}  # fmt: skip


def path(rotators, first_cm=(120.0, -340.0, 155.0)):
    """Rotators and places, (frames, 6, 3), of a rig that turns and moves."""
    rotators = np.repeat(np.array(rotators)[:, None], 6, axis=1)
    right = rotation_from_rotator_deg(rotators)[..., 1]
    steps = np.arange(len(rotators))[:, None, None] * np.array([7.0, 3.0, -2.0])
    return rotators, np.array(first_cm) + steps + PLACES_CM[:, None] * right


def quaternion_xyzw(turn):
    """By the eigenvector of Bar-Itzhack's matrix: no code of the package."""
    (a, b, c), (d, e, f), (g, h, i) = turn
    matrix = [[a - e - i, 0, 0, 0], [d + b, e - a - i, 0, 0], [g + c, h + f, i - a - e, 0],
              [h - f, c - g, d - b, a + e + i]]  # fmt: skip
    return np.linalg.eigh(np.array(matrix) / 3)[1][:, 3]


def rigid(turn, place):
    return np.block([[turn, place[:, None]], [np.zeros(3), np.ones(1)]])


FORMS = {
    "rotator": lambda p: {"location": p.at("xyz"), "rotation": p.rotator("pitch", "yaw", "roll")},
    "rotator upside": lambda p: {"Rotation": p.rotator("Roll", "Yaw", "Pitch"), "loc": p.place},
    "rotator flat": lambda p: p.at("xyz") | p.rotator("pitch_deg", "yaw_deg", "roll_deg"),
    "rotator list": lambda p: {"position": p.place, "rotation_pyr": p.angles("pitch yaw roll")},
    "rotator initials": lambda p: {"Loc": p.at("XYZ"), "Rot": p.initials()},
    "roll first": lambda p: {"position": p.place, "rotation_rpy": p.angles("roll pitch yaw")},
    "quaternion": lambda p: {"location": p.at("XYZ"), "rotation": p.quaternion("xyzw")},
    "quaternion wxyz": lambda p: {"t": p.place, "rotation_wxyz": [*p.quaternion("wxyz").values()]},
    "qx": lambda p: {"t": p.place} | {f"q{key}": v for key, v in p.quaternion("xyzw").items()},
    "3x3": lambda p: {"position": p.place, "rotation": p.turn.tolist()},
    "9": lambda p: {"position": p.place, "rotation_matrix": p.turn.ravel().tolist()},
    "4x4": lambda p: {"camera_to_world": p.matrix.tolist()},
    "m00": lambda p: {"matrix": {f"m{at // 4}{at % 4}": each
                                 for at, each in enumerate(p.matrix.ravel().tolist())}},
    "rows": lambda p: {"camera_to_world": p.matrix.T.tolist()},
    "3x4": lambda p: {"c2w": p.matrix[:3].tolist()},
    "inverse": lambda p: {"world_to_camera": np.linalg.inv(p.matrix).tolist()},
    "16 inverse": lambda p: {"w2c": np.linalg.inv(p.matrix).ravel().tolist()},
    "R and t": lambda p: {"world_to_camera": p.inverse_parts()},
    "rvec": lambda p: p.vectors("rvec"),
    "colmap": lambda p: p.vectors("qvec"),
}  # fmt: skip
ROTATORS_ONLY = {name for name in FORMS if name.startswith("ro") and name != "rows"}
STATED = {"rvec": "vector rad w2c", "colmap": "quaternion wxyz w2c"}
"""Forms that are read only where a file of conventions states them."""
SETTLED = [form for form in FORMS if form not in STATED]


class Written:
    """One pose, in the axes and the unit of a writer."""

    def __init__(self, rotator, place_cm, axes, unit):
        turn = WORLDS[axes] @ rotation_from_rotator_deg(rotator) @ CAMERAS[axes]
        self.turn = turn
        self.place = (WORLDS[axes] @ place_cm * {"cm": 1, "m": 0.01, "mm": 10}[unit]).tolist()
        self.matrix = rigid(turn, np.array(self.place))
        self._angles = dict(zip(("pitch", "yaw", "roll"), rotator.tolist(), strict=True))

    def at(self, names):
        return dict(zip(names, self.place, strict=True))

    def rotator(self, *names):
        return {name: self._angles[name.lower().removesuffix("_deg")] for name in names}

    def initials(self):
        return {name[0].upper(): angle for name, angle in self._angles.items()}

    def angles(self, order):
        return [self._angles[name] for name in order.split()]

    def quaternion(self, names):
        parts = dict(zip("xyzw", quaternion_xyzw(self.turn).tolist(), strict=True))
        return {name: parts[name] for name in names}

    def vectors(self, name):
        inverse = np.linalg.inv(self.matrix)
        x, y, z, w = quaternion_xyzw(inverse[:3, :3])
        angle = 2 * np.arccos(np.clip(w, -1, 1))
        vector = np.array([x, y, z]) * (angle / np.sin(angle / 2) if angle else 2.0)
        turn = {"rvec": vector.tolist(), "qvec": [w, x, y, z]}[name]
        return {name: turn, "tvec": inverse[:3, 3].tolist()}

    def inverse_parts(self):
        inverse = np.linalg.inv(self.matrix)
        return {"R": inverse[:3, :3].tolist(), "t": inverse[:3, 3].tolist()}


def written(form, rotators, places_cm, *, axes="unreal", unit="cm", **said):
    def pose(frame, camera):
        return FORMS[form](Written(rotators[frame, camera], places_cm[frame, camera], axes, unit))

    frames = frames_of(len(rotators), pose)
    return json.dumps({"unit": unit, "frames": frames} | said).encode()


def motions(poses):
    """The motions between cameras, and of each camera from its first place."""
    first = np.linalg.inv(poses.world_from_cam(0, 0))
    places = np.ndindex(poses.frame_count, 6)
    return np.array([first @ poses.world_from_cam(frame, camera) for frame, camera in places])


def truth(rotators, places_cm):
    turns = OPENCV_FROM_UNREAL @ rotation_from_rotator_deg(rotators) @ OPENCV_FROM_UNREAL.T
    return motions(CameraPoses(places_cm, 0.01, turns))


def understood(text, rig=RIG, **named):
    at = PosesAt(**named) if named else None
    return settled_poses(text, rig, where="trajectory.json", named=at)


TURNED = path([(-12.0, 33.0, 2.0), (-14.0, 37.0, 1.0), (-15.0, 44.0, -3.0)])


def assert_read(text, path=TURNED, atol=1e-9):
    """One reading is left, and its poses are those of a path."""
    found = understood(text)
    assert len(found.names) == 1
    np.testing.assert_allclose(motions(found.poses), truth(*path), atol=atol)


@pytest.mark.parametrize(
    ("form", "axes", "unit"),
    [
        *((form, "unreal", unit) for form in SETTLED for unit in ("cm", "m")),
        *((form, axes, "m") for form in SETTLED for axes in WORLDS
          if form not in ROTATORS_ONLY and axes != "unreal"),
    ],
)  # fmt: skip
def test_each_form_is_read_in_each_unit_and_world_and_never_mirrored(form, axes, unit):
    assert_read(written(form, *TURNED, axes=axes, unit=unit, coordinate_system=axes))


@pytest.mark.parametrize("axes", sorted(set(WORLDS) - {"unreal"}))
@pytest.mark.parametrize("form", ["quaternion wxyz", "4x4", "inverse", *STATED])
def test_what_nothing_names_is_refused_and_read_where_conventions_state_it(form, axes):
    text = written(form, *TURNED, axes=axes, unit="m")
    with pytest.raises(SchemaError, match=r"fits the rig|by its poses"):
        understood(text)

    found = understood(text, axes=axes, form=STATED.get(form))

    np.testing.assert_allclose(motions(found.poses), truth(*TURNED), atol=1e-9)


def test_readings_that_only_pictures_can_tell_apart_are_all_named():
    text = written("4x4", *TURNED, axes="opencv", unit="m", world="from OpenGL to OpenCV, axes")

    names = understood(text).names

    assert {name.rpartition(", ")[2].split()[0] for name in names} == {"opencv", "opengl"}


@pytest.mark.parametrize("form", SETTLED)
def test_what_is_settled_is_read_again_by_its_places_alone(form, monkeypatch):
    axes = "unreal" if form in ROTATORS_ONLY else "opencv"
    text = written(form, *TURNED, axes=axes, unit="m", coordinate_system=axes)
    settled = understood(text)
    monkeypatch.setattr(evidence, "recorded_in", None)

    again = declared_poses(text, RIG, where="trajectory.json", settled=settled)

    np.testing.assert_array_equal(again.poses.centres, settled.poses.centres)
    turns = settled.poses.world_from_cam_rotations
    np.testing.assert_array_equal(again.poses.world_from_cam_rotations, turns)
    assert (again.form, again.names) == (settled.form, settled.names)


@pytest.mark.parametrize("form", SETTLED)
def test_poses_are_read_again_by_the_name_that_an_index_has(form):
    axes = "unreal" if form in ROTATORS_ONLY else "opencv"
    text = written(form, *TURNED, axes=axes, unit="m", coordinate_system=axes)

    name, _, unit_m = understood(text).names[0].rpartition(" @ ")
    poses = poses_named(json.loads(text), name, where="trajectory.json")

    poses = replace(poses, unit_m=float(unit_m))
    np.testing.assert_allclose(motions(poses), truth(*TURNED), atol=1e-9)


def test_of_several_lists_of_poses_that_of_as_many_frames_as_the_videos_counts():
    document = json.loads(written("rotator", *TURNED))
    frames = document.pop("frames")
    document |= {"keyframes": frames[::2], "preroll": frames[:1], "frames": frames}
    text = json.dumps(document).encode()

    found = settled_poses(text, RIG, where="trajectory.json", frames=len(frames))

    np.testing.assert_allclose(motions(found.poses), truth(*TURNED), atol=1e-9)
    with pytest.raises(SchemaError, match="several readings of its poses fit the rig"):
        understood(text)


def test_frames_that_count_by_twos_are_frames_in_order():
    document = json.loads(written("rotator", *TURNED))
    for frame in document["frames"]:
        frame["frame"] = 2 * frame.pop("frame_index") + 6

    found = understood(json.dumps(document).encode())

    assert (found.at.frame, found.at.first, found.at.step) == ("$.frames[].frame", 6, 2)


@pytest.mark.parametrize(
    "count",
    [
        lambda n: {"image": f"frame_{n:04d}.png"},
        lambda n: {"meta": {"sequence_frame": 100 + n}},
        lambda n: {"elapsed": n / 15},
        lambda n: {"timecode": f"00:00:05:{n:02d}"},
        lambda n: {"cameras": [{"file": f"cam_{camera:02d}/{n}.png"} for camera in range(6)]},
    ],
)
def test_frames_in_another_order_than_what_counts_them_are_refused(count):
    document = json.loads(written("rotator", *TURNED))
    for number, frame in enumerate(document["frames"]):
        del frame["frame_index"]
        more = count(number)
        for pose, own in zip(frame["cameras"], more.pop("cameras", [{}] * 6), strict=True):
            pose |= own
        frame |= more | {"frames_left": 3 - number, "focus_number": [1, 3, 0][number]}
    assert understood(json.dumps(document).encode()).at.frame is None

    document["frames"].reverse()
    with pytest.raises(SchemaError, match=r"in another order than their \S+ says.*frame below"):
        understood(json.dumps(document).encode())


angles = st.tuples(st.floats(-60, 60), st.floats(-180, 180), st.floats(-15, 15))


@settings(max_examples=25)
@given(rotators=st.lists(angles, min_size=2, max_size=3), form=st.sampled_from(sorted(FORMS)))
def test_any_path_in_any_form_is_read_or_refused(rotators, form):
    rotators, places_cm = path(rotators)
    try:
        found = understood(written(form, rotators, places_cm))
    except SchemaError:
        return

    if len(found.names) == 1:
        np.testing.assert_allclose(motions(found.poses), truth(rotators, places_cm), atol=1e-6)


def test_the_form_that_a_file_names_is_kept_where_others_fit_too():
    still = path([(0.0, 0.0, 0.0), (0.0, 0.0, 0.0)])

    found = understood(written("rotator", *still, rotation_representation="rotator"))

    assert len(found.names) == 1
    assert "rotator pitch yaw roll deg, unreal axes" in found.names[0]


def test_a_named_form_that_fails_gives_way_to_one_that_fits():
    text = written("quaternion wxyz", *TURNED, rotation_representation="quaternion_xyzw")

    np.testing.assert_allclose(motions(understood(text).poses), truth(*TURNED), atol=1e-9)


def test_poses_beside_others_of_the_rig_alone_are_those_of_the_world():
    document = json.loads(written("rotator", *TURNED))
    for frame in document["frames"]:
        for camera, pose in enumerate(frame["cameras"]):
            pose["relative_location"] = {"x": 0.0, "y": PLACES_CM[camera], "z": 0.0}
            pose["relative_rotation"] = {"pitch": 0.0, "yaw": 0.0, "roll": 0.0}

    assert_read(json.dumps(document).encode())


@pytest.mark.parametrize(("factor", "unit"), [(1, "m"), (1, "mm"), (0.5, "cm"), (1.01, "cm")])
def test_distances_in_one_ratio_to_the_baselines_are_stated_in_two_ways(factor, unit):
    rotators, places_cm = TURNED
    document = json.loads(written("rotator", rotators, places_cm * factor)) | {"unit": unit}

    told = r"(?s)trajectory\.json: .* 66 cm apart, and by the poses.*in another unit or scaled"
    with pytest.raises(SidesError, match=told) as caught:
        understood(json.dumps(document).encode())

    scale = factor * {"m": 100, "mm": 0.1, "cm": 1}[unit]
    assert caught.value.scale == pytest.approx(scale, rel=1e-6)


def test_a_pose_that_is_no_number_is_named_with_frame_and_camera():
    document = json.loads(written("rotator", *TURNED))
    document["frames"][2]["cameras"][4]["rotation"]["yaw"] = None

    with pytest.raises(SchemaError, match=r"frame 2, camera 4: .*rotation\.yaw must be a number"):
        understood(json.dumps(document).encode())


def test_the_poses_of_another_rig_are_refused():
    rotators, places_cm = TURNED

    with pytest.raises(SchemaError, match=r"trajectory\.json: no reading of its poses fits"):
        understood(written("rotator", rotators, places_cm * np.linspace(1, 1.1, 6)[:, None]))


def test_a_left_camera_that_stands_on_the_right_is_a_contradiction():
    rotators, places_cm = TURNED
    mirrored = 2 * places_cm[:, :1] - places_cm  # all cameras to the left of camera 0

    with pytest.raises(SidesError, match="camera 0 is to the right of camera 1"):
        understood(written("rotator", rotators, mirrored, coordinate_system="Unreal"))
