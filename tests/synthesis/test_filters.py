"""Filters on maps with known answers: a wall, a pit, a ceiling, a box around a camera."""

from dataclasses import replace

import numpy as np
import pytest

from stereogenbench_data.synthesis.filters import (
    LIMITS,
    check_poses,
    check_spawn,
    find_spawn,
    obstructed,
)
from stereogenbench_data.synthesis.planning import propose
from stereogenbench_data.synthesis.proposal import Rig
from stereogenbench_data.synthesis.renderer import Spawn
from stereogenbench_data.synthesis.request import SynthRequest
from stereogenbench_data.synthesis.trajectory import examine
from tests.synthesis.worlds import FLOOR, Blocks, yard

HERE = Spawn(np.zeros(3), 0.0)


def proposal(**request):
    return propose(SynthRequest(**{"size_px": 64, "frames": 9, "focal_mm": 24.0} | request),
                   index=0, number=0)  # fmt: skip


def spawn_refusal(world):
    body_m = np.stack([world.subject_points_m(HERE, frame=frame) for frame in range(81)])
    return check_spawn(body_m, world=world)


def looking(world, *, eye=(4, 0, 1.0), rig=None, yaw=180.0, pitch=0.0):
    """The verdict on one pose of a narrow rig; the subject stands at the origin."""
    return check_poses(
        np.array([eye], float),
        np.array([[pitch, yaw, 0.0]]),
        body_m=world.subject_points_m(HERE, frame=0)[None],
        rig=rig or Rig(np.linspace(-0.16, 0.16, 6), (0.99, 0.99)),
        world=world,
    )


# The spawn.


WALL = ((2, -5, 0), (2.2, 5, 3))
CLIFF = [((-20, -20, -1), (1, 20, 0)), ((-20, -20, -4), (20, 20, -3))]
"""The floor ends a metre ahead; three metres below there is another one."""
NOWHERE = Blocks([((5, 5, -1), (6, 6, 0))])


@pytest.mark.parametrize("world", [yard(), yard(walk_m=3.5), yard(sunk_m=0.1), yard(WALL)])
def test_a_subject_with_room_on_a_floor_is_accepted(world):
    assert spawn_refusal(world) is None


@pytest.mark.parametrize(
    ("world", "reason", "value"),
    [
        (Blocks(CLIFF, walk_m=3.5), "spawn_support", 3.0),
        (NOWHERE, "spawn_support", np.inf),
        (yard(sunk_m=-0.3), "spawn_support", 0.3),
        (yard(sunk_m=0.3), "spawn_support", None),
        (yard(WALL, walk_m=1.8), "spawn_space", None),
    ],
    ids=["walks over a pit", "nothing below", "floats", "sinks", "walks into a wall"],
)
def test_a_subject_without_ground_or_room_is_refused(world, reason, value):
    refusal = spawn_refusal(world)

    assert refusal.reason == reason
    assert value is None or refusal.value == pytest.approx(value)
    assert (refusal.value > refusal.limit) == (reason == "spawn_support")


def test_a_subject_is_put_on_a_floor_with_headroom():
    """Under a table there are 80 cm, on it there is room; the sky above is open."""
    world = yard(((-1, -1, 0.8), (1, 1, 0.9)))

    spawn = find_spawn(proposal(), world=world)

    assert spawn.place_m[2] == pytest.approx(0.9)


def test_a_low_ceiling_or_a_hole_refuses_the_place():
    low = find_spawn(proposal(), world=yard(((-9, -9, 1.5), (9, 9, 11))))
    hole = find_spawn(proposal(), world=NOWHERE)

    assert (low.reason, low.value, low.limit) == ("spawn_space", pytest.approx(1.5), 2.0)
    assert hole.reason == "spawn_support"


# Poses.

WIDE = Rig(np.linspace(-1, 1, 6), (0.99, 0.99))
"""Looking along -x, the camera's right is at -y: camera 0 is at +y."""
NARROW = Rig(np.linspace(-0.01, 0.01, 6), (1.2, 1.2))
CLOSE = Rig(NARROW.lateral_m, (8.0, 8.0))
SLAB = ((3.5, -2, 0), (3.6, -0.05, 3))
POST = ((1.9, 0.25, 0), (2.1, 0.75, 3))
BESIDE = ((3.7, -1.2, 0.7), (4.3, -0.9, 1.3))
HOLLOW = [
    ((2.9, -1.1, 0), (3, 1.1, 2.1)), ((5, -1.1, 0), (5.1, 1.1, 2.1)),
    ((3, -1.1, 0), (5, -1, 2.1)), ((3, 1, 0), (5, 1.1, 2.1)), ((3, -1, 2), (5, 1, 2.1)),
]  # fmt: skip
"""A box of 2 m around the camera: nothing touches it, and nothing of the subject is seen."""


