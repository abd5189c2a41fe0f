"""trajectory.json: numbers are read where they stand, found by structure, and put in order."""

import json
import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.declaration import PosesAt
from stereogenbench_data.schema.pose_search import recorded_in
from stereogenbench_data.schema.trajectory import parse_trajectory, read_block
from tests.servers.scene_fixtures import frames_of

RELEASED = PosesAt(
    location="$.frames[].cameras[].location[x,y,z]",
    frame="$.frames[].frame_index",
    camera="$.frames[].cameras[].camera_index",
    outer="frames",
)


def recorded(document):
    text = json.dumps(document).encode()
    return recorded_in(parse_trajectory(text, where="trajectory.json"), where="trajectory.json")


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
        pytest.param(
            lambda d: {"shots": [{"frames": [[{"loc": p} for k, _, p in poses_of(d) if k == f]
                                             for f in range(3)]}]},
            id="lists in lists, of one shot",
        ),
        pytest.param(
            lambda d: {"frames": [{"t": f / 15, "cameras": [{"loc": p} for k, _, p in poses_of(d)
                                                            if k == f]} for f in range(3)]},
            id="frames with times in seconds",
        ),
        pytest.param(
            lambda d: {"frames": [{"t": (2 - f) / 15, "idx": 2 - f, "cameras": [
                {"loc": p} for k, _, p in poses_of(d) if k == 2 - f]} for f in range(3)]},
            id="times in seconds beside numbers, backwards",
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
        (change(["frames", 1, "cameras", 3], ...), r"frames\[1\]\.cameras has 5, and the first"),
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


@pytest.mark.parametrize("value", [math.nan, "9", None, True, {}, [1], 10**400])
def test_a_pose_that_is_no_number_is_named_with_frame_and_camera(trajectory_document, value):
    trajectory_document["frames"][1]["cameras"][2]["location"]["x"] = value

    told = r"frame 1, camera 2: \$\.frames\[1\]\.cameras\[2\]\.location\.x must be"
    (odd,) = recorded(trajectory_document).odd
    assert re.match(told, odd)


@pytest.mark.parametrize(
    ("path", "told"),
    [
        (
            ["frames", 1, "cameras", 3, "location", "y"],
            r"frames\[1\]\.cameras\[3\]\.location has no y",
        ),
        (["frames", 2, "cameras"], r"frames\[2\] has no cameras; it is an object"),
        (["frames", 2, "cameras", 0], r"frames\[2\]\.cameras has 5, and the first such has 6"),
        (["frames", 1, "frame_index"], r"frames\[1\] has no frame_index"),
    ],
)
def test_a_place_that_some_pose_does_not_have_is_named(trajectory_document, path, told):
    change(path, ...)(trajectory_document)

    with pytest.raises(SchemaError, match=rf"trajectory\.json: \$\.{told}"):
        read_block(trajectory_document, RELEASED, str(RELEASED.location), where="trajectory.json")


def places(document):
    """The locations of a document, (frame, 6, 3)."""
    return np.array([[[*each["location"].values()] for each in frame["cameras"]]
                     for frame in document["frames"]])  # fmt: skip


DECLARED = {
    "in the release's layout": (
        lambda document: document,
        {"frame": "$.frames[].frame_index", "camera": "$.frames[].cameras[].camera_index"},
        "$.frames[].cameras[].location[x,y,z]",
    ),
    "columns of each camera": (
        lambda document: {"cameras": [
            {"name": f"Cam_{camera:02d}", "at": dict(zip("XYZ", columns.tolist(), strict=True))}
            for camera, columns in enumerate(places(document).transpose(1, 2, 0))
        ][::-1]},
        {"camera": "$.cameras[].name", "outer": "cameras"},
        "$.cameras[].at[X[],Y[],Z[]]",
    ),
    "texts below keys that count": (
        lambda document: {f"frame_{2 * number + 1:04d}": {
            f"view {camera}": {"t": "({}, {}, {})".format(*place)}
            for camera, place in enumerate(poses)
        } for number, poses in enumerate(places(document).tolist())},
        {"frame": "${frame_}#", "camera": "${frame_}.{view }#", "first": 1, "step": 2},
        "${frame_}.{view }.t~",
    ),
    "keys that end in no number": (
        lambda document: {"frames": {f"frame_{number:04d}@{number / 15:.3f}s": {
            "abcdef"[camera] + "_rgb": {"camera": camera, "t": place}
            for camera, place in [*enumerate(poses)][::-1]
        } for number, poses in enumerate(places(document).tolist())}},
        {"frame": "$.frames{frame_*}#0", "camera": "$.frames{*}{*}.camera"},
        "$.frames{frame_*}{*}.t",
    ),
    "a part of a list, in rows": (
        lambda document: {"rows": [
            {"n": number, "c": camera, "pose": [*place, 9.0]}
            for number, poses in enumerate(places(document).tolist())
            for camera, place in enumerate(poses)
        ][::-1]},
        {"frame": "$.rows[].n", "camera": "$.rows[].c", "outer": "rows"},
        "$.rows[].pose[0:3]",
    ),
    "rows with two numbers in a name, components in an order of their own": (
        lambda document: {"images": [
            {"name": f"cam_{camera:02d}/{number:04d}.png", "t": {"z": x, "x": y, "y": z}}
            for number, poses in enumerate(places(document).tolist())
            for camera, (x, y, z) in enumerate(poses)
        ][::-1]},
        {"frame": "$.images[].name#1", "camera": "$.images[].name#0", "outer": "rows"},
        "$.images[].t[z,x,y]",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("write", "how", "place"), DECLARED.values(), ids=[*DECLARED])
def test_numbers_are_read_where_they_are_declared(trajectory_document, write, how, place):
    document = json.loads(json.dumps(write(trajectory_document)))

    found = read_block(document, PosesAt(**{"outer": "frames"} | how), place, where="t")

    np.testing.assert_array_equal(found.values, places(trajectory_document))


def test_frames_that_do_not_begin_or_grow_as_declared_are_refused(trajectory_document):
    at = PosesAt(frame="$.frames[].frame_index", outer="frames", first=1)

    with pytest.raises(SchemaError, match="frames must be numbered from 1 without a gap"):
        read_block(trajectory_document, at, "$.frames[].cameras[].location[x,y,z]", where="t")


def test_a_pose_of_very_many_numbers_is_not_read_place_by_place(trajectory_document):
    for frame in trajectory_document["frames"]:
        for pose in frame["cameras"]:
            pose |= {f"vector {number}": [1.0, 2.0, 3.0] for number in range(500)}

    assert len(recorded(trajectory_document).blocks) <= 40


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


def test_a_place_of_numbers_in_a_text_that_leads_to_no_text_says_what_stands_there(
    trajectory_document,
):
    with pytest.raises(SchemaError, match=r"frame 0, camera 0: .* found an object with 3 keys"):
        read_block(
            trajectory_document, RELEASED, "$.frames[].cameras[].location~", where="trajectory.json"
        )
