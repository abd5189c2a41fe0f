"""The tables of an evaluation: groups of pairs, a row for each method, the paper's rows below.

A table holds methods of one tier only: rows of different tiers answer different questions.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.aggregate import (
    CONTROL,
    Cell,
    Labels,
    PairMeans,
    Scores,
    cell,
    grouped,
    require_comparable,
    strata,
)
from stereogenbench_data.evaluation.columns import COLUMNS, FRAME_METRICS
from stereogenbench_data.evaluation.metrics.frechet import FrechetDistance
from stereogenbench_data.evaluation.metrics.scale import SD_OF_THE_PAPER
from stereogenbench_data.evaluation.protocol import PAPER_SIZE, EvaluationProtocol
from stereogenbench_data.evaluation.reference import (
    ReferenceRow,
    TableName,
    reference_rows,
    reference_table,
)
from stereogenbench_data.schema.release import BASELINE_BINS, FAMILIES, FRAME_COUNT, baseline_bin

_SOURCES: Mapping[str, tuple[TableName, ...]] = {
    "branches": ("main", "unseen"),
    "bins_primary": ("bins",),
    "controls": ("controls",),
}


@dataclass(frozen=True, slots=True)
class TableRow:
    """One row: a method's scores of one group, or a row of the paper as printed.

    Attributes:
        method: The method's name.
        labels: The group's values of the table's keys.
        scenes: N_s, the scenes of the group that are scored; None where the paper has no number.
        frames: N_f, their frames.
        missing: How many pairs have no scores, because their right views are missing or unusable.
        cells: For each column of frames, its numbers; of a row of the paper none.
        distances: For each distance between sets, its value.
        printed: Of a row of the paper, its numbers as printed, by column.
    """

    method: str
    labels: Labels
    scenes: int | None
    frames: int | None
    missing: int = 0
    cells: Mapping[str, Cell] = field(default_factory=dict)
    distances: Mapping[str, FrechetDistance] = field(default_factory=dict)
    printed: Mapping[str, str] = field(default_factory=dict)

    @property
    def is_papers(self) -> bool:
        """Whether it is a row of the paper."""
        return bool(self.printed)


@dataclass(frozen=True, slots=True)
class Table:
    """One table.

    Attributes:
        name: A short name, for files.
        title: What it shows.
        keys: What groups are made by.
        protocol: How everything in it was scored.
        columns: Columns of frames, and distances.
        rows: Group by group.
        notes: What to know when reading it.
    """

    name: str
    title: str
    keys: tuple[str, ...]
    protocol: EvaluationProtocol
    columns: tuple[str, ...]
    rows: tuple[TableRow, ...]
    notes: tuple[str, ...] = ()


def paper_row(row: Mapping[str, str], labels: Labels) -> TableRow:
    """Return a row of one of the paper's tables, its numbers as printed."""
    printed = {}
    for name in (*FRAME_METRICS, "fid", "fvd"):
        value = row.get(name, "")
        if value:
            interval = row.get(f"{name}_ci95", "")
            headline = FRAME_METRICS.get(name, (name,))[0]
            printed[headline] = f"{value} ± {interval}" if interval else value
    return TableRow(
        method=f"{row.get('method') or row['control']} (paper)",
        labels=labels,
        scenes=int(row["n_scenes"]) if "n_scenes" in row else None,
        frames=int(row["n_frames"]) if "n_frames" in row else None,
        printed=printed,
    )


def notes_of(
    results: Sequence[Scores], rows: Sequence[TableRow], *, name: str, columns: Sequence[str]
) -> list[str]:
    """Return the notes of a table: its sources, and what is not comparable."""
    protocol = results[0].protocol
    notes = []
    if any(COLUMNS[column].fit for column in columns if column in COLUMNS):
        notes.append(f"SD: {SD_OF_THE_PAPER}.")
    if any(row.is_papers for row in rows):
        sources = "; ".join(reference_table(each).source for each in _SOURCES[name])
        notes.append(f"Rows of the paper as printed: {sources}.")
        others = [
            protocol.label(column)
            for column in columns
            if any(column in row.printed for row in rows)
            and column in COLUMNS
            and not protocol.is_papers(column)
        ]
        if others:
            notes.append(
                f"† The paper measures this by DeDoDe (E_match) or FoundationStereo (SD), not by "
                f"what the head of the column names ({', '.join(others)}): not comparable."
            )
        if protocol.size != PAPER_SIZE:
            notes.append(
                f"The paper scores at {PAPER_SIZE[1]}x{PAPER_SIZE[0]}, this at "
                f"{protocol.size[1]}x{protocol.size[0]}: not comparable."
            )
        frames = {pair.frames for one in results for pair in one.pairs if not pair.fault}
        if frames - {FRAME_COUNT}:
            ours = ", ".join(map(str, sorted(frames)))
            notes.append(f"The paper scores {FRAME_COUNT} frames a scene, this {ours}.")
    if any(found.underdetermined for row in rows for found in row.distances.values()):
        notes.append(
            "! No more samples than dimensions: the distance is biased upwards, and more so the "
            "fewer samples there are."
        )
    return notes


