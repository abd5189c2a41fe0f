"""The walk over a tree: nothing is lost, and a second walk goes on where the first stopped."""

import json
import os
import shutil
import zlib
from dataclasses import replace
from threading import get_ident
from time import sleep

import pytest

from stereogenbench_data.geometry import pose_evidence as evidence
from stereogenbench_data.index import build as walk_module
from stereogenbench_data.index.build import walk
from stereogenbench_data.index.tree_cache import CACHE_VARIABLE

KEY = "train/Uniform/Car_Dealer/scene_{:06d}"


@pytest.fixture
def alike_scenes(make_scene, root):
    """Write scenes with the same files, and return their keys."""

    def make(count):
        first = make_scene(KEY.format(0))
        keys = [KEY.format(number) for number in range(count)]
        for key in keys[1:]:
            shutil.copytree(first, root / key)
        return keys

    return make


def test_every_scene_is_whole_incomplete_or_broken(alike_scenes, root):
    keys = alike_scenes(4)
    (root / keys[1] / "_scene_complete.json").unlink()
    (root / keys[2] / "baseline.json").unlink()
    (root / "train/Uniform/scene.7").mkdir()
    (root / "train/Uniform/scene.7/baseline.json").write_text("{}")

    report = walk(root)

    assert [scene.id.key for scene in report.scenes] == [keys[0], keys[3]]
    assert list(report.incomplete) == [keys[1]]
    assert list(report.broken) == [keys[2], "train/Uniform/scene.7"]
    assert "has no baseline.json" in report.broken[keys[2]]


def test_of_a_disk_that_waits_several_scenes_are_read_at_a_time_in_their_order(make_scene, root):
    make_scene()
    threads = set()

    def read(key):
        sleep(0.001)
        threads.add(get_ident())
        return key

    keys = [KEY.format(number) for number in range(300)]

    assert [*walk_module.find_tree(root, wanted=None).of_each(read, keys)] == keys
    assert len(threads) > 2


def test_poses_are_searched_for_once_and_then_read_where_they_stand(
    alike_scenes, root, monkeypatch
):
    keys, searched = alike_scenes(4), []
    for key in keys:
        path = root / key / "trajectory.json"
        document = json.loads(path.read_text())
        for frame in document["frames"]:
            frame["views"] = frame.pop("cameras")
        path.write_text(json.dumps(document))
    search = evidence.recorded_in
    monkeypatch.setattr(
        evidence, "recorded_in", lambda *args, **how: searched.append(0) or search(*args, **how)
    )

    scenes = walk(root, workers=1).scenes

    assert len(searched) == 1
    assert {scene.pose_form for scene in scenes} == {None}
    assert all(scene.lateral_m[5] == pytest.approx(0.725) for scene in scenes)
    assert not any(scene.remark("poses") for scene in scenes)


def test_worker_processes_find_what_one_process_finds(alike_scenes, root, monkeypatch):
    keys = alike_scenes(5)
    (root / keys[3] / "baseline.json").unlink()
    alone = walk(root, workers=1)
    monkeypatch.setattr(walk_module, "POOL_FROM", 1)

    together = walk(root, workers=2)

    assert together == alone
    assert len(alone.scenes) == 4


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


def again(root, **how):
    """The number of scenes that were known at the start, and the report."""
    told = []
    report = walk(root, progress=lambda done, total: told.append(done), **how)
    return told[0], report


def test_a_stopped_walk_goes_on_and_a_damaged_row_is_read_again(alike_scenes, root, cache):
    alike_scenes(4)

    def stop(done, total):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match=r"^$"):
        walk(root, progress=stop)
    row = next(path for path in cache.rglob("scenes/*/*"))
    os.truncate(row, row.stat().st_size - 100)

    known, report = again(root)

    assert (known, again(root)[0]) == (2, 4)
    assert report == again(root)[1]
    assert len(report.scenes) == 4


@pytest.mark.usefixtures("cache")
def test_checksums_of_a_folder_go_on_where_they_were_stopped(alike_scenes, root, monkeypatch):
    keys = alike_scenes(4)
    monkeypatch.setattr(walk_module, "_SETTLED_BY", 1)
    bare = walk(root).scenes

    def stop(done, total):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match=r"^$"):
        walk(root, checksums="all", progress=stop)
    known, report = again(root, checksums="all")

    assert known == 3
    for scene, before in zip(report.scenes, bare, strict=True):
        assert replace(scene, members=before.members) == before
        assert all(each.crc32 is None for each in before.members.values())
        for name, member in scene.members.items():
            content = (root / scene.id.key / name).read_bytes()
            assert (member.crc32, member.size) == (zlib.crc32(content), len(content))
    assert [scene.id.key for scene in report.scenes] == keys


@pytest.mark.usefixtures("cache")
def test_a_scene_that_changed_since_is_read_again(alike_scenes, root):
    keys = alike_scenes(3)
    walk(root)
    path = root / keys[1] / "scene_description_qwen_dataset_level.json"
    path.unlink()
    path.write_text('{"detailed_caption": "Another."}')

    known, report = again(root)

    assert known == 2
    captions = [scene.caption for scene in report.scenes]
    assert captions == ["Cars behind glass.", "Another.", "Cars behind glass."]


@pytest.mark.usefixtures("cache")
def test_a_file_of_the_same_size_and_date_is_another_one(alike_scenes, root):
    (key,) = alike_scenes(1)
    walk(root)
    path = root / key / "scene_description_qwen_dataset_level.json"
    text, status = path.read_text(), path.stat()
    path.write_text(text.replace("Cars", "Cats"))
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))

    known, report = again(root)

    assert known == 0
    assert report.scenes[0].caption == "Cats behind glass."


@pytest.mark.usefixtures("cache")
def test_a_walk_of_another_kind_reads_all_scenes(alike_scenes, root):
    alike_scenes(2)
    walk(root)

    known, report = again(root, valid_depth="sample")

    assert known == 0
    assert [scene.valid_depth_ratio for scene in report.scenes] != [None, None]


@pytest.mark.parametrize(
    ("folder", "map_name", "subset", "notes"),
    [
        ("MapSeenInTrain", "Elsewhere", "seen_map", 0),
        ("MapUnseenInTrain", "Car_Dealer", "unseen_map", 0),
        ("Other", "Car_Dealer", "seen_map", 1),
        ("Other", "OnlyHere", "seen_map", 1),
        ("Other", "STF_TestMap", "unseen_map", 1),
    ],
)
def test_an_eval_subset_is_that_of_its_folder(
    make_scene, root, rewrite, folder, map_name, subset, notes
):
    for path, name in (
        ("train/Uniform/OnlyHere/scene_000000", "OnlyHere"),
        (f"eval/{folder}/Uniform/{map_name}/scene_000000", map_name),
    ):
        scene = make_scene(path)
        for file in ("baseline.json", "_scene_complete.json"):
            rewrite(scene / file, lambda document, name=name: document.update(map_name=name))

    report = walk(root)

    assert [scene.id.subset for scene in report.scenes] == [subset, None]
    assert len(report.notes) == notes
    assert all("eval/Other names no subset" in note for note in report.notes)
