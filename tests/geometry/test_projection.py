from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.projection import (
    homography,
    landing_pixels,
    lands_inside,
    project_by_homography,
    project_rectified,
)

WIDE = Intrinsics(2694.0, 2694.0, 640.0, 640.0, 1280, 1280)


class Case(NamedTuple):
    """A lateral rig that is hard on the pose chain, and what was done to its picture.

    By default the picture is the corner of the release's, where rays are the most oblique.
    """

    baseline_cm: float = 18.5
    rotator_deg: tuple[float, float, float] = (-12.0, 200.0, 7.0)
    offset_cm: tuple[float, float, float] = (1000.0, -2000.0, 300.0)
    target: int = 1
    source: int = 0
    intrinsics: Intrinsics = WIDE.cropped(left_px=0, top_px=0, width_px=80, height_px=80)


CASES = {
    "1 cm baseline, 1e6 cm from the origin": Case(1.0, offset_cm=(1e6, -1e6, 1e6)),
    "looking straight up": Case(rotator_deg=(90.0, 30.0, 20.0)),
    "upside down": Case(rotator_deg=(3.0, -170.0, 180.0)),
    "right to left": Case(target=0, source=1),
    "resized unlike in x and y": Case(intrinsics=WIDE.resized(width_px=52, height_px=30)),
    "cropped off the middle, then flipped": Case(
        intrinsics=WIDE.cropped(left_px=300, top_px=7, width_px=40, height_px=30).flipped()
    ),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_the_pose_chain_is_the_closed_form_on_a_lateral_rig(make_rig, case):
    """u - B f / z, v and z, wherever the points land."""
    pitch, yaw, roll = case.rotator_deg
    rotation = Rotation.from_euler("ZYX", [yaw, -pitch, -roll], degrees=True).as_matrix()
    lateral_cm = [0.0, *(case.baseline_cm + np.arange(5.0))]
    poses = make_rig(lateral_cm, rotation=rotation, offset_cm=case.offset_cm)
    motion = poses.cam_from_cam(0, target=case.target, source=case.source)
    baseline_m = (case.target - case.source) * case.baseline_cm / 100
    camera = case.intrinsics
    depth_m = np.random.default_rng(0).uniform(1.0, 200.0, (camera.height_px, camera.width_px))
    depth_m[0, :3] = 1.0, 6553.4, 1e6

    projection = project_by_homography(depth_m, *homography(camera, camera, motion))

    v_px, u_px = np.mgrid[: camera.height_px, : camera.width_px] + 0.5
    expected_u_px = u_px - camera.fx_px * baseline_m / depth_m
    np.testing.assert_allclose(projection.u_px, expected_u_px, rtol=0, atol=1e-6)
    np.testing.assert_allclose(projection.v_px, v_px, rtol=0, atol=1e-6)
    np.testing.assert_allclose(projection.depth_m, depth_m, rtol=1e-9)


@settings(max_examples=30)
@given(
    turn_deg=st.tuples(*[st.floats(-20, 20)] * 3),
    shift_m=st.tuples(*[st.floats(-0.5, 0.5)] * 3),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_motion_is_that_of_the_points_in_space(library, turn_deg, shift_m, seed):
    """Against points lifted, moved and projected one by one with scipy."""
    source = Intrinsics(30.0, 28.0, 4.5, 2.0, 8, 6)
    target = Intrinsics(25.0, 26.0, 4.0, 3.5, 9, 7)
    rotation = Rotation.from_euler("xyz", turn_deg, degrees=True)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation.as_matrix(), shift_m
    depth_m = np.random.default_rng(seed).uniform(2.0, 50.0, (6, 8))

    moved = map(library.array, homography(source, target, motion))
    projection = project_by_homography(library.array(depth_m), *moved)

    v_px, u_px = np.mgrid[:6, :8] + 0.5
    rays = np.stack([(u_px - 4.5) / 30, (v_px - 2) / 28, np.ones((6, 8))], axis=-1)
    x, y, z = (rotation.apply((rays * depth_m[..., None]).reshape(-1, 3)) + shift_m).T
    np.testing.assert_allclose(library.numpy(projection.depth_m).ravel(), z, rtol=1e-12)
    np.testing.assert_allclose(library.numpy(projection.u_px).ravel(), 25 * x / z + 4, rtol=1e-9)
    np.testing.assert_allclose(library.numpy(projection.v_px).ravel(), 26 * y / z + 3.5, rtol=1e-9)


@pytest.mark.parametrize(
    "depth_m",
    [
        pytest.param(0.0, id="not measured"),
        pytest.param(1.0, id="on the target's plane"),
        pytest.param(0.5, id="behind the target"),
        pytest.param(np.inf, id="sky"),
        pytest.param(np.nan, id="nan"),
    ],
)
def test_a_point_that_the_target_cannot_see_lands_nowhere(library, depth_m):
    """The target stands 1 m in front of the source."""
    intrinsics = Intrinsics(2.0, 2.0, 1.5, 0.5, 3, 1)
    motion = np.eye(4)
    motion[2, 3] = -1.0

    moved = map(library.array, homography(intrinsics, intrinsics, motion))
    projection = project_by_homography(
        library.array(np.full((1, 3), depth_m, dtype=np.float32)), *moved
    )

    assert np.isnan(library.numpy(projection.u_px)).all()
    assert not library.numpy(lands_inside(projection, height_px=1, width_px=3)).any()


@pytest.mark.parametrize(
    ("disparity_px", "column"),
    [
        pytest.param(0.5, 0, id="the image's left edge belongs to column 0"),
        pytest.param(0.5 + 2**-10, None, id="just past the left edge"),
        pytest.param(-2.5 + 2**-10, 2, id="just before the right edge"),
        pytest.param(-2.5, None, id="the right edge is outside"),
        pytest.param(1e30, None, id="far beyond the image's width"),
        pytest.param(np.inf, None, id="infinitely far"),
    ],
)
def test_where_the_leftmost_of_three_pixels_lands(library, disparity_px, column):
    disparity = library.array(np.full((1, 3), disparity_px, dtype=np.float32))
    projection = project_rectified(library.array(np.ones((1, 3), np.float32)), disparity)

    inside, pixel = landing_pixels(projection, height_px=1, width_px=3)

    assert library.numpy(inside)[0, 0] == (column is not None)
    assert column is None or library.numpy(pixel)[0, 0] == column
