"""Averages: frames, then pairs of a scene, then scenes; intervals by hand."""

import math

import pytest

from stereogenbench_data import EvaluationError
from stereogenbench_data.evaluation.aggregate import PairMeans, cell, strata, tally


def pair(scene, numbers, *, cameras=(0, 1)):
    return PairMeans(
        row=0, scene=scene, pair=cameras, is_primary=cameras == (0, 1), baseline_cm=6.0,
        frames=len(numbers), tallies={"psnr": tally(numbers)},
    )  # fmt: skip


def test_frames_are_averaged_before_pairs_and_these_before_scenes():
    pairs = [pair("a", [0, 20]), pair("a", [30], cameras=(0, 2)), pair("b", [50])]

    found = cell(pairs, "psnr")

    assert found.mean == 35
    assert found.scenes == 2


def test_identical_frames_are_counted_and_not_averaged():
    found = cell([pair("a", [10, math.inf]), pair("b", [math.inf, math.inf])], "psnr")

    assert (found.mean, found.infinite, found.scenes) == (10, 3, 1)
    assert found.ci95 is None


def test_frames_without_a_score_are_counted():
    found = cell([pair("a", [10, math.nan]), pair("b", [math.nan]), pair("c", [20])], "psnr")

    assert (found.mean, found.undefined, found.scenes) == (15, 2, 2)


def test_the_interval_of_three_scenes_is_the_hand_worked_one():
    found = cell([pair("a", [1]), pair("b", [2]), pair("c", [3])], "psnr")

    # t of 0.975 with 2 degrees of freedom is 4.302653, s is 1.
    assert found.ci95 == pytest.approx(4.302653 / math.sqrt(3), rel=1e-6)
    assert found.median == 2


def test_texts_and_few_numbers_are_strata_themselves():
    assert strata(["Town", "", "Egypt"], name="map_name") == ["Town", "not recorded", "Egypt"]
    assert strata([24, 50.5, 24], name="focal_mm") == ["24", "50.5", "24"]


def test_many_numbers_fall_into_quarters():
    found = strata([float(number) for number in range(101)], name="focal_mm")

    assert {each: found.count(each) for each in dict.fromkeys(found)} == {
        "[0,25)": 25, "[25,50)": 25, "[50,75)": 25, "[75,100]": 26,
    }  # fmt: skip


def test_a_column_that_is_not_known_is_refused():
    with pytest.raises(EvaluationError, match="valid_depth_ratio is not known for any scene"):
        strata([math.nan, math.nan], name="valid_depth_ratio")
