"""The scores of a method: frames are averaged first, then the pairs of a scene, then scenes.

Every scene counts once, whatever the number of its frames and pairs. Intervals are over scenes.
"""

import hashlib
import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from operator import attrgetter
from statistics import median
from typing import Any, Final, TypeVar

import numpy as np

from stereogenbench_data.errors import EvaluationError, missing_extra
from stereogenbench_data.evaluation.metrics.frechet import FrechetDistance
from stereogenbench_data.evaluation.protocol import EvaluationProtocol
from stereogenbench_data.index.table import SceneIndex

CONFIDENCE: Final = 0.95
_DISTINCT_VALUES: Final = 6

Group = TypeVar("Group", bound=Hashable)


@dataclass(frozen=True, slots=True)
class Tally:
    """The numbers of one column over the frames of one pair.

    Attributes:
        mean: Of the finite ones; nan where there is none.
        finite: How many are finite.
        infinite: How many are infinite: identical pictures, for PSNR.
        undefined: How many are nan: frames without a score.
    """

    mean: float
    finite: int
    infinite: int
    undefined: int

    @property
    def text(self) -> str:
        """The mean in full, "inf" where all are infinite, empty where there is none."""
        return repr(self.mean) if self.finite else "inf" if self.infinite else ""


@dataclass(frozen=True, slots=True)
class PairMeans:
    """The scores of one pair of one scene, averaged over its frames.

    Attributes:
        row: The scene's row in the index.
        scene: Its key.
        pair: Left and right camera.
        is_primary: Whether it is the scene's primary pair.
        baseline_cm: The recorded baseline.
        frames: How many frames are scored.
        tallies: For each column.
        problem: "", or why there are no scores.
        views_sha256: Of the pixels of the right views that were scored.
    """

    row: int
    scene: str
    pair: tuple[int, int]
    is_primary: bool
    baseline_cm: float
    frames: int
    tallies: Mapping[str, Tally]
    problem: str = ""
    views_sha256: str = ""


@dataclass(frozen=True, slots=True)
class Cell:
    """One column of one group of pairs; None where there is no such number.

    Attributes:
        mean: Of the scenes' means.
        ci95: Half of the 95 % interval of the mean; None for one scene, and where some frames
            are infinite.
        median: Of the scenes' means.
        scenes: How many scenes have a finite mean.
        infinite: How many frames are infinite, and not averaged.
        undefined: How many frames have no score.
    """

    mean: float | None
    ci95: float | None
    median: float | None
    scenes: int
    infinite: int
    undefined: int


def tally(numbers: Iterable[float]) -> Tally:
    """Return the mean of the finite numbers, and how many there are of each kind.

    >>> tally([1.0, 3.0, math.inf, math.nan])
    Tally(mean=2.0, finite=2, infinite=1, undefined=1)
    """
    found = list(numbers)
    finite = [number for number in found if math.isfinite(number)]
    infinite = sum(map(math.isinf, found))
    mean = math.fsum(finite) / len(finite) if finite else math.nan
    return Tally(mean, len(finite), infinite, len(found) - len(finite) - infinite)


def cell(pairs: Sequence[PairMeans], column: str) -> Cell:
    """Return a column's mean over the scenes of some pairs, with its interval.

    Raises:
        ExtraError: If scipy, which knows Student's t, is not installed.
    """
    tallies = [each.tallies[column] for each in pairs]
    scenes = group_by((each for each in pairs if each.tallies[column].finite), lambda p: p.scene)
    means = [
        math.fsum(each.tallies[column].mean for each in found) / len(found)
        for found in scenes.values()
    ]
    infinite = sum(found.infinite for found in tallies)
    return Cell(
        mean=math.fsum(means) / len(means) if means else None,
        ci95=None if infinite else half_interval(means),
        median=median(means) if means else None,
        scenes=len(means),
        infinite=infinite,
        undefined=sum(found.undefined for found in tallies),
    )


