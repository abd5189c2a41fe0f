"""The files of a synthetic scene, in the release's layout, and what their pictures must pass.

One thread encodes, and the bytes depend only on frames and options, so the same frames give the
same bytes on any number of processors.

Source: the StereoGenBench paper's appendix on the file schema. Keys that it does not spell are
those of a scene in this layout that was rendered elsewhere.
"""

import json
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import av
import numpy as np
from jaxtyping import Float64

from stereogenbench_data.audit.geometry.picture_limits import border_share
from stereogenbench_data.geometry.pose import rotation_from_rotator_deg
from stereogenbench_data.media.depth import grey_frame
from stereogenbench_data.media.encoder import VideoWriter
from stereogenbench_data.schema.release import (
    ADJACENT_PAIRS,
    BASELINE_JSON,
    CAMERA_COUNT,
    CAMERA_PAIRS,
    COMPLETE_JSON,
    DESCRIPTION_JSON,
    DESCRIPTION_TXT,
    FRAME_RATE_HZ,
    TRAJECTORY_JSON,
    depth_name,
    rgb_name,
)
from stereogenbench_data.synthesis.filters import LIMITS, Refusal
from stereogenbench_data.synthesis.proposal import Proposal
from stereogenbench_data.synthesis.renderer import RenderedView, Renderer, ScenePlan
from stereogenbench_data.synthesis.request import LARGEST_UNITS, RotationForm

# Videos.

_H264: Final = {"crf": "18", "x264-params": "cpu-independent=1"}
_FFV1: Final = {"level": "3", "slices": "4", "slicecrc": "1"}


def write_cameras(
    plan: ScenePlan,
    *,
    renderer: Renderer,
    cameras: tuple[int, ...],
    folder: Path,
    after_frame: Callable[[], None],
) -> dict[int, Float64[np.ndarray, "frames 4"]]:
    """Write the two videos of some cameras into a folder, and measure what they show.

    Args:
        plan: The scene.
        renderer: What draws it.
        cameras: Numbers of the cameras.
        folder: Where the videos go.
        after_frame: Called after each frame of each camera; an exception from it ends the work.

    Returns:
        By camera, at each frame: the share of pixels without depth, the mean and the standard
        deviation of brightness (of 255), and the share of the border that near things cover.
    """
    contract = plan.proposal.request.contract
    measured: dict[int, list[tuple[float, ...]]] = {camera: [] for camera in cameras}
    tag = contract.depth_tag
    tags = None if tag is None else {tag: repr(contract.depth_unit_m)}
    with ExitStack() as stack:

        def begin(name: str, **how: Any) -> VideoWriter:
            return stack.enter_context(VideoWriter(folder / name, rate_hz=FRAME_RATE_HZ, **how))

        videos = [
            (
                begin(rgb_name(camera), container="mp4", codec="libx264", options=_H264),
                begin(
                    depth_name(camera), container="matroska", codec="ffv1", options=_FFV1, tags=tags
                ),
            )
            for camera in cameras
        ]
        views = renderer.views(plan, cameras=cameras)
        for subject_m in plan.subject_m:
            for (rgb, depth), rows in zip(videos, measured.values(), strict=True):
                view = next(views)
                shown = av.VideoFrame.from_ndarray(view.picture, format="rgb24")
                rgb.write(shown.reformat(format="yuv420p", threads=1))
                units = np.minimum(np.rint(view.depth_m / contract.depth_unit_m), LARGEST_UNITS)
                depth.write(grey_frame(units.astype(np.uint16), pixel_format="gray16le"))
                rows.append(_measured(view, subject_m=subject_m))
                after_frame()
    return {camera: np.array(rows) for camera, rows in measured.items()}


# Checks of what was rendered.

_THIN: Final = 4
"""Brightness is measured on every fourth row and column."""
_LUMA: Final = np.array([0.299, 0.587, 0.114], np.float32)


def _measured(view: RenderedView, *, subject_m: float) -> tuple[float, ...]:
    """Return what `write_cameras` measures at a frame, given the subject's depth."""
    brightness = view.picture[::_THIN, ::_THIN].astype(np.float32) @ _LUMA
    invalid = (view.depth_m >= LIMITS.farthest_m).mean()
    near = border_share(view.depth_m < LIMITS.near_share * subject_m)
    return float(invalid), float(brightness.mean()), float(brightness.std()), near


def check_pictures(measured: Mapping[int, Float64[np.ndarray, "frames 4"]]) -> Refusal | None:
    """Return why a scene is refused by what `write_cameras` measured of it, if it is."""
    for rows in measured.values():
        invalid, mean, sd, near = rows.T
        for reason, value, limit, sign in (
            ("invalid_depth", invalid.mean(), LIMITS.invalid_share, 1),
            ("dark", mean.min(), LIMITS.dark_mean, -1),
            ("flat", sd.min(), LIMITS.flat_sd, -1),
            ("border_occluder", near.max(), LIMITS.border_share, 1),
        ):
            if sign * value > sign * limit:
                return Refusal(reason, float(value), limit)
    return None


