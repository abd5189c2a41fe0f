"""baseline.json: which keys are read, and what is refused."""

import dataclasses
import itertools
import json
import math
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.parse import parse_rig, require_unit
from stereogenbench_data.schema.records import Rig

BASELINES_CM = (6.5, 13.25, 19.0, 26.0, 32.5, 6.75, 12.5, 19.5, 26.0, 5.75, 12.75, 19.25)
BASELINES_CM += (7.0, 13.5, 6.5)
PLACES_CM = (0.0, 6.5, 13.25, 19.0, 26.0, 32.5)


def problems_of(document, dumped):
    with pytest.raises(SchemaError, match="problem") as caught:
        parse_rig(dumped(document), where="baseline.json")
    return [line.strip() for line in str(caught.value).splitlines()[1:]]


def test_a_rig_is_read_as_it_is_recorded(rig_document, dumped):
    rig, labels, _ = parse_rig(dumped(rig_document), where="baseline.json")

    assert rig == Rig(32.5, 23.76, 17.82, 640, 480, None, BASELINES_CM, (0, 1), "recorded")
    assert (labels.scene_label, labels.scene_index, labels.map_name) == (
        "Town_scene_1166",
        1166,
        "Town",
    )


def baseline(place, value):
    """A change of the length of one recorded pair."""
    return lambda document: document["pairwise_pairs"][place].update(baseline_cm=value)


def lens(**values):
    """A change of the recorded intrinsics."""
    return lambda document: document["camera_intrinsics"].update(values)


def keys(**values):
    """A change of keys of the whole document."""
    return lambda document: document.update(values)


