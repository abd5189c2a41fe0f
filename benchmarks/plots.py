"""Plots of the results, from the JSON file."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.field import CONTESTANTS, LIMIT, NO_DEPTH, OURS, title
from benchmarks.material import DRAWN_CRF, OTHER_CRFS
from benchmarks.network import network_plot
from benchmarks.results import Spread, entry, rates, ratios, sent_mb, shares
from benchmarks.tables import rgb_mbit_s
from benchmarks.workloads import RATED, RATES, WORKLOADS, Workload

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
    races = sections.get("races", {})
    local = [w for w in WORKLOADS if w.name in races and w.source == "local" and not w.field]
    web = [w for w in WORKLOADS if w.name in races and w.source == "web"]
    made = []
    for name, wanted, make in (
        ("speed", local, lambda: _speed(races, local)),
        ("contestants", local, lambda: _contestants(races, local)),
        ("workers", "all-frames" in races, lambda: _workers(races["all-frames"])),
        ("rates", any(w.name in races for w in RATES), lambda: _by_rate(sections)),
        ("web", web, lambda: _web(races, web)),
        ("network", "network" in sections, lambda: network_plot(sections["network"])),
        ("accuracy", "accuracy" in sections, lambda: _accuracy(sections["accuracy"])),
        ("profile", "profile" in sections, lambda: _profile(sections["profile"])),
        ("memory", "memory" in sections, lambda: _memory(sections["memory"])),
    ):
        if wanted:
            path = folder / f"{name}.png"
            _save(make(), path)
            made.append(path)
    return made


def _save(figure: Any, path: Path) -> None:
    import matplotlib.pyplot as plt

    figure.savefig(path, metadata={"Software": None})
    plt.close(figure)


def _colour(name: str) -> str:
    return _OURS if name.startswith(OURS) else _OTHERS


def _medians(spreads: Iterable[Spread]) -> tuple[np.ndarray, np.ndarray]:
    """Return medians, and how far the quartiles are below and above them, shaped (2, n)."""
    kept = [(each.low, each.median, each.high) for each in spreads]
    low, middle, high = np.array(kept).reshape(-1, 3).T
    return middle, np.stack([middle - low, high - middle])


def _bars(axes: Any, names: list[str], spreads: list[Spread], *, form: str) -> None:
    """Draw horizontal bars of medians with quartiles, each with its number."""
    places = np.arange(len(names))[::-1]
    middle, errors = _medians(spreads)
    axes.barh(places, middle, color=[_colour(name) for name in names], height=0.7)
    axes.errorbar(middle, places, xerr=errors, fmt="none", ecolor=_INK, elinewidth=1)
    for place, spread in zip(places, spreads, strict=True):
        axes.annotate(
            f"{spread.median:{form}}", (spread.high, place), xytext=(4, 0),
            textcoords="offset points", va="center", fontsize=8, color=_INK, zorder=5,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8},
        )  # fmt: skip
    axes.set_yticks(places, [title(name) for name in names], fontsize=8)
    axes.margins(x=0.15)
    axes.set_xlim(left=0)


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


def _contestants(races: dict[str, Any], workloads: list[Workload]) -> Any:
    import matplotlib.pyplot as plt

    rows = -(-len(workloads) // 2)
    figure, grid = plt.subplots(rows, 2, figsize=(12.5, 3.3 * rows), squeeze=False)
    for axes in grid.flat[len(workloads) :]:
        axes.set_visible(False)
    for axes, workload in zip(grid.flat, workloads, strict=False):
        rounds, workers = races[workload.name]["rounds"], workload.workers[0]
        found = {
            name: ratios(rounds, entry(name, workers), to=entry(LIMIT, workers))
            for name in (*CONTESTANTS,)
        }
        shown = {name: spread for name, spread in found.items() if spread is not None}
        names = sorted(shown, key=lambda name: -shown[name].median)
        _bars(axes, names, [shown[name] for name in names], form=".2f")
        axes.axvline(1, color=_INK, linewidth=1)
        axes.set_xlim(right=max(1.05, axes.get_xlim()[1]))
        if workload.target is not None:
            axes.axvline(workload.target.limit, color=_TARGET, linewidth=1, linestyle="--")
        axes.set_title(workload.title)
        axes.set_xlabel("samples a second, as a share of the bare loop's", fontsize=8)
    figure.suptitle(
        "Speed against a bare decoding loop, as many processes each "
        "(line: the loop; dashed: target for ours; bars: median, quartiles)",
        x=0.01, ha="left", fontsize=10,
    )  # fmt: skip
    figure.tight_layout(rect=(0, 0, 1, 0.98))
    return figure


def _workers(race: dict[str, Any]) -> Any:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.5, 4))
    workers = sorted({int(name.split("/")[1]) for found in race["rounds"] for name in found})
    for name, colour, marker in ((LIMIT, _INK, "s"), (OURS, _OURS, "o")):
        spreads = {count: rates(race["rounds"], entry(name, count)) for count in workers}
        shown = {count: spread for count, spread in spreads.items() if spread is not None}
        if not shown:
            continue
        middle, errors = _medians(shown.values())
        places = [workers.index(count) for count in shown]
        axes.errorbar(
            places, middle, yerr=errors, color=colour, marker=marker, capsize=3,
            label=title(name),
        )  # fmt: skip
    axes.set_xticks(range(len(workers)), [str(count) for count in workers])
    axes.set_xlabel("worker processes (0: in the training process)")
    axes.set_ylabel("samples a second")
    axes.set_ylim(bottom=0)
    axes.set_title(race["settings"]["title"])
    axes.legend(frameon=False, fontsize=8)
    return figure


def _to_limit(race: dict[str, Any], name: str) -> Spread | None:
    """Return the ratios of a contestant to the limit under the race's first number of workers."""
    workers = race["settings"]["workers"][0]
    return ratios(race["rounds"], entry(name, workers), to=entry(LIMIT, workers))


