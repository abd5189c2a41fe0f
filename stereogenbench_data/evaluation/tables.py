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
    group_by,
    require_comparable,
    strata,
)
from stereogenbench_data.evaluation.columns import COLUMNS, FRAME_METRICS
from stereogenbench_data.evaluation.metrics.frechet import FrechetDistance
from stereogenbench_data.evaluation.metrics.scale import SD_OF_THE_PAPER
from stereogenbench_data.evaluation.protocol import PAPER_SIZE, EvaluationProtocol
from stereogenbench_data.evaluation.reference import (
    SOURCES,
    ReferenceRow,
    TableName,
    reference_rows,
    release_difference,
)
from stereogenbench_data.schema.release import BASELINE_BINS, FAMILIES, FRAME_COUNT, baseline_bin

PairsShown = Literal["primary", "all"]

_TABLES_OF_THE_PAPER: Final[Mapping[str, tuple[TableName, ...]]] = {
    "branches": ("main", "unseen"),
    "bins_primary": ("bins",),
    "controls": ("controls",),
}
"""The tables of the paper whose rows stand in a table of ours."""

_BRANCH: Final = ("subset", "family")
_ORDERS: Final[Mapping[str, Sequence[str]]] = {
    "subset": ("seen_map", "unseen_map", ""),
    "family": FAMILIES,
    "baseline": tuple(BASELINE_BINS),
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
        cells: For each column of frames, its numbers; empty in a row of the paper.
        distances: For each distance between sets, its value.
        printed: In a row of the paper, its numbers as printed, by column.
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

    rows = _rows(results, _BRANCH, distances="show", paper=paper)
    return _table(results, rows, "branches", "Evaluation branches, primary pairs", _BRANCH)


def bin_table(results: Sequence[Scores], pairs: PairsShown) -> Table:
    """Return pairs by baseline in the paper's bins, beside the paper's own table."""

    def paper(labels: Labels) -> list[ReferenceRow]:
        if pairs != "primary" or labels[:2] != ("seen_map", "Uniform"):
            return []
        return reference_rows("bins", tier=results[0].tier, baseline_bin_cm=labels[2])

    keys = (*_BRANCH, "baseline")
    rows = _rows(results, keys, pairs=pairs, paper=paper)
    return _table(results, rows, f"bins_{pairs}", f"Baseline in cm, {pairs} pairs", keys)


def stratum_table(results: Sequence[Scores], column: str, *, edges: Sequence[float] = ()) -> Table:
    """Return primary pairs by a column of the index.

    Raises:
        EvaluationError: If the index has no such column with one value a scene.
    """
    values = results[0].index.column(column)
    if values.ndim != 1:
        raise EvaluationError(
            f"{column} has {values.shape[1]} values a scene: stratify by a column that has one."
        )
    used = sorted({pair.row for one in results for pair in one.pairs})
    plain = ["" if value is None else value for value in values[used].tolist()]
    strata_of = dict(zip(used, strata(plain, name=column, edges=edges), strict=True))
    keys = (*_BRANCH, column)
    rows = _rows(results, keys, strata_of=strata_of)
    return _table(results, rows, f"by_{column}", f"By {column}, primary pairs", keys)


def explaining_table(results: Sequence[Scores]) -> Table:
    """Return what explains the scores, by branch: matches, fits, ceilings, shares."""
    title = "What explains the scores, primary pairs"
    return _table(results, _rows(results, _BRANCH), "explanations", title, _BRANCH)


def control_table(results: Sequence[Scores]) -> Table:
    """Return all pairs of the selection together, beside the paper's calibration controls."""
    rows: list[TableRow] = []
    differs = _difference(results, "controls")
    for one in results:
        rows.append(_row(one, (), one.pairs))
        found = reference_rows("controls", control=one.name)
        rows.extend(_paper_row(row, (), differs=differs) for row in found)
    return _table(results, rows, "controls", "Calibration controls", ())


def _rows(
    results: Sequence[Scores],
    keys: Sequence[str],
    *,
    pairs: PairsShown = "primary",
    strata_of: Mapping[int, str] | None = None,
    distances: Literal["show", "hide"] = "hide",
    paper: Callable[[Labels], Sequence[ReferenceRow]] = lambda labels: (),
) -> list[TableRow]:
    """Return the rows of groups in the order of tables: every method's, then the paper's.

    Args:
        results: Each method's scores.
        keys: What groups are made by: "subset", "family", "baseline" or a column of the index.
        pairs: Which pairs are in them.
        strata_of: For a column of the index, the group of each row of the index.
        distances: Whether distances between sets are shown.
        paper: Returns the paper's rows of a group.
    """
    index = results[0].index
    differs = _difference(results)

    def label_of(pair: PairMeans, key: str) -> str:
        if key == "baseline":
            return baseline_bin(pair.baseline_cm)
        if key in _BRANCH:
            return str(index.column(key)[pair.row] or "")
        return (strata_of or {})[pair.row]

    by_method = [
        (
            one,
            group_by(
                (pair for pair in one.pairs if pairs == "all" or pair.is_primary),
                lambda pair: tuple(label_of(pair, key) for key in keys),
            ),
        )
        for one in results
    ]
    rows = []
    for labels in sorted(
        {labels for _, groups in by_method for labels in groups},
        key=lambda labels: [_rank(key, label) for key, label in zip(keys, labels, strict=True)],
    ):
        for one, groups in by_method:
            if labels in groups:
                found = one.distances.get(labels, {}) if distances == "show" else {}
                rows.append(_row(one, labels, groups[labels], distances=found))
        rows += [_paper_row(row, labels, differs=differs) for row in paper(labels)]
    return rows


def _rank(key: str, label: str) -> tuple[float, str]:
    """Return what orders labels: the release's order, else the first number in them."""
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
    distances: Mapping[str, FrechetDistance] | None = None,
) -> TableRow:
    scored = [pair for pair in pairs if not pair.problem]
    columns = scored[0].tallies if scored else {}
    return TableRow(
        method=one.name,
        labels=labels,
        scenes=len({pair.scene for pair in scored}),
        frames=sum(pair.frames for pair in scored),
        missing=len(pairs) - len(scored),
        cells={name: cell(scored, name) for name in columns},
        distances=distances or {},
    )


