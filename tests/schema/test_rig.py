"""baseline.json: read exactly as the paper's example reads it, and what is refused."""

import dataclasses
import itertools
import json
import math
import re
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.parse import parse_rig, require_unit
from stereogenbench_data.schema.records import Rig, SceneLabels

BASELINES_CM = (6.5, 13.25, 19.0, 26.0, 32.5, 6.75, 12.5, 19.5, 26.0, 5.75, 12.75, 19.25)
BASELINES_CM += (7.0, 13.5, 6.5)


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


def as_the_paper_reads_it(document):
    """Left, right, focal length in pixels and baseline in cm: the loading example of the paper."""

    def cam_idx(name):
        if isinstance(name, int):
            return name
        m = re.search(r"[Cc]am_?(\d+)$", name)
        if m is None:
            raise ValueError(f"cannot parse camera index from {name!r}")
        return int(m.group(1))

    pair = document["primary_stereo_pair"]
    if isinstance(pair, dict):
        left, right = cam_idx(pair["left_camera"]), cam_idx(pair["right_camera"])
    else:
        left, right = pair
    intr = document["camera_intrinsics"]
    width = document.get("image_width", 1280)
    fx_px = intr["focal_length_mm"] / intr["sensor_width_mm"] * width
    low, high = sorted((left, right))
    for entry in document["pairwise_pairs"]:
        if sorted((entry["camera_index_a"], entry["camera_index_b"])) == [low, high]:
            return left, right, fx_px, entry["baseline_cm"]
    raise KeyError((low, high))


def as_we_read_it(rig):
    """The same four of a rig."""
    left, right = rig.primary_pair
    fx_px = rig.focal_mm / rig.sensor_width_mm * rig.image_width_px
    return left, right, fx_px, rig.baseline_cm(left, right)


VALUES = (None, True, 0, -1, 0.5, 3, "4", "Cam_03", "Cam_7", [], {}, [0, 1], [1, 0, 2], math.nan)
PLACES = (
    ("primary_stereo_pair",), ("primary_stereo_pair", "left_camera"),
    ("primary_stereo_pair", "right_camera"), ("camera_intrinsics",),
    ("camera_intrinsics", "focal_length_mm"), ("camera_intrinsics", "sensor_width_mm"),
    ("image_width",), ("pairwise_pairs",), ("pairwise_pairs", 0), ("pairwise_pairs", 7),
    ("pairwise_pairs", 0, "camera_index_a"), ("pairwise_pairs", 0, "camera_index_b"),
    ("pairwise_pairs", 0, "baseline_cm"), ("pairwise_pairs", 14, "baseline_cm"),
)  # fmt: skip
DELETED = object()


@pytest.mark.parametrize("place", PLACES, ids=str)
def test_the_papers_example_runs_on_each_file_that_is_accepted(rig_document, place):
    accepted = 0
    for value in (DELETED, *VALUES):
        document = json.loads(json.dumps(rig_document))
        *parents, last = place
        holder = document
        for key in parents:
            holder = holder[key]
        if value is DELETED:
            del holder[last]
        else:
            holder[last] = value
        with suppress(SchemaError):
            rig, _, _ = read(document)
            assert as_we_read_it(rig) == pytest.approx(as_the_paper_reads_it(document))
            accepted += 1
    assert accepted < len(VALUES)


LIKELY = {
    "index": 3, "left_camera_index": 4, "left": 5, "pair": "4-5", "cameras": [4, 5], "a": 2, "b": 9,
    "camera_names": ["Cam_04", "Cam_05"], "index_gap": 1, "separation": 99.0, "baseline": 1.0,
    "baseline_m": 7.0, "unit": "m", "distance_cm": 1.0, "target_baseline_cm": 7.0,
}  # fmt: skip
BESIDE = {
    "pairs": [[0, 1, 99.0]], "baselines_cm": [1.0] * 15, "unit": "m", "focal_length_mm": 50.0,
    "camera_count": 5, "frame_count": 99, "lens": {"focal_length": 18, "fov_deg": 90.0},
    "adjacent_baselines": [1, 2, 3, 4, 5], "stereo_pair": [4, 5], "camera_offsets_m": [0] * 6,
    "sensor_fit": "VERTICAL", "distortion": {"k1": 0.1}, "baseline_matrix_cm": [[1.0] * 6] * 6,
}  # fmt: skip


def test_keys_beside_the_printed_ones_never_matter(rig_document):
    expected = read(rig_document)
    for pair in rig_document["pairwise_pairs"]:
        pair |= LIKELY
    rig_document["camera_intrinsics"] |= {"focal_length": 50.0, "fov": 90.0, "sensor_size": 36.0}
    rig_document["primary_stereo_pair"] |= {"left_index": 3, "right_index": 4, "L": "Cam_04"}

    assert read(BESIDE | rig_document | {"unit": "m"}) == expected


