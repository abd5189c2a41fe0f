"""The Fréchet distance against roots of matrices, to sixty digits by mpmath."""

from functools import reduce

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.metrics.frechet import FeatureStatistics, frechet_distance


def distance(one: np.ndarray, two: np.ndarray) -> float:
    return frechet_distance(FeatureStatistics.of(one), FeatureStatistics.of(two)).value


def by_sixty_digits(one: np.ndarray, two: np.ndarray) -> float:
    """Return the distance by the eigenvalues of the product of covariances, to 60 digits."""
    with mpmath.workdps(60):
        (mean_one, first), (mean_two, second) = map(precise_moments, (one, two))
        eigenvalues = mpmath.eig(first * second, right=False)
        root = mpmath.fsum(mpmath.sqrt(max(mpmath.re(value), 0)) for value in eigenvalues)
        apart = mpmath.fsum((a - b) ** 2 for a, b in zip(mean_one, mean_two, strict=True))
        traces = mpmath.fsum(first[i, i] + second[i, i] for i in range(first.rows))
        return float(apart + traces - 2 * root)


def precise_moments(samples: np.ndarray) -> tuple[list, mpmath.matrix]:
    table = mpmath.matrix(samples.tolist())
    mean = [mpmath.fsum(table[:, column]) / table.rows for column in range(table.cols)]
    for row in range(table.rows):
        for column in range(table.cols):
            table[row, column] -= mean[column]
    return mean, table.T * table / (table.rows - 1)


def mixed(rng, samples: int, dim: int, *, offset: float = 0.0) -> np.ndarray:
    return rng.normal(size=(samples, dim)) @ rng.normal(size=(dim, dim)) + offset


@pytest.mark.parametrize("decades", [0, 8])
def test_sets_far_from_zero_are_as_far_apart_as_sixty_digits_say(decades):
    rng = np.random.default_rng(decades)
    scales = np.logspace(0, -decades, 8)
    turn = np.linalg.qr(rng.normal(size=(8, 8)))[0]
    one = rng.normal(size=(30, 8)) * scales + 100
    two = (rng.normal(size=(25, 8)) * scales) @ turn + 100.5

    assert distance(one, two) == pytest.approx(by_sixty_digits(one, two), rel=1e-9)


@pytest.mark.parametrize(("samples", "others"), [(4, 30), (2, 2)])
def test_fewer_samples_than_features_are_no_difficulty(samples, others):
    rng = np.random.default_rng(samples)
    one, two = rng.normal(size=(samples, 8)), rng.normal(size=(others, 8)) + 0.3

    found = frechet_distance(FeatureStatistics.of(one), FeatureStatistics.of(two))

    assert found.value == pytest.approx(by_sixty_digits(one, two), rel=1e-9)
    assert found.underdetermined
    assert (found.samples, found.dim) == ((samples, others), 8)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 999), cuts=st.lists(st.integers(0, 300), max_size=6))
def test_gathered_in_parts_a_set_spreads_as_it_does_at_once(seed, cuts):
    rng = np.random.default_rng(seed)
    samples = mixed(rng, 300, 5, offset=1e3)
    split = [part for part in np.split(samples, sorted(cuts)) if len(part)]
    parts = [FeatureStatistics.of(part) for part in split]

    gathered = reduce(FeatureStatistics.merged, parts)
    backwards = reduce(FeatureStatistics.merged, parts[::-1])

    scatter = np.cov(samples.T) * 299
    for spread in (gathered, backwards):
        assert spread.count == 300
        assert len(spread.root) <= 10
        np.testing.assert_allclose(spread.mean, samples.mean(axis=0), rtol=1e-13)
        np.testing.assert_allclose(spread.root.T @ spread.root, scatter, rtol=1e-9, atol=1e-8)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 999), samples=st.integers(2, 40), dim=st.integers(1, 12))
def test_the_distance_is_symmetric_never_negative_and_zero_from_itself(seed, samples, dim):
    rng = np.random.default_rng(seed)
    one, two = rng.normal(size=(samples, dim)), rng.normal(size=(samples + 3, dim)) * 2

    assert distance(one, two) == pytest.approx(distance(two, one), rel=1e-12)
    assert distance(one, two) >= 0
    assert distance(one, one) == pytest.approx(0, abs=1e-12 * np.sum(one**2))


def test_below_two_samples_there_is_no_distance():
    many = FeatureStatistics.of(np.random.default_rng(0).normal(size=(9, 3)))

    found = frechet_distance(FeatureStatistics.of(np.zeros((1, 3))), many)

    assert found.value is None
    assert found.underdetermined


def test_features_that_cannot_be_gathered_are_named():
    with pytest.raises(EvaluationError, match=r"1 of 3 samples .* not finite, sample 2 first"):
        FeatureStatistics.of(np.array([[0.0], [1.0], [np.nan]]))
