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


def test_a_limit_is_met_exactly_and_shared_out(crowded_cm):
    drawn = balanced(crowded_cm, by="bins", limit=52, seed=0)
    shares = Counter(map(baseline_bin, crowded_cm[drawn]))

    assert len(drawn) == 52
    assert max(shares.values()) - min(shares.values()) <= 1


def test_a_limit_beyond_the_poorest_stratum_names_it(crowded_cm):
    with pytest.raises(
        SelectionError,
        match=r"500 pairs are wanted of the bin \[30,60\) cm, which has 318; the most .* is 785",
    ):
        balanced(crowded_cm, by="bins", limit=2500, seed=0)


def test_a_limit_below_the_number_of_strata_is_refused(crowded_cm):
    with pytest.raises(SelectionError, match="less than one pair for each of 5 strata"):
        balanced(crowded_cm, by="bins", limit=3, seed=0)


def test_an_unknown_balance_is_refused():
    with pytest.raises(SelectionError, match="must be 'bins' or 'log_baseline', got 'log'"):
        balanced(np.ones(3), by="log", limit=None, seed=0)
