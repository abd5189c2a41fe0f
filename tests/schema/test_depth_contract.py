"""What tags and JSON say of stored depth, in many spellings: understood right, or refused."""

import json
import re

import pytest

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.depth_contract import agreed, stated_in_json, stated_in_tags


def of_tags(**tags):
    return agreed(stated_in_tags(tags, name="clip"))


def of_json(document):
    return agreed(stated_in_json(document, name="baseline.json"))


MILLIMETRES = """
scale=0.001 | depth_scale=1000 | DEPTH_UNIT=mm | unit=0.001 m | depth_unit=1 mm | scale=1e-3 m
meters_per_unit=0.001 | units_per_meter=1000 | UNITSPERMETER=1000 | DEPTHSCALEMM=1
depth_scale_cm=0.1 | depth_scale=0.001 m/unit
depth_units=millimeters | depth_unit=millimeters per count | scale=0.001 m per unit
depth_to_meters=0.001 | m_to_depth=1000 | scale_factor=1000 | DEPTH_DIVISOR=1000
depth_multiplier=0.001 | DEPTH_M_PER_LSB=0.001 | DEPTH_MM_PER_UNIT=1 | depth_precision=1mm
depth_quantization_step_m=0.001
"""


@pytest.mark.parametrize(
    "tag", [each.strip() for line in MILLIMETRES.split("\n") for each in line.split("|") if each]
)
def test_a_tag_of_millimetres_is_understood(tag):
    key, _, value = tag.partition("=")

    found = of_tags(**{key: value})

    assert found == (pytest.approx(0.001), "tag")


@pytest.mark.parametrize(
    "document",
    [
        {"cameras": [{"id": at, "depth_scale": 0.01 if at == 3 else 0.001} for at in range(6)]},
        {"depth_scales_m": {f"cam_{at:02d}": 0.01 if at == 3 else 0.001 for at in range(6)}},
    ],
    ids=json.dumps,
)
def test_cameras_whose_units_differ_are_refused_with_both_places(document):
    with pytest.raises(SchemaError, match=r"(03|\[3\]).* is '0.01', .* is '0.001': contradict"):
        of_json(document)


@pytest.mark.parametrize(
    "document",
    [
        {"depth_scale": 1000},
        {"depth_scales_m": [0.001] * 6},
        {"depth_scales_m": {f"cam_{camera:02d}": 0.001 for camera in range(6)}},
        {"cameras": [{"camera_index": number, "depth_scale": 0.001} for number in range(6)]},
        {"depth_unit": "mm"},
        {"depthUnitMeters": 0.001},
        {"depth": {"scale": 0.001, "unit": "m", "bits": 16, "frames": 81}},
        {"depth_encoding": {"meters_per_unit": 0.001, "dtype": "uint16"}},
        {"render_settings": {"depth": {"format": "gray16", "unit_m": 0.001}}},
        {"unit": "cm", "depth_unit_cm": 0.1, "depth_stats": {"min_m": 5.8, "max_m": 61.5}},
        {"frames": [{"t": 0, "cameras": [{"depth": {"unit": "mm"}}]}]},
        {"outputs": [{"type": "rgb", "scale": 2.0}, {"type": "depth", "scale": 0.001}]},
        {"files": [{"file": "cam_00_depth.mkv", "scale_m": 0.001, "crf": 0.01}]},
        {"encoding": {"target": "depth", "meters_per_value": 0.001}},
        {"depthmap_scale": 0.001},
    ],
    ids=json.dumps,
)
def test_json_of_millimetres_is_understood(document):
    found = of_json(document)

    assert found == (pytest.approx(0.001), "metadata")


@pytest.mark.parametrize(
    "document",
    [
        {},
        {"unit": "cm", "meters_per_unit": 0.01},
        {"depth_scale": None},
        {"depth": {"bits": 16, "codec": "ffv1", "pix_fmt": "gray16le", "frames": 81}},
        {"depth_of_field": {"scale": 2.5}},
        {"name": "depth", "unit": "cm"},
        {"frames": [{"focus_depth_m": 0.15}]},
        {"depth_stats": {"min_m": 5.8, "max_m": 61.5}, "valid_depth_ratio": 0.94},
        {"depth_range_m": [0.5, 80.5], "depth": {"near": 0.5, "far": 80.5, "foo": 0.001}},
    ],
    ids=json.dumps,
)
def test_json_that_says_nothing_of_the_unit_leaves_it_open(document):
    assert of_json(document) is None


