from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.geometry import disparity as disparity_module
from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.disparity import (
    disparity_error_px,
    disparity_from_depth,
    disparity_from_shifts,
    planar_from_ray,
    write_disparity,
)

focals_px = st.floats(900.0, 4600.0)
baselines_m = st.floats(0.01, 7.5) | st.floats(-7.5, -0.01)
units_m = st.sampled_from([0.1, 0.01, 0.001, 1 / 256]) | st.floats(1e-4, 0.5)

ALL_UNITS = np.arange(2**16).reshape(1, 2**16)
UNREADABLE = (0.0, -1.0, np.nan)


def ulps_away(values: np.ndarray, exact: np.ndarray) -> float:
    """Return the largest distance from the float64 result in ulps of float32."""
    ulp = np.spacing(np.abs(exact).astype(np.float32)).astype(np.float64)
    return float(np.max(np.abs(values.astype(np.float64) - exact) / ulp))


def disparity_of(library, units, shift_units, *, form):
    """Return the disparity of stored numbers, a number of 0 not measured."""
    stored = np.where(units == 0, np.inf if form == "depth" else 0, units)
    shift = library.array(np.array(shift_units))
    stored = library.array(stored.astype(np.float64))
    return library.numpy(disparity_from_shifts(stored, shift, form=form))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    ("depth_m", "baseline_m", "expected_px"),
    [
        pytest.param(2.0, 0.125, 50.0, id="800 px * 0.125 m / 2 m"),
        pytest.param(2.0, -0.125, -50.0, id="a target to the left"),
        pytest.param(0.0625, 8.0, 102400.0, id="beyond any image's width"),
        pytest.param(np.inf, 0.125, 0.0, id="sky does not move"),
        *[pytest.param(z, 0.125, 0.0, id=f"{z} is not measured") for z in UNREADABLE],
    ],
)
def test_disparity_of_one_pixel(library, dtype, depth_m, baseline_m, expected_px):
    depth = library.array(np.array([[depth_m]], dtype=dtype))

    disparity_px = disparity_from_depth(depth, focal_px=800.0, baseline_m=baseline_m)

    assert library.numpy(disparity_px).dtype == dtype
    np.testing.assert_array_equal(library.numpy(disparity_px), [[expected_px]])


@settings(max_examples=50)
@given(focal_px=focals_px, baseline_m=baselines_m, unit_m=units_m)
def test_float32_disparity_is_the_float64_one_rounded(library, focal_px, baseline_m, unit_m):
    depth_m = (ALL_UNITS[:, 1:] * unit_m).astype(np.float32)
    exact = focal_px * baseline_m / depth_m.astype(np.float64)

    pair = {"focal_px": focal_px, "baseline_m": baseline_m}
    disparity_px = library.numpy(disparity_from_depth(library.array(depth_m), **pair))

    np.testing.assert_array_equal(disparity_px, exact.astype(np.float32))


@settings(max_examples=50)
@given(focal_px=focals_px, baseline_m=baselines_m, unit_m=units_m)
@pytest.mark.parametrize("form", ["depth", "inverse"])
def test_disparity_of_any_stored_number_is_within_an_ulp(
    library, form, focal_px, baseline_m, unit_m
):
    units = ALL_UNITS.astype(np.int32)
    depth_m = {"depth": units[:, 1:] * unit_m, "inverse": unit_m / units[:, 1:]}[form]

    disparity_px = disparity_of(library, units, focal_px * baseline_m / unit_m, form=form)

    assert disparity_px.dtype == np.float32
    assert disparity_px[0, 0] == 0.0
    assert ulps_away(disparity_px[:, 1:], focal_px * baseline_m / depth_m) < 0.55


