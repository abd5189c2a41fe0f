"""Depth against numbers worked by other means: by hand, by bisection, by a finer picture."""

import numpy as np
import pytest

from stereogenbench_data.synthesis.maps import open_map
from stereogenbench_data.synthesis.planning import plan_scene
from stereogenbench_data.synthesis.ray_casting import (
    GROUND,
    SKY,
    first_hits,
    hits_of_list,
    shape_of,
)
from stereogenbench_data.synthesis.render import SceneState, render_frame, static_light
from stereogenbench_data.synthesis.renderer import View
from stereogenbench_data.synthesis.request import SynthRequest
from stereogenbench_data.synthesis.scene import Material, Shape

LEVEL = np.zeros(2)
STONE = Material("plaster", 1.0, (1.0, 1.0, 1.0))


def view_from(eye, *, size_px=(5, 5), focal_px=5.0):
    """A camera that looks along the scene's x axis, its principal point in the middle."""
    return View(
        eye=np.array(eye),
        axes=np.eye(3),
        focal_px=(focal_px, focal_px),
        size_px=size_px,
    )


def state_of(plan, *, frame):
    world = open_map(plan.proposal)
    walker = world.figure.limbs(plan.spawn, slope=world.slope, frame=frame)
    return SceneState(world, walker=walker, static_light=static_light(world))


def depth_of(shapes, view, *, slope=LEVEL):
    inverse, faces = first_hits(view, shapes=shapes, slope=slope)
    with np.errstate(divide="ignore"):
        return 1 / inverse, faces


def solid(kind, x_m, half_m):
    return Shape(kind, np.array([x_m, 0.0, 2.0]), np.eye(3), np.array(half_m), STONE)


NEAR, FAR = solid("box", 3.0, [0.4] * 3), solid("box", 8.0, [3.9] * 3)


@pytest.mark.parametrize(
    ("shapes", "row", "depths_m"),
    [
        ([], [0, 1, 2, 3, 4], [np.inf, np.inf, np.inf, 10.0, 5.0]),
        ([solid("box", 6.0, [2.0, 1.9, 1.9])], [0, 2, 4], [4.0, 4.0, 4.0]),
        ([solid("ellipsoid", 6.0, [1.5] * 3)], [0, 2], [np.inf, 4.5]),
        ([NEAR, FAR], [2, 0], [2.6, 4.1]),
        ([FAR, NEAR], [2, 0], [2.6, 4.1]),
        ([solid("box", -3.0, [1.0] * 3)], [2], [np.inf]),
    ],
    ids=["ground", "a face", "a ball", "near, far", "far, near", "behind"],
)
def test_depth_along_the_axis_is_as_worked_by_hand(shapes, row, depths_m):
    """Rows look 0.4, 0.2, 0, -0.2, -0.4 up at depth 1, from 2 m: 10 m and 5 m to the ground."""
    depth_m, faces = depth_of(shapes, view_from([0.0, 0.0, 2.0]))

    np.testing.assert_allclose(depth_m[row, 2], depths_m)
    assert (faces[row, 2] == SKY).tolist() == np.isinf(depths_m).tolist()


@pytest.mark.parametrize("index", range(2))
def test_every_hit_lies_on_the_surface_of_its_solid(index):
    """Independent of how it was found: the point at that depth fulfils the solid's equation."""
    plan = plan_scene(SynthRequest(family="Uniform", size_px=48), index=index)[0]
    state = state_of(plan, frame=40)
    view = plan.view(camera=2, frame=40)
    depth_m, faces = depth_of(state.shapes, view, slope=state.scene.slope)

    v, u = np.nonzero(np.isfinite(depth_m))
    camera = np.stack(
        [
            np.ones(len(u)),
            (u + 0.5 - 24) / plan.proposal.focal_px[0],
            (23.5 - v) / plan.proposal.focal_px[1],
        ]
    )
    points = view.eye[:, None] + depth_m[v, u] * (view.axes @ camera)
    checked = 0
    for point, met in zip(points.T, faces[v, u], strict=True):
        if met == GROUND:
            level = point[2] - state.scene.slope @ point[:2]
        else:
            shape = state.shapes[shape_of(met)]
            place = shape.axes @ (point - shape.centre) / shape.half_m
            level = np.abs(place).max() - 1 if shape.kind == "box" else np.linalg.norm(place) - 1
        assert abs(level) < 1e-9
        checked += 1
    assert checked > 1000


def test_strips_of_a_large_picture_join_without_a_seam():
    """A 1280 px picture is cast in strips; its rows are those of rays cast one row at a time."""
    plan = plan_scene(SynthRequest(size_px=1280, height_px=112), index=0)[0]
    state = state_of(plan, frame=0)
    view = plan.view(camera=0, frame=0)

    picture, depth_m = render_frame(state, view=view)

    assert picture.shape == (112, 1280, 3)
    np.testing.assert_array_equal(depth_m, depth_of(state.shapes, view, slope=state.scene.slope)[0])
    among = [(number, np.arange(1280)) for number in range(len(state.shapes))]
    for row in (0, 101, 102, 111):
        inverse, _ = hits_of_list(
            view,
            right=view.right_of_axis(np.arange(1280) + 0.5),
            below=np.full(1280, view.below_axis(row + 0.5)),
            shapes=state.shapes,
            slope=state.scene.slope,
            among=among,
        )
        with np.errstate(divide="ignore"):
            np.testing.assert_allclose(depth_m[row], 1 / inverse, rtol=1e-9)
