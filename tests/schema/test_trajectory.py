"""trajectory.json: poses in every representation, and what is refused."""

import copy
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.spellings import SPELLINGS
from stereogenbench_data.schema.trajectory import parse_trajectory


def parsed(document):
    return parse_trajectory(json.dumps(document).encode(), where="trajectory.json")


def problems_of(document):
    with pytest.raises(SchemaError, match=r"trajectory\.json: .*problem") as caught:
        parsed(document)
    return [line.strip() for line in str(caught.value).splitlines()[1:]]


def poses_of(document):
    return [pose for frame in document["frames"] for pose in frame["cameras"]]


def with_rotations(document, representation, write):
    """The document with each rotation as another function of pitch, yaw and roll writes it."""
    document = copy.deepcopy(document)
    document["rotation_representation"] = representation
    for pose in poses_of(document):
        turn = pose["rotation"]
        pose["rotation"] = write(turn["pitch"], turn["yaw"], turn["roll"])
    return document


def scipy_rotation(pitch, yaw, roll):
    return Rotation.from_euler("ZYX", [yaw, -pitch, -roll], degrees=True)


def test_poses_are_read_as_they_are_recorded(trajectory_document):
    trajectory = parsed(trajectory_document)

    assert trajectory.frame_count == 3
    assert trajectory.unit_m == 0.01
    assert trajectory.rotation_kind == "rotator_deg"
    np.testing.assert_array_equal(trajectory.locations[2, 4], [200.0, 4.0, -5.0])
    np.testing.assert_array_equal(trajectory.rotations[2, 4], [1.5, 20.0, -1.0])


def test_poses_cannot_be_changed(trajectory_document):
    trajectory = parsed(trajectory_document)

    for array in (trajectory.locations, trajectory.rotations):
        assert array.dtype == np.float64
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_the_trajectory_rendered_elsewhere_is_read(shared_scenes):
    path = next(shared_scenes.rglob("trajectory.json"))

    trajectory = parse_trajectory(path.read_bytes(), where="trajectory.json")

    assert trajectory.frame_count == 81
    np.testing.assert_array_equal(
        trajectory.locations[0, 1], [1048.871369760287, -2865.2410888569193, 304.99999521731604]
    )
    np.testing.assert_array_equal(
        trajectory.rotations[80, 5], [-5.141698439627633, -103.65434103936865, -3.851218266492164]
    )


def test_a_world_offset_keeps_every_digit(trajectory_document):
    far = 987654.3210123456
    poses_of(trajectory_document)[3]["location"]["x"] = far

    assert parsed(trajectory_document).locations[0, 3, 0] == far


@pytest.mark.parametrize(
    ("unit", "metres"),
    [("cm", 0.01), ("Centimeters", 0.01), ("m", 1.0), ("metre", 1.0), (" MM ", 0.001)],
)
def test_a_unit_is_read_in_each_spelling(trajectory_document, unit, metres):
    assert parsed(trajectory_document | {"unit": unit}).unit_m == metres


def test_without_a_unit_lengths_are_centimetres(trajectory_document):
    del trajectory_document["unit"]

    assert parsed(trajectory_document).unit_m == 0.01


def radians(pitch, yaw, roll):
    return {
        "pitch": math.radians(pitch),
        "yaw": math.radians(yaw),
        "roll": math.radians(roll),
    }


@pytest.mark.parametrize(
    ("representation", "write"),
    [
        ("rotator_radians", radians),
        ("rotator_pitch_yaw_roll_degrees", lambda pitch, yaw, roll: [pitch, yaw, roll]),
        ("Euler (roll, pitch, yaw) degrees", lambda pitch, yaw, roll: [roll, pitch, yaw]),
        ("rpy_deg", lambda pitch, yaw, roll: [roll, pitch, yaw]),
        ("FRotator", lambda pitch, yaw, roll: {"Roll": roll, "Pitch": pitch, "Yaw": yaw}),
        ("unreal", lambda pitch, yaw, roll: {"pitch": pitch, "yaw": yaw, "roll": roll}),
        (None, lambda pitch, yaw, roll: {"pitch": pitch, "yaw": yaw, "roll": roll}),
    ],
)
def test_a_rotator_is_read_in_each_form(trajectory_document, representation, write):
    document = with_rotations(trajectory_document, representation, write)

    found = parsed(document)

    assert found.rotation_kind == "rotator_deg"
    np.testing.assert_allclose(
        found.rotations, parsed(trajectory_document).rotations, rtol=1e-15, atol=1e-15
    )


