"""The races' tables: headlines, each race, and ratios by bit rate."""

from typing import Any

from benchmarks.field import CONTESTANTS, LIMIT, NAIVE, NO_DEPTH, OURS, title
from benchmarks.markdown import rate_text, spread_text, table, verdict
from benchmarks.reencoded import DRAWN_CRF, OTHER_CRFS
from benchmarks.results import Spread, cpu_ratios, entry, rates, ratios, shares
from benchmarks.workloads import RATED, WORKLOADS, Workload
from stereogenbench_data.schema.text import counted


def headlines(races: dict[str, Any]) -> str:
    """Return the table of our ratios beside those that are to be reached."""
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
                workload.title, spread_text(limit), verdict(limit, workload.target.limit),
                spread_text(naive, ".1f"), verdict(naive, workload.target.naive),
                spread_text(blosc2), verdict(blosc2, workload.blosc2), spread_text(best),
            ]
        )  # fmt: skip
    head = (
        "ours, 2 workers", "to the limit", "target", "to naive", "target",
        "blosc2 shards to the released codecs' limit", "target", "that limit, depth for nothing",
    )  # fmt: skip
    return "## Headlines\n\n" + table(head, rows)


def by_rate(sections: dict[str, Any]) -> str:
    """Return the table of what blosc2 depth gives by the bit rate of the pictures."""
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
            sent = Spread.of(
                found[entrant]["bytes"] / found[entrant]["samples"] / 1e6
                for found in rounds
                if "bytes" in found.get(entrant, {})
            )
            rows.append(
                [
                    title(name), str(workers), rate_text(rates(rounds, entrant)),
                    spread_text(ratios(rounds, entrant, to=base)) if entrant != base else "",
                    spread_text(cpu_ratios(rounds, entrant, to=base)) if entrant != base else "",
                    *(
                        [rate_text(sent)]
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
