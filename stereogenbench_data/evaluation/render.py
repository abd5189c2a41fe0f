"""Tables as text: Markdown, LaTeX, CSV and plain values for JSON."""

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, Final

from stereogenbench_data.evaluation.aggregate import Cell
from stereogenbench_data.evaluation.columns import COLUMNS, HEAVY_TAILED
from stereogenbench_data.evaluation.frechet import FrechetDistance
from stereogenbench_data.evaluation.table_rows import Row, Table
from stereogenbench_data.schema.text import markdown_text

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


def markdown(table: Table) -> str:
    """Return a table in Markdown, with its title and notes."""
    head, rows = _texts(table)
    lines = [f"### {table.title}", ""]
    lines.append(_pipes(head))
    texts = 1 + len(table.keys)
    lines.append(_pipes(["---"] * texts + ["---:"] * (len(head) - texts)))
    lines += [_pipes(list(map(markdown_text, row))) for row in rows]
    if table.notes:
        lines += ["", *(f"- {note}" for note in table.notes)]
    return "\n".join(lines) + "\n"


def latex(table: Table) -> str:
    """Return a table in LaTeX, for the package booktabs; the notes are its caption's."""
    head, rows = _texts(table)
    texts = 1 + len(table.keys)
    caption = " ".join([f"{table.title}.", *table.notes])
    body = [" & ".join(map(_tex, row)) + r" \\" for row in rows]
    lines = [
        r"\begin{table}",
        r"  \centering",
        f"  \\caption{{{_tex(caption)}}}",
        f"  \\begin{{tabular}}{{{'l' * texts}{'r' * (len(head) - texts)}}}",
        r"    \toprule",
        "    " + " & ".join(map(_tex, head)) + r" \\",
        r"    \midrule",
        *(f"    {line}" for line in body),
        r"    \bottomrule",
        r"  \end{tabular}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def csv_text(tables: Sequence[Table]) -> str:
    """Return tables as one CSV, a line for each row and column; empty where there is no number."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(_CSV_HEAD)
    for table in tables:
        for row in table.rows:
            writer.writerows(_csv_lines(table, row))
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
        return f"{_distance_label(column)}↓"
    median = " [median]" if column in HEAVY_TAILED else ""
    return f"{table.protocol.label(column)}{_ARROWS[COLUMNS[column].better]}{median}"


def _distance_label(name: str) -> str:
    return name.upper() if name in ("fid", "fvd") else f"FD{name.removeprefix('fd')}"


def _texts(table: Table) -> tuple[list[str], list[list[str]]]:
    """Return the head and the rows of a table as texts."""
    has_gaps = any(row.missing for row in table.rows)
    head = ["Method", *table.keys, "N_s", "N_f"]
    head += ["missing"] if has_gaps else []
    head += [heading(table, name) for name in table.columns]
    rows = []
    for row in table.rows:
        texts = [row.method, *(label or ABSENT for label in row.labels)]
        texts += [ABSENT if count is None else str(count) for count in (row.scenes, row.frames)]
        if has_gaps:
            texts.append(ABSENT if row.is_papers else str(row.missing))
        texts += [_cell_text(table, row, name) for name in table.columns]
        rows.append(texts)
    return head, rows


def _cell_text(table: Table, row: Row, column: str) -> str:
    if row.is_papers:
        text = row.printed.get(column, ABSENT).replace("inf", "∞")
        marked = column in COLUMNS and not table.protocol.is_papers(column) and text != ABSENT
        return f"{text} †" if marked else text
    if column in row.distances:
        return _distance_text(row.distances[column])
    found = row.cells.get(column)
    return ABSENT if found is None else _number_text(found, column)


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
    compared = "≤" if found.underdetermined else ">"
    mark = " !" if found.underdetermined else ""
    return f"{found.value:.2f} (N {fewer} {compared} D {found.dim}){mark}"


def _pipes(texts: Sequence[str]) -> str:
    return "| " + " | ".join(text.replace("|", r"\|") for text in texts) + " |"


def _tex(text: str) -> str:
    return "---" if text == ABSENT else "".join(_LATEX.get(letter, letter) for letter in text)


def _csv_lines(table: Table, row: Row) -> list[list[Any]]:
    group = "; ".join(f"{k}={v}" for k, v in zip(table.keys, row.labels, strict=True))
    source = "paper" if row.is_papers else "scored"
    lines: list[list[Any]] = []
    for name in table.columns:
        start = [table.name, row.method, source, group, heading(table, name)]
        if row.is_papers:
            lines.append([*start, *[""] * 8, row.printed.get(name, "")])
        elif name in row.distances:
            found = row.distances[name]
            value = _plain_distance(found)["value"]
            counts = [row.scenes, row.frames, "", "", row.missing, ""]
            lines.append([*start, _blank(value), "", "", *counts])
        elif name in row.cells:
            each = row.cells[name]
            numbers = [each.mean, each.ci95, each.median, each.scenes, each.finite, each.infinite]
            lines.append([*start, *map(_blank, numbers), each.undefined, row.missing, ""])
    return lines


def _blank(number: float | None) -> float | str:
    return "" if number is None else number


def _plain_row(table: Table, row: Row) -> dict[str, Any]:
    told: dict[str, Any] = {
        "method": row.method,
        "source": "paper" if row.is_papers else "scored",
        "group": dict(zip(table.keys, row.labels, strict=True)),
        "scenes": row.scenes,
        "frames": row.frames,
    }
    if row.is_papers:
        return told | {"printed": dict(row.printed)}
    cells = {name: asdict(row.cells[name]) for name in table.columns if name in row.cells}
    told |= {"missing_pairs": row.missing, "cells": cells}
    if row.distances:
        told["distances"] = {name: _plain_distance(each) for name, each in row.distances.items()}
    return told


def _plain_distance(found: FrechetDistance) -> dict[str, Any]:
    return {
        "value": found.value if math.isfinite(found.value) else None,
        "samples": list(found.samples),
        "dim": found.dim,
        "underdetermined": found.underdetermined,
    }
