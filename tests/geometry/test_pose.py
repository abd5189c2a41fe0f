import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stereogenbench_data.geometry.pose import (
    OPENCV_FROM_UNREAL,
    invert_rigid,
    nearest_rotation,
    rotation_angle_rad,
    rotation_from_quaternion_xyzw,
    rotation_from_rotator_deg,
)
from stereogenbench_data.schema.release import CAMERA_PAIRS

degrees = st.one_of(st.floats(-360, 360), st.sampled_from([-180.0, -90.0, 0.0, 90.0, 180.0]))
rotators_deg = st.tuples(degrees, degrees, degrees)
offsets_cm = st.tuples(*[st.floats(-1e6, 1e6)] * 3)
gaps_cm = st.lists(st.floats(1.0, 150.0), min_size=5, max_size=5)


def scipy_rotation(pitch_deg, yaw_deg, roll_deg):
    return Rotation.from_euler("ZYX", [yaw_deg, -pitch_deg, -roll_deg], degrees=True)


@given(rotator_deg=rotators_deg)
def test_a_rotator_is_yaw_then_negative_pitch_then_negative_roll(rotator_deg):
    matrix = rotation_from_rotator_deg(np.array(rotator_deg))

    np.testing.assert_allclose(matrix, scipy_rotation(*rotator_deg).as_matrix(), atol=3e-15)


@pytest.mark.parametrize(
    ("rotator_deg", "forward", "right", "up"),
    [
        pytest.param((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), id="unturned"),
        pytest.param((0, 90, 0), (0, 1, 0), (-1, 0, 0), (0, 0, 1), id="yaw turns right"),
        pytest.param((90, 0, 0), (0, 0, 1), (0, 1, 0), (-1, 0, 0), id="pitch +90 looks up"),
        pytest.param((-90, 0, 0), (0, 0, -1), (0, 1, 0), (1, 0, 0), id="pitch -90 looks down"),
        pytest.param((0, 0, 90), (1, 0, 0), (0, 0, -1), (0, 1, 0), id="roll tilts clockwise"),
    ],
)
def test_where_a_rotated_cameras_axes_point(rotator_deg, forward, right, up):
    matrix = rotation_from_rotator_deg(np.array(rotator_deg, dtype=np.float64))

    np.testing.assert_allclose(matrix, np.column_stack([forward, right, up]), atol=1e-15)


@given(
    rotator_deg=rotators_deg, length=st.floats(1 - 1e-3, 1 + 1e-3), sign=st.sampled_from([-1, 1])
)
def test_a_quaternion_a_little_too_long_is_still_the_same_rotation(rotator_deg, length, sign):
    rotation = scipy_rotation(*rotator_deg)

    matrix = rotation_from_quaternion_xyzw(sign * length * rotation.as_quat())

    np.testing.assert_allclose(matrix, rotation.as_matrix(), atol=3e-15)


@given(rotator_deg=rotators_deg, seed=st.integers(0, 2**32 - 1))
def test_a_rounded_matrix_is_replaced_by_the_nearest_rotation(rotator_deg, seed):
    exact = scipy_rotation(*rotator_deg).as_matrix()
    rounded = exact + np.random.default_rng(seed).uniform(-1e-6, 1e-6, (3, 3))

    matrix = nearest_rotation(rounded)

    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)
    assert rotation_angle_rad(matrix, exact) < 3e-6


def test_rotations_between_unreals_axes_become_those_between_opencvs(make_rig):
    rotation = scipy_rotation(-12.0, 200.0, 7.0).as_matrix()

    poses = make_rig(np.arange(6.0), rotation=rotation, frames=2)

    expected = OPENCV_FROM_UNREAL @ rotation @ OPENCV_FROM_UNREAL.T
    assert poses.frame_count == 2
    assert poses.world_from_cam_rotations.shape == (2, 6, 3, 3)
    np.testing.assert_allclose(poses.world_from_cam_rotations[1, 5], expected, atol=3e-15)


def test_a_camera_to_the_right_sees_the_world_moved_left(make_rig):
    poses = make_rig([0, 50, 60, 70, 80, 90])

    right_from_left = poses.cam_from_cam(0, target=1, source=0)

    np.testing.assert_array_equal(right_from_left[:3, :3], np.eye(3))
    np.testing.assert_allclose(right_from_left[:3, 3], [-0.5, 0.0, 0.0], atol=1e-15)
    np.testing.assert_array_equal(right_from_left[3], [0.0, 0.0, 0.0, 1.0])


def test_the_world_has_x_right_y_down_and_z_forward_of_an_unturned_camera(make_rig):
    """Unreal's 300 cm forward, 100 cm right and 200 cm up are (1, -2, 3) metres."""
    poses = make_rig(np.zeros(6), offset_cm=(300, 100, 200))

    np.testing.assert_allclose(poses.world_from_cam(0, 0)[:3, 3], [1.0, -2.0, 3.0], atol=1e-15)
    np.testing.assert_array_equal(poses.world_from_cam(0, 0)[:3, :3], np.eye(3))


@given(rotator_deg=rotators_deg, offset_cm=offsets_cm, gaps=gaps_cm)
def test_pose_baselines_are_the_recorded_ones_anywhere(make_rig, rotator_deg, offset_cm, gaps):
    lateral_cm = np.concatenate([[0.0], np.cumsum(gaps)])
    rotation = scipy_rotation(*rotator_deg).as_matrix()

    poses = make_rig(lateral_cm, rotation=rotation, offset_cm=offset_cm)

    for a, b in CAMERA_PAIRS:
        baseline_cm = lateral_cm[b] - lateral_cm[a]
        moved_m = np.linalg.norm(poses.cam_from_cam(0, target=b, source=a)[:3, 3])
        assert poses.baseline_m(0, a, b) * 100 == pytest.approx(baseline_cm, rel=0, abs=1e-9)
        assert moved_m == pytest.approx(poses.baseline_m(0, a, b), rel=1e-13)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 0.3, np.pi / 2, np.pi])
def test_the_angle_between_rotations_is_exact_even_where_a_cosine_would_round_it_away(angle_rad):
    turned = Rotation.from_rotvec(np.array([2.0, -1.0, 2.0]) / 3 * angle_rad).as_matrix()

    assert rotation_angle_rad(np.eye(3), turned) == pytest.approx(angle_rad, rel=1e-7, abs=1e-15)


@given(rotator_deg=rotators_deg, shift=st.tuples(*[st.floats(-100, 100)] * 3))
def test_an_inverted_motion_undoes_it(rotator_deg, shift):
    motion = np.eye(4)
    motion[:3, :3] = scipy_rotation(*rotator_deg).as_matrix()
    motion[:3, 3] = shift

    np.testing.assert_allclose(invert_rigid(motion), np.linalg.inv(motion), atol=1e-12)
