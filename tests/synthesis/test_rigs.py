import numpy as np
import pytest
from scipy import stats

from stereogenbench_data.synthesis.proposal import (
    lateral_places_cm,
    pair_distances_cm,
    random_gaps_cm,
)


def gaps_cm(family, *, rigs=800):
    rng = np.random.default_rng(5)
    return np.array([random_gaps_cm(family, rng=rng) for _ in range(rigs)])


@pytest.mark.parametrize(
    ("family", "papers"),
    [
        ("IPD_Gaussian", stats.truncnorm(-1.88 / 0.5, 2.12 / 0.5, loc=6.38, scale=0.5)),
        ("Uniform", stats.uniform(1, 149)),
    ],
    ids=["IPD_Gaussian", "Uniform"],
)
def test_gaps_follow_the_distribution_of_the_paper(family, papers):
    """Of IPD_Gaussian a normal one of 6.38 and 0.5 cm, cut at 4.5 and 8.5 cm."""
    assert stats.kstest(gaps_cm(family).ravel(), papers.cdf).pvalue > 0.01


def test_pairwise_uniform_spreads_all_pairs_up_to_two_metres():
    """The release: 5.11 to 200.00 cm, mean 97.76, standard deviation 56.78, median 93.36."""
    drawn = gaps_cm("Pairwise_Uniform", rigs=300)
    pairs = np.array([pair_distances_cm(gaps) for gaps in drawn])

    assert pairs.min() >= 5
    assert 195 < pairs.max() <= 200
    assert pairs.mean() == pytest.approx(97.8, abs=4)
    assert pairs.std() == pytest.approx(56.8, abs=3)
    assert np.median(pairs) == pytest.approx(93.4, abs=4)
    assert drawn.std() == pytest.approx(20.8, abs=5)


def test_pair_distances_of_a_rig_worked_by_hand():
    """The gaps of the scene that was rendered elsewhere, with its recorded distances."""
    gaps = np.array([18.5, 33.0, 9.75, 61.25, 40.5])

    assert lateral_places_cm(gaps).tolist() == [0, 18.5, 51.5, 61.25, 122.5, 163.0]
    assert pair_distances_cm(gaps).tolist() == [
        *(18.5, 51.5, 61.25, 122.5, 163.0, 33.0, 42.75, 104.0),
        *(144.5, 9.75, 71.0, 111.5, 61.25, 101.75, 40.5),
    ]
