"""Which frame a time stands for."""

from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereogenbench_data.media.decoder import SteadyClock

MATROSKA_15_HZ = SteadyClock(start=0, step=Fraction(1000, 15))


@pytest.mark.parametrize(
    ("pts", "index"),
    [(0, 0), (67, 1), (66, 1), (133, 2), (5333, 80), (-67, -1), (64, None), (70, None), (33, None)],
)
def test_a_time_within_a_tick_of_a_frame_is_the_frames(pts, index):
    assert MATROSKA_15_HZ.index(pts) == index


@given(
    index=st.integers(0, 10_000),
    rate=st.sampled_from([Fraction(15), Fraction(24000, 1001), Fraction(60)]),
    ticks=st.sampled_from([1000, 15360, 90000]),
    start=st.integers(-5000, 5000),
)
def test_a_rounded_time_is_found_again(index, rate, ticks, start):
    clock = SteadyClock(start, ticks / rate)

    assert clock.index(round(start + index * clock.step)) == index
    assert clock.index(clock.latest(index)) == index


def test_a_clock_of_one_tick_a_frame_lets_no_frame_be_another():
    clock = SteadyClock(start=3, step=Fraction(1))

    assert [clock.index(pts) for pts in (3, 4, 5)] == [clock.latest(i) - 3 for i in range(3)]