PairsShown = Literal["primary", "all"]

_SUBSETS: Final = ("seen_map", "unseen_map", "")
_ORDERS: Final[dict[str, Sequence[str]]] = {
    "subset": _SUBSETS,
    "family": FAMILIES,
    "baseline": tuple(BASELINE_BINS),
}
_TEXT_OF_BRANCH: Final = ("subset", "family")


def tables_of(
    results: Sequence[Scores], *, by: Mapping[str, Sequence[float]] | None = None
) -> list[Table]:
    """Return all tables of methods of one tier.

    Args:
        results: Each method's scores.
        by: Columns of the index to stratify by, besides branches and baselines; with the edges
            of numbers, or () to choose them.

    Raises:
        EvaluationError: If the methods are of different tiers or were scored in different ways.
    """
    require_comparable(results)
    tables = [branch_table(results), bin_table(results, "primary")]
    if any(not pair.is_primary for one in results for pair in one.pairs):
        tables.append(bin_table(results, "all"))
    for column, edges in (by or {}).items():
        tables.append(stratum_table(results, column, edges=edges))
    tables.append(explaining_table(results))
    return tables


def branch_table(results: Sequence[Scores]) -> Table:
    """Return primary pairs by evaluation branch, beside the paper's main tables."""

    def paper(labels: Labels) -> list[ReferenceRow]:
        subset, family = labels
        if not subset:
            return []
        name: TableName = "unseen" if subset == "unseen_map" else "main"
        return reference_rows(name, tier=results[0].tier, subset=subset, family=family)

    rows = _rows(results, _TEXT_OF_BRANCH, distances="show", paper=paper)
    distances = {name for row in rows for name in row.distances}
    return _table(
        results,
        rows,
        name="branches",
        title="Evaluation branches, primary pairs",
        keys=_TEXT_OF_BRANCH,
        extra=tuple(name for name in results[0].protocol.metrics if name in distances),
    )


def bin_table(results: Sequence[Scores], pairs: PairsShown) -> Table:
    """Return pairs by baseline in the paper's bins, beside the paper's own table."""

    def paper(labels: Labels) -> list[ReferenceRow]:
        if pairs != "primary" or labels[:2] != ("seen_map", "Uniform"):
            return []
        return reference_rows("bins", tier=results[0].tier, baseline_bin_cm=labels[2])

    keys = (*_TEXT_OF_BRANCH, "baseline")
    rows = _rows(results, keys, pairs=pairs, paper=paper)
    shown = "primary pairs" if pairs == "primary" else "all pairs"
    return _table(results, rows, name=f"bins_{pairs}", title=f"Baseline in cm, {shown}", keys=keys)


def stratum_table(results: Sequence[Scores], column: str, *, edges: Sequence[float] = ()) -> Table:
    """Return primary pairs by a column of the index.

    Raises:
        EvaluationError: If the index has no such column with one value a scene.
    """
    index = results[0].index
    values = index.column(column)
    if values.ndim != 1:
        raise EvaluationError(
            f"{column} has {values.shape[1]} values a scene: stratify by a column that has one."
        )
    rows_used = sorted({pair.row for one in results for pair in one.pairs})
    plain = [values[row] for row in rows_used]
    plain = [
        "" if each is None else each.item() if hasattr(each, "item") else each for each in plain
    ]
    named = dict(zip(rows_used, strata(plain, name=column, edges=edges), strict=True))
    keys = (*_TEXT_OF_BRANCH, column)
    return _table(
        results,
        _rows(results, keys, named=named),
        name=f"by_{column}",
        title=f"By {column}, primary pairs",
        keys=keys,
    )


