"""What a method of each tier may see."""

import pytest

from stereogenbench_data import EvaluationError
from stereogenbench_data.evaluation.protocol import TIERS, require_tier


def test_each_tier_gives_what_the_paper_says():
    assert TIERS["G0"].inputs == ("left", "disparity", "warped_right", "hole")
    assert TIERS["G1"].inputs == ("left", "baseline_m", "intrinsics")
    assert TIERS["G2"].inputs == ("left",)


@pytest.mark.parametrize("name", ["g0", None])
def test_an_unknown_tier_is_refused_with_those_there_are(name):
    with pytest.raises(EvaluationError, match=r"there is no tier .*G0 \(oracle geometry"):
        require_tier(name)
