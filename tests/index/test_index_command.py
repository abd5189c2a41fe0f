"""``stereogenbench index``: what it writes, lists and returns."""

import errno
import json
import os
from tempfile import TemporaryFile

import pytest

from stereogenbench_data.index import build as walk_module
from stereogenbench_data.index.table import IncompleteSceneWarning, SceneIndex
from stereogenbench_data.index.tree_cache import CACHE_VARIABLE
from tests.cli.command import invoke, one_line


@pytest.fixture
def run():
    return lambda *words: invoke("index", *words)


def test_an_index_may_lie_elsewhere(make_scene, root, run, tmp_path):
    make_scene()

    result = run(root, "-o", tmp_path / "made" / "a.parquet", "--workers", "1", "--valid-depth")

    opened = SceneIndex.open(tmp_path / "made" / "a.parquet", root=root)
    assert f"root='{root}'), or with --root {root}" in result.stderr
    assert result.exit_code == 0
    assert opened.root == str(root)
    assert opened.column("valid_depth_ratio")[0] == pytest.approx(23 / 24)
    assert [path.name for path in (tmp_path / "made").iterdir()] == ["a.parquet"]


def test_commands_take_the_root_of_an_index_elsewhere(small_release, tmp_path):
    kept = tmp_path / "kept.parquet"
    SceneIndex.open(small_release).write(kept)

    refused = invoke("stats", kept, "--json")
    taken = invoke("stats", kept, "--json", "--root", small_release)

    assert refused.exit_code == 2
    assert "or --root with a command" in refused.stderr
    assert taken.exit_code == 0
    assert json.loads(taken.stdout)["root"] == str(small_release)


def test_checksums_are_filled_by_the_command_and_only_for_a_folder(make_scene, root, run):
    make_scene()
    make_scene("train/Uniform/Car_Dealer/scene_000002")

    done = run(root, "--checksums")
    refused = run("hf://datasets/an/other", "--checksums", "-o", root / "other.parquet")

    assert done.exit_code == 0
    members = SceneIndex.open(root).scene(1).members.values()
    assert all(each.crc32 is not None for each in members)
    assert refused.exit_code == 2
    assert "checksums are made of files on a disk" in one_line(refused.stderr)


def test_incomplete_scenes_are_listed_and_broken_ones_end_with_1(make_scene, root, run):
    make_scene()
    (make_scene("train/Uniform/Car_Dealer/scene_000002") / "_scene_complete.json").unlink()
    incomplete = run(root)
    (make_scene("train/Uniform/Car_Dealer/scene_000003") / "baseline.json").unlink()
    broken = run(root)

    assert (incomplete.exit_code, broken.exit_code) == (0, 1)
    assert incomplete.stdout == f"{root / 'index.parquet'}: 1 scene\n"
    assert "1 incomplete, left out:" in incomplete.stderr
    assert "scene_000002: has no _scene_complete.json" in incomplete.stderr
    assert "1 broken, left out:" in broken.stderr
    with pytest.warns(IncompleteSceneWarning, match=r"(?s)scene_000002.*scene_000003"):
        assert len(SceneIndex.open(root)) == 1
    assert sorted(path.name for path in root.iterdir()) == ["index.parquet", "train"]


def test_odd_scenes_are_listed_with_their_reasons_as_json_too(make_scene, root, run):
    for number in range(3):
        folder = make_scene(f"train/Uniform/Car_Dealer/scene_{number:06d}")
    (folder / "cam_03_rgb.mp4").write_bytes(b"no video" * 200)

    told, document = run(root).stderr, json.loads(run(root, "--json").stdout)

    assert "1 odd, left out where that is needed:" in told
    assert "scene_000002/cam_03_rgb.mp4" in told
    assert list(document["odd"]) == ["train/Uniform/Car_Dealer/scene_000002"]
    assert "cam_03_rgb.mp4" in document["odd"]["train/Uniform/Car_Dealer/scene_000002"]


def test_what_is_missing_everywhere_is_told_once_with_the_cure(make_scene, root, run, rewrite):
    for number in range(3):
        folder = make_scene(f"train/Uniform/Car_Dealer/scene_{number:06d}")
        rewrite(folder / "baseline.json", lambda d: d.update(lens=d.pop("camera_intrinsics")))

    told = run(root).stderr

    assert told.count("$.camera_intrinsics.focal_length_mm is missing") == 1
    assert "likewise train/Uniform/Car_Dealer/scene_000002" in told
    assert "stereogenbench conventions" in told
    assert "\\n" not in told


def test_a_tree_of_which_nothing_is_whole_makes_no_index(make_scene, root, run):
    for video in make_scene().glob("cam_*"):
        video.unlink()

    result = run(root)

    assert result.exit_code == 1
    assert "nothing to index" in result.stderr
    assert not (root / "index.parquet").exists()


def test_a_contradiction_that_is_not_fatal_is_reported(make_scene, root, run):
    make_scene("train/Uniform/Downtown_West/scene_000000")

    result = run(root)

    assert result.exit_code == 0
    assert "1 note:" in result.stderr
    assert "such as train/Uniform/Downtown_West/scene_000000: 'Car_Dealer'" in result.stderr


def test_a_read_only_tree_asks_for_a_file_elsewhere(make_scene, root, run, tmp_path, monkeypatch):
    make_scene()

    def refuse(dir):
        if dir == root:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))
        return TemporaryFile(dir=dir)

    monkeypatch.setattr("stereogenbench_data.cli.index.TemporaryFile", refuse)
    refused, elsewhere = run(root), run(root, "-o", tmp_path / "elsewhere.parquet")

    assert refused.exit_code == 2
    assert "(Read-only file system)" in one_line(refused.stderr)
    assert "place that can be written" in one_line(refused.stderr)
    assert elsewhere.exit_code == 0
    assert len(SceneIndex.open(tmp_path / "elsewhere.parquet", root=root)) == 1


def test_a_second_run_goes_on_where_one_was_stopped(make_scene, root, run, tmp_path, monkeypatch):
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    for number in range(3):
        make_scene(f"train/Uniform/Car_Dealer/scene_{number:06d}")
    describe = walk_module.Description
    described = []

    def stopping(folder, key, settled):
        if key.endswith("2") and len(described) == 2:
            described.append("stopped")
            raise KeyboardInterrupt
        described.append(key)
        return describe(folder, key, settled)

    monkeypatch.setattr(walk_module, "Description", stopping)

    first, second = run(root), run(root)

    assert first.exit_code == 130
    assert "run the same command again" in first.stderr
    assert second.exit_code == 0
    assert described[-2:] == ["stopped", "train/Uniform/Car_Dealer/scene_000002"]
