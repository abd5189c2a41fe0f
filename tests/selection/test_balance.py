"""A balanced subsample holds equally many of every bin."""

from collections import Counter

import numpy as np
import pytest

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.schema.release import baseline_bin
from stereogenbench_data.selection.balance import balanced


@pytest.fixture(scope="module")
def crowded_cm():
    """Baselines that crowd at the short end."""
    return np.exp(np.random.default_rng(0).gamma(3.0, 0.9, size=3000)).clip(1.0, 149.0)


def test_bins_are_filled_alike_up_to_the_poorest(crowded_cm):
    drawn = balanced(crowded_cm, limit=None, seed=0)
    available = Counter(map(baseline_bin, crowded_cm))

    assert Counter(map(baseline_bin, crowded_cm[drawn])) == dict.fromkeys(
        available, min(available.values())
    )


def test_a_limit_is_met_exactly_and_shared_out(crowded_cm):
    drawn = balanced(crowded_cm, limit=52, seed=0)
    shares = Counter(map(baseline_bin, crowded_cm[drawn]))

    assert len(drawn) == 52
    assert max(shares.values()) - min(shares.values()) <= 1


def test_nothing_is_drawn_twice_and_the_order_is_kept(crowded_cm):
    drawn = balanced(crowded_cm, limit=None, seed=5)

    assert (np.diff(drawn) > 0).all()


def test_the_draw_depends_on_the_seed_alone(crowded_cm):
    one, same, other = (balanced(crowded_cm, limit=50, seed=seed) for seed in (1, 1, 2))

    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)


def test_a_limit_beyond_the_poorest_bin_names_it(crowded_cm):
    with pytest.raises(
        SelectionError,
        match=r"500 pairs are wanted of the bin \[30,60\) cm, which has 318; the most .* is 785",
    ):
        balanced(crowded_cm, limit=2500, seed=0)


def test_a_limit_below_the_number_of_bins_is_refused(crowded_cm):
    with pytest.raises(SelectionError, match="less than one pair for each of 5 bins"):
        balanced(crowded_cm, limit=3, seed=0)
