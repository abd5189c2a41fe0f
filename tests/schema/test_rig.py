"""baseline.json: which keys are read, and what is refused."""

import itertools
import json
import math
import re
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema import spellings
from stereogenbench_data.schema.parse import parse_rig
from stereogenbench_data.schema.records import Rig

BASELINES_CM = (6.5, 13.25, 19.0, 26.0, 32.5, 6.75, 12.5, 19.5, 26.0, 5.75, 12.75, 19.25)
BASELINES_CM += (7.0, 13.5, 6.5)


def problems_of(document, dumped):
    with pytest.raises(SchemaError, match="problem") as caught:
        parse_rig(dumped(document), where="baseline.json")
    return [line.strip() for line in str(caught.value).splitlines()[1:]]


def test_a_rig_is_read_as_it_is_recorded(rig_document, dumped):
    rig, labels = parse_rig(dumped(rig_document), where="baseline.json")

    assert rig == Rig(32.5, 23.76, 17.82, 640, 480, None, BASELINES_CM, (0, 1), "recorded")
    assert (labels.scene_label, labels.scene_index, labels.map_name) == (
        "Town_scene_1166",
        1166,
        "Town",
    )


def test_the_scene_rendered_elsewhere_is_read(shared_scenes):
    path = next(shared_scenes.rglob("baseline.json"))

    rig, labels = parse_rig(path.read_bytes(), where="baseline.json")

    assert rig.focal_mm == 45.0
    assert rig.baselines_cm[:5] == (18.5, 51.5, 61.25000000000001, 122.50000000000001, 163.0)
    assert (labels.character, labels.animation) == ("SK_Ch13_nonPBR", "AN_Pontera")


def test_without_an_image_size_the_releases_size_is_assumed(rig_document, dumped):
    del rig_document["image_width"], rig_document["image_height"]

    rig, _ = parse_rig(dumped(rig_document), where="baseline.json")

    assert (rig.image_width_px, rig.image_height_px) == (1280, 1280)
    assert rig.image_size_source == "default"


def test_without_a_sensor_height_pixels_are_square(rig_document, dumped):
    del rig_document["camera_intrinsics"]["sensor_height_mm"]

    rig, _ = parse_rig(dumped(rig_document), where="baseline.json")

    assert rig.sensor_height_mm / 480 == pytest.approx(rig.sensor_width_mm / 640, rel=1e-15)


@pytest.mark.parametrize(
    ("pair", "expected"),
    [
        ({"left_camera": "Town_Cam_02", "right_camera": "Town_cam4"}, (2, 4)),
        ({"left_camera": 3, "right_camera": 5}, (3, 5)),
        ([1, 2], (1, 2)),
        (["Cam_00", "Cam_05"], (0, 5)),
    ],
)
def test_both_forms_of_the_primary_pair_are_read(rig_document, dumped, pair, expected):
    rig_document["primary_stereo_pair"] = pair

    rig, _ = parse_rig(dumped(rig_document), where="baseline.json")

    assert rig.primary_pair == expected


@pytest.mark.parametrize(
    ("pair", "problem"),
    [
        ([0, 6], "$.primary_stereo_pair[1]: is camera 6, and the rig has cameras 0 to 5"),
        ([2, 2], "$.primary_stereo_pair: has camera 2 on both sides"),
        ([0, True], "$.primary_stereo_pair[1]: must be the index of a camera"),
        ([0, 1, 2], "$.primary_stereo_pair: must be {left_camera, right_camera} or a list"),
        ({"left_camera": "Cam_left", "right_camera": 1}, "$.primary_stereo_pair.left_camera: must"),
        ({"left_camera": 0}, "$.primary_stereo_pair: right_camera is missing"),
        (None, "$: primary_stereo_pair is missing"),
    ],
)
def test_a_wrong_primary_pair_is_refused(rig_document, dumped, pair, problem):
    rig_document["primary_stereo_pair"] = pair

    found = problems_of(rig_document, dumped)

    assert len(found) == 1
    assert found[0].startswith(problem)


def test_a_principal_point_is_read(rig_document, dumped):
    rig_document["camera_intrinsics"]["principal_point_px"] = {"x": 300.5, "y": 250}

    rig, _ = parse_rig(dumped(rig_document), where="baseline.json")

    assert rig.principal_point_px == (300.5, 250.0)


def test_a_principal_point_that_is_null_is_none(rig_document, dumped):
    rig, _ = parse_rig(dumped(rig_document | {"principal_point": None}), where="baseline.json")

    assert rig.principal_point_px is None


