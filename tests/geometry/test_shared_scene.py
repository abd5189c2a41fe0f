"""Against a scene that nobody of this project rendered: pictures, depth and poses must agree."""

import json
from collections.abc import Callable
from typing import Any, NamedTuple

import av
import numpy as np
import pytest

from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.disparity import disparity_from_depth, disparity_from_units
from stereogenbench_data.geometry.pose import CameraPoses, invert_rigid
from stereogenbench_data.geometry.projection import (
    backward_warp,
    lands_inside,
    project_rectified,
    project_through_poses,
    visible_from_source,
    visible_in_target,
)
from stereogenbench_data.geometry.rig import lateral_offsets_m, rectification_residual_px
from stereogenbench_data.schema.records import Trajectory

SCENE = "train/Pairwise_Uniform/SeyeonjeongPavilion/scene_000003"
QUANTUM_M = 0.001
LATERAL_CM = np.array([0.0, 18.5, 51.5, 61.25, 122.5, 163.0])
ALL_FRAMES, SOME_FRAMES = slice(None), slice(None, None, 8)


class Frames(NamedTuple):
    """A camera's decoded frames."""

    rgb: np.ndarray
    units: np.ndarray

    @property
    def depth_m(self) -> np.ndarray:
        return (self.units * QUANTUM_M).astype(np.float32)

    @property
    def measured(self) -> np.ndarray:
        return (self.units > 0) & (self.units < 65535)


@pytest.fixture(scope="module")
def frames_of(shared_scenes) -> Callable[[int], Frames]:
    """Return one that decodes a camera's frames, once."""
    decoded: dict[int, Frames] = {}

    def frames(camera: int) -> Frames:
        if camera not in decoded:
            folder = shared_scenes / SCENE
            with av.open(folder / f"cam_{camera:02d}_rgb.mp4") as file:
                rgb = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
            with av.open(folder / f"cam_{camera:02d}_depth.mkv") as file:
                units = [frame.to_ndarray() for frame in file.decode(video=0)]
            decoded[camera] = Frames(np.stack(rgb).transpose(0, 3, 1, 2), np.stack(units))
        return decoded[camera]

    return frames


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


class Warped(NamedTuple):
    """The worst frame's PSNR and the worst frame's share of pixels that were kept."""

    psnr_db: float
    kept: float


@pytest.fixture(scope="module")
def warp_pair(frames_of, intrinsics, psnr_db):
    """Return one that warps a pair's right view by disparity and compares where it is visible.

    What is visible is decided by the recorded depth; the warp goes by ``scale`` times the
    disparity.
    """

    def warp(
        left: int, right: int, *, frames: slice = SOME_FRAMES, scale: float = 1.0, judge="target"
    ) -> Warped:
        source, target = frames_of(left), frames_of(right)
        baseline_m = (LATERAL_CM[right] - LATERAL_CM[left]) / 100
        psnrs_db, kept = [], []
        for frame in range(81)[frames]:
            depth_m = source.depth_m[frame]
            disparity_px = disparity_from_units(
                source.units[frame],
                focal_px=intrinsics.fx_px,
                baseline_m=baseline_m,
                unit_m=QUANTUM_M,
            )
            projection = project_rectified(depth_m, disparity_px)
            own: dict[str, Any] = {"measured": source.measured[frame], "quantum_m": QUANTUM_M}
            if judge == "target":
                own |= {
                    "target_depth_m": target.depth_m[frame],
                    "target_measured": target.measured[frame],
                }
            decide = {"target": visible_in_target, "source": visible_from_source}[judge]
            visible = decide(projection, **own)
            warped, inside = backward_warp(
                target.rgb[frame], project_rectified(depth_m, disparity_px * scale)
            )
            psnrs_db.append(psnr_db(warped, source.rgb[frame], visible & inside))
            kept.append(visible.mean())
        return Warped(min(psnrs_db), min(kept))

    return warp


PAIRS = [
    pytest.param(0, 1, 31.78, 0.7046, id="0-1"),
    pytest.param(1, 3, 30.79, 0.6283, id="1-3"),
    pytest.param(0, 5, 29.46, 0.3214, id="0-5"),
]