def _by_rate(sections: dict[str, Any]) -> Any:
    """Draw the gain of the depth codec against the bit rate of the pictures, and its bound."""
    import matplotlib.pyplot as plt

    lines = (
        ("ours-blosc2", "ours, blosc2 shards", _OURS, "o"),
        ("ours-shards", "ours, released shards", "#7fb8d1", "s"),
        (NO_DEPTH, title(NO_DEPTH), _INK, "^"),
    )
    figure, grid = plt.subplots(1, len(RATED), figsize=(13, 4), sharey=True)
    for axes, name in zip(grid, RATED, strict=True):
        found = {
            rgb_mbit_s(sections, crf): sections["races"][race]
            for crf in (DRAWN_CRF, *OTHER_CRFS)
            if (race := name if crf == DRAWN_CRF else f"{name}-crf{crf}") in sections["races"]
        }
        for entrant, label, colour, marker in lines:
            spreads = {mbit_s: _to_limit(race, entrant) for mbit_s, race in found.items()}
            shown = {mbit_s: each for mbit_s, each in spreads.items() if each is not None}
            middle, errors = _medians(shown.values())
            axes.errorbar(
                list(shown), middle, yerr=errors, color=colour, marker=marker, capsize=3,
                label=label,
            )  # fmt: skip
        for mbit_s, race in found.items():
            workers = race["settings"]["workers"][0]
            limit, free = entry(LIMIT, workers), entry(NO_DEPTH, workers)
            share = shares(race["rounds"], limit, without=free)
            if share is not None:
                axes.annotate(
                    f"{share.median * 100:.0f} %", (mbit_s, 0), xytext=(0, 4), ha="center",
                    textcoords="offset points", fontsize=8, color=_TARGET,
                )  # fmt: skip
        workload = next(workload for workload in WORKLOADS if workload.name == name)
        axes.axhline(1, color=_INK, linewidth=1)
        axes.set_title(workload.title, fontsize=9)
        axes.set_xlabel("Mbit/s a camera")
        axes.margins(x=0.1)
        axes.set_xlim(left=0)
    grid[0].set_ylim(bottom=0)
    grid[0].set_ylabel("speed, in the bare loop's")
    grid[0].legend(frameon=False, fontsize=8)
    figure.suptitle(
        "What the codec of depth gives depends on what the pictures cost "
        "(red: depth decoding's share of the bare loop's time)", x=0.01, ha="left", fontsize=10,
    )  # fmt: skip
    figure.tight_layout(rect=(0, 0, 1, 0.96))
    return figure


