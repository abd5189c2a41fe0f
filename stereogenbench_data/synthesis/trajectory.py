"""The path of a rig: candidate viewpoints around the subject, connected frame by frame.

A viewpoint is (azimuth, elevation, distance) in degrees and metres, as seen from the subject; it
moves along with the subject. The path is a spring that is pulled from viewpoint to viewpoint. When
a transition fails a filter, its frames are thrown away, and the path goes on from the last
viewpoint that held, towards another one.

Angles and places are rounded to 1e-6, so that the last digits of a processor's sines do not reach
decisions.
"""

from collections import Counter
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np

from stereogenbench_data.geometry.pose import rotation_from_rotator_deg
from stereogenbench_data.schema.release import FRAME_RATE_HZ
from stereogenbench_data.synthesis.filters import (
    LIMITS,
    Refusal,
    check_poses,
    check_spawn,
    find_spawn,
    obstructed,
)
from stereogenbench_data.synthesis.proposal import Proposal
from stereogenbench_data.synthesis.renderer import ScenePlan, World

_CANDIDATES: Final = 96
_STEEPEST: Final = 0.95
"""Sine of the largest elevation of a candidate."""
_SMOOTH_FRAMES: Final = 7
_DIGITS: Final = 6
_PULL: Final = 0.004
_DRAG: Final = 0.126
"""Twice the root of the pull, so that the spring does not swing over."""
_LARGEST_ARC_M: Final = 5.0
_LARGEST_TURN_DEG: Final = np.array([55.0, 25.0])
_LARGEST_STRETCH: Final = 0.5
_SEGMENT_FRAMES: Final = (24, 48)
_TRANSITIONS: Final = 24
_TARGETS: Final = 4
"""How many viewpoints are tried from a place before the path goes back beyond it."""

Array = Any


def examine(proposal: Proposal, *, world: World) -> ScenePlan | Refusal:
    """Return the plan of a proposal that passes all filters, or why it is refused."""
    spawn = find_spawn(proposal, world=world)
    if isinstance(spawn, Refusal):
        return spawn
    frames = proposal.request.frames
    body_m = np.stack([world.subject_points_m(spawn, frame=frame) for frame in range(frames)])
    refusal = check_spawn(body_m, world=world)
    if refusal is not None:
        return refusal
    search = _Search(proposal, world=world, body_m=body_m)
    path = search.path()
    if isinstance(path, Refusal):
        return path
    centres_m, rotators_deg = search.poses(path, np.arange(frames))
    ahead = rotation_from_rotator_deg(rotators_deg)[..., 0]
    subject_m = ((body_m.mean(axis=1) - centres_m) * ahead).sum(axis=1)
    plan = ScenePlan(proposal, spawn, centres_m, rotators_deg, subject_m)
    step_m, turn_deg = plan.steps()
    for values, limit in (
        (step_m, LIMITS.step_m),
        (turn_deg, LIMITS.turn_deg),
        (np.abs(np.diff(turn_deg)), LIMITS.jerk_deg),
    ):
        if values.max(initial=0) > limit:
            return Refusal("motion", float(values.max()), limit)
    return plan


class _Knot(NamedTuple):
    """A place of the path: the frame, the viewpoint, its speed, and viewpoints yet to be tried."""

    frame: int
    viewpoint: Array
    speed: Array
    targets: Iterator[Array]


