"""baseline.json: which keys are read, and what is refused."""

import dataclasses
import itertools
import json
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.parse import parse_rig, require_unit
from stereogenbench_data.schema.records import Rig, SceneLabels

BASELINES_CM = (6.5, 13.25, 19.0, 26.0, 32.5, 6.75, 12.5, 19.5, 26.0, 5.75, 12.75, 19.25)
BASELINES_CM += (7.0, 13.5, 6.5)
PLACES_CM = (0.0, 6.5, 13.25, 19.0, 26.0, 32.5)


def read(document, **known):
    """The rig, labels and remarks of a document."""
    return parse_rig(json.dumps(document).encode(), where="baseline.json", **known)


def test_a_rig_is_read_as_it_is_recorded(rig_document):
    rig, labels, remarks = read(rig_document | {"aperture_fstop": 4})

    assert rig == Rig(32.5, 23.76, 17.82, 640, 480, None, BASELINES_CM, (0, 1), "recorded")
    assert labels == SceneLabels("Town_scene_1166", 1166, "Town", aperture_fstop=4.0)
    assert remarks == ()


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
def test_what_is_wrong_with_a_rig_is_told_with_its_place(rig_document, change, told):
    change(rig_document)

    with pytest.raises(SchemaError, match=rf"(?s)baseline\.json: \d+ problem.*{told}"):
        read(rig_document)


def test_all_problems_of_a_file_are_reported_at_once_but_for_many(rig_document):
    lens(focal_length_mm="far", sensor_width_mm=0)(rig_document)
    baseline(3, None)(rig_document)

    told = r"(?s)3 problems.*\[3\].baseline_cm.*focal_length_mm.*sensor_width_mm"
    with pytest.raises(SchemaError, match=told):
        read(rig_document)
    rig_document["pairwise_pairs"] = rig_document["pairwise_pairs"][3:4] * 30
    with pytest.raises(SchemaError, match=r"(?s)33 problems.*\n  and 13 more\.$"):
        read(rig_document)


def test_without_an_image_size_the_releases_size_is_assumed(rig_document):
    del rig_document["image_width"], rig_document["image_height"]

    rig, _, _ = read(rig_document)

    assert (rig.image_width_px, rig.image_height_px) == (1280, 1280)
    assert rig.image_size_source == "default"


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
def test_each_form_of_the_primary_pair_is_read(rig_document, pair, expected):
    assert read(rig_document | {"primary_stereo_pair": pair})[0].primary_pair == expected


@pytest.mark.parametrize(
    "intrinsics", [{"fx": 875.4208754, "fy": 875.4208754}, {"fov_deg": 40.15832}]
)
def test_without_a_sensor_that_of_the_release_is_assumed(rig_document, intrinsics):
    rig, _, (remark,) = read(rig_document | {"camera_intrinsics": intrinsics})

    assert (rig.sensor_width_mm, rig.sensor_height_mm) == pytest.approx((23.76, 17.82))
    assert rig.focal_mm == pytest.approx(32.5, rel=1e-5)
    assert remark.about == "sensor"


@pytest.mark.parametrize(
    ("matrix", "told"),
    [
        ([[1750.84, 0, 640], [0, 1750.84, 480], [0, 0, 1]], "other pictures than .*, of 640x480"),
        ([[437.71, 0, 160], [0, 437.71, 120], [0, 0, 1]], "of other pictures than these"),
        ([[875.42, 3, 320], [0, 875.42, 240], [0, 0, 1]], "focal_length_mm is missing"),
    ],
    ids=["larger pictures", "smaller pictures", "skewed pixels"],
)
def test_a_camera_matrix_of_other_pictures_is_refused(rig_document, matrix, told):
    rig_document["camera_intrinsics"] = {"K": matrix}
    del rig_document["image_width"], rig_document["image_height"]

    with pytest.raises(SchemaError, match=told):
        read(rig_document, size_px=(640, 480))


@pytest.mark.parametrize(("unit_cm", "unit"), [(100, "m"), (0.1, "mm")])
def test_baselines_that_fit_their_family_in_another_unit_are_refused(rig_document, unit_cm, unit):
    for entry in rig_document["pairwise_pairs"]:
        entry["baseline_cm"] /= unit_cm
    rig, _, _ = read(rig_document)

    with pytest.raises(SchemaError, match=rf"4.5 to 8.5 cm. In {unit} they would be"):
        require_unit(rig, family="IPD_Gaussian", where="baseline.json")


def test_baselines_outside_of_their_family_are_told(rig_document):
    rig, _, _ = read(rig_document)
    wide = dataclasses.replace(rig, baselines_cm=tuple(3 * each for each in BASELINES_CM))

    (remark,) = require_unit(wide, family="IPD_Gaussian", where="baseline.json")

    assert remark.about == "unit"
    assert require_unit(rig, family="IPD_Gaussian", where="baseline.json") == ()