POSES = [
    ("a free view", yard(), {}, ""),
    ("a free view of a wide rig", yard(), {"rig": WIDE}, ""),
    ("a low wall", yard(((1.9, -3, 0), (2, 3, 0.6))), {}, ""),
    ("a wall 25 cm behind the cameras", yard(((4.25, -5, 0), (5, 5, 3))), {}, ""),
    ("a wall 15 cm behind them", yard(((4.15, -5, 0), (5, 5, 3))), {}, "collision"),
    ("a block beside a narrow rig", yard(BESIDE), {}, ""),
    ("a block in the outermost camera", yard(BESIDE), {"rig": WIDE}, "collision"),
    ("outside the map", yard(size_m=((-3, -3, 0), (3, 3, 3))), {}, "collision"),
    ("in the subject", yard(), {"eye": (0.45, 0, 0.9), "rig": CLOSE}, "collision"),
    ("a wall before the subject", yard(((1.9, -3, 0), (2, 3, 3))), {}, "visibility"),
    ("a wall before half of it", yard(((1.9, -3, 0), (2, 3, 1.2))), {}, "visibility"),
    ("a post before one camera", yard(POST), {"rig": WIDE}, "visibility"),
    ("a roomy box around the cameras", yard(*HOLLOW), {}, "visibility"),
    ("behind the cameras", yard(), {"yaw": 0.0}, "framing"),
    ("beside the picture", yard(), {"yaw": 150.0}, "framing"),
    ("larger than the picture", yard(), {"eye": (1, 0, 0.9)}, "framing"),
    ("small", yard(), {"eye": (18.9, 0, 1.0)}, "framing"),
    ("a picture full of sky", Blocks([FLOOR]), {"pitch": 8.0}, "valid_depth"),
    ("a near slab on the right", yard(SLAB), {"rig": NARROW}, "border_occluder"),
]


@pytest.mark.parametrize(
    ("world", "pose", "reason"), [row[1:] for row in POSES], ids=[row[0] for row in POSES]
)
def test_a_pose_is_refused_for_what_is_in_its_way(world, pose, reason):
    assert looking(world, **pose).tolist() == [reason]


def test_a_thin_wall_between_two_frames_is_an_obstruction():
    wall = ((1.0, -5, 0), (1.01, 5, 3))
    eyes = np.ones((3, 6, 3))
    eyes[:, :, 1] = np.linspace(-0.5, 0.5, 6)
    eyes[:, :, 0] = np.array([0.8, 0.95, 1.1])[:, None]

    assert obstructed(eyes, world=yard(wall)).tolist() == [False, True]


# Whole proposals.


@pytest.mark.parametrize("frames", [1, 9])
def test_a_free_yard_accepts_and_every_frame_holds(frames):
    for number in range(3):
        drawn = replace(proposal(frames=frames), number=number)

        plan = examine(drawn, world=yard(walk_m=1.0))

        assert plan.centres_m.shape == plan.rotators_deg.shape == (frames, 3)
        assert plan.subject_m.min() > 0.5


def test_a_subject_that_jumps_from_one_frame_to_the_next_is_refused():
    refusal = examine(proposal(), world=yard(walk_m=1.0, jump_m=1.0))

    assert (refusal.reason, refusal.limit) == ("subject_motion", LIMITS.subject_step_m)
    assert refusal.value == pytest.approx(1.0 + 1 / 80)


def test_a_subject_that_runs_through_a_fence_between_frames_0_and_8_is_refused():
    fence = [
        ((-1.1, -1.1, 0), (-1.0, 1.1, 1)), ((1.0, -1.1, 0), (1.1, 1.1, 1)),
        ((-1.0, -1.1, 0), (1.0, -1.0, 1)), ((-1.0, 1.0, 0), (1.0, 1.1, 1)),
    ]  # fmt: skip

    refusal = examine(proposal(), world=yard(*fence, walk_m=24.0))

    assert refusal.reason == "spawn_space"


def test_a_yard_that_walls_cut_has_a_path_all_of_which_passes():
    walls = []
    for turn in np.arange(6) * np.pi / 3 + 0.2:
        out = np.array([np.cos(turn), np.sin(turn)])
        for reach in np.arange(1.2, 4.5, 0.3):
            x, y = reach * out
            walls.append(((x - 0.16, y - 0.16, 0), (x + 0.16, y + 0.16, 5)))
    world = yard(*walls)
    drawn = propose(SynthRequest(size_px=64, frames=81, focal_mm=20.0), index=0, number=0)

    plan = examine(drawn, world=world)

    body_m = np.stack([world.subject_points_m(plan.spawn, frame=t) for t in range(81)])
    reasons = check_poses(
        plan.centres_m, plan.rotators_deg, body_m=body_m, rig=drawn.rig, world=world
    )
    assert (reasons == "").all()
