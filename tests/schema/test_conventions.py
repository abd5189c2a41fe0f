"""Files of conventions: what they may state, and what is refused with file, key, value and cure."""

import re

import pytest

from stereogenbench_data.errors import SchemaError, StorageError
from stereogenbench_data.schema.conventions import (
    MAX_BYTES,
    Conventions,
    parse_conventions,
    shape_of_text,
    write_toml,
)
from stereogenbench_data.schema.parse import parse_rig, see_rig

WHOLE = b"""
[[shape]]
has = ["baseline.json: $.lens.mm"]

[shape.focal_length]
place = "$.lens.mm"
unit = "mm"
ignored = ["$.old"]

[shape.sensor_width]
value = 23.76
unit = "mm"

[shape.baselines]
place = "$.pairs"
unit = "cm"

[shape.primary_pair]
left = "$.primary[0]"
right = '$["the pair"].right'

[shape.poses]
location = "frames[].cameras[].location"
rotation = "frames[].cameras[].rotation"
form = "quaternion wxyz"
axes = "opencv"
unit = "m"

[shape.depth]
unit_m = 0.01
instead_of_tag_m = 0.1
kind = "ray"
form = "inverse"
frame_lag = -1
no_depth = [0, 7, "max"]
accept = ["10-bit", "lossy"]

[[shape]]
[shape.depth]
frame_lag = 1
no_depth = []
"""


def read(text):
    return parse_conventions(text, where="c.toml")


def test_all_that_can_be_stated_is_read_and_written_again():
    conventions = read(WHOLE)

    written = write_toml(conventions, {(0, "depth"): ["a note\nof two lines"], (-1, ""): ["head"]})

    assert read(written.encode()) == conventions
    assert written.startswith("# head\n")
    first, second = conventions.shapes
    assert (first.has, first.at["sensor_width"].value) == (
        ("baseline.json: $.lens.mm",),
        23.76,
    )
    assert (first.depth.encoding.kind, first.depth.encoding.no_depth) == ("ray", (0, 7, "max"))
    assert (second.depth.encoding.frame_lag, second.depth.encoding.no_depth) == (1, ())
    assert [shape_of_text(shape.text()) for shape in conventions.shapes] == [first, second]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        pytest.param(b"[focl_length]\n", "focl_length.*did you mean focal_length", id="table"),
        pytest.param(b"[depth]\nunitm = 1", r"\[depth\].*unitm.*did you mean unit_m", id="key"),
        pytest.param(b"[depth]\nkind = 'rya'", r"\[depth\].*kind.*rya", id="choice"),
        pytest.param(b"[depth]\nunit_m = -1", r"\[depth\].*unit_m.*-1", id="negative"),
        pytest.param(b"[depth]\nframe_lag = 0.5", r"\[depth\].*frame_lag.*0.5", id="half a frame"),
        pytest.param(b"[depth]\nunit_m = " + b"9" * 400, "unit_m", id="no float holds it"),
        pytest.param(b"[depth]\nno_depth = [[1]]", "no_depth", id="nested"),
        pytest.param(b"[depth]\naccept = ['losy']", "losy.*did you mean lossy", id="risk"),
        pytest.param(b"[depth]\ninstead_of_tag_m = 1.0", "unit_m", id="instead of what"),
        pytest.param(b"[focal_length]\n", r"\[focal_length\].*place", id="neither place nor value"),
        pytest.param(b"[focal_length]\nplace='x'\n", "place.*JSON path.*'x'", id="no path"),
        pytest.param(b"[focal_length]\nvalue=nan\n", "value.*nan", id="nan"),
        pytest.param(b"[focal_length]\nplace='$.f'\nunit='deg'", "unit.*deg", id="unit of angles"),
        pytest.param(b"[baselines]\nunit = 'cm'", r"\[baselines\].*place", id="no place"),
        pytest.param(b"has = 3", "has.*3", id="has"),
        pytest.param(b"shape = [3]", "shape.*3", id="shape"),
        pytest.param(b"[[shape]]\n[depth]\n", r"\[depth\].*\[shape.depth\]", id="beside a shape"),
        pytest.param(b"[depth]\nunit_m = \n", "line 2", id="no TOML"),
        pytest.param(b"x = " + b"[" * 9000 + b"]" * 9000, "not TOML", id="deep"),
        pytest.param(b"\xff\xfe", "not UTF-8", id="bytes"),
        pytest.param(b"#" * (MAX_BYTES + 1), f"{MAX_BYTES:,}", id="too large"),
    ],
)
def test_what_is_not_understood_is_refused_by_name(text, told):
    with pytest.raises(SchemaError, match=rf"(?s)c\.toml.*{told}"):
        read(text)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(StorageError, match=r"none\.toml"):
        Conventions.read(tmp_path / "none.toml")


