"""Files of conventions: what they may state, and what is refused with file, key, value and cure."""

import contextlib
import itertools
import re

import pytest

from stereogenbench_data.errors import SchemaError, StorageError
from stereogenbench_data.schema.conventions import (
    MAX_BYTES,
    Conventions,
    declaration_of_text,
    parse_conventions,
    write_toml,
)
from stereogenbench_data.schema.declaration import BUILT_IN
from stereogenbench_data.schema.parse import parse_rig

EARLIER = b"""
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


WHOLE = b"""
format = 2

[[shape]]
has = ["baseline.json: $.lens.f"]

[shape.focal_length]
place = ["$.lens.f", "$.lens.px~"]
as = "pixels"

[shape.sensor_width]
value = 23.76
unit = "mm"

[shape.sensor_height]
place = "$.lens.h"
unit = "cm"
optional = true

[shape.pairs]
rows = "$.gaps{}"
a = "#0"
b = "#1"
length = "d"
unit = "m"
first = 1

[shape.gaps]
rows = "$.steps[]"
a = "order"
b = "order"
length = ""

[shape.primary_pair]
left = ["$.pair.l", "$.pair[0]"]
right = ["$.pair.r", "$.pair[1]"]
optional = true

[shape.poses]
location = "$.frames{}.cams[].pose[0:3]"
rotation = "$.frames{}.cams[].pose[3:7]"
frame = "$.frames{}#"
camera = "$.frames{}.cams[].name"
outer = "frames"
first = 1
step = 2
form = "quaternion wxyz"
axes = "opencv"
unit = "m"

[shape.depth]
unit_m = 0.01

