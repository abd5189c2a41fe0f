"""``stereogenbench show`` and JSON reports, as a user calls them."""

import json
import shutil

import av
import numpy as np
import pytest
from PIL import Image

from tests.cli.command import invoke, refused, succeed

SCENE = "train/Uniform/SynthStage/scene_000001"


def test_the_first_scene_is_drawn_under_its_key(small_shards, here):
    shown = succeed("show", small_shards)
    name = "eval_MapSeenInTrain_Uniform_SynthStage_scene_000000.png"

    assert shown.stdout == f"{name}: eval/MapSeenInTrain/Uniform/SynthStage/scene_000000\n"
    with Image.open(here / name) as sheet:
        assert sheet.size[0] > 1500


def test_a_part_of_a_key_a_pair_and_a_frame_are_taken(indexed_release, tmp_path):
    sheets = []
    for number, options in enumerate(([], ["--pair", "0-5"], ["--frame", 6])):
        out = tmp_path / f"{number}.png"
        shown = succeed("show", indexed_release, "scene_000001", "-o", out, *options)
        assert shown.stdout == f"{out}: {SCENE}\n"
        with Image.open(out) as sheet:
            sheets.append(np.asarray(sheet))

    first, *others = sheets
    assert not any(np.array_equal(first, other) for other in others)


def test_a_clip_is_written_by_the_ending_of_its_name(small_shards, tmp_path):
    succeed("show", small_shards, SCENE, "-o", tmp_path / "clip.mp4")

    with av.open(tmp_path / "clip.mp4") as clip:
        assert sum(1 for _ in clip.decode(video=0)) == 7


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ([SCENE, "--frame", "7"], "has no frame 7: its 7 are 0 to 6"),
        ([SCENE, "-o", "sheet.jpg"], "a sheet is .png"),
        ([SCENE, "-o", "clip.avi"], "a clip .mp4"),
    ],
)
def test_what_cannot_be_shown_is_refused(small_shards, here, options, reason):
    assert reason in refused("show", small_shards, *options)
    assert list(here.iterdir()) == []


def test_an_index_as_json_is_one_document_and_a_broken_scene_gives_exit_status_1(
    small_release, tmp_path
):
    data = shutil.copytree(small_release, tmp_path / "data")
    whole = invoke("index", data, "--json")
    (data / SCENE / "baseline.json").write_text("{}")
    broken = invoke("index", data, "--json")

    assert json.loads(whole.stdout) == {
        "index": str(data / "index.parquet"), "scenes": 4, "incomplete": {}, "broken": {},
        "odd": {}, "notes": [],
    }  # fmt: skip
    assert broken.exit_code == 1
    assert list(json.loads(broken.stdout)["broken"]) == [SCENE]
