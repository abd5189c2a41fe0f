"""Statistics as pictures: the baseline histograms of the paper's appendix, and focal lengths."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, Unpack

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.audit.statistics import ADJACENT, FOCAL_EDGES_MM, branch_rows
from stereogenbench_data.errors import ExtraError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.selection.filters import SceneFilters, filter_scenes
from stereogenbench_data.sources.files import open_atomic

_BINS: Final = 40
_COLOURS: Final = {"IPD_Gaussian": "#4477aa", "Uniform": "#ee6677", "Pairwise_Uniform": "#228833"}
_COLUMNS: Final = 3
_HEADROOM: Final = 1.3
"""Room above the bars for the legend."""
_INCHES: Final = (4.2, 3.2)


def write_plots(
    index: SceneIndex, folder: Path, **filters: Unpack[SceneFilters]
) -> tuple[Path, Path]:
    """Write ``baselines.png`` and ``focal_lengths.png`` into a folder, which is made if need be.

    A panel shows the adjacent baselines of a split's family, of Pairwise_Uniform those of all 15
    pairs, with the mean dashed and the median dotted.

    Raises:
        ExtraError: If matplotlib is not installed.
        SelectionError: If no scene passes the filters.

    Source: the StereoGenBench paper, figure of the realized baseline distributions.
    """
    rows = filter_scenes(index, filters)
    panels = [
        (f"{split} {family}", family, index.column("baselines_cm")[chosen],
         index.column("focal_mm")[chosen])
        for split, family, chosen in branch_rows(index, rows)
    ]  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    baselines, focals = folder / "baselines.png", folder / "focal_lengths.png"
    figure = _figure(len(panels))
    for axes, (title, family, baselines_cm, _) in zip(_axes(figure), panels, strict=False):
        is_pairwise = family == "Pairwise_Uniform"
        shown_cm = baselines_cm if is_pairwise else baselines_cm[:, ADJACENT]
        what = "all pairs" if is_pairwise else "adjacent"
        _histogram(axes, shown_cm.ravel(), bins=_BINS, colour=_COLOURS.get(family, "#777777"))
        axes.set(title=f"{title}, {what}", xlabel="baseline (cm)", ylabel="pairs")
    _save(figure, baselines)
    figure = _figure(len(panels))
    for axes, (title, family, _, focal_mm) in zip(_axes(figure), panels, strict=False):
        outer = [focal_mm.min(), focal_mm.max()]
        beyond = [each for each in outer if not FOCAL_EDGES_MM[0] <= each <= FOCAL_EDGES_MM[-1]]
        edges = np.union1d(FOCAL_EDGES_MM, beyond)
        _histogram(axes, focal_mm, bins=edges, colour=_COLOURS.get(family, "#777777"))
        axes.set(title=title, xlabel="focal length (mm)", ylabel="scenes")
    _save(figure, focals)
    return baselines, focals


def _histogram(axes: Any, values: Float64[np.ndarray, " n"], *, bins: Any, colour: str) -> None:
    axes.hist(values, bins=bins, color=colour, edgecolor="white", linewidth=0.3)
    mean, median = float(values.mean()), float(np.median(values))
    axes.axvline(mean, color="black", linestyle="--", linewidth=1, label=f"mean {mean:.2f}")
    axes.axvline(median, color="black", linestyle=":", linewidth=1.4, label=f"median {median:.2f}")
    axes.set_ylim(top=axes.get_ylim()[1] * _HEADROOM)
    axes.legend(
        title=f"n = {len(values):,}",
        loc="upper right",
        fontsize=8,
        title_fontsize=8,
        ncols=2,
        framealpha=1,
    )


def _figure(panels: int) -> Any:
    """Return a figure with room for panels; the unused ones are blank."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ExtraError(
            "plots need matplotlib: pip install 'stereogenbench-data[plots]'."
        ) from error
    columns = min(_COLUMNS, panels)
    rows = -(-panels // columns)
    figure = Figure(figsize=(_INCHES[0] * columns, _INCHES[1] * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False)
    for axes in grid.flat[panels:]:
        axes.set_axis_off()
    return figure


def _axes(figure: Any) -> Iterator[Any]:
    yield from figure.axes


def _save(figure: Any, path: Path) -> None:
    with open_atomic(path) as file:
        figure.savefig(file, format="png", dpi=100)
