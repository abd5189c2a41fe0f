"""What stored depth numbers mean: unit, kind, form, what is not measured, and which frame."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.media.container import StreamFacts
from stereogenbench_data.media.depth import (
    depth_frame_index,
    depth_m_from_units,
    measured,
    stated_unit,
)
from stereogenbench_data.schema.records import DepthEncoding

CAMERA = Intrinsics(1.5, 2.0, 0.5, 0.5, 3, 1)


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        pytest.param({"encoder": "Lavf"}, (0.1, "default"), id="no unit"),
        pytest.param({"depth_scale": "0.001"}, (0.001, "tag"), id="a number"),
        pytest.param({"depth_scale": "mm"}, (0.001, "tag"), id="millimetres"),
    ],
)
def test_the_unit_is_the_tags_or_the_releases(tags, expected):
    facts = StreamFacts("ffv1", "gray12le", 8, 8, 1, 15.0, tags)

    assert stated_unit(facts, name="clip") == expected


@pytest.mark.parametrize(
    ("pixel_format", "largest"),
    [("gray", 255), ("gray10le", 1023), ("gray12be", 4095), ("gray16le", 65535),
     ("yuv420p10le", 1023), ("yuvj420p", 255)],
)  # fmt: skip
def test_zero_and_the_formats_largest_number_are_not_measured(pixel_format, largest):
    units = np.array([[0, 1, largest - 1, largest]], dtype=np.uint16)

    found = measured(units, encoding=DepthEncoding(), pixel_format=pixel_format)

    np.testing.assert_array_equal(found, [[False, True, True, False]])


@settings(max_examples=50)
@given(unit_m=st.floats(1e-5, 10))
def test_metres_are_the_exact_product_rounded_once(unit_m):
    units = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    encoding = DepthEncoding(unit_m=unit_m)
    everywhere = np.ones(units.shape, dtype=bool)

    depth_m = depth_m_from_units(units, measured=everywhere, encoding=encoding, intrinsics=CAMERA)

    assert depth_m.dtype == np.float32
    np.testing.assert_array_equal(depth_m, (units.astype(float) * unit_m).astype(np.float32))


@pytest.mark.parametrize(
    ("encoding", "expected_m"),
    [
        (DepthEncoding(unit_m=0.5, offset_m=0.25), [0, 2.25, 32767.75]),
        (DepthEncoding(unit_m=2.0, form="inverse"), [0, 0.5, 2 / 65535]),
        (DepthEncoding(unit_m=2.0, form="inverse", no_depth=()), [np.inf, 0.5, 2 / 65535]),
        (DepthEncoding(unit_m=2.0), [0, 8, 131070]),
    ],
    ids=["a range from its offset", "inverse", "an inverse of 0 that counts", "plain"],
)
def test_numbers_become_metres_and_0_where_depth_was_not_measured(encoding, expected_m):
    units = np.array([[0, 4, 65535, 4]], dtype=np.uint16)
    where = np.array([[not encoding.no_depth, True, True, False]])

    depth_m = depth_m_from_units(units, measured=where, encoding=encoding, intrinsics=CAMERA)

    np.testing.assert_array_equal(depth_m, np.float32([[*expected_m, 0]]))


def test_a_ray_becomes_depth_along_the_optical_axis():
    """The last pixel's ray is (2 / 1.5, 0, 1), 5/3 long."""
    units = np.array([[10, 0, 10]], dtype=np.uint16)
    encoding = DepthEncoding(unit_m=1.0, kind="ray")

    depth_m = depth_m_from_units(units, measured=units > 0, encoding=encoding, intrinsics=CAMERA)

    assert depth_m.dtype == np.float32
    np.testing.assert_allclose(depth_m, [[10, 0, 6]], rtol=1e-6)


@pytest.mark.parametrize(
    ("index", "lag", "expected"), [(0, 0, 0), (5, 2, 7), (5, -5, 0), (5, -6, None), (79, 2, None)]
)
def test_a_lag_names_the_depth_frame_or_none(index, lag, expected):
    encoding = DepthEncoding(frame_lag=lag)

    assert depth_frame_index(index, encoding=encoding, frames=81) == expected
