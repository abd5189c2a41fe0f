"""The tables of an evaluation: groups of pairs, a row for each method, the paper's rows below.

A table holds methods of one tier alone: rows of different tiers answer different questions.
"""

from collections.abc import Mapping, Sequence
from typing import Final, Literal

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.aggregate import PairMeans, cell, grouped, strata
from stereogenbench_data.evaluation.columns import COLUMNS
from stereogenbench_data.evaluation.protocol import EvaluationProtocol
from stereogenbench_data.evaluation.reference import reference_rows
from stereogenbench_data.evaluation.results import CONTROL, Labels, Scores, require_comparable
from stereogenbench_data.evaluation.table_rows import Row, Table, notes_of, paper_row
from stereogenbench_data.schema.release import BASELINE_BINS, FAMILIES, baseline_bin

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
    rows: list[Row] = []
    for labels, group in _groups(results, _TEXT_OF_BRANCH, pairs="primary"):
        rows.extend(_row(one, labels, found, distances=True) for one, found in group)
        subset, family = labels
        name: Literal["main", "unseen"] = "unseen" if subset == "unseen_map" else "main"
        if subset:
            rows.extend(
                paper_row(row, labels)
                for row in reference_rows(name, tier=results[0].tier, subset=subset, family=family)
            )
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
    keys = (*_TEXT_OF_BRANCH, "baseline")
    rows: list[Row] = []
    for labels, group in _groups(results, keys, pairs=pairs):
        rows.extend(_row(one, labels, found) for one, found in group)
        if pairs == "primary" and labels[:2] == ("seen_map", "Uniform"):
            rows.extend(
                paper_row(row, labels)
                for row in reference_rows("bins", tier=results[0].tier, baseline_bin_cm=labels[2])
            )
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
    rows: list[Row] = []
    for labels, group in _groups(results, (*_TEXT_OF_BRANCH, column), pairs="primary", named=named):
        rows.extend(_row(one, labels, found) for one, found in group)
    return _table(
        results,
        rows,
        name=f"by_{column}",
        title=f"By {column}, primary pairs",
        keys=(*_TEXT_OF_BRANCH, column),
    )


def explaining_table(results: Sequence[Scores]) -> Table:
    """Return what explains the scores, by branch: matches, fits, ceilings, shares."""
    rows: list[Row] = []
    for labels, group in _groups(results, _TEXT_OF_BRANCH, pairs="primary"):
        rows.extend(_row(one, labels, found) for one, found in group)
    wanted = _frame_columns(results[0].protocol, headline="no")
    return _table(
        results,
        rows,
        name="explanations",
        title="What explains the scores, primary pairs",
        keys=_TEXT_OF_BRANCH,
        columns=wanted,
    )


def control_table(results: Sequence[Scores]) -> Table:
    """Return all pairs of the selection together, beside the paper's calibration controls."""
    rows: list[Row] = []
    for one in results:
        rows.append(_row(one, (), list(one.pairs)))
        rows.extend(paper_row(row, ()) for row in reference_rows("controls", control=one.name))
    return _table(results, rows, name="controls", title="Calibration controls", keys=())


def _groups(
    results: Sequence[Scores],
    keys: Sequence[str],
    *,
    pairs: PairsShown,
    named: Mapping[int, str] | None = None,
) -> list[tuple[Labels, list[tuple[Scores, list[PairMeans]]]]]:
    """Return the groups in the order of tables, each with the pairs of every method."""
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
    every = sorted(
        {labels for _, groups in by_method for labels in groups},
        key=lambda labels: [_rank(key, label) for key, label in zip(keys, labels, strict=True)],
    )
    return [
        (labels, [(one, groups[labels]) for one, groups in by_method if labels in groups])
        for labels in every
    ]


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
    one: Scores, labels: Labels, pairs: Sequence[PairMeans], *, distances: bool = False
) -> Row:
    scored = [pair for pair in pairs if not pair.fault]
    columns = scored[0].tallies if scored else {}
    return Row(
        method=one.name,
        labels=labels,
        scenes=len({pair.scene for pair in scored}),
        frames=sum(pair.frames for pair in scored),
        missing=len(pairs) - len(scored),
        cells={name: cell(scored, name) for name in columns},
        distances=one.distances.get(labels, {}) if distances else {},
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
    rows: Sequence[Row],
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