def test_cameras_are_numbers_as_the_papers_example_compares_them(rig_document):
    expected = read(rig_document)
    for pair in rig_document["pairwise_pairs"]:
        pair["camera_index_a"] = float(pair["camera_index_a"])

    assert read(rig_document) == expected


PAIR = "the primary pair must be a left and a right one of the cameras 0 to 5.*found "
TWICE = {"camera_index_a": 2, "camera_index_b": 0, "baseline_cm": 13.5}
LENGTH = r"pairwise_pairs\[3\]\.baseline_cm: must be a number above zero, found "


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (keys(primary_stereo_pair=[0, 6]), rf"{PAIR}\$\.primary_stereo_pair\[0\] 0, .*\[1\] 6"),
        (keys(primary_stereo_pair=[2, 2]), PAIR),
        (keys(primary_stereo_pair=["Cam_00", "Cam_01"]), f"{PAIR}.*'Cam_00'"),
        (keys(primary_stereo_pair={"left_camera": "Cam_left", "right_camera": 1}), PAIR),
        (keys(primary_stereo_pair={"left_camera": 0}), f"{PAIR}.*left_camera 0, nothing"),
        (keys(primary_stereo_pair={"L": 0, "R": 1}), r"left_camera or .*missing.*\[primary_pair"),
        (baseline(3, math.nan), f"{LENGTH}nan"),
        (baseline(3, "6.5"), f"{LENGTH}'6.5'"),
        (baseline(3, -6.5), f"{LENGTH}-6.5"),
        (lambda document: document["pairwise_pairs"][4].update(camera_index_b=7),
         r"pairwise_pairs\[4\]: is of cameras 0 and 7, and the rig has cameras 0 to 5"),
        (lambda document: document["pairwise_pairs"][4].pop("camera_index_b"),
         r"pairwise_pairs\[4\]: has no camera_index_b; it is an object with 2 keys"),
        (lambda document: document["pairwise_pairs"].__setitem__(7, TWICE),
         r"pairwise_pairs\[7\].*0 and 2 is 13.5 cm here and 13.25 cm at \$\.pairwise_pairs\[1\]"),
        (keys(adjacent_pairs=[{"camera_index_a": 1, "camera_index_b": 2, "baseline_cm": 6.9}]),
         r"adjacent_pairs\[0\]\.b.*1 and 2 is 6.9 cm here and 6.75 cm at \$\.pairwise_pairs\[5\]"),
        (keys(pairwise_pairs=[None]), r"pairs\[0\]: must have the keys camera_index_a,.* is null"),
        (keys(pairwise_pairs=[]), "each of the 15 pairs of cameras, and lacks 0-1"),
        (keys(pairwise_pairs={"0-1": 6.5}), r"pairwise_pairs\[\] is missing.*\[pairs\] rows = "),
        (lens(focal_length_mm=0.0325), r"0\.0325 mm.*0\.00137 widths"),
        (lens(sensor_width_mm=0.02376), r"0\.02376 mm.*e\+03 widths"),
        (lens(fx=875.42, fy=920.0), r"intrinsics\.fy: is 920 px, .* it is 875\.421 px"),
        (lens(K=[875.42, 0, 320, 0, 920, 240, 0, 0, 1]), r"intrinsics\.K\[4\]: is 920 px"),
        (lens(K={"fx": 920.0}), r"intrinsics\.K\.fx: means 1\.4375"),
        (lens(fx=920.0), r"intrinsics\.fx: means 1\.4375 focal.*focal_length_mm.* mean 1\.36785"),
        (keys(K=[[920.0, 0, 320], [0, 920.0, 240], [0, 0, 1]]), r"\$\.K\[0\]\[0\]: means 1\.4375"),
        (lens(cx=960.0, cy=720.0), r"by its principal point \(960, 720\) it is of .* 640x480"),
        (lens(cx=160.0, cy=120.0), r"by its principal point \(160, 120\) it is of other pictures"),
        (keys(image_width="640"), r"\$\.image_width: must be a number above zero, found '640'"),
        (keys(image_width=0.5), r"\$\.image_width: must be a whole number of pixels, found 0\.5"),
        (keys(camera_intrinsics={"zoom": 32.5, "sensor_width_mm": 23.76}),
         r"\$\.camera_intrinsics\.focal_length_mm is missing, where the focal length stands; the "
         r"keys are: .*intrinsics\.zoom.*\[focal_length\] place = "),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_rig_is_told_with_its_place(rig_document, change, told):
    change(rig_document)

    with pytest.raises(SchemaError, match=rf"(?s)baseline\.json: \d+ problem.*{told}"):
        read(rig_document)


