"""Filters keep what they say and name themselves where nothing is left."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.selection.filters import filter_scenes, may_pass
from tests.selection.conftest import made_scene


def keys(index, **filters):
    return [str(index.column("key")[row]) for row in filter_scenes(index, filters)]


@pytest.mark.parametrize(
    ("filters", "expected"),
    [
        ({}, 9),
        ({"split": "train"}, 7),
        ({"subset": "seen_map"}, 1),
        ({"family": "Uniform"}, 5),
        ({"family": ("Uniform", "IPD_Gaussian")}, 9),
        ({"map": "Town"}, 4),
        ({"character": "SK_A"}, 4),
        ({"animation": "AN_Walk"}, 3),
        ({"focal_mm": (21, 22)}, 2),
        ({"min_frames": 81}, 8),
        ({"caption": "COURTYARD sky"}, 4),
        ({"caption": "sky"}, 4),
        ({"scenes": "train/Uniform/Town/scene_000001"}, 1),
        ({"split": "train", "family": "Uniform", "map": None}, 3),
    ],
    ids=str,
)
def test_a_filter_keeps_the_scenes_that_match(index, filters, expected):
    assert len(keys(index, **filters)) == expected


@pytest.mark.parametrize(
    ("filters", "message"),
    [
        (
            {"split": "train", "family": "IPD_Gaussian", "map": "Town"},
            "map Town .*4 scenes .*split train, family IPD_Gaussian.* found Egypt",
        ),
        ({"split": ["eval", "trian"]}, r"; did you mean 'train'\?$"),
        ({"map": "town"}, r"; did you mean 'Town'\?$"),
        # What other filters left out is not taken for a misspelt value.
        (
            {"family": "Uniform", "map": "Town", "subset": "unseen_map"},
            r"that family Uni.* left; found seen_map\.$",
        ),
        ({"min_frames": 82}, r"min_frames 82 matches none of 9 .* 40 to 81\.$"),
        ({"min_frames": np.int16(82)}, "min_frames 82 matches none of 9"),
        # A value that no scene has is not passed over beside one that some have.
        ({"family": ["Uniform", "Nope"]}, "family Nope matches none of 9 scenes of the index"),
        ({"focal_mm": (80, 90)}, "focal_mm 80 to 90 .* found 20 to 35"),
        ({"valid_depth_ratio": (0.9, 1.0)}, "does not know it .* --valid-depth"),
        ({"scenes": "scene_000000"}, r"'scene_000000' is a part of 4 keys: eval/.*Give"),
        ({"scenes": "Town/scene_00001"}, r"is not a key .* Did you mean .*Town/scene_000001"),
        # What no filter takes.
        ({"min_frames": 0}, "min_frames must be a whole number from 1"),
        ({"min_frames": True}, "min_frames must be a whole number from 1"),
        ({"family": 3}, "family must be a text or a sequence of texts"),
        ({"family": []}, "family must be a text or a sequence of texts"),
        ({"focal_mm": (30, 20)}, "focal_mm: .* is no range"),
        ({"focal_mm": ("a", "b")}, "focal_mm must be"),
        ({"focal_mm": (np.nan, 2)}, "focal_mm"),
        ({"caption": "   "}, "caption must be one or more words"),
        ({"caption": "court"}, "caption court matches none of 9 scenes; .* none with court"),
        ({"caption": "street igh"}, "none with all of street, igh"),
    ],
    ids=str,
)
def test_a_filter_that_leaves_nothing_or_means_nothing_is_named(index, filters, message):
    with pytest.raises(SelectionError, match=message):
        keys(index, **filters)


def test_a_part_of_a_key_that_one_scene_has_is_enough(index):
    whole = "train/Uniform/Town/scene_000001"

    for text in ("Uniform/Town/scene_000001", "TOWN/scene_000001", "/town/scene_000001/"):
        assert keys(index, scenes=text, split="train") == [whole]
    assert keys(index, scenes=[whole, "train/uniform/town/scene_000000"])[1] == whole


def test_whole_folders_of_one_key_win_over_a_part_of_others():
    both = [f"train/{family}/Town/scene_000000" for family in ("Pairwise_Uniform", "Uniform")]
    index = SceneIndex.from_scenes(map(made_scene, both), Path("release"))

    assert keys(index, scenes="uniform") == both[1:]


@pytest.fixture(scope="module")
def nameless_release(small_release, tmp_path_factory):
    """Three scenes in train, and two in eval: the folder of one does not tell its subset."""
    root = tmp_path_factory.mktemp("nameless") / "release"
    shutil.copytree(small_release, root, copy_function=os.link)
    seen = root / "eval" / "MapSeenInTrain"
    shutil.copytree(seen, seen.with_name("Other"), copy_function=os.link)
    return root


@pytest.mark.parametrize(
    ("filters", "expected"),
    [
        ({"split": ("train", "eval"), "family": "IPD_Gaussian"}, 1),
        ({"split": "eval", "family": ("IPD_Gaussian", "Uniform")}, 2),
        ({"split": "eval", "character": ("SK_Synth11", "SK_Synth16")}, 2),
        ({"split": "train", "family": ("Uniform", "Nope")}, "Nope matches none of 5 scenes of the"),
        ({"split": "eval", "scenes": "scene_000000"}, "is a part of 4 keys"),
        # Whether a map was seen is told by all of train, and not by the folder's name.
        ({"split": "eval", "subset": "seen_map"}, 2),
    ],
    ids=str,
)
def test_a_folder_answers_as_its_index_does(nameless_release, filters, expected):
    wholes = SceneIndex.open(nameless_release)
    part = SceneIndex.open(nameless_release, wanted=may_pass(filters))

    for index in (wholes, part):
        if isinstance(expected, str):
            with pytest.raises(SelectionError, match=expected):
                keys(index, **filters)
        else:
            assert len(keys(index, **filters)) == expected
