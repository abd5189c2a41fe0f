"""The Markdown of the results: everything in it is worked out from the JSON file."""

from typing import Any

from benchmarks.markdown import table
from benchmarks.race_tables import by_rate, headlines, race_table
from benchmarks.workloads import RATES, WORKLOADS
from stereogenbench_data.schema.text import counted


def tables(sections: dict[str, Any]) -> str:
    """Return all tables of the results at hand."""
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
        ("tried", _tried), ("evaluation", _evaluation),
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
        ["loading a state of half an epoch", _ms(start["resuming"]["seek_s"]), ""],
    ]  # fmt: skip
    torch = "imports torch" if start["imports_torch"] else "does not import torch"
    rounds = counted(start["rounds"], "round")
    text = f"## Start\n\n`import stereogenbench_data` {torch}. {rounds}.\n\n"
    return text + table(("", "ms", "target"), rows) + "\n" + _resuming(start)


def _resuming(start: dict[str, Any]) -> str:
    """Return the table of starting and resuming beside what a bare loop has to decode anyway."""
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
            spread = f"{to_bare['median']:.2f} ({to_bare['low']:.2f} to {to_bare['high']:.2f})"
            beside = [_ms(times[f"bare_{name}"]), spread]
        rows.append([what, _ms(times[name]), *beside])
    head = ("", "ours, ms", "a bare loop to the same frames, ms", "ours to the loop, times")
    return table(head, rows)


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
                f"{most:.2f} {'reached' if ns['conversions'] <= most else '**missed**'}",
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
            spread = f"{times['median']:.2f} ({times['low']:.2f} to {times['high']:.2f})"
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
         f"{beside['median']:.2f} ({beside['low']:.2f} to {beside['high']:.2f})",
         f"{most:g} {'reached' if beside['median'] <= most else '**missed**'}"],
    ]  # fmt: skip
    text = (
        f"## Scoring\n\nOne scene of {found['frames']} frames of {found['stored_px']} px, scored "
        f"at {found['scored_at']} by the offline metrics; processor time, "
        f"{counted(found['rounds'], 'round')}.\n\n"
    )
    return text + table(("", "", "at most"), rows)


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
