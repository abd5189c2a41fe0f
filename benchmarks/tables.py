"""The Markdown of the results: everything in it is worked out from the JSON file."""

from collections.abc import Iterable
from typing import Any

from benchmarks.field import LIMIT, NAIVE, OURS, title
from benchmarks.results import Spread, cpu_ratios, entry, rates, ratios
from benchmarks.ways import DEFAULT
from benchmarks.workloads import WORKLOADS, Workload
from stereogenbench_data.schema.problems import counted

Rows = list[list[str]]


def tables(sections: dict[str, Any]) -> str:
    """Return all tables of the results at hand."""
    parts = ["# Measured\n", _how(sections)]
    races = sections.get("races", {})
    if races:
        parts += [_headlines(races)]
        parts += [_race(workload, races[workload.name]) for workload in WORKLOADS
                  if workload.name in races]  # fmt: skip
    for name, make in (
        ("start", _start), ("memory", _memory), ("accuracy", _accuracy), ("profile", _profile),
    ):  # fmt: skip
        if name in sections:
            parts.append(make(sections[name]))
    return "\n".join(parts)


def _table(head: Iterable[str], rows: Rows) -> str:
    titles = list(head)
    lines = [titles, ["---"] + ["---:"] * (len(titles) - 1), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def _spread(spread: Spread | None, form: str = ".2f") -> str:
    """Return median (low to high quartile)."""
    if spread is None:
        return ""
    return f"{spread.median:{form}} ({spread.low:{form}} to {spread.high:{form}})"


def _rate(spread: Spread | None) -> str:
    return "" if spread is None else f"{spread.median:.3g}"


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
        f"{data.get('shards_mb_a_scene', 0):.0f} MB in shards"
        + (
            f" and {data['blosc2_mb_a_scene']:.0f} MB with depth as blosc2 frames "
            f"({data['blosc2_mb_a_scene'] / data['shards_mb_a_scene']:.2f} times)."
            if "blosc2_mb_a_scene" in data
            else "."
        ),
        "",
        "Ratios are medians over rounds with quartiles; each is taken within one round.",
        "",
    ]
    return "\n".join(lines)


def _verdict(spread: Spread | None, wanted: float | None) -> str:
    if spread is None or wanted is None:
        return ""
    return f"{wanted:g} {'reached' if spread.median >= wanted else '**missed**'}"


def _headlines(races: dict[str, Any]) -> str:
    rows = []
    for workload in WORKLOADS:
        if workload.name not in races or workload.target is None:
            continue
        rounds, workers = races[workload.name]["rounds"], workload.workers[0]
        own = entry(OURS, workers)
        limit = ratios(rounds, own, to=entry(LIMIT, workers))
        naive = ratios(rounds, own, to=entry(NAIVE, workers))
        blosc2 = ratios(rounds, entry("ours-blosc2", workers), to=entry(LIMIT, workers))
        rows.append(
            [
                workload.title, _spread(limit), _verdict(limit, workload.target.limit),
                _spread(naive, ".1f"), _verdict(naive, workload.target.naive),
                _spread(blosc2), _verdict(blosc2, workload.blosc2),
            ]
        )  # fmt: skip
    head = (
        "ours, 2 workers", "to the limit", "target", "to naive", "target",
        "blosc2 shards to the released codecs' limit", "target",
    )  # fmt: skip
    return "## Headlines\n\n" + _table(head, rows)


def _race(workload: Workload, race: dict[str, Any]) -> str:
    rounds = race["rounds"]
    names = {name for found in rounds for name in found}
    rows = []
    for workers in sorted(workload.workers):
        limit, naive = entry(LIMIT, workers), entry(NAIVE, workers)
        for name in (LIMIT, OURS, *(n for n in _order(names) if n not in (LIMIT, OURS))):
            entrant = entry(name, workers)
            if entrant not in names:
                continue
            sent = Spread.of(
                found[entrant]["bytes"] / found[entrant]["samples"] / 1e6
                for found in rounds
                if "bytes" in found.get(entrant, {})
            )
            rows.append(
                [
                    title(name), str(workers), _rate(rates(rounds, entrant)),
                    _spread(ratios(rounds, entrant, to=limit)) if name != LIMIT else "",
                    _spread(ratios(rounds, entrant, to=naive), ".1f") if name != NAIVE else "",
                    _spread(cpu_ratios(rounds, entrant, to=limit)) if name != LIMIT else "",
                    *([_rate(sent)] if workload.source == "web" else []),
                ]
            )  # fmt: skip
    head = [
        "", "workers", "samples/s", "to the limit", "to naive", "to the limit, by processor time",
        *(["MB a sample"] if workload.source == "web" else []),
    ]  # fmt: skip
    failed = [f"- {title(name.split('/')[0])}: {why}" for name, why in race["failed"].items()]
    text = f"## {workload.title}\n\n{counted(len(rounds), 'round')}.\n\n" + _table(head, rows)
    return text + ("\nDid not race:\n" + "\n".join(failed) + "\n" if failed else "")


