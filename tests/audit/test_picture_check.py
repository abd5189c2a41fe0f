"""Payloads, light, motion and occluders, on pictures made by hand."""

import math

import numpy as np
import pytest

from stereogenbench_data.audit.geometry.picture_check import (
    border_occluder,
    light_figures,
    stored_step,
    subject_m,
)
from stereogenbench_data.audit.geometry.records import Figure


def stripes(low, high):
    luma = np.full((24, 32), low, np.float32)
    luma[:, ::2] = high
    return luma


def test_light_is_that_of_a_picture_and_change_that_from_the_one_before():
    found = light_figures("a.mp4", 15, stripes(24, 206), before=(10, stripes(24, 204)))

    # Half of the pixels change by 2 grey levels.
    assert list(found) == [
        Figure("brightness", "a.mp4", pytest.approx(115, abs=0.01), "frame 15"),
        Figure("contrast", "a.mp4", pytest.approx(91, abs=0.01), "frame 15"),
        Figure("change", "a.mp4", pytest.approx(1.0, abs=0.01), "frame 10"),
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
        # Borders are 2 pixels wide, and 800 pixels in all.
        pytest.param((slice(None), slice(0, 25)), 300 / 800, "left", id="left"),
        pytest.param((slice(20, 80), slice(70, 100)), 120 / 800, "right", id="part of the right"),
        pytest.param((slice(0, 12), slice(10, 90)), 160 / 800, "top", id="top"),
        pytest.param((slice(88, 100), slice(10, 90)), 160 / 800, "bottom", id="bottom"),
        pytest.param((slice(40, 60), slice(40, 60)), 0.0, "", id="not at a border"),
        pytest.param((slice(0), slice(0)), 0.0, "", id="nothing"),
        pytest.param((slice(70, 100), slice(None)), 0.0, "", id="the ground"),
        pytest.param((slice(0, 95), slice(None)), 580 / 800, "top", id="everywhere"),
    ],
)
def test_what_covers_the_border_is_reported_with_its_share_and_side(where, share, side):
    depth_m, measured = scene()
    depth_m[where] = 1.0

    found, on = border_occluder(depth_m, measured, far_m=10.0)

    assert (found, on) == (pytest.approx(share), side)
    assert border_occluder(depth_m, measured, far_m=math.nan) == (0.0, "")