def test_baselines_below_a_unit_that_is_not_known_are_refused(rig_document):
    pairs = rig_document.pop("pairwise_pairs")
    rows = [{"a": p["camera_index_a"], "b": p["camera_index_b"], "value": 1} for p in pairs]

    with pytest.raises(SchemaError, match=r"value: is in a unit of length that is not known"):
        read(rig_document | {"baseline": {"unit": "ell", "pairs": rows}})


@pytest.mark.parametrize(
    ("written", "point_px", "about"),
    [
        ({"principal_point_px": {"x": 300.5, "y": 250}}, (300.5, 250.0), []),
        ({"principal_point": [300.5, 250.0]}, (300.5, 250.0), []),
        ({"cx": 300.5, "cy": 250.0}, (300.5, 250.0), []),
        ({"optical_center_x_px": 300.5, "optical_center_y_px": 250.0}, (300.5, 250.0), []),
        ({"principal_point": None}, None, []),
        ({"cx": 0.5, "cy": 0.5}, None, []),
        ({"principal_point": "image_center"}, None, []),
        *(
            (written, None, ["principal point"])
            for written in (
                {"cx": 300.5}, {"principal_point": "left"}, {"cx": 1e9, "cy": 1}, {"shift_x": 0.05},
                {"principal_point_normalized": [0.53, 0.5]}, {"principal_point_offset_px": [4, 0]},
            )
        ),
    ],
)  # fmt: skip
def test_a_principal_point_is_found_or_told_and_the_centre(rig_document, written, point_px, about):
    lens(**written)(rig_document)

    rig, _, remarks = read(rig_document)

    assert rig.principal_point_px == point_px
    assert [remark.about for remark in remarks] == about


MATRIX = [[875.4208754, 0, 320], [0, 875.4208754, 240], [0, 0, 1]]


@pytest.mark.parametrize(
    ("intrinsics", "size"),
    [
        ({"focal_length_mm": "32.5 mm", "sensor_width_cm": 2.376, "sensor_height_cm": 1.782}, {}),
        ({"focal_length_mm": 32.5, "sensor": {"width_mm": 23.76, "height_mm": 17.82}}, {}),
        ({"focal_length_mm": 32.5, "sensor_width_mm": 23.76, "fov_deg": 40.16}, {}),
        ({"fx_px": 875.4208754, "sensor_width_mm": 23.76, "sensor_height_mm": 17.82},
         {"render_width": 640, "render_height": 480}),
        ({"K": MATRIX, "sensor_width_mm": 23.76}, {}),
        ({"focal_length_mm": [32.5] * 6, "sensor_width_mm": 23.76}, {}),
        ({"FOVAngle": 40.15832, "sensor_width_mm": 23.76}, {}),
        ({"camera.focal_length_mm": 32.5, "sensor_mm": [23.76, 17.82], "fov": 40.2}, {}),
        ({"camera_matrix": {"rows": 3, "data": [*MATRIX[0], *MATRIX[1], *MATRIX[2]]},
          "sensor_width_mm": 23.76}, {}),
        ({"vertical_fov_degrees": 30.66233813, "sensor_width_mm": 23.76}, {}),
        ({"focal_length": {"value": 3.25, "unit": "cm"}, "sensor_width_mm": 23.76}, {}),
        ({"model": "PINHOLE", "params": [875.4208754, 875.4208754, 320, 240],
          "sensor_width_mm": 23.76}, {}),
        ({"K": {f"cam_{camera:02d}": MATRIX for camera in range(6)}, "sensor_width_mm": 23.76}, {}),
    ],
)  # fmt: skip
def test_a_lens_is_found_under_likely_keys(rig_document, intrinsics, size):
    if size:
        del rig_document["image_width"], rig_document["image_height"]

    rig, _, _ = read(rig_document | size | {"camera_intrinsics": intrinsics})

    assert rig.focal_mm / rig.sensor_width_mm == pytest.approx(32.5 / 23.76, rel=1e-5)
    assert rig.sensor_height_mm == pytest.approx(17.82)
    assert (rig.image_width_px, rig.image_height_px) == (640, 480)


@pytest.mark.parametrize(("fit", "sensor_mm"), [("VERTICAL", (32.0, 24.0)), ("AUTO", (36.0, 27.0))])
def test_the_side_that_a_sensor_is_fitted_to_counts(rig_document, fit, sensor_mm):
    lens(sensor_width_mm=36.0, sensor_height_mm=24.0)(rig_document)

    rig, _, _ = read(rig_document | {"sensor_fit": fit})

    assert (rig.sensor_width_mm, rig.sensor_height_mm) == pytest.approx(sensor_mm)


