"""The report of an evaluation: results.json, a page for people, plots."""

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import cycle
from pathlib import Path
from typing import Any, Final

from stereogenbench_data.errors import explain_os_errors, missing_extra
from stereogenbench_data.evaluation.columns import COLUMNS, HEAVY_TAILED
from stereogenbench_data.evaluation.metrics.frechet import FrechetDistance
from stereogenbench_data.evaluation.metrics.scale import LEAST_R2
from stereogenbench_data.evaluation.predictions import pair_name
from stereogenbench_data.evaluation.protocol import PROTOCOL_VERSION, TIERS
from stereogenbench_data.evaluation.tables import (
    CONTROL,
    DISPARITY,
    Cell,
    Scores,
    Table,
    Value,
    cell,
    group_by,
    with_score,
)
from stereogenbench_data.schema.release import BASELINE_BINS, baseline_bin
from stereogenbench_data.schema.text import counted, markdown_table, markdown_text
from stereogenbench_data.sources.files import open_atomic, write_atomic

FORMAT: Final = 7
_GAPS_SHOWN: Final = 20
ABSENT: Final = "-"
_ARROWS: Final = {"higher": "↑", "lower": "↓", "neither": ""}
_LATEX: Final = {
    "\\": r"\textbackslash{}", "_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", "$": r"\$",
    "{": r"\{", "}": r"\}", "±": r"$\pm$", "↑": r"$\uparrow$", "↓": r"$\downarrow$",
    "∞": r"$\infty$", "≤": r"$\le$",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$", "|": "$|$",
    "[": "{[}", "*": "{*}",
}  # fmt: skip


def document(results: Sequence[Scores], tables: Sequence[Table]) -> dict[str, Any]:
    """Return an evaluation as plain values, to be written as JSON; no number in it is nan.

    It names what the scores are of: the data's digest, the protocol's version and every choice with
    the hashes of weights, and a hash of each method's right views.

    Args:
        results: Each method's scores, of one tier.
        tables: Their tables.
    """
    first = results[0]
    return {
        "format": FORMAT,
        "tier": first.tier,
        "data": {"root": first.index.where, "digest": first.index.digest},
        "settings": dict(first.settings),
        "coverage": [_coverage(one) for one in results],
        "tables": [_plain_table(table) for table in tables],
    }


def page(results: Sequence[Scores], tables: Sequence[Table]) -> str:
    """Return an evaluation as a Markdown page: what was scored, the tables, every choice."""
    first = results[0]
    names = ", ".join(markdown_text(one.name) for one in results)
    is_tier = first.tier in TIERS
    tier = f", tier {first.tier}: {TIERS[first.tier].meaning}" if is_tier else ""
    lines = [
        f"# {names}{tier}",
        "",
        f"- protocol: version {PROTOCOL_VERSION}",
        f"- data: sha256 {first.index.digest}, at {markdown_text(first.index.where)}",
    ]
    for one in results:
        covered = _coverage(one)
        missing = covered["missing"]
        what = "disparity maps" if first.tier == DISPARITY else "right views"
        lines.append(
            f"- {markdown_text(one.name)}: {_counts(covered)}, {what} sha256 {one.views_sha256}"
        )
        lines += [f"  - missing: {markdown_text(each)}" for each in missing[:_GAPS_SHOWN]]
    lines += ["", *map(markdown, tables)]
    lines += ["### Every choice", ""]
    for name, value in first.settings.items():
        parts = value if isinstance(value, list) else [value]
        if isinstance(value, Mapping):
            parts = [f"{key} {each}" for key, each in value.items()]
        lines.append(f"- {name}: {', '.join(map(str, parts))}")
    return "\n".join(lines) + "\n"


def write_report(folder: Path, results: Sequence[Scores], tables: Sequence[Table]) -> list[Path]:
    """Write results.json, report.md, tables.tex, pairs.csv and plots; return the files.

    Raises:
        StorageError: If a file cannot be written.
        ExtraError: If matplotlib is not installed.
    """
    written = {
        "results.json": json.dumps(
            document(results, tables), indent=1, allow_nan=False, ensure_ascii=False
        ),
        "report.md": page(results, tables),
        "tables.tex": "\n".join(map(latex, tables)),
        "pairs.csv": pairs_csv(results),
    }
    cannot = f"{folder}: the report cannot be written"
    with explain_os_errors(cannot, "Choose another folder with --out."):
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in written.items():
            write_atomic(folder / name, text.encode())
        # Controls do not depend on the baseline.
        plots = [] if results[0].tier == CONTROL else _write_plots(folder / "plots", results)
    return [*(folder / name for name in written), *plots]


_SIZE_IN: Final = (9.0, 4.2)
_DPI: Final = 120
_COLOURS: Final = ("#1b5e9e", "#c4511d", "#2e7d45", "#7a3b8f", "#8a6d00", "#444444")


