"""baseline.json: what is read under which spelling, and what is refused."""

import itertools
import json
import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.records import Rig
from stereogenbench_data.schema.rig import parse_rig
from stereogenbench_data.schema.spellings import SPELLINGS

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


def test_without_an_image_size_the_rig_is_for_the_releases(rig_document, dumped):
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
        ({"leftCamera": "camera_01", "rightCamera": "camera_00"}, (1, 0)),
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
        ([0, 6], "$.primary_stereo_pair[1]: names camera 6, and the rig's cameras are 0 to 5"),
        ([2, 2], "$.primary_stereo_pair: names camera 2 as left and as right"),
        ([0, True], "$.primary_stereo_pair[1]: must name a camera"),
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


@pytest.mark.parametrize(
    "override",
    [
        {"principal_point": {"x": 300.5, "y": 250.0}},
        {"principalPoint": [300.5, 250.0]},
        {"camera_intrinsics": {"cx": 300.5, "cy": 250}},
        {"principal_point_override": {"cx": 300.5, "cy": 250.0}},
        {"principal_point_x_px": 300.5, "principal_point_y_px": 250.0},
    ],
)
def test_a_principal_point_is_read_in_each_form(rig_document, dumped, override):
    rig_document["camera_intrinsics"] |= override.pop("camera_intrinsics", {})

    rig, _ = parse_rig(dumped(rig_document | override), where="baseline.json")

    assert rig.principal_point_px == (300.5, 250.0)


def test_a_principal_point_that_is_null_is_none(rig_document, dumped):
    rig, _ = parse_rig(dumped(rig_document | {"principal_point": None}), where="baseline.json")

    assert rig.principal_point_px is None


def test_half_a_principal_point_is_refused(rig_document, dumped):
    assert problems_of(rig_document | {"cx": 300.5}, dumped) == [
        "$.cx: one coordinate of the principal point is recorded and the other is not"
    ]


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
def test_a_baseline_that_is_no_length_is_named_with_its_path(rig_document, dumped, value, found):
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
        "$.pairwise_pairs[7]: cameras 0 and 2 were already given at $.pairwise_pairs[1]; "
        "keep the right one of the two",
        "$.pairwise_pairs: must have each of the 15 pairs of cameras once, and has none for 1-4",
    ]


def test_a_camera_that_is_not_there_is_named(rig_document, dumped):
    rig_document["pairwise_pairs"][4]["camera_index_b"] = 7

    assert problems_of(rig_document, dumped) == [
        "$.pairwise_pairs[4].camera_index_b: names camera 7, and the rig's cameras are 0 to 5",
        "$.pairwise_pairs: must have each of the 15 pairs of cameras once, and has none for 0-5",
    ]


def test_a_pair_of_one_camera_is_refused(rig_document, dumped):
    rig_document["pairwise_pairs"][0]["camera_index_b"] = 0

    assert problems_of(rig_document, dumped)[0] == "$.pairwise_pairs[0]: names camera 0 twice"


@pytest.mark.parametrize(
    ("pairs", "problem"),
    [
        ({}, "$.pairwise_pairs: must be a list, found an empty object"),
        ([1], "$.pairwise_pairs[0]: must be an object, found 1"),
        ([], "$.pairwise_pairs: must have each of the 15 pairs of cameras once, and has none for"),
    ],
)
def test_pairs_that_are_no_list_of_objects_are_refused(rig_document, dumped, pairs, problem):
    rig_document["pairwise_pairs"] = pairs

    assert problems_of(rig_document, dumped)[0].startswith(problem)


@pytest.mark.parametrize(
    ("record", "path"),
    [
        (
            {"adjacent_pairs": [{"camera_a": 1, "camera_b": 2, "baseline_cm": 6.8}]},
            "$.adjacent_pairs[0].baseline_cm",
        ),
        ({"baselines_adjacent_cm": [6.5, 6.8, 5.75, 7.0, 6.5]}, "$.baselines_adjacent_cm[1]"),
    ],
)
def test_adjacent_baselines_must_agree_with_the_pairwise_ones(rig_document, dumped, record, path):
    assert problems_of(rig_document | record, dumped) == [
        f"{path}: the baseline of cameras 1 and 2 is 6.8 cm here and 6.75 cm among the "
        f"pairwise ones"
    ]


def test_adjacent_baselines_may_be_rounded_to_float32(rig_document, dumped):
    rounded = [6.500000476837158, 6.75, 5.75, 7.0, 6.5]

    rig, _ = parse_rig(dumped(rig_document | {"adjacent_baselines_cm": rounded}), where="b")

    assert rig.baselines_cm == BASELINES_CM


def test_a_missing_quantity_tells_what_was_looked_for_and_what_is_there(rig_document, dumped):
    del rig_document["camera_intrinsics"]["focal_length_mm"]

    problems = problems_of(rig_document, dumped)

    assert len(problems) == 1
    assert problems[0].startswith("$: camera_intrinsics.focal_length_mm is missing (or, in any")
    assert problems[0].endswith(
        "the keys here are: camera_count, camera_intrinsics, image_height, image_width, map_name, "
        "pairwise_pairs, primary_stereo_pair, scene_index, scene_label, unit"
    )


def test_all_problems_of_a_file_are_told_at_once(rig_document, dumped):
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


def in_case(name, style):
    first, *rest = name.split("_")
    capitalised = "".join(word.capitalize() for word in rest)
    return {"snake": name, "camel": first + capitalised}.get(
        style, first.capitalize() + capitalised
    )


def spelled(values, *, seed):
    """A document that says each quantity under a spelling and in a case style picked by a seed."""
    pick = random.Random(seed).choice
    document = {}
    for quantity, value in values.items():
        style = pick(["snake", "camel", "Pascal"])
        *parents, last = [in_case(name, style) for name in pick(SPELLINGS[quantity]).split(".")]
        place = document
        for key in parents:
            place = place.setdefault(key, {})
        place[last] = value
    return document


lengths = st.floats(0.5, 5000)


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32), baselines=st.lists(lengths, min_size=15, max_size=15))
def test_every_spelling_of_a_rig_is_the_same_rig(seed, baselines):
    pairs = zip(itertools.combinations(range(6), 2), baselines, strict=True)
    document = spelled(
        {
            "focal_mm": 45.0,
            "sensor_width_mm": 23.76,
            "sensor_height_mm": 13.3,
            "image_width_px": 640,
            "image_height_px": 360,
            "primary_pair": [1, 2],
            "aperture_fstop": 4,
            "pairwise_pairs": [
                spelled({"camera_a": a, "camera_b": b, "baseline_cm": length}, seed=seed + a)
                for (a, b), length in pairs
            ],
        },
        seed=seed,
    )

    rig, labels = parse_rig(json.dumps(document).encode(), where="baseline.json")

    assert rig == Rig(45.0, 23.76, 13.3, 640, 360, None, tuple(baselines), (1, 2))
    assert labels.aperture_fstop == 4.0


@pytest.mark.parametrize("spelling", SPELLINGS["character"])
def test_every_spelling_of_the_character_is_read(rig_document, dumped, spelling):
    document = {}
    *parents, last = spelling.split(".")
    place = document
    for key in parents:
        place = place.setdefault(key, {})
    place[last] = "SK_Ch13"

    _, labels = parse_rig(dumped(rig_document | document), where="baseline.json")

    assert labels.character == "SK_Ch13"
