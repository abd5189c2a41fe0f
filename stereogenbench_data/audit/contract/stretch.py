"""Whether depth is right along the optical axis, too: pictures from the side do not show it.

A scene that is stretched along the axis, its lens with it, has the disparities of the right one: a
unit of depth and a focal length (or a sensor's width) that are wrong by one factor cancel out. A
camera that turns or advances shows the factor. By its poses, which are in metres, a point of one
frame lands where the depth of another frame says only without it.
"""

import math
from dataclasses import replace
from itertools import chain
from typing import Final

import numpy as np
from jaxtyping import Float, Float64

from stereogenbench_data.audit.contract.row_matches import SceneFrames
from stereogenbench_data.audit.geometry.reprojection import moved_points
from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.disparity import planar_from_ray
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.geometry.projection import Projection, landing_pixels
from stereogenbench_data.schema.release import CAMERA_COUNT

_STEP: Final = 0.025
_FACTORS: Final = np.exp(_STEP * np.arange(-28, 29))
"""The factors that are tried: half to twice what is recorded."""
STRETCH_MARGIN: Final = 0.1
"""A smaller logarithm of the factor is not called wrong."""
_BESIDE: Final = 8
_LEAST_RISE: Final = 1.2
"""How much larger the error must be by a fifth beside the best factor, for a clip that tells."""
_CAMERAS: Final = (0, CAMERA_COUNT - 1)
_PARTS: Final = (4, 2)
_ACROSS: Final = 100
"""How many points of a picture's side are moved."""
_FEWEST: Final = 200


def stretch_of(views: SceneFrames, poses: CameraPoses) -> float:
    """Return by what factor unit and focal length explain the depth of other frames best.

    Two cameras must say the same. It is nan where they do not, or where any factor fits alike, as
    with cameras that stand still or only move sideways.

    Args:
        views: A scene, whose contract says how depth is read.
        poses: Its poses.

    Raises:
        MediaError: If depth cannot be decoded.
    """
    steps = [_best(_errors(views, poses, camera)) for camera in _CAMERAS]
    is_one = max(steps) - min(steps) <= _BESIDE / 2
    return float(np.exp(_STEP * np.mean(steps))) if is_one else math.nan


def _best(errors: Float64[np.ndarray, " factors"]) -> float:
    """Return how many steps from 1 the best factor is, nan where the errors do not tell."""
    place = int(np.argmin(errors))
    if not _BESIDE <= place < len(errors) - _BESIDE:
        return math.nan
    beside = min(errors[place - _BESIDE], errors[place + _BESIDE])
    tells = math.isfinite(errors[place]) and beside > _LEAST_RISE * errors[place]
    return float(place - len(errors) // 2) if tells else math.nan


def _errors(views: SceneFrames, poses: CameraPoses, camera: int) -> Float64[np.ndarray, " factors"]:
    """Return for each factor the median by which depth of one frame is off in another."""
    moves = views.frame_moves(_PARTS)
    lengths = {  # of rays, where depth is along them
        frame: views.measured_depth(frame, camera, kind="planar").depth_m
        for frame in sorted({*chain(*moves)})
    }
    motions = [poses.later_from_cam(*move, camera=camera) for move in moves]
    errors = []
    for factor in _FACTORS:
        fx_px, fy_px = (factor * each for each in (views.intrinsics.fx_px, views.intrinsics.fy_px))
        stretched = replace(views.intrinsics, fx_px=fx_px, fy_px=fy_px)
        depths_m = {frame: factor * length_m for frame, length_m in lengths.items()}
        if views.encoding.kind == "ray":
            depths_m = {at: planar_from_ray(each, stretched) for at, each in depths_m.items()}
        off = [
            _off(depths_m[first], depths_m[later], stretched, motion)
            for (first, later), motion in zip(moves, motions, strict=True)
        ]
        both = np.concatenate([np.empty(0), *off])
        errors.append(float(np.median(both)) if len(both) >= _FEWEST else math.inf)
    return np.array(errors)


def _off(
    here_m: Float[np.ndarray, "h w"],
    there_m: Float[np.ndarray, "h w"],
    camera: Intrinsics,
    motion: Float64[np.ndarray, "4 4"],
) -> Float64[np.ndarray, " n"]:
    """Return by how much the logarithm of depth is off where points of a frame land in another."""
    height, width = here_m.shape
    step = max(1, math.ceil(min(height, width) / _ACROSS))
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    depth_m = here_m[rows, columns]
    u_px, v_px, expected_m = moved_points(columns + 0.5, rows + 0.5, depth_m, camera, motion)
    landed = Projection(u_px=u_px, v_px=v_px, depth_m=expected_m)
    inside, pixel = landing_pixels(landed, height_px=height, width_px=width)
    found_m = there_m.ravel()[pixel]
    both = inside & (depth_m > 0) & (found_m > 0)
    return np.asarray(np.abs(np.log(expected_m[both] / found_m[both])))