def _write_plots(folder: Path, results: Sequence[Scores]) -> list[Path]:
    """Write each headline metric against the baseline as a PNG, and return the files.

    There is a point for each pair, and a line through bins with intervals.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_extra("plots", "plots", error) from None
    written = []
    for column in results[0].protocol.plotted:
        if any(with_score(one.pairs, column) for one in results):
            figure = Figure(figsize=_SIZE_IN, layout="constrained")
            _draw(figure.add_subplot(), results, column)
            written.append(folder / f"{column}_by_baseline.png")
            folder.mkdir(exist_ok=True)
            with open_atomic(written[-1]) as file:
                figure.savefig(file, format="png", dpi=_DPI)
    return written


def _draw(axes: Any, results: Sequence[Scores], column: str) -> None:
    protocol, facts, tier = results[0].protocol, COLUMNS[column], results[0].tier
    for one, colour in zip(results, cycle(_COLOURS), strict=False):
        pairs = with_score(one.pairs, column)
        axes.scatter(
            [pair.baseline_cm for pair in pairs],
            [pair.tallies[column].mean for pair in pairs],
            s=14, alpha=0.45, color=colour, linewidths=0,
        )  # fmt: skip
        groups = group_by(pairs, lambda pair: baseline_bin(pair.baseline_cm))
        bins = [groups[name] for name in BASELINE_BINS if name in groups]
        cells = [cell(group, column) for group in bins]
        axes.errorbar(
            [sum(pair.baseline_cm for pair in group) / len(group) for group in bins],
            [found.mean for found in cells],
            yerr=[found.ci95 or 0.0 for found in cells],
            fmt="o-", color=colour, markersize=6, linewidth=1.6, capsize=3,
            label=f"{one.name}: bins, 95 % intervals",
        )  # fmt: skip
    ticks = [low for low, _ in BASELINE_BINS.values() if low]
    axes.set_xscale("log")
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.grid(axis="x", color="#dddddd", linewidth=0.8)
    if column in HEAVY_TAILED:
        axes.set_ylim(bottom=0)
        axes.set_yscale("symlog", linthresh=0.1)
    axes.set_xlabel("baseline in cm")
    axes.set_ylabel(f"{protocol.label(column)} ({facts.better} is better)")
    shown = {CONTROL: "calibration controls", DISPARITY: "all pixels"}.get(tier, f"tier {tier}")
    axes.set_title(f"{protocol.label(column)} by baseline, {shown}", fontsize=11)
    axes.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.01, 1.0))


def pairs_csv(results: Sequence[Scores]) -> str:
    """Return the scores of every pair of every scene as CSV, empty where there is no score."""
    columns = list(dict.fromkeys(name for one in results for p in one.pairs for name in p.tallies))
    out = io.StringIO()
    head = (
        "method", "scene", "cameras", "primary", "baseline_cm", "frames", "missing", "views_sha256",
    )  # fmt: skip
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*head, *columns])
    for one in results:
        for pair in one.pairs:
            facts = (
                one.name, pair.scene, pair_name(pair.pair), int(pair.is_primary),
                repr(pair.baseline_cm), pair.frames, pair.problem, pair.views_sha256,
            )  # fmt: skip
            tallies = [pair.tallies.get(name) for name in columns]
            writer.writerow([*facts, *("" if each is None else each.text for each in tallies)])
    return out.getvalue()


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


def _counts(covered: Mapping[str, Any]) -> str:
    """Return in words how much was scored of a method."""
    missing = covered["missing"]
    return (
        f"{counted(covered['pairs'], 'pair')} of {counted(covered['scenes'], 'scene')}, "
        f"{counted(covered['frames'], 'frame')}"
        + (f", {counted(len(missing), 'pair')} missing" if missing else "")
    )


def markdown(table: Table) -> str:
    """Return a table in Markdown, with its title and notes."""
    notes = ["", *(f"- {note}" for note in table.notes)] if table.notes else []
    lines = [f"### {table.title}", "", *markdown_table(*_texts(table)), *notes]
    return "\n".join(lines) + "\n"


def latex(table: Table) -> str:
    """Return a table in LaTeX, for the package booktabs; its notes stand in the page alone."""
    escapes = str.maketrans(_LATEX)
    caption = f"{table.title}.".translate(escapes)
    head, *rows = (" & ".join(each.translate(escapes) for each in row) for row in _texts(table))
    left = "l" * (1 + len(table.keys))
    lines = [
        rf"\begin{{table}} \centering \caption{{{caption}}}",
        rf"\begin{{tabular}}{{{left}{'r' * (len(_texts(table)[0]) - len(left))}}} \toprule",
        rf"{head} \\ \midrule",
        *(rf"{row} \\" for row in rows),
        r"\bottomrule \end{tabular} \end{table}",
    ]
    return "\n".join(lines) + "\n"


def transposed(table: Table) -> list[list[str]]:
    """Return a table as cells, a row a column of it: few methods have many."""
    return [list(row) for row in zip(*_texts(table), strict=True)]


def verdict(results: Sequence[Scores]) -> str:
    """Return in a line or two what was scored; of controls, what the rendered target is best in."""
    first = results[0]
    if first.tier == CONTROL:
        return _verdict_of_controls(results)
    return "\n".join(f"{one.name}: scored {_counts(_coverage(one))}." for one in results)


def _verdict_of_controls(results: Sequence[Scores]) -> str:
    """Return in which columns the rendered target, the first control, scores best."""
    target, *others = results
    best: list[str] = []
    worse: list[str] = []
    for name in target.protocol.plotted:
        sign = -1 if COLUMNS[name].better == "lower" else 1
        means = [sign * _mean(one, name) for one in (target, *others)]
        is_best = not any(mean > means[0] for mean in means[1:])
        (best if is_best else worse).append(target.protocol.label(name))
    told = f"The {target.name} scores best in {len(best)} of {len(best) + len(worse)} columns"
    return f"{told}; not in {', '.join(worse)}." if worse else f"{told}."


def _mean(one: Scores, column: str) -> float:
    """Return a column's mean, infinite where every frame is."""
    found = cell([pair for pair in one.pairs if not pair.problem], column)
    mean: float = math.nan if found.mean is None else found.mean
    return math.inf if found.mean is None and found.infinite else mean


