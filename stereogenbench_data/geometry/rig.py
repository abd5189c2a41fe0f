"""The deviation of a lateral rig's recorded poses from the rectified rig of the closed form.

Camera axes are x right, y down, z forward, in metres; pixels as in `camera`. In a rectified rig
all cameras have the same orientation and lie on camera 0's x axis. So a point at depth z moves from
u to u - B fx / z, and no row changes.
"""

import itertools
from typing import Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.pose import OPENCV_FROM_UNREAL, CameraPoses
from stereogenbench_data.schema.release import CAMERA_PAIRS

RECTIFIED_PX: Final = 0.05
"""A rig whose residual is at most this is rectified: disparity is B fx / z. Beyond it every pixel
goes through the poses."""

_LEFT, _RIGHT = (list(cameras) for cameras in zip(*CAMERA_PAIRS, strict=True))


def lateral_offsets_m(poses: CameraPoses) -> Float64[np.ndarray, "6"]:
    """Return the distance of each camera to the right of camera 0 in frame 0, in metres.

    The signed baseline of a pair is the target's offset minus the source's.
    """
    right_axis = poses.world_from_cam_rotations[0, 0, :, 0]
    steps = (poses.centres[0] - poses.centres[0, 0]) @ OPENCV_FROM_UNREAL.T
    return np.asarray(steps @ right_axis * poses.unit_m)


def rectification_residual_px(poses: CameraPoses, intrinsics: Intrinsics) -> float:
    """Return the largest distance in pixels between the closed form and the pose chain.

    Both map points of the left camera's image to the right camera's image, for all frames and all
    15 pairs. The points are the image's four corners and its centre, each at infinity and at the
    nearest relevant depth: 1 m or, for a wide pair, the depth where disparity is the image's width.
    Rotation errors show at every depth, position errors mostly at the nearest. The closed form is
    (u - B fx / z, v), where B is the difference of `lateral_offsets_m`, one number per pair for all
    frames. The result is inf where a point lies on or behind the right camera's plane.
    """
    width_px, height_px = float(intrinsics.width_px), float(intrinsics.height_px)
    corners = itertools.product((0.0, width_px), (0.0, height_px))
    pixels = np.array([(u, v, 1.0) for u, v in [*corners, (width_px / 2, height_px / 2)]])
    offsets_m = lateral_offsets_m(poses)
    shift_px_m = intrinsics.fx_px * (offsets_m[_RIGHT] - offsets_m[_LEFT])
    nearest_m = np.maximum(1.0, np.abs(shift_px_m) / width_px)

    # K R K^-1 and K t of right_from_left, (frames, 15, 3, 3) and (frames, 15, 3).
    camera_matrix, rotations = intrinsics.matrix(), poses.world_from_cam_rotations
    image_from_world = camera_matrix @ np.swapaxes(rotations[:, _RIGHT], -1, -2)
    far = image_from_world @ rotations[:, _LEFT] @ np.linalg.inv(camera_matrix)
    steps = (poses.centres[:, _LEFT] - poses.centres[:, _RIGHT]) @ OPENCV_FROM_UNREAL.T
    step = (image_from_world @ steps[..., None])[..., 0] * poses.unit_m
    landed_far = pixels @ np.swapaxes(far, -1, -2)
    landed_near = landed_far + (step / nearest_m[:, None])[..., None, :]
    expected_near = pixels - np.outer(shift_px_m / nearest_m, (1.0, 0.0, 0.0))[:, None, :]
    largest_px = 0.0
    for landed, expected in ((landed_far, pixels), (landed_near, expected_near)):
        if not (landed[..., 2] > 0).all():
            return float("inf")
        away_px = landed[..., :2] / landed[..., 2:] - expected[..., :2]
        largest_px = max(largest_px, float(np.linalg.norm(away_px, axis=-1).max()))
    return largest_px
