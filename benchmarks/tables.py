"""The Markdown tables of the results, computed from the JSON file."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

from benchmarks.derive import MARK
from benchmarks.field import CONTESTANTS, LIMIT, NAIVE, NO_DEPTH, OURS, title
from benchmarks.material import DRAWN_CRF, OTHER_CRFS
from benchmarks.results import Spread, cpu_ratios, entry, rates, ratios, sent_mb, shares
from benchmarks.training import MARK_OWN
from benchmarks.workloads import RATED, RATES, WORKLOADS, Workload
from stereogenbench_data.schema.text import counted


def tables(sections: dict[str, Any]) -> str:
    """Return all tables of the results."""
    parts = ["# Measured\n", _how(sections)]
    races = sections.get("races", {})
    if races:
        parts += [headlines(races)]
        parts += [race_table(workload, races[workload.name]) for workload in WORKLOADS
                  if workload.name in races and workload not in RATES]  # fmt: skip
        if any(workload.name in races for workload in RATES):
            parts.append(by_rate(sections))
    for name, make in (
        ("start", _start), ("memory", _memory), ("accuracy", _accuracy), ("profile", _profile),
        ("tried", _tried), ("evaluation", _evaluation), ("derive", _derive),
        ("training", _training), ("generation", _generation),
    ):  # fmt: skip
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


def _ms(value: dict[str, float]) -> str:
    return spread_text(value, ".0f", scale=1e3)


def _start(start: dict[str, Any]) -> str:
    rows = [[name, _ms(value), ""] for name, value in start["imports_s"].items()]
    for name, value in start["commands_s"].items():
        mark = at_most(value["median"], 0.4, scale=1e3) if name == "stereogenbench --help" else ""
        rows.append([f"`{name}`", _ms(value), mark])
    both = start["index_both_s"]
    rows += [
        [f"open an index of {start['index_scenes']:,} scenes", _ms(start["index_open_s"]), ""],
        [f"select {start['index_pairs']:,} pairs of a family", _ms(start["index_select_s"]), ""],
        ["both", _ms(both), at_most(both["median"], 0.2, scale=1e3)],
        ["first batch of a fresh process, no file cached: ours",
         _ms(start["first_batch_s"]["ours"]), ""],
        ["the same: naive", _ms(start["first_batch_s"]["naive"]), ""],
        ["loading a state of half an epoch", _ms(start["resuming"]["seek_s"]), ""],
    ]  # fmt: skip
    torch = "imports torch" if start["imports_torch"] else "does not import torch"
    rounds = counted(start["rounds"], "round")
    text = f"## Start\n\n`import stereogenbench_data` {torch}. {rounds}.\n\n"
    return text + table(("", "ms", "target"), rows) + "\n" + _resuming(start)


def _resuming(start: dict[str, Any]) -> str:
    """Return the table of starting and resuming, beside a bare loop over the same frames."""
    titles = {
        "start_s": "first batch at the start of an epoch",
        "resume_s": "first batch, resumed at half an epoch",
        "rest_from_start_s": "a batch on average, over the first 17",
        "rest_from_half_s": "a batch on average, over 17 from the middle",
    }
    rows = []
    for name, what in titles.items():
        times, to_bare = start["resuming"], start["resuming_to_bare"].get(name)
        beside = ["", ""]
        if to_bare is not None:
            beside = [_ms(times[f"bare_{name}"]), spread_text(to_bare)]
        rows.append([what, _ms(times[name]), *beside])
    head = ("", "ours, ms", "a bare loop to the same frames, ms", "ours to the loop, times")
    return table(head, rows)


def _memory(memory: dict[str, Any]) -> str:
    peak = memory["peak_mb"]
    rows = [
        ["peak of the larger worker, MB", f"{peak:.0f}",
         at_most(peak, 1500)],
        ["the same without shared memory, MB", f"{memory['peak_private_mb']:.0f}", ""],
        ["growth from the third to the last quarter, MB a 1,000 batches",
         f"{memory['growth_mb_per_1000']:.0f}", "0"],
    ]  # fmt: skip
    text = (
        "## Memory\n\nAll pairs, all frames, default fields and settings "
        f"({memory['lanes']} shuffle groups, {memory['open_scenes']} open scenes each), "
        f"{memory['scenes']} scenes, {memory['workers']} workers, batches of {memory['batch']}, "
        f"{memory['batches']} batches.\n\n"
    )
    return text + table(("", "", "target"), rows)


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
    text += table(head, rows) + "\n"
    rows = [
        [way["name"], offered[way["offered"]], *speed(way), f"{way['other_share'] * 100:.4f}"]
        for way in found["visibility"]
    ]
    head = ("visibility", "in the package", "ns a pixel", "conversions", "decided otherwise, %")
    return text + table(head, rows) + "\n" + _kernels(found)


def _kernels(found: dict[str, Any]) -> str:
    rows = []
    for kernel in found["kernels"]:
        ns, most = kernel["ns_a_pixel"], kernel["most"]
        rows.append(
            [
                kernel["kernel"], kernel["memory"], f"{kernel['conversion_ns']:.2f}",
                f"{ns['median']:.2f}",
                f"{ns['conversions']:.2f} ({ns['conversions_low']:.2f} to "
                f"{ns['conversions_high']:.2f})",
                at_most(ns["conversions"], most, ".2f"),
            ]
        )  # fmt: skip
    head = (
        "kernel", "written into", "plain conversion, ns a pixel", "kernel, ns a pixel",
        "conversions", "at most",
    )  # fmt: skip
    return table(head, rows)


def _tried(found: dict[str, Any]) -> str:
    text = (
        "## Ways to decode and to convert\n\nOne process, "
        f"{counted(found['rounds'], 'round')}; the package's own way is the first of each table. "
        '"Equal" means bit for bit.\n'
    )
    for group, ways in found["groups"].items():
        rows = []
        for way in ways:
            times, alike = way["times"], "not compared"
            if "psnr_db" in way:
                alike = "equal" if way["psnr_db"] is None else f"{way['psnr_db']:.0f} dB"
            spread = spread_text(times)
            ms = (f"{way['cpu_ms']:.2f}", f"{way['wall_ms']:.2f}")
            rows.append([way["name"], *ms, "" if way is ways[0] else spread, alike])
        head = (
            group,
            "ms of processor a picture",
            "ms",
            "processor time, in the first's",
            "result",
        )
        text += "\n" + table(head, rows)
    return text


def _evaluation(found: dict[str, Any]) -> str:
    beside, most = found["beside_matchers_over_decoding"], found["limit"]
    rows = [
        ["decoding and resizing what is scored, s", f"{found['decoding_and_resizing_s']:.2f}", ""],
        ["scoring, s", f"{found['scoring_s']:.2f}", ""],
        ["of it the matchers, s", f"{found['matchers_s']:.2f}", ""],
        ["scoring beside the matchers, in decodings",
         spread_text(beside),
         at_most(beside["median"], most)],
    ]  # fmt: skip
    text = (
        f"## Scoring\n\nOne scene of {found['frames']} frames of {found['stored_px']} px, scored "
        f"at {found['scored_at']} by the offline metrics; processor time, "
        f"{counted(found['rounds'], 'round')}.\n\n"
    )
    return text + table(("", "", "at most"), rows)


def _generation(found: dict[str, Any]) -> str:
    stages = list(found["rows"][0]["stages_s"])
    rows = [
        [
            f"{row['map']}, {row['family']}, {row['size_px']} px",
            *(f"{row['stages_s'][stage]:.1f}" for stage in stages),
            f"{row['scene_core_s']:.0f}", f"{row['times_encoding']:.2f}",
            at_most(row["times_encoding"], found["limit"]),
            f"{row['scenes_an_hour_a_core']:.1f}", f"{row['release_core_hours']:,}",
        ]
        for row in found["rows"]
    ]  # fmt: skip
    low, high = found["paper_scenes_an_hour"]
    text = (
        "## Generating scenes\n\nSeconds of one core's time for a scene of 6 x 81 frames, "
        f"by the built-in renderer; {counted(found['frames'], 'frame')} of one camera stand for "
        f"all, medians of {counted(found['scenes'], 'scene')}. The paper names {low} to {high} "
        "scenes an hour on a workstation with one GPU.\n\n"
    )
    head = (
        "map, family", *stages, "in all", "times encoding", "at most", "scenes an hour, one core",
        "core-hours of the release",
    )  # fmt: skip
    return text + table(head, rows)


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
    return "## Where the time goes\n\n" + table(head, rows)


def _derive(found: dict[str, Any]) -> str:
    parts = ["## Pairs made on the device\n"]
    rows = []
    for size, measured in found.items():
        ways = measured["ways"]
        decoding_s = ways["decoding alone"]["cpu_s"]
        for name, way in ways.items():
            ratio = way["cpu_s"] / decoding_s
            mark = at_most(ratio, MARK) if name == "views and stored depth" else ""
            rows.append(
                [f"{name}, {size}", f"{way['cpu_s'] * 1e3:.1f}", f"{ratio:.2f}", mark,
                 f"{way['bytes'] / 1e6:.1f}"]
            )  # fmt: skip
    head = ("a moment of six cameras", "processor ms", "to decoding", "target", "MB")
    parts.append(table(head, rows))
    rows = [
        [f"{size}, {way}", f"{gpu[way]:.0f}", f"{gpu[way] / gpu['limit']:.2f}", gpu["device"]]
        for size, measured in found.items()
        if (gpu := measured["gpu"]) is not None
        for way in ("limit", "eager", "compiled")
        if way in gpu
    ]
    if not rows:
        return "\n".join([*parts, "No GPU was at hand: rates on one were not measured.\n"])
    head = ("15 pairs with all maps", "moments/s", "to the memory's limit", "device")
    return "\n".join([*parts, table(head, rows)])


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
        blosc2 = ratios(rounds, entry("ours-blosc2", workers), to=entry(LIMIT, workers))
        best = ratios(rounds, entry(NO_DEPTH, workers), to=entry(LIMIT, workers))
        rows.append(
            [
                workload.title, spread_text(limit), at_least(limit, workload.target.limit),
                spread_text(naive, ".1f"), at_least(naive, workload.target.naive),
                spread_text(blosc2), at_least(blosc2, workload.blosc2), spread_text(best),
            ]
        )  # fmt: skip
    head = (
        "ours, 2 workers", "to the limit", "target", "to naive", "target",
        "blosc2 shards to the released codecs' limit", "target", "that limit, depth for nothing",
    )  # fmt: skip
    return "## Headlines\n\n" + table(head, rows)


def by_rate(sections: dict[str, Any]) -> str:
    """Return the table of the gain of blosc2 depth by the bit rate of the pictures."""
    rows = []
    for name in RATED:
        for crf in (DRAWN_CRF, *OTHER_CRFS):
            race = sections["races"].get(name if crf == DRAWN_CRF else f"{name}-crf{crf}")
            if race is None:
                continue
            rounds, workers = race["rounds"], race["settings"]["workers"][0]
            limit, free, shards, blosc2 = (
                entry(name, workers) for name in (LIMIT, NO_DEPTH, "ours-shards", "ours-blosc2")
            )
            rows.append(
                [
                    next(workload.title for workload in WORKLOADS if workload.name == name),
                    str(crf), f"{rgb_mbit_s(sections, crf):.1f}",
                    spread_text(shares(rounds, limit, without=free)),
                    spread_text(ratios(rounds, free, to=limit)),
                    spread_text(ratios(rounds, shards, to=limit)),
                    spread_text(ratios(rounds, blosc2, to=limit)),
                    spread_text(ratios(rounds, blosc2, to=shards)),
                ]
            )  # fmt: skip
    head = (
        "2 workers", "rate factor", "Mbit/s a camera", "depth's share of the limit's time",
        "the limit with depth for nothing, to the limit", "ours, released shards, to the limit",
        "ours, blosc2 shards, to the limit", "ours, blosc2 to released shards",
    )  # fmt: skip
    text = "## What blosc2 depth gives by the pictures' rate\n\n" + table(head, rows)
    return text + "\n![What depth's codec gives by the pictures' rate](rates.png)\n"


def rgb_mbit_s(sections: dict[str, Any], crf: int) -> float:
    """Return the pictures' Mbit/s a camera at a constant rate factor."""
    data = sections["data"]
    found: float = (data if crf == DRAWN_CRF else data["other_rates"][str(crf)])["rgb_mbit_s"]
    return found