PAIR = r"\$\.primary_stereo_pair: must be \{left_camera, right_camera\}"
TWICE = {"camera_index_a": 2, "camera_index_b": 0, "baseline_cm": 13.5}
LENGTH = r"pairwise_pairs\[3\]\.baseline_cm: must be a number above zero, found "


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (keys(primary_stereo_pair=[0, 6]), PAIR),
        (keys(primary_stereo_pair=[2, 2]), PAIR),
        (keys(primary_stereo_pair={"left_camera": "Cam_left", "right_camera": 1}), PAIR),
        (keys(primary_stereo_pair={"left_camera": 0}), PAIR),
        (keys(primary_stereo_pair={"left_camera": "Cam_00", "left_index": 2,
                                   "right_camera": "Cam_01", "right_index": 3}), PAIR),
        (baseline(3, math.nan), f"{LENGTH}nan"),
        (baseline(3, "6.5"), f"{LENGTH}'6.5'"),
        (baseline(3, -6.5), f"{LENGTH}-6.5"),
        (lambda document: document["pairwise_pairs"][4].update(camera_index_b=7),
         r"pairwise_pairs\[4\].*: is of cameras 0 and 7, and the rig has cameras 0 to 5"),
        (lambda document: document["pairwise_pairs"].__setitem__(7, TWICE),
         r"pairwise_pairs\[7\].*0 and 2 is 13.5 cm here and 13.25 cm at \$\.pairwise_pairs\[1\]"),
        (keys(baselines_adjacent_cm=[6.5, 6.9, 5.75, 7.0, 6.5]),
         r"adjacent_cm\[1\]: .*1 and 2 is 6.9 cm here and 6.75 cm at \$\.pairwise_pairs\[5\]"),
        (keys(pairwise_pairs={}), "each of the 15 camera pairs, and lacks 0-1"),
        (keys(pairwise_pairs=[[0, 0, 6.5]]), "each of the 15 camera pairs, and lacks 0-1"),
        (lens(focal_length_mm=0.0325), r"0\.0325 mm.*0\.00137 widths"),
        (lens(sensor_width_mm=0.02376), r"0\.02376 mm.*e\+03 widths"),
        (lens(fov_deg=45.0), r"fov_deg: 45\.0 means 1\.20711 focal lengths"),
        (keys(camera_intrinsics={"focal_length": 875.42, "sensor_width_mm": 23.76}),
         "focal_length"),
        (keys(camera_intrinsics={"zoom": 32.5, "sensor_width_mm": 23.76}),
         r"\$\.camera_intrinsics\.focal_length_mm is missing; the keys are: .*intrinsics\.zoom"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_rig_is_told_with_its_place(rig_document, dumped, change, told):
    change(rig_document)

    assert re.search(told, "\n".join(problems_of(rig_document, dumped)))


def test_all_problems_of_a_file_are_reported_at_once(rig_document, dumped):
    lens(focal_length_mm="far", sensor_width_mm=0)(rig_document)
    baseline(0, None)(rig_document)

    problems = problems_of(rig_document, dumped)

    for place in ("baseline_cm", "focal_length_mm", "sensor_width_mm"):
        assert any(place in problem for problem in problems)


def test_without_an_image_size_the_releases_size_is_assumed(rig_document, dumped):
    del rig_document["image_width"], rig_document["image_height"]

    rig, _, _ = parse_rig(dumped(rig_document), where="baseline.json")

    assert (rig.image_width_px, rig.image_height_px) == (1280, 1280)
    assert rig.image_size_source == "default"


def test_without_a_sensor_height_pixels_are_square(rig_document, dumped):
    del rig_document["camera_intrinsics"]["sensor_height_mm"]

    rig, _, _ = parse_rig(dumped(rig_document), where="baseline.json")

    assert rig.sensor_height_mm / 480 == pytest.approx(rig.sensor_width_mm / 640, rel=1e-15)


@pytest.mark.parametrize(
    ("pair", "expected"),
    [
        ({"left_camera": "Town_Cam_02", "right_camera": "Town_cam4"}, (2, 4)),
        ({"left_camera": 3, "right_camera": 5}, (3, 5)),
        ({"L": "Cam_01", "R": "Cam_02"}, (1, 2)),
        (["Cam_00", "Cam_05"], (0, 5)),
        ("1-3", (1, 3)),
        ({"left_camera": "cam_00_rgb.mp4", "right_camera": "cam_04_rgb.mp4"}, (0, 4)),
    ],
)
def test_both_forms_of_the_primary_pair_are_read(rig_document, dumped, pair, expected):
    rig_document["primary_stereo_pair"] = pair

    rig, _, _ = parse_rig(dumped(rig_document), where="baseline.json")

    assert rig.primary_pair == expected


@pytest.mark.parametrize(
    "intrinsics", [{"fx": 875.4208754, "fy": 875.4208754}, {"fov_deg": 40.15832}]
)
def test_without_a_sensor_that_of_the_release_is_assumed(rig_document, dumped, intrinsics):
    rig_document["camera_intrinsics"] = intrinsics

    rig, _, (remark,) = parse_rig(dumped(rig_document), where="baseline.json")

    assert (rig.sensor_width_mm, rig.sensor_height_mm) == pytest.approx((23.76, 17.82))
    assert rig.focal_mm == pytest.approx(32.5, rel=1e-5)
    assert remark.about == "sensor"


@pytest.mark.parametrize(
    ("matrix", "told"),
    [
        (
            [[1750.84, 0, 640], [0, 1750.84, 480], [0, 0, 1]],
            "of other pictures than these, of 640x480",
        ),
        ([[437.71, 0, 160], [0, 437.71, 120], [0, 0, 1]], "of other pictures than these"),
        ([[875.42, 3, 320], [0, 875.42, 240], [0, 0, 1]], "focal_length_mm is missing"),
    ],
    ids=["larger pictures", "smaller pictures", "skewed pixels"],
)
def test_a_camera_matrix_of_other_pictures_is_refused(rig_document, dumped, matrix, told):
    rig_document["camera_intrinsics"] = {"K": matrix}
    del rig_document["image_width"], rig_document["image_height"]

    with pytest.raises(SchemaError, match=told):
        parse_rig(dumped(rig_document), where="baseline.json", size_px=(640, 480))


def test_of_baselines_that_agree_the_most_precise_counts(rig_document, dumped):
    rig_document["adjacent_baselines_cm"] = [6.5, 6.8, 5.8, 7.0, 6.5]

    rig, _, _ = parse_rig(dumped(rig_document), where="baseline.json")

    assert rig.baselines_cm == BASELINES_CM


@pytest.mark.parametrize(("unit_cm", "unit"), [(100, "m"), (0.1, "mm")])
def test_baselines_that_fit_their_family_in_another_unit_alone_are_refused(
    rig_document, dumped, unit_cm, unit
):
    for entry in rig_document["pairwise_pairs"]:
        entry["baseline_cm"] /= unit_cm
    rig, _, _ = parse_rig(dumped(rig_document), where="baseline.json")

    with pytest.raises(SchemaError, match=rf"4.5 to 8.5 cm. In {unit} they would be"):
        require_unit(rig, family="IPD_Gaussian", where="baseline.json")


def test_baselines_outside_of_their_family_are_told(rig_document, dumped):
    rig, _, _ = parse_rig(dumped(rig_document), where="baseline.json")
    wide = dataclasses.replace(rig, baselines_cm=tuple(3 * each for each in BASELINES_CM))

    (remark,) = require_unit(wide, family="IPD_Gaussian", where="baseline.json")

    assert remark.about == "unit"
    assert require_unit(rig, family="IPD_Gaussian", where="baseline.json") == ()


def test_without_a_primary_pair_cameras_are_taken_to_ascend_to_the_right(rig_document, dumped):
    del rig_document["primary_stereo_pair"]

    rig, _, (remark,) = parse_rig(dumped(rig_document), where="baseline.json")

    assert rig.primary_pair == (0, 1)
    assert remark.about == "primary pair"


def test_baselines_below_a_unit_that_is_not_known_are_refused(rig_document, dumped):
    pairs = rig_document.pop("pairwise_pairs")
    rows = [
        {"a": each["camera_index_a"], "b": each["camera_index_b"], "value": 1} for each in pairs
    ]

    with pytest.raises(SchemaError, match=r"value: is in a unit of length that is not known"):
        parse_rig(dumped(rig_document | {"baseline": {"unit": "ell", "pairs": rows}}), where="rig")


@pytest.mark.parametrize(
    "written",
    [
        {"principal_point_px": {"x": 300.5, "y": 250}},
        {"principal_point": [300.5, 250.0]},
        {"cx": 300.5, "cy": 250.0},
        {"optical_center_x_px": 300.5, "optical_center_y_px": 250.0},
    ],
)
def test_a_principal_point_is_found_under_likely_keys(rig_document, dumped, written):
    rig_document["camera_intrinsics"] |= written

    rig, _, remarks = parse_rig(dumped(rig_document), where="baseline.json")

    assert rig.principal_point_px == (300.5, 250.0)
    assert remarks == ()


@pytest.mark.parametrize(
    "written",
    [{"principal_point": None}, {"cx": 0.5, "cy": 0.5}, {"principal_point": "image_center"}],
)
def test_a_principal_point_at_the_centre_is_none(rig_document, dumped, written):
    rig, _, remarks = parse_rig(dumped(rig_document | written), where="baseline.json")

    assert rig.principal_point_px is None
    assert remarks == ()


@pytest.mark.parametrize(
    "written",
    [
        {"cx": 300.5}, {"principal_point": "left"}, {"cx": 1e9, "cy": 1}, {"shift_x": 0.05},
        {"principal_point_normalized": [0.53, 0.5]}, {"principal_point_offset_px": [4, 0]},
    ],
)  # fmt: skip
def test_a_principal_point_that_is_not_understood_stops_no_disparity(rig_document, dumped, written):
    rig, _, (remark,) = parse_rig(dumped(rig_document | written), where="baseline.json")

    assert rig.principal_point_px is None
    assert remark.about == "principal point"


@pytest.mark.parametrize(
    ("intrinsics", "size"),
    [
        ({"focal_length_mm": "32.5 mm", "sensor_width_cm": 2.376, "sensor_height_cm": 1.782}, {}),
        ({"focal_length_mm": 32.5, "sensor": {"width_mm": 23.76, "height_mm": 17.82}}, {}),
        (
            {"fx_px": 875.4208754, "sensor_width_mm": 23.76, "sensor_height_mm": 17.82},
            {"render_width": 640, "render_height": 480},
        ),
        (
            {"K": [[875.4208754, 0, 320], [0, 875.4208754, 240], [0, 0, 1]],
             "sensor_width_mm": 23.76},
            {},
        ),
        ({"focal_length_mm": [32.5] * 6, "sensor_width_mm": 23.76}, {}),
        ({"FOVAngle": 40.15832, "sensor_width_mm": 23.76}, {}),
        ({"camera.focal_length_mm": 32.5, "sensor_mm": [23.76, 17.82], "fov": 40.2}, {}),
        ({"camera_matrix": {"rows": 3, "data": [875.4208754, 0, 320, 0, 875.4208754, 240, 0, 0, 1]},
          "sensor_width_mm": 23.76}, {}),
        ({"vertical_fov_degrees": 30.66233813, "sensor_width_mm": 23.76}, {}),
        ({"focal_length": {"value": 3.25, "unit": "cm"}, "sensor_width_mm": 23.76}, {}),
        ({"model": "PINHOLE", "params": [875.4208754, 875.4208754, 320, 240],
          "sensor_width_mm": 23.76}, {}),
        ({"K": {f"cam_{camera:02d}": [[875.4208754, 0, 320], [0, 875.4208754, 240], [0, 0, 1]]
                for camera in range(6)}, "sensor_width_mm": 23.76}, {}),
    ],
)  # fmt: skip
def test_a_lens_is_found_under_likely_keys(rig_document, dumped, intrinsics, size):
    rig_document["camera_intrinsics"] = intrinsics
    if size:
        del rig_document["image_width"], rig_document["image_height"]
        rig_document |= size

    rig, _, _ = parse_rig(dumped(rig_document), where="baseline.json")

    assert rig.focal_mm / rig.sensor_width_mm == pytest.approx(32.5 / 23.76, rel=1e-5)
    assert rig.sensor_height_mm == pytest.approx(17.82)
    assert (rig.image_width_px, rig.image_height_px) == (640, 480)


def test_the_side_that_a_sensor_is_fitted_to_counts(rig_document, dumped):
    rig_document["camera_intrinsics"] |= {"sensor_width_mm": 36.0, "sensor_height_mm": 24.0}

    for fit, width_mm, height_mm in (("VERTICAL", 32.0, 24.0), ("AUTO", 36.0, 27.0)):
        document = rig_document | {"sensor_fit": fit}
        rig, _, _ = parse_rig(dumped(document), where="baseline.json")
        assert (rig.sensor_width_mm, rig.sensor_height_mm) == pytest.approx((width_mm, height_mm))


@pytest.mark.parametrize(
    "written", [{"distortion": {"k1": -0.12}}, {"camera_model": "fisheye"}, {"overscan": 0.1}]
)
def test_a_model_of_the_lens_is_told(rig_document, dumped, written):
    _, _, (remark,) = parse_rig(dumped(rig_document | written), where="baseline.json")

    assert remark.about == "lens"


def test_a_lens_may_be_stated_twice_within_its_rounding(rig_document, dumped):
    lens(fov_deg=40.16)(rig_document)

    assert parse_rig(dumped(rig_document), where="baseline.json")[0].focal_mm == 32.5


def pairs_as(document, write):
    """The document with its baselines written by another function of cameras and length."""
    recorded = document.pop("pairwise_pairs")
    entries = [(p["camera_index_a"], p["camera_index_b"], p["baseline_cm"]) for p in recorded]
    return document | write(entries)


@pytest.mark.parametrize(
    "write",
    [
        pytest.param(
            lambda pairs: {"pairwise_pairs": [
                {"cameras": [f"Cam_{a:02d}", f"Cam_{b:02d}"], "baseline_m": cm / 100}
                for a, b, cm in pairs
            ]}, id="names in a list, metres"),
        pytest.param(
            lambda pairs: {"pairwise_pairs": [
                {"camera_index_a": a + 1, "camera_index_b": b + 1, "baseline_cm": cm}
                for a, b, cm in pairs
            ], "primary_stereo_pair": [1, 2]}, id="cameras from 1"),
        pytest.param(
            lambda pairs: {"pairwise_pairs": [
                {"camera_index_a": b, "camera_index_b": a, "baseline_cm": -cm}
                for a, b, cm in reversed(pairs)
            ] + [
                {"camera_index_a": a, "camera_index_b": b, "baseline_cm": cm} for a, b, cm in pairs
            ]}, id="both directions, signed"),
        pytest.param(
            lambda pairs: {"adjacent_baselines_cm": [cm for a, b, cm in pairs if b == a + 1]},
            id="neighbours alone"),
        pytest.param(
            lambda pairs: {"camera_positions_m": {
                f"Cam_{b:02d}": [1.0, cm / 100, -2.0]
                for a, b, cm in [(0, 0, 0.0), *pairs] if a == 0}}, id="places in space"),
        pytest.param(
            lambda pairs: {"camera_offsets_m": [0.0, *(cm / 100 for a, _, cm in pairs if a == 0)]},
            id="places along the rig"),
        pytest.param(lambda pairs: {"pairwise_pairs": [*pairs]}, id="two cameras and a length"),
        pytest.param(
            lambda pairs: {"pairwise_pairs": dict(zip(
                ("camera_index_a", "camera_index_b", "baseline_cm"),
                map(list, zip(*pairs, strict=True)),
                strict=True,
            ))}, id="columns"),
        pytest.param(
            lambda pairs: {"pairwise_pairs": [
                {"camera_index_a": a, "camera_index_b": b, "baseline": cm / 2.54, "unit": "inch"}
                for a, b, cm in pairs
            ]}, id="a unit beside the number"),
        pytest.param(
            lambda pairs: {"pairwise_pairs": [
                {"camera_index_a": a, "camera_index_b": b, "baseline_cm": cm, "fx_px": 875.4,
                 "baseline_bin": "[1,10)", "focal_length_mm": 32.5, "baseline_error_cm": 3e-12,
                 "target_baseline_cm": 7.0, "fx_times_baseline": 9.0}
                for a, b, cm in pairs
            ]}, id="figures beside the baseline"),
        pytest.param(
            lambda pairs: {"baseline_matrix_cm": [[abs(a - b) for b in PLACES_CM]
                                                  for a in PLACES_CM]}, id="a matrix"),
        pytest.param(
            lambda pairs: {"baseline_matrix_cm": [[b - a for b in PLACES_CM]
                                                  for a in PLACES_CM]}, id="a signed matrix"),
        pytest.param(
            lambda pairs: {"pairs": [{"pair": f"{a}-{b}", "baseline_mm": 10 * cm}
                                     for a, b, cm in pairs]}, id="pairs by a key"),
        pytest.param(
            lambda pairs: {"baselines_cm": {
                f"cam_{a:02d}": {f"cam_{b:02d}": cm for c, b, cm in pairs if c == a}
                for a in range(5)
            }}, id="names below names"),
    ],
)  # fmt: skip
def test_baselines_are_found_in_likely_forms(rig_document, dumped, write):
    rig, _, _ = parse_rig(dumped(pairs_as(rig_document, write)), where="baseline.json")

    assert rig.baselines_cm == pytest.approx(BASELINES_CM, rel=1e-12)
    assert rig.primary_pair == (0, 1)


def test_a_pair_that_is_not_recorded_follows_from_the_others(rig_document, dumped):
    del rig_document["pairwise_pairs"][3]

    rig, _, (remark,) = parse_rig(dumped(rig_document), where="baseline.json")

    assert rig.baselines_cm == pytest.approx(BASELINES_CM)
    assert "0-4" in remark.text


def test_sizes_and_labels_that_are_odd_stop_nothing(rig_document, dumped):
    rig_document |= {
        "camera_count": "six", "image_width": 0.5, "image_height": -1, "scene_index": "no",
        "aperture_fstop": "f/4", "notes": [math.nan], "map_name": 3,
    }  # fmt: skip

    rig, labels, _ = parse_rig(dumped(rig_document), where="baseline.json")

    assert rig.image_size_source == "default"
    assert (labels.scene_index, labels.map_name) == (None, None)


def test_more_than_twenty_problems_are_counted(rig_document, dumped):
    rig_document["pairwise_pairs"] = [
        {"camera_index_a": 0, "camera_index_b": 10 + place, "baseline_cm": 1.0}
        for place in range(30)
    ]

    problems = problems_of(rig_document, dumped)

    assert len(problems) == 21
    assert problems[-1] == "and 11 more."


lengths = st.floats(0.5, 5000)


@settings(max_examples=100)
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

    rig, labels, _ = parse_rig(json.dumps(document).encode(), where="baseline.json")

    assert rig == Rig(45.0, 23.76, 13.3, 640, 360, None, tuple(baselines), (1, 2))
    assert labels.aperture_fstop == 4.0
