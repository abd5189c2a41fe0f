"""A balanced subsample holds equally many of every stratum."""

from collections import Counter

import numpy as np
import pytest
from scipy import stats

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.schema.release import baseline_bin
from stereogenbench_data.selection.plan import balanced


@pytest.fixture(scope="module")
def crowded_cm():
    """Baselines that crowd at the short end."""
    return np.exp(np.random.default_rng(0).gamma(3.0, 0.9, size=3000)).clip(1.0, 149.0)


def test_bins_are_filled_alike_up_to_the_poorest(crowded_cm):
    drawn = balanced(crowded_cm, by="bins", limit=None, seed=0)
    available = Counter(map(baseline_bin, crowded_cm))

    assert Counter(map(baseline_bin, crowded_cm[drawn])) == dict.fromkeys(
        available, min(available.values())
    )


def test_log_baseline_comes_out_uniform(crowded_cm):
    drawn = balanced(crowded_cm, by="log_baseline", limit=320, seed=0)
    logs = np.log(crowded_cm[drawn])
    uniform = stats.uniform(np.log(crowded_cm).min(), np.ptp(np.log(crowded_cm)))

    assert stats.kstest(logs, uniform.cdf).pvalue > 0.05
    assert stats.kstest(np.log(crowded_cm), uniform.cdf).pvalue < 1e-6


@pytest.mark.parametrize("counts", [(2, 5, 5), (5, 2, 5), (5, 5, 2), (3, 3, 3), (4, 2, 2), (7,)])
def test_a_limit_balances_up_to_the_most_that_is_told(counts):
    """Whether it is a multiple of the strata or not, and whichever stratum is the poorest."""
    baselines_cm = np.repeat([1.0, 10.0, 100.0], [*counts, 0, 0][:3])
    most = min(counts) * len(counts) + sum(count > min(counts) for count in counts)

    for limit in range(len(counts), most + 1):
        drawn = balanced(baselines_cm, by="log_baseline", limit=limit, seed=0)
        shares = np.unique(baselines_cm[drawn], return_counts=True)[1]
        assert len(set(drawn)) == sum(shares) == limit
        assert len(shares) == len(counts)
        assert np.ptp(shares) <= 1
    with pytest.raises(SelectionError, match=f"the most that balances is {most}\\."):
        balanced(baselines_cm, by="log_baseline", limit=most + 1, seed=0)


def test_a_limit_is_met_exactly_and_shared_out(crowded_cm):
    drawn = balanced(crowded_cm, by="bins", limit=52, seed=0)
    shares = Counter(map(baseline_bin, crowded_cm[drawn]))

    assert len(drawn) == 52
    assert max(shares.values()) - min(shares.values()) <= 1


@pytest.mark.parametrize(
    ("by", "limit", "message"),
    [
        ("bins", 2500, r"500 pairs .* of the bin \[60,100\) cm, which has 157; .* most .* is 789"),
        ("bins", 790, "158 pairs are wanted .* the most that balances is 789"),
        ("bins", 3, "less than one pair for each of 5 strata"),
        ("bins", "a", "limit must be a whole number from 1, got 'a'"),
        ("bins", 10.5, "limit must be a whole number from 1, got 10.5"),
        ("log", None, "must be 'bins' or 'log_baseline', got 'log'"),
    ],
)
def test_a_balance_that_cannot_be_had_is_refused(crowded_cm, by, limit, message):
    with pytest.raises(SelectionError, match=message):
        balanced(crowded_cm, by=by, limit=limit, seed=0)