@pytest.mark.parametrize(
    ("point", "found"),
    [
        ({"x": 300.5}, "must be {x, y} in pixels, found an object with 1 keys (x)"),
        ([300.5, 250.0], "must be {x, y} in pixels, found a list of 2"),
    ],
)
def test_a_principal_point_of_another_form_is_refused(rig_document, dumped, point, found):
    rig_document["camera_intrinsics"]["principal_point_px"] = point

    (problem,) = problems_of(rig_document, dumped)

    assert problem.startswith(f"$.camera_intrinsics.principal_point_px: {found}")


@pytest.mark.parametrize(
    ("known", "place", "unknown"),
    [
        ("camera_intrinsics.principal_point_px", "$", "principal_point"),
        ("camera_intrinsics.principal_point_px", "$", "cx"),
        ("camera_intrinsics.principal_point_px", "$.camera_intrinsics", "opticalCenter"),
        ("camera_intrinsics.sensor_height_mm", "$.camera_intrinsics", "sensor_height"),
        ("image_width", "$", "resolution"),
        ("image_width", "$.camera_intrinsics", "width_px"),
        ("image_height", "$", "imageHeight"),
        ("unit", "$", "length_unit"),
    ],
)
def test_an_unknown_key_that_may_hold_a_quantity_is_refused(
    rig_document, dumped, known, place, unknown
):
    """Its default would otherwise stand for what the file records."""
    holders = {"$": rig_document, "$.camera_intrinsics": rig_document["camera_intrinsics"]}
    *parents, last = known.split(".")
    holders["$" + "".join(f".{parent}" for parent in parents)].pop(last, None)
    holders[place][unknown] = 1

    problems = problems_of(rig_document, dumped)

    start = f"{place}.{unknown}: is not a known key and may stand for {known}."
    keys = ", ".join(sorted(holders[place]))
    assert any(each.startswith(start) and each.endswith(keys) for each in problems)


@pytest.mark.parametrize(
    ("value", "found"),
    [
        (math.nan, "must be a finite number, found nan"),
        (math.inf, "must be a finite number, found inf"),
        (True, "must be a finite number, found True"),
        ("6.5", "must be a finite number, found '6.5'"),
        ([6.5], "must be a finite number, found a list of 1"),
        (10**400, "must be a finite number, found 1000000"),
        (0, "must be a number above zero, found 0"),
        (-6.5, "must be a number above zero, found -6.5"),
    ],
)
def test_a_baseline_that_is_not_a_length_is_named_with_its_path(rig_document, dumped, value, found):
    rig_document["pairwise_pairs"][3]["baseline_cm"] = value

    problems = problems_of(rig_document, dumped)

    assert len(problems) == 1
    assert problems[0].startswith(f"$.pairwise_pairs[3].baseline_cm: {found}")


def test_a_pair_given_twice_names_both_places_and_the_pair_that_is_missing(rig_document, dumped):
    rig_document["pairwise_pairs"][7] = {
        "camera_index_a": 2,
        "camera_index_b": 0,
        "baseline_cm": 13.25,
    }

    assert problems_of(rig_document, dumped) == [
        "$.pairwise_pairs[7]: cameras 0 and 2 are already at $.pairwise_pairs[1]; "
        "remove the wrong entry",
        "$.pairwise_pairs: must have each of the 15 camera pairs once, and lacks 1-4",
    ]


def test_a_camera_outside_the_rig_is_named(rig_document, dumped):
    rig_document["pairwise_pairs"][4]["camera_index_b"] = 7

    assert problems_of(rig_document, dumped) == [
        "$.pairwise_pairs[4].camera_index_b: is camera 7, and the rig has cameras 0 to 5",
        "$.pairwise_pairs: must have each of the 15 camera pairs once, and lacks 0-5",
    ]


def test_a_pair_of_one_camera_is_refused(rig_document, dumped):
    rig_document["pairwise_pairs"][0]["camera_index_b"] = 0

    assert problems_of(rig_document, dumped)[0] == "$.pairwise_pairs[0]: has camera 0 twice"


@pytest.mark.parametrize(
    ("pairs", "problem"),
    [
        ({}, "$.pairwise_pairs: must be a list, found an empty object"),
        ([1], "$.pairwise_pairs[0]: must be an object, found 1"),
        ([], "$.pairwise_pairs: must have each of the 15 camera pairs once, and lacks 0-1"),
    ],
)
def test_pairs_must_be_a_list_of_objects(rig_document, dumped, pairs, problem):
    rig_document["pairwise_pairs"] = pairs

    assert problems_of(rig_document, dumped)[0].startswith(problem)


