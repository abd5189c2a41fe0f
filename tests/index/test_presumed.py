"""Many scenes without an index: a few are read, the others are presumed and read when needed."""

import json
import os
import shutil

import numpy as np
import pytest

from stereogenbench_data import IncompleteSceneWarning, OddSceneWarning, StereoPairs
from stereogenbench_data.errors import StorageError
from stereogenbench_data.index import build
from stereogenbench_data.index.table import AssumptionWarning, SceneIndex
from stereogenbench_data.index.tree_cache import CACHE_VARIABLE
from tests.servers.scene_fixtures import documents

KEYS = [f"train/Uniform/Map_{number % 4}/scene_{number:06d}" for number in range(68)]
KEYS += [f"eval/MapSeenInTrain/Uniform/Map_0/scene_{number:06d}" for number in range(8)]
ODD = "train/Uniform/Map_0/scene_000004"
"""A scene that opening the tree does not look at."""


def baseline_of(number):
    """A baseline.json; no two have the same focal length, baselines, names and labels."""
    document = documents()["baseline.json"]
    name = f"Town_scene_{number}"
    document["scene_label"], document["scene_index"] = name, number
    document["character_mesh"] = f"SK_{number % 5}"
    document["camera_intrinsics"]["focal_length_mm"] = 20.5 + number
    left, right = f"{name}_Cam_00", f"{name}_Cam_01"
    document["primary_stereo_pair"] = {"left_camera": left, "right_camera": right}
    for pair in document["pairwise_pairs"]:
        pair["baseline_cm"] *= 1 + number / 100
    document["mean_baseline_cm"] = 30 + number / 7
    return document


def trajectory_of(number):
    document = documents()["trajectory.json"]
    for frame in document["frames"]:
        for camera in frame["cameras"]:
            camera["location"]["y"] *= 1 + number / 100
    return document


@pytest.fixture(scope="module")
def whole_tree(tmp_path_factory, video):
    root = tmp_path_factory.mktemp("whole")
    for number, key in enumerate(KEYS):
        (root / key).mkdir(parents=True)
        own = {"baseline.json": baseline_of(number), "trajectory.json": trajectory_of(number)}
        own["_scene_complete.json"] = {"scene_label": own["baseline.json"]["scene_label"]}
        for name, document in (documents() | own).items():
            (root / key / name).write_text(json.dumps(document))
        for camera in range(6):
            for kind in ("rgb.mp4", "depth.mkv"):
                os.link(video(kind), root / key / f"cam_{camera:02d}_{kind}")
    return root


@pytest.fixture(scope="module")
def read_index(whole_tree):
    return SceneIndex.open(whole_tree, rows="read")


@pytest.fixture
def tree(whole_tree, tmp_path):
    """A tree of its own, of which files may be replaced by `put`."""
    return shutil.copytree(whole_tree, tmp_path / "tree", copy_function=os.link)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


def put(path, content):
    """Replace a file, and not what other links lead to."""
    path.unlink()
    if isinstance(content, dict):
        path.write_text(json.dumps(content))
    elif isinstance(content, bytes):
        path.write_bytes(content)
    else:
        os.link(content, path)


def row_of(index, key):
    return index.column("key").tolist().index(key)


def test_presumed_rows_are_those_that_reading_gives(whole_tree, read_index):
    presumed, read = SceneIndex.open(whole_tree), read_index

    assert presumed.presumption is not None
    assert read.presumption is None
    for name in (
        "key", "subset", "frames", "focal_mm", "baselines_cm", "primary_left", "depth_unit_m",
        "depth_codec", "image_width_px", "character", "scene_label", "caption",
    ):  # fmt: skip
        np.testing.assert_array_equal(presumed.column(name), read.column(name), err_msg=name)
    np.testing.assert_allclose(presumed.column("lateral_m"), read.column("lateral_m"), atol=1e-9)
    assert presumed.scene(row_of(presumed, ODD)) == read.scene(row_of(read, ODD))


def test_a_video_that_cannot_be_opened_ends_the_run(tree):
    put(tree / ODD / "cam_03_rgb.mp4", b"no video")
    index = SceneIndex.open(tree)

    with pytest.raises(StorageError, match=rf"{ODD}.*cam_03_rgb.mp4.*stereogenbench index"):
        index.scene(row_of(index, ODD))


@pytest.mark.parametrize(
    ("how", "found"),
    [
        ({"frames": 3}, "frames presumed 4, found 3"),
        ({"tags": {"DEPTH_SCALE": "0.01"}}, r"unit of depth presumed \(0.001.*found \(0.01"),
    ],
)
def test_a_scene_that_contradicts_what_was_presumed_is_named(tree, video, how, found):
    for camera in range(6):
        put(tree / ODD / f"cam_{camera:02d}_depth.mkv", video("depth.mkv", **how))
        if "frames" in how:
            put(tree / ODD / f"cam_{camera:02d}_rgb.mp4", video("rgb.mp4", **how))
    index = SceneIndex.open(tree)

    with pytest.raises(StorageError, match=rf"{ODD} is not as was presumed of it: .*{found}"):
        index.scene(row_of(index, ODD))


def test_pictures_of_another_size_are_read_at_their_own(tree, video):
    for camera in range(6):
        for kind in ("rgb.mp4", "depth.mkv"):
            put(tree / ODD / f"cam_{camera:02d}_{kind}", video(kind, size=(48, 64)))
    with pytest.warns(AssumptionWarning, match="the videos' picture size counts"):
        pairs = StereoPairs(tree, scenes=ODD, fields=["left", "intrinsics"], size=(12, 16))
    with pytest.warns(AssumptionWarning, match="the videos' picture size counts"):
        whole = StereoPairs(tree, split="train", map="Map_0", fields=["left"], size=(12, 16))
    assert pairs.index.presumption is None  # one scene is read whole

    assert pairs[0]["left"].shape == (3, 12, 16)
    assert whole.index.scene(row_of(whole.index, ODD)).rig.image_width_px == 64


