"""``stereogenbench export clips``: its options reach the export."""

import json

from tests.cli.command import invoke


def run(*words):
    return invoke("export", "clips", *words)


def records(out):
    return [json.loads(line) for line in (out / "clips.jsonl").read_text().splitlines()]


def test_every_option_reaches_the_export_and_it_says_what_was_written(indexed_release, tmp_path):
    words = [indexed_release, tmp_path / "out", "--layout", "musubi", "--workers", "1"]
    chosen = "--where family=Uniform --where baseline_cm=0:500 --split train --pairs 0-1,1-2"
    form = "--length 5 --stride 1 --step 2 --size 48x32 --baseline-in-caption"
    words += [*chosen.split(), *form.split()]

    first, again = run(*words), run(*words)

    assert first.exit_code == again.exit_code == 0, first.output
    assert "8 clips written, 0 kept; clips.jsonl, dataset.toml" in first.stdout
    assert "0 clips written, 8 kept; clips.jsonl, dataset.toml" in again.stdout
    found = records(tmp_path / "out")
    assert len(found) == 2 * 2 * 2
    assert (found[0]["width"], found[0]["height"]) == (48, 32)
    assert found[0]["frames"] == [0, 1, 2, 3, 4]
    assert found[0]["caption"].endswith(" cm.")


def test_training_scenes_are_exported_unless_the_split_is_named(indexed_release, tmp_path):
    words = (indexed_release, tmp_path / "out", "--layout", "musubi", "--workers", "1")

    shown, refused = run(*words), run(*words, "--where", "subset=seen_map")

    assert shown.exit_code == 0, shown.output
    assert {record["split"] for record in records(tmp_path / "out")} == {"train"}
    assert (refused.exit_code, "left by split train" in refused.stderr) == (2, True)