@pytest.mark.parametrize(
    ("record", "path"),
    [
        (
            {"adjacent_pairs": [{"camera_index_a": 1, "camera_index_b": 2, "baseline_cm": 6.8}]},
            "$.adjacent_pairs[0].baseline_cm",
        ),
        ({"baselines_adjacent_cm": [6.5, 6.8, 5.75, 7.0, 6.5]}, "$.baselines_adjacent_cm[1]"),
    ],
)
def test_adjacent_baselines_must_agree_with_the_pairwise_ones(rig_document, dumped, record, path):
    assert problems_of(rig_document | record, dumped) == [
        f"{path}: the baseline of cameras 1 and 2 is 6.8 cm here and 6.75 cm in pairwise_pairs"
    ]


def test_adjacent_baselines_may_be_rounded_to_float32(rig_document, dumped):
    rounded = [6.500000476837158, 6.75, 5.75, 7.0, 6.5]

    rig, _ = parse_rig(dumped(rig_document | {"baselines_adjacent_cm": rounded}), where="b")

    assert rig.baselines_cm == BASELINES_CM


def test_a_missing_quantity_is_named_with_its_place_and_the_keys_found(rig_document, dumped):
    intrinsics = rig_document["camera_intrinsics"]
    intrinsics["focalLength"] = intrinsics.pop("focal_length_mm")
    del rig_document["pairwise_pairs"]

    assert sorted(problems_of(rig_document, dumped)) == [
        "$.camera_intrinsics: focal_length_mm is missing; the keys here are: focalLength, "
        "sensor_height_mm, sensor_width_mm",
        "$: pairwise_pairs is missing; the keys here are: camera_count, camera_intrinsics, "
        "image_height, image_width, map_name, primary_stereo_pair, scene_index, scene_label, unit",
    ]


def test_missing_intrinsics_are_named_with_the_keys_of_the_file(rig_document, dumped):
    rig_document["intrinsics"] = rig_document.pop("camera_intrinsics")

    problems = problems_of(rig_document, dumped)

    assert problems[0].startswith("$: camera_intrinsics.sensor_width_mm is missing; the keys here")
    assert "image_width, intrinsics, map_name" in problems[0]


def test_all_problems_of_a_file_are_reported_at_once(rig_document, dumped):
    rig_document["camera_intrinsics"]["focal_length_mm"] = "32"
    rig_document["camera_intrinsics"]["sensor_width_mm"] = 0
    rig_document |= {"unit": "inch", "camera_count": 5, "image_width": 0.5, "image_height": -1}

    paths = [problem.split(": ")[0] for problem in problems_of(rig_document, dumped)]

    assert sorted(paths) == [
        "$.camera_count",
        "$.camera_intrinsics.focal_length_mm",
        "$.camera_intrinsics.sensor_width_mm",
        "$.image_height",
        "$.image_width",
        "$.unit",
    ]


def test_more_than_twenty_problems_are_counted(rig_document, dumped):
    rig_document["pairwise_pairs"] = [
        {"camera_index_a": 0, "camera_index_b": 10 + place, "baseline_cm": 1.0}
        for place in range(30)
    ]

    problems = problems_of(rig_document, dumped)

    assert len(problems) == 21
    assert problems[-1] == "and 11 more"


lengths = st.floats(0.5, 5000)


@settings(max_examples=100, deadline=None)
@given(baselines=st.lists(lengths, min_size=15, max_size=15))
def test_every_number_of_a_rig_is_read_exactly(baselines):
    pairs = zip(itertools.combinations(range(6), 2), baselines, strict=True)
    document = {
        "camera_intrinsics": {
            "focal_length_mm": 45.0,
            "sensor_width_mm": 23.76,
            "sensor_height_mm": 13.3,
            "aperture_fstop": 4,
        },
        "image_width": 640,
        "image_height": 360,
        "primary_stereo_pair": [1, 2],
        "pairwise_pairs": [
            {"camera_index_a": a, "camera_index_b": b, "baseline_cm": length}
            for (a, b), length in pairs
        ],
    }

    rig, labels = parse_rig(json.dumps(document).encode(), where="baseline.json")

    assert rig == Rig(45.0, 23.76, 13.3, 640, 360, None, tuple(baselines), (1, 2))
    assert labels.aperture_fstop == 4.0


def test_every_key_of_the_table_has_its_evidence():
    table = Path(spellings.__file__).read_text().partition("SPELLINGS")[2].partition("}")[0]
    rows = [line for line in table.splitlines() if line.strip().startswith('"')]

    assert len(rows) == len(spellings.SPELLINGS)
    assert [row for row in rows if not re.search(r"# \[[PVSX]\]", row)] == []
