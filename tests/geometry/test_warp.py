import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from stereogenbench_data.geometry import projection as projection_module
from stereogenbench_data.geometry.projection import (
    backward_warp,
    project_rectified,
    splat,
    visible_from_source,
    visible_in_target,
)


def splat_pixel_by_pixel(image, u_px, v_px, depth_m, measured):
    """Paint from far to near, in python; of equally near pixels the later one stays."""
    warped, hole = np.zeros_like(image), np.ones(depth_m.shape, dtype=bool)
    height, width = depth_m.shape
    for flat in np.argsort(-depth_m, axis=None, kind="stable"):
        v, u = np.unravel_index(flat, depth_m.shape)
        if measured[v, u] and 0 <= u_px[v, u] < width and 0 <= v_px[v, u] < height:
            place = int(v_px[v, u]), int(u_px[v, u])
            warped[:, *place], hole[place] = image[:, v, u], False
    return warped, hole


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    dtype=st.sampled_from([np.uint8, np.uint16, np.float32]),
    rows=st.sampled_from(["kept", "moved"]),
)
def test_a_splat_is_painting_from_far_to_near(library, seed, dtype, rows):
    rng = np.random.default_rng(seed)
    depth_m = rng.choice([1.0, 2.0, 2.5, 700.0], (5, 6)).astype(np.float32)
    u_px = rng.uniform(-2, 8, (5, 6)).astype(np.float32)
    v_px = rng.uniform(-2, 7, (5, 6)).astype(np.float32)
    if rows == "kept":
        v_px = np.broadcast_to((np.arange(5, dtype=np.float32) + 0.5)[:, None], (5, 6)).copy()
    image = rng.integers(1, 200, (3, 5, 6)).astype(dtype)
    if library.name == "torch" and dtype == np.uint16:
        image = image.astype(np.int32)
    measured = rng.random((5, 6)) < 0.8

    warped, hole = splat(
        library.array(image),
        library.projection(u_px, v_px, depth_m, rows=rows),
        measured=library.array(measured),
    )

    expected, expected_hole = splat_pixel_by_pixel(image, u_px, v_px, depth_m, measured)
    assert library.numpy(warped).dtype == image.dtype
    np.testing.assert_array_equal(library.numpy(warped), expected)
    np.testing.assert_array_equal(library.numpy(hole), expected_hole)


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    dtype=st.sampled_from([np.uint8, np.float32, np.float64]),
    rows=st.sampled_from(["kept", "moved"]),
)
def test_a_backward_warp_is_scipys_interpolation_between_pixel_centres(library, seed, dtype, rows):
    rng = np.random.default_rng(seed)
    image = (rng.random((2, 3, 6, 7)) * 255).astype(dtype)
    shape = (2, 6, 5) if rows == "kept" else (2, 4, 5)
    u_px = rng.uniform(-1, 8, shape)
    v_px = rng.uniform(-1, 7, shape)
    u_px[0, 0, 0] = v_px[0, 0, 0] = np.nan
    if rows == "kept":
        v_px = np.broadcast_to((np.arange(6) + 0.5)[:, None], shape)

    warped, inside = backward_warp(
        library.array(image),
        library.projection(u_px, v_px, np.ones(shape), rows=rows),
    )

    expected_inside = (u_px >= 0) & (u_px < 7) & (v_px >= 0) & (v_px < 6)
    np.testing.assert_array_equal(library.numpy(inside), expected_inside)
    assert library.numpy(warped).dtype == (np.float64 if dtype == np.float64 else np.float32)
    for item, channel in np.ndindex(2, 3):
        sampled = map_coordinates(
            image[item, channel].astype(np.float64),
            [np.nan_to_num(v_px[item]) - 0.5, np.nan_to_num(u_px[item]) - 0.5],
            order=1,
            mode="nearest",
        )
        expected = np.where(expected_inside[item], sampled, 0.0)
        np.testing.assert_allclose(library.numpy(warped)[item, channel], expected, atol=1e-4)


def test_blocks_of_rows_give_the_result_of_one_block(monkeypatch):
    rng = np.random.default_rng(3)
    shape = (2, 9, 16)
    depth_m, target_m = rng.uniform(1, 4, (2, *shape)).astype(np.float32)
    measured, seen = rng.random((2, *shape)) > 0.2
    image = rng.integers(0, 256, (2, 3, 9, 16)).astype(np.uint8)
    projection = project_rectified(depth_m, (8 / depth_m).astype(np.float32))
    quantum_m = rng.uniform(0, 0.1, shape).astype(np.float32)

    def all_of_it():
        return (
            *splat(image, projection, measured=measured),
            *backward_warp(image, projection),
            visible_from_source(projection, measured=measured, quantum_m=quantum_m),
            visible_in_target(
                projection, measured=measured, target_depth_m=target_m, target_measured=seen,
                quantum_m=quantum_m,
            ),
        )  # fmt: skip

    whole = all_of_it()
    monkeypatch.setattr(projection_module, "_BLOCK_PIXELS", 2 * 2 * 16)

    for one, other in zip(whole, all_of_it(), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