@pytest.mark.parametrize(
    "tags",
    [
        {"encoder": "Lavf61.7.100", "DURATION": "00:00:05.4", "RGB_SCALE": "255"},
        {"title": "AssetsvilleTown_scene_1166 depth 16 bit"},
        {"comment": "Rendered by Unreal 5.3 with a 35 mm lens, 1280x1280"},
        {"description": "ray-traced"},
    ],
    ids=str,
)
def test_tags_of_something_else_leave_the_unit_open(tags):
    assert of_tags(**tags) is None


def test_the_ends_of_a_range_beside_a_scale_are_ignored():
    found = of_tags(DEPTH_SCALE="0.001", depth_min="312", depth_max="60000", depth_range="0-80 m")

    assert found == (0.001, "tag")


UNCLEAR = """
scale= | scale=0 | scale=-1 | scale=nan | scale=x0.001 | units_per_meter=0.001 | DEPTH_MM=1
DEPTH_FOO=0.001 | DEPTH_UNIT=m | scale=1/1000 | scale=0,001
unit=furlong | scale=0.03937 in | scale=0.1; DEPTH_UNIT=mm | scale=0.1; unit=cm
DEPTH_SCALE=65.535 | DEPTH_SCALE=1 | scale=1.0 | depth_encoding=inverse; scale=655
encoding=log; scale=0.001 | depth_type=euclidean; scale=0.001 | disparity_scale=16
scale=0.001; depth_encoding=1/z | scale=0.001; depth_shift=3 | scale=0.001; depth_linear=false
scale=0.001; depth_is_planar=0 | scale=0.001; depth_kind=range | scale=0.001; depth_is=reciprocal
scale=0.001; offset=0.5 | max_depth=100 | normalized=1 | near=10; far=10000
depth_near=0.5 m; depth_far=80.5 m | depth_range=0.5-80.5 m
projection=distance_to_camera; scale=0.001 | depth_format=uint16_mm | title=cam_00_depth_mm
comment=mm | title=depth in mm, 16 bit | comment=Depth (millimetres), uint16
comment=stored = metres * 1000 | comment=depth[m] = pixel / 1000.0 | comment=z = v*0.001 m
comment=[m] = 0.001 * raw | comment=1 unit = 1 mm | comment=1000 = 1m
comment=1000 units per metre | comment=baselines in cm; depth in mm | comment=unit=mm
comment=16-bit integers with a scale of 0.001 meters per unit. | comment=depth_scale=0.001
comment=multiply by 0.001 to get metres | comment={"depth_scale": 0.001, "unit": "m"}
comment=depth clipped at 100 m | comment=uint16 mm, distance to camera | comment=range image, mm
"""
"""Each is refused: nobody reads it, and the default unit in its place would be wrong in silence."""


@pytest.mark.parametrize("text", UNCLEAR.strip().replace("\n", " | ").split(" | "))
def test_tags_that_do_not_tell_the_unit_are_refused_by_name(text):
    tags = dict(each.split("=", 1) for each in re.split(r"; (?=\w+=)", text))

    with pytest.raises(SchemaError, match=f"clip: tag ({'|'.join(tags)}) = "):
        of_tags(**tags)


@pytest.mark.parametrize(
    "document",
    [
        {"depth_resolution_m": 0.001},
        {"depth_encoding": "uint16 millimeters"},
        {"depth_description": "16-bit depth, 1 unit = 1 mm"},
        {"depth_normalization": "linear"},
        {"depth": {"type": "ray_distance", "scale": 0.001}},
        {"depth": {"annotator": "distance_to_camera", "unit": "mm"}},
        {"depth_kind": "spherical", "depth_scale": 0.001},
        {"depth": {"offset": 0.5, "scale": 0.001}},
        {"depth": {"linear": False, "scale": 0.001}},
        {"depth_formula": "z = 65.535 / v"},
        {"depth_is_planar": False, "depth_scale": 0.001},
        {"depth_scale": {"value": "many"}},
    ],
    ids=json.dumps,
)
def test_json_that_does_not_tell_the_unit_is_refused_by_its_path(document):
    with pytest.raises(SchemaError, match=r"baseline\.json: \$\.depth"):
        of_json(document)


def test_a_contradiction_of_two_files_names_both_places():
    tags = stated_in_tags({"DEPTH_SCALE": "0.001"}, name="cam_00_depth.mkv")
    document = stated_in_json({"depth_scale": 0.1}, name="baseline.json")

    with pytest.raises(SchemaError, match=r"cam_00_depth\.mkv: tag .*baseline\.json: \$\.depth_"):
        agreed([*tags, *document])


def test_what_is_stated_twice_agrees_within_its_rounding():
    tags = stated_in_tags({"scale": "0.00152587890625"}, name="clip")
    document = stated_in_json({"depth_units_per_meter": 655.36}, name="j")

    assert agreed([*tags, *document]) == (0.00152587890625, "tag")
