"""The report of an evaluation: a Markdown page, LaTeX, CSV and JSON tables, and plots."""

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, Literal

from stereogenbench_data.errors import StorageError, describe_os_error
from stereogenbench_data.evaluation.aggregate import CONTROL, Cell, PairMeans, Scores
from stereogenbench_data.evaluation.columns import COLUMNS, HEAVY_TAILED
from stereogenbench_data.evaluation.controls import Relation
from stereogenbench_data.evaluation.metrics.frechet import FrechetDistance
from stereogenbench_data.evaluation.predictions import pair_name
from stereogenbench_data.evaluation.protocol import PROTOCOL_VERSION, TIERS
from stereogenbench_data.evaluation.reference import DISCREPANCIES, PAPER
from stereogenbench_data.evaluation.tables import Table, TableRow
from stereogenbench_data.schema.text import counted, markdown_text
from stereogenbench_data.sources.files import write_atomic

FORMAT: Final = 3
_GAPS_SHOWN: Final = 20
_VERDICTS: Final[Mapping[bool | None, str]] = {
    True: "holds",
    False: "DOES NOT HOLD",
    None: "cannot be told",
}
ABSENT: Final = "-"
_ARROWS: Final = {"higher": "↑", "lower": "↓", "neither": ""}
_LATEX: Final = {
    "\\": r"\textbackslash{}", "_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", "$": r"\$",
    "{": r"\{", "}": r"\}", "±": r"$\pm$", "↑": r"$\uparrow$", "↓": r"$\downarrow$",
    "∞": r"$\infty$", "†": r"$^\dagger$", "≤": r"$\le$", "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$", "|": "$|$", "[": "{[}", "*": "{*}",
}  # fmt: skip
_CSV_HEAD: Final = (
    "table", "method", "source", "group", "column", "mean", "ci95", "median", "scenes", "frames",
    "infinite", "undefined", "missing_pairs", "printed",
)  # fmt: skip
_CSV_CELL: Final = ("mean", "ci95", "median", "scenes", "finite", "infinite", "undefined")
"""The attributes of a `Cell` from "mean" to "undefined"."""


def document(
    results: Sequence[Scores], tables: Sequence[Table], *, found: Sequence[Relation] = ()
) -> dict[str, Any]:
    """Return an evaluation as plain values, to be written as JSON; no number in it is nan.

    It names what the scores are of: the data's digest, the protocol's version and every choice with
    the hashes of weights, and a hash of each method's right views.

    Args:
        results: Each method's scores, of one tier.
        tables: Their tables.
        found: Relations of calibration controls.
    """
    first = results[0]
    content: dict[str, Any] = {
        "format": FORMAT,
        "tier": first.tier,
        "methods": [one.name for one in results],
        "data": {"root": first.index.where, "digest": first.index.digest},
        "settings": dict(first.settings),
        "coverage": [_coverage(one) for one in results],
        "tables": [plain(table) for table in tables],
        "paper": {"title": PAPER, "discrepancies": dict(DISCREPANCIES)},
    }
    if found:
        content["relations"] = [
            {"what": each.what, "holds": each.holds, "found": each.found} for each in found
        ]
    return content


def page(
    results: Sequence[Scores], tables: Sequence[Table], *, found: Sequence[Relation] = ()
) -> str:
    """Return an evaluation as a Markdown page: what was scored, the tables, every choice."""
    first = results[0]
    names = ", ".join(markdown_text(one.name) for one in results)
    tier = "" if first.tier == CONTROL else f", tier {first.tier}: {TIERS[first.tier].meaning}"
    lines = [f"# {names}{tier}", "", *(f"- {each}" for each in _provenance(first))]
    for one in results:
        covered = _coverage(one)
        missing = covered["missing"]
        lines.append(
            f"- {markdown_text(one.name)}: {counted(covered['pairs'], 'pair')} of "
            f"{counted(covered['scenes'], 'scene')}, {counted(covered['frames'], 'frame')}, "
            f"right views sha256 {one.views_sha256}"
            + (f", {counted(len(missing), 'pair')} missing" if missing else "")
        )
        lines += [f"  - missing: {markdown_text(each)}" for each in missing[:_GAPS_SHOWN]]
    lines += ["", *map(markdown, tables)]
    if found:
        lines += ["### Relations between the controls", ""]
        lines += [f"- {_VERDICTS[each.holds]}: {each.what} ({each.found})" for each in found]
        lines.append("")
    lines += ["### Every choice", ""]
    for name, value in first.settings.items():
        parts = value if isinstance(value, list) else [value]
        if isinstance(value, Mapping):
            parts = [f"{key} {each}" for key, each in value.items()]
        lines.append(f"- {name}: {', '.join(map(str, parts))}")
    lines.append("")
    lines += ["### Where the paper's tables disagree", ""]
    lines += [f"- {name}: {text}" for name, text in DISCREPANCIES.items()]
    return "\n".join(lines) + "\n"