@pytest.mark.parametrize(
    ("depth_m", "expected_px"),
    [
        pytest.param(1.0, 111.5 * 0.05 / 0.95, id="1 m"),
        pytest.param(10.0, 11.15 * 0.05 / 9.95, id="10 m"),
        pytest.param(0.05, np.inf, id="half a step: the truth may be arbitrarily near"),
        pytest.param(0.04, np.inf, id="less than half a step"),
        pytest.param(np.inf, 0.0, id="sky"),
        *[pytest.param(z, 0.0, id=f"{z} is not measured") for z in UNREADABLE],
    ],
)
def test_the_error_of_one_pixel_at_a_tenth_of_a_metre(library, depth_m, expected_px):
    depth = library.array(np.array([[depth_m]], dtype=np.float32))

    error_px = library.numpy(disparity_error_px(depth, shift_px_m=111.5, half_step_m=0.05))

    assert error_px.dtype == np.float32
    np.testing.assert_allclose(error_px, [[expected_px]], rtol=1e-4)


@settings(max_examples=100)
@given(
    focal_px=focals_px,
    baseline_m=baselines_m,
    quantum_m=units_m,
    dtype=st.sampled_from([np.float32, np.float64]),
    seed=st.integers(0, 2**32 - 1),
)
def test_rounded_depth_moves_disparity_within_the_bound(
    library, focal_px, baseline_m, quantum_m, dtype, seed
):
    """The truth lies anywhere in the step that was stored, its very ends included."""
    units = np.random.default_rng(seed).integers(1, 2**16, 500)
    units[:3] = 1, 2, 65535
    within = np.random.default_rng(seed).uniform(-0.5, 0.5, 500)
    within[::2] = np.sign(within[::2]) / 2
    true_m = (units + within) * quantum_m
    stored = library.array((units * quantum_m).astype(dtype)[None])
    pair = {"focal_px": focal_px, "baseline_m": baseline_m}

    disparity_px = library.numpy(disparity_from_depth(stored, **pair)).astype(np.float64)
    shift_px_m = focal_px * abs(baseline_m)
    bound_px = library.numpy(
        disparity_error_px(stored, shift_px_m=shift_px_m, half_step_m=quantum_m / 2)
    )

    error_px = np.abs(disparity_px - focal_px * baseline_m / true_m)
    assert (error_px <= bound_px).all()


def test_the_ray_to_the_corner_is_longer_than_its_depth(library):
    """In a 6x2 image with f = 1 the corner's centre is at x = 2.5, y = 0.5."""
    intrinsics = Intrinsics(1.0, 1.0, 3.0, 1.0, 6, 2)
    depth_m = planar_from_ray(library.array(np.full((2, 6), 4.0, dtype=np.float32)), intrinsics)

    assert library.numpy(depth_m).dtype == np.float32
    assert library.numpy(depth_m)[0, 0] == pytest.approx(4 / np.sqrt(1 + 2.5**2 + 0.5**2))
    assert library.numpy(depth_m)[1, 3] == pytest.approx(4 / np.sqrt(1 + 0.5**2 + 0.5**2))


@settings(max_examples=50)
@given(
    seed=st.integers(0, 2**32 - 1),
    shift_units=st.floats(1e-3, 1e9) | st.floats(-1e9, -1e-3),
    form=st.sampled_from(["depth", "inverse"]),
    rows=st.sampled_from([1, 2, 1000]),
)
def test_written_disparity_is_the_same_or_0(library, seed, shift_units, form, rows):
    """In blocks of any number of rows."""
    rng = np.random.default_rng(seed)
    units = rng.choice([0, 1, 7, *rng.integers(0, 65536, 20)], (2, 7, 5)).astype(np.uint16)
    measured = (rng.random(units.shape) < 0.8) & ((units > 0) | (form == "inverse"))
    out = np.full(units.shape, np.nan, dtype=np.float32)

    with mock.patch.object(disparity_module, "_BLOCK_PIXELS", rows * 5):
        write_disparity(out, units, measured=measured, shift_units=shift_units, form=form)

    returned = disparity_of(library, units, shift_units, form=form)
    np.testing.assert_array_equal(out, np.where(measured, returned, 0))