def _difference(results: Sequence[Scores], name: str = "") -> str:
    """Return how the scored scenes differ from the paper's, empty if they do not."""
    rows = {pair.row for one in results for pair in one.pairs if not pair.problem}
    scored = "all" if name == "controls" else "some"
    return release_difference(results[0].index, rows, scored=scored)


def _paper_row(row: ReferenceRow, labels: Labels, *, differs: str) -> TableRow:
    """Return a row of one of the paper's tables, its numbers as printed."""
    printed = {}
    for name in (*FRAME_METRICS, "fid", "fvd"):
        if value := row.get(name, ""):
            interval = row.get(f"{name}_ci95", "")
            headline = FRAME_METRICS.get(name, (name,))[0]
            printed[headline] = f"{value} ± {interval}" if interval else value
    return TableRow(
        method=f"{row.get('method') or row['control']} (paper{', other scenes' * bool(differs)})",
        labels=labels,
        scenes=int(row["n_scenes"]) if "n_scenes" in row else None,
        frames=int(row["n_frames"]) if "n_frames" in row else None,
        printed=printed,
    )


def _table(
    results: Sequence[Scores],
    rows: Sequence[TableRow],
    name: str,
    title: str,
    keys: tuple[str, ...],
) -> Table:
    """Return a table of rows: headline columns, or those that explain them, and distances."""
    protocol, explains = results[0].protocol, name == "explanations"
    columns = (
        *(each for each in protocol.columns if (COLUMNS[each].better == "neither") == explains),
        *(each for each in protocol.metrics if any(each in row.distances for row in rows)),
    )
    return Table(
        name=name,
        title=title if results[0].tier == CONTROL else f"{title} (tier {results[0].tier})",
        keys=keys,
        protocol=protocol,
        columns=columns,
        rows=tuple(rows),
        notes=tuple(_notes(results, rows, columns, name=name)),
    )


def _notes(
    results: Sequence[Scores], rows: Sequence[TableRow], columns: Sequence[str], *, name: str
) -> list[str]:
    """Return the notes of a table: its sources, and what is not comparable."""
    protocol, of_frames = results[0].protocol, [each for each in columns if each in COLUMNS]
    notes = []
    if any(COLUMNS[column].fit for column in of_frames):
        notes.append(f"SD: {SD_OF_THE_PAPER}.")
    if any(row.is_papers for row in rows):
        differs = _difference(results, name)
        if differs:
            notes.append(
                f"NOT COMPARABLE WITH THE PAPER: these scores are not of the release's evaluation "
                f"scenes, but of {differs}. Its rows are of other pictures: nothing here is better "
                f"or worse than they."
            )
        sources = "; ".join(SOURCES[each] for each in _TABLES_OF_THE_PAPER[name])
        notes.append(f"Rows of the paper as printed: {sources}.")
        others = [
            protocol.label(column)
            for column in of_frames
            if any(column in row.printed for row in rows) and not protocol.is_papers(column)
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
        frames = {pair.frames for one in results for pair in one.pairs if not pair.problem}
        if frames - {FRAME_COUNT}:
            ours = ", ".join(map(str, sorted(frames)))
            notes.append(f"The paper scores {FRAME_COUNT} frames a scene, this {ours}.")
    if any(found.underdetermined for row in rows for found in row.distances.values()):
        notes.append(
            "! No more samples than dimensions: the distance is biased upwards, and more so the "
            "fewer samples there are."
        )
    return notes