def quaternion(pitch, yaw, roll):
    return scipy_rotation(pitch, yaw, roll).as_quat().tolist()


@pytest.mark.parametrize(
    ("representation", "write"),
    [
        ("quaternion", quaternion),
        ("quaternion_xyzw", quaternion),
        ("quaternion_wxyz", lambda *angles: [quaternion(*angles)[k] for k in (3, 0, 1, 2)]),
        ("quat (w, x, y, z)", lambda *angles: [quaternion(*angles)[k] for k in (3, 0, 1, 2)]),
        ("quaternion scalar-first", lambda *angles: [quaternion(*angles)[k] for k in (3, 0, 1, 2)]),
        ("quaternion_wxyz", lambda *angles: dict(zip("xyzw", quaternion(*angles), strict=True))),
        (None, lambda *angles: dict(zip("XYZW", quaternion(*angles), strict=True))),
        (None, quaternion),
    ],
)
def test_a_quaternion_is_read_in_each_form(trajectory_document, representation, write):
    found = parsed(with_rotations(trajectory_document, representation, write))

    assert found.rotation_kind == "quaternion_xyzw"
    np.testing.assert_allclose(found.rotations[2, 3], quaternion(1.5, 20.0, -0.75), atol=1e-15)


def matrix(pitch, yaw, roll):
    return scipy_rotation(pitch, yaw, roll).as_matrix()


@pytest.mark.parametrize(
    ("representation", "write"),
    [
        ("rotation_matrix", lambda *angles: matrix(*angles).tolist()),
        ("matrix3x3_row_major", lambda *angles: matrix(*angles).ravel().tolist()),
        ("matrix_column_major", lambda *angles: matrix(*angles).T.ravel().tolist()),
        ("rotation_matrix_row_vectors", lambda *angles: matrix(*angles).T.tolist()),
        ("transposed rotation matrix", lambda *angles: matrix(*angles).T.tolist()),
        (None, lambda *angles: matrix(*angles).tolist()),
    ],
)
def test_a_matrix_is_read_in_each_form(trajectory_document, representation, write):
    found = parsed(with_rotations(trajectory_document, representation, write))

    assert found.rotation_kind == "matrix"
    np.testing.assert_array_equal(found.rotations[2, 3], matrix(1.5, 20.0, -0.75))


def test_a_quaternion_that_is_nearly_unit_is_normalised(trajectory_document):
    document = with_rotations(
        trajectory_document, "quaternion", lambda *angles: [1.0009 * q for q in quaternion(*angles)]
    )

    norms = np.linalg.norm(parsed(document).rotations, axis=-1)

    np.testing.assert_allclose(norms, 1.0, rtol=1e-15)


@pytest.mark.parametrize(
    ("representation", "rotation", "problem"),
    [
        ("quaternion", [0.0, 0.0, 0.0, 0.0], "a rotation's quaternion has length 1 within 0.001"),
        ("quaternion", [0.0, 0.0, 0.0, 1.002], "a rotation's quaternion has length 1 within 0.001"),
        ("matrix", [1.01, 0, 0, 0, 1, 0, 0, 0, 1], "a rotation's matrix is orthonormal within"),
        ("matrix", [[1, 0, 0], [0, 1, 0], [0, 0, -1]], "the matrix mirrors (its determinant"),
        ("matrix", [[0, 0, 0]] * 3, "a rotation's matrix is orthonormal within"),
        (
            "rotator",
            {"pitch": 0, "yaw": math.nan, "roll": 0},
            "must hold finite numbers, found nan",
        ),
        ("rotator", {"pitch": 0, "yaw": "9", "roll": 0}, "must hold finite numbers, found '9'"),
        ("rotator", {"pitch": 0, "yaw": True, "roll": 0}, "must hold finite numbers, found True"),
        ("rotator", {"pitch": 0, "yaw": 0}, "must be {pitch, yaw, roll}, a quaternion"),
        ("quaternion", [1, 2, 3, 4, 5], "must be {pitch, yaw, roll}, a quaternion"),
        ("quaternion", {"pitch": 0, "yaw": 0, "roll": 0}, "is a rotator, but rotation_repr"),
        ("unreal_rotator_degrees", [0, 0, 0, 1], "is a quaternion, but rotation_representation is"),
        ("rotator", [1, 2, 3], "three angles without names have no order; write {pitch, yaw,"),
    ],
)
def test_a_rotation_that_is_none_is_named_with_its_path(
    trajectory_document, representation, rotation, problem
):
    turns = {
        "quaternion": [0, 0, 0, 1],
        "matrix": np.eye(3).tolist(),
    }
    document = with_rotations(
        trajectory_document,
        representation,
        lambda *angles: turns.get(
            representation, dict(zip(("pitch", "yaw", "roll"), angles, strict=True))
        ),
    )
    document["frames"][1]["cameras"][2]["rotation"] = rotation

    problems = problems_of(document)

    assert len(problems) == 1
    assert problems[0].startswith(f"$.frames[1].cameras[2].rotation: {problem}")


