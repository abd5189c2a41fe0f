"""The scores of a method, and tables of them: a row for each group of pairs and method.

Frames are averaged first, then the pairs of a scene, then scenes: every scene counts once, whatever
the number of its frames and pairs. Intervals are over scenes. A table holds methods of one tier
only: rows of different tiers answer different questions.
"""

import hashlib
import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from operator import attrgetter
from statistics import median
from typing import Any, Final, Literal, NamedTuple, TypeVar

import numpy as np

from stereogenbench_data.errors import EvaluationError, missing_extra
from stereogenbench_data.evaluation.columns import COLUMNS
from stereogenbench_data.evaluation.metrics.frechet import FrechetDistance
from stereogenbench_data.evaluation.metrics.scale import LEAST_R2
from stereogenbench_data.evaluation.protocol import DisparityProtocol, EvaluationProtocol
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import BASELINE_BINS, FAMILIES, baseline_bin

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
        loose: How many of the finite are of a line that explains hardly anything (`LEAST_R2`).
    """

    mean: float
    finite: int
    infinite: int
    undefined: int
    loose: int = 0

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
        loose: How many frames have a score by a line that explains hardly anything.
    """

    mean: float | None
    ci95: float | None
    median: float | None
    scenes: int
    infinite: int
    undefined: int
    loose: int


def tallies(columns: Mapping[str, Sequence[float]]) -> dict[str, Tally]:
    """Return the tally of each column of frames; that of a fit by the R2 beside it."""
    return {
        name: tally(numbers, r2=columns.get(f"{name}_r2", ())) for name, numbers in columns.items()
    }


def tally(numbers: Iterable[float], *, r2: Sequence[float] = ()) -> Tally:
    """Return the mean of the finite numbers, and how many there are of each kind.

    Args:
        numbers: One a frame.
        r2: Of the lines that they are the slopes of, if they are.

    >>> tally([1.0, 3.0, math.inf, math.nan])
    Tally(mean=2.0, finite=2, infinite=1, undefined=1, loose=0)
    """
    found = list(numbers)
    loose = [fit for number, fit in zip(found, r2, strict=False) if math.isfinite(number)]
    finite = [number for number in found if math.isfinite(number)]
    infinite = sum(map(math.isinf, found))
    mean = math.fsum(finite) / len(finite) if finite else math.nan
    undefined = len(found) - len(finite) - infinite
    return Tally(mean, len(finite), infinite, undefined, sum(not fit >= LEAST_R2 for fit in loose))


def with_score(pairs: Iterable[PairMeans], column: str) -> list[PairMeans]:
    """Return the pairs some of whose frames have a finite score in a column."""
    return [pair for pair in pairs if column in pair.tallies and pair.tallies[column].finite]


