"""The search for scenes: which folders are scenes, and what is said of the others."""

import os
import re

import pytest

from stereogenbench_data.errors import StorageError
from stereogenbench_data.index.build import walk
from stereogenbench_data.index.tree import find_scene_folders

KEYS = [
    "eval/MapSeenInTrain/Uniform/Car_Dealer/scene_000000",
    "train/IPD_Gaussian/Car_Dealer/scene_000000",
    "train/Uniform/Car_Dealer/scene_000000",
    "train/Uniform/Car_Dealer/scene_000001",
]


@pytest.fixture
def tree(tmp_path):
    """Scenes that hold nothing but their baseline.json."""
    root = tmp_path / "release"
    for key in KEYS:
        add(root, key)
    return root


def add(root, key):
    (root / key).mkdir(parents=True)
    (root / key / "baseline.json").write_text("{}")


def test_other_folders_and_hidden_ones_are_passed_over(tree):
    (tree / "metadata").mkdir()
    (tree / "metadata" / "manifest.jsonl").write_text("{}")
    add(tree, ".cache/train/Uniform/Car_Dealer/scene_000000")

    assert find_scene_folders(tree) == (KEYS, {})


@pytest.mark.parametrize(
    ("key", "told"),
    [
        ("copy/train/Uniform/Car_Dealer/scene_000000", "Move it, or point at .*/copy instead"),
        ("train/Uniform/scene_000000", "found 3 folders"),
        ("train/Uniform/Car_Dealer/scene_1.5", "not a valid folder"),
    ],
)
def test_a_misplaced_scene_is_listed_with_the_cure(tree, key, told):
    add(tree, key)

    keys, refused = find_scene_folders(tree)

    assert keys == KEYS
    ((found, reason),) = refused.items()
    assert found == key
    assert re.search(told, reason)


@pytest.mark.parametrize("cure", ["Move it to such a path", "Move it, or point at .*/more instead"])
def test_scenes_that_are_too_deep_are_told_with_the_cure(tree, cure):
    below = "more/train" if "point at" in cure else "more"
    for scene in ("scene_000000", "scene_000001"):
        add(tree, f"train/{below}/Uniform/Car_Dealer/{scene}")

    (text,) = (text for key, text in walk(tree).broken.items() if "more" in key)

    first = f"'train/{below}/Uniform/Car_Dealer/scene_000000'"
    assert re.search(f"{first}: .* folders that start with 'train'.*{cure}", text)
    assert text.endswith("(1 other likewise.)")


@pytest.mark.parametrize("place", ["train", "eval/MapSeenInTrain", KEYS[3], ".."])
def test_a_root_inside_the_release_or_above_it_is_answered_with_the_right_one(tree, place):
    with pytest.raises(StorageError, match=f"Point at {tree} instead"):
        find_scene_folders((tree / place).resolve())


def test_a_folder_without_scenes_says_what_was_looked_for(tmp_path):
    (tmp_path / "pictures").mkdir()

    told = r"looked for folders train/<family>/<map>/<scene> or eval/.*found pictures"
    with pytest.raises(StorageError, match=told):
        find_scene_folders(tmp_path)


def test_links_to_folders_are_followed(tree, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("disk")
    add(elsewhere, "Pairwise_Uniform/Car_Dealer/scene_000000")
    (tree / "train/Pairwise_Uniform").symlink_to(elsewhere / "Pairwise_Uniform")

    assert "train/Pairwise_Uniform/Car_Dealer/scene_000000" in find_scene_folders(tree)[0]


def test_a_link_to_a_folder_above_itself_is_listed_and_not_followed(tree):
    (tree / "train/Uniform/loop").symlink_to(tree / "train")

    keys, refused = find_scene_folders(tree)

    assert keys == KEYS
    place = "train/Uniform/loop"
    told = f"{tree / place}: is a link to a folder above itself. Remove the link."
    assert refused == {place: told}


def test_a_folder_that_may_not_be_read_is_listed(tree, monkeypatch):
    scandir = os.scandir

    def forbidding(path):
        if str(path).endswith("IPD_Gaussian"):
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", forbidding)

    keys, refused = find_scene_folders(tree)

    assert len(keys) == 3
    assert refused == {
        "train/IPD_Gaussian": f"{tree}/train/IPD_Gaussian: cannot be searched (Permission denied). "
        f"Give permission, or choose another place."
    }
