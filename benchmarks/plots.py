"""Plots of the results, from the JSON file."""

from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.field import LIMIT
from benchmarks.network import network_plot
from benchmarks.results import entry, ratios
from benchmarks.workloads import WORKLOADS, Workload

_INK: Final = "#222222"
_OURS: Final = "#0b6e99"
_OTHERS: Final = "#b8b8b8"
_TARGET: Final = "#c0392b"


def plot_all(sections: dict[str, Any], folder: Path) -> list[Path]:
    """Write a plot of every section of the results; return their paths.

    Raises:
        ImportError: If matplotlib is not installed.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    mpl.rcParams.update(
        {
            "font.size": 10, "axes.spines.top": False, "axes.spines.right": False,
            "axes.edgecolor": _INK, "axes.titlesize": 11, "axes.titleweight": "bold",
            "axes.titlelocation": "left", "figure.dpi": 130, "savefig.bbox": "tight",
        }
    )  # fmt: skip
    import matplotlib.pyplot as plt

    races = sections.get("races", {})
    local = [w for w in WORKLOADS if w.name in races and not w.field]
    drawn = {
        "speed": lambda: local and _speed(races, local),
        "network": lambda: "network" in sections and network_plot(sections["network"]),
        "accuracy": lambda: "accuracy" in sections and _accuracy(sections["accuracy"]),
    }
    made = []
    for name, draw in drawn.items():
        if figure := draw():
            made.append(folder / f"{name}.png")
            figure.savefig(made[-1], metadata={"Software": None})
            plt.close(figure)
    return made


_SHOWN: Final = (
    ("ours", "stereogenbench_data", _OURS, "o"),
    ("webdataset", "webdataset", "#d68910", "s"),
    ("datasets", "HF datasets", "#8e6bbf", "D"),
    ("torchcodec", "torchcodec", "#555555", "^"),
    ("naive", "the paper's snippet", "#a0a0a0", "v"),
)


def _speed(races: dict[str, Any], workloads: list[Workload]) -> Any:
    """Draw one loader of each kind in all local races: the plot of the README."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(8, 0.5 * len(workloads) + 1.4))
    places = np.arange(len(workloads))[::-1]
    for place in places:
        axes.axhline(place, color="#e8e8e8", linewidth=1, zorder=0)
    for name, label, colour, marker in _SHOWN:
        for place, workload in zip(places, workloads, strict=True):
            workers = workload.workers[0]
            share = ratios(
                races[workload.name]["rounds"], entry(name, workers), to=entry(LIMIT, workers)
            )
            if share is None:
                continue
            axes.errorbar(
                share.median, place, xerr=[[share.median - share.low], [share.high - share.median]],
                color=colour, marker=marker, markersize=7, label=label, zorder=3,
            )  # fmt: skip
    axes.axvline(1, color=_INK, linewidth=1, zorder=1)
    axes.set_yticks(places, [workload.title for workload in workloads], fontsize=9)
    axes.set_xlim(left=-0.03)
    axes.set_ylim(-0.6, len(workloads) - 0.4)
    axes.set_xlabel("samples a second, as a share of a bare decoding loop's (line)", fontsize=9)
    handles = dict(zip(*axes.get_legend_handles_labels()[::-1], strict=True))
    figure.legend(
        handles.values(), handles.keys(), frameon=False, fontsize=9, ncol=len(_SHOWN),
        loc="upper center", handletextpad=0.3, columnspacing=1.5,
    )  # fmt: skip
    figure.tight_layout(rect=(0, 0, 1, 0.93))
    return figure


_MARKS: Final = {"default": ("o", _OURS), "offered": ("o", "#7fb8d1"), "not taken": ("X", _OTHERS)}
_FLOOR_PX: Final = 1e-13


def _accuracy(found: dict[str, Any]) -> Any:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(9, 6))
    ways = sorted(found["ways"], key=lambda way: (way["worst_on_screen_px"], way["name"]))
    for number, way in enumerate(ways, start=1):
        ns = way["ns_a_pixel"]["median"]
        marker, colour = _MARKS[way["offered"]]
        worst, most = (
            max(way[key], _FLOOR_PX) for key in ("worst_on_screen_px", "p999_on_screen_px")
        )
        axes.plot([ns, ns], [most, worst], color=colour, linewidth=1.5, zorder=2)
        axes.scatter([ns], [worst], marker=marker, color=colour, s=55, zorder=3)
        axes.scatter([ns], [most], marker="_", color=colour, s=80, zorder=3)
        axes.annotate(
            str(number), (ns, most), xytext=(0, -6), textcoords="offset points", fontsize=8.5,
            ha="center", va="top",
        )  # fmt: skip
        axes.text(
            1.03, 0.72 - 0.06 * (len(ways) - number), f"{number}  {way['name']}", fontsize=8.5,
            transform=axes.transAxes,
        )  # fmt: skip
    conversion = found["conversion_ns"]["median"]
    axes.axvline(conversion, color=_INK, linestyle=":", linewidth=1, zorder=1)
    axes.annotate(
        "one conversion\nuint16 to float32", (conversion, 1e-11), xytext=(4, 0),
        textcoords="offset points", fontsize=8,
    )  # fmt: skip
    ulp = float(np.spacing(np.float32(1279)))
    axes.axhline(ulp, color=_TARGET, linestyle="--", linewidth=1, zorder=1)
    axes.annotate(
        "1 ulp of float32 below 1280 px", (3 * conversion, ulp), xytext=(0, 4),
        textcoords="offset points", fontsize=8, color=_TARGET,
    )  # fmt: skip
    for label, (marker, colour) in _MARKS.items():
        axes.scatter([], [], marker=marker, color=colour, label=f"{label} in the package")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.margins(x=0.12, y=0.08)
    axes.set_xlabel("nanoseconds a pixel")
    axes.set_ylabel("error in px, of disparities up to 1280 px\n(mark: worst; dash: 99.9 %)")
    axes.set_title("Ways from stored depth to disparity: speed against error")
    axes.legend(frameon=False, fontsize=8.5, loc="upper left", bbox_to_anchor=(1.01, 1))
    return figure
