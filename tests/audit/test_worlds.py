"""Which reading of the poses is right, by depth from frame to frame."""

import pytest

from stereogenbench_data.audit.contract.worlds import judge_worlds

RIGHT, WRONG = "opencv", "opengl"


def scenes(*shares):
    return [{RIGHT: right, WRONG: wrong} for right, wrong in shares]


def test_a_reading_that_explains_most_pixels_and_is_well_ahead_is_right():
    verdict = judge_worlds(scenes((0.9, 0.5), (0.95, 0.6), (0.8, 0.02), (0.97, 0.9)))

    assert verdict.chosen == RIGHT
    assert verdict.shares[WRONG] == pytest.approx((0.26, 0.75))


@pytest.mark.parametrize(
    ("shares", "reason"),
    [
        ([(0.9, 0.5)], "fewer than two scenes"),
        ([(0.5, 0.1), (0.5, 0.1)], "no reading explains 60% of the pixels of the scenes that cho"),
        ([(0.95, 0.9), (0.95, 0.9)], "no reading is 20% ahead in the scenes that choose"),
        ([(0.95, 0.3), (0.3, 0.95)], "no reading explains 60% of the pixels of the scenes that co"),
        ([(0.95, 0.3), (0.95, 0.9)], "no reading is 20% ahead in the scenes that confirm"),
    ],
)
def test_what_pictures_cannot_tell_stays_open(shares, reason):
    verdict = judge_worlds(scenes(*shares))

    assert verdict.chosen == ""
    assert verdict.reason.startswith(reason)