def test_scenes_that_are_not_alike_are_all_read(tree, video):
    for key in KEYS[:68:2]:
        for camera in range(6):
            other = video("depth.mkv", tags={"DEPTH_SCALE": "0.01"})
            put(tree / key / f"cam_{camera:02d}_depth.mkv", other)

    index = SceneIndex.open(tree)

    assert index.presumption is None
    assert sorted(set(index.column("depth_unit_m").ravel())) == [0.001, 0.01]


def test_what_the_listing_and_baseline_json_show_is_told_at_opening(tree):
    (tree / KEYS[1] / "_scene_complete.json").unlink()
    put(tree / KEYS[2] / "baseline.json", b'{"scene_label": "cu')
    (tree / KEYS[3] / "cam_05_rgb.mp4").unlink()

    with pytest.warns(IncompleteSceneWarning, match=r"2 scenes cannot be used"):
        index = SceneIndex.open(tree)

    assert index.presumption is not None
    assert (list(index.incomplete), list(index.broken)) == ([KEYS[1]], [KEYS[2]])
    assert "cam_05_rgb.mp4" in index.indexed_scene(row_of(index, KEYS[3])).remark("videos")


def test_where_no_scene_has_its_mark_all_are_presumed_and_that_is_told(tree):
    for key in KEYS:
        (tree / key / "_scene_complete.json").unlink()

    with pytest.warns(AssumptionWarning, match="_scene_complete"):
        index = SceneIndex.open(tree)

    assert index.presumption is not None
    assert len(index) == len(KEYS)


def test_more_than_a_few_broken_scenes_are_refused(tree):
    for key in KEYS[:10]:
        put(tree / key / "baseline.json", b"{")

    with pytest.raises(StorageError, match="10 scenes cannot be used"):
        SceneIndex.open(tree)


def test_a_table_that_is_presumed_is_not_written_as_an_index(whole_tree, tmp_path):
    with pytest.raises(StorageError, match="rows are presumed"):
        SceneIndex.open(whole_tree).write(tmp_path / "index.parquet")


def test_a_second_opening_has_the_same_rows_without_a_cache_too(whole_tree, cache, monkeypatch):
    first, second = SceneIndex.open(whole_tree), SceneIndex.open(whole_tree)
    monkeypatch.setenv(CACHE_VARIABLE, "off")
    without = SceneIndex.open(whole_tree)

    assert list(cache.rglob("presumed-*.parquet"))
    assert first.digest == second.digest == without.digest
    assert second.root == first.root


def test_a_damaged_cache_is_ignored_and_written_anew(whole_tree, cache):
    digest = SceneIndex.open(whole_tree).digest
    (kept,) = cache.rglob("presumed-*.parquet")
    size = kept.stat().st_size
    kept.write_bytes(kept.read_bytes()[: size // 2])

    assert SceneIndex.open(whole_tree).digest == digest
    assert kept.stat().st_size == size


def test_a_changed_file_is_seen_at_the_next_opening(tree, cache):
    SceneIndex.open(tree)
    put(tree / ODD / "baseline.json", baseline_of(50))

    index = SceneIndex.open(tree)

    assert index.column("focal_mm")[row_of(index, ODD)] == 70.5


def test_a_described_scene_is_kept_until_its_files_change(tree, cache, monkeypatch):
    index = SceneIndex.open(tree)
    row, video = row_of(index, ODD), tree / ODD / "cam_00_rgb.mp4"
    scene, status = index.scene(row), video.stat()
    with monkeypatch.context() as patched:
        patched.setattr(build, "describe_scene", None)
        assert SceneIndex.open(tree).scene(row) == scene
    put(video, bytes(status.st_size))
    os.utime(video, ns=(status.st_atime_ns, status.st_mtime_ns))

    with pytest.raises(StorageError, match=ODD):
        SceneIndex.open(tree).scene(row)


def test_a_state_is_loaded_by_a_second_opening(whole_tree, cache, monkeypatch):
    def loader():
        return StereoPairs(whole_tree, split="train", fields=["left", "scene"]).loader(4, seed=1)

    first = loader()
    batches = iter(first)
    next(batches)
    state, due = first.state_dict(), next(batches)["scene"]
    monkeypatch.setenv(CACHE_VARIABLE, "off")
    second = loader()
    second.load_state_dict(state)

    assert next(iter(second))["scene"] == due


def test_poses_that_are_not_understood_are_told_and_stop_only_fields_that_need_them(tree):
    put(tree / ODD / "trajectory.json", trajectory_of(4) | {"frames": []})
    plain = StereoPairs(tree, split="train", map=["Map_0", "Map_1", "Map_2", "Map_3"])
    posed = StereoPairs(tree, split="train", fields=["left", "world_from_left"])
    (number,) = np.flatnonzero(plain.index.column("key")[plain.plan.scene_rows] == ODD)

    with pytest.warns(OddSceneWarning, match=ODD):
        sample = plain[int(number)]

    assert bool((sample["disparity"] > 0).any())
    with pytest.raises(StorageError, match=rf"{ODD} cannot give 'world_from_left'"):
        posed[int(number)]


def test_captions_are_read_where_scenes_are_chosen_by_them(tree):
    put(tree / ODD / "scene_description_qwen_dataset_level.json", {"caption": "A red horse."})

    pairs = StereoPairs(tree, caption="horse", fields=["left"])

    assert pairs.index.column("key")[pairs.plan.scene_rows].tolist() == [ODD]
