"""Each metric against the baseline: a point for each pair, and bins with intervals.

A plot shows methods of one tier that were scored in one way.
"""

from collections.abc import Iterable, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, Final

from stereogenbench_data.errors import explain_os_errors, missing_extra
from stereogenbench_data.evaluation.aggregate import (
    CONTROL,
    PairMeans,
    Scores,
    cell,
    group_by,
)
from stereogenbench_data.evaluation.columns import COLUMNS, HEAVY_TAILED
from stereogenbench_data.schema.release import BASELINE_BINS, baseline_bin
from stereogenbench_data.sources.files import open_atomic

_SIZE_IN: Final = (9.0, 4.2)
_DPI: Final = 120
_COLOURS: Final = ("#1b5e9e", "#c4511d", "#2e7d45", "#7a3b8f", "#8a6d00", "#444444")


def write_plots(folder: Path, results: Sequence[Scores]) -> list[Path]:
    """Write one PNG for each headline metric, and return the files.

    Raises:
        ExtraError: If matplotlib is not installed.
        StorageError: If a file cannot be written.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_extra("plots", "plots", error) from None
    written = []
    for column, facts in COLUMNS.items():
        if facts.better == "neither" or not any(_scored(one.pairs, column) for one in results):
            continue
        figure = Figure(figsize=_SIZE_IN, layout="constrained")
        _draw(figure.add_subplot(), results, column)
        path = folder / f"{column}_by_baseline.png"
        cannot = f"{path}: the plot cannot be written"
        with explain_os_errors(cannot, "Choose another folder with --out."):
            folder.mkdir(parents=True, exist_ok=True)
            with open_atomic(path) as file:
                figure.savefig(file, format="png", dpi=_DPI)
        written.append(path)
    return written


def _scored(pairs: Iterable[PairMeans], column: str) -> list[PairMeans]:
    return [pair for pair in pairs if column in pair.tallies and pair.tallies[column].finite]


def _draw(axes: Any, results: Sequence[Scores], column: str) -> None:
    protocol, facts, tier = results[0].protocol, COLUMNS[column], results[0].tier
    for one, colour in zip(results, cycle(_COLOURS), strict=False):
        pairs = _scored(one.pairs, column)
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
    shown = "calibration controls" if tier == CONTROL else f"tier {tier}"
    axes.set_title(f"{protocol.label(column)} by baseline, {shown}", fontsize=11)
    axes.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.01, 1.0))