def _order(names: set[str]) -> list[str]:
    from benchmarks.field import CONTESTANTS

    found = {name.split("/")[0] for name in names}
    return [name for name in CONTESTANTS if name in found]


def _ms(value: dict[str, float]) -> str:
    return f"{value['median'] * 1e3:.0f} ({value['low'] * 1e3:.0f} to {value['high'] * 1e3:.0f})"


def _start(start: dict[str, Any]) -> str:
    rows = [[name, _ms(value), ""] for name, value in start["imports_s"].items()]
    rows += [
        [f"`{name}`", _ms(value), _below(value, 0.4) if name.endswith("bench --help") else ""]
        for name, value in start["commands_s"].items()
    ]
    rows += [
        [f"open an index of {start['index_scenes']:,} scenes", _ms(start["index_open_s"]), ""],
        [f"select {start['index_pairs']:,} pairs of a family", _ms(start["index_select_s"]), ""],
        ["both", _ms(start["index_both_s"]), _below(start["index_both_s"], 0.2)],
        ["first batch of a fresh process, no file cached: ours",
         _ms(start["first_batch_s"]["ours"]), ""],
        ["the same: naive", _ms(start["first_batch_s"]["naive"]), ""],
        ["first batch at the start of an epoch", _ms(start["start_s"]), ""],
        ["first batch, resumed at half an epoch", _ms(start["resume_s"]), ""],
        ["loading the state alone", _ms(start["seek_s"]), ""],
        ["a batch on average, over the first 17", _ms(start["epoch_from_start_s"]), ""],
        ["a batch on average, over 17 from the middle", _ms(start["epoch_from_half_s"]), ""],
    ]  # fmt: skip
    torch = "imports torch" if start["imports_torch"] else "does not import torch"
    text = f"## Start\n\n`import stereogenbench_data` {torch}. {start['rounds']} rounds.\n\n"
    return text + _table(("", "ms", "target"), rows)


def _below(value: dict[str, float], wanted_s: float) -> str:
    reached = "reached" if value["median"] <= wanted_s else "**missed**"
    return f"{wanted_s * 1e3:g} {reached}"


def _memory(memory: dict[str, Any]) -> str:
    peak = memory["peak_mb"]
    rows = [
        ["peak of the larger worker, MB", f"{peak:.0f}",
         f"1500 {'reached' if peak <= 1500 else '**missed**'}"],
        ["the same without shared memory, MB", f"{memory['peak_private_mb']:.0f}", ""],
        ["growth from the third to the last quarter, MB a 1,000 batches",
         f"{memory['growth_mb_per_1000']:.0f}", "0"],
    ]  # fmt: skip
    text = (
        "## Memory\n\nAll pairs, all frames, default fields and settings "
        f"({memory['lanes']} lanes, {memory['open_scenes']} open scenes each), "
        f"{memory['scenes']} scenes, {memory['workers']} workers, batches of {memory['batch']}, "
        f"{memory['batches']} batches.\n\n"
    )
    return text + _table(("", "", "target"), rows)


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
        "pixel.\n\n" + _table(head, rows)
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
    text += _table(head, rows) + "\n"
    rows = [
        [way["name"], offered[way["offered"]], *speed(way), f"{way['other_share'] * 100:.4f}"]
        for way in found["visibility"]
    ]
    head = ("visibility", "in the package", "ns a pixel", "conversions", "decided otherwise, %")
    return text + _table(head, rows) + "\n" + _kernels(found)


def kernel_ratios(found: dict[str, Any]) -> dict[str, tuple[dict[str, float], float]]:
    """Return the conversions that disparity and visibility take, with what they may take."""
    spent = {way["name"]: way["ns_a_pixel"] for way in (*found["ways"], *found["visibility"])}
    return {
        "disparity, into a new array": (spent[DEFAULT], 1 / 0.7),
        "disparity, into the same array": (found["default_here_ns"], 1 / 0.7),
        "disparity, into memory fresh from the system": (found["default_fresh_ns"], 1 / 0.7),
        "visibility": (spent["visible, float32"], 12.0),
    }


def _kernels(found: dict[str, Any]) -> str:
    rows = [
        [name, f"{ns['conversions']:.2f} ({ns['conversions_low']:.2f} to "
         f"{ns['conversions_high']:.2f})",
         f"{most:.2f} {'reached' if ns['conversions'] <= most else '**missed**'}"]
        for name, (ns, most) in kernel_ratios(found).items()
    ]  # fmt: skip
    return _table(("kernel", "conversions of the same map", "at most"), rows)


def _profile(profile: dict[str, Any]) -> str:
    names = list(profile)
    labels = list(profile[names[0]]["ms_a_sample"])
    rows = []
    for label in labels:
        cells = []
        for name in names:
            ms = profile[name]["ms_a_sample"]
            cells.append(f"{ms[label]:.2f} ({ms[label] / sum(ms.values()) * 100:.0f} %)")
        rows.append([label, *cells])
    rows.append(["all", *(f"{sum(profile[n]['ms_a_sample'].values()):.2f}" for n in names)])
    head = ("ms a sample, one worker", *names)
    return "## Where the time goes\n\n" + _table(head, rows)
