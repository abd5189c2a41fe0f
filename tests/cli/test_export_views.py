"""``stereogenbench export`` of several views, as a user calls it."""

import json

import pytest

from tests.cli.command import refused, succeed

USUAL = ("--size", "16x16", "--workers", "1")


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("colmap", "sparse/0/points3D.txt"),
        ("transforms", "transforms.json"),
        ("ply", "points.ply"),
    ],
)
def test_training_scenes_are_exported(indexed_release, tmp_path, name, file):
    done = succeed("export", name, indexed_release, tmp_path, *USUAL)

    assert done.stdout == f"{tmp_path}: 3 folders\n"
    folder = tmp_path / "train" / "Uniform" / "SynthStage" / "scene_000001" / "frame_000"
    assert (folder / file).is_file()


@pytest.mark.parametrize(("split", "told"), [("all", "4 folders"), ("eval", "1 folder")])
def test_all_splits_are_exported_where_all_are_asked_for(indexed_release, tmp_path, split, told):
    done = succeed("export", "ply", indexed_release, tmp_path, *USUAL, "--split", split)

    assert done.stdout == f"{tmp_path}: {told}\n"


def test_filters_cameras_frames_and_points_are_taken(indexed_release, tmp_path):
    done = succeed(
        "export", "ply", indexed_release, tmp_path, *USUAL, "--where", "family=Uniform",
        "--cameras", "0,5", "--frames", "every:3", "--points", "all",
    )  # fmt: skip
    settings = json.loads((tmp_path / "export.json").read_text())

    assert done.stdout == f"{tmp_path}: 6 folders\n"
    assert settings["cameras"] == [0, 5]
    assert (settings["points"], settings["size"]) == (None, [16, 16])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--cameras", "a,b"], "'a,b': write numbers from 0 to 5"),
        (["--points", "many"], "'many' is not a number or all"),
    ],
)
def test_a_text_that_is_not_understood_is_named(indexed_release, tmp_path, options, message):
    assert message in refused("export", "ply", indexed_release, tmp_path / "out", *options)
    assert not (tmp_path / "out").exists()
