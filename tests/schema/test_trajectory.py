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
from stereogenbench_data.schema.trajectory import parse_trajectory

ROTATOR = "unreal_rotator_degrees"


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
    [("cm", 0.01), ("Centimeters", 0.01), (" centimetres ", 0.01)],
)
def test_a_unit_is_read_in_each_spelling(trajectory_document, unit, metres):
    assert parsed(trajectory_document | {"unit": unit}).unit_m == metres


def test_without_a_unit_lengths_are_centimetres(trajectory_document):
    del trajectory_document["unit"]

    assert parsed(trajectory_document).unit_m == 0.01


def test_a_rotator_without_a_representation_is_in_degrees(trajectory_document):
    expected = parsed(trajectory_document)
    del trajectory_document["rotation_representation"]

    found = parsed(trajectory_document)

    assert found.rotation_kind == "rotator_deg"
    np.testing.assert_array_equal(found.rotations, expected.rotations)


def quaternion(pitch, yaw, roll):
    return scipy_rotation(pitch, yaw, roll).as_quat().tolist()


@pytest.mark.parametrize(
    ("representation", "write"),
    [
        ("quaternion_xyzw", quaternion),
        ("quaternion_wxyz", lambda *angles: [quaternion(*angles)[k] for k in (3, 0, 1, 2)]),
    ],
)
def test_a_quaternion_is_read_in_each_form(trajectory_document, representation, write):
    found = parsed(with_rotations(trajectory_document, representation, write))

    assert found.rotation_kind == "quaternion_xyzw"
    np.testing.assert_allclose(found.rotations[2, 3], quaternion(1.5, 20.0, -0.75), atol=1e-15)


def matrix(pitch, yaw, roll):
    return scipy_rotation(pitch, yaw, roll).as_matrix()


def test_a_matrix_is_read(trajectory_document):
    document = with_rotations(
        trajectory_document, "matrix_3x3", lambda *angles: matrix(*angles).tolist()
    )

    found = parsed(document)

    assert found.rotation_kind == "matrix"
    np.testing.assert_array_equal(found.rotations[2, 3], matrix(1.5, 20.0, -0.75))


def test_a_quaternion_that_is_nearly_unit_is_normalised(trajectory_document):
    document = with_rotations(
        trajectory_document,
        "quaternion_xyzw",
        lambda *angles: [1.0009 * q for q in quaternion(*angles)],
    )

    norms = np.linalg.norm(parsed(document).rotations, axis=-1)

    np.testing.assert_allclose(norms, 1.0, rtol=1e-15)


@pytest.mark.parametrize(
    ("representation", "rotation", "problem"),
    [
        ("quaternion_xyzw", [0.0, 0.0, 0.0, 0.0], "a quaternion must have length 1 within 0.001"),
        ("quaternion_wxyz", [1.002, 0.0, 0.0, 0.0], "a quaternion must have length 1 within 0.001"),
        ("matrix_3x3", [[1.01, 0, 0], [0, 1, 0], [0, 0, 1]], "a rotation matrix must be orthonorm"),
        ("matrix_3x3", [[1, 0, 0], [0, 1, 0], [0, 0, -1]], "the matrix mirrors (its determinant"),
        ("matrix_3x3", [[0, 0, 0]] * 3, "a rotation matrix must be orthonormal within"),
        (ROTATOR, {"pitch": 0, "yaw": math.nan, "roll": 0}, "must hold finite numbers, found nan"),
        (ROTATOR, {"pitch": 0, "yaw": "9", "roll": 0}, "must hold finite numbers, found '9'"),
        (ROTATOR, {"pitch": 0, "yaw": True, "roll": 0}, "must hold finite numbers, found True"),
        (ROTATOR, {"pitch": 0, "yaw": 0}, "must be {pitch, yaw, roll} in degrees"),
        (ROTATOR, [0, 0, 0, 1], "must be {pitch, yaw, roll} in degrees"),
        (ROTATOR, [1, 2, 3], "must be {pitch, yaw, roll} in degrees"),
        ("quaternion_xyzw", [1, 2, 3, 4, 5], "must be a list x, y, z, w"),
        ("quaternion_wxyz", {"pitch": 0, "yaw": 0, "roll": 0}, "must be a list w, x, y, z"),
        ("matrix_3x3", [1, 0, 0, 0, 1, 0, 0, 0, 1], "must be three rows of three numbers"),
        ("matrix_3x3", [1, 2, 3], "must be three rows of three numbers"),
    ],
)
def test_a_rotation_that_is_not_one_is_named_with_its_path(
    trajectory_document, representation, rotation, problem
):
    turns = {
        ROTATOR: {"pitch": 0, "yaw": 0, "roll": 0},
        "quaternion_xyzw": [0, 0, 0, 1],
        "quaternion_wxyz": [1, 0, 0, 0],
        "matrix_3x3": np.eye(3).tolist(),
    }
    document = with_rotations(trajectory_document, representation, lambda *_: turns[representation])
    document["frames"][1]["cameras"][2]["rotation"] = rotation

    problems = problems_of(document)

    assert len(problems) == 1
    assert problems[0].startswith(f"$.frames[1].cameras[2].rotation: {problem}")


