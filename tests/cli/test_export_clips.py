"""``stereogenbench export clips``: its options reach the export."""

import json

from tests.cli.command import succeed


def test_every_option_reaches_the_export_and_it_says_what_was_written(indexed_release, tmp_path):
    chosen = "--where family=Uniform --where baseline_cm=0:500 --pairs 0-1,1-2"
    form = "--length 5 --stride 1 --step 2 --size 48x32 --baseline-in-caption"
    words = ["export", "clips", indexed_release, tmp_path / "out", "--layout", "musubi"]
    words += ["--workers", "1", *chosen.split(), *form.split()]

    first, again = succeed(*words), succeed(*words)

    assert "8 clips written, 0 kept; clips.jsonl, dataset.toml" in first.stdout
    assert "0 clips written, 8 kept; clips.jsonl, dataset.toml" in again.stdout
    lines = (tmp_path / "out" / "clips.jsonl").read_text().splitlines()
    found = [json.loads(line) for line in lines]
    assert len(found) == 2 * 2 * 2
    assert {record["split"] for record in found} == {"train"}  # unless another is named
    assert (found[0]["width"], found[0]["height"]) == (48, 32)
    assert found[0]["frames"] == [0, 1, 2, 3, 4]
    assert found[0]["caption"].endswith(" cm.")