@pytest.mark.parametrize(
    "written", [{"distortion": {"k1": -0.12}}, {"camera_model": "fisheye"}, {"overscan": 0.1}]
)
def test_a_model_of_the_lens_is_told(rig_document, written):
    _, _, (remark,) = read(rig_document | written)

    assert remark.about == "lens"


def pairs_as(document, write):
    """The document with its baselines written by another function of cameras and length."""
    recorded = document.pop("pairwise_pairs")
    entries = [(p["camera_index_a"], p["camera_index_b"], p["baseline_cm"]) for p in recorded]
    return document | write(entries)


def entry(a, b, length_cm):
    """A pair of a baseline.json."""
    return {"camera_index_a": a, "camera_index_b": b, "baseline_cm": length_cm}


FIGURES = {
    "fx_px": 875.4, "baseline_bin": "[1,10)", "focal_length_mm": 32.5, "baseline_error_cm": 3e-12,
    "target_baseline_cm": 7.0, "fx_times_baseline": 9.0,
}  # fmt: skip


@pytest.mark.parametrize(
    "write",
    [
        pytest.param(
            lambda pairs: {"pairwise_pairs": [
                {"cameras": [f"Cam_{a:02d}", f"Cam_{b:02d}"], "baseline_m": cm / 100}
                for a, b, cm in pairs
            ]}, id="names in a list, metres"),
        pytest.param(
            lambda pairs: {"pairwise_pairs": [entry(a + 1, b + 1, cm) for a, b, cm in pairs],
                           "primary_stereo_pair": [1, 2]}, id="cameras from 1"),
        pytest.param(
            lambda pairs: {"pairwise_pairs": [
                *(entry(b, a, -cm) for a, b, cm in reversed(pairs)), *(entry(*p) for p in pairs)
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
            lambda pairs: {"pairwise_pairs": {
                key: [entry(*pair)[key] for pair in pairs] for key in entry(0, 1, 0.0)
            }}, id="columns"),
        pytest.param(
            lambda pairs: {"pairwise_pairs": [
                {"camera_index_a": a, "camera_index_b": b, "baseline": cm / 2.54, "unit": "inch"}
                for a, b, cm in pairs
            ]}, id="a unit beside the number"),
        pytest.param(
            lambda pairs: {"pairwise_pairs": [entry(*pair) | FIGURES for pair in pairs]},
            id="figures beside the baseline"),
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
def test_baselines_are_found_in_likely_forms(rig_document, write):
    rig, _, _ = read(pairs_as(rig_document, write))

    assert rig.baselines_cm == pytest.approx(BASELINES_CM, rel=1e-12)
    assert rig.primary_pair == (0, 1)


@pytest.mark.parametrize(
    ("key", "about", "told"),
    [
        ("primary_stereo_pair", "primary pair", "has no primary_stereo_pair"),
        ("pairwise_pairs", "baselines", "0-4"),
    ],
)
def test_what_follows_from_other_values_is_told(rig_document, key, about, told):
    recorded = rig_document.pop(key)
    if key == "pairwise_pairs":
        rig_document[key] = recorded[:3] + recorded[4:]
        # Of lengths that agree the most precise counts.
        rig_document["adjacent_baselines_cm"] = [6.5, 6.8, 5.8, 7.0, 6.5]

    rig, _, (remark,) = read(rig_document)

    assert rig.baselines_cm == pytest.approx(BASELINES_CM, rel=1e-15)
    assert rig.primary_pair == (0, 1)
    assert (remark.about, told in remark.text) == (about, True)


def test_sizes_and_labels_that_are_odd_stop_nothing(rig_document):
    rig_document |= {
        "camera_count": "six", "image_width": 0.5, "image_height": -1, "scene_index": "no",
        "aperture_fstop": "f/4", "notes": [math.nan], "map_name": 3,
    }  # fmt: skip

    rig, labels, _ = read(rig_document)

    assert rig.image_size_source == "default"
    assert (labels.scene_index, labels.map_name) == (None, None)


lengths = st.floats(0.5, 5000)


@settings(max_examples=100)
@given(baselines=st.lists(lengths, min_size=15, max_size=15))
def test_every_number_of_a_rig_is_read_exactly(baselines):
    intrinsics = {"focal_length_mm": 45.0, "sensor_width_mm": 23.76, "sensor_height_mm": 13.3}
    pairs = zip(itertools.combinations(range(6), 2), baselines, strict=True)
    entries = [entry(a, b, length) for (a, b), length in pairs]
    document = {"camera_intrinsics": intrinsics, "image_width": 640, "image_height": 360}
    document |= {"primary_stereo_pair": [1, 2], "pairwise_pairs": entries}

    rig, _, _ = read(document)

    assert rig == Rig(45.0, 23.76, 13.3, 640, 360, None, tuple(baselines), (1, 2))