@pytest.mark.parametrize(("left", "right", "worst_db", "least_kept"), PAIRS)
def test_the_right_view_warped_by_disparity_is_the_left_one(
    warp_pair, left, right, worst_db, least_kept
):
    """The least of all 81 frames of each, as measured elsewhere with other code."""
    warped = warp_pair(left, right, frames=ALL_FRAMES)

    assert warped.psnr_db == pytest.approx(worst_db, abs=0.1)
    assert warped.kept == pytest.approx(least_kept, abs=0.005)


@pytest.mark.parametrize(("left", "right", "loss_db"), [(0, 1, 0.9), (1, 3, 3.5), (0, 5, 9.0)])
@pytest.mark.parametrize("scale", [0.97, 1.03])
def test_a_depth_scale_that_is_wrong_by_3_percent_is_detected(
    warp_pair, left, right, loss_db, scale
):
    wrong = warp_pair(left, right, scale=scale)

    assert wrong.psnr_db < warp_pair(left, right).psnr_db - loss_db


@pytest.mark.parametrize(("left", "right"), [(0, 1), (1, 3), (0, 5)])
def test_the_wrong_sign_is_far_worse(warp_pair, left, right):
    wrong = warp_pair(left, right, scale=-1.0)

    assert wrong.psnr_db < warp_pair(left, right).psnr_db - 10


def test_the_source_view_does_not_know_occluders_outside_it(warp_pair):
    by_source = warp_pair(0, 5, judge="source")

    assert by_source.psnr_db < 16
    assert by_source.kept > warp_pair(0, 5).kept


def test_the_poses_are_those_of_the_recorded_rig(poses, intrinsics):
    np.testing.assert_allclose(lateral_offsets_m(poses), LATERAL_CM / 100, atol=1e-11)
    assert rectification_residual_px(poses, intrinsics) < 1e-5


@pytest.mark.parametrize(("left", "right"), [(0, 1), (1, 3), (0, 5)])
def test_the_pose_chain_is_the_closed_form_on_recorded_poses(
    frames_of, poses, intrinsics, left, right
):
    """To 1e-8 of the disparity: the recorded yaw is rounded to float32, about 1e-8 radians."""
    offsets_m = lateral_offsets_m(poses)
    for frame in range(0, 81, 16):
        depth_m = frames_of(left).units[frame] * QUANTUM_M
        disparity_px = disparity_from_depth(
            depth_m, focal_px=intrinsics.fx_px, baseline_m=offsets_m[right] - offsets_m[left]
        )
        measured = frames_of(left).measured[frame]

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


@pytest.mark.parametrize("frame", [1, 10, 40, 80])
def test_depth_carried_to_another_frame_by_the_poses_is_the_depth_measured_there(
    frames_of, poses, intrinsics, frame
):
    """Of camera 0: where the background is seen again, half of it agrees to a quantum."""
    camera = frames_of(0)
    motion = invert_rigid(poses.world_from_cam(frame, 0)) @ poses.world_from_cam(0, 0)
    cameras = {"intrinsics": intrinsics, "target_intrinsics": intrinsics}
    judged = {
        "measured": camera.measured[0],
        "target_depth_m": camera.depth_m[frame],
        "target_measured": camera.measured[frame],
        "quantum_m": QUANTUM_M,
    }
    depth_m = camera.depth_m[0]

    carried = project_through_poses(depth_m, target_from_source=motion, **cameras)
    stayed = project_through_poses(depth_m, target_from_source=np.eye(4), **cameras)

    seen = visible_in_target(carried, **judged)
    seen_there, _ = backward_warp(camera.depth_m[frame][None], carried)
    assert np.median(np.abs(seen_there[0] - carried.depth_m)[seen]) < QUANTUM_M / 2
    inside = lands_inside(carried, height_px=320, width_px=320)
    assert seen[inside & camera.measured[0]].mean() > (0.95 if frame == 1 else 0.6)
    assert visible_in_target(stayed, **judged).sum() < seen.sum() / 2