# Metadata.

_FIRST_LABEL: Final = 1000
"""The number in the label of scene 0; labels differ from the names of folders."""
_REPRESENTATIONS: Final = {"rotator": "unreal_rotator_degrees", "matrix": "matrix_3x3"}


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
    return json.dumps(marker, indent=2)


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
        BASELINE_JSON: json.dumps(_baseline(plan.proposal), indent=2),
        TRAJECTORY_JSON: json.dumps(_trajectory(plan), indent=2),
        DESCRIPTION_JSON: json.dumps(description, indent=2),
        DESCRIPTION_TXT: str(description["detailed_caption"]),
        COMPLETE_JSON: completion_text(plan.proposal, renderer=renderer),
    }


def _labels(proposal: Proposal) -> dict[str, Any]:
    number = _FIRST_LABEL + proposal.index
    return {
        "scene_label": f"{proposal.map_name}_scene_{number}",
        "scene_index": number,
        "map_name": proposal.map_name,
    }


def _camera_names(proposal: Proposal) -> list[str]:
    label = _labels(proposal)["scene_label"]
    return [f"{label}_Cam_{camera:02d}" for camera in range(CAMERA_COUNT)]


def _primary_pair(proposal: Proposal) -> dict[str, str]:
    left, right, *_ = _camera_names(proposal)
    return {"left_camera": left, "right_camera": right}


def _baseline(proposal: Proposal) -> dict[str, Any]:
    width_px, height_px = proposal.request.picture_px
    places_cm = proposal.places_cm.tolist()
    pairs = {
        pair: {
            "camera_index_a": pair[0],
            "camera_index_b": pair[1],
            "baseline_cm": places_cm[pair[1]] - places_cm[pair[0]],
        }
        for pair in CAMERA_PAIRS
    }
    return _labels(proposal) | {
        "unit": "cm",
        "camera_count": CAMERA_COUNT,
        "image_width": width_px,
        "image_height": height_px,
        "camera_intrinsics": {
            "focal_length_mm": proposal.focal_mm,
            "sensor_width_mm": proposal.sensor_mm[0],
            "sensor_height_mm": proposal.sensor_mm[1],
        },
        "primary_stereo_pair": _primary_pair(proposal),
        "adjacent_pairs": [pairs[pair] for pair in ADJACENT_PAIRS],
        "pairwise_pairs": list(pairs.values()),
        "character_mesh": proposal.character,
        "animation": proposal.animation,
    }


def _trajectory(plan: ScenePlan) -> dict[str, Any]:
    proposal, names = plan.proposal, _camera_names(plan.proposal)
    form = proposal.request.contract.rotation
    frames = []
    for frame, rotator_deg in enumerate(plan.rotators_deg):
        rotation = recorded_rotation(rotator_deg, form=form)
        locations_cm = plan.world_locations_cm(frame).tolist()
        cameras = [
            {
                "camera_name": name,
                "camera_index": camera,
                "location": dict(zip("xyz", location_cm, strict=True)),
                "rotation": rotation,
            }
            for camera, (name, location_cm) in enumerate(zip(names, locations_cm, strict=True))
        ]
        frames.append({"frame_index": frame, "cameras": cameras})
    return _labels(proposal) | {
        "character_id": proposal.character,
        "unit": "cm",
        "rotation_representation": _REPRESENTATIONS.get(form, form),
        "camera_count": CAMERA_COUNT,
        "primary_stereo_pair": _primary_pair(proposal),
        "camera_order": names,
        "frames": frames,
    }


def recorded_rotation(
    rotator_deg: Float64[np.ndarray, "3"], *, form: RotationForm
) -> dict[str, float] | list[float] | list[list[float]]:
    """Return a rotator (pitch, yaw, roll) in the form that ``trajectory.json`` is to have.

    It turns camera axes (forward, right, up) into world axes by Rz(yaw) Ry(-pitch) Rx(-roll).
    """
    if form == "rotator":
        return dict(zip(("pitch", "yaw", "roll"), rotator_deg.tolist(), strict=True))
    if form == "matrix":
        rows: list[list[float]] = rotation_from_rotator_deg(rotator_deg).tolist()
        return rows
    half = np.radians(rotator_deg) / 2
    (sp, sy, sr), (cp, cy, cr) = np.sin(half).tolist(), np.cos(half).tolist()
    x, y = cr * sp * sy - sr * cp * cy, -cr * sp * cy - sr * cp * sy
    z, w = cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy
    return [x, y, z, w] if form == "quaternion_xyzw" else [w, x, y, z]
