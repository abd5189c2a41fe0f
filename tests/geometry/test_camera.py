from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereogenbench_data.errors import GeometryError
from stereogenbench_data.geometry.camera import Intrinsics, rig_intrinsics
from stereogenbench_data.schema.records import Rig

sizes_px = st.integers(1, 4000)


RIG = Rig(
    focal_mm=32.599998, sensor_width_mm=23.76, sensor_height_mm=23.76,
    image_width_px=1280, image_height_px=1280, principal_point_px=None,
    baselines_cm=(10.0,) * 15, primary_pair=(0, 1),
)  # fmt: skip


def test_the_focal_length_in_pixels_of_a_real_scene():
    intrinsics = rig_intrinsics(RIG)

    assert intrinsics.fx_px == pytest.approx(1756.2288, abs=1e-4)
    assert (intrinsics.cx_px, intrinsics.cy_px) == (640.0, 640.0)


def test_a_sensor_that_is_not_square_gives_each_axis_its_own_focal_length():
    """Also where pictures are stored at half the recorded width."""
    lens = {"focal_mm": 50.0, "sensor_width_mm": 36.0, "sensor_height_mm": 24.0}
    rig = replace(
        RIG, **lens, principal_point_px=(300.0, 400.0), image_width_px=720, image_height_px=720
    )
    stored = replace(rig, recorded_size_px=(720, 720), image_width_px=360)

    assert rig_intrinsics(rig) == Intrinsics(1000.0, 1500.0, 300.0, 400.0, 720, 720)
    assert rig_intrinsics(stored) == Intrinsics(500.0, 1500.0, 150.0, 400.0, 360, 720)


def test_the_evaluators_resize_scales_each_axis_by_its_own_factor():
    released = Intrinsics(1756.0, 1756.0, 640.0, 640.0, 1280, 1280)
    resized = released.resized(width_px=832, height_px=480)

    assert resized.fx_px == pytest.approx(1756 * 0.65, rel=1e-15)
    assert resized.fy_px == pytest.approx(1756 * 0.375, rel=1e-15)
    assert (resized.cx_px, resized.cy_px) == (416.0, 240.0)


def test_a_crop_moves_the_principal_point_and_nothing_else(intrinsics):
    """Past the principal point, and padded on the left and the top."""
    for left_px, top_px, centre in ((24, 20, (-2.5, -6.0)), (-8, -5, (29.5, 19.0))):
        cropped = intrinsics.cropped(left_px=left_px, top_px=top_px, width_px=16, height_px=10)

        assert cropped == Intrinsics(70.0, 66.0, *centre, 16, 10)


def test_a_flip_mirrors_the_principal_point_about_the_images_middle(intrinsics):
    assert intrinsics.flipped().cx_px == 40 - 21.5
    assert intrinsics.flipped().flipped() == intrinsics


@given(width_px=sizes_px, height_px=sizes_px, x=st.floats(-1, 1), y=st.floats(-1, 1))
def test_a_ray_lands_on_the_same_fraction_of_the_image_at_every_size(width_px, height_px, x, y):
    intrinsics = Intrinsics(70.0, 66.0, 21.5, 14.0, 40, 30)
    resized = intrinsics.resized(width_px=width_px, height_px=height_px)

    u_px, v_px, _ = intrinsics.matrix() @ [x, y, 1.0]
    resized_u_px, resized_v_px, _ = resized.matrix() @ [x, y, 1.0]

    np.testing.assert_allclose(resized_u_px / width_px, u_px / 40, atol=1e-12)
    np.testing.assert_allclose(resized_v_px / height_px, v_px / 30, atol=1e-12)


@pytest.mark.parametrize(
    "changes",
    [{"width_px": 0}, {"fx_px": 0.0}, {"fy_px": float("nan")}, {"cx_px": float("inf")}],
    ids=str,
)
def test_intrinsics_out_of_range_are_refused(intrinsics, changes):
    ((name, value),) = changes.items()

    with pytest.raises(GeometryError, match=f"{name}={value}"):
        replace(intrinsics, **changes)
