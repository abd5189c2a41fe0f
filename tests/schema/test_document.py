"""What is refused before a metadata file's content is looked at."""

import json

import pytest

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.document import parse_object


@pytest.mark.parametrize(
    ("text", "match"),
    [
        pytest.param(b"", r"a\.json: the file is empty. Copy it", id="empty"),
        pytest.param(b'{"a": 1, "b"', r"looks truncated: copy it", id="truncated"),
        pytest.param(b'{"a": "unfinish', r"looks truncated: copy it", id="truncated in a text"),
        pytest.param(b'{"a": 1]', r"line 1, column 8 .*Copy it", id="not JSON"),
        pytest.param(b"\xff\xfe{}", r"not UTF-8: byte 0 is 0xff", id="UTF-16"),
        pytest.param(b"[1, 2]", r"\$ must be an object, found a list of 2", id="a list"),
        pytest.param(b'{"a": ' + b"9" * 5000 + b"}", "not valid JSON", id="long number"),
        pytest.param(b"[" * 100_000, "nested hundreds of levels deep", id="nesting bomb"),
    ],
)
def test_a_text_that_is_not_a_json_object_is_refused(text, match):
    with pytest.raises(SchemaError, match=match):
        parse_object(text, where="a.json")


def test_a_colon_in_a_text_is_no_key():
    assert parse_object(rb'{"a": "b\": c", "d": ["e\":", {"f": 1}]}', where="a.json") == {
        "a": 'b": c', "d": ['e":', {"f": 1}]
    }  # fmt: skip


@pytest.mark.parametrize("beside", ["", r'"said": "a\": b", '])
def test_a_key_that_is_written_twice_is_named_with_its_place(beside):
    text = f'{{{beside}"frames": [{{"x": 1}}, {{"pose": {{"yaw": 1, "yaw": 2}}}}]}}'.encode()

    with pytest.raises(SchemaError, match="'yaw' is written twice"):
        parse_object(text, where="a.json")


def test_a_text_above_the_limit_is_refused_before_it_is_parsed():
    text = b'{"a": "' + b"x" * 2**25 + b'"}'

    with pytest.raises(SchemaError, match=r"may have 33,554,432 bytes, this one has 33,554,441"):
        parse_object(text, where="a.json")


def test_a_byte_order_mark_is_accepted():
    assert parse_object(b"\xef\xbb\xbf" + json.dumps({"a": 1}).encode(), where="a") == {"a": 1}
