import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.geometry.disparity import disparity_from_depth
from stereogenbench_data.geometry.projection import (
    project_rectified,
    visible_from_source,
    visible_in_target,
)


def row(library, *values, dtype=np.float32):
    return library.array(np.array([values], dtype=dtype))


def seen_by_target(projection, measured, target_m, *, quantum_m):
    target = {"target_depth_m": target_m, "target_measured": target_m > 0}
    return visible_in_target(projection, measured=measured, **target, quantum_m=quantum_m)


def pair(library, depth_m, *, shift_px_m):
    """Return the projection and the mask of a source row, for B f in px m."""
    depth = row(library, *depth_m)
    disparity_px = disparity_from_depth(depth, focal_px=shift_px_m, baseline_m=1.0)
    return project_rectified(depth, disparity_px), depth > 0


@pytest.mark.parametrize(
    ("source_m", "target_m", "expected"),
    [
        pytest.param(10.0, 10.0, True, id="equal"),
        pytest.param(10.0, 10.39, True, id="2 % and two quanta farther"),
        pytest.param(10.0, 9.61, True, id="2 % and two quanta nearer"),
        pytest.param(10.0, 10.41, False, id="in front of what the target sees"),
        pytest.param(10.0, 9.59, False, id="behind what the target sees"),
        pytest.param(0.1, 0.0, False, id="an unmeasured target does not count as near"),
        pytest.param(np.inf, np.inf, True, id="sky before sky"),
        pytest.param(np.inf, 10.0, False, id="sky behind a wall"),
        pytest.param(10.0, np.inf, False, id="a wall before sky"),
        pytest.param(0.0, 10.0, False, id="an unmeasured source"),
    ],
)
def test_a_target_sees_points_that_agree_with_its_own_depth(library, source_m, target_m, expected):
    projection, measured = pair(library, [source_m], shift_px_m=1e-3)

    visible = seen_by_target(projection, measured, row(library, target_m), quantum_m=0.1)

    assert library.numpy(visible).tolist() == [[expected]]


def test_only_the_target_depth_shows_an_occluder_outside_the_source_view(library):
    """A wall at 2 m moves by one column; the target sees a pole at 0.5 m that the source cannot.

    The pole stands in the target's column 2, to which it moved by four columns: from column 6
    of a source view that ends at column 5.
    """
    projection, measured = pair(library, [2.0] * 6, shift_px_m=2.0)
    target = row(library, 2.0, 2.0, 0.5, 2.0, 2.0, 2.0)

    by_target = seen_by_target(projection, measured, target, quantum_m=0.001)
    by_source = visible_from_source(projection, measured=measured, quantum_m=0.001)

    assert library.numpy(by_target).tolist() == [[False, True, True, False, True, True]]
    assert library.numpy(by_source).tolist() == [[False, True, True, True, True, True]]


def test_of_two_source_pixels_on_one_target_pixel_the_farther_is_hidden(library):
    """Columns 2 (at 2 m, one to the left) and 3 (at 1 m, two to the left) meet in column 1."""
    projection, measured = pair(library, [2.0, 2.0, 2.0, 1.0, 2.0], shift_px_m=2.0)

    visible = visible_from_source(projection, measured=measured, quantum_m=0.001)

    assert library.numpy(visible).tolist() == [[False, True, False, True, True]]


class Scattered:
    """Points of a map of 6x9 pixels that land anywhere in and around a target, some nowhere."""

    def __init__(self, seed, rows, *, target_shape):
        self.rng = np.random.default_rng(seed)
        height, width = target_shape
        self.depth_m = self.rng.uniform(1.0, 1.2, (6, 9))
        self.u_px = self.rng.uniform(-2.0, width + 2.0, (6, 9))
        self.v_px = self.rng.uniform(-2.0, height + 2.0, (6, 9))
        if rows == "kept":
            self.v_px = np.tile(np.arange(6)[:, None] + 0.5, (1, 9))
        self.u_px[0, 0] = np.nan
        self.measured = self.rng.random((6, 9)) < 0.8
        inside = (self.u_px >= 0) & (self.u_px < width) & (self.v_px >= 0) & (self.v_px < height)
        self.landed = self.measured & inside

    def places(self):
        """Return each pixel that lands, with the target's pixel."""
        for place in np.argwhere(self.landed):
            yield tuple(place), (int(self.v_px[*place]), int(self.u_px[*place]))


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), rows=st.sampled_from(["kept", "moved"]))
def test_whole_maps_are_decided_as_pixel_by_pixel(library, seed, rows):
    shape = (6, 9) if rows == "kept" else (5, 11)
    points = Scattered(seed, rows, target_shape=shape)
    target_m = points.rng.uniform(1.0, 1.2, shape)
    target_measured = points.rng.random(shape) < 0.8
    expected = np.zeros((6, 9), dtype=bool)
    for here, there in points.places():
        depth_m = float(points.depth_m[here])
        agrees = abs(float(target_m[there]) - depth_m) <= 0.03 * depth_m + 2 * 0.01
        expected[here] = target_measured[there] and agrees

    visible = visible_in_target(
        library.projection(points.u_px, points.v_px, points.depth_m, rows=rows),
        measured=library.array(points.measured),
        target_depth_m=library.array(target_m),
        target_measured=library.array(target_measured),
        quantum_m=0.01,
        tolerance=0.03,
    )

    np.testing.assert_array_equal(library.numpy(visible), expected)


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), rows=st.sampled_from(["kept", "moved"]))
def test_a_pixel_is_hidden_where_a_nearer_one_lands_beside_it(library, seed, rows):
    """Against each pixel's nearest rival; the sky is a rival of none."""
    points = Scattered(seed, rows, target_shape=(6, 9))
    points.depth_m[points.rng.random((6, 9)) < 0.1] = np.inf
    nearest_m = dict.fromkeys((there for _, there in points.places()), np.inf)
    for here, there in points.places():
        nearest_m[there] = min(nearest_m[there], points.depth_m[here])
    expected = np.zeros((6, 9), dtype=bool)
    for here, there in points.places():
        expected[here] = nearest_m[there] >= points.depth_m[here] * 0.97 - 0.02

    visible = visible_from_source(
        library.projection(points.u_px, points.v_px, points.depth_m, rows=rows),
        measured=library.array(points.measured),
        quantum_m=0.01,
        tolerance=0.03,
    )

    np.testing.assert_array_equal(library.numpy(visible), expected)
