"""``stereogenbench export``: its options reach the export, and what it refuses is said in short."""

import json

import pytest

from tests.cli.command import invoke, one_line


def run(*words):
    return invoke("export", "clips", *words, env={"COLUMNS": "300"})


def records(out):
    return [json.loads(line) for line in (out / "clips.jsonl").read_text().splitlines()]


def test_every_option_reaches_the_export(indexed_release, tmp_path):
    shown = run(
        indexed_release, tmp_path / "out", "--layout", "diffsynth", "--where", "family=Uniform",
        "--where", "baseline_cm=0:500", "--split", "train", "--pairs", "0-1,1-2", "--length", "5",
        "--stride", "1", "--step", "2", "--size", "48x32", "--baseline-in-caption",
        "--workers", "1",
    )  # fmt: skip

    assert shown.exit_code == 0, shown.output
    found = records(tmp_path / "out")
    assert len(found) == 2 * 2 * 2
    assert (found[0]["width"], found[0]["height"]) == (48, 32)
    assert found[0]["frames"] == [0, 1, 2, 3, 4]
    assert found[0]["caption"].endswith(" cm.")


def test_it_says_what_was_written_and_what_was_there(indexed_release, tmp_path):
    words = [indexed_release, tmp_path / "out", "--layout", "musubi", "--workers", "1"]

    first, again = run(*words), run(*words)
    refused = run(*words, "--where", "subset=seen_map")

    assert first.exit_code == again.exit_code == 0, first.output
    assert "3 clips written, 0 kept; clips.jsonl, dataset.toml" in first.stdout
    assert "0 clips written, 3 kept; clips.jsonl, dataset.toml" in again.stdout
    assert {record["split"] for record in records(tmp_path / "out")} == {"train"}
    assert refused.exit_code == 2
    assert "SelectionError" in refused.stderr
    assert "left by split train" in refused.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--length", "7"], ["length=7", "4N+1", "5 or 9"]),
        (["--stride", "0"], ["at least 1", "got 0"]),
        (["--where", "family=Narrow"], ["family", "Narrow", "Uniform"]),
    ],
)
def test_what_cannot_be_is_refused_with_its_cure(indexed_release, tmp_path, words, said):
    shown = run(indexed_release, tmp_path / "out", "--layout", "musubi", "--split", "train", *words)

    assert shown.exit_code == 2, shown.output
    text = one_line(shown.stderr)
    assert all(word in text for word in said), text
    assert not (tmp_path / "out").exists()
