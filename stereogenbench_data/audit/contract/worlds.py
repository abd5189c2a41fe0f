"""Which of several readings of poses is right: depth of one frame must be found in another.

The rig alone does not tell a camera that looks ahead from one that looks back, or a world from its
mirror image (`geometry.pose_evidence`). Depth does: a pixel of one frame, taken by the poses to
another frame of the same camera, must lie where that frame's depth says. The truth may not be among
the readings, so the best must explain most pixels, be well ahead of the next, and do both in scenes
that were not used to choose it, or with a camera that was not, where there is one scene.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from typing import Final

import numpy as np

from stereogenbench_data.audit.contract.row_matches import SceneFrames
from stereogenbench_data.audit.geometry.reprojection import reproject
from stereogenbench_data.errors import SchemaError
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.geometry.pose_evidence import poses_of, same_poses, settled_poses
from stereogenbench_data.schema.conventions import declaration_of
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.schema.release import CAMERA_COUNT

LEAST_SHARE: Final = 0.6
"""The share of pixels that a right reading explains at least: moving things take some."""

LEAST_MARGIN: Final = 0.2
"""How far the best reading must be ahead of the next."""

_LEAST_PIXELS: Final = 200
_PARTS: Final = (8, 4, 2)
_CAMERAS: Final = (0, CAMERA_COUNT - 1)

Shares = Mapping[str, tuple[float, float]]
"""For each reading, the share of pixels that it explains: where it is chosen, and where the choice
is confirmed. Of one scene these are two cameras, of several scenes one half and the other."""


@dataclass(frozen=True, slots=True)
class WorldVerdict:
    """What pictures say about the readings of the poses of some scenes.

    Attributes:
        chosen: The reading that is right; "" where the pictures cannot tell.
        shares: What each reading explains.
        reason: Why the pictures cannot tell; "" where they do.
        stated: The reading that conventions state; "" where they state none.
    """

    chosen: str
    shares: Shares
    reason: str
    stated: str = ""

    @property
    def is_wrong(self) -> bool:
        """Whether another reading is right than the one that conventions state."""
        return bool(self.stated and self.chosen) and self.stated != self.chosen

    @property
    def lines(self) -> list[str]:
        """The figures of each reading, the best first, and the verdict."""
        ranked = sorted(self.shares.items(), key=lambda each: each[1], reverse=True)
        listed = [f"{one:.0%}, again {other:.0%}: {name}" for name, (one, other) in ranked]
        verdict = f"right: {self.chosen}" if self.chosen else f"cannot tell: {self.reason}"
        wrong = [f"WRONG: the conventions state {self.stated}"] if self.is_wrong else []
        return [each.partition(" @ ")[0] for each in (*listed, verdict, *wrong)]


def is_stated(scene: Scene) -> bool:
    """Return whether conventions state how a scene's poses are read."""
    return declaration_of(scene).poses is not None


def rival_readings(scene: Scene, text: bytes) -> tuple[str, ...]:
    """Return the readings that fit a scene's rig and differ; that of its row comes first.

    Args:
        scene: The row.
        text: Its ``trajectory.json``.
    """
    where = scene.id.key
    names = scene.pose_form.split("|") if scene.pose_form else []
    if names and is_stated(scene):
        with suppress(SchemaError):  # what conventions state is all that fits
            names += settled_poses(text, scene.rig, where=where, frames=scene.frames).names
    found: dict[str, CameraPoses] = {}
    for name in names:
        poses = poses_of(scene, text, where=where, form=name)
        if not any(same_poses(poses, other) for other in found.values()):
            found[name] = poses
    return tuple(found)


def explained_shares(views: SceneFrames, text: bytes, names: Sequence[str]) -> Shares:
    """Return the shares of comparable pixels that each reading explains; 0 where they are few.

    Args:
        views: The scene's depth.
        text: Its ``trajectory.json``.
        names: The readings, as `Scene.pose_form` lists them.

    Raises:
        SchemaError: If the file has no such poses.
        MediaError: If depth cannot be decoded.
    """
    where = views.scene.id.key
    moves = views.frame_moves(_PARTS) or views.frame_moves((1,))
    depths = {
        (frame, camera): views.measured_depth(frame, camera)
        for frame in sorted({*chain(*moves)})
        for camera in _CAMERAS
    }
    found = {}
    for name in names:
        poses = poses_of(views.scene, text, where=where, form=name)
        shares = []
        for camera in _CAMERAS:
            counts = np.zeros(2, dtype=np.int64)
            for first, later in moves:
                motion = poses.later_from_cam(first, later, camera=camera)
                both, pinhole = (depths[first, camera], depths[later, camera]), views.intrinsics
                errors = reproject(*both, intrinsics=pinhole, right_from_left=motion)
                counts += (errors.agreeing, errors.unhidden)
            agreeing, unhidden = counts.tolist()
            shares.append(agreeing / unhidden if unhidden >= _LEAST_PIXELS else 0.0)
        found[name] = shares[0], shares[1]
    return found


def judge_worlds(scenes: Sequence[Shares], *, stated: str = "") -> WorldVerdict:
    """Return which reading is right, by `explained_shares` of some scenes.

    Every other scene chooses, and those between must confirm the choice; of one scene, one camera
    chooses and another confirms.

    Args:
        scenes: At least one.
        stated: The reading that conventions state.
    """
    names = sorted(set.intersection(*map(set, scenes)))
    if not names:
        return WorldVerdict("", {}, "no reading fits all scenes", stated)
    shares = scenes[0]
    if len(scenes) > 1:
        shares = {name: (_mean(scenes[::2], name), _mean(scenes[1::2], name)) for name in names}
    best = max(names, key=lambda name: shares[name][0])
    kind = "scenes" if len(scenes) > 1 else "camera"
    for half, who in enumerate(("choosing", "confirming")):
        others = [shares[name][half] for name in names if name != best]
        if shares[best][half] < LEAST_SHARE:
            reason = f"no reading explains {LEAST_SHARE:.0%} of the pixels of the {who} {kind}"
        elif others and shares[best][half] - max(others) < LEAST_MARGIN:
            reason = f"no reading is {LEAST_MARGIN:.0%} ahead in the {who} {kind}"
        else:
            continue
        return WorldVerdict("", shares, reason, stated)
    return WorldVerdict(best, shares, "", stated)


def _mean(scenes: Sequence[Shares], name: str) -> float:
    return float(np.mean([scene[name] for scene in scenes]))
