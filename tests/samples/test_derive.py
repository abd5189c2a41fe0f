"""What is derived from decoded views, against hand-worked numbers and the long way round."""

from dataclasses import replace

import numpy as np
import pytest

from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.pose import CameraPoses, rotation_from_rotator_deg
from stereogenbench_data.samples.derive import (
    PairGeometry,
    PairSample,
    SceneFacts,
    StoredDepth,
    Views,
)
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.selection.plan import Address
from tests.selection.conftest import made_scene

GAP_CM = 20.0
INTRINSICS = Intrinsics(100.0, 100.0, 20.0, 10.0, 40, 20)


def facts(encoding, *, residual_px=0.0, order=1.0, yaw_deg=(0.0,) * 6):
    """Return a scene whose cameras stand 20 cm apart, looking along Unreal's x."""
    scene = made_scene("train/Uniform/Map/scene_000000", gaps_cm=(GAP_CM,) * 5, frames=1)
    scene = replace(
        scene,
        lateral_m=tuple(order * place_m for place_m in scene.lateral_m),
        rig_residual_px=residual_px,
    )
    centres, rotations = np.zeros((1, 6, 3)), np.zeros((1, 6, 3))
    centres[0, :, 1] = 100 * np.array(scene.lateral_m)
    rotations[0, :, 1] = yaw_deg
    poses = CameraPoses.from_unreal(centres, rotation_from_rotator_deg(rotations), unit_m=0.01)
    return SceneFacts(
        scene, INTRINSICS, dict.fromkeys(range(6), encoding), lambda name: name, poses=poses
    )


def geometry(units, encoding, *, source=0, target=1, world="as recorded", padded=None, **scene):
    units = np.asarray(units, dtype=np.uint16)[None]
    stored = StoredDepth(units, units > 0)
    views = Views(
        source=source, targets=(target,), frames=(0,), pictures={},
        depths={source: stored, target: stored}, intrinsics=INTRINSICS, world=world,
        padded=padded,
    )  # fmt: skip
    return PairGeometry(views, facts(encoding, **scene), source=source, target=target)


def some_units(low=5, high=400):
    units = np.random.default_rng(0).integers(low, high, (20, 40))
    units[3, 4] = 0
    return units


def test_disparity_by_hand():
    pair = geometry(np.full((20, 40), 50), DepthEncoding(0.1))

    # 100 px * 0.2 m / 5 m
    assert (pair.disparity == 4.0).all()
    assert (pair.depth_m == 5.0).all()
    assert pair.baseline_m == 0.2


def test_depth_of_a_range_moves_disparity_and_keeps_its_error():
    pair = geometry(np.full((20, 40), 40), DepthEncoding(0.1, offset_m=1.0))
    plain = geometry(np.full((20, 40), 50), DepthEncoding(0.1))

    assert (pair.depth_m == 5.0).all()
    np.testing.assert_array_equal(pair.disparity, plain.disparity)
    np.testing.assert_array_equal(pair.disparity_error, plain.disparity_error)


@pytest.mark.parametrize(
    ("options", "sign"),
    [
        ({}, 1),
        ({"source": 1, "target": 0}, -1),
        ({"order": -1.0}, -1),
        ({"order": -1.0, "source": 1, "target": 0}, 1),
        ({"world": "mirrored"}, -1),
        ({"world": "mirrored", "source": 1, "target": 0}, 1),
    ],
    ids=str,
)
@pytest.mark.parametrize("residual_px", [0.0, 1.0], ids=["closed form", "pose chain"])
def test_the_sign_follows_where_the_target_stands(options, sign, residual_px):
    """Whether by the closed form or through the poses."""
    pair = geometry(np.full((20, 40), 50), DepthEncoding(0.1), residual_px=residual_px, **options)

    assert pair.baseline_m == pytest.approx(0.2 * sign)
    np.testing.assert_allclose(pair.disparity, 4.0 * sign, rtol=1e-6)
    np.testing.assert_allclose(pair.target_from_source[0, :3, 3], [-0.2 * sign, 0, 0], atol=1e-12)


@pytest.mark.parametrize("encoding", [
    DepthEncoding(0.1), DepthEncoding(0.1, kind="ray"), DepthEncoding(500.0, form="inverse"),
    DepthEncoding(500.0, form="inverse", kind="ray"),
], ids=str)  # fmt: skip
def test_the_pose_chain_of_a_rectified_rig_is_the_closed_form(encoding):
    closed = geometry(some_units(), encoding)
    chained = geometry(some_units(), encoding, residual_px=1.0)

    np.testing.assert_allclose(chained.disparity, closed.disparity, rtol=2e-6)
    assert (closed.disparity[0, 3, 4], chained.disparity[0, 3, 4]) == (0, 0)


