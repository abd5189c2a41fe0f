"""Consistency of what a scene's metadata records of its cameras; no picture is needed.

Intrinsics recorded in pixels are compared with the paper's equation. The release's files record
millimetres. Pixels, of the rig, a camera or a frame, are found by name at any depth of the
document: ``fx``, ``fy``, ``cx``, ``cy`` and their longer spellings, and 3x3 camera matrices.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Final

import numpy as np

from stereogenbench_data.audit.audit_records import RigAudit
from stereogenbench_data.geometry.camera import Intrinsics, rig_intrinsics
from stereogenbench_data.geometry.pose import CameraPoses, rotation_angle_rad
from stereogenbench_data.geometry.rig import rectification_residual_px
from stereogenbench_data.schema.records import Rig
from stereogenbench_data.schema.release import ADJACENT_PAIRS, CAMERA_PAIRS

_NAMES: Final = {
    "fx_px": re.compile(r"(fx|f_x|focal(_length)?_(x|px)|focal(_length)?_x_px|fx_px)"),
    "fy_px": re.compile(r"(fy|f_y|focal(_length)?_y|focal(_length)?_y_px|fy_px)"),
    "cx_px": re.compile(r"(cx|c_x|principal(_point)?_x|principal(_point)?_x_px|cx_px)"),
    "cy_px": re.compile(r"(cy|c_y|principal(_point)?_y|principal(_point)?_y_px|cy_px)"),
}
_MATRIX: Final = re.compile(r"(k|k_matrix|camera_matrix|intrinsics?(_matrix)?|k_px)")
_PLACES: Final = {"fx_px": (0, 0), "fy_px": (1, 1), "cx_px": (0, 2), "cy_px": (1, 2)}


def recorded_px(node: Any) -> Iterator[tuple[str, float]]:
    """Yield the name (of `Intrinsics`) and value of each number in pixels, at any depth."""
    if isinstance(node, list):
        for each in node:
            if isinstance(each, dict | list):
                yield from recorded_px(each)
        return
    if not isinstance(node, dict):
        return
    for key, value in node.items():
        spelled = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", str(key)).lower()
        if isinstance(value, int | float) and not isinstance(value, bool):
            yield from (
                (name, float(value)) for name, spelling in _NAMES.items()
                if spelling.fullmatch(spelled)
            )  # fmt: skip
        elif _MATRIX.fullmatch(spelled) and (matrix := _matrix(value)) is not None:
            yield from ((name, float(matrix[place])) for name, place in _PLACES.items())
        elif isinstance(value, dict | list):
            yield from recorded_px(value)


def _matrix(value: Any) -> Any:
    """Return a value as a 3x3 array of numbers, None if it is not one."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return matrix if matrix.shape == (3, 3) else None


def rig_audit(rig: Rig, poses: CameraPoses, documents: list[dict[str, Any]]) -> RigAudit:
    """Return the figures of a scene's rig.

    Args:
        rig: What ``baseline.json`` records.
        poses: What ``trajectory.json`` records, over all frames.
        documents: Both files as parsed JSON, to search for intrinsics in pixels.

    Source: the StereoGenBench paper, fx = f_mm / sensor_width_mm * width_px, and its table of the
    geometry consistency audit.
    """
    intrinsics = rig_intrinsics(rig)
    fx_px = rig.focal_mm / rig.sensor_width_mm * rig.image_width_px
    fy_px = rig.focal_mm / rig.sensor_height_mm * rig.image_height_px
    expected = replace(intrinsics, fx_px=fx_px, fy_px=fy_px)
    recorded = [
        abs(value - getattr(expected, name))
        for document in documents
        for name, value in recorded_px(document)
    ]
    deviations = [abs(intrinsics.fx_px - fx_px), abs(intrinsics.fy_px - fy_px), *recorded]
    left, right = (list(cameras) for cameras in zip(*CAMERA_PAIRS, strict=True))
    posed_cm = np.linalg.norm(poses.centres[:, right] - poses.centres[:, left], axis=-1)
    away_cm = np.abs(posed_cm * (poses.unit_m * 100) - np.array(rig.baselines_cm))
    adjacent_cm = away_cm[:, [CAMERA_PAIRS.index(pair) for pair in ADJACENT_PAIRS]]
    rotations = poses.world_from_cam_rotations
    in_one_place = replace(poses, centres=np.zeros_like(poses.centres))
    looking_alike = replace(
        poses, world_from_cam_rotations=np.repeat(rotations[:, :1], rotations.shape[1], axis=1)
    )
    turned_rad = rotation_angle_rad(rotations, np.broadcast_to(rotations[:, :1], rotations.shape))
    return RigAudit(
        fx_px=fx_px,
        fy_px=fy_px,
        intrinsics_px=float(max(deviations)),
        intrinsics_recorded=len(recorded),
        adjacent_mean_cm=float(adjacent_cm.mean()),
        adjacent_max_cm=float(adjacent_cm.max()),
        pairs_mean_cm=float(away_cm.mean()),
        pairs_max_cm=float(away_cm.max()),
        rotation_deg=float(np.rad2deg(turned_rad).max()),
        rotation_px=rectification_residual_px(in_one_place, intrinsics),
        lateral_px=rectification_residual_px(looking_alike, intrinsics),
    )


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
