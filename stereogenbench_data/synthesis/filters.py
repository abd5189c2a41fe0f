"""Filters of proposals: is there a place for the subject, and can a rig see it from a pose.

They ask a `World`, so they are the same for every renderer. Lengths are metres in map axes. All
decisions are made in float64.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float64

from stereogenbench_data.audit.geometry.picture_limits import (
    BORDER_SHARE,
    DARK_MEAN,
    FLAT_SD,
    INVALID_SHARE,
    NEAR_SHARE,
)
from stereogenbench_data.geometry.pose import rotation_from_rotator_deg
from stereogenbench_data.synthesis.proposal import Proposal, Rig
from stereogenbench_data.synthesis.renderer import Spawn, World

Array = Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """The limits of the filters; those of pictures are the audit's (`picture_limits`).

    Attributes:
        support_gap_m: Largest height of the soles above the ground, or depth below it.
        headroom_m: Least free height above the floor.
        body_space_m: Least distance between the subject's middle and the map, all around.
        framed_share: Least share of the subject that lies in every camera's picture.
        least_height: Least height of the subject, as a share of the picture's.
        largest_height: Largest height of the subject.
        clearance_m: Least distance of every camera to the map and to its bounds.
        subject_clearance_m: Least distance of every camera to the subject.
        visible_share: Least share of the subject that every camera sees: in the picture, and with
            nothing before it.
        valid_share: Least share of the picture of every camera that has depth.
        farthest_m: What lies farther has no depth. This is the release's range, whatever the range
            of the files: how a scene is written does not change it.
        near_share: Depth below this share of the subject's is a near occluder.
        border_share: Largest share of a picture's border that near occluders cover.
        viewpoints: Least number of valid candidate viewpoints.
        step_m: Largest way of any camera from frame to frame.
        turn_deg: Largest rotation from frame to frame.
        jerk_deg: Largest change of that rotation from frame to frame.
        subject_step_m: Largest way of the subject's middle from frame to frame: 9 m/s at 15 Hz, a
            fast run. What goes farther is a jump in the animation.
        invalid_share: Largest share of a rendered camera's pixels without depth, over all frames.
        dark_mean: Least mean brightness of a rendered frame, of 255.
        flat_sd: Least standard deviation of the brightness of a rendered frame.
    """

    support_gap_m: float = 0.2
    headroom_m: float = 2.0
    body_space_m: float = 0.35
    framed_share: float = 0.75
    least_height: float = 0.12
    largest_height: float = 1.0
    clearance_m: float = 0.2
    subject_clearance_m: float = 0.5
    visible_share: float = 0.5
    valid_share: float = 0.5
    farthest_m: float = 65.535
    near_share: float = NEAR_SHARE
    border_share: float = BORDER_SHARE
    viewpoints: int = 4
    step_m: float = 0.25
    turn_deg: float = 2.5
    jerk_deg: float = 0.4
    subject_step_m: float = 0.6
    invalid_share: float = INVALID_SHARE
    dark_mean: float = DARK_MEAN
    flat_sd: float = FLAT_SD


LIMITS: Final = Limits()


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why a proposal was refused.

    Attributes:
        reason: The filter that refused it, such as "collision"; ``docs/generation.md`` has them.
        value: What was measured.
        limit: What the filter allows.
    """

    reason: str
    value: float
    limit: float


# Where the subject stands.

_FLOORS: Final = 6
_STEP_DOWN_M: Final = 0.25
_EYE_LEVELS: Final = (0.3, 0.55, 0.9)
"""Heights of the body, as shares of its own, at which the space around it is measured."""
_REACH_M: Final = 0.5
"""How far above a sole the search for ground beneath it begins."""


def find_spawn(proposal: Proposal, *, world: World) -> Spawn | Refusal:
    """Draw a place and a direction, and put it on one of the floors there.

    The floors are found from above; each must have headroom.
    """
    rng = proposal.rng("spawn")
    low, high = world.spawn_bounds_m
    x, y = rng.uniform(low[:2], high[:2])
    yaw_deg = float(np.round(rng.uniform(-180, 180), 6))
    pick = float(rng.random())
    floors: list[float] = []
    z = float(high[2])
    while len(floors) < _FLOORS and z > low[2]:
        fall = _cast_one(world, (x, y, z), (0.0, 0.0, -1.0))
        if not np.isfinite(fall):
            break
        z -= fall
        # From inside a solid it falls by 0.
        if fall > 0 and z >= low[2] - LIMITS.support_gap_m:
            floors.append(z)
        z -= _STEP_DOWN_M
    if not floors:
        return Refusal("spawn_support", 0, 1)
    rooms = [_cast_one(world, (x, y, floor + 0.05), (0.0, 0.0, 1.0)) + 0.05 for floor in floors]
    high_enough = [z for z, room in zip(floors, rooms, strict=True) if room >= LIMITS.headroom_m]
    if not high_enough:
        return Refusal("spawn_space", max(rooms), LIMITS.headroom_m)
    floor = high_enough[int(pick * len(high_enough))]
    return Spawn(np.round(np.array([x, y, floor]), 6), yaw_deg)