class _Search:
    """The search for the path of one proposal."""

    def __init__(self, proposal: Proposal, *, world: World, body_m: Array) -> None:
        self.rig, self.world, self.body_m = proposal.rig, world, body_m
        self.rng = proposal.rng("path")
        self.frames = len(body_m)
        middle = (body_m.min(axis=1) + body_m.max(axis=1)) / 2
        padded = np.pad(middle, ((_SMOOTH_FRAMES, _SMOOTH_FRAMES), (0, 0)), mode="edge")
        window = 2 * _SMOOTH_FRAMES + 1
        smooth = np.stack([padded[t : t + window].mean(axis=0) for t in range(self.frames)])
        self.anchor_m = np.round(smooth, _DIGITS)
        self.height_m = float(np.ptp(body_m[..., 2], axis=1).max())
        # At this distance the subject fits into the picture of every camera.
        width, height = self.rig.picture_at_1m
        across = (proposal.span_m + 0.35 * self.height_m) / width
        self.nearest_m = float(max(1.15 * self.height_m / height, across, 0.5 * self.height_m))
        # The rig looks a little beside the subject, and rolls a little.
        largest = np.array([0.02 * self.nearest_m, 0.02 * self.nearest_m, 3.5])
        sizes = largest * self.rng.uniform(0.5, 1.0, 3)
        periods_s, phases = self.rng.uniform(4.0, 9.0, 3), self.rng.uniform(0, 2 * np.pi, 3)
        moments = np.arange(self.frames)[:, None] / FRAME_RATE_HZ
        self.sway = np.round(sizes * np.sin(2 * np.pi * moments / periods_s + phases), _DIGITS)

    # Viewpoints.

    def poses(self, viewpoints: Array, frames: Array) -> tuple[Array, Array]:
        """Return centres and rotators of viewpoints at frames."""
        azimuth, elevation = np.radians(viewpoints[:, 0]), np.radians(viewpoints[:, 1])
        flat = np.cos(elevation)
        out = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
        anchor, sway = self.anchor_m[frames], self.sway[frames]
        centres_m = np.round(anchor + viewpoints[:, 2:] * out, _DIGITS)
        aside = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(len(azimuth))], axis=1)
        target = anchor + sway[:, :1] * aside + sway[:, 1:2] * np.array([0.0, 0.0, 1.0])
        x, y, z = (target - centres_m).T
        pitch, yaw = np.degrees(np.arctan2(z, np.hypot(x, y))), np.degrees(np.arctan2(y, x))
        return centres_m, np.round(np.stack([pitch, yaw, sway[:, 2]], axis=1), _DIGITS)

    def _pool(self) -> Array | Refusal:
        """Return the candidates that hold at the first, the middle and the last frame."""
        rng = self.rng
        candidates = np.empty((_CANDIDATES, 3))
        candidates[:, 0] = rng.uniform(-180, 180, _CANDIDATES)
        candidates[:, 1] = np.degrees(np.arcsin(rng.uniform(0, _STEEPEST, _CANDIDATES)))
        least = LIMITS.least_height * self.rig.picture_at_1m[1]
        farthest_m = max(min(0.9 * self.height_m / least, 2 * self.nearest_m), self.nearest_m)
        candidates[:, 2] = rng.uniform(self.nearest_m, farthest_m, _CANDIDATES)
        pool = np.round(candidates, _DIGITS)
        refused: Counter[str] = Counter()
        for frame in sorted({0, self.frames // 2, self.frames - 1}):
            at = np.full(len(pool), frame)
            centres_m, rotators_deg = self.poses(pool, at)
            reasons = self.checks(centres_m, rotators_deg, frames=at)
            refused.update(reasons[reasons != ""].tolist())
            pool = pool[reasons == ""]
            if len(pool) < LIMITS.viewpoints:
                ((reason, _),) = refused.most_common(1)
                return Refusal(reason, len(pool), LIMITS.viewpoints)
        return pool

    def checks(self, centres_m: Array, rotators_deg: Array, *, frames: Array) -> Array:
        """Ask all filters about poses at frames, as `check_poses`."""
        body_m = self.body_m[frames]
        return check_poses(centres_m, rotators_deg, body_m=body_m, rig=self.rig, world=self.world)

    # The path through them.

    def path(self) -> Array | Refusal:
        """Return the viewpoint at every frame."""
        pool = self._pool()
        if isinstance(pool, Refusal):
            return pool
        start = pool[int(self.rng.integers(len(pool)))]
        # The path begins in motion: degrees a frame, and a share of the distance a frame.
        arc_deg = np.degrees(_LARGEST_ARC_M / start[2])
        fastest = min(1.0, arc_deg / _LARGEST_TURN_DEG[0]) * np.array([1.0, 0.3, 0.006])
        speed = np.round(
            self.rng.choice([-1.0, 1.0], 3) * self.rng.uniform(0.5, 1.0, 3) * fastest, _DIGITS
        )
        speed = speed * np.array([1.0, 1.0, start[2]])
        knots = [_Knot(0, start, speed, self._targets(pool, start))]
        path = np.empty((self.frames, 3))
        path[0] = start
        reached = 1
        for _ in range(_TRANSITIONS):
            knot = knots[-1]
            if knot.frame == self.frames - 1:
                break
            target = next(knot.targets, None)
            if target is None:
                # All ways on from here fail: go back beyond it.
                if len(knots) == 1:
                    break
                knots.pop()
                continue
            length = int(self.rng.integers(*_SEGMENT_FRAMES))
            viewpoints, speed = _pulled(
                knot, target=target, frames=min(length, self.frames - 1 - knot.frame)
            )
            held = self._held(viewpoints, first=knot.frame)
            reached = max(reached, knot.frame + 1 + held)
            if held < len(viewpoints) - 1:
                continue
            last = knot.frame + held
            path[knot.frame + 1 : last + 1] = viewpoints[1:]
            knots.append(_Knot(last, viewpoints[-1], speed, self._targets(pool, viewpoints[-1])))
        if knots[-1].frame == self.frames - 1:
            return np.round(path, _DIGITS)
        return Refusal("transition", reached, self.frames)

    def _targets(self, pool: Array, viewpoint: Array) -> Iterator[Array]:
        """Return viewpoints to go to from one, in random order; the last is to stay there."""
        apart = pool - viewpoint
        apart[:, 0] = (apart[:, 0] + 180) % 360 - 180
        arc_deg = np.degrees(_LARGEST_ARC_M / viewpoint[2])
        near = (np.abs(apart[:, :2]) <= np.minimum(_LARGEST_TURN_DEG, arc_deg)).all(axis=1)
        near &= np.abs(apart[:, 2]) <= min(_LARGEST_STRETCH * viewpoint[2], _LARGEST_ARC_M)
        near &= (apart != 0).any(axis=1)
        chosen = self.rng.permutation(np.flatnonzero(near))[:_TARGETS]
        return iter([*(viewpoint + apart[chosen]), viewpoint])

    def _held(self, viewpoints: Array, *, first: int) -> int:
        """Return how many of the viewpoints after the first hold, with the ways between them."""
        frames = np.arange(first, first + len(viewpoints))
        centres_m, rotators_deg = self.poses(np.round(viewpoints, _DIGITS), frames)
        reasons = self.checks(centres_m, rotators_deg, frames=frames)
        eyes = self.rig.eyes(centres_m, rotation_from_rotator_deg(rotators_deg))
        held = (reasons[1:] == "") & ~obstructed(eyes, world=self.world)
        return len(held) if held.all() else int(held.argmin())


def _pulled(knot: _Knot, *, target: Array, frames: int) -> tuple[Array, Array]:
    """Return the viewpoints from a knot on, itself first, and the speed at the last of them."""
    viewpoint, speed = knot.viewpoint, knot.speed
    viewpoints = [viewpoint]
    for _ in range(frames):
        speed = speed + _PULL * (target - viewpoint) - _DRAG * speed
        viewpoint = viewpoint + speed
        viewpoints.append(viewpoint)
    return np.array(viewpoints), speed