def explaining_table(results: Sequence[Scores]) -> Table:
    """Return what explains the scores, by branch: matches, fits, ceilings, shares."""
    return _table(
        results,
        _rows(results, _TEXT_OF_BRANCH),
        name="explanations",
        title="What explains the scores, primary pairs",
        keys=_TEXT_OF_BRANCH,
        columns=_frame_columns(results[0].protocol, headline="no"),
    )


def control_table(results: Sequence[Scores]) -> Table:
    """Return all pairs of the selection together, beside the paper's calibration controls."""
    rows: list[TableRow] = []
    for one in results:
        rows.append(_row(one, (), list(one.pairs)))
        rows.extend(paper_row(row, ()) for row in reference_rows("controls", control=one.name))
    return _table(results, rows, name="controls", title="Calibration controls", keys=())


def _rows(
    results: Sequence[Scores],
    keys: Sequence[str],
    *,
    pairs: PairsShown = "primary",
    named: Mapping[int, str] | None = None,
    distances: Literal["show", "hide"] = "hide",
    paper: Callable[[Labels], Sequence[ReferenceRow]] = lambda labels: (),
) -> list[TableRow]:
    """Return the rows of groups in the order of tables: every method's, then the paper's.

    Args:
        results: Each method's scores.
        keys: What groups are made by: "subset", "family", "baseline" or a column of the index.
        pairs: Which pairs are in them.
        named: For a column of the index, the group of each row of the index.
        distances: Whether distances between sets are shown.
        paper: Returns the paper's rows of a group.
    """
    index = results[0].index

    def labels_of(pair: PairMeans) -> Labels:
        found = []
        for key in keys:
            if key == "baseline":
                found.append(baseline_bin(pair.baseline_cm))
            elif key in _TEXT_OF_BRANCH:
                found.append(str(index.column(key)[pair.row] or ""))
            else:
                found.append((named or {})[pair.row])
        return tuple(found)

    by_method = [
        (one, grouped((p for p in one.pairs if pairs == "all" or p.is_primary), labels_of))
        for one in results
    ]
    rows = []
    for labels in sorted(
        {labels for _, groups in by_method for labels in groups},
        key=lambda labels: [_rank(key, label) for key, label in zip(keys, labels, strict=True)],
    ):
        rows += [
            _row(one, labels, groups[labels], distances=distances)
            for one, groups in by_method
            if labels in groups
        ]
        rows += [paper_row(row, labels) for row in paper(labels)]
    return rows


def _rank(key: str, label: str) -> tuple[float, str]:
    order = list(_ORDERS.get(key, ()))
    if label in order:
        return float(order.index(label)), ""
    start = label.lstrip("[(").partition(",")[0]
    try:
        return float(start), label
    except ValueError:
        return float(len(order)), label


def _row(
    one: Scores,
    labels: Labels,
    pairs: Sequence[PairMeans],
    *,
    distances: Literal["show", "hide"] = "hide",
) -> TableRow:
    scored = [pair for pair in pairs if not pair.fault]
    columns = scored[0].tallies if scored else {}
    return TableRow(
        method=one.name,
        labels=labels,
        scenes=len({pair.scene for pair in scored}),
        frames=sum(pair.frames for pair in scored),
        missing=len(pairs) - len(scored),
        cells={name: cell(scored, name) for name in columns},
        distances=one.distances.get(labels, {}) if distances == "show" else {},
    )


def _frame_columns(
    protocol: EvaluationProtocol, *, headline: Literal["yes", "no"]
) -> tuple[str, ...]:
    return tuple(
        name
        for name in protocol.columns
        if (COLUMNS[name].better != "neither") == (headline == "yes")
    )


def _table(  # noqa: PLR0913 - the parts of one table
    results: Sequence[Scores],
    rows: Sequence[TableRow],
    *,
    name: str,
    title: str,
    keys: tuple[str, ...],
    columns: tuple[str, ...] | None = None,
    extra: tuple[str, ...] = (),
) -> Table:
    protocol = results[0].protocol
    shown = _frame_columns(protocol, headline="yes") if columns is None else columns
    return Table(
        name=name,
        title=title if results[0].tier == CONTROL else f"{title} (tier {results[0].tier})",
        keys=keys,
        protocol=protocol,
        columns=(*shown, *extra),
        rows=tuple(rows),
        notes=tuple(notes_of(results, rows, name=name, columns=(*shown, *extra))),
    )
