import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.geometry.disparity import disparity_from_depth
from stereogenbench_data.geometry.projection import (
    Projection,
    project_rectified,
    visible_from_source,
    visible_in_target,
)


def row(library, *values, dtype=np.float32):
    return library.array(np.array([values], dtype=dtype))


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
    target = row(library, target_m)

    visible = visible_in_target(
        projection,
        measured=measured,
        target_depth_m=target,
        target_measured=target > 0,
        quantum_m=0.1,
    )

    assert library.numpy(visible).tolist() == [[expected]]


def test_only_the_target_depth_shows_an_occluder_outside_the_source_view(library):
    """A wall at 2 m moves by one column; the target sees a pole at 0.5 m that the source cannot.

    The pole stands in the target's column 2, to which it moved by four columns: from column 6
    of a source view that ends at column 5.
    """
    projection, measured = pair(library, [2.0] * 6, shift_px_m=2.0)
    target = row(library, 2.0, 2.0, 0.5, 2.0, 2.0, 2.0)

    by_target = visible_in_target(
        projection,
        measured=measured,
        target_depth_m=target,
        target_measured=target > 0,
        quantum_m=0.001,
    )
    by_source = visible_from_source(projection, measured=measured, quantum_m=0.001)

    assert library.numpy(by_target).tolist() == [[False, True, True, False, True, True]]
    assert library.numpy(by_source).tolist() == [[False, True, True, True, True, True]]


def test_of_two_source_pixels_on_one_target_pixel_the_farther_is_hidden(library):
    """Columns 2 (at 2 m, one to the left) and 3 (at 1 m, two to the left) meet in column 1."""
    projection, measured = pair(library, [2.0, 2.0, 2.0, 1.0, 2.0], shift_px_m=2.0)

    visible = visible_from_source(projection, measured=measured, quantum_m=0.001)

    assert library.numpy(visible).tolist() == [[False, True, False, True, True]]


def brute_force(projection: Projection, measured, target_m, target_measured, tolerance, quantum_m):
    """Return visibility decided pixel by pixel, in python."""
    visible = np.zeros(measured.shape, dtype=bool)
    for v, u in np.ndindex(*measured.shape):
        row_px = v if projection.v_px is None else projection.v_px[v, u]
        column_px, depth_m = projection.u_px[v, u], projection.depth_m[v, u]
        if not (measured[v, u] and 0 <= column_px < target_m.shape[1]):
            continue
        if not 0 <= row_px < target_m.shape[0]:
            continue
        place = int(row_px), int(column_px)
        difference_m = abs(float(target_m[place]) - float(depth_m))
        agrees = difference_m <= tolerance * float(depth_m) + 2 * quantum_m
        visible[v, u] = target_measured[place] and agrees
    return visible


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), rows=st.sampled_from(["kept", "moved"]))
def test_whole_maps_are_decided_as_pixel_by_pixel(library, seed, rows):
    rng = np.random.default_rng(seed)
    shape, target_shape = (6, 9), (6, 9) if rows == "kept" else (5, 11)
    depth_m = rng.uniform(1.0, 1.2, shape)
    u_px = rng.uniform(-2.0, target_shape[1] + 2.0, shape)
    v_px = rng.uniform(-2.0, target_shape[0] + 2.0, shape)
    u_px[0, 0] = v_px[0, 0] = np.nan
    measured, target_measured = rng.random(shape) < 0.8, rng.random(target_shape) < 0.8
    target_m = rng.uniform(1.0, 1.2, target_shape)
    expected = brute_force(
        Projection(u_px, None if rows == "kept" else v_px, depth_m),
        measured,
        target_m,
        target_measured,
        tolerance=0.03,
        quantum_m=0.01,
    )

    visible = visible_in_target(
        library.projection(u_px, v_px, depth_m, rows=rows),
        measured=library.array(measured),
        target_depth_m=library.array(target_m),
        target_measured=library.array(target_measured),
        quantum_m=0.01,
        tolerance=0.03,
    )

    np.testing.assert_array_equal(library.numpy(visible), expected)


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), rows=st.sampled_from(["kept", "moved"]))
def test_a_pixel_is_hidden_where_a_nearer_one_lands_beside_it(library, seed, rows):
    """Against each pixel's nearest rival, found by comparing all pixels with all."""
    rng = np.random.default_rng(seed)
    shape = height, width = 5, 9
    depth_m = np.where(rng.random(shape) < 0.1, np.inf, rng.uniform(1.0, 1.3, shape))
    u_px, v_px = rng.uniform(-2.0, width + 2.0, shape), rng.uniform(-2.0, height + 2.0, shape)
    u_px[0, 0] = v_px[0, 0] = np.nan
    measured = rng.random(shape) < 0.8
    row_px = np.arange(height)[:, None] + 0.5 if rows == "kept" else v_px
    landed = measured & (u_px >= 0) & (u_px < width) & (row_px >= 0) & (row_px < height)
    cells = np.broadcast_to(np.floor(row_px) * width + np.floor(u_px), shape)
    beside = (cells[..., None, None] == cells) & landed
    nearest_m = np.where(beside, depth_m, np.inf).min(axis=(-1, -2))

    visible = visible_from_source(
        library.projection(u_px, v_px, depth_m, rows=rows),
        measured=library.array(measured),
        quantum_m=0.01,
        tolerance=0.03,
    )

    expected = landed & (nearest_m >= depth_m * 0.97 - 0.02)
    np.testing.assert_array_equal(library.numpy(visible), expected)
