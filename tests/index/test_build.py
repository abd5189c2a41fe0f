"""The walk over a tree: nothing is lost, and a second walk goes on where the first stopped."""

import json
import math
import os
import shutil

import pytest

from stereogenbench_data.index import build as walk_module
from stereogenbench_data.index.build import scene_journal, walk
from stereogenbench_data.index.scene_folder import describe_scene

KEY = "train/Uniform/Car_Dealer/scene_{:06d}"


@pytest.fixture
def linked_scenes(make_scene, root):
    """Write scenes that share one scene's files, and return their keys."""

    def make(count):
        first = make_scene(KEY.format(0))
        keys = [KEY.format(number) for number in range(count)]
        for key in keys[1:]:
            shutil.copytree(first, root / key, copy_function=os.link)
        return keys

    return make


def test_every_scene_is_whole_incomplete_or_broken(linked_scenes, root):
    keys = linked_scenes(4)
    (root / keys[1] / "_scene_complete.json").unlink()
    (root / keys[2] / "baseline.json").unlink()
    (root / "train/Uniform/scene.7").mkdir()
    (root / "train/Uniform/scene.7/baseline.json").write_text("{}")

    report = walk(root)

    assert [scene.id.key for scene in report.scenes] == [keys[0], keys[3]]
    assert list(report.incomplete) == [keys[1]]
    assert list(report.broken) == [keys[2], "train/Uniform/scene.7"]
    assert "has no baseline.json" in report.broken[keys[2]]


def test_scenes_of_one_writer_read_their_poses_alike(linked_scenes, root):
    """A camera that stands level at heading 0 fits two readings; others of its shape fit one."""
    keys = linked_scenes(3)
    for key, yaw_deg in zip(keys, (0.0, 25.0, 40.0), strict=True):
        _write_matrices(root / key / "trajectory.json", yaw_deg=yaw_deg)

    scenes = walk(root).scenes

    assert describe_scene(root, keys[0]).remark("world")
    assert len({scene.pose_form for scene in scenes}) == 1
    assert [scene.remark("world", "poses") for scene in scenes] == ["", "", ""]


def _write_matrices(path, *, yaw_deg):
    """Replace a trajectory by one of Blender's matrices: a turned rig that stands still."""
    document = json.loads(path.read_text())
    sin, cos = math.sin(math.radians(yaw_deg)), math.cos(math.radians(yaw_deg))
    right, up, back = (sin, -cos, 0.0), (0.0, 0.0, 1.0), (-cos, -sin, 0.0)
    for frame in document["frames"]:
        first = frame["cameras"][0]["location"].copy()
        for pose in frame["cameras"]:
            place = pose.pop("location")
            along_m = math.dist(place.values(), first.values()) / 100
            pose.pop("rotation")
            columns = (right, up, back, tuple(1 + along_m * each for each in right))
            pose["matrix"] = [[*row] for row in zip(*columns, strict=True)] + [[0, 0, 0, 1]]
    path.unlink()
    path.write_text(json.dumps(document | {"unit": "m"}))


def test_worker_processes_find_what_one_process_finds(linked_scenes, root, monkeypatch):
    keys = linked_scenes(5)
    (root / keys[3] / "baseline.json").unlink()
    alone = walk(root, workers=1)
    monkeypatch.setattr(walk_module, "POOL_FROM", 1)

    together = walk(root, workers=2)

    assert together == alone
    assert len(alone.scenes) == 4


def stopped_walk(root, journal_path, *, after):
    def stop(done, total):
        if done == after:
            raise KeyboardInterrupt

    with (
        scene_journal(journal_path, walk="w") as journal,
        pytest.raises(KeyboardInterrupt, match=r"^$"),
    ):
        walk(root, journal=journal, progress=stop)


def resumed_walk(root, journal_path, *, name="w"):
    """The number of scenes that were known at the start, and the report."""
    told = []
    with scene_journal(journal_path, walk=name) as journal:
        report = walk(root, journal=journal, progress=lambda done, total: told.append(done))
    return told[0], report


def test_a_journal_line_that_was_cut_short_is_read_again(linked_scenes, root, tmp_path):
    linked_scenes(4)
    journal = tmp_path / "journal"
    stopped_walk(root, journal, after=3)
    os.truncate(journal, journal.stat().st_size - 100)

    known, report = resumed_walk(root, journal)
    again, _ = resumed_walk(root, journal)

    assert (known, again) == (2, 4)
    assert report == walk(root)
    assert len(report.scenes) == 4


def test_a_scene_that_changed_since_is_read_again(linked_scenes, root, tmp_path):
    keys = linked_scenes(3)
    resumed_walk(root, tmp_path / "journal")
    path = root / keys[1] / "scene_description_qwen_dataset_level.json"
    path.unlink()
    path.write_text('{"detailed_caption": "Another."}')

    known, report = resumed_walk(root, tmp_path / "journal")

    assert known == 2
    captions = [scene.caption for scene in report.scenes]
    assert captions == ["Cars behind glass.", "Another.", "Cars behind glass."]


def test_the_journal_of_another_walk_is_begun_anew(linked_scenes, root, tmp_path):
    linked_scenes(2)
    resumed_walk(root, tmp_path / "journal")

    known, _ = resumed_walk(root, tmp_path / "journal", name="other")

    assert known == 0


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
