"""Calibration controls: what each shows, and the relations that must hold between them."""

import statistics
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereogenbench_data import EvaluationError, EvaluationProtocol, score_controls
from stereogenbench_data.evaluation.columns import HEAVY_TAILED
from stereogenbench_data.evaluation.controls import CONTROLS, derangement, wrong_camera
from stereogenbench_data.evaluation.models.opencv import Sgbm
from stereogenbench_data.evaluation.predictions import open_frames
from stereogenbench_data.evaluation.protocol import PROTOCOL_VERSION
from stereogenbench_data.evaluation.report import markdown
from stereogenbench_data.evaluation.tables import cell, table_of
from stereogenbench_data.schema.release import CAMERA_PAIRS
from tests.evaluation.conftest import QUICK, numbers, scored

TARGET, COPIED, WRONG, RANDOM = range(4)
"""The controls in the order in which they are scored."""

ORDERED = [
    ("psnr", (RANDOM,), (COPIED, WRONG)),
    ("ssim", (COPIED, WRONG, RANDOM), (TARGET,)),
    ("ssim", (RANDOM,), (COPIED, WRONG)),
    ("p_psnr", (RANDOM,), (TARGET, COPIED, WRONG)),
    ("e_match", (TARGET, COPIED, WRONG), (RANDOM,)),
    ("sd_filtered", (TARGET,), (COPIED,)),
    ("sd_filtered", (TARGET,), (WRONG,)),
]
"""A column, and the controls whose mean (of SD median) is below that of others."""
SHARDS = Path(__file__).resolve().parents[2] / "shards"


def middle(scores, column):
    found = cell(scores.pairs, column)
    return found.median if column in HEAVY_TAILED else found.mean


@pytest.fixture(scope="module")
def on_the_sample():
    """The controls on the first frames of the shipped sample, at half of the paper's size."""
    return score_controls(
        SHARDS, split="eval", frames="first", workers=1,
        protocol=EvaluationProtocol(size=(240, 416)),
    )  # fmt: skip


@given(st.sets(st.text(min_size=1, max_size=4), min_size=2, max_size=9), st.integers(0, 2**32))
def test_a_derangement_gives_every_scene_another_one_each_once(keys, seed):
    donors = derangement(sorted(keys), seed=seed)

    assert set(donors) == set(donors.values()) == keys
    assert all(scene != donor for scene, donor in donors.items())
    assert donors == derangement(sorted(keys, reverse=True), seed=seed)


def test_one_scene_has_no_derangement():
    with pytest.raises(EvaluationError, match=r"'random right'.* 1 is selected. Select more"):
        derangement(["alone"], seed=0)


def test_the_wrong_camera_is_02_for_01_and_always_neither_of_the_pair():
    assert wrong_camera(0, 1) == 2
    for left, right in CAMERA_PAIRS:
        assert wrong_camera(left, right) not in (left, right)
        assert 0 <= wrong_camera(left, right) < 6


@pytest.mark.parametrize(("column", "lower", "upper"), ORDERED)
def test_a_column_orders_the_controls_of_the_shipped_sample(on_the_sample, column, lower, upper):
    low, high = ([middle(on_the_sample[each], column) for each in side] for side in (lower, upper))

    assert max(low) < min(high)


def test_the_target_is_perfect_and_the_wrong_baselines_slope_is_the_ratio_of_baselines(
    on_the_sample,
):
    target, copied, wrong, _ = on_the_sample
    off = []
    for pair in wrong.pairs:
        slope, r2 = pair.tallies["sd_filtered_slope"], pair.tallies["sd_filtered_r2"]
        if slope.finite and r2.mean >= 0.8:  # else the matcher's search is too short for it
            rig = target.index.scene(pair.row).rig
            other_cm = rig.baseline_cm(pair.pair[0], wrong_camera(*pair.pair))
            off.append(abs(slope.mean - pair.baseline_cm / other_cm))

    assert cell(target.pairs, "psnr").infinite == sum(pair.frames for pair in target.pairs)
    assert middle(target, "e_match") == 0 < middle(copied, "e_match")
    assert statistics.median_high(off) <= 0.1