[[shape]]
[shape.depth]
frame_lag = 1
"""


def read(text):
    return parse_conventions(text, where="c.toml")


@pytest.mark.parametrize("text", [EARLIER, WHOLE], ids=["the earlier format", "format 2"])
def test_all_that_can_be_stated_is_read_and_written_again(text):
    conventions = read(text)

    written = write_toml(conventions, {(0, "depth"): ["a note\nof two lines"], (-1, ""): ["head"]})

    assert read(written.encode()) == conventions
    assert written.startswith("# head\n")
    texts = [shape.text() for shape in conventions.shapes]
    assert [*map(declaration_of_text, texts)] == [*conventions.shapes]


def test_a_candidate_has_the_header_of_its_shape():
    candidate = {(1, "image_width"): ["candidate 1 of 1", "[image_width]", "value = 320"]}

    written = write_toml(read(EARLIER), candidate)

    head, found, uncommented = written.partition("# [shape.image_width]\n# value = 320\n")
    assert found
    _, second = read((head + found.replace("# ", "") + uncommented).encode()).shapes
    assert second.numbers["image_width"].value == 320


def test_files_of_the_earlier_format_are_declarations():
    first, second = read(EARLIER).shapes
    assert (first.has, first.numbers["sensor_width"].value) == (
        ("baseline.json: $.lens.mm",),
        23.76,
    )
    assert first.numbers["focal_length"].places == ("$.lens.mm",)
    assert second.numbers == BUILT_IN.numbers
    assert (first.depth.encoding.kind, first.depth.encoding.no_depth) == ("ray", (0, 7, "max"))
    assert (second.depth.encoding.frame_lag, second.depth.encoding.no_depth) == (1, ())


def test_a_text_beside_a_scene_of_an_earlier_index_is_written_as_it_was():
    text = '{"depth": {"frame_lag": 1}, "focal_length": {"place": "$.f", "unit": "mm"}}'

    assert declaration_of_text(text).text() == text


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
        pytest.param(b"[focal_length]\nplace='$[\"\\x\"]'\n", "place.*JSON path", id="no escape"),
        pytest.param(b"[focal_length]\nplace='$camera'\n", "place.*JSON path", id="no dot"),
        pytest.param(b"[focal_length]\nplace='$.f[]'\n", "place.*JSON path", id="many values"),
        pytest.param(b"[focal_length]\nvalue=nan\n", "value.*nan", id="nan"),
        pytest.param(b"[focal_length]\nplace='$.f'\nunit='deg'", "unit.*deg", id="unit of angles"),
        pytest.param(b"[baselines]\nunit = 'cm'", r"\[baselines\].*place", id="no place"),
        pytest.param(b"has = 3", "has.*3", id="has"),
        pytest.param(b"shape = [3]", "shape.*3", id="shape"),
        pytest.param(b"[[shape]]\n[depth]\n", r"\[depth\].*\[shape.depth\]", id="beside a shape"),
        pytest.param(b"[depth]\nunit_m = \n", "line 2", id="no TOML"),
        pytest.param(b"x = " + b"[" * 9000 + b"]" * 9000, "not TOML", id="deep"),
        pytest.param(b"\xff\xfe", "not UTF-8", id="bytes"),
        pytest.param(b"format = 3", "format must be 2, found 3", id="format"),
        pytest.param(b"format = 2\n[baselines]", "baselines.*not known", id="of the other format"),
        pytest.param(b"[pairs]\nrows = '$.p[]'", "pairs.*not known", id="without its format"),
        pytest.param(b"format = 2\n[pairs]\nrows='$.p'\na='i'\nb='j'", "rows.*ends in", id="rows"),
        pytest.param(b"format = 2\n[pairs]\nrows='$.p[]'\nb='j'", "pairs.*a is missing", id="a"),
        pytest.param(b"format = 2\n[pairs]\nrows='$.p[]'\na='[]'\nb='j'", "a must be", id="part"),
        pytest.param(
            b"format = 2\n[poses]\nlocation='frames[].t'", "location.*JSON path", id="way"
        ),
        pytest.param(b"format = 2\n[image_width]\nplace='$..a'", "place.*JSON path", id="dots"),
        pytest.param(b"format = 2\n[image_width]\nplace=[]", "place must be", id="no places"),
        pytest.param(b"format = 2\n[focal_length]\nvalue=1\nas='mm'", "as must be", id="as"),
        pytest.param(b"#" * (MAX_BYTES + 1), f"{MAX_BYTES:,}", id="too large"),
    ],
)
def test_what_is_not_understood_is_refused_by_name(text, told):
    with pytest.raises(SchemaError, match=rf"(?s)c\.toml.*{told}"):
        read(text)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(StorageError, match=r"none\.toml"):
        Conventions.read(tmp_path / "none.toml")


def moved(document):
    """The document with its lens, pairs and primary pair under other keys, in other units."""
    camera = document.pop("camera_intrinsics")
    document["optics"] = {"a": camera["focal_length_mm"] / 10, "b": [camera["sensor_width_mm"]]}
    document["gaps"] = document.pop("pairwise_pairs")
    document["who"] = document.pop("primary_stereo_pair")
    return document


EARLIER_MOVED = b"""
[focal_length]
place = "$.optics.a"
unit = "cm"
[sensor_width]
place = "$.optics.b[0]"
unit = "mm"
[sensor_height]
value = 17.82
unit = "mm"
[baselines]
place = "$.gaps"
[primary_pair]
left = "$.who.left_camera"
right = "$.who.right_camera"
"""
MOVED = b"format = 2" + EARLIER_MOVED.replace(
    b'[baselines]\nplace = "$.gaps"',
    b'[pairs]\nrows = "$.gaps[]"\na = "camera_index_a"\nb = "camera_index_b"\n'
    b'length = "baseline_cm"',
)


@pytest.mark.parametrize("text", [EARLIER_MOVED, MOVED], ids=["the earlier format", "format 2"])
def test_quantities_are_read_where_a_file_says(rig_document, dumped, text):
    expected = parse_rig(dumped(rig_document), where="b")[0]

    (shape,) = read(text).shapes

    assert parse_rig(dumped(moved(rig_document)), where="b", declared=shape)[0] == expected


PLACES_CM = (0.0, 6.5, 13.25, 19.0, 26.0, 32.5)
PAIRS = [(a, b, PLACES_CM[b] - PLACES_CM[a]) for a, b in itertools.combinations(range(6), 2)]


@pytest.mark.parametrize(
    ("written", "stated"),
    [
        ({f"{a}-{b}": cm for a, b, cm in PAIRS}, 'rows = "$.x{}"\na = "#0"\nb = "#1"'),
        ([[f"Cam_{a:02d}", f"Cam_{b:02d}", cm / 100] for a, b, cm in PAIRS],
         'rows = "$.x[]"\na = "[0]"\nb = "[1]"\nlength = "[2]"\nunit = "m"'),
        ([{"of": f"{a + 1} to {b + 1}", "d": cm * 10} for a, b, cm in PAIRS],
         'rows = "$.x[]"\na = "of#0"\nb = "of#1"\nlength = "d"\nunit = "mm"\nfirst = 1'),
        ({f"cam_{a}": {f"cam_{b}": cm for c, b, cm in PAIRS if c == a} for a in range(5)},
         'rows = "$.x{}{}"\na = "#0"\nb = "#1"'),
        ([[abs(a - b) or 1.0 for b in PLACES_CM] for a in PLACES_CM],
         'rows = "$.x[][]"\na = "#0"\nb = "#1"'),
        ([b - a for a, b in itertools.pairwise(PLACES_CM)],
         'rows = "$.x[]"\na = "order"\nb = "order"'),
    ],
    ids=["keys", "lists", "texts, from one", "names below names", "a matrix", "neighbours"],
)  # fmt: skip
def test_baselines_in_each_form_are_read_where_a_file_says(rig_document, dumped, written, stated):
    rig_document["x"] = written
    del rig_document["pairwise_pairs"]
    (shape,) = read(f"format = 2\n[pairs]\n{stated}\n".encode()).shapes

    rig = parse_rig(dumped(rig_document), where="b", declared=shape)[0]

    assert rig.baselines_cm == pytest.approx([cm for _, _, cm in PAIRS])


@pytest.mark.parametrize(
    ("lens", "stated"),
    [
        ({"f": 875.4208754}, '[focal_length]\nplace = "$.lens.f"\nas = "pixels"'),
        ({"f": 40.15832}, '[focal_length]\nplace = "$.lens.f"\nas = "field of view"'),
        ({"f": 0.7008949}, '[focal_length]\nplace = "$.lens.f"\nas = "field of view"\nunit="rad"'),
        ({"f": "3.25 cm"}, '[focal_length]\nplace = "$.lens.f~"\nunit = "cm"'),
    ],
    ids=["pixels", "degrees", "radians", "a text"],
)
def test_a_lens_in_each_form_is_read_where_a_file_says(rig_document, dumped, lens, stated):
    rig_document["lens"] = lens
    del rig_document["camera_intrinsics"]["focal_length_mm"]
    rig_document["camera_intrinsics"]["fx"] = 1.37  # which is then not compared
    (shape,) = read(f"format = 2\n{stated}\n".encode()).shapes

    rig = parse_rig(dumped(rig_document), where="b", declared=shape)[0]

    assert rig.focal_mm == pytest.approx(32.5, rel=1e-5)


def test_without_a_sensor_that_of_the_release_is_assumed(rig_document, dumped):
    rig_document["camera_intrinsics"] = {"fx": 875.4208754}
    text = b'format = 2\n[focal_length]\nplace = "$.camera_intrinsics.fx"\nas = "pixels"'
    (shape,) = read(text).shapes

    rig, _, (remark,) = parse_rig(dumped(rig_document), where="b", declared=shape)

    assert (rig.sensor_width_mm, rig.sensor_height_mm) == pytest.approx((23.76, 17.82))
    assert rig.focal_mm == pytest.approx(32.5, rel=1e-5)
    assert remark.about == "sensor"


def test_a_primary_pair_that_need_not_be_there_is_the_first_two_cameras(rig_document, dumped):
    del rig_document["primary_stereo_pair"]
    text = b'format = 2\n[primary_pair]\nleft = "$.l"\nright = "$.r"\noptional = true'
    (shape,) = read(text).shapes

    rig, _, (remark,) = parse_rig(dumped(rig_document), where="b", declared=shape)

    assert rig.primary_pair == (0, 1)
    assert remark.about == "primary pair"


@pytest.mark.parametrize(
    ("left", "end", "found"),
    [("Cam_03_C_1", "#0", 3), ("CineCameraActor_3", "#", 3), ("3", "#", 3), ("left", "#", None)],
)
def test_a_number_in_a_name_is_a_camera_where_a_file_says(rig_document, dumped, left, end, found):
    rig_document["primary_stereo_pair"] = {"left_camera": left, "right_camera": 4}
    pair = "$.primary_stereo_pair"
    places = f'left = "{pair}.left_camera{end}"\nright = "{pair}.right_camera"'
    (shape,) = read(f"format = 2\n[primary_pair]\n{places}\n".encode()).shapes
    with pytest.raises(SchemaError, match=r'left = "\$\.its\.place#0" is the first number'):
        parse_rig(dumped(rig_document), where="b")

    with pytest.raises(SchemaError) if found is None else contextlib.nullcontext():
        rig = parse_rig(dumped(rig_document), where="b", declared=shape)[0]
        assert rig.primary_pair == (found, 4)


@pytest.mark.parametrize("place", ["$.none", "$.pairwise_pairs[99]"])
def test_a_place_that_a_file_does_not_have_is_named(rig_document, dumped, place):
    (shape,) = read(f"[focal_length]\nplace = '{place}'\n".encode()).shapes

    with pytest.raises(SchemaError, match=rf"{re.escape(place)} is missing, where the focal len"):
        parse_rig(dumped(rig_document), where="b", declared=shape)


@pytest.mark.parametrize(
    "rows",
    [
        [{"cam_a": f"Cam_{a:02d}", "cam_b": f"Cam_{b:02d}", "baseline_m": cm / 100}
         for a, b, cm in PAIRS],
        [{"camera_index_a": a, "camera_index_b": b, "baseline_cm": cm, "index": 3, "gap": b - a}
         for a, b, cm in PAIRS],
        {f"{a}-{b}": {"length_cm": cm} for a, b, cm in PAIRS},
        {f"{a}-{b}": cm for a, b, cm in PAIRS},
        [[a, b, cm] for a, b, cm in PAIRS],
        [cm for a, b, cm in PAIRS if b == a + 1],
    ],
    ids=["names, metres", "the printed keys", "keys and objects", "keys", "lists", "neighbours"],
)  # fmt: skip
def test_a_file_of_the_earlier_format_names_the_list_of_baselines_alone(rig_document, dumped, rows):
    rig_document["pairwise_pairs"] = rows
    (shape,) = read(b'[baselines]\nplace = "$.pairwise_pairs"\n').shapes

    rig = parse_rig(dumped(rig_document), where="b", declared=shape)[0]

    assert rig.baselines_cm == pytest.approx([cm for _, _, cm in PAIRS])


def test_the_only_number_beside_two_cameras_may_be_called_a_baseline(rig_document, dumped):
    expected = parse_rig(dumped(rig_document), where="b")[0]
    pairs = rig_document.pop("pairwise_pairs")
    rig_document["gaps"] = [
        {"i": each["camera_index_a"], "j": each["camera_index_b"], "d": each["baseline_cm"]}
        for each in pairs
    ]
    (shape,) = read(b'[baselines]\nplace = "$.gaps"\nunit = "cm"\n').shapes

    assert parse_rig(dumped(rig_document), where="b", declared=shape)[0] == expected
    for each in rig_document["gaps"]:
        each["e"] = 1.5
    with pytest.raises(SchemaError, match="the keys here are: d, e, i, j"):
        parse_rig(dumped(rig_document), where="b", declared=shape)
