"""Scene keys, identifiers and descriptions."""

import json

import pytest

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.parse import parse_caption, parse_complete, parse_scene_key
from stereogenbench_data.schema.records import SceneId, SceneLabels


@pytest.mark.parametrize(
    ("key", "split", "subset"),
    [
        ("train/Uniform/Car_Dealer/scene_000001", "train", None),
        ("eval/MapSeenInTrain/Uniform/Car_Dealer/scene_000001", "eval", "seen_map"),
        ("eval/MapUnseenInTrain/Uniform/Car_Dealer/scene_000001", "eval", "unseen_map"),
        ("eval/Other/Uniform/Car_Dealer/scene_000001", "eval", None),
    ],
)
def test_a_key_tells_split_subset_family_and_map(key, split, subset):
    assert parse_scene_key(key) == SceneId(key, split, subset, "Uniform", "Car_Dealer")


@pytest.mark.parametrize(
    ("key", "match"),
    [
        ("train/Uniform/Map/scene_1.5", "is not a valid folder.*Rename the folder"),
        ("train/Uniform/../scene_1", "is not a valid folder"),
        ("train/Uniform/Mäp/scene_1", "'Mäp' is not a valid folder"),
        ("train/Uniform/scene_1", "train/<family>/<map>/<scene>.*found 3 folders"),
        ("eval/Uniform/Map/scene_1", "eval/<subset>/<family>/<map>/<scene>.*found 4 folders"),
        ("test/Uniform/Map/scene_1", "start with 'test'"),
    ],
)
def test_a_path_of_another_form_is_refused(key, match):
    with pytest.raises(SchemaError, match=match):
        parse_scene_key(key)


def test_the_completion_marker_is_read():
    told = {"scene_label": "A_1", "scene_index": 1, "map_name": "A", "map_path": "/Game/A"}

    labels, remarks = parse_complete(json.dumps(told).encode(), where="m.json")

    assert labels == SceneLabels(**told)
    assert remarks == ()


@pytest.mark.parametrize(
    "text",
    [
        b'{"scene_label": 3}', b'{"scene_label": ["A"]}', b'{"map_name": "\\ud800"}', b"", b"[]",
        b"\xff\xfe{}", b'{"map_name": "A", "map_name": "B"}',
    ],
)  # fmt: skip
def test_a_marker_that_is_not_understood_stops_nothing(text):
    labels, remarks = parse_complete(text, where="m.json")

    assert labels == SceneLabels()
    assert all(remark.text.startswith("m.json: ") for remark in remarks)


@pytest.mark.parametrize(
    ("written", "number"), [(4, 4), ("0041", 41), (1.5, None), ("x", None), (True, None)]
)
def test_the_number_of_a_scene_may_be_a_text(written, number):
    labels, _ = parse_complete(json.dumps({"scene_index": written}).encode(), where="m.json")

    assert labels.scene_index == number


@pytest.mark.parametrize(
    "text",
    [
        b"""{"scene_type": "outdoor", "short_caption": "A yard.", "tags": ["yard", "wall"],
             "detailed_caption": "A yard with a wall."}""",
        b'{"caption": "A yard with a wall.", "summary": "A yard."}',
        b'{"short_caption": "A yard with a wall."}',
    ],
    ids=["as printed", "the only one", "the short one alone"],
)
def test_a_caption_is_the_detailed_one(text):
    assert parse_caption(text, where="d.json") == ("A yard with a wall.", ())


LONG = b'{"caption": "%s"}' % (b"x" * 70_000)


@pytest.mark.parametrize("text", [b"{}", b'{"caption": true}', b'{"tags": [3]}', b"[]", b"", LONG])
def test_a_description_without_texts_has_no_caption_and_stops_nothing(text):
    caption, remarks = parse_caption(text, where="d.json")

    assert caption == ""
    assert {remark.about for remark in remarks} <= {"caption"}
