"""All that works offline, on a synthesised pair whose geometry is known."""

import cv2
import numpy as np
import pytest
import torch

from stereogenbench_data import StereoPairs
from stereogenbench_data.evaluation.metrics.matching import match_error, target_matches
from stereogenbench_data.evaluation.metrics.pixels import outside_window, patch_psnr, psnr_db, ssim
from stereogenbench_data.evaluation.metrics.scale import fit_scale
from stereogenbench_data.evaluation.models.opencv import Sgbm, Sift


@pytest.fixture(scope="module")
def pairs(detailed_release):
    """Return samples of the pairs of cameras (0, 1), the target, and (0, 2), too wide a one."""
    fields = ["left", "right", "disparity", "visible", "baseline_m"]
    return [
        {
            name: np.asarray(value)
            for name, value in StereoPairs(detailed_release, pairs=[pair], fields=fields)[0].items()
        }
        for pair in ((0, 1), (0, 2))
    ]


@pytest.fixture(scope="module")
def scores(pairs):
    """Return what each control scores by each metric."""
    target, wide = pairs
    left, right = target["left"], target["right"]
    matcher, stereo = Sift(), Sgbm(disparities=48)
    against = target_matches(left, right, matcher=matcher)
    controls = {
        "target": right,
        "copied left": left,
        "wrong baseline": wide["right"],
        "random": right[:, ::-1, ::-1].copy(),
    }
    return {
        name: {
            "psnr": psnr_db(picture, right),
            "ssim": ssim(picture, right),
            "p_psnr": patch_psnr(left, picture).mean_db,
            "match": match_error(picture, against=against, matcher=matcher),
            "scale": fit_scale(
                stereo(left, picture), target["disparity"][0], scored=target["visible"][0]
            ),
        }
        for name, picture in controls.items()
    }


@pytest.mark.parametrize("metric", ["psnr", "ssim"])
def test_the_target_scores_best_and_a_random_view_worst(scores, metric):
    values = {name: score[metric] for name, score in scores.items()}

    assert max(values, key=values.get) == "target"
    assert min(values, key=values.get) == "random"


def test_patches_of_a_random_view_match_worst_and_need_not_match_best_in_the_target(scores, pairs):
    """Half of the target's disparities are below the 2 px that P-PSNR searches from."""
    values = {name: score["p_psnr"] for name, score in scores.items()}

    assert outside_window(pairs[0]["disparity"][0], pairs[0]["visible"][0]) > 0.4
    assert min(values, key=values.get) == "random"
    assert values["target"] > values["copied left"]


def test_match_errors_are_ordered_and_the_copied_left_has_what_the_formula_says(scores):
    errors = {name: score["match"].e_match for name, score in scores.items()}
    target = scores["target"]["match"]

    assert errors["target"] == 0 < errors["wrong baseline"] < errors["random"]
    assert errors["random"] > 90
    assert errors["copied left"] == pytest.approx(
        100 * (1 - target.target_matches / target.keypoints)
    )


def test_the_scale_of_the_target_is_right_and_of_a_wrong_baseline_the_ratio_of_the_two(
    scores, pairs
):
    ratio = pairs[0]["baseline_m"] / pairs[1]["baseline_m"]

    assert scores["target"]["scale"].drift < 0.1
    assert scores["wrong baseline"]["scale"].slope == pytest.approx(ratio, abs=0.1)
    assert scores["copied left"]["scale"].r2 < 0.05
    assert scores["random"]["scale"].drift == pytest.approx(1, abs=0.2)


def measured(left, right, *, threads):
    """Return scores, computed by so many threads, and the numbers of threads there were."""
    before = cv2.getNumThreads(), torch.get_num_threads()
    cv2.setNumThreads(threads)
    torch.set_num_threads(threads)
    try:
        found = cv2.getNumThreads(), torch.get_num_threads()
        noisy = right // 2 + 30
        against = target_matches(left, right, matcher=Sift())
        disparity = Sgbm(disparities=48)(left, noisy)
        fit = fit_scale(disparity, disparity * 2 + left[0] / 100, scored=np.isfinite(disparity))
        return found, [
            psnr_db(noisy, right),
            ssim(noisy, right),
            patch_psnr(left, noisy).mean_db,
            match_error(noisy, against=against, matcher=Sift()).e_match,
            fit.slope,
            fit.residual_px,
        ]
    finally:
        cv2.setNumThreads(before[0])
        torch.set_num_threads(before[1])


def test_scores_are_the_same_to_the_last_digit_on_one_thread_and_on_three(pairs):
    left, right = pairs[0]["left"], pairs[0]["right"]
    one, scores_of_one = measured(left, right, threads=1)
    three, scores_of_three = measured(left, right, threads=3)

    assert (one, three) == ((1, 1), (3, 3))
    assert scores_of_one == scores_of_three
