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


def looking(world, *, eye, rig=None, yaw=180.0, pitch=0.0):
    """The verdict on one pose of a narrow rig; the subject stands at the origin."""
    return check_poses(
        np.array([eye], float),
        np.array([[pitch, yaw, 0.0]]),
        body_m=world.subject_points_m(HERE, frame=0)[None],
        rig=rig or Rig(np.linspace(-0.16, 0.16, 6), (0.99, 0.99)),
        world=world,
    )


# The spawn.


def test_a_subject_on_an_open_floor_is_accepted():
    assert spawn_refusal(yard()) is None
    assert spawn_refusal(yard(walk_m=3.5)) is None


def test_a_pit_refuses_the_subject_that_walks_over_it():
    """The floor ends a metre ahead; three metres below there is another one."""
    world = Blocks([((-20, -20, -1), (1, 20, 0)), ((-20, -20, -4), (20, 20, -3))], walk_m=3.5)

    refusal = spawn_refusal(world)

    assert refusal.reason == "spawn_support"
    assert refusal.value == pytest.approx(3.0)
    assert refusal.limit == LIMITS.support_gap_m


def test_nothing_below_the_subject_refuses_it():
    refusal = spawn_refusal(Blocks([((5, 5, -1), (6, 6, 0))]))

    assert (refusal.reason, refusal.value) == ("spawn_support", np.inf)


def test_a_subject_that_floats_or_sinks_is_refused():
    assert spawn_refusal(yard(sunk_m=-0.3)).value == pytest.approx(0.3)
    assert spawn_refusal(yard(sunk_m=0.3)).reason == "spawn_support"
    assert spawn_refusal(yard(sunk_m=0.1)) is None


def test_a_wall_in_the_way_refuses_the_subject_that_walks_into_it():
    wall = ((2, -5, 0), (2.2, 5, 3))

    assert spawn_refusal(yard(wall)) is None
    refusal = spawn_refusal(yard(wall, walk_m=1.8))
    assert refusal.reason == "spawn_space"
    assert refusal.value < LIMITS.body_space_m


def test_a_subject_is_put_on_a_floor_with_headroom():
    """Under a table there are 80 cm, on it there is room; the sky above is open."""
    world = yard(((-1, -1, 0.8), (1, 1, 0.9)))

    spawn = find_spawn(proposal(), world=world)

    assert spawn.place_m[2] == pytest.approx(0.9)


def test_a_low_ceiling_refuses_all_floors():
    world = yard(((-9, -9, 1.5), (9, 9, 11)))

    refusal = find_spawn(proposal(), world=world)

    assert (refusal.reason, refusal.limit) == ("spawn_space", 2.0)
    assert refusal.value == pytest.approx(1.5)


def test_a_hole_without_a_floor_refuses_the_place():
    world = Blocks([((5, 5, -1), (6, 6, 0))])

    assert find_spawn(proposal(), world=world).reason == "spawn_support"


# Poses.


def test_a_free_view_of_the_subject_passes():
    assert looking(yard(), eye=(4, 0, 1.0)).passed.all()


def test_a_wall_before_the_subject_hides_it_whatever_the_camera_sees():
    checks = looking(yard(((1.9, -3, 0), (2, 3, 3))), eye=(4, 0, 1.0))

    assert (checks.reasons[0], checks.values[0]) == ("visibility", 0.0)


def test_a_post_before_one_of_six_cameras_is_enough():
    """The rig is 2 m wide; the post is between camera 0 and the subject only."""
    wide = Rig(np.linspace(-1, 1, 6), (0.99, 0.99))
    side = -1 / 2  # Looking along -x, the camera's right is at -y: camera 0 is at +y.
    post = ((1.9, -side - 0.25, 0), (2.1, -side + 0.25, 3))

    assert looking(yard(), eye=(4, 0, 1.0), rig=wide).passed.all()
    assert looking(yard(post), eye=(4, 0, 1.0), rig=wide).reasons[0] == "visibility"