def write_report(
    folder: Path,
    results: Sequence[Scores],
    tables: Sequence[Table],
    *,
    found: Sequence[Relation] = (),
    plots: Literal["write", "skip"] = "write",
) -> list[Path]:
    """Write results.json, report.md, tables.tex, tables.csv, pairs.csv and plots; return the files.

    Raises:
        StorageError: If a file cannot be written.
        ExtraError: If plots are wanted and matplotlib is not installed.
    """
    written = {
        "results.json": json.dumps(
            document(results, tables, found=found), indent=1, allow_nan=False, ensure_ascii=False
        ),
        "report.md": page(results, tables, found=found),
        "tables.tex": "\n".join([*_tex_comments(results), *map(latex, tables)]),
        "tables.csv": csv_text(tables),
        "pairs.csv": pairs_csv(results),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in written.items():
            write_atomic(folder / name, text.encode())
    except OSError as error:
        what = f"{folder}: the report cannot be written"
        cure = "Choose another folder with --out."
        raise StorageError(describe_os_error(what, error, cure)) from error
    files = [folder / name for name in written]
    if plots == "skip":
        return files
    from stereogenbench_data.evaluation.plots import write_plots

    return files + write_plots(folder / "plots", results)


def pairs_csv(results: Sequence[Scores]) -> str:
    """Return the scores of every pair of every scene as CSV, empty where there is no score."""
    columns = list(dict.fromkeys(name for one in results for p in one.pairs for name in p.tallies))
    head = ["method", "scene", "cameras", "primary", "baseline_cm", "frames", "missing"]
    head += ["views_sha256", *columns]
    lines = (
        [
            one.name, pair.scene, pair_name(pair.pair), int(pair.is_primary),
            repr(pair.baseline_cm), pair.frames, pair.problem,
            pair.views_sha256, *(_mean_text(pair, name) for name in columns),
        ]
        for one in results
        for pair in one.pairs
    )  # fmt: skip
    return _csv(head, lines)


def _mean_text(pair: PairMeans, column: str) -> str:
    found = pair.tallies.get(column)
    if found is None or not found.finite:
        return "inf" if found is not None and found.infinite else ""
    return repr(found.mean)


def _provenance(one: Scores) -> list[str]:
    """Return what scores are of, but for the right views."""
    return [
        f"protocol: version {PROTOCOL_VERSION}",
        f"data: sha256 {one.index.digest}, at {markdown_text(one.index.where)}",
    ]


def _coverage(one: Scores) -> dict[str, Any]:
    scored = [pair for pair in one.pairs if not pair.problem]
    return {
        "method": one.name,
        "scenes": len({pair.scene for pair in scored}),
        "pairs": len(scored),
        "frames": sum(pair.frames for pair in scored),
        "views_sha256": one.views_sha256,
        "missing": [pair.problem for pair in one.pairs if pair.problem],
    }


def markdown(table: Table) -> str:
    """Return a table in Markdown, with its title and notes."""
    head, rows = _texts(table)
    texts = 1 + len(table.keys)
    rule = ["---"] * texts + ["---:"] * (len(head) - texts)
    lines = [f"### {table.title}", "", _pipes(head), _pipes(rule)]
    lines += [_pipes(list(map(markdown_text, row))) for row in rows]
    if table.notes:
        lines += ["", *(f"- {note}" for note in table.notes)]
    return "\n".join(lines) + "\n"


def latex(table: Table) -> str:
    """Return a table in LaTeX, for the package booktabs; its caption has the notes."""
    head, rows = _texts(table)
    texts = 1 + len(table.keys)
    caption = " ".join([f"{table.title}.", *table.notes])
    lines = [
        r"\begin{table}",
        r"  \centering",
        f"  \\caption{{{_tex(caption)}}}",
        f"  \\begin{{tabular}}{{{'l' * texts}{'r' * (len(head) - texts)}}}",
        r"    \toprule",
        "    " + " & ".join(map(_tex, head)) + r" \\",
        r"    \midrule",
        *("    " + " & ".join(map(_tex, row)) + r" \\" for row in rows),
        r"    \bottomrule",
        r"  \end{tabular}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def _tex_comments(results: Sequence[Scores]) -> list[str]:
    views = [f"{one.name}: right views sha256 {one.views_sha256}" for one in results]
    return [f"% {' '.join(text.split())}" for text in [*_provenance(results[0]), *views]]


def csv_text(tables: Sequence[Table]) -> str:
    """Return tables as one CSV, a line for each row and column; empty where there is no number."""
    lines: list[list[Any]] = []
    for table in tables:
        for row in table.rows:
            group = "; ".join(f"{k}={v}" for k, v in zip(table.keys, row.labels, strict=True))
            for name in table.columns:
                start = [table.name, row.method, row.source, group, heading(table, name)]
                match row.values.get(name):
                    case FrechetDistance() as distance:
                        value = _plain(distance)["value"]
                        counts = [row.scenes, row.frames, "", "", row.missing, ""]
                        lines.append([*start, value, "", "", *counts])
                    case Cell() as found:
                        numbers = [getattr(found, each) for each in _CSV_CELL]
                        lines.append([*start, *numbers, row.missing, ""])
                    case printed if row.source == "paper":
                        lines.append([*start, *[""] * 8, printed or ""])
    return _csv(_CSV_HEAD, lines)


def _csv(head: Sequence[str], lines: Iterable[Sequence[Any]]) -> str:
    """Return CSV; None is an empty field."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(lines)
    return out.getvalue()


def plain(table: Table) -> dict[str, Any]:
    """Return a table as plain values for JSON: numbers in full, null where there is none."""
    return {
        "name": table.name,
        "title": table.title,
        "keys": list(table.keys),
        "columns": {name: heading(table, name) for name in table.columns},
        "notes": list(table.notes),
        "rows": [_plain_row(table, row) for row in table.rows],
    }


def heading(table: Table, column: str) -> str:
    """Return the head of a column: its name, what it was measured with, which way is better."""
    if column not in COLUMNS:
        return f"{column.upper()}↓"
    median = " [median]" if column in HEAVY_TAILED else ""
    return f"{table.protocol.label(column)}{_ARROWS[COLUMNS[column].better]}{median}"


def _texts(table: Table) -> tuple[list[str], list[list[str]]]:
    """Return the head and the rows of a table as texts."""
    has_gaps = any(row.missing for row in table.rows)
    head = ["Method", *table.keys, "N_s", "N_f", *(["missing"] if has_gaps else [])]
    head += [heading(table, name) for name in table.columns]
    rows = []
    for row in table.rows:
        texts = [row.method, *(label or ABSENT for label in row.labels)]
        texts += [ABSENT if count is None else str(count) for count in (row.scenes, row.frames)]
        if has_gaps:
            texts.append(ABSENT if row.source == "paper" else str(row.missing))
        texts += [_cell_text(table, row, name) for name in table.columns]
        rows.append(texts)
    return head, rows


def _cell_text(table: Table, row: TableRow, column: str) -> str:
    match row.values.get(column):
        case None:
            return ABSENT
        case FrechetDistance() as distance:
            return _distance_text(distance)
        case Cell() as found:
            return _number_text(found, column)
        case printed:
            text = printed.replace("inf", "∞")
            marked = column in COLUMNS and not table.protocol.is_papers(column)
            return f"{text} †" if marked else text


def _number_text(found: Cell, column: str) -> str:
    """Return a cell's mean and interval, and what is not in them."""
    digits = COLUMNS[column].digits
    if found.mean is None:
        if found.infinite and not found.undefined:
            return f"∞ ({found.infinite} identical)"
        return f"{ABSENT} ({found.undefined} undefined)" if found.undefined else ABSENT
    text = f"{found.mean:.{digits}f}"
    if found.ci95 is not None:
        text += f" ± {found.ci95:.{digits}f}"
    if column in HEAVY_TAILED:
        text += f" [{found.median:.{digits}f}]"
    left_out = [
        f"{count} {what}"
        for count, what in ((found.infinite, "identical"), (found.undefined, "undefined"))
        if count
    ]
    return f"{text} ({', '.join(left_out)})" if left_out else text


def _distance_text(found: FrechetDistance) -> str:
    fewer = min(found.samples)
    if not math.isfinite(found.value):
        return f"{ABSENT} (N {fewer})"
    compared, mark = ("≤", " !") if found.underdetermined else (">", "")
    return f"{found.value:.2f} (N {fewer} {compared} D {found.dim}){mark}"


def _pipes(texts: Sequence[str]) -> str:
    return "| " + " | ".join(text.replace("|", r"\|") for text in texts) + " |"


def _tex(text: str) -> str:
    return "---" if text == ABSENT else "".join(_LATEX.get(letter, letter) for letter in text)


def _plain_row(table: Table, row: TableRow) -> dict[str, Any]:
    plain_row: dict[str, Any] = {
        "method": row.method,
        "source": row.source,
        "group": dict(zip(table.keys, row.labels, strict=True)),
        "scenes": row.scenes,
        "frames": row.frames,
    }
    if row.source == "paper":
        return plain_row | {"printed": dict(row.values)}
    shown = {name: row.values[name] for name in table.columns if name in row.values}
    cells = {name: _plain(each) for name, each in shown.items() if isinstance(each, Cell)}
    distances = {name: _plain(each) for name, each in shown.items() if name not in cells}
    plain_row |= {"missing_pairs": row.missing, "cells": cells}
    return plain_row | ({"distances": distances} if distances else {})


def _plain(found: Any) -> dict[str, Any]:
    """Return the numbers of a cell or of a distance; null where there is none."""
    content = asdict(found)
    if isinstance(found, FrechetDistance):
        value = found.value if math.isfinite(found.value) else None
        return content | {"value": value, "samples": list(found.samples)}
    return content