def race_table(workload: Workload, race: dict[str, Any]) -> str:
    """Return the table of one race: a row for each contestant and number of workers."""
    rounds = race["rounds"]
    names = {name for found in rounds for name in found}
    is_web = workload.source == "web"
    where = "ours from local files" if is_web else "the limit"
    rows = []
    for workers in sorted(workload.workers):
        base, naive = entry(OURS if is_web else LIMIT, workers), entry(NAIVE, workers)
        first = (LIMIT, NO_DEPTH, OURS)
        for name in (*first, *(n for n in _order(names) if n not in first)):
            entrant = entry(name, workers)
            if entrant not in names:
                continue
            rows.append(
                [
                    title(name), str(workers), rate_text(rates(rounds, entrant)),
                    spread_text(ratios(rounds, entrant, to=base)) if entrant != base else "",
                    spread_text(cpu_ratios(rounds, entrant, to=base)) if entrant != base else "",
                    *(
                        [rate_text(sent_mb(rounds, entrant))]
                        if is_web
                        else [spread_text(ratios(rounds, entrant, to=naive), ".1f")]
                        if name != NAIVE
                        else [""]
                    ),
                ]
            )  # fmt: skip
    head = [
        "", "workers", "samples/s", *(f"to {where}{how}" for how in ("", ", by processor time")),
        "MB a sample" if is_web else "to naive",
    ]  # fmt: skip
    slices = f"{race['settings']['samples']} samples of {counted(workload.scenes, 'scene')}"
    failed = [f"- {title(name.split('/')[0])}: {why}" for name, why in race["failed"].items()]
    text = f"## {workload.title}\n\n{counted(len(rounds), 'round')}, {slices}.\n\n"
    text += table(head, rows)
    return text + (
        "\nDid not race, or failed in a round:\n" + "\n".join(failed) + "\n" if failed else ""
    )


