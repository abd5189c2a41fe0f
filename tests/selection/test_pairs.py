"""Pairs by name, by index and by baseline."""

import numpy as np
import pytest

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.schema.release import CAMERA_PAIRS, baseline_bin
from stereogenbench_data.selection.filters import choose_pairs, filter_scenes


def chosen(index, filters=None, **options):
    pairs = choose_pairs(index, filter_scenes(index, filters or {}), **options)
    return [
        (int(row), int(source), [int(target) for target in targets if target >= 0])
        for row, source, targets in zip(pairs.row, pairs.source, pairs.targets, strict=True)
    ]


def test_the_primary_pair_is_the_one_that_each_scene_records(index):
    found = chosen(index, {"map": "Town"})

    assert [pair[1:] for pair in found] == [(2, [3]), (0, [1]), (0, [1]), (0, [1])]


@pytest.mark.parametrize(
    "pairs",
    [(0, 1), "0 - 1", ["0-1"], np.array([[0, 1]])],
    ids=repr,
)
def test_one_pair_needs_no_list_around_it(index, pairs):
    assert chosen(index, pairs=pairs) == chosen(index, pairs=[(0, 1)])


def test_several_pairs_are_a_list_or_one_text(index):
    expected = chosen(index, pairs=[(0, 5), (1, 3)])

    assert chosen(index, pairs="0-5,1-3") == chosen(index, pairs=["0-5", (1, 3)]) == expected


def test_right_to_left_turns_every_pair_round(index):
    found = chosen(index, {"subset": "seen_map"}, pairs="all", direction="right_to_left")

    assert [(*targets, source) for _, source, targets in found] == list(CAMERA_PAIRS)
    sweep = chosen(index, {"subset": "seen_map"}, pairs="sweep", direction="right_to_left")
    assert sweep == [(0, 5, [4, 3, 2, 1, 0])]


def test_a_sweep_groups_what_stands_to_the_right_of_the_primary_view(index):
    assert chosen(index, {"split": "eval"}, pairs="sweep") == [
        (0, 2, [3, 4, 5]),
        (1, 0, [1, 2, 3, 4, 5]),
    ]


def test_a_baseline_range_is_closed_and_drops_pairs_not_scenes(index):
    found = chosen(
        index,
        {"scenes": "train/Uniform/Town/scene_000002"},
        pairs="all",
        baseline_cm=(25.0, 40.0),
    )

    # gaps 5 25 40 70 120: 1-2 is 25, 0-2 is 30, 2-3 is 40
    assert [(source, *targets) for _, source, targets in found] == [(0, 2), (1, 2), (2, 3)]


def test_a_sweep_keeps_the_targets_in_the_baseline_range(index):
    found = chosen(
        index,
        {"scenes": "train/Uniform/Town/scene_000002"},
        pairs="sweep",
        baseline_cm=(25.0, 80.0),
    )

    # from camera 0: 5, 30, 70, 140, 260 cm
    assert found == [(8, 0, [2, 3])]


def test_the_last_bin_of_the_paper_is_closed_and_the_others_are_half_open():
    edges = [1.0, 10.0, 30.0, 60.0, 100.0, 150.0, np.nextafter(150.0, 151)]

    assert [baseline_bin(edge) for edge in edges] == [
        "[1,10)", "[10,30)", "[30,60)", "[60,100)", "[100,150]", "[100,150]", "(150,inf)",
    ]  # fmt: skip


def test_several_bins_are_joined(index):
    found = chosen(
        index, {"family": "IPD_Gaussian"}, pairs="all", baseline_cm=["[1,10)", "[30,60)"]
    )

    # gaps of 6: five pairs of 6 cm and one of 30 cm in each of four scenes
    assert len(found) == 4 * (5 + 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pairs": [(2, 2)]}, r"there is no pair \(2, 2\)"),
        ({"pairs": [(3, 1)]}, r"write \(1, 3\), .* direction='right_to_left'"),
        ({"pairs": [(0, 1), (0, 1)]}, "each only once"),
        ({"pairs": "every"}, "must be 'primary'"),
        ({"pairs": "1-0"}, r"write \(0, 1\), .* direction='right_to_left'"),
        ({"pairs": []}, "at least one"),
        ({"pairs": 5}, "camera pairs such as .* got 5"),
        ({"pairs": [(0, 1, 2)]}, r"got \(0, 1, 2\)"),
        ({"pairs": [("0", "1")]}, "got"),
        (
            {"filters": {"family": "IPD_Gaussian"}, "baseline_cm": (50, 60)},
            r"baseline_cm 50 to 60 .* 4 pairs; found 6 to 6 cm, in the bins \[1,10\)",
        ),
        ({"baseline_cm": 10}, "baseline_cm must be"),
        ({"baseline_cm": (5, 1)}, "baseline_cm: 5 to 1 "),
        ({"baseline_cm": "[1,11)"}, r"no baseline bin '\[1,11\)'; the bins are \[0,1\), "),
        ({"direction": "backwards"}, "direction must be"),
    ],
    ids=str,
)
def test_a_choice_of_pairs_that_cannot_be_is_refused(index, options, message):
    with pytest.raises(SelectionError, match=message):
        chosen(index, **options)
