"""Samples and selections as a notebook shows them."""

import numpy as np
import pandas
import pytest
import torch

from stereogenbench_data import SceneViews, StereoPairs, show
from stereogenbench_data.bridges.picture import NOT_MEASURED
from stereogenbench_data.errors import FieldError

FIELDS = ("left", "right", "disparity", "valid", "visible")
SIDE, GAP, TOP = 64, 13, 35
"""Of a tile of 64 px: its side, what lies between two of them, and what lies above the first."""


def tile(picture, number):
    left = GAP + number * (SIDE + GAP)
    return np.asarray(picture)[TOP : TOP + SIDE, left : left + SIDE]


def test_pictures_are_shown_as_they_are_and_maps_in_colours(small_release):
    sample = StereoPairs(small_release, fields=FIELDS)[0]
    picture = show(sample, width_px=SIDE)

    for number, name in enumerate(("left", "right")):
        np.testing.assert_array_equal(tile(picture, number), sample[name].permute(1, 2, 0))
    valid, disparity = sample["valid"][0].numpy(), sample["disparity"][0].numpy()
    painted = tile(picture, 2)
    np.testing.assert_array_equal((painted == NOT_MEASURED).all(axis=2), ~valid)
    near, far = (
        painted[valid][place] for place in (disparity[valid].argmax(), disparity[valid].argmin())
    )
    assert near[0] > near[2]
    assert far[2] > far[0]
    np.testing.assert_array_equal(tile(picture, 4)[..., 0] == 255, sample["visible"][0])


def test_batches_views_and_clips_have_a_row_for_each_field(small_release):
    pairs = StereoPairs(small_release, fields=("left", "disparity", "valid"))
    (batch,) = pairs.loader(4)
    views = SceneViews(small_release, fields=("image", "depth"))[0]
    clip = StereoPairs(small_release, fields=("left", "right"), frames=("clips", 7, 1, 7))[0]

    widths = [show(each, width_px=SIDE).width for each in (batch, views, clip)]
    assert widths == [GAP + number * (SIDE + GAP) for number in (4, 6, 6)]
    second = show(views, width_px=SIDE)
    np.testing.assert_array_equal(tile(second, 1), views["image"][1].permute(1, 2, 0))


def test_pictures_that_a_network_takes_are_shown_too(small_release):
    sample = StereoPairs(small_release, fields=("left",))[0]
    scaled = show({"left": sample["left"] / 255}, width_px=SIDE)

    np.testing.assert_array_equal(np.asarray(scaled), np.asarray(show(sample, width_px=SIDE)))
    empty = show({"disparity": torch.zeros(1, SIDE, SIDE)}, width_px=SIDE)
    assert (tile(empty, 0) == NOT_MEASURED).all()
    with pytest.raises(FieldError, match="no picture, map or mask"):
        show({"pair": torch.tensor([0, 1]), "scene": "a"})


def test_a_selection_says_how_many_of_how_many_samples_it_has(small_release):
    few, all_of_them = (
        StereoPairs(small_release),
        StereoPairs(small_release, pairs="all", frames="all"),
    )

    assert repr(few).startswith(
        '<StereoPairs: 4 of 420 samples (all: pairs="all", frames="all") of 4 scenes; split=None; '
        "pairs='primary'; frames='first'; stored size; fields left, right, disparity, "
    )
    assert repr(all_of_them).startswith(
        "<StereoPairs: 420 samples of 4 scenes; split=None; pairs='all'"
    )
    small = StereoPairs(small_release, family="Uniform", size=(32, 48), frames=("clips", 2, 1, 2))
    assert "frames=('clips', 2, 1, 2); size 48x32;" in repr(small)
    assert "cameras=(0, 2); frames='first'" in repr(SceneViews(small_release, cameras=(0, 2)))


def test_the_table_has_a_row_for_each_selected_pair(small_release):
    pairs = StereoPairs(small_release, pairs="all", frames="all", baseline_cm=(5, 60))
    table = pairs.to_pandas()

    assert isinstance(table, pandas.DataFrame)
    assert table["samples"].sum() == len(pairs)
    assert table["baseline_cm"].between(5, 60).all()
    first = pairs[0]
    row = table.iloc[0]
    assert (row["key"], [row["left"], row["right"]]) == (first["scene"], first["pair"].tolist())
    assert row["baseline_cm"] == pytest.approx(100 * float(first["baseline_m"]))
    sweep = StereoPairs(small_release, pairs="sweep").to_pandas()
    assert sweep["right"].tolist()[0] == [1, 2, 3, 4, 5]