def _cast_one(world: World, origin: Sequence[float], direction: Sequence[float]) -> float:
    origins, directions = np.array([origin], np.float64), np.array([direction], np.float64)
    return float(world.cast(origins, directions)[0])


def check_spawn(body_m: Float64[np.ndarray, "frames p 3"], *, world: World) -> Refusal | None:
    """Refuse a subject that at some frame meets the map, floats or sinks, or that jumps.

    Args:
        body_m: Points of the subject's body at consecutive frames.
        world: The map.
    """
    frames, _, _ = body_m.shape
    lowest = body_m[..., 2].min(axis=1)
    height = body_m[..., 2].max(axis=1) - lowest
    middle = body_m.mean(axis=1)
    # Free space around the body at some heights, and from its middle to all its points.
    turns = np.arange(8) * (np.pi / 4)
    around = np.column_stack([np.cos(turns), np.sin(turns), np.zeros(8)])
    levels = lowest[:, None] + np.outer(height, _EYE_LEVELS)
    origins = np.empty((frames, len(_EYE_LEVELS), 8, 3))
    origins[..., :2] = middle[:, None, None, :2]
    origins[..., 2] = levels[..., None]
    directions = np.broadcast_to(around, origins.shape)
    space = world.cast(origins.reshape(-1, 3), directions.reshape(-1, 3)).reshape(frames, -1)
    least = space.min(axis=1)
    if least.min() < LIMITS.body_space_m:
        return Refusal("spawn_space", float(least.min()), LIMITS.body_space_m)
    # The soles may sink as far as the filter of support allows.
    low = body_m[..., 2] <= lowest[:, None] + LIMITS.support_gap_m
    seen = _sight(world, middle[:, None], body_m) | low
    if not seen.all():
        return Refusal("spawn_space", float(seen.mean(axis=1).min()), 1.0)
    # Ground beneath the sole that is lowest at a frame, and beneath the middle of the body.
    sole = body_m[np.arange(frames), body_m[..., 2].argmin(axis=1)]
    above = np.concatenate([sole, np.column_stack([middle[:, :2], lowest])])
    above[:, 2] += _REACH_M
    fall = world.cast(above, np.tile([0.0, 0.0, -1.0], (len(above), 1)))
    gap = np.where(np.isfinite(fall), np.abs(fall - _REACH_M), np.inf)
    if gap.max() > LIMITS.support_gap_m:
        return Refusal("spawn_support", float(gap.max()), LIMITS.support_gap_m)
    way_m = np.linalg.norm(np.diff(middle, axis=0), axis=1)
    if way_m.max(initial=0) > LIMITS.subject_step_m:
        return Refusal("subject_motion", float(way_m.max()), LIMITS.subject_step_m)
    return None


def _sight(world: World, start: Array, end: Array) -> Array:
    """Return whether the map leaves free the lines between points, which broadcast together."""
    start, end = np.broadcast_arrays(start, end)
    line = end - start
    length = np.sqrt((line * line).sum(axis=-1))
    directions = line / np.maximum(length, 1e-12)[..., None]
    met = world.cast(start.reshape(-1, 3), directions.reshape(-1, 3)).reshape(length.shape)
    return met >= length - 1e-6


# What a rig sees from a pose.