def test_half_a_wall_hides_half_the_subject():
    low, high = ((1.9, -3, 0), (2, 3, 0.6)), ((1.9, -3, 0), (2, 3, 1.2))

    assert looking(yard(low), eye=(4, 0, 1.0)).passed.all()
    checks = looking(yard(high), eye=(4, 0, 1.0))
    assert checks.reasons[0] == "visibility"
    assert 0 < checks.values[0] < LIMITS.visible_share


def test_a_box_around_the_camera_leaves_it_no_view_even_if_it_is_roomy():
    """A hollow box of 2 m: no camera touches it, and nothing of the subject is seen."""
    hollow = [
        ((2.9, -1.1, 0), (3, 1.1, 2.1)), ((5, -1.1, 0), (5.1, 1.1, 2.1)),
        ((3, -1.1, 0), (5, -1, 2.1)), ((3, 1, 0), (5, 1.1, 2.1)), ((3, -1, 2), (5, 1, 2.1)),
    ]  # fmt: skip

    assert looking(yard(*hollow), eye=(4, 0, 1.0)).reasons[0] == "visibility"


@pytest.mark.parametrize(("gap_m", "passes"), [(0.25, True), (0.15, False)])
def test_a_camera_keeps_its_distance_from_a_wall(gap_m, passes):
    wall = ((4 + gap_m, -5, 0), (5, 5, 3))

    checks = looking(yard(wall), eye=(4, 0, 1.0))

    assert checks.passed[0] == passes
    if not passes:
        assert checks.reasons[0] == "collision"
        assert checks.values[0] == pytest.approx(gap_m)


def test_the_outermost_camera_alone_can_collide():
    wide = Rig(np.linspace(-1, 1, 6), (0.99, 0.99))
    block = ((3.7, -1.2, 0.7), (4.3, -0.9, 1.3))

    assert looking(yard(block), eye=(4, 0, 1.0)).passed.all()
    assert looking(yard(block), eye=(4, 0, 1.0), rig=wide).reasons[0] == "collision"


def test_a_camera_outside_the_map_collides_though_nothing_is_near_it():
    world = yard(size_m=((-3, -3, 0), (3, 3, 3)))

    checks = looking(world, eye=(4, 0, 1.0))

    assert (checks.reasons[0], checks.values[0]) == ("collision", pytest.approx(-1.0))


def test_a_camera_inside_the_subject_collides():
    near = Rig(np.linspace(-0.01, 0.01, 6), (8.0, 8.0))

    assert looking(yard(), eye=(0.45, 0, 0.9), rig=near).reasons[0] == "collision"


@pytest.mark.parametrize(
    ("pose", "what"),
    [
        ({"eye": (4, 0, 1.0), "yaw": 0.0}, "the subject is behind"),
        ({"eye": (4, 0, 1.0), "yaw": 150.0}, "the subject is beside the picture"),
        ({"eye": (1.0, 0, 0.9)}, "the subject is larger than the picture"),
        ({"eye": (18.9, 0, 1.0)}, "the subject is small"),
    ],
)
def test_a_subject_out_of_frame_too_large_or_too_small_is_refused(pose, what):
    checks = looking(yard(), **pose)

    assert checks.reasons[0] == "framing", what


def test_a_picture_full_of_sky_has_too_little_depth():
    world = Blocks([FLOOR], size_m=((-20, -20, 0), (20, 20, 12)))

    checks = looking(world, eye=(4, 0, 1.0), pitch=8.0)

    assert checks.reasons[0] == "valid_depth"
    assert checks.values[0] < LIMITS.valid_share


def test_a_near_block_over_a_side_of_the_picture_is_an_occluder():
    """A slab 40 cm before the cameras covers the right third, beside the subject."""
    slab = ((3.5, -2, 0), (3.6, -0.05, 3))
    narrow = Rig(np.linspace(-0.01, 0.01, 6), (1.2, 1.2))

    assert looking(yard(slab), eye=(4, 0.05, 1.0), rig=narrow).reasons[0] == "border_occluder"


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
    assert check_poses(
        plan.centres_m, plan.rotators_deg, body_m=body_m, rig=drawn.rig, world=world
    ).passed.all()
