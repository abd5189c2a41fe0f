from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.geometry.rig import lateral_offsets_m, rectification_residual_px

LATERAL_CM = np.array([0.0, 18.5, 51.5, 61.25, 122.5, 163.0])
TURNED = Rotation.from_euler("ZYX", [200.0, 12.0, -7.0], degrees=True).as_matrix()
INTRINSICS = Intrinsics(2694.0, 2694.0, 640.0, 640.0, 1280, 1280)


def with_camera_turned(poses: CameraPoses, camera: int, turn: Rotation) -> CameraPoses:
    rotations = poses.world_from_cam_rotations.copy()
    rotations[-1, camera] = rotations[-1, camera] @ turn.as_matrix()
    return replace(poses, world_from_cam_rotations=rotations)


def with_camera_moved(poses: CameraPoses, camera: int, step_cm) -> CameraPoses:
    centres = poses.centres.copy()
    centres[-1, camera] += step_cm
    return replace(poses, centres=centres)


def test_lateral_offsets_are_where_the_cameras_stand_along_the_rig(make_rig):
    poses = make_rig(LATERAL_CM, rotation=TURNED, offset_cm=(1000, -2000, 300), frames=3)

    np.testing.assert_allclose(lateral_offsets_m(poses), LATERAL_CM / 100, atol=1e-14)


@pytest.mark.parametrize("offset_cm", [(0, 0, 0), (1e6, -1e6, 1e6)])
def test_a_lateral_rig_is_rectified_wherever_it_stands(make_rig, offset_cm):
    poses = make_rig(LATERAL_CM, rotation=TURNED, offset_cm=offset_cm, frames=2)

    assert rectification_residual_px(poses, INTRINSICS) < 1e-6


def test_one_frame_with_a_pitch_error_shows_in_the_residual(make_rig):
    """0.01 degrees of pitch move the image's middle by f tan(0.01 deg) and its corners by more."""
    nod = Rotation.from_euler("x", 0.01, degrees=True)
    poses = with_camera_turned(make_rig(LATERAL_CM, frames=4), 3, nod)

    middle_px = 2694 * np.tan(np.deg2rad(0.01))

    assert middle_px < rectification_residual_px(poses, INTRINSICS) < 1.2 * middle_px


def test_a_camera_beside_the_line_shows_at_the_nearest_depth(make_rig):
    """1 mm up, in a rig so narrow that the nearest depth looked at is 1 m, is f / 1000."""
    poses = with_camera_moved(make_rig(LATERAL_CM / 10, frames=2), 5, (0.0, 0.0, 0.1))

    assert rectification_residual_px(poses, INTRINSICS) == pytest.approx(2.694, rel=1e-6)


def test_a_wide_pair_is_tested_only_at_depths_where_its_images_overlap(make_rig):
    """Camera 5's disparity against camera 0 is the image's width at 1.63 * 2694 / 1280 m."""
    centred = np.array([0.0, 0.01, 0.02, 0.03, 0.04, 163.0])
    poses = with_camera_moved(make_rig(centred, frames=2), 5, (0.0, 0.0, 0.1))

    expected_px = 2.694 / ((1.63 - 0.0004) * 2694 / 1280)

    assert rectification_residual_px(poses, INTRINSICS) == pytest.approx(expected_px, rel=1e-6)


def test_a_baseline_that_changes_over_time_is_not_one_closed_form(make_rig):
    poses = with_camera_moved(make_rig(LATERAL_CM / 10, frames=2), 1, (0.0, 0.1, 0.0))

    assert rectification_residual_px(poses, INTRINSICS) == pytest.approx(2.694, rel=1e-6)


def test_a_camera_that_looks_back_has_no_closed_form_at_all(make_rig):
    poses = with_camera_turned(make_rig(LATERAL_CM), 2, Rotation.from_euler("y", np.pi))

    assert rectification_residual_px(poses, INTRINSICS) == np.inf