def cell(pairs: Sequence[PairMeans], column: str) -> Cell:
    """Return a column's mean over the scenes of some pairs, with its interval.

    Raises:
        ExtraError: If scipy, which knows Student's t, is not installed.
    """
    found_in = [each.tallies[column] for each in pairs]
    scenes = group_by(with_score(pairs, column), lambda pair: pair.scene)
    means = [
        math.fsum(each.tallies[column].mean for each in found) / len(found)
        for found in scenes.values()
    ]
    infinite = sum(found.infinite for found in found_in)
    return Cell(
        mean=math.fsum(means) / len(means) if means else None,
        ci95=None if infinite else half_interval(means),
        median=median(means) if means else None,
        scenes=len(means),
        infinite=infinite,
        undefined=sum(found.undefined for found in found_in),
        loose=sum(found.loose for found in found_in),
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

DISPARITY: Final = "disparity"
"""What stands for the tier where disparity is scored: a method is given both views."""


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """What one method scored.

    Attributes:
        name: What tables call it.
        tier: "G0", "G1", "G2", "control" or "disparity".
        protocol: How it was scored.
        settings: The same with every choice of every metric, as plain values.
        index: The index of the scenes.
        pairs: The scores of each pair of each scene.
        distances: Distances between sets, by branch (subset, family), of primary pairs.
    """

    name: str
    tier: str
    protocol: EvaluationProtocol | DisparityProtocol
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


PairsShown = Literal["primary", "all"]
_BRANCH: Final = ("subset", "family")
_BINS: Final = (*_BRANCH, "baseline")
_ORDER: Final = ("seen_map", "unseen_map", *FAMILIES, *BASELINE_BINS)
"""The release's order of what groups are called."""


class TableForm(NamedTuple):
    """What a table shows.

    Attributes:
        title: What it shows, in words.
        keys: What groups are made by: "subset", "family", "baseline" or a column of the index.
        pairs: Which pairs are in them.
    """

    title: str
    keys: tuple[str, ...]
    pairs: PairsShown = "primary"


TABLES: Final[Mapping[str, TableForm]] = {
    "branches": TableForm("Evaluation branches, primary pairs", _BRANCH),
    "bins_primary": TableForm("Baseline in cm, primary pairs", _BINS),
    "bins_all": TableForm("Baseline in cm, all pairs", _BINS, pairs="all"),
    "explanations": TableForm("What explains the scores, primary pairs", _BRANCH),
    "controls": TableForm("Calibration controls", (), pairs="all"),
}
"""The tables by name; those by a column of the index come on top."""

Value = Cell | FrechetDistance
"""The numbers of a column of frames, or a distance between sets."""


@dataclass(frozen=True, slots=True)
class TableRow:
    """One row: a method's scores of one group.

    Attributes:
        method: The method's name.
        labels: The group's values of the table's keys.
        scenes: N_s, the scenes of the group that are scored.
        frames: N_f, their frames.
        missing: How many pairs have no scores, because their right views are missing or unusable.
        values: What stands in each column.
    """

    method: str
    labels: Labels
    scenes: int
    frames: int
    missing: int
    values: Mapping[str, Value]


@dataclass(frozen=True, slots=True)
class Table:
    """One table.

    Attributes:
        name: A short name, for files.
        title: What it shows.
        keys: What groups are made by.
        protocol: How everything in it was scored.
        columns: Columns of frames, and distances.
        rows: Group by group, in each the methods.
        notes: What to know when reading it.
    """

    name: str
    title: str
    keys: tuple[str, ...]
    protocol: EvaluationProtocol | DisparityProtocol
    columns: tuple[str, ...]
    rows: tuple[TableRow, ...]
    notes: tuple[str, ...] = ()


def tables_of(results: Sequence[Scores], *, by: Sequence[str] = ()) -> list[Table]:
    """Return all tables of methods of one tier.

    Args:
        results: Each method's scores.
        by: Columns of the index to stratify by, besides branches and baselines.

    Raises:
        EvaluationError: If the methods are of different tiers or were scored in different ways, or
            if the index has no such column with one value a scene.
    """
    require_comparable(results)
    forms = forms_of(results, by)
    return [
        *(table_of(results, name, form=form) for name, form in forms.items()),
        table_of(results, "explanations"),
    ]


def forms_of(results: Sequence[Scores], by: Sequence[str]) -> dict[str, TableForm]:
    """Return the forms of tables by branch, by baseline and by columns of the index, by name."""
    has_others = any(not pair.is_primary for one in results for pair in one.pairs)
    names = ["branches", "bins_primary", *(["bins_all"] if has_others else [])]
    return {name: TABLES[name] for name in names} | {
        f"by_{each}": TableForm(f"By {each}, primary pairs", (*_BRANCH, each)) for each in by
    }


def table_of(results: Sequence[Scores], name: str, *, form: TableForm | None = None) -> Table:
    """Return a table: headline columns, or those that explain them, and distances of branches.

    Args:
        results: Each method's scores.
        name: Its name, one of `TABLES` unless a form is given.
        form: What it shows.
    """
    first, form = results[0], form or TABLES[name]
    protocol = first.protocol
    if isinstance(protocol, DisparityProtocol):
        raise EvaluationError("scores of disparity have tables of their own: `disparity_tables`.")
    explains = name == "explanations"
    columns = [each for each in protocol.columns if (COLUMNS[each].better == "neither") == explains]
    if name == "branches":
        distances = {
            metric for one in results for each in one.distances.values() for metric in each
        }
        columns += [each for each in protocol.metrics if each in distances]
    return Table(
        name=name,
        title=form.title if first.tier == CONTROL else f"{form.title} (tier {first.tier})",
        keys=form.keys,
        protocol=protocol,
        columns=tuple(columns),
        rows=rows_of(results, form),
    )


def rows_of(results: Sequence[Scores], form: TableForm) -> tuple[TableRow, ...]:
    """Return the rows of groups in the order of tables, of every method."""
    label_of = [_labels_by(key, results) for key in form.keys]
    groups_of = [
        group_by(
            (pair for pair in one.pairs if form.pairs == "all" or pair.is_primary),
            lambda pair: tuple(label(pair) for label in label_of),
        )
        for one in results
    ]
    all_labels = {labels for groups in groups_of for labels in groups}
    return tuple(
        _row(one, labels, groups[labels])
        for labels in sorted(all_labels, key=lambda labels: list(map(_rank, labels)))
        for one, groups in zip(results, groups_of, strict=True)
        if labels in groups
    )


def _labels_by(key: str, results: Sequence[Scores]) -> Callable[[PairMeans], str]:
    """Return what tells the group of a pair by one key of a table."""
    if key == "baseline":
        return lambda pair: baseline_bin(pair.baseline_cm)
    values = results[0].index.column(key)
    if key in _BRANCH:
        return lambda pair: str(values[pair.row] or "")
    if values.ndim != 1:
        raise EvaluationError(
            f"{key} has {values.shape[1]} values a scene: stratify by a column that has one."
        )
    used = sorted({pair.row for one in results for pair in one.pairs})
    plain = ["" if value is None else value for value in values[used].tolist()]
    strata_of = dict(zip(used, strata(plain, name=key), strict=True))
    return lambda pair: strata_of[pair.row]


def _rank(label: str) -> tuple[float, str]:
    """Return what orders labels: the release's order, else the first number in them."""
    if label in _ORDER:
        return _ORDER.index(label), ""
    with suppress(ValueError):
        return float(label.lstrip("[(").partition(",")[0]), label
    return math.inf, label


def _row(one: Scores, labels: Labels, pairs: Sequence[PairMeans]) -> TableRow:
    scored = [pair for pair in pairs if not pair.problem]
    cells = {name: cell(scored, name) for name in (scored[0].tallies if scored else {})}
    return TableRow(
        method=one.name,
        labels=labels,
        scenes=len({pair.scene for pair in scored}),
        frames=sum(pair.frames for pair in scored),
        missing=len(pairs) - len(scored),
        values={**cells, **one.distances.get(labels, {})},
    )
