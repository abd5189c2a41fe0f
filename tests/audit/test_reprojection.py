"""The reprojection error against numbers worked out by hand."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereogenbench_data.audit.geometry.records import QUANTILES
from stereogenbench_data.audit.geometry.reprojection import (
    MeasuredDepth,
    pair_audit,
    reproject,
)
from stereogenbench_data.geometry.camera import Intrinsics

FX = 100.0
CAMERA = Intrinsics(FX, FX, 40.0, 30.0, 80, 60)


def constant(depth_m, *, step_m=0.001, form="depth"):
    return MeasuredDepth(np.full((60, 80), depth_m), np.ones((60, 80), bool), step_m, form)


def beside(baseline_m, *, turn=None):
    motion = np.eye(4)
    motion[0, 3] = -baseline_m
    if turn is not None:
        motion[:3, :3] = turn.as_matrix()
    return motion


def compared(left, right, motion):
    return reproject(left, right, intrinsics=CAMERA, right_from_left=motion)


def test_two_cameras_that_see_one_plane_have_no_error_at_any_tolerance():
    found = compared(constant(2.0), constant(2.0), beside(0.1))

    # 0.1 m at 2 m is 5 px: five of 80 columns leave the picture.
    assert found.comparable == 60 * 75
    assert [errors.size for errors in found.errors_px] == [60 * 75] * 4
    assert max(errors.max() for errors in found.errors_px) < 1e-12
    assert found.unhidden == found.agreeing == 60 * 75


@pytest.mark.parametrize(
    ("away_m", "kept"),
    [
        pytest.param(0.0004, 4, id="less than half a step"),
        pytest.param(0.0015, 3, id="within two steps"),
        pytest.param(0.0118, 2, id="within half a per cent and two steps"),
        pytest.param(0.0415, 1, id="within two per cent and two steps"),
        pytest.param(0.0425, 0, id="beyond all"),
    ],
)
def test_a_right_depth_that_is_off_gives_the_disparity_it_is_off_by(away_m, kept):
    found = compared(constant(2.0), constant(2.0 + away_m), beside(0.1))

    expected_px = 0.1 * FX * (1 / 2.0 - 1 / (2.0 + away_m))
    assert [errors.size > 0 for errors in found.errors_px] == [False] * (4 - kept) + [True] * kept
    for errors in found.errors_px[4 - kept :]:
        np.testing.assert_allclose(errors, expected_px, rtol=1e-9)
    assert found.agreeing == (found.unhidden if kept else 0)


def test_pixels_behind_something_near_are_not_counted():
    left, right = constant(4.0), constant(4.0)
    # A box of 20 columns at 1 m: 10 px of disparity, where the wall has 2.5 px.
    left.depth_m[:, 40:60] = 1.0
    right.depth_m[:, 30:50] = 1.0

    found = compared(left, right, beside(0.1))

    # Wall pixels 32.5 .. 52.5 land behind the box: of those the left sees 33 .. 39.
    hidden = 60 * 7
    assert found.comparable - found.errors_px[-1].size == pytest.approx(hidden, abs=60)
    assert found.errors_px[-1].max() < 1e-12
    assert found.agreeing == found.unhidden


def test_what_was_not_measured_is_not_compared():
    left, right = constant(2.0), constant(2.0)
    left.measured[:30] = False
    left.depth_m[:30] = 0.0
    right.measured[:, :20] = False

    found = compared(left, right, beside(0.1))

    assert found.comparable == 30 * 55


def test_a_turned_camera_gives_the_error_that_its_rotation_makes():
    turn = Rotation.from_euler("xyz", (3.0, 2.0, -5.0), degrees=True)
    motion = beside(0.1, turn=turn)
    left = constant(2.0)
    left.measured[:], left.measured[20, 60] = False, True
    moved = turn.apply(np.array([60.5 - 40.0, 20.5 - 30.0, FX]) / FX * 2.0) + motion[:3, 3]
    right = constant(moved[2] * 1.01)
    back = turn.inv().apply(moved * 1.01 - motion[:3, 3])
    expected_px = np.hypot(*(FX * back[:2] / back[2] + [40.0 - 60.5, 30.0 - 20.5]))

    found = compared(left, right, motion)

    assert [errors.size for errors in found.errors_px] == [0, 0, 0, 1]
    np.testing.assert_allclose(found.errors_px[-1], expected_px, rtol=1e-9)


def test_the_figures_of_a_pair_are_those_of_all_its_frames():
    found = [
        compared(constant(2.0), constant(2.0 + away_m), beside(0.1)) for away_m in (0.0, 0.001)
    ]

    audit, nothing = pair_audit(found), pair_audit([])

    assert (audit.comparable, audit.kept[0], audit.kept[-1]) == (9000, 4500, 9000)
    p95 = QUANTILES.index(0.95)
    assert audit.errors_px[0][p95] < 1e-12
    assert audit.errors_px[-1][p95] == pytest.approx(10 * (1 / 2 - 1 / 2.001), rel=1e-6)
    assert math.isnan(nothing.median_px(0))
