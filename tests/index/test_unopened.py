"""Many scenes without an index: some settle what the others have, which are opened when needed."""

import json
import os
import re
import shutil

import av
import numpy as np
import pytest

from stereogenbench_data import IncompleteSceneWarning, StereoPairs
from stereogenbench_data.errors import StorageError
from stereogenbench_data.index import build
from stereogenbench_data.index.table import AssumptionWarning, SceneIndex
from stereogenbench_data.index.tree import SceneFolder
from stereogenbench_data.index.tree_cache import CACHE_VARIABLE
from tests.servers.scene_fixtures import documents

pytestmark = pytest.mark.filterwarnings("ignore:.*not opened yet:UserWarning")

KEYS = [f"train/Uniform/Map_{number % 4}/scene_{number:06d}" for number in range(68)]
KEYS += [f"eval/MapSeenInTrain/Uniform/Map_0/scene_{number:06d}" for number in range(8)]
ODD = "train/Uniform/Map_0/scene_000008"
"""A scene that opening the tree does not open."""
SETTLING = sorted(KEYS)[:: len(KEYS) - 1]
"""The first and the last scene, which settle what others have."""


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


def test_rows_of_unopened_scenes_are_those_that_opening_gives(whole_tree, read_index):
    unopened, read = SceneIndex.open(whole_tree), read_index

    assert unopened.unopened is not None
    assert read.unopened is None
    for name in (
        "key", "subset", "frames", "focal_mm", "baselines_cm", "primary_left", "depth_unit_m",
        "depth_codec", "image_width_px", "character", "scene_label", "caption",
    ):  # fmt: skip
        np.testing.assert_array_equal(unopened.column(name), read.column(name), err_msg=name)
    np.testing.assert_allclose(unopened.column("lateral_m"), read.column("lateral_m"), atol=1e-9)
    assert unopened.scene(row_of(unopened, ODD)) == read.scene(row_of(read, ODD))


def test_a_video_that_cannot_be_opened_ends_the_run(tree):
    put(tree / ODD / "cam_03_rgb.mp4", b"no video")
    index = SceneIndex.open(tree)

    with pytest.raises(StorageError, match=rf"{ODD}.*cam_03_rgb.mp4.*stereogenbench index"):
        index.scene(row_of(index, ODD))


@pytest.mark.parametrize(
    ("how", "found"),
    [
        ({"frames": 3}, "frames 3, and not 4"),
        ({"size": (48, 64)}, r"picture size .*\(64, 48\), and not \(32"),
        ({"tags": {"DEPTH_SCALE": "0.01"}}, r"unit of depth \(0.01, .*and not \(0.001, "),
    ],
)
def test_a_scene_unlike_those_that_were_opened_is_named(tree, video, how, found):
    for camera in range(6):
        put(tree / ODD / f"cam_{camera:02d}_depth.mkv", video("depth.mkv", **how))
        if "tags" not in how:
            put(tree / ODD / f"cam_{camera:02d}_rgb.mp4", video("rgb.mp4", **how))
    index = SceneIndex.open(tree)

    with pytest.raises(
        StorageError, match=rf"{ODD} is not as the scenes that were opened first: .*{found}"
    ):
        index.scene(row_of(index, ODD))


def of_another_unit(tree, video, keys):
    for key in keys:
        for camera in range(6):
            other = video("depth.mkv", tags={"DEPTH_SCALE": "0.01"})
            put(tree / key / f"cam_{camera:02d}_depth.mkv", other)


@pytest.mark.parametrize("filters", [{}, {"split": "train"}, {"map": "Map_1"}])
def test_without_a_majority_the_kinds_are_listed_whatever_is_filtered(tree, video, filters):
    of_another_unit(tree, video, sorted(KEYS)[:38])

    with pytest.raises(StorageError, match=r"(?s)There are 2:.*scene_000000\n  10 .*: metres"):
        StereoPairs(tree, **filters)


def test_the_majority_settles_and_odd_ones_are_left_out(tree, video):
    of_another_unit(tree, video, SETTLING)

    with pytest.warns(IncompleteSceneWarning, match=r"2 scenes cannot be used:\n  .*is unlike 18"):
        index = SceneIndex.open(tree)

    assert set(index.column("depth_unit_m").ravel()) == {0.001}
    assert list(index.broken) == SETTLING


