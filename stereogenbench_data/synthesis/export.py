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
from stereogenbench_data.synthesis.proposal import Proposal
from stereogenbench_data.synthesis.request import RotationForm

_REPRESENTATIONS: Final = {
    "rotator": "unreal_rotator_degrees",
    "quaternion_xyzw": "quaternion_xyzw",
    "quaternion_wxyz": "quaternion_wxyz",
    "matrix": "matrix_3x3",
}


def completion_text(proposal: Proposal, *, renderer: str) -> str:
    """Return the completion marker. It records the request, so that a later run can compare it."""
    request, map_name = proposal.request, proposal.map_name
    marker = _labels(proposal) | {
        "map_path": f"/Game/{map_name}/Maps/{map_name}",
        "synthesis": {
            "seed": request.seed,
            "scene": proposal.index,
            "proposal": proposal.number,
            "frames": request.frames,
            "picture_px": request.picture_px,
            "focal_mm": proposal.focal_mm,
            "contract": repr(request.contract),
            "renderer": renderer,
        },
    }
    return _json(marker)


def metadata_texts(
    plan: ScenePlan, *, renderer: str, description: dict[str, object]
) -> dict[str, str]:
    """Return the text of every metadata file by name, with the completion marker last.

    Args:
        plan: The scene.
        renderer: Name and fingerprint of what drew it.
        description: The scene's description; "detailed_caption" is also written as text.
    """
    return {
        BASELINE_JSON: _json(_baseline(plan)),
        TRAJECTORY_JSON: _json(_trajectory(plan)),
        DESCRIPTION_JSON: _json(description),
        DESCRIPTION_TXT: str(description["detailed_caption"]),
        COMPLETE_JSON: completion_text(plan.proposal, renderer=renderer),
    }


def _json(value: dict[str, Any]) -> str:
    return json.dumps(value, indent=2)


def _labels(proposal: Proposal) -> dict[str, Any]:
    return {
        "scene_label": proposal.label,
        "scene_index": proposal.label_number,
        "map_name": proposal.map_name,
    }


def _camera_name(plan: ScenePlan, *, camera: int) -> str:
    return f"{plan.proposal.label}_Cam_{camera:02d}"


def _primary_pair(plan: ScenePlan) -> dict[str, str]:
    return {
        "left_camera": _camera_name(plan, camera=0),
        "right_camera": _camera_name(plan, camera=1),
    }


def _baseline(plan: ScenePlan) -> dict[str, Any]:
    width_px, height_px = plan.request.picture_px
    return _labels(plan.proposal) | {
        "unit": "cm",
        "camera_count": CAMERA_COUNT,
        "image_width": width_px,
        "image_height": height_px,
        "camera_intrinsics": {
            "focal_length_mm": plan.proposal.focal_mm,
            "sensor_width_mm": plan.proposal.sensor_mm[0],
            "sensor_height_mm": plan.proposal.sensor_mm[1],
        },
        "primary_stereo_pair": _primary_pair(plan),
        "adjacent_pairs": [_pair(plan, left=left, right=right) for left, right in ADJACENT_PAIRS],
        "pairwise_pairs": [_pair(plan, left=left, right=right) for left, right in CAMERA_PAIRS],
        "character_mesh": plan.proposal.character,
        "animation": plan.proposal.animation,
    }


def _pair(plan: ScenePlan, *, left: int, right: int) -> dict[str, Any]:
    return {
        "camera_index_a": left,
        "camera_index_b": right,
        "baseline_cm": float(plan.proposal.places_cm[right] - plan.proposal.places_cm[left]),
    }


def _trajectory(plan: ScenePlan) -> dict[str, Any]:
    return _labels(plan.proposal) | {
        "character_id": plan.proposal.character,
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
    rotation = _rotation(plan.rotators_deg[frame], form=plan.request.contract.rotation)
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
    rotator_deg: Float64[np.ndarray, "3"], *, form: RotationForm
) -> dict[str, float] | list[float] | list[list[float]]:
    if form == "rotator":
        return dict(zip(("pitch", "yaw", "roll"), rotator_deg.tolist(), strict=True))
    if form == "matrix":
        rows: list[list[float]] = rotation_from_rotator_deg(rotator_deg).tolist()
        return rows
    x, y, z, w = quaternion_from_rotator(rotator_deg).tolist()
    return [x, y, z, w] if form == "quaternion_xyzw" else [w, x, y, z]