def half_interval(means: Sequence[float]) -> float | None:
    """Return half of the 95 % interval of the mean: t s / sqrt(n), None for fewer than two.

    Raises:
        ExtraError: If scipy is not installed.

    >>> round(half_interval([1.0, 2.0, 3.0]), 4)
    2.4841
    """
    if len(means) < 2:
        return None
    try:
        from scipy import stats
    except ImportError as error:
        raise missing_extra("confidence intervals", "evaluation", error) from None
    quantile = stats.t.ppf((1 + CONFIDENCE) / 2, len(means) - 1)
    return float(quantile * stats.sem(means))


def group_by(
    pairs: Iterable[PairMeans], group_of: Callable[[PairMeans], Group]
) -> dict[Group, list[PairMeans]]:
    """Return pairs by group, in order of first appearance."""
    groups: dict[Group, list[PairMeans]] = {}
    for each in pairs:
        groups.setdefault(group_of(each), []).append(each)
    return groups


def strata(values: Sequence[Any], *, name: str) -> list[str]:
    """Return the stratum of each value of a column.

    Texts and up to 6 different numbers are strata themselves; other numbers fall into quarters.

    Raises:
        EvaluationError: If no value is known.

    >>> strata([18.0, 50.0, 18.0], name="focal_mm")
    ['18', '50', '18']
    """
    if not all(isinstance(value, int | float) for value in values):
        return [str(value) or "not recorded" for value in values]
    known = [number for number in values if math.isfinite(number)]
    if not known:
        raise EvaluationError(
            f"{name} is not known for any scene: make the index anew (for valid_depth_ratio with "
            f"`stereogenbench index ROOT --valid-depth`), or stratify by another column."
        )
    if len(set(known)) <= _DISTINCT_VALUES:
        return [f"{number:g}" if math.isfinite(number) else "not known" for number in values]
    inner = {float(f"{each:.4g}") for each in np.quantile(known, (0.25, 0.5, 0.75))}
    edges = sorted(inner | {min(known), max(known)})
    names = [f"[{low:g},{high:g})" for low, high in pairwise(edges)]
    names[-1] = f"{names[-1][:-1]}]"
    places = np.searchsorted(edges[1:-1], values, side="right")
    return [
        names[place] if math.isfinite(number) else "not known"
        for place, number in zip(places, values, strict=True)
    ]


Labels = tuple[str, ...]

CONTROL: Final = "control"
"""The tier of calibration controls."""


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """What one method scored.

    Attributes:
        name: What tables call it.
        tier: "G0", "G1", "G2" or "control".
        protocol: How it was scored.
        settings: The same with every choice of every metric, as plain values.
        index: The index of the scenes.
        pairs: The scores of each pair of each scene.
        distances: Distances between sets, by branch (subset, family), of primary pairs.
    """

    name: str
    tier: str
    protocol: EvaluationProtocol
    settings: Mapping[str, Any]
    index: SceneIndex
    pairs: tuple[PairMeans, ...]
    distances: Mapping[Labels, Mapping[str, FrechetDistance]] = field(default_factory=dict)

    @property
    def views_sha256(self) -> str:
        """A sha256 of all right views that were scored, by scene and pair."""
        lines = sorted(f"{each.scene} {each.pair} {each.views_sha256}\n" for each in self.pairs)
        return hashlib.sha256("".join(lines).encode()).hexdigest()


def require_comparable(results: Sequence[Scores]) -> None:
    """Raise unless the methods may stand in one table: same tier, protocol and data.

    Raises:
        EvaluationError: Naming the first two that differ, and in what.
    """
    if not results:
        raise EvaluationError("a table needs the scores of at least one method, got none.")
    first = results[0]
    for other in results[1:]:
        for what in ("tier", "protocol", "index.digest"):
            here, there = (attrgetter(what)(one) for one in (first, other))
            if here != there:
                raise EvaluationError(
                    f"{first.name} and {other.name} cannot share a table: their {what} differs "
                    f"({here} and {there}). Make a table for each."
                )
