"""Against a scene that nobody of this project rendered: pictures, depth and poses must agree."""

import json

import av
import numpy as np
import pytest

from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.disparity import disparity_from_depth
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.geometry.projection import (
    project_rectified,
    project_through_poses,
)
from stereogenbench_data.geometry.rig import lateral_offsets_m, rectification_residual_px
from stereogenbench_data.schema.records import Trajectory

SCENE = "train/Pairwise_Uniform/SeyeonjeongPavilion/scene_000003"
QUANTUM_M = 0.001
LATERAL_CM = np.array([0.0, 18.5, 51.5, 61.25, 122.5, 163.0])


@pytest.fixture(scope="module")
def poses(shared_scenes) -> CameraPoses:
    recorded = json.loads((shared_scenes / SCENE / "trajectory.json").read_text())

    def numbers(name: str, keys: tuple[str, ...]) -> np.ndarray:
        return np.array(
            [[[c[name][k] for k in keys] for c in f["cameras"]] for f in recorded["frames"]]
        )

    return CameraPoses.from_trajectory(
        Trajectory(
            locations=numbers("location", ("x", "y", "z")),
            unit_m=0.01,
            rotations=numbers("rotation", ("pitch", "yaw", "roll")),
            rotation_kind="rotator_deg",
        )
    )


@pytest.fixture(scope="module")
def intrinsics() -> Intrinsics:
    return Intrinsics.from_mm(focal_mm=45.0, sensor_mm=(23.76, 23.76), size_px=(320, 320))


def test_the_poses_are_those_of_the_recorded_rig(poses, intrinsics):
    np.testing.assert_allclose(lateral_offsets_m(poses), LATERAL_CM / 100, atol=1e-11)
    assert rectification_residual_px(poses, intrinsics) < 1e-5


@pytest.mark.parametrize(("left", "right"), [(0, 1), (1, 3), (0, 5)])
def test_the_pose_chain_is_the_closed_form_on_recorded_poses(
    shared_scenes, poses, intrinsics, left, right
):
    """To 1e-8 of the disparity: the recorded yaw is rounded to float32, about 1e-8 radians."""
    offsets_m = lateral_offsets_m(poses)
    with av.open(shared_scenes / SCENE / f"cam_{left:02d}_depth.mkv") as file:
        units = [frame.to_ndarray() for frame in file.decode(video=0)]
    for frame in range(0, 81, 16):
        depth_m = units[frame] * QUANTUM_M
        disparity_px = disparity_from_depth(
            depth_m, focal_px=intrinsics.fx_px, baseline_m=offsets_m[right] - offsets_m[left]
        )
        measured = (units[frame] > 0) & (units[frame] < 65535)

        chain = project_through_poses(
            depth_m,
            intrinsics=intrinsics,
            target_intrinsics=intrinsics,
            target_from_source=poses.cam_from_cam(frame, target=right, source=left),
        )

        closed = project_rectified(depth_m, disparity_px)
        bound_px = np.maximum(1e-6, disparity_px[measured] * 1e-8)
        assert (np.abs(chain.u_px - closed.u_px)[measured] < bound_px).all()
        v_px = np.broadcast_to(np.arange(320)[:, None] + 0.5, (320, 320))
        np.testing.assert_allclose(chain.v_px[measured], v_px[measured], rtol=0, atol=1e-6)
