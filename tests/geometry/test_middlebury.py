"""Against measured disparities: Cones (2003), Cloth3 (2006) and Motorcycle (2014).

Disparity stands for depth where two views are compared: their agreement is asked for in pixels,
as the sets' own occlusion maps are made.
"""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.projection import (
    backward_warp,
    homography,
    lands_inside,
    project_by_homography,
    project_rectified,
    visible_from_source,
    visible_in_target,
)


def read(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture)


def depth_of(disparity_px: np.ndarray) -> np.ndarray:
    """Return depth for B f = 1, and 0 where disparity is not known."""
    known = disparity_px > 0
    return np.where(known, 1 / np.where(known, disparity_px, 1), 0).astype(disparity_px.dtype)


def psnr_db(image: np.ndarray, reference: np.ndarray, mask: np.ndarray) -> float:
    """Return the PSNR in dB of two images (c, h, w) over the pixels of a mask, peak 255."""
    error = (image.astype(np.float64) - reference)[..., mask]
    return float(10 * np.log10(255**2 / np.mean(error**2)))


@pytest.mark.parametrize(
    ("judge", "least"),
    [
        pytest.param("target", 0.984, id="by both views' disparity"),
        pytest.param("source", 0.99, id="by a z-buffer of the left view"),
    ],
)
def test_visibility_is_the_occlusion_map_of_cones(ground_truth, judge, least):
    cones = ground_truth / "cones"
    left_px, right_px = read(cones / "disp_left.tif"), read(cones / "disp_right.tif")
    visible_there = read(cones / "occlusion.png").astype(bool)
    known = left_px > 0
    projection = project_rectified(depth_of(left_px), left_px)

    if judge == "target":
        target = {"target_depth_m": depth_of(right_px), "target_measured": right_px > 0}
        visible = visible_in_target(projection, measured=known, **target, quantum_m=0.0)
    else:
        visible = visible_from_source(projection, measured=known, quantum_m=0.0)

    assert (visible == visible_there)[known].mean() > least


def test_cloth_warps_back_onto_itself(ground_truth):
    """Where the right view's disparity is within a pixel that of the left one that lands there."""
    folder = ground_truth / "cloth3"
    left, right = (read(folder / f"view{n}.png").transpose(2, 0, 1) for n in (1, 5))
    left_px, right_px = (read(folder / f"disp{n}.png").astype(np.float32) / 2 for n in (1, 5))
    projection = project_rectified(left_px, left_px)

    warped, inside = backward_warp(right, projection)

    target = {"target_depth_m": right_px, "target_measured": right_px > 0}
    how = {"measured": left_px > 0, "quantum_m": 0.5, "tolerance": 0.0}
    visible = visible_in_target(projection, **target, **how)
    assert psnr_db(warped, left, visible & inside) == pytest.approx(34.94, abs=0.02)


@pytest.fixture(scope="module")
def motorcycle(ground_truth):
    """The two pictures, disparity in pixels, and where it is known."""
    folder = ground_truth / "motorcycle"
    files = (folder / f"motorcycle_{side}.png" for side in ("left", "right"))
    left, right = (read(file).transpose(2, 0, 1) for file in files)
    with np.load(folder / "motorcycle_disp.npz") as archive:
        disparity_px = archive["arr_0"]
    known = np.isfinite(disparity_px)
    return left, right, np.where(known, disparity_px, np.float32(0)), known


@pytest.mark.parametrize(("sign", "expected_db"), [(1, 22.4), (-1, 11.6)])
def test_the_right_view_of_the_motorcycle_is_to_the_left(motorcycle, sign, expected_db):
    left, right, disparity_px, known = motorcycle
    projection = project_rectified(disparity_px, sign * disparity_px)

    warped, inside = backward_warp(right, projection)

    assert psnr_db(warped, left, known & inside) == pytest.approx(expected_db, abs=0.05)


def test_principal_points_that_differ_are_part_of_the_disparity(motorcycle):
    """Doffs of 31 px: the chain between the two cameras gives back the measured disparity."""
    *_, disparity_px, known = motorcycle
    left = Intrinsics(994.978, 994.978, 311.193, 254.877, 741, 500)
    right = Intrinsics(994.978, 994.978, 311.193 + 31.086, 254.877, 741, 500)
    depth_m = np.where(known, depth_of(disparity_px.astype(np.float64) + 31.086), 0)
    depth_m *= 994.978 * 0.193001
    motion = np.eye(4)
    motion[0, 3] = -0.193001

    chain = project_by_homography(depth_m, *homography(left, right, motion))

    assert depth_m[known].min() == pytest.approx(2.11, abs=0.005)
    assert depth_m[known].max() == pytest.approx(5.02, abs=0.005)
    measured_u_px = project_rectified(depth_m, disparity_px.astype(np.float64)).u_px
    np.testing.assert_allclose(chain.u_px[known], measured_u_px[known], rtol=0, atol=1e-9)
    inside = lands_inside(chain, height_px=500, width_px=741)
    assert inside[known].mean() > 0.9