def test_opening_says_in_a_line_what_it_takes_for_granted_and_so_does_repr(whole_tree):
    told = r"56 scenes of 76 not opened yet; taken to be as in 20 that were: 4 frames, 32x24 pixels"

    with pytest.warns(AssumptionWarning, match=rf"{told}.*`stereogenbench index .*` opens all"):
        index = SceneIndex.open(whole_tree)

    assert re.search(told, repr(index))
    assert "not opened yet" in repr(StereoPairs(index, split="train"))


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 9\n"


def test_what_a_listing_or_json_shows_is_told_once_and_left_out_where_it_is_needed(tree):
    keys = [key for key in KEYS if key not in SETTLING][:6]
    put(tree / keys[1] / "cam_01_rgb.mp4", b"")
    put(tree / keys[2] / "cam_01_rgb.mp4", POINTER)
    (tree / keys[3] / "cam_01_rgb.mp4").unlink()
    (tree / keys[3] / "cam_01_rgb.mp4").symlink_to(tree / "gone.mp4")
    put(tree / keys[4] / "baseline.json", b'{"scene_label": "cu')
    (tree / keys[5] / "_scene_complete.json").unlink()

    with pytest.warns(IncompleteSceneWarning) as told:
        pairs = StereoPairs(tree, fields=["left", "right"], split=("train", "eval"))

    (message,) = [str(each.message) for each in told if "not opened" not in str(each.message)]
    assert "2 scenes cannot be used" in message
    assert "3 scenes left out where a file is needed" in message
    for cause in ("is empty", "`git lfs pull`", "a link to a file that is missing"):
        assert cause in message
    assert (list(pairs.index.incomplete), list(pairs.index.broken)) == ([keys[5]], [keys[4]])
    assert pairs.left_out == 3
    assert len(pairs.plan.scene_rows) == len(KEYS) - 5
    assert len(StereoPairs(pairs.index, pairs=(2, 3), fields=["left"]).plan.scene_rows) == 74


@pytest.mark.parametrize("end", [b"0", b"}"], ids=["in a number", "after an inner bracket"])
def test_a_trajectory_that_was_cut_stops_only_fields_that_need_poses(tree, end):
    path = tree / ODD / "trajectory.json"
    whole = json.dumps(json.loads(path.read_bytes()), indent=2).encode()
    put(path, whole[: whole.rindex(end, 0, -200) + 1])

    with pytest.warns(IncompleteSceneWarning, match=rf"{ODD}/trajectory.json: is cut short"):
        plain = StereoPairs(tree, split="train")
    posed = StereoPairs(plain.index, split="train", fields=["left", "world_from_left"])
    (number,) = np.flatnonzero(plain.index.column("key")[plain.plan.scene_rows] == ODD)

    assert bool((plain[int(number)]["disparity"] > 0).any())
    assert posed.left_out == 1


def test_a_subset_is_that_of_the_whole_tree_whatever_is_filtered(tree):
    """Without a subset in its path a scene of eval has that of its map in train."""
    (tree / "eval/MapSeenInTrain").rename(tree / "eval/Test")
    shutil.copytree(tree / ODD, tree / "eval/Test/Uniform/Elsewhere/scene_000001")

    for filters in ({"split": "eval"}, {"subset": ["seen_map", "unseen_map"]}):
        index = StereoPairs(tree, **filters).index
        of_map = dict(zip(index.column("map_name"), index.column("subset"), strict=True))
        assert of_map == {"Map_0": "seen_map", "Elsewhere": "unseen_map"}
    assert len(StereoPairs(tree, subset="seen_map").plan.scene_rows) == 8


def test_where_no_scene_has_its_mark_all_are_rows_and_that_is_told(tree):
    for key in KEYS:
        (tree / key / "_scene_complete.json").unlink()

    with pytest.warns(AssumptionWarning, match="_scene_complete"):
        index = SceneIndex.open(tree)

    assert index.unopened is not None
    assert len(index) == len(KEYS)