def test_version_2_of_the_protocol_gives_these_scores(on_the_sample):
    """If a number changes on purpose, PROTOCOL_VERSION must be raised with it."""
    wrong = on_the_sample[2]
    expected = {"psnr": 19.835750, "ssim": 0.643907, "p_psnr": 32.174968}

    assert PROTOCOL_VERSION == 2
    assert {name: cell(wrong.pairs, name).mean for name in expected} == pytest.approx(
        expected, abs=1e-6
    )


def test_what_sgbm_cannot_find_pollutes_no_sd_and_a_copied_view_does_not_print_as_any_other():
    target, copied, *_ = results = score_controls(
        SHARDS, split="eval", family="Uniform", pairs=[(0, 4)], frames=[0], workers=1,
        protocol=EvaluationProtocol(metrics=("sd",)),
    )  # fmt: skip
    far, near = sorted(target.pairs, key=lambda pair: -pair.baseline_cm)
    text = markdown(table_of(results, "controls"))
    line = next(line for line in text.splitlines() if line.startswith("| copied left |"))

    assert (round(far.baseline_cm), round(near.baseline_cm)) == (248, 190)
    assert near.tallies["sd_filtered"].mean < 0.04
    assert near.tallies["sd_filtered_r2"].mean > 0.9
    assert far.tallies["sd_filtered"].undefined == far.tallies["sd_least_squares"].undefined == 1
    assert far.tallies["sd_beyond"].mean > 0.9
    assert [pair.tallies["sd_filtered"].loose for pair in copied.pairs].count(1) == 1
    assert line.count("1 undefined, 1 with R2 below 0.1") == 2


def test_both_fits_of_a_frame_are_of_the_one_disparity_that_the_matcher_found(on_the_sample):
    target = on_the_sample[0]
    fields = ("left", "right", "disparity", "visible")
    for pair in target.pairs:
        with open_frames(target.index, fields, size=(240, 416)) as load:
            sample = load(pair.row, pair.pair, 0)
        found, true = Sgbm()(sample["left"], sample["right"]), sample["disparity"][0]
        used = sample["visible"][0] & np.isfinite(found) & (true <= 175)
        slope, offset = np.polyfit(found[used].astype(float), true[used].astype(float), 1)
        numbers = {name: each.mean for name, each in pair.tallies.items()}

        assert numbers["sd_least_squares"] == pytest.approx(abs(slope - 1), rel=1e-6)
        assert numbers["sd_least_squares_slope"] == pytest.approx(slope, rel=1e-6)
        assert numbers["sd_least_squares_offset_px"] == pytest.approx(offset, rel=1e-6)
        assert numbers["sd_least_squares_outliers"] == 0
        assert numbers["sd_filtered"] == abs(numbers["sd_filtered_slope"] - 1)
        assert 0 < numbers["sd_filtered_outliers"] < 0.5
        assert numbers["sd_filtered"] != pytest.approx(numbers["sd_least_squares"], rel=0.1)


def test_the_wrong_baseline_is_camera_02(scored_index, other_views, protocol):
    controls = score_controls(scored_index, protocol=protocol, workers=1)
    wrong = controls[2]

    assert [one.name for one in controls] == list(CONTROLS)
    assert numbers(wrong) == numbers(scored(scored_index, other_views, protocol))


def test_a_random_right_depends_on_the_seed_alone(scored_index, tmp_path):
    def random_right(seed, **options):
        options = {"frames": "first", "workers": 1} | options
        return numbers(score_controls(scored_index, protocol=QUICK, seed=seed, **options)[3])

    assert random_right(0) == random_right(0, out=tmp_path)
    assert len({str(random_right(seed)) for seed in range(4)}) == 2
    with pytest.raises(EvaluationError, match="holds scores of other seed: 0, where 1"):
        random_right(1, out=tmp_path)
