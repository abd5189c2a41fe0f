"""Which of several readings of poses is right: depth of one frame must be found in another.

The rig alone does not tell a camera that looks ahead from one that looks back, or a world from its
mirror image (`index.evidence`). Depth does: a pixel of one frame, taken by the poses to another
frame of the same camera, must lie where that frame's depth says. The truth may not be among the
readings, so the best must explain most pixels, be well ahead of the next, and do both in scenes
that were not used to choose it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from stereogenbench_data.audit.contract.matching import SceneFrames
from stereogenbench_data.audit.geometry.reprojection import (
    FEWER_PIXELS,
    MeasuredDepth,
    reproject,
)
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.index.evidence import poses_as
from stereogenbench_data.media.depth import depth_m_from_units
from stereogenbench_data.schema.release import CAMERA_COUNT

LEAST_SHARE: Final = 0.6
"""The share of pixels that a right reading explains at least: moving things take some."""

LEAST_MARGIN: Final = 0.2
"""How far the best reading must be ahead of the next."""

_LEAST_PIXELS: Final = 200
_STEPS: Final = (8, 4, 2)


@dataclass(frozen=True, slots=True)
class WorldVerdict:
    """What pictures say about the readings of the poses of some scenes.

    Attributes:
        chosen: The reading that is right; "" where the pictures cannot tell.
        shares: For each reading, the share of pixels that it explains: of the scenes that chose it,
            and of the others.
        reason: Why the pictures cannot tell; "" where they do.
    """

    chosen: str
    shares: Mapping[str, tuple[float, float]]
    reason: str


def explained_shares(views: SceneFrames, text: bytes, names: Sequence[str]) -> dict[str, float]:
    """Return the share of comparable pixels that each reading explains; 0 where they are few.

    Args:
        views: The scene's depth.
        text: Its ``trajectory.json``.
        names: The readings, as `Scene.pose_form` lists them.

    Raises:
        SchemaError: If the file has no such poses.
        MediaError: If depth cannot be decoded.
    """
    where = views.scene.id.key
    last = views.scene.frames - 1
    steps = sorted({max(1, last // step) for step in _STEPS} if last else ())
    moves = [(first, first + step) for step in steps for first in {0, last - step}]
    cameras = (0, CAMERA_COUNT - 1)
    depths = {
        (frame, camera): _depth(views, frame, camera)
        for frame in sorted({frame for move in moves for frame in move})
        for camera in cameras
    }
    found = {}
    for name in names:
        poses = poses_as(text, name, where=where)
        counts = np.zeros(2, dtype=np.int64)
        for first, later in moves:
            for camera in cameras:
                errors = reproject(
                    depths[first, camera],
                    depths[later, camera],
                    intrinsics=views.intrinsics,
                    right_from_left=_moved(poses, camera, first, later),
                    most_pixels=FEWER_PIXELS,
                )
                counts += (errors.agreeing, errors.unhidden)
        agreeing, unhidden = counts.tolist()
        found[name] = agreeing / unhidden if unhidden >= _LEAST_PIXELS else 0.0
    return found


def judge_worlds(scenes: Sequence[Mapping[str, float]]) -> WorldVerdict:
    """Return which reading is right, by `explained_shares` of some scenes.

    Every other scene chooses, and those between must confirm the choice.
    """
    names = sorted(set.intersection(*(set(scene) for scene in scenes))) if scenes else []
    shares = {name: (_mean(scenes[::2], name), _mean(scenes[1::2], name)) for name in names}
    if len(scenes) < 2 or not names:
        return WorldVerdict("", shares, "fewer than two scenes have these readings")
    best = max(names, key=lambda name: shares[name][0])
    for half, who in enumerate(("that choose", "that confirm")):
        others = [shares[name][half] for name in names if name != best]
        if shares[best][half] < LEAST_SHARE:
            reason = f"no reading explains {LEAST_SHARE:.0%} of the pixels of the scenes {who}"
        elif others and shares[best][half] - max(others) < LEAST_MARGIN:
            reason = f"no reading is {LEAST_MARGIN:.0%} ahead in the scenes {who}"
        else:
            continue
        return WorldVerdict("", shares, reason)
    return WorldVerdict(best, shares, "")


def _mean(scenes: Sequence[Mapping[str, float]], name: str) -> float:
    return float(np.mean([scene[name] for scene in scenes])) if scenes else float("nan")


def _moved(poses: CameraPoses, camera: int, first: int, later: int) -> np.ndarray:
    """Return the motion from a camera's axes in one frame to its axes in another."""
    world_from_later = poses.world_from_cam(later, camera)
    return np.asarray(np.linalg.inv(world_from_later) @ poses.world_from_cam(first, camera))


def _depth(views: SceneFrames, frame: int, camera: int) -> MeasuredDepth:
    units, measured = views.depth(frame, camera)
    encoding = replace(views.encoding, unit_m=views.unit_m(camera))
    depth_m = depth_m_from_units(
        units, measured=measured, encoding=encoding, intrinsics=views.intrinsics
    )
    known = measured & np.isfinite(depth_m)
    return MeasuredDepth(
        np.where(known, depth_m, 0).astype(np.float64),
        known,
        step_m=views.unit_m(camera),
        form=encoding.form,
    )
