"""An evaluation written down: one Markdown page, LaTeX, CSV and JSON tables, and plots."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal

from stereogenbench_data.errors import StorageError, cure_of
from stereogenbench_data.evaluation.aggregate import PairMeans
from stereogenbench_data.evaluation.predictions import pair_name
from stereogenbench_data.evaluation.reference import DISCREPANCIES, PAPER
from stereogenbench_data.evaluation.relations import Relation
from stereogenbench_data.evaluation.render import csv_text, latex, markdown, plain
from stereogenbench_data.evaluation.results import CONTROL, Scores
from stereogenbench_data.evaluation.table_rows import Table
from stereogenbench_data.evaluation.tiers import TIERS
from stereogenbench_data.schema.text import counted, markdown_text
from stereogenbench_data.sources.atomic_write import write_whole

Verdict = Mapping[bool | None, str]

FORMAT: Final = 2
_GAPS_TOLD: Final = 20
_VERDICTS: Final[Verdict] = {True: "holds", False: "DOES NOT HOLD", None: "cannot be told"}


def document(
    results: Sequence[Scores], tables: Sequence[Table], *, found: Sequence[Relation] = ()
) -> dict[str, Any]:
    """Return an evaluation as plain values, to be written as JSON; no number in it is nan.

    Args:
        results: Each method's scores, of one tier.
        tables: Their tables.
        found: Relations of calibration controls.
    """
    first = results[0]
    told: dict[str, Any] = {
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
        told["relations"] = [
            {"what": each.what, "holds": each.holds, "found": each.found} for each in found
        ]
    return told


def page(
    results: Sequence[Scores], tables: Sequence[Table], *, found: Sequence[Relation] = ()
) -> str:
    """Return an evaluation as a Markdown page: what was scored, the tables, every choice."""
    first = results[0]
    names = ", ".join(markdown_text(one.name) for one in results)
    tier = "" if first.tier == CONTROL else f", tier {first.tier}: {TIERS[first.tier].meaning}"
    lines = [f"# {names}{tier}", ""]
    for one in results:
        told = _coverage(one)
        lines.append(
            f"- {markdown_text(one.name)}: {counted(told['pairs'], 'pair')} of "
            f"{counted(told['scenes'], 'scene')}, {counted(told['frames'], 'frame')}"
            + (f", {counted(len(told['missing']), 'pair')} missing" if told["missing"] else "")
        )
        lines += [f"  - missing: {markdown_text(each)}" for each in told["missing"][:_GAPS_TOLD]]
    lines += ["", *(f"{markdown(table)}" for table in tables)]
    if found:
        lines += ["### Relations between the controls", ""]
        lines += [f"- {_VERDICTS[each.holds]}: {each.what} ({each.found})" for each in found]
        lines.append("")
    lines += ["### Every choice", "", *_choices(first.settings), ""]
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
        "tables.tex": "\n".join(latex(table) for table in tables),
        "tables.csv": csv_text(tables),
        "pairs.csv": pairs_csv(results),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in written.items():
            write_whole(folder / name, text.encode())
    except OSError as error:
        raise StorageError(
            f"{folder}: the report cannot be written ({error.strerror or error}). "
            + cure_of(error, "Choose another folder with --out.")
        ) from error
    files = [folder / name for name in written]
    if plots == "skip":
        return files
    from stereogenbench_data.evaluation.plots import write_plots

    return files + write_plots(folder / "plots", results)


def pairs_csv(results: Sequence[Scores]) -> str:
    """Return the scores of every pair of every scene as CSV, empty where there is none."""
    columns = list(dict.fromkeys(name for one in results for p in one.pairs for name in p.tallies))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(
        ["method", "scene", "cameras", "primary", "baseline_cm", "frames", "missing", *columns]
    )
    for one in results:
        for pair in one.pairs:
            writer.writerow(
                [
                    one.name, pair.scene, pair_name(pair.pair), int(pair.is_primary),
                    repr(pair.baseline_cm), pair.frames, pair.fault,
                    *(_mean_text(pair, name) for name in columns),
                ]
            )  # fmt: skip
    return out.getvalue()


def _mean_text(pair: PairMeans, column: str) -> str:
    found = pair.tallies.get(column)
    if found is None or not found.finite:
        return "inf" if found is not None and found.infinite else ""
    return repr(found.mean)


def _coverage(one: Scores) -> dict[str, Any]:
    scored = [pair for pair in one.pairs if not pair.fault]
    return {
        "method": one.name,
        "scenes": len({pair.scene for pair in scored}),
        "pairs": len(scored),
        "frames": sum(pair.frames for pair in scored),
        "missing": [pair.fault for pair in one.pairs if pair.fault],
    }


def _choices(settings: Mapping[str, Any]) -> list[str]:
    lines = []
    for name, value in settings.items():
        if isinstance(value, Mapping):
            inner = ", ".join(f"{key} {each}" for key, each in value.items())
            lines.append(f"- {name}: {inner}")
        elif isinstance(value, list):
            lines.append(f"- {name}: {', '.join(map(str, value))}")
        else:
            lines.append(f"- {name}: {value}")
    return lines