def _web(races: dict[str, Any], workloads: list[Workload]) -> Any:
    import matplotlib.pyplot as plt

    figure, grid = plt.subplots(
        len(workloads), 2, figsize=(12.5, 2.3 * len(workloads)), squeeze=False
    )
    for (speed, traffic), workload in zip(grid, workloads, strict=True):
        rounds, workers = races[workload.name]["rounds"], workload.workers[0]
        names = [
            name
            for name in ("ours-web", "ours-web-blosc2", "webdataset-web", "datasets-web")
            if rates(rounds, entry(name, workers)) is not None
        ]
        _bars(speed, names, [rates(rounds, entry(name, workers)) for name in names], form=".1f")
        sent = [sent_mb(rounds, entry(name, workers)) for name in names]
        _bars(traffic, names, sent, form=".2f")
        traffic.set_yticks([])
        speed.set_title(workload.title)
        speed.set_xlabel("samples a second", fontsize=8)
        traffic.set_xlabel("MB fetched a sample", fontsize=8)
    figure.tight_layout()
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


def _profile(profile: dict[str, Any]) -> Any:
    import matplotlib.pyplot as plt

    names = list(profile)
    labels = list(profile[names[0]]["ms_a_sample"])
    colours = plt.get_cmap("tab20")(np.linspace(0, 1, len(labels)))
    figure, axes = plt.subplots(figsize=(11, 0.75 * len(names) + 2))
    places = np.arange(len(names))[::-1]
    left = np.zeros(len(names))
    totals = np.array([sum(profile[name]["ms_a_sample"].values()) for name in names])
    for label, colour in zip(labels, colours, strict=True):
        shares = np.array([profile[name]["ms_a_sample"][label] for name in names]) / totals * 100
        axes.barh(places, shares, left=left, color=colour, label=label, height=0.65)
        for place, share, start in zip(places, shares, left, strict=True):
            if share >= 4:
                axes.text(start + share / 2, place, f"{share:.0f}", ha="center", va="center",
                          fontsize=8)  # fmt: skip
        left += shares
    axes.set_yticks(
        places,
        [f"{name}\n{total:.1f} ms a sample" for name, total in zip(names, totals, strict=True)],
        fontsize=8,
    )
    axes.set_xlim(0, 100)
    axes.set_xlabel("% of one worker's time")
    axes.set_title("Where an epoch's time goes")
    axes.legend(
        frameon=False, fontsize=8, ncol=6, loc="upper left", bbox_to_anchor=(0, -0.9 / len(names))
    )
    return figure


def _memory(memory: dict[str, Any]) -> Any:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(8, 3.6))
    axes.plot(memory["resident_mb"], color=_OURS, label="resident")
    axes.plot(memory["private_mb"], color=_OTHERS, label="without shared memory")
    axes.axhline(1500, color=_TARGET, linestyle="--", linewidth=1, label="target")
    axes.set_xlim(0, len(memory["resident_mb"]))
    axes.set_ylim(0, 1650)
    axes.set_xlabel(f"batches of {memory['batch']}")
    axes.set_ylabel("MB of the larger worker")
    axes.set_title("A worker's memory: all pairs, all frames, default settings")
    axes.legend(frameon=False, fontsize=8, loc="lower right")
    return figure
