"""The Markdown tables of the results, computed from the JSON file."""

from collections.abc import Iterable
from typing import Any

from benchmarks.field import CONTESTANTS, LIMIT, NAIVE, OURS
from benchmarks.results import Spread, entry, rates, ratios
from benchmarks.training import MARK_OWN
from benchmarks.workloads import WORKLOADS, Workload
from stereogenbench_data.schema.text import counted


def tables(sections: dict[str, Any]) -> str:
    """Return all tables of the results."""
    parts = ["# Measured\n", _how(sections)]
    races = sections.get("races", {})
    if races:
        parts += [headlines(races)]
        parts += [race_table(workload, races[workload.name]) for workload in WORKLOADS
                  if workload.name in races]  # fmt: skip
    for name, make in (("accuracy", _accuracy), ("training", _training)):
        if name in sections:
            parts.append(make(sections[name]))
    return "\n".join(parts)


def _how(sections: dict[str, Any]) -> str:
    machine, data = sections.get("machine", {}), sections.get("data", {})
    versions = ", ".join(
        f"{name} {value}" for name, value in machine.get("versions", {}).items() if value
    )
    lines = [
        f"Measured {machine.get('when')} on {machine.get('cores')} cores of {machine.get('cpu')}, "
        f"{machine.get('memory_gb')} GB, {machine.get('system')}, Python {machine.get('python')}; "
        f"{versions}.",
        "",
        f"Data: {data.get('scenes')} drawn scenes of two families, "
        f"{data.get('size_px')}x{data.get('size_px')}, {data.get('frames')} frames; H.264 "
        f"{data.get('rgb_mbit_s', 0):.1f} Mbit/s a camera with one key frame, FFV1 depth "
        f"{data.get('depth_mb_a_frame', 0):.2f} MB a frame; a scene takes "
        f"{data.get('shards_mb_a_scene', 0):.0f} MB in shards.",
        "",
        "Ratios are medians over rounds with quartiles; each is taken within one round.",
        "",
    ]
    return "\n".join(lines)


def _accuracy(found: dict[str, Any]) -> str:
    offered = {"default": "default", "offered": "yes", "not taken": "no"}
    conversion = found["conversion_ns"]["median"]

    def speed(way: dict[str, Any]) -> list[str]:
        ns = way["ns_a_pixel"]
        return [f"{ns['median']:.2f}", f"{ns['conversions']:.2f}"]

    rows = [
        [
            way["name"], offered[way["offered"]], *speed(way),
            *(f"{way[key]:.2g}" for key in (
                "worst_px", "p999_px", "worst_on_screen_px", "p999_on_screen_px", "worst_ulps",
                "worst_of_bound",
            )),
            str(way["overflowed"]),
        ]
        for way in found["ways"]
    ]  # fmt: skip
    head = (
        "disparity", "in the package", "ns a pixel", "conversions", "worst px", "99.9 % px",
        "worst px, within 1280", "99.9 % px, within 1280", "worst, ulps of float32",
        "worst, of the quantum's bound", "overflowed",
    )  # fmt: skip
    text = (
        f"## Speed against error\n\n{found['cases']:,} hard pixels; speed on "
        f"{found['pixels']:,} pixels of a rendered frame, {found['rounds']} rounds, by processor "
        f"time. One conversion of the map from uint16 to float32 takes {conversion:.2f} ns a "
        "pixel.\n\n" + table(head, rows)
    )
    text += (
        f"\nThe cheapest whose error stays within the depth quantum's own bound and 1 ulp of "
        f"float32: **{found['justified']}**.\n\n"
    )
    rows = [
        [way["name"], offered[way["offered"]], *speed(way),
         *(f"{way[key]:.2g}" for key in ("p99_px", "p999_px", "worst_px", "mean_px")),
         f"{way['invented_share'] * 100:.2f}"]
        for way in found["resized"]
    ]  # fmt: skip
    head = (
        "resized to 832x480", "in the package", "ns a source pixel", "conversions", "99 % px",
        "99.9 % px", "worst px", "mean px", "of no surface, % of pixels",
    )  # fmt: skip
    return text + table(head, rows)


