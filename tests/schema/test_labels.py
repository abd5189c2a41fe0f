"""Scene keys, identifiers and descriptions."""

import contextlib
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.parse import parse_complete, parse_description, parse_scene_key
from stereogenbench_data.schema.records import Description, SceneId, SceneLabels


@pytest.mark.parametrize(
    ("key", "split", "subset"),
    [
        ("train/Uniform/Car_Dealer/scene_000001", "train", None),
        ("eval/MapSeenInTrain/Uniform/Car_Dealer/scene_000001", "eval", "seen_map"),
        ("eval/MapUnseenInTrain/Uniform/Car_Dealer/scene_000001", "eval", "unseen_map"),
        ("eval/MapNotSeenInTrain/Uniform/Car_Dealer/scene_000001", "eval", "unseen_map"),
        ("eval/Other/Uniform/Car_Dealer/scene_000001", "eval", None),
    ],
)
def test_a_key_tells_split_subset_family_and_map(key, split, subset):
    assert parse_scene_key(key) == SceneId(key, split, subset, "Uniform", "Car_Dealer")


@pytest.mark.parametrize(
    ("key", "match"),
    [
        ("train/Uniform/Map/scene_1.5", "contains a dot.*Rename the folder"),
        ("train/Uniform/../scene_1", "contains a dot"),
        ("train/Uniform/Mäp/scene_1", "'Mäp' is not a valid folder"),
        ("train/Uniform//scene_1", "'' is not a valid folder"),
        ("train/Uniform/a\\b/scene_1", "is not a valid folder"),
        ("train/Uniform/a\n/scene_1", "is not a valid folder"),
        ("train/Uniform/scene_1", "train/<family>/<map>/<scene>.*found 3 folders"),
        ("eval/Uniform/Map/scene_1", "eval/<subset>/<family>/<map>/<scene>.*found 4 folders"),
        ("test/Uniform/Map/scene_1", "start with 'test'"),
        ("", "'' is not a valid folder"),
    ],
)
def test_a_path_of_another_form_is_refused(key, match):
    with pytest.raises(SchemaError, match=match):
        parse_scene_key(key)


@given(key=st.text(max_size=30))
def test_any_text_is_a_key_or_refused(key):
    with contextlib.suppress(SchemaError):
        assert parse_scene_key(key).key == key


def test_the_completion_marker_is_read():
    text = json.dumps(
        {"scene_label": "A_1", "scene_index": 1.0, "map_name": "A", "map_path": "/Game/A"}
    )

    labels = parse_complete(text.encode(), where="m.json")

    assert labels == SceneLabels(scene_label="A_1", scene_index=1, map_name="A", map_path="/Game/A")


def test_every_identifier_of_a_wrong_type_is_reported():
    text = b'{"scene_label": 3, "scene_index": "4", "map_name": ["A"]}'

    with pytest.raises(SchemaError, match=r"m\.json: 3 problems") as caught:
        parse_complete(text, where="m.json")

    assert str(caught.value).splitlines()[1:] == [
        "  $.scene_label: must be a text, found 3",
        "  $.scene_index: must be an integer, found '4'",
        "  $.map_name: must be a text, found a list of 1",
    ]


def test_half_a_character_is_refused():
    with pytest.raises(SchemaError, match=r"\$\.map_name: contains half a character"):
        parse_complete(b'{"map_name": "\\ud800"}', where="m.json")


def test_a_description_is_read():
    text = b"""{"scene_type": "outdoor", "setting": "yard", "short_caption": "A yard.",
               "detailed_caption": "A yard with a wall.", "tags": ["yard", "wall"], "other": 1}"""

    assert parse_description(text, where="d.json") == Description(
        "A yard.", "A yard with a wall.", "outdoor", "yard", ("yard", "wall")
    )


def test_a_caption_under_an_unknown_key_is_refused():
    with pytest.raises(SchemaError, match=r"d\.json: .*problem") as caught:
        parse_description(b'{"caption": "A yard.", "tags": []}', where="d.json")

    assert "$.caption: is not a known key and may stand for short_caption" in str(caught.value)
    assert "the keys here are: caption, tags" in str(caught.value)


def test_an_empty_description_has_empty_texts():
    assert parse_description(b"{}", where="d.json") == Description()


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (b'{"tags": "yard"}', r"\$\.tags: must be a list of texts, found 'yard'"),
        (b'{"tags": ["yard", 3]}', r"\$\.tags\[1\]: must be a text, found 3"),
        (b'{"short_caption": true}', r"\$\.short_caption: must be a text, found True"),
    ],
)
def test_a_description_of_a_wrong_type_is_refused(text, match):
    with pytest.raises(SchemaError, match=match):
        parse_description(text, where="d.json")
