"""An index beside a folder that has changed: said at once, and never of a mere copy."""

import os
import shutil
import tarfile
import warnings

import pytest

from stereogenbench_data import StereoPairs
from stereogenbench_data.errors import SelectionError
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.index.table import IncompleteSceneWarning, SceneIndex, StaleIndexWarning
from stereogenbench_data.schema.release import COMPLETE_JSON
from stereogenbench_data.selection.filters import filter_scenes, find_scene
from tests.cli.command import invoke

MAP = "train/Uniform/SynthStage"
OLD = r"index\.parquet: is older than the folder "
CURE = r"Run `stereogenbench index /\S+`\."


@pytest.fixture
def tree(indexed_release, tmp_path):
    """A tree with its index: scenes 0 and 1 of Uniform in train, and others."""
    return shutil.copytree(indexed_release, tmp_path / "tree")


@pytest.fixture
def shards(small_shards, tmp_path):
    """The same scenes in shards."""
    return shutil.copytree(small_shards, tmp_path / "shards")


def add_scene(tree, key=f"{MAP}/scene_000009"):
    return shutil.copytree(tree / MAP / "scene_000000", tree / key)


@pytest.mark.parametrize("key", [f"{MAP}/scene_000009", "eval/new/Other/New_Map/scene_000000"])
def test_an_added_scene_is_named_wherever_data_are_opened(tree, key):
    add_scene(tree, key)
    told = rf"{OLD}.*: 1 scene not in the index \({key}\)\. {CURE}"

    with pytest.warns(StaleIndexWarning, match=told):
        assert len(SceneIndex.open(tree)) == 4
    with pytest.warns(StaleIndexWarning, match=told):
        StereoPairs(tree)
    with pytest.warns(StaleIndexWarning, match=told):
        SceneIndex.open(tree / INDEX_NAME)
    assert invoke("index", tree).exit_code == 0
    assert len(SceneIndex.open(tree)) == 5


@pytest.mark.parametrize(
    "words", [("stats",), ("download", "--dry-run", "-o", "to")], ids=lambda w: w[0]
)
def test_commands_say_so_on_stderr(tree, words):
    add_scene(tree)

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        shown = invoke(words[0], tree, *words[1:])

    assert shown.exit_code == 0, shown.stderr
    said = shown.stderr + "".join(str(each.message) for each in caught)
    assert f"1 scene not in the index ({MAP}/scene_000009). Run `stereogenbench index" in said


def test_a_scene_that_was_finished_since_is_named(tree):
    marker = tree / MAP / "scene_000001" / COMPLETE_JSON
    text = marker.read_bytes()
    marker.unlink()
    assert invoke("index", tree).exit_code == 0
    marker.write_bytes(text)

    with pytest.warns(match="cannot be used|is older than") as told:
        SceneIndex.open(tree)

    assert [each.category for each in told] == [IncompleteSceneWarning, StaleIndexWarning]
    assert f"1 scene not in the index ({MAP}/scene_000001)" in str(told[1].message)


def test_a_filter_that_matches_nothing_says_that_the_index_is_old(tree):
    add_scene(tree, "train/New_Family/SynthStage/scene_000000")
    with pytest.warns(StaleIndexWarning, match=OLD):
        index = SceneIndex.open(tree)

    told = rf"matches none of 4 scenes; .*Uniform\. /.*{OLD}.*New_Family.*{CURE}"
    with pytest.raises(SelectionError, match=told):
        filter_scenes(index, {"family": "New_Family"})
    with pytest.raises(SelectionError, match=rf"is not a key of 4 scenes.*{OLD}"):
        find_scene(index, "New_Family")


@pytest.mark.parametrize("found", ["empty", "unfinished", "hidden", "a file", "bad name"])
def test_what_is_no_finished_scene_is_not_missed(tree, found):
    place = tree / MAP / "scene_000009"
    if found == "a file":
        place.write_text("")
    elif found == "empty":
        place.mkdir()
    elif found == "unfinished":
        add_scene(tree)
        (place / COMPLETE_JSON).unlink()
    else:
        add_scene(tree, f"{MAP}/{'.scene_9' if found == 'hidden' else 'scene.9'}")

    assert SceneIndex.open(tree).stale == ""


def touch_all(root):
    """Give files and folders times of change in an order of their own, the index the oldest."""
    for number, path in enumerate(sorted(root.rglob("*"), key=lambda each: each.name)):
        os.utime(path, (1_600_000_000 + number, 1_600_000_000 + number))
    os.utime(root / INDEX_NAME, (1, 1))


@pytest.mark.parametrize("kind", ["tree", "shards"])
@pytest.mark.parametrize("how", ["touched", "archived", "moved"])
def test_a_copy_is_not_taken_for_changed(kind, how, tree, shards, tmp_path):
    data, copy = tree if kind == "tree" else shards, tmp_path / "copy"
    if how == "archived":
        with tarfile.open(tmp_path / "all.tar", "w") as tar:
            tar.add(data, arcname="copy")
        with tarfile.open(tmp_path / "all.tar") as tar:
            tar.extractall(tmp_path, filter="data")
    elif how == "moved":
        data.rename(copy)
    else:
        touch_all(shutil.copytree(data, copy))

    assert SceneIndex.open(copy).stale == ""


def test_an_index_alone_and_one_of_a_part_are_not_old(tree, tmp_path):
    (tmp_path / "alone").mkdir()
    shutil.copy(tree / INDEX_NAME, tmp_path / "alone")
    part = tmp_path / "part.parquet"
    assert invoke("index", tree, "-o", part, "--where", "family=Uniform").exit_code == 0

    assert SceneIndex.open(tmp_path / "alone").stale == ""
    assert SceneIndex.open(part).stale == ""
    shutil.rmtree(tree / MAP / "scene_000001")
    with pytest.warns(StaleIndexWarning, match="is of a part of the folder: make it again"):
        SceneIndex.open(part)


def test_a_shard_beside_an_old_index_is_named_and_one_that_is_gone(shards):
    (shards / "train-Uniform-000000.tar").rename(shards / "train-Uniform-000007.tar")

    told = (
        r"1 shard not in the index \(train-Uniform-000007\.tar\); 1 shard of the index, and not "
        r"there \(train-Uniform-000000\.tar\)\. Fetch the index that belongs"
    )
    with pytest.warns(StaleIndexWarning, match=told):
        SceneIndex.open(shards)