def test_all_problems_of_a_file_are_reported_at_once_but_for_many(rig_document):
    lens(focal_length_mm="far", sensor_width_mm=0)(rig_document)
    baseline(3, None)(rig_document)

    told = r"(?s)3 problems.*focal_length_mm.*sensor_width_mm.*\[3\].baseline_cm"
    with pytest.raises(SchemaError, match=told):
        read(rig_document)
    rig_document["pairwise_pairs"] = rig_document["pairwise_pairs"][3:4] * 30
    with pytest.raises(SchemaError, match=r"(?s)32 problems.*\n  and 12 more\.$"):
        read(rig_document)


def test_without_an_image_size_the_releases_size_is_assumed(rig_document):
    del rig_document["image_width"], rig_document["image_height"]

    rig, _, _ = read(rig_document)

    assert (rig.image_width_px, rig.image_height_px) == (1280, 1280)
    assert rig.image_size_source == "default"


def test_without_a_sensor_height_pixels_are_square(rig_document):
    del rig_document["camera_intrinsics"]["sensor_height_mm"]

    assert read(rig_document)[0].sensor_height_mm == pytest.approx(17.82)


@pytest.mark.parametrize(
    ("pair", "expected"),
    [
        ({"left_camera": "Town_Cam_02", "right_camera": "Town_cam4"}, (2, 4)),
        ({"left_camera": 3, "right_camera": 5}, (3, 5)),
        ([4, 1], (4, 1)),
    ],
)
def test_each_form_of_the_primary_pair_is_read(rig_document, pair, expected):
    assert read(rig_document | {"primary_stereo_pair": pair})[0].primary_pair == expected


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


@pytest.mark.parametrize(
    ("written", "point_px"),
    [
        ({"principal_point": [300.5, 250.0]}, (300.5, 250.0)),
        ({"cx": 300.5, "cy": 250.0}, (300.5, 250.0)),
        ({"cx_px": 300.5, "cy_px": 250.0}, (300.5, 250.0)),
        ({"principal_point_px": {"x": 300.5, "y": 250}}, (300.5, 250.0)),
        ({"principal_point_override": {"enabled": True, "cx": 300.5, "cy": 250}}, (300.5, 250.0)),
        ({"K": {"fx": 875.42, "fy": 875.42, "cx": 300.5, "cy": 250.0}}, (300.5, 250.0)),
        ({"K": [[875.42, 0, 300.5], [0, 875.42, 250.0], [0, 0, 1]]}, (300.5, 250.0)),
        ({"cx": 320.5, "cy": 239.5}, None),
        ({"cx": 0.5, "cy": 0.5}, None),
        ({"principal_point": None}, None),
        ({"cx": None, "cy": "centre"}, None),
    ],
)
def test_a_principal_point_is_read_where_it_is_in_pixels(rig_document, written, point_px):
    lens(**written)(rig_document)

    rig, _, remarks = read(rig_document)

    assert rig.principal_point_px == point_px
    assert remarks == ()


@pytest.mark.parametrize("written", [{"cx": 300.5}, {"cx": 1e9, "cy": 1}])
def test_a_principal_point_outside_the_picture_is_told(rig_document, written):
    lens(**written)(rig_document)

    rig, _, (remark,) = read(rig_document)

    assert rig.principal_point_px is None
    assert remark.about == "principal point"


def test_baselines_of_neighbours_add_up_to_the_others(rig_document):
    rig_document["pairwise_pairs"] = [
        pair for pair in rig_document["pairwise_pairs"]
        if pair["camera_index_b"] - pair["camera_index_a"] in (1, 4)
    ]  # fmt: skip

    rig, _, (remark,) = read(rig_document)

    assert rig.baselines_cm == pytest.approx(BASELINES_CM, rel=1e-15)
    assert remark.about == "baselines"
    assert "0-2, 0-3, 0-5, 1-3" in remark.text
    rig_document["pairwise_pairs"][1]["baseline_cm"] = 30.0
    with pytest.raises(SchemaError, match="and lacks 0-2, 0-3"):
        read(rig_document)


def test_labels_that_are_odd_stop_nothing(rig_document):
    rig_document |= {
        "camera_count": "six", "scene_index": "no", "aperture_fstop": "f/4", "notes": [math.nan],
        "map_name": 3,
    }  # fmt: skip

    _, labels, (remark,) = read(rig_document)

    assert (labels.scene_index, labels.map_name, labels.aperture_fstop) == (None, None, None)
    assert remark.about == "labels"


lengths = st.floats(0.5, 5000)


def entry(a, b, length_cm):
    """A pair of a baseline.json."""
    return {"camera_index_a": a, "camera_index_b": b, "baseline_cm": length_cm}


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
