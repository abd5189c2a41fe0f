"""Each metric against the baseline: a point for each pair, bins with intervals, the paper's bins.

A plot shows methods of one tier that were scored in one way.
"""

from collections.abc import Iterable, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, Final

from stereogenbench_data.errors import StorageError, describe_os_error, missing_extra
from stereogenbench_data.evaluation.aggregate import (
    CONTROL,
    PairMeans,
    Scores,
    cell,
    group_by,
    require_comparable,
)
from stereogenbench_data.evaluation.columns import COLUMNS, FRAME_METRICS, HEAVY_TAILED
from stereogenbench_data.evaluation.reference import reference_rows, release_difference
from stereogenbench_data.schema.release import BASELINE_BINS, baseline_bin
from stereogenbench_data.sources.files import open_atomic

_SIZE_IN: Final = (9.0, 4.2)
_DPI: Final = 120
_COLOURS: Final = ("#1b5e9e", "#c4511d", "#2e7d45", "#7a3b8f", "#8a6d00", "#444444")
_LONGEST_TICK_CM: Final = 2000
_LINEAR_SD: Final = 2.0
_MARGIN: Final = 0.08


def write_plots(folder: Path, results: Sequence[Scores]) -> list[Path]:
    """Write one PNG for each headline metric, and return the files.

    Raises:
        EvaluationError: If the methods are of different tiers or were scored in different ways.
        ExtraError: If matplotlib is not installed.
        StorageError: If a file cannot be written.
    """
    require_comparable(results)
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
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with open_atomic(path) as file:
                figure.savefig(file, format="png", dpi=_DPI)
        except OSError as error:
            what = f"{path}: the plot cannot be written"
            cure = "Choose another folder with --out."
            raise StorageError(describe_os_error(what, error, cure)) from error
        written.append(path)
    return written


def _scored(pairs: Iterable[PairMeans], column: str) -> list[PairMeans]:
    return [pair for pair in pairs if column in pair.tallies and pair.tallies[column].finite]


def _draw(axes: Any, results: Sequence[Scores], column: str) -> None:
    protocol, facts = results[0].protocol, COLUMNS[column]
    heights = []
    for one, colour in zip(results, cycle(_COLOURS), strict=False):
        pairs = _scored(one.pairs, column)
        if not pairs:
            axes.plot([], [], color=colour, label=f"{one.name}: no finite number")
            continue
        # Lines join the pairs of a scene that share their left view: same content, wider baseline.
        for sweep in group_by(pairs, lambda pair: (pair.scene, pair.pair[0])).values():
            if len(sweep) > 1:
                sweep.sort(key=lambda pair: pair.baseline_cm)
                axes.plot(*_points(sweep, column), color=colour, linewidth=0.6, alpha=0.35)
        baselines_cm, means = _points(pairs, column)
        axes.scatter(baselines_cm, means, s=14, alpha=0.45, color=colour, linewidths=0)
        heights += means
        _draw_bins(axes, pairs, column, colour, name=one.name)
    differs = release_difference(
        results[0].index, {pair.row for one in results for pair in one.pairs if not pair.problem}
    )
    metric = {columns[0]: name for name, columns in FRAME_METRICS.items()}.get(column)
    if metric is not None and protocol.is_papers(column):
        heights += _draw_reference(axes, results, metric, differs=differs)
    _draw_edges(axes, results)
    axes.set_ylabel(f"{protocol.label(column)} ({facts.better} is better)")
    axes.set_xlabel("baseline in cm")
    # The interval of a few scenes may reach far beyond their scores: it is cut off.
    low, high = min(heights), max(heights)
    if column in HEAVY_TAILED and high > _LINEAR_SD:
        axes.set_yscale("symlog", linthresh=0.1)
    margin = (high - low) * _MARGIN or _MARGIN
    axes.set_ylim(0 if column in HEAVY_TAILED else low - margin, high + margin)
    tier = "calibration controls" if results[0].tier == CONTROL else f"tier {results[0].tier}"
    axes.set_title(f"{protocol.label(column)} by baseline, {tier}", fontsize=11)
    if differs:
        axes.annotate(
            f"Scored: {differs}.\nNot the scenes of the paper, so not comparable with its curves.",
            (0, 0), (0, -44), xycoords="axes fraction", textcoords="offset points", va="top",
            fontsize=8.5, color="#c0392b",
        )  # fmt: skip
    axes.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    axes.spines[["top", "right"]].set_visible(False)


def _points(pairs: Sequence[PairMeans], column: str) -> tuple[list[float], list[float]]:
    """Return the baselines of pairs in cm, and their scores."""
    return [pair.baseline_cm for pair in pairs], [pair.tallies[column].mean for pair in pairs]


def _draw_bins(
    axes: Any, pairs: Sequence[PairMeans], column: str, colour: str, *, name: str
) -> None:
    groups = group_by(pairs, lambda pair: baseline_bin(pair.baseline_cm))
    places, means, intervals = [], [], []
    for bin_name in (each for each in BASELINE_BINS if each in groups):
        found = cell(groups[bin_name], column)
        baselines = [pair.baseline_cm for pair in groups[bin_name]]
        places.append(sum(baselines) / len(baselines))
        means.append(found.mean)
        intervals.append(found.ci95 or 0.0)
    axes.errorbar(
        places, means, yerr=intervals, fmt="o-", color=colour, markersize=6, linewidth=1.6,
        capsize=3, label=f"{name}: bins, 95 % intervals",
    )  # fmt: skip


def _draw_reference(
    axes: Any, results: Sequence[Scores], metric: str, *, differs: str
) -> list[float]:
    """Draw the paper's bins of the tier if Uniform scenes were scored; return their numbers.

    A metric that the paper does not report has none.
    """
    families = results[0].index.column("family")
    if not any(families[pair.row] == "Uniform" for one in results for pair in one.pairs):
        return []
    rows = [row for row in reference_rows("bins", tier=results[0].tier) if row.get(metric)]
    for number, method in enumerate(dict.fromkeys(row["method"] for row in rows)):
        found = [row for row in rows if row["method"] == method]
        middles = [sum(BASELINE_BINS[row["baseline_bin_cm"]]) / 2 for row in found]
        axes.plot(
            middles, [float(row[metric]) for row in found], color="#777777", linewidth=0.9,
            linestyle=("--", ":", "-.")[number % 3], marker="sDv^<>"[number % 6], markersize=3,
            label=f"{method} (paper, Uniform{', other scenes' * bool(differs)})",
        )  # fmt: skip
    return [float(row[metric]) for row in rows]


def _draw_edges(axes: Any, results: Sequence[Scores]) -> None:
    """Use a logarithmic axis with the bins' edges as its ticks."""
    baselines = [pair.baseline_cm for one in results for pair in one.pairs]
    edges = sorted({edge for low, high in BASELINE_BINS.values() for edge in (low, high)})
    ticks = [edge for edge in edges if 0 < edge < _LONGEST_TICK_CM]
    axes.set_xscale("log")
    axes.set_xlim(min(1.0, *baselines) * 0.9, max(150.0, *baselines) * 1.1)
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.grid(axis="x", color="#dddddd", linewidth=0.8)
    axes.set_axisbelow(True)