def test_more_than_a_few_broken_scenes_are_refused(tree):
    for key in KEYS[:10]:
        put(tree / key / "baseline.json", b"{")

    with pytest.raises(StorageError, match="10 scenes cannot be used"):
        SceneIndex.open(tree)


def test_rows_of_unopened_scenes_are_not_written_as_an_index(whole_tree, tmp_path):
    with pytest.raises(StorageError, match="were not opened"):
        SceneIndex.open(whole_tree).write(tmp_path / "index.parquet")


def test_a_second_opening_has_the_same_rows_without_a_cache_too(whole_tree, cache, monkeypatch):
    first, second = SceneIndex.open(whole_tree), SceneIndex.open(whole_tree)
    monkeypatch.setenv(CACHE_VARIABLE, "off")
    without = SceneIndex.open(whole_tree)

    assert list(cache.rglob("settled-*.parquet"))
    assert first.digest == second.digest == without.digest
    assert second.root == first.root


def test_a_second_opening_lists_the_files_of_those_scenes_alone_that_settle(
    tree, cache, monkeypatch
):
    SceneIndex.open(tree)
    listed, stamps = [], SceneFolder.stamps
    monkeypatch.setattr(SceneFolder, "stamps", lambda it: listed.append(it.key) or stamps(it))

    index = SceneIndex.open(tree)

    assert len(index) == len(KEYS)
    assert len(set(listed)) == 20


def test_a_file_that_is_mended_in_place_is_seen_at_the_next_opening(tree, cache):
    video = tree / ODD / "cam_01_rgb.mp4"
    content = video.read_bytes()
    put(video, POINTER)
    with pytest.warns(IncompleteSceneWarning, match=ODD):
        SceneIndex.open(tree)
    with video.open("r+b") as file:
        file.write(content)

    assert not SceneIndex.open(tree).lacking


def test_a_scene_that_changed_in_place_is_read_anew_after_it_was_told(tree, cache):
    before = SceneIndex.open(tree)
    row, path = row_of(before, ODD), tree / ODD / "trajectory.json"
    whole = path.read_bytes()
    put(path, whole)
    SceneIndex.open(tree)
    path.write_bytes(whole[:-200])
    index = SceneIndex.open(tree)

    with pytest.raises(StorageError, match=rf"{ODD}/trajectory.json: is cut short"):
        index.scene(row)
    with pytest.warns(IncompleteSceneWarning, match=rf"{ODD}/trajectory.json: is cut short"):
        SceneIndex.open(tree)


def test_depth_farther_than_stereo_shows_by_the_default_unit_is_told(tree, video):
    untagged = video("depth.mkv", tags={})
    for key in KEYS[1:]:
        shutil.rmtree(tree / key)
    for camera in range(6):
        put(tree / KEYS[0] / f"cam_{camera:02d}_depth.mkv", untagged)
    with av.open(untagged) as opened:
        units = next(opened.decode(video=0)).to_ndarray()
    half_m = float(np.median(units[(units > 0) & (units < 65535)])) * 0.1

    with pytest.warns(AssumptionWarning, match=f"farther than {half_m:,.0f} m.*doctor"):
        SceneIndex.open(tree)


def test_a_damaged_cache_is_ignored_and_written_anew(whole_tree, cache):
    digest = SceneIndex.open(whole_tree).digest
    (kept,) = cache.rglob("settled-*.parquet")
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
        patched.setattr(build.Tree, "opened", None)
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


def test_poses_of_another_form_end_the_run(tree):
    put(tree / ODD / "trajectory.json", trajectory_of(8) | {"frames": []})
    pairs = StereoPairs(tree, split="train", map=["Map_0", "Map_1", "Map_2", "Map_3"])
    (number,) = np.flatnonzero(pairs.index.column("key")[pairs.plan.scene_rows] == ODD)

    with pytest.raises(StorageError, match=rf"{ODD}/trajectory.json.*stereogenbench index"):
        pairs[int(number)]


def test_captions_are_read_where_scenes_are_chosen_by_them(tree):
    put(tree / ODD / "scene_description_qwen_dataset_level.json", {"caption": "A red horse."})

    pairs = StereoPairs(tree, caption="horse", fields=["left"])

    assert pairs.index.column("key")[pairs.plan.scene_rows].tolist() == [ODD]