_SIGHT_POINTS: Final = 14
_GRID: Final = 6
_BORDER: Final = 0.98
_AROUND: Final = np.array(
    [axis for sign in (-1.0, 1.0) for axis in (sign * np.eye(3))]
    + [np.array([x, y, z]) / np.sqrt(3) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
)
"""Unit directions to the faces and corners of a cube."""


def check_poses(
    centres_m: Float64[np.ndarray, "n 3"],
    rotators_deg: Float64[np.ndarray, "n 3"],
    *,
    body_m: Float64[np.ndarray, "n p 3"],
    rig: Rig,
    world: World,
) -> Array:
    """Return the first filter that refuses each of n poses of a rig, as (n,) texts; "" for none.

    All filters are asked about all six cameras.

    Args:
        centres_m: The middle of the rig.
        rotators_deg: Pitch, yaw and roll.
        body_m: The subject's points at the moment of each pose.
        rig: The cameras.
        world: The map.
    """
    reasons = np.full(len(centres_m), "", object)
    axes = rotation_from_rotator_deg(rotators_deg)
    eyes = rig.eyes(centres_m, axes)
    for measure in (_framing, _collision, _visibility, _depth):
        left = np.flatnonzero(reasons == "")
        if not len(left):
            break
        poses = _Poses(eyes[left], axes[left], body_m[left], rig)
        for reason, is_refused in measure(poses, world):
            reasons[left[is_refused & (reasons[left] == "")]] = reason
    return reasons


Refused = list[tuple[str, Array]]
"""Filters, each with the poses that it refuses."""


@dataclass(frozen=True, slots=True, eq=False)
class _Poses:
    eyes: Array
    axes: Array
    body_m: Array
    rig: Rig

    def projected(self) -> tuple[Array, Array, Array]:
        """Return depth of the subject's points, and their place, -1..1 across and up the pictures.

        Each is (n, 6, p).
        """
        apart = self.body_m[:, None] - self.eyes[:, :, None]
        ahead, right, up = np.moveaxis(np.einsum("ncpi,nij->ncpj", apart, self.axes), -1, 0)
        width, height = self.rig.picture_at_1m
        safe = np.maximum(ahead, 1e-6)
        return ahead, right / safe * (2 / width), up / safe * (2 / height)

    def framed(self) -> Array:
        """Return which of the subject's points lie in each picture, (n, 6, p)."""
        ahead, across, up = self.projected()
        return (ahead > 1e-6) & (np.abs(across) <= 1) & (np.abs(up) <= 1)


def _framing(poses: _Poses, world: World) -> Refused:
    height = np.ptp(poses.projected()[2], axis=2) / 2
    is_refused = poses.framed().mean(axis=2).min(axis=1) < LIMITS.framed_share
    is_refused |= height.min(axis=1) < LIMITS.least_height
    is_refused |= height.max(axis=1) > LIMITS.largest_height
    return [("framing", is_refused)]


def _collision(poses: _Poses, world: World) -> Refused:
    low, high = world.bounds_m
    margin = np.minimum(poses.eyes - low, high - poses.eyes).min(axis=(1, 2))
    apart = poses.body_m[:, None] - poses.eyes[:, :, None]
    to_subject = np.sqrt((apart * apart).sum(axis=-1)).min(axis=(1, 2))
    inside = margin >= LIMITS.clearance_m
    eyes = poses.eyes[inside]
    shape = (*eyes.shape[:2], len(_AROUND), 3)
    origins = np.broadcast_to(eyes[:, :, None], shape).reshape(-1, 3)
    met = world.cast(origins, np.broadcast_to(_AROUND, shape).reshape(-1, 3))
    clearance = np.full(len(inside), np.inf)
    clearance[inside] = met.reshape(len(eyes), shape[1] * shape[2]).min(axis=1)
    is_refused = np.minimum(margin, clearance) < LIMITS.clearance_m
    return [("collision", is_refused | (to_subject < LIMITS.subject_clearance_m))]


def _visibility(poses: _Poses, world: World) -> Refused:
    points = poses.body_m.shape[1]
    chosen = np.unique(np.arange(_SIGHT_POINTS) * (points - 1) // (_SIGHT_POINTS - 1))
    # From the subject to the camera, so that a camera inside a solid sees nothing.
    seen = _sight(world, poses.body_m[:, None, chosen], poses.eyes[:, :, None])
    seen &= poses.framed()[:, :, chosen]
    return [("visibility", seen.mean(axis=2).min(axis=1) < LIMITS.visible_share)]


def _depth(poses: _Poses, world: World) -> Refused:
    # Rays (ahead, right, up; 1 ahead) over the picture, and which are at its border.
    place = np.linspace(-_BORDER, _BORDER, _GRID)
    across, up = (each.ravel() for each in np.meshgrid(place, place))
    width, height = poses.rig.picture_at_1m
    rays = np.column_stack([np.ones(_GRID**2), across * width / 2, up * height / 2])
    at_border = np.maximum(np.abs(across), np.abs(up)) >= _BORDER
    length = np.sqrt((rays * rays).sum(axis=1))
    directions = np.einsum("nij,rj->nri", poses.axes, rays / length[:, None])
    count, cameras, _ = poses.eyes.shape
    shape = (count, cameras, len(rays), 3)
    origins = np.broadcast_to(poses.eyes[:, :, None], shape).reshape(-1, 3)
    met = world.cast(origins, np.broadcast_to(directions[:, None], shape).reshape(-1, 3))
    depth_m = met.reshape(count, cameras, -1) / length
    valid = (depth_m < LIMITS.farthest_m).mean(axis=2).min(axis=1)
    subject_m = poses.projected()[0].mean(axis=2)
    near = depth_m[..., at_border] < LIMITS.near_share * subject_m[..., None]
    return [
        ("valid_depth", valid < LIMITS.valid_share),
        ("border_occluder", near.mean(axis=2).max(axis=1) > LIMITS.border_share),
    ]


def obstructed(eyes: Float64[np.ndarray, "t 6 3"], *, world: World) -> Bool[np.ndarray, " s"]:
    """Return whether the map is in the way of a camera between consecutive frames."""
    return np.asarray(~_sight(world, eyes[:-1], eyes[1:]).all(axis=1))
