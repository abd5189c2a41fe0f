"""trajectory.json: numbers are found by structure, and refused where they have no order."""

import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.trajectory import record_poses
from tests.servers.scene_fixtures import frames_of


def recorded(document):
    return record_poses(json.dumps(document).encode(), where="trajectory.json")


def block(document, word):
    (found,) = (each for each in recorded(document).blocks if word in each.words)
    return found


def test_poses_are_found_as_they_are_recorded(trajectory_document):
    location, rotation = (block(trajectory_document, word) for word in ("location", "rotation"))

    assert recorded(trajectory_document).unit_m == 0.01
    assert rotation.components == ("pitch", "yaw", "roll")
    np.testing.assert_array_equal(location.values[2, 4], [200.0, 4.0, -5.0])
    np.testing.assert_array_equal(rotation.values[2, 4], [1.5, 20.0, -1.0])


def poses_of(document):
    """(frame, camera, x, y, z) of each pose of the fixture."""
    for frame in document["frames"]:
        for pose in frame["cameras"]:
            place = pose["location"]
            yield frame["frame_index"], pose["camera_index"], [place["x"], place["y"], place["z"]]


def nested(document, outer, inner, leaf):
    """Locations as nested objects, frames or cameras outermost."""
    found: dict = {}
    for frame, camera, place in poses_of(document):
        keys = {"frame": frame, "camera": camera}
        holder = found.setdefault(outer.format(**keys), {})
        holder[inner.format(**keys)] = leaf(place)
    return {"poses": found}


def named(place):
    return {"transform": {"Location_cm": dict(zip("XYZ", place, strict=True))}}


@pytest.mark.parametrize(
    "write",
    [
        pytest.param(lambda d: nested(d, "Town_Cam_{camera:02d}", "{frame}", named), id="cameras"),
        pytest.param(
            lambda d: nested(d, "{frame}", "{camera}", lambda place: {"position": place}),
            id="lists",
        ),
        pytest.param(
            lambda d: {
                "cameras": [
                    {"camera_name": f"Cam_{c:02d}", "location": [p for _, k, p in poses_of(d)
                                                                 if k == c]}
                    for c in reversed(range(6))
                ]
            },
            id="one list of a camera",
        ),
        pytest.param(
            lambda d: {
                "samples": [
                    {"frame": 3 - f, "views": [
                        {"id": c + 1, "location_x": p[0], "location_y": p[1], "location_z": p[2]}
                        for k, c, p in poses_of(d) if k == 2 - f
                    ][::-1]}
                    for f in range(3)
                ]
            },
            id="from one, backwards, flat",
        ),
        pytest.param(
            lambda d: [
                {"frame": 1001 + f} | {f"Town_Cam_{c:02d}": {"loc": p}
                                       for k, c, p in poses_of(d) if k == f}
                for f in range(3)
            ],
            id="a bare list, cameras beside other keys",
        ),
        pytest.param(
            lambda d: {"records": [{"cam": f"Cam_{c:02d}", "frame_index": f, "pos": p}
                                   for f, c, p in poses_of(d)][::-1]},
            id="records of a camera and a frame",
        ),
        pytest.param(
            lambda d: {"camera_order": [f"Cam_{c:02d}" for c in reversed(range(6))],
                       "frames": [{"cameras": [{"loc": p} for k, _, p in poses_of(d)
                                               if k == f][::-1]}
                                  for f in range(3)]},
            id="an order of its own",
        ),
    ],
)  # fmt: skip
def test_locations_are_found_at_any_depth_and_in_any_order(trajectory_document, write):
    found = recorded(write(trajectory_document)).blocks

    expected = block(trajectory_document, "location").values
    assert any(np.array_equal(each.values, expected) for each in found)


@pytest.mark.parametrize(
    ("unit", "metres"),
    [
        ("cm", 0.01),
        (" Centimetres ", 0.01),
        ("Unreal units (1 uu = 1 cm)", 0.01),
    ],
)
def test_a_unit_is_read_in_each_spelling(trajectory_document, unit, metres):
    assert recorded(trajectory_document | {"unit": unit}).unit_m == metres


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
    ("changes", "reason"),
    [
        (change(["frames"], ...), "no numbers of 6 cameras in each frame are in it"),
        (change(["frames", 1, "cameras", 3], ...), "no numbers of 6 cameras"),
        (change(["frames", 2, "frame_index"], 1), "frames must be .*, and 1 is there twice"),
        (change(["frames", 2, "frame_index"], 5), "frames must be .*, and there are 3 of 0 to 5"),
        (change(["frames", 1, "cameras", 3, "camera_index"], 2), "cameras must .*, and 2 is there"),
        (change(["frames", 1, "cameras", 3, "camera_index"], 6), "there are 6 of 0 to 6"),
        (change(["unit"], "furlongs"), r"\$\.unit: 'furlongs' is not a unit of length"),
    ],
)
def test_poses_that_cannot_be_put_in_order_are_refused(trajectory_document, changes, reason):
    changes(trajectory_document)

    with pytest.raises(SchemaError, match=rf"trajectory\.json: .*{reason}"):
        recorded(trajectory_document)


def test_cameras_that_are_numbered_in_two_ways_are_refused(trajectory_document):
    for frame in trajectory_document["frames"]:
        for pose in frame["cameras"]:
            pose["camera_name"] = f"Cam_{5 - pose['camera_index']:02d}"

    with pytest.raises(SchemaError, match="camera_index and camera_name number cameras apart"):
        recorded(trajectory_document)


@pytest.mark.parametrize("value", [math.nan, "9", None, True, {}, [1], 10**400])
def test_a_place_that_is_no_number_in_one_frame_is_no_number_at_all(trajectory_document, value):
    trajectory_document["frames"][1]["cameras"][2]["location"]["x"] = value

    blocks = recorded(trajectory_document).blocks

    locations = [each.values for each in blocks if "location" in each.words]
    assert all(np.isnan(each).any() for each in locations)


def test_nan_under_a_key_that_nobody_reads_is_ignored(trajectory_document):
    for frame in trajectory_document["frames"]:
        frame["exposure"] = math.nan

    assert len(recorded(trajectory_document).blocks) == 2


@settings(max_examples=60)
@given(numbers=st.lists(st.floats(-1e6, 1e6), min_size=36, max_size=36))
def test_every_number_of_a_pose_is_read_exactly(numbers):
    names = ("x", "y", "z", "pitch", "yaw", "roll")

    def pose(_, camera):
        values = dict(zip(names, numbers[6 * camera : 6 * camera + 6], strict=True))
        location = {name: values[name] for name in "xyz"}
        return {"location": location, "rotation": {n: values[n] for n in ("roll", "yaw", "pitch")}}

    document = {"frames": frames_of(1, pose)}
    expected = np.array(numbers).reshape(1, 6, 6)
    np.testing.assert_array_equal(block(document, "location").values, expected[..., :3])
    np.testing.assert_array_equal(block(document, "rotation").values, expected[..., 3:])
