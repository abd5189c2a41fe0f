"""P-PSNR against a search by loops, and by hand."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.evaluation.metrics.pixels import outside_window, patch_psnr

FLOOR_DB = 10 * math.log10(255**2 * 12)


def best_errors(left: np.ndarray, right: np.ndarray) -> list[float]:
    """Return the mean squared error of each patch's best match, patch by patch."""
    left, right = left.astype(np.int64), right.astype(np.int64)
    found = []
    for y in range(0, left.shape[1] - 15, 16):
        for x in range(0, left.shape[2] - 15, 16):
            patch = left[:, y : y + 16, x : x + 16]
            errors = [
                np.mean((patch - right[:, y : y + 16, x - d : x - d + 16]) ** 2)
                for d in range(2, 49)
                if d <= x
            ]
            if errors:
                found.append(min(errors))
    return found


def random_picture(height: int, width: int, *, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (3, height, width)).astype(np.uint8)


@settings(max_examples=25, deadline=None)
@given(
    height=st.integers(16, 40),
    width=st.integers(32, 140),
    seed=st.integers(0, 99),
    contrast=st.sampled_from([1, 3, 64, 255]),
)
def test_every_patch_finds_what_a_search_by_loops_finds(height, width, seed, contrast):
    left, right = (random_picture(height, width, seed=seed + n) // (256 - contrast) for n in (0, 1))
    errors = np.array(best_errors(left, right))

    score = patch_psnr(left, right)

    floored = np.maximum(errors, 1 / 12)
    assert score == pytest.approx(np.mean(10 * np.log10(255**2 / floored)), abs=1e-9)


@pytest.mark.parametrize(("shift", "found"), [(1, False), (2, True), (48, True), (49, False)])
def test_a_shift_is_found_from_2_to_48_pixels(shift, found):
    wide = random_picture(32, 400, seed=5)
    left, right = wide[..., :-64], wide[..., shift : shift + 400 - 64]

    score = patch_psnr(left, right)

    # Few patches are nearer to the left border than the shift and so have no counterpart.
    assert 50 < score <= FLOOR_DB if found else score < 20


def test_one_level_off_is_48_db_and_patches_at_the_left_border_are_not_scored():
    wide = random_picture(16, 80, seed=2) // 2
    left, right = wide[..., :64], wide[..., 4:68] + np.uint8(1)

    score = patch_psnr(left, right)

    assert score == pytest.approx(48.1308036086791, abs=1e-9)


@pytest.mark.parametrize("size", [(15, 64), (40, 31)])
def test_a_picture_without_patches_to_search_has_no_score(size):
    picture = np.zeros((3, *size), dtype=np.uint8)

    score = patch_psnr(picture, picture)

    assert math.isnan(score)


def test_content_outside_the_window_is_counted_where_disparity_is_known():
    disparity = np.array([[1.9, 2.0, 30.0], [48.0, 48.1, 500.0]], dtype=np.float32)

    assert outside_window(disparity, np.ones((2, 3), dtype=bool)) == 0.5
    assert outside_window(disparity, disparity < 40) == pytest.approx(1 / 3)
    assert math.isnan(outside_window(disparity, disparity < 0))
