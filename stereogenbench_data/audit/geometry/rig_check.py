"""Consistency of what a scene's metadata records of its cameras; no picture is needed.

Intrinsics recorded in pixels are compared with the paper's equation. The release's files record
millimetres; a declaration says where pixels may stand.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from stereogenbench_data.geometry.camera import Intrinsics, rig_intrinsics
from stereogenbench_data.geometry.pose import CameraPoses, rotation_angle_rad
from stereogenbench_data.geometry.rig import rectification_residual_px
from stereogenbench_data.schema.declaration import BUILT_IN, Declaration
from stereogenbench_data.schema.document import is_number
from stereogenbench_data.schema.places import first_value
from stereogenbench_data.schema.records import Rig
from stereogenbench_data.schema.release import CAMERA_PAIRS

_QUANTITIES: Final = {
    "fx_px": "focal_length_px", "fy_px": "focal_length_y_px",
    "cx_px": "principal_x", "cy_px": "principal_y",
}  # fmt: skip
"""The parts of `Intrinsics` and the tables of a declaration that say where they stand in pixels."""


def recorded_px(
    document: dict[str, Any], declared: Declaration = BUILT_IN
) -> Iterator[tuple[str, float]]:
    """Yield the name (of `Intrinsics`) and value of each number in pixels of a ``baseline.json``.

    Args:
        document: The file as parsed JSON.
        declared: Where they stand in it.
    """
    for name, quantity in _QUANTITIES.items():
        at = declared.numbers.get(quantity)
        value = None if at is None else first_value(document, at.places)[1]
        if is_number(value):
            yield name, float(value)


def rig_figures(
    rig: Rig, poses: CameraPoses, recorded: Iterable[tuple[str, float]]
) -> dict[str, float]:
    """Return the figures of a scene's rig, by quantity.

    A recorded baseline agrees with the poses where their difference is within its own rounding.

    Args:
        rig: What ``baseline.json`` records.
        poses: What ``trajectory.json`` records, over all frames.
        recorded: The intrinsics in pixels that ``baseline.json`` records, too, by their names.

    Source: the StereoGenBench paper, fx = f_mm / sensor_width_mm * width_px, and its table of the
    geometry consistency audit.
    """
    intrinsics = rig_intrinsics(rig)
    fx_px = rig.focal_mm / rig.sensor_width_mm * rig.image_width_px
    fy_px = rig.focal_mm / rig.sensor_height_mm * rig.image_height_px
    expected = replace(intrinsics, fx_px=fx_px, fy_px=fy_px)
    deviations = [abs(intrinsics.fx_px - fx_px), abs(intrinsics.fy_px - fy_px)]
    deviations += [abs(value - getattr(expected, name)) for name, value in recorded]
    left, right = (list(cameras) for cameras in zip(*CAMERA_PAIRS, strict=True))
    posed_cm = np.linalg.norm(poses.centres[:, right] - poses.centres[:, left], axis=-1)
    away_cm = np.abs(posed_cm * (poses.unit_m * 100) - np.array(rig.baselines_cm))
    away_cm[away_cm <= _rounding_cm(rig.baselines_cm) + 1e-9] = 0.0
    rotations = poses.world_from_cam_rotations
    in_one_place = replace(poses, centres=np.zeros_like(poses.centres))
    looking_alike = replace(
        poses, world_from_cam_rotations=np.repeat(rotations[:, :1], rotations.shape[1], axis=1)
    )
    return {
        "intrinsics_px": float(max(deviations)),
        "baseline_cm": float(away_cm.max()),
        "rotation_px": rectification_residual_px(in_one_place, intrinsics),
        "lateral_px": rectification_residual_px(looking_alike, intrinsics),
    }


def _rounding_cm(baselines_cm: Sequence[float]) -> float:
    """Return half of the last decimal of baselines in centimetres, if that is one of 2 to 5."""
    for decimals in range(2, 6):
        if np.allclose(np.round(baselines_cm, decimals), baselines_cm, rtol=0, atol=1e-9):
            return float(0.5 * 10.0**-decimals)
    return 0.0


def motion_px(
    poses: CameraPoses,
    camera: int,
    frames: tuple[int, int],
    *,
    intrinsics: Intrinsics,
    far_m: float,
) -> float:
    """Return about how far a camera's motion between frames moves the middle of its picture.

    Rotation and translation count in full, as if both were across the line of sight.

    Args:
        poses: All cameras' poses.
        camera: The camera.
        frames: Two frames.
        intrinsics: The picture's intrinsics.
        far_m: The distance of its subject; nan to leave out the translation.
    """
    first, second = frames
    turned_rad = rotation_angle_rad(
        poses.world_from_cam_rotations[first, camera],
        poses.world_from_cam_rotations[second, camera],
    )
    way = np.linalg.norm(poses.centres[second, camera] - poses.centres[first, camera])
    shift = 0.0 if math.isnan(far_m) else float(way) * poses.unit_m / far_m
    return intrinsics.fx_px * (float(turned_rad) + shift)