def test_a_representation_that_nobody_knows_is_refused(trajectory_document):
    problems = problems_of(trajectory_document | {"rotation_representation": "axis_angle"})

    assert problems[0].startswith("$.rotation_representation: is no rotation representation")
    assert "'quaternion_wxyz'" in problems[0]


def test_one_complaint_about_all_poses_is_told_once(trajectory_document):
    document = with_rotations(trajectory_document, "rotator", lambda *angles: list(angles))

    problems = problems_of(document)

    assert len(problems) == 1
    assert problems[0].startswith("$.frames[0].cameras[0].rotation: three angles")
    assert problems[0].endswith("(and so in 17 more places)")


def test_the_rotation_that_the_representation_names_is_taken_of_two(trajectory_document):
    trajectory_document["rotation_representation"] = "quaternion"
    for pose in poses_of(trajectory_document):
        pose["quaternion"] = [0.0, 0.0, 0.0, 1.0]

    assert parsed(trajectory_document).rotation_kind == "quaternion_xyzw"


def test_frames_and_cameras_are_put_in_order(trajectory_document):
    shuffled = copy.deepcopy(trajectory_document)
    shuffled["frames"].reverse()
    for frame in shuffled["frames"]:
        frame["cameras"].reverse()

    expected, found = parsed(trajectory_document), parsed(shuffled)

    np.testing.assert_array_equal(found.locations, expected.locations)
    np.testing.assert_array_equal(found.rotations, expected.rotations)


@pytest.mark.parametrize("name", ["Town_scene_7_Cam_{:02d}", "cam{}", "{}"])
def test_cameras_may_be_keyed_by_name(trajectory_document, name):
    keyed = copy.deepcopy(trajectory_document)
    for frame in keyed["frames"]:
        frame["cameras"] = {
            name.format(pose.pop("camera_index")): pose for pose in reversed(frame["cameras"])
        }

    np.testing.assert_array_equal(parsed(keyed).locations, parsed(trajectory_document).locations)


def test_cameras_may_be_told_by_the_files_camera_order(trajectory_document):
    ordered = copy.deepcopy(trajectory_document)
    ordered["camera_order"] = [f"Cam_{camera:02d}" for camera in reversed(range(6))]
    for frame in ordered["frames"]:
        frame["cameras"].reverse()
        for pose in frame["cameras"]:
            del pose["camera_index"]

    np.testing.assert_array_equal(parsed(ordered).locations, parsed(trajectory_document).locations)


def test_places_may_be_lists_under_another_name(trajectory_document):
    listed = copy.deepcopy(trajectory_document)
    for pose in poses_of(listed):
        pose["transform"] = {
            "Translation": list(pose.pop("location").values()),
            "rotation": pose.pop("rotation"),
        }

    np.testing.assert_array_equal(parsed(listed).locations, parsed(trajectory_document).locations)


def test_frames_without_indices_count_from_zero(trajectory_document):
    for frame in trajectory_document["frames"]:
        del frame["frame_index"]

    assert parsed(trajectory_document).frame_count == 3


