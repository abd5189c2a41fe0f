"""The metadata files of a synthetic scene, in the release's layout.

Source: the StereoGenBench paper's appendix on the file schema. Keys that it does not spell are
those of a scene in this layout that was rendered elsewhere.
"""

import json
from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.geometry.pose import rotation_from_rotator_deg
from stereogenbench_data.schema.release import (
    ADJACENT_PAIRS,
    BASELINE_JSON,
    CAMERA_COUNT,
    CAMERA_PAIRS,
    COMPLETE_JSON,
    DESCRIPTION_JSON,
    DESCRIPTION_TXT,
    TRAJECTORY_JSON,
)
from stereogenbench_data.synthesis.cameras import quaternion_from_rotator
from stereogenbench_data.synthesis.plan import ScenePlan
from stereogenbench_data.synthesis.request import ExportContract

_REPRESENTATIONS: Final = {
    "rotator": "unreal_rotator_degrees",
    "quaternion_xyzw": "quaternion_xyzw",
    "quaternion_wxyz": "quaternion_wxyz",
    "matrix": "matrix_3x3",
}


def completion_text(plan: ScenePlan) -> str:
    """Return the completion marker. It records the request, so that a later run can compare it."""
    request = plan.request
    marker = _labels(plan) | {
        "map_path": f"/Game/{request.map_name}/Maps/{request.map_name}",
        "synthesis": {
            "seed": request.seed,
            "frames": request.frames,
            "picture_px": request.picture_px,
            "focal_mm": plan.focal_mm,
            "contract": repr(request.contract),
        },
    }
    return _json(marker)


def metadata_texts(plan: ScenePlan) -> dict[str, str]:
    """Return the text of every metadata file by name, with the completion marker last."""
    description = _description(plan)
    return {
        BASELINE_JSON: _json(_baseline(plan)),
        TRAJECTORY_JSON: _json(_trajectory(plan)),
        DESCRIPTION_JSON: _json(description),
        DESCRIPTION_TXT: description["detailed_caption"],
        COMPLETE_JSON: completion_text(plan),
    }


def _json(value: dict[str, Any]) -> str:
    return json.dumps(value, indent=2)


def _labels(plan: ScenePlan) -> dict[str, Any]:
    return {
        "scene_label": plan.label,
        "scene_index": plan.label_number,
        "map_name": plan.request.map_name,
    }


def _camera_name(plan: ScenePlan, *, camera: int) -> str:
    return f"{plan.label}_Cam_{camera:02d}"


def _primary_pair(plan: ScenePlan) -> dict[str, str] | list[int]:
    contract = plan.request.contract
    left, right = contract.primary_pair
    if contract.pair_form == "indices":
        return [left, right]
    return {
        "left_camera": _camera_name(plan, camera=left),
        "right_camera": _camera_name(plan, camera=right),
    }


def _baseline(plan: ScenePlan) -> dict[str, Any]:
    width_px, height_px = plan.request.picture_px
    contract = plan.request.contract
    intrinsics: dict[str, Any] = {
        "focal_length_mm": plan.focal_mm,
        "sensor_width_mm": contract.sensor_mm[0],
        "sensor_height_mm": contract.sensor_mm[1],
    }
    if contract.principal_point_px is not None:
        x_px, y_px = contract.principal_point_px
        intrinsics["principal_point_px"] = {"x": x_px, "y": y_px}
    return _labels(plan) | {
        "unit": "cm",
        "camera_count": CAMERA_COUNT,
        "image_width": width_px,
        "image_height": height_px,
        "camera_intrinsics": intrinsics,
        "primary_stereo_pair": _primary_pair(plan),
        "adjacent_pairs": [_pair(plan, left=left, right=right) for left, right in ADJACENT_PAIRS],
        "pairwise_pairs": [_pair(plan, left=left, right=right) for left, right in CAMERA_PAIRS],
        "character_mesh": plan.character,
        "animation": "AN_Walk",
    }


def _pair(plan: ScenePlan, *, left: int, right: int) -> dict[str, Any]:
    return {
        "camera_index_a": left,
        "camera_index_b": right,
        "baseline_cm": float(plan.places_cm[right] - plan.places_cm[left]),
    }


def _trajectory(plan: ScenePlan) -> dict[str, Any]:
    return _labels(plan) | {
        "character_id": plan.character,
        "unit": "cm",
        "rotation_representation": _REPRESENTATIONS[plan.request.contract.rotation],
        "camera_count": CAMERA_COUNT,
        "primary_stereo_pair": _primary_pair(plan),
        "camera_order": [_camera_name(plan, camera=camera) for camera in range(CAMERA_COUNT)],
        "frames": [
            {"frame_index": frame, "cameras": _poses(plan, frame=frame)}
            for frame in range(plan.request.frames)
        ],
    }


def _poses(plan: ScenePlan, *, frame: int) -> list[dict[str, Any]]:
    rotation = _rotation(plan.world_rotator_deg(frame), contract=plan.request.contract)
    return [
        {
            "camera_name": _camera_name(plan, camera=camera),
            "camera_index": camera,
            "location": dict(zip("xyz", location_cm.tolist(), strict=True)),
            "rotation": rotation,
        }
        for camera, location_cm in enumerate(plan.world_locations_cm(frame))
    ]


def _rotation(
    rotator_deg: Float64[np.ndarray, "3"], *, contract: ExportContract
) -> dict[str, float] | list[float] | list[list[float]]:
    if contract.rotation == "rotator":
        return dict(zip(("pitch", "yaw", "roll"), rotator_deg.tolist(), strict=True))
    if contract.rotation == "matrix":
        rows: list[list[float]] = rotation_from_rotator_deg(rotator_deg).tolist()
        return rows
    x, y, z, w = quaternion_from_rotator(rotator_deg).tolist()
    return [x, y, z, w] if contract.rotation == "quaternion_xyzw" else [w, x, y, z]


def _description(plan: ScenePlan) -> dict[str, Any]:
    scene = plan.scene
    walls, things = scene.static_shapes[0].material.texture, len(scene.static_shapes)
    detailed = (
        f"A figure walks across a slanted ground of {scene.ground.texture}, among crates, balls "
        f"and thin poles ({things} things in all), before walls of {walls} under a cloudy sky."
    )
    return {
        "scene_type": "outdoor",
        "setting": "yard",
        "primary_elements": ["walking figure", "crates", "balls", "poles", "walls"],
        "spatial_layout": "a figure in the middle, things scattered before and behind it",
        "lighting_materials": "sunlight, matte procedural textures",
        "short_caption": f"A figure walks over {scene.ground.texture}.",
        "detailed_caption": detailed,
        "tags": ["outdoor", "figure", scene.ground.texture, walls],
    }
