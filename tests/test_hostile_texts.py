"""Texts of any length: the work grows with their length, and messages hold their start.

A text here would take hours if the work grew with its square.
"""

import pytest

from stereogenbench_data.errors import SchemaError, StereoGenBenchError
from stereogenbench_data.schema.parse import parse_caption, parse_scene_key
from tests.hostile import run_bounded

MANY = 500_000


def test_a_message_of_any_length_is_searched_for_urls_once():
    starts = ["", "http://", "http://h/", "https://"]
    told = run_bounded(
        "from stereogenbench_data.errors import StereoGenBenchError\n"
        f"for start in {starts}:\n"
        "    for part in ('a', 'a.', 'a:', 'a::', '@', 'http:/'):\n"
        f"        text = start + part * {MANY}\n"
        "        print(len(str(StereoGenBenchError(text))) <= len(text))"
    )

    assert told.split() == ["True"] * 24


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("at zip://a::https://me:word@host/b?key=1 now", "at zip://a::https://host/b now"),
        ("'s3://me:word@bucket/a'", "'s3://bucket/a'"),
        ("a::b::https://me:word@host", "a::b::https://host"),
        ("1https://me:word@host", "1https://host"),
        ("file:///a?b", "file:///a?b"),
        ("<hf://datasets/a/b@main>", "<hf://datasets/a/b@main>"),
    ],
)
def test_urls_in_a_message_are_shown_without_secrets(text, shown):
    assert str(StereoGenBenchError(text)) == shown


def test_a_scene_with_a_long_name_is_refused_in_few_words():
    with pytest.raises(SchemaError, match=r"scene 'train/Uniform/xxx") as refused:
        parse_scene_key(f"train/Uniform/{'x' * 100_000}.y/scene")

    assert len(str(refused.value)) < 1000


def test_a_long_text_of_a_metadata_file_is_left_out_with_a_remark():
    text = b'{"short_caption": "' + b"x" * 70_000 + b'"}'

    caption, (remark,) = parse_caption(text, where="a.json")

    assert caption == ""
    assert "short_caption" in remark.text
    assert len(remark.text) < 300