def test_a_rig_is_the_same_by_the_places_where_it_was_seen(rig_document, dumped):
    text = dumped(rig_document)

    shape, _, unknown = see_rig(text, where="b")

    assert parse_rig(text, where="b", shape=shape) == parse_rig(text, where="b")
    assert shape.at["focal_length"].place == "$.camera_intrinsics.focal_length_mm"
    assert shape.at["baselines"].place == "$.pairwise_pairs"
    assert unknown == []


def test_keys_that_nobody_reads_are_seen(rig_document, dumped):
    document = rig_document | {"exposure": {"shutter_7": 0.5}}

    assert see_rig(dumped(document), where="b")[2] == ["$.exposure.shutter_#"]


def test_quantities_under_unknown_names_are_read_where_conventions_say(rig_document, dumped):
    expected = parse_rig(dumped(rig_document), where="b")[0]
    camera = rig_document.pop("camera_intrinsics")
    rig_document["optics"] = {"a": camera["focal_length_mm"] / 10, "b": [camera["sensor_width_mm"]]}
    rig_document["gaps"] = rig_document.pop("pairwise_pairs")
    rig_document["who"] = rig_document.pop("primary_stereo_pair")
    (shape,) = read(
        b'[focal_length]\nplace = "$.optics.a"\nunit = "cm"\n'
        b'[sensor_width]\nplace = "$.optics.b[0]"\nunit = "mm"\n'
        b'[sensor_height]\nvalue = 17.82\nunit = "mm"\n'
        b'[baselines]\nplace = "$.gaps"\n'
        b'[primary_pair]\nleft = "$.who.left_camera"\nright = "$.who.right_camera"\n'
    ).shapes

    assert parse_rig(dumped(rig_document), where="b", shape=shape)[0] == expected


@pytest.mark.parametrize("place", ["$.none", "$.pairwise_pairs[99]", r'$["\x"]', r'$["\u12"]'])
def test_a_place_that_a_file_does_not_have_is_named(rig_document, dumped, place):
    (shape,) = read(f"[focal_length]\nplace = '{place}'\n".encode()).shapes

    with pytest.raises(SchemaError, match=rf"{re.escape(place)} is not in the file.*focal_length"):
        parse_rig(dumped(rig_document), where="b", shape=shape)


def test_the_only_number_beside_two_cameras_may_be_called_a_baseline(rig_document, dumped):
    expected = parse_rig(dumped(rig_document), where="b")[0]
    pairs = rig_document.pop("pairwise_pairs")
    rig_document["gaps"] = [
        {"i": each["camera_index_a"], "j": each["camera_index_b"], "d": each["baseline_cm"]}
        for each in pairs
    ]
    (shape,) = read(b'[baselines]\nplace = "$.gaps"\nunit = "cm"\n').shapes

    assert parse_rig(dumped(rig_document), where="b", shape=shape)[0] == expected
    for each in rig_document["gaps"]:
        each["e"] = 1.0
    with pytest.raises(SchemaError, match="the keys here are: d, e, i, j") as caught:
        parse_rig(dumped(rig_document), where="b", shape=shape)
    assert str(caught.value).count("the keys here are: d") == 1


def test_another_value_of_a_quantity_counts_unless_it_is_ignored(rig_document, dumped):
    rig_document["camera_intrinsics"]["focal_length"] = 50.0
    stated = b'[focal_length]\nplace = "$.camera_intrinsics.focal_length_mm"\n'
    ignoring = stated + b'ignored = ["$.camera_intrinsics.focal_length"]\n'

    with pytest.raises(SchemaError, match=r"focal_length: .*50.*32\.5"):
        parse_rig(dumped(rig_document), where="b", shape=read(stated).shapes[0])
    rig, _, _ = parse_rig(dumped(rig_document), where="b", shape=read(ignoring).shapes[0])

    assert rig.focal_mm == 32.5