def _training(found: dict[str, Any]) -> str:
    rows = []
    for row in found["rows"].values():
        cost = row["cpu_s"]
        to_released = cost["released"] / cost["ours, training"]
        to_own = cost["training"] / cost["ours, training"]
        rows.append(
            [row["title"], *(f"{cost_s * 1e3:.1f}" for cost_s in cost.values()),
             f"{to_released:.1f}", _reached(to_released, row["mark"]),
             f"{to_own:.2f}", _reached(to_own, MARK_OWN),
             f"{cost['training'] / cost['ours, in order']:.2f}"]
        )  # fmt: skip
    head = (
        "832x480, processor ms a sample", "bare loop, released", "bare loop, training shards",
        "ours, released", "ours, training shards", "the same, not shuffled",
        "to the released limit", "target", "to their own limit", "target",
        "to their own limit, not shuffled",
    )  # fmt: skip
    measured = f"Measured {found['machine']['when']} on {found['machine']['cpu']}, one process."
    return "\n".join([f"## Training shards\n\n{measured}\n", table(head, rows)])


def headlines(races: dict[str, Any]) -> str:
    """Return the table of our ratios beside their targets."""
    rows = []
    for workload in WORKLOADS:
        if workload.name not in races or workload.target is None:
            continue
        rounds, workers = races[workload.name]["rounds"], workload.workers[0]
        own = entry(OURS, workers)
        limit = ratios(rounds, own, to=entry(LIMIT, workers))
        naive = ratios(rounds, own, to=entry(NAIVE, workers))
        rows.append(
            [
                workload.title, spread_text(limit), at_least(limit, workload.target.limit),
                spread_text(naive, ".1f"), at_least(naive, workload.target.naive),
            ]
        )  # fmt: skip
    head = ("ours, 2 workers", "to the limit", "target", "to naive", "target")
    return "## Headlines\n\n" + table(head, rows)


def race_table(workload: Workload, race: dict[str, Any]) -> str:
    """Return the table of one race: a row for each contestant and number of workers."""
    rounds = race["rounds"]
    there = {name for found in rounds for name in found}

    def beside(entrant: str, other: str, form: str = ".2f", **how: Any) -> str:
        ratio = ratios(rounds, entrant, to=other, **how)
        return "" if entrant == other else spread_text(ratio, form)

    rows = []
    for workers in sorted(race["settings"]["workers"]):  # of the machine that measured
        limit, naive = entry(LIMIT, workers), entry(NAIVE, workers)
        for name in dict.fromkeys((LIMIT, OURS, *CONTESTANTS)):
            own = entry(name, workers)
            if own in there:
                rows.append(
                    [
                        CONTESTANTS[name].title, str(workers), rate_text(rates(rounds, own)),
                        beside(own, limit), beside(own, limit, by="cpu_s"),
                        beside(own, naive, ".1f"),
                    ]
                )  # fmt: skip
    head = (
        "", "workers", "samples/s", "to the limit", "to the limit, by processor time", "to naive",
    )  # fmt: skip
    slices = f"{race['settings']['samples']} samples of {counted(workload.scenes, 'scene')}"
    if workload.part:
        slices += f" by ours, once it has begun, and of {workload.part} of them by the others"
    text = f"## {workload.title}\n\n{counted(len(rounds), 'round')}, {slices}.\n\n"
    text += table(head, rows)
    if race["failed"]:
        text += "\nDid not race, or failed in a round:\n"
    for name, why in race["failed"].items():
        text += f"- {CONTESTANTS[name.partition('/')[0]].title}: {why}\n"
    return text


def table(head: Iterable[str], rows: list[list[str]]) -> str:
    """Return a table, numbers to the right."""
    titles = list(head)
    lines = [titles, ["---"] + ["---:"] * (len(titles) - 1), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def spread_text(spread: Spread | None, form: str = ".2f") -> str:
    """Return median (low to high quartile)."""
    if spread is None:
        return ""
    return f"{spread.median:{form}} ({spread.low:{form}} to {spread.high:{form}})"


def rate_text(spread: Spread | None) -> str:
    """Return the median alone."""
    return "" if spread is None else f"{spread.median:.3g}"


def at_least(spread: Spread | None, wanted: float | None) -> str:
    """Return the target ratio, and whether the median reaches it."""
    return "" if spread is None or wanted is None else _reached(spread.median, wanted)


def _reached(ratio: float, wanted: float) -> str:
    return f"{wanted:g} {'reached' if ratio >= wanted else '**missed**'}"