@pytest.mark.parametrize("name", ["axis_angle", "quaternion", "rotator", 3])
def test_an_unknown_representation_is_refused(trajectory_document, name):
    (problem,) = problems_of(trajectory_document | {"rotation_representation": name})

    assert problem.startswith("$.rotation_representation: must be one of unreal_rotator_degrees, ")
    assert problem.endswith(f"found {name!r}")


@pytest.mark.parametrize(
    ("known", "unknown"),
    [
        ("rotation_representation", "orientation_format"),
        ("unit", "locationUnit"),
    ],
)
def test_an_unknown_key_that_may_hold_a_quantity_is_refused(trajectory_document, known, unknown):
    trajectory_document[unknown] = trajectory_document.pop(known)

    (problem,) = problems_of(trajectory_document)

    assert problem.startswith(f"$.{unknown}: is not a known key and may stand for {known}.")
    assert problem.endswith(f"the keys here are: {', '.join(sorted(trajectory_document))}")


def test_an_unknown_key_for_the_number_of_a_frame_is_refused(trajectory_document):
    for frame in trajectory_document["frames"]:
        frame["frame_number"] = frame.pop("frame_index")

    (problem,) = problems_of(trajectory_document)

    assert problem.startswith("$.frames[0].frame_number: is not a known key")
    assert problem.endswith("the keys here are: cameras, frame_number (and in 2 more places)")


def test_one_complaint_about_all_poses_is_reported_once(trajectory_document):
    document = with_rotations(trajectory_document, ROTATOR, lambda *angles: list(angles))

    (problem,) = problems_of(document)

    assert problem.startswith("$.frames[0].cameras[0].rotation: must be {pitch, yaw, roll}")
    assert problem.endswith("found a list of 3 (and in 17 more places)")


def test_frames_and_cameras_are_put_in_order(trajectory_document):
    shuffled = copy.deepcopy(trajectory_document)
    shuffled["frames"].reverse()
    for frame in shuffled["frames"]:
        frame["cameras"].reverse()

    expected, found = parsed(trajectory_document), parsed(shuffled)

    np.testing.assert_array_equal(found.locations, expected.locations)
    np.testing.assert_array_equal(found.rotations, expected.rotations)


def test_cameras_may_be_identified_by_name_alone(trajectory_document):
    named = copy.deepcopy(trajectory_document)
    for frame in named["frames"]:
        frame["cameras"].reverse()
        for pose in frame["cameras"]:
            pose["camera_name"] = f"Town_scene_7_Cam_{pose.pop('camera_index'):02d}"

    np.testing.assert_array_equal(parsed(named).locations, parsed(trajectory_document).locations)


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
            "$: frames is missing; the keys here are: rotation_representation, unit",
        ),
        (change(["frames"], {}), "$.frames: must be a list, found an empty object"),
        (change(["frames"], []), "$.frames: has no frame"),
        (change(["frames", 1], None), "$.frames[1]: must be an object, found null"),
        (
            change(["frames", 2, "frame_index"], 1),
            "$.frames[2].frame_index: frame 1 is already at $.frames[1]",
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
            "$.frames[1].cameras[3]: camera 2 is already at $.frames[1].cameras[2]",
        ),
        (
            change(["frames", 1, "cameras", 3, "camera_index"], 6),
            "$.frames[1].cameras[3].camera_index: is camera 6, and the rig has cameras 0 to 5",
        ),
        (
            change(["frames", 1, "cameras", 3, "camera_index"], ...),
            "$.frames[1].cameras[3]: camera_index is missing",
        ),
        (
            change(["frames", 1, "cameras", 3, "camera_name"], "Cam_02"),
            "$.frames[1].cameras[3]: camera_index is 3 but camera_name is that of camera 2",
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
            "$.frames[1].cameras[3].location: must be {x, y, z}, found a list of 2",
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
        (
            change(["unit"], "feet"),
            "$.unit: must be one of cm, centimeters, centimetres, found 'feet'",
        ),
    ],
)
def test_a_violation_of_the_format_is_named_with_its_path(trajectory_document, changes, problem):
    changes(trajectory_document)

    assert any(found.startswith(problem) for found in problems_of(trajectory_document))


@settings(max_examples=60, deadline=None)
@given(numbers=st.lists(st.floats(-1e6, 1e6), min_size=36, max_size=36))
def test_every_number_of_a_pose_is_read_exactly(numbers):
    names = ("x", "y", "z", "pitch", "yaw", "roll")
    poses = []
    for camera in range(6):
        values = dict(zip(names, numbers[6 * camera : 6 * camera + 6], strict=True))
        poses.append(
            {
                "camera_index": camera,
                "location": {name: values[name] for name in "xyz"},
                "rotation": {name: values[name] for name in ("roll", "yaw", "pitch")},
            }
        )

    trajectory = parsed({"frames": [{"cameras": poses}]})

    expected = np.array(numbers).reshape(1, 6, 6)
    np.testing.assert_array_equal(trajectory.locations, expected[..., :3])
    np.testing.assert_array_equal(trajectory.rotations, expected[..., 3:])
