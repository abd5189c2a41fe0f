"""PSNR and SSIM against scikit-image, on random, flat and photographed pictures."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays
from skimage.metrics import peak_signal_noise_ratio

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.metrics.pixels import psnr_db, ssim
from tests.evaluation.conftest import photograph, true_ssim

pictures = arrays(np.uint8, (3, 13, 17))


def noisy(picture: np.ndarray, *, sigma: float) -> np.ndarray:
    noise = np.random.default_rng(3).normal(0, sigma, picture.shape)
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module", params=["cones/left.png", "cloth3/view1.png"])
def photographed(request, ground_truth):
    return photograph(ground_truth / request.param)


@pytest.mark.parametrize("sigma", [0.3, 80])
def test_photographs_score_as_in_scikit_image(photographed, sigma):
    other = noisy(photographed, sigma=sigma)

    assert psnr_db(other, photographed) == pytest.approx(
        peak_signal_noise_ratio(photographed, other, data_range=255), abs=1e-9
    )
    assert ssim(other, photographed) == pytest.approx(true_ssim(photographed, other), abs=1e-9)


@pytest.mark.parametrize("other", [254, 0])
def test_flat_pictures_score_as_in_scikit_image(other):
    white = np.full((3, 20, 30), 255, dtype=np.uint8)
    flat = np.full_like(white, other)

    assert psnr_db(white, flat) == pytest.approx(20 * math.log10(255 / (255 - other)), abs=1e-12)
    assert ssim(white, flat) == pytest.approx(true_ssim(white, flat), abs=1e-9)


@settings(max_examples=25, deadline=None)
@given(one=pictures, two=pictures)
def test_scores_do_not_depend_on_which_is_the_target_nor_on_a_mirror(one, two):
    assert psnr_db(one, two) == psnr_db(two, one) == psnr_db(one[..., ::-1], two[..., ::-1])
    assert ssim(one, two) == ssim(two, one)
    assert ssim(one, two) == pytest.approx(ssim(one[:, ::-1], two[:, ::-1]), abs=1e-12)
    assert -1 <= ssim(one, two) <= ssim(one, one) == 1
    assert psnr_db(one, one) == math.inf


def test_a_picture_below_the_window_has_no_ssim():
    small = np.zeros((3, 10, 30), dtype=np.uint8)

    with pytest.raises(EvaluationError, match="at least 11x11 pixels, got 30x10"):
        ssim(small, small)