def change(path, value):
    """A change of one place of a document; a value of `...` deletes it."""

    def apply(document):
        *parents, last = path
        for key in parents:
            document = document[key]
        if value is ...:
            del document[last]
        else:
            document[last] = value

    return apply


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        (
            change(["frames"], ...),
            "$: frames is missing (or, in any case style, trajectory, poses)",
        ),
        (change(["frames"], {}), "$.frames: must be a list, found an empty object"),
        (change(["frames"], []), "$.frames: has no frame"),
        (change(["frames", 1], None), "$.frames[1]: must be an object, found null"),
        (
            change(["frames", 2, "frame_index"], 1),
            "$.frames[2].frame_index: frame 1 was already given at $.frames[1]",
        ),
        (
            change(["frames", 2, "frame_index"], 5),
            "$.frames: frames must be numbered from 0 without a gap; there are 3 numbers up to 5",
        ),
        (change(["frames", 1, "frame_index"], ...), "$.frames[1]: frame_index is missing"),
        (change(["frames", 1, "frame_index"], 0.5), "$.frames[1].frame_index: must be an integer"),
        (
            change(["frames", 1, "cameras", 3], ...),
            "$.frames[1].cameras: has no pose of camera 3",
        ),
        (
            change(["frames", 1, "cameras", 3, "camera_index"], 2),
            "$.frames[1].cameras[3]: camera 2 was already given at $.frames[1].cameras[2]",
        ),
        (
            change(["frames", 1, "cameras", 3, "camera_index"], 6),
            "$.frames[1].cameras[3].camera_index: names camera 6, and the rig's cameras are 0 to 5",
        ),
        (
            change(["frames", 1, "cameras", 3, "camera_index"], ...),
            "$.frames[1].cameras[3]: camera_index is missing",
        ),
        (
            change(["frames", 1, "cameras", 3, "camera_name"], "Cam_02"),
            "$.frames[1].cameras[3]: camera_index is 3 and the name is that of camera 2",
        ),
        (
            change(["frames", 1, "cameras"], "none"),
            "$.frames[1].cameras: must be a list, found 'none'",
        ),
        (
            change(["frames", 1, "cameras", 3, "location"], ...),
            "$.frames[1].cameras[3]: location is missing",
        ),
        (
            change(["frames", 1, "cameras", 3, "location"], [1, 2]),
            "$.frames[1].cameras[3].location: must be {x, y, z} or [x, y, z], found a list of 2",
        ),
        (
            change(["frames", 1, "cameras", 3, "location", "x"], math.inf),
            "$.frames[1].cameras[3].location: must hold finite numbers, found inf",
        ),
        (
            change(["frames", 1, "cameras", 3, "location", "x"], 10**400),
            "$.frames[1].cameras[3].location: must hold finite numbers, found 1000",
        ),
        (
            change(["frames", 1, "cameras", 3, "rotation"], None),
            "$.frames[1].cameras[3]: rotation is missing",
        ),
        (change(["camera_count"], 4), "$.camera_count: a rig has 6 cameras, found 4"),
        (change(["unit"], "feet"), "$.unit: must be a unit of length (cm, m or mm), found 'feet'"),
    ],
)
def test_what_does_not_follow_the_format_is_named_with_its_path(
    trajectory_document, changes, problem
):
    changes(trajectory_document)

    assert any(found.startswith(problem) for found in problems_of(trajectory_document))


@settings(max_examples=60, deadline=None)
@given(
    numbers=st.lists(st.floats(-1e6, 1e6), min_size=36, max_size=36),
    location=st.sampled_from(SPELLINGS["location"]),
    rotation=st.sampled_from(SPELLINGS["rotation"] + SPELLINGS["rotator"]),
    cameras=st.sampled_from(SPELLINGS["cameras"]),
    index=st.sampled_from(SPELLINGS["camera_index"]),
)
def test_every_spelling_of_a_pose_is_the_same_pose(numbers, location, rotation, cameras, index):
    poses = []
    for camera in range(6):
        x, y, z, pitch, yaw, roll = numbers[6 * camera : 6 * camera + 6]
        pose = {index: camera}
        for spelling, value in (
            (location, [x, y, z]),
            (rotation, {"roll": roll, "yaw": yaw, "pitch": pitch}),
        ):
            place = pose
            *parents, last = spelling.split(".")
            for key in parents:
                place = place.setdefault(key, {})
            place[last] = value
        poses.append(pose)

    trajectory = parsed({"frames": [{cameras: poses}]})

    expected = np.array(numbers).reshape(1, 6, 6)
    np.testing.assert_array_equal(trajectory.locations, expected[..., :3])
    np.testing.assert_array_equal(trajectory.rotations, expected[..., 3:])
