"""The Fréchet distance of two sets of features, accumulated in parts and across processes.

No covariance matrix is formed, and no root of one is taken. Each set is kept as its mean and a root
R of its scatter, where R'R is the sum over samples of (x - mean)(x - mean)'. The distance needs the
trace of the root of the product of two covariances. That is the nuclear norm of R1 R2' over
sqrt((n1 - 1)(n2 - 1)): a sum of singular values, real at any rank, and without the loss of half of
the digits that squaring brings.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64

from stereogenbench_data.errors import EvaluationError


@dataclass(frozen=True, slots=True, eq=False)
class FeatureStatistics:
    """Count, mean and scatter of a set of features, in float64: tensors, as files can hold them.

    Merging in another grouping changes the result by rounding alone; in the same order, not at all.

    Attributes:
        count: How many samples there are.
        mean: Their mean.
        root: A root of their scatter, with at most twice as many rows as there are features.
    """

    count: int
    mean: Float64[torch.Tensor, " dim"]
    root: Float64[torch.Tensor, "rows dim"]

    @classmethod
    def of(cls, features: Float[np.ndarray, "n dim"]) -> "FeatureStatistics":
        """Return the statistics of samples.

        Raises:
            EvaluationError: If a number is not finite.
        """
        samples = features.astype(np.float64)
        if not np.isfinite(samples).all():
            bad = np.flatnonzero(~np.isfinite(samples).all(axis=1))
            raise EvaluationError(
                f"{len(bad)} of {len(samples)} samples have features that are not finite, "
                f"sample {bad[0]} first: the extractor overflowed or its weights are damaged."
            )
        mean = samples.mean(axis=0)
        root = _compressed(torch.from_numpy(samples - mean), at_most=2 * samples.shape[1])
        return cls(count=len(samples), mean=torch.from_numpy(mean), root=root)

    @property
    def dim(self) -> int:
        """How many features a sample has."""
        return len(self.mean)

    def merged(self, other: "FeatureStatistics") -> "FeatureStatistics":
        """Return the statistics of the union of both sets."""
        count = self.count + other.count
        between = other.mean - self.mean
        apart = math.sqrt(self.count * other.count / count) * between
        return FeatureStatistics(
            count=count,
            mean=self.mean + between * (other.count / count),
            root=_compressed(torch.vstack([self.root, other.root, apart]), at_most=2 * self.dim),
        )


@dataclass(frozen=True, slots=True)
class FrechetDistance:
    """A Fréchet distance, with the sample sizes needed to interpret it.

    Attributes:
        value: The distance (squared, as FID and FVD are); None below two samples on a side.
        samples: How many samples the predicted and the target side have.
        dim: How many features a sample has.
        underdetermined: Whether the smaller side has no more samples than features. Its covariance
            then lacks full rank and the value is biased upwards, the more the fewer samples there
            are: compare it only with values of as many samples.
    """

    value: float | None
    samples: tuple[int, int]
    dim: int
    underdetermined: bool


def frechet_distance(predicted: FeatureStatistics, target: FeatureStatistics) -> FrechetDistance:
    """Return the Fréchet distance of Gaussians fitted to two sets of features.

    ||m1 - m2||^2 + tr S1 + tr S2 - 2 tr (S1 S2)^(1/2), with covariances over n - 1.

    Source: Dowson & Landau, Journal of Multivariate Analysis 12(3), 1982; Heusel et al., NIPS 2017.
    """
    samples = (predicted.count, target.count)
    value = None
    if min(samples) > 1:
        one, two = (
            _compressed(side.root, at_most=side.dim).numpy() / math.sqrt(side.count - 1)
            for side in (predicted, target)
        )
        between = (predicted.mean - target.mean).numpy()
        shared = np.linalg.svd(one @ two.T, compute_uv=False).sum()
        distance = between @ between + np.sum(one**2) + np.sum(two**2) - 2 * shared
        value = max(float(distance), 0.0)
    return FrechetDistance(
        value=value,
        samples=samples,
        dim=predicted.dim,
        underdetermined=min(samples) <= predicted.dim,
    )


def _compressed(
    root: Float64[torch.Tensor, "rows dim"], *, at_most: int
) -> Float64[torch.Tensor, "fewer dim"]:
    """Return a root of the same scatter, with as many rows as features if it has too many."""
    if len(root) <= at_most:
        return root
    return torch.from_numpy(np.linalg.qr(root.numpy(), mode="r"))