def test_disparity_of_depth_along_the_ray_is_within_four_units_in_the_last_place():
    """Depth of the ray's length is rounded to float32 on its way, that of the axis is not."""
    rng, worst = np.random.default_rng(3), {"planar": 0.0, "ray": 0.0}
    u, v = np.arange(40) + 0.5 - 20, np.arange(20)[:, None] + 0.5 - 10
    lengths = {"planar": 1.0, "ray": np.sqrt(1 + (u / 100) ** 2 + (v / 100) ** 2)}
    for _ in range(120):
        unit_m = float(np.exp(rng.uniform(np.log(1e-4), np.log(0.1))))
        units = rng.integers(1, 65535, (20, 40))
        for kind, length in lengths.items():
            found = geometry(units, DepthEncoding(unit_m, kind=kind)).disparity[0]
            exact = 100 * GAP_CM / 100 * length / (units * np.float64(unit_m))
            error = np.abs(found - exact) / np.spacing(exact.astype(np.float32))
            worst[kind] = max(worst[kind], float(error.max()))

    assert worst["planar"] < 0.55
    assert worst["ray"] < 3.5


def test_a_turned_camera_moves_pixels_as_its_homography_says():
    pair = geometry(
        np.full((20, 40), 60000), DepthEncoding(1e3), residual_px=5.0,
        yaw_deg=(0.0, 1.0, 0, 0, 0, 0),
    )  # fmt: skip

    # far away only the turn of one degree to the right counts, at the centre f tan(1 degree)
    assert pair.disparity[0, 10, 20] == pytest.approx(100 * np.tan(np.pi / 180), rel=0.01)


@pytest.mark.parametrize("form", ["depth", "inverse"])
def test_a_point_behind_the_other_camera_is_not_valid_and_has_no_disparity(form):
    units = some_units()
    encoding = DepthEncoding(0.1) if form == "depth" else DepthEncoding(500.0, form="inverse")
    pair = geometry(units, encoding, residual_px=5.0, yaw_deg=(0.0, 80.0, 0, 0, 0, 0))
    to_the_right = PairSample(pair._views, pair._facts, Address(0, 0, (1,), (0,)), target=1)

    # the right camera stands 0.2 m to the right and looks 80 degrees to the right of the left one
    ahead_m = np.divide(500, units, where=units > 0, out=np.zeros(units.shape))
    ahead_m = 0.1 * units if form == "depth" else ahead_m
    right_m = ahead_m * (np.arange(40) + 0.5 - 20) / 100
    turn = np.deg2rad(80)
    in_front = ahead_m * np.cos(turn) + (right_m - 0.2) * np.sin(turn) > 0
    expected = in_front & (units > 0)
    assert 0.2 < expected.mean() < 0.98
    assert np.array_equal(to_the_right.valid[0], expected)
    assert np.isfinite(pair.disparity).all()
    assert (pair.disparity[0][~expected] == 0).all()
    assert (pair.disparity[0][expected] != 0).all()
    assert np.isfinite(pair.disparity_error).all()
    assert (pair.disparity_error[0][~expected] == 0).all()


@pytest.mark.parametrize(
    "encoding", [DepthEncoding(0.1), DepthEncoding(500.0, form="inverse")], ids=str
)
def test_the_error_bound_holds_for_every_depth_that_rounds_to_the_stored_one(encoding):
    units = some_units()
    pair = geometry(units, encoding)
    stored = units.astype(np.float64)[None]
    measured = stored > 0
    for off in (-0.4999, 0.4999):
        ratio = (stored + off) * encoding.unit_m if encoding.form == "depth" else (
            encoding.unit_m / np.where(measured, stored + off, 1))  # fmt: skip
        truth = np.divide(100 * 0.2, ratio, where=measured, out=np.zeros_like(stored))
        assert (np.abs(pair.disparity - truth) <= pair.disparity_error)[measured].all()
    assert pair.disparity_error[0, 3, 4] == 0
    assert pair.disparity_error.dtype == np.float32


@pytest.mark.parametrize("residual_px", [0.0, 1.0], ids=["rectified", "through poses"])
def test_nothing_is_visible_in_a_padded_target_nor_warped_into_it(residual_px):
    plain = geometry(some_units(), DepthEncoding(0.1), residual_px=residual_px)
    padded = np.zeros((20, 40), dtype=bool)
    padded[:, 10:15], padded[4:6] = True, True
    boxed = geometry(some_units(), DepthEncoding(0.1), residual_px=residual_px, padded=padded)

    columns = np.nan_to_num(np.floor(plain.projection.u_px)).clip(0, 39).astype(int)
    on_padding = padded[np.arange(20)[:, None], columns]
    expected = plain.visible_from_source & ~on_padding & ~padded
    assert (plain.visible_from_source & on_padding & ~padded).any()
    assert np.array_equal(boxed.visible_from_source, expected)
    assert np.array_equal(boxed.visible(boxed), plain.visible(plain) & ~on_padding & ~padded)
    assert np.array_equal(boxed.hole, plain.hole | padded)
