"""Payloads, light, motion and occluders, on pictures made by hand."""

import math

import numpy as np
import pytest

from stereogenbench_data.audit.geometry.picture_check import (
    LightCheck,
    PayloadCheck,
    border_occluder,
    stored_step,
    subject_m,
)
from stereogenbench_data.audit.geometry.records import Figure


def grey(level, *, size=(24, 32)):
    return np.full((3, *size), level, np.uint8)


def stripes(low, high):
    picture = grey(low)
    picture[:, :, ::2] = high
    return picture


def test_change_counts_only_while_the_camera_moves():
    check = LightCheck()
    check.take(stripes(20, 200), 0, moved=False)
    check.take(stripes(20, 200), 5, moved=False)
    check.take(stripes(24, 204), 10, moved=True)
    check.take(stripes(24, 206), 15, moved=True)

    # Half of the pixels change by 2 grey levels.
    assert list(check.figures("a.mp4")) == [
        Figure("brightness", "a.mp4", pytest.approx(200, abs=0.01), "frame 0"),
        Figure("contrast", "a.mp4", pytest.approx(180, abs=0.01), "frame 0"),
        Figure("change", "a.mp4", pytest.approx(1.0, abs=0.01), "frame 10"),
    ]


def test_a_payload_may_stand_still_while_the_camera_does():
    check = PayloadCheck()
    units = np.arange(48, dtype=np.uint16).reshape(6, 8) * 10
    for frame in range(3):
        check.take(units, units > 0, frame, moved=False)

    assert list(check.figures("a.mkv")) == [
        Figure("mean_valid_depth", "a.mkv", pytest.approx(47 / 48)),
        Figure("valid_depth", "a.mkv", pytest.approx(47 / 48), "frame 0"),
        Figure("depth_levels", "a.mkv", 47.0),
    ]


def test_numbers_that_were_stretched_from_10_bits_are_64_apart():
    stretched = np.unique(np.rint(np.arange(1, 1024) * 65535 / 1023).astype(int))

    assert stored_step(stretched) == 64.0
    assert stored_step(np.arange(1, 1024) * 100) == 100.0
    assert stored_step(np.arange(5, 400)) == 1.0


def scene(depth_m=10.0):
    return np.full((100, 100), depth_m), np.ones((100, 100), bool)


def test_the_subject_is_as_far_as_the_nearer_part_of_the_middle_of_most_cameras():
    plain, covered = scene(10.0), scene(0.5)
    with_subject = scene(20.0)
    with_subject[0][30:70, 30:70] = 6.0

    assert subject_m([plain] * 5 + [covered]) == 10.0
    assert subject_m([with_subject] * 6) == 6.0
    assert math.isnan(subject_m([(plain[0], ~plain[1])]))


@pytest.mark.parametrize(
    ("where", "share", "side"),
    [
        pytest.param((slice(None), slice(0, 25)), 0.25, "left", id="left"),
        pytest.param((slice(20, 80), slice(70, 100)), 0.18, "right", id="part of the right"),
        pytest.param((slice(0, 12), slice(10, 90)), 0.096, "top", id="top"),
        pytest.param((slice(40, 60), slice(40, 60)), 0.0, "", id="not at a border"),
        pytest.param((slice(0), slice(0)), 0.0, "", id="nothing"),
        pytest.param((slice(70, 100), slice(None)), 0.0, "", id="the ground"),
        pytest.param((slice(0, 95), slice(None)), 0.95, "all", id="everywhere"),
    ],
)
def test_what_hides_a_border_is_reported_with_its_share_and_side(where, share, side):
    depth_m, measured = scene()
    depth_m[where] = 1.0

    found, on = border_occluder(depth_m, measured, far_m=10.0)

    assert (found, on) == (pytest.approx(share), side)
    assert border_occluder(depth_m, measured, far_m=math.nan) == (0.0, "")
