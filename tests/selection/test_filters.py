"""Filters keep what they say and name themselves where nothing is left."""

import numpy as np
import pytest

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.selection.filters import filter_scenes


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
        ({"scenes": "train/Uniform/Town/scene_000001"}, 1),
        ({"split": "train", "family": "Uniform", "map": None}, 3),
    ],
    ids=str,
)
def test_a_filter_keeps_the_scenes_that_match(index, filters, expected):
    assert len(keys(index, **filters)) == expected


def test_the_filter_that_empties_a_selection_is_named_with_what_there_is(index):
    what, place, found = "map Town", "4 scenes .*split train, family IPD_Gaussian", "Egypt"
    with pytest.raises(SelectionError, match=f"{what} .*{place}.* found {found}"):
        keys(index, split="train", family="IPD_Gaussian", map="Town")


@pytest.mark.parametrize(
    ("filters", "meant"),
    [({"split": ["eval", "trian"]}, "train"), ({"map": "town"}, "Town")],
    ids=str,
)
def test_a_misspelt_value_of_any_filter_is_answered_with_the_one_that_was_meant(
    index, filters, meant
):
    with pytest.raises(SelectionError, match=rf"; did you mean '{meant}'\?$"):
        keys(index, **filters)


def test_a_value_that_other_filters_left_out_is_not_taken_for_a_misspelt_one(index):
    with pytest.raises(SelectionError, match=r"of those left by family Uni.*; found seen_map\.$"):
        keys(index, family="Uniform", map="Town", subset="unseen_map")


def test_scenes_with_fewer_frames_are_left_out(index):
    with pytest.raises(SelectionError, match=r"min_frames 82 matches none of 9 .* 40 to 81\.$"):
        keys(index, min_frames=82)


def test_a_value_that_no_scene_has_is_not_passed_over_beside_one_that_some_have(index):
    with pytest.raises(SelectionError, match="family Nope matches none of 9 scenes of the index"):
        keys(index, family=["Uniform", "Nope"])


def test_a_range_that_nothing_meets_says_what_the_numbers_span(index):
    with pytest.raises(SelectionError, match=r"focal_mm 80 to 90 .* found 20 to 35"):
        keys(index, focal_mm=(80, 90))


@pytest.mark.parametrize(
    ("filters", "message"),
    [
        ({"min_frames": 0}, "min_frames must be a whole number from 1"),
        ({"min_frames": True}, "min_frames must be a whole number from 1"),
        ({"family": 3}, "family must be a text or a sequence of texts"),
        ({"family": []}, "family must be a text or a sequence of texts"),
        ({"focal_mm": (30, 20)}, "focal_mm: .* is no range"),
        ({"focal_mm": ("a", "b")}, "focal_mm must be"),
        ({"focal_mm": (np.nan, 2)}, "focal_mm"),
        ({"caption": "   "}, "caption must be one or more words"),
    ],
    ids=str,
)
def test_a_value_that_no_filter_takes_is_refused(index, filters, message):
    with pytest.raises(SelectionError, match=message):
        keys(index, **filters)


def test_a_ratio_that_nobody_measured_is_said_to_be_unknown(index):
    with pytest.raises(SelectionError, match=r"does not know it .* --valid-depth"):
        keys(index, valid_depth_ratio=(0.9, 1.0))


def test_a_part_of_a_key_that_one_scene_has_is_enough(index):
    whole = "train/Uniform/Town/scene_000001"

    assert keys(index, scenes="Uniform/Town/scene_000001", split="train") == [whole]
    assert keys(index, scenes=[whole, "train/uniform/town/scene_000000"])[1] == whole
