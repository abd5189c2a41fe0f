"""The numbering of samples: scene by scene, window by window, pair by pair."""

import itertools
import re

import numpy as np
import pytest
import torch

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.selection.filters import baselines_cm
from stereogenbench_data.selection.plan import plan_pairs, plan_views


def test_samples_are_numbered_scene_window_pair(index):
    plan = plan_pairs(index, family="IPD_Gaussian", pairs="adjacent", frames=[3, 7])
    found = [plan.locate(number, epoch=0) for number in range(len(plan))]

    expected = itertools.product(range(4), [(3,), (7,)], [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)])
    first = found[0].row
    assert [(a.row - first, a.frames, (a.source, *a.targets)) for a in found] == list(expected)


@pytest.mark.parametrize("kind", [np.uint16, torch.tensor])
def test_numbers_of_numpy_and_torch_are_numbers(index, kind):
    def digest(of):
        options = {"seed": of(3), "min_frames": of(40), "baseline_cm": None}
        pairs = plan_pairs(
            index, pairs=(of(0), of(2)), frames=("random", of(2)), balance="bins", limit=of(5),
            **options,
        )  # fmt: skip
        views = plan_views(index, cameras=(of(0), of(4)), frames=of(7), seed=of(1), filters={})
        return pairs.digest, views.digest, pairs.locate(of(4), epoch=0)

    assert digest(kind) == digest(int)


@pytest.mark.parametrize("seed", [1.0, True, "1", torch.tensor(1.0), np.float32(1)], ids=repr)
def test_a_seed_that_is_no_whole_number_is_refused(index, seed):
    match = f"seed must be .* from 0, got {re.escape(repr(seed))}"
    with pytest.raises(SelectionError, match=match):
        plan_pairs(index, seed=seed)


def test_only_random_frames_depend_on_the_epoch(index):
    fixed = plan_pairs(index, frames=("every", 20))
    drawn = plan_pairs(index, frames=("random", 4))

    def addresses(plan, epoch):
        return [plan.locate(number, epoch=epoch) for number in range(len(plan))]

    assert addresses(fixed, 0) == addresses(fixed, 1)
    assert addresses(drawn, 0) != addresses(drawn, 1)
    assert addresses(drawn, 0) == addresses(drawn, 0)


def test_pairs_of_one_moment_share_their_random_frame(index):
    plan = plan_pairs(index, family="IPD_Gaussian", pairs="all", frames=("random", 3))
    frames = [plan.locate(number, epoch=5).frames for number in range(45)]

    assert [len(set(frames[start : start + 15])) for start in (0, 15, 30)] == [1, 1, 1]


@pytest.mark.parametrize(
    "frames",
    [50, ("clips", 25, 2), ("random clips", 2, 48)],
    ids=str,
)
def test_the_cure_of_an_error_about_short_scenes_leaves_out_those_alone(index, frames):
    with pytest.raises(SelectionError, match="eval/MapUnseenInTrain/Uniform/Reef") as refused:
        plan_pairs(index, frames=frames)
    least = int(re.search(r"min_frames=([0-9]+)", str(refused.value))[1])

    plan = plan_pairs(index, frames=frames, min_frames=least)

    assert 40 < least <= 51
    assert len(plan.scene_rows) == len(index) - 1


def test_a_few_pairs_are_drawn_of_all_and_more_hold_fewer(index):
    def drawn(limit, seed=0):
        pairs = plan_pairs(index, pairs="all", limit=limit, seed=seed).pairs
        columns = (pairs.row, pairs.source, pairs.targets[:, 0])
        return {*zip(*(each.tolist() for each in columns), strict=True)}

    few, more = drawn(7), drawn(30)

    assert (len(few), len(more)) == (7, 30)
    assert few < more
    assert len({row for row, _, _ in more}) > 3
    assert drawn(7, seed=1) != few
    assert drawn(15 * len(index)) == drawn(None)


def test_of_several_captions_one_has_to_fit(index):
    def scenes(caption):
        return plan_pairs(index, caption=caption).scene_rows.tolist()

    courtyard, street = scenes("open sky"), scenes("street night")

    assert scenes(["open sky", "night street"]) == sorted(courtyard + street)
    assert scenes(["open sky", "open street"]) == courtyard
    with pytest.raises(SelectionError, match=r"none with all of open, street or red"):
        scenes(["open street", "red"])
    with pytest.raises(SelectionError, match="a list of such texts"):
        scenes([])


def test_a_balanced_plan_draws_pairs_evenly(wide_index):
    plan = plan_pairs(
        wide_index, pairs="all", balance="bins", limit=40, baseline_cm=["[1,10)", "[10,30)"]
    )
    found = baselines_cm(wide_index, plan.pairs)[:, 0]

    assert len(plan) == 40
    assert (found < 10).sum() == 20


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"pairs": "all", "limit": 1000}, r"limit=1000, and the selection has \d+ pairs"),
        ({"limit": 0}, "limit must be a whole number from 1"),
        ({"balance": "bins", "pairs": "sweep"}, "needs single pairs"),
        ({"pears": "all"}, "no filter 'pears'"),
    ],
)
def test_options_that_do_not_go_together_are_refused(index, options, message):
    with pytest.raises(SelectionError, match=message):
        plan_pairs(index, **options)


@pytest.mark.parametrize("number", [-1, 9])
def test_a_sample_beyond_the_last_is_an_index_error(index, number):
    with pytest.raises(IndexError, match=f"no sample {number}: there are 9"):
        plan_pairs(index).locate(number, epoch=0)


def test_views_are_one_sample_a_moment_or_one_a_camera(index):
    options = {"frames": [0, 1], "seed": 0, "filters": {"split": "eval"}}
    together = plan_views(index, cameras=(4, 0, 2), **options)
    each = plan_views(index, cameras="each", **options)

    assert len(together) == 2 * 2
    assert together.locate(1, epoch=0)[1:4] == (4, (0, 2), (1,))
    assert len(each) == 2 * 2 * 6
    assert [each.locate(number, epoch=0)[1:3] for number in (0, 5)] == [(0, ()), (5, ())]