def _texts(table: Table) -> list[list[str]]:
    """Return the cells of the head and of each row."""
    has_gaps = any(row.missing for row in table.rows)
    head = ["Method", *table.keys, "N_s", "N_f", *(["missing"] if has_gaps else [])]
    lines = [head + [heading(table, name) for name in table.columns]]
    for row in table.rows:
        counts = [row.scenes, row.frames, *([row.missing] if has_gaps else [])]
        texts = [row.method, *(label or ABSENT for label in row.labels)]
        texts += map(str, counts)
        lines.append(texts + [_cell_text(table, row.values, name) for name in table.columns])
    return lines


def heading(table: Table, column: str) -> str:
    """Return the head of a column: its name, what it was measured with, which way is better."""
    if column not in COLUMNS:
        return f"{column.upper()}↓"
    median = " [median]" if column in HEAVY_TAILED else ""
    return f"{table.protocol.label(column)}{_ARROWS[COLUMNS[column].better]}{median}"


def _cell_text(table: Table, values: Mapping[str, Value], column: str) -> str:
    match values.get(column):
        case None:
            return ABSENT
        case FrechetDistance(value=None, samples=samples):
            return f"{ABSENT} (N {min(samples)})"
        case FrechetDistance(value=distance, samples=samples, dim=dim, underdetermined=is_under):
            compared, remark = ("≤", ": biased upwards") if is_under else (">", "")
            return f"{distance:.2f} (N {min(samples)} {compared} D {dim}{remark})"
        case Cell() as found:
            remarks = _remarks(found, column, values)
            text = _number_text(found, column)
            return f"{text} ({', '.join(remarks)})" if remarks else text


def _number_text(found: Cell, column: str) -> str:
    """Return a cell's mean and interval."""
    digits = COLUMNS[column].digits
    text = "∞" if found.infinite and not found.undefined else ABSENT
    if found.mean is not None:
        text = f"{found.mean:.{digits}f}"
        text += "" if found.ci95 is None else f" ± {found.ci95:.{digits}f}"
        text += f" [{found.median:.{digits}f}]" if column in HEAVY_TAILED else ""
    return text


def _remarks(found: Cell, column: str, values: Mapping[str, Value]) -> list[str]:
    """Return what is not in a cell's mean, and what it is to be read with."""
    counts = (
        (found.infinite, "identical"),
        (found.undefined, "undefined"),
        (found.loose, f"with R2 below {LEAST_R2:g}"),
    )
    told = [f"{count} {what}" for count, what in counts if count]
    match values.get("sd_beyond"):
        case Cell(mean=float(share)) if column in HEAVY_TAILED and share > 0:
            told.append(f"{share:.1%} beyond range")
    match found.mean, values.get("p_psnr_ceiling"):
        case float(own_db), Cell(mean=float(ceiling_db)) if (
            column == "p_psnr" and own_db > ceiling_db
        ):
            told.append(f"above the target's {ceiling_db:.2f}, so not better")
    return told


def _plain_table(table: Table) -> dict[str, Any]:
    """Return a table as plain values for JSON: numbers in full, null where there is none."""
    return {
        "name": table.name,
        "title": table.title,
        "columns": {name: heading(table, name) for name in table.columns},
        "notes": list(table.notes),
        "rows": [
            {
                "method": row.method,
                "group": dict(zip(table.keys, row.labels, strict=True)),
                "scenes": row.scenes,
                "frames": row.frames,
                "missing": row.missing,
                "values": {
                    name: asdict(value)
                    for name, value in row.values.items()
                    if name in table.columns
                },
            }
            for row in table.rows
        ],
    }
