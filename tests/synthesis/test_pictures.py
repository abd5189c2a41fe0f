"""What is drawn, judged from the written files alone."""

import numpy as np
import pytest


def warped(right, disparity_px):
    """Sample the right picture where the left one's pixels land; own code on purpose."""
    height, width, _ = right.shape
    place = np.arange(width) - disparity_px
    column = np.clip(np.floor(place).astype(int), 0, width - 2)
    part = (place - column)[..., None]
    rows = np.arange(height)[:, None]
    return right[rows, column] * (1 - part) + right[rows, column + 1] * part


def psnr_db(scene, *, left, right, frame, scale=1.0):
    depth_m = scene.units(left)[frame] / 1000
    target_m = scene.units(right)[frame] / 1000
    measured = (depth_m > 0) & (depth_m < 65.535)
    disparity_px = (
        scale * scene.focal_px * scene.baseline_m(left, right) / np.maximum(depth_m, 0.01)
    )
    width = depth_m.shape[1]
    landing = np.arange(width) - disparity_px
    inside = measured & (landing >= 0) & (landing <= width - 1)
    nearest = np.clip(np.rint(landing).astype(int), 0, width - 1)
    there_m = target_m[np.arange(len(depth_m))[:, None], nearest]
    visible = inside & (np.abs(there_m - depth_m) < 0.02 * depth_m + 0.002)
    error = warped(scene.pictures(right)[frame], disparity_px) - scene.pictures(left)[frame]
    return 10 * np.log10(255**2 / (error[visible] ** 2).mean()), visible.mean()


@pytest.mark.parametrize("pair", [(0, 1), (3, 4)])
def test_neighbours_agree_when_warped_by_depth(uniform_scene, pair):
    left, right = pair

    agreement_db, kept = psnr_db(uniform_scene, left=left, right=right, frame=1)

    assert agreement_db > 30
    assert kept > 0.2


def test_a_wrong_scale_or_sign_is_far_worse(uniform_scene):
    true_db, _ = psnr_db(uniform_scene, left=1, right=2, frame=0)
    wrong_db, _ = psnr_db(uniform_scene, left=1, right=2, frame=0, scale=-1.0)

    assert true_db - wrong_db > 10


def test_depth_has_near_far_and_sky(draw):
    scene = draw(family="IPD_Gaussian", seed=1, focal_mm=18.0, frames=1)
    units = scene.units(0)

    assert (units == 65535).any()
    assert units.min() < 1500
    assert np.percentile(units[units < 65535], 95) > 6000