def _order(names: set[str]) -> list[str]:
    found = {name.split("/")[0] for name in names}
    return [name for name in CONTESTANTS if name in found]


def table(head: Iterable[str], rows: list[list[str]]) -> str:
    """Return a table, numbers to the right."""
    titles = list(head)
    lines = [titles, ["---"] + ["---:"] * (len(titles) - 1), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def spread_text(
    spread: Spread | Mapping[str, float] | None, form: str = ".2f", *, scale: float = 1
) -> str:
    """Return median (low to high quartile), times a scale."""
    if spread is None:
        return ""
    kept = asdict(spread) if isinstance(spread, Spread) else spread
    median, low, high = (f"{kept[name] * scale:{form}}" for name in ("median", "low", "high"))
    return f"{median} ({low} to {high})"


def rate_text(spread: Spread | None) -> str:
    """Return the median alone."""
    return "" if spread is None else f"{spread.median:.3g}"


def at_least(spread: Spread | None, wanted: float | None) -> str:
    """Return the target ratio, and whether the median reaches it."""
    return "" if spread is None or wanted is None else _reached(spread.median, wanted)


def _reached(ratio: float, wanted: float) -> str:
    return f"{wanted:g} {'reached' if ratio >= wanted else '**missed**'}"


def at_most(value: float, wanted: float, form: str = "g", *, scale: float = 1) -> str:
    """Return the largest allowed value, times a scale, and whether the value is within it."""
    return f"{wanted * scale:{form}} {'reached' if value <= wanted else '**missed**'}"
