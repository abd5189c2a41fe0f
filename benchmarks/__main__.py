"""`python -m benchmarks`: prepares the data, measures, and writes docs/performance."""

import argparse
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

from benchmarks.accuracy import CASES, measure_accuracy
from benchmarks.clock import MeasurementError, in_a_fork
from benchmarks.equality import differences
from benchmarks.ffmpeg_links import link_libraries
from benchmarks.material import Material, facts, prepared
from benchmarks.network import NETWORKS, network_tables, run_network
from benchmarks.network import Plan as NetworkPlan
from benchmarks.plots import plot_all
from benchmarks.race import Plan, run_races
from benchmarks.results import Report, Results, machine
from benchmarks.tables import tables
from benchmarks.training import measure_training
from benchmarks.workloads import WORKLOADS

ROOT: Final = Path(__file__).parents[1]
ALL: Final = (*(workload.name for workload in WORKLOADS), "network", "accuracy", "training")
USUAL: Final = ("first", "all-frames", "all-pairs", "release-size", "workers")
"""What is measured unless something is named: in some 15 minutes on two cores."""
QUICK: Final = ("first", "all-frames", "random", "accuracy")


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Return the options of a command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "--only", action="append", choices=(*ALL, "all"),
        help=f"measure only this, or all, in hours; may be repeated [{', '.join(USUAL)}]",
    )  # fmt: skip
    parser.add_argument("--quick", action="store_true", help="one round of " + ", ".join(QUICK))
    parser.add_argument(
        "--rounds", type=int, help="rounds of every race [5 of what is named, or 3]"
    )
    parser.add_argument("--delays", help="of the races over a network, in ms, such as 0,60")
    parser.add_argument("--scenes", type=int, default=0, help="of the races over a network")
    parser.add_argument("--resume", action="store_true", help="keep the rounds that exist")
    parser.add_argument(
        "--check", action="store_true", help="only compare every contestant's samples with ours"
    )
    parser.add_argument("--tables", action="store_true", help="only write tables and plots again")
    parser.add_argument("--data", type=Path, default=ROOT / "build" / "bench")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "performance")
    parser.add_argument("--size", type=int, default=1280, help=argparse.SUPPRESS)
    parser.add_argument("--frames", type=int, default=81, help=argparse.SUPPRESS)
    return parser.parse_args(words)


def measure(options: argparse.Namespace, *, report: Report) -> list[str]:
    """Measure, and write results, tables and plots; return the failures."""
    material = Material(options.data, size_px=options.size, frames=options.frames)
    results = Results(options.out / "results.json")
    failed: list[str] = []
    if not options.tables:
        prepared(material, report=report)
        if options.check:
            print(json.dumps(differences(material), indent=1))  # noqa: T201
            return failed
        here = machine()
        if not options.only or results.sections.get("machine", here)["cpu"] == here["cpu"]:
            results.put("machine", here)
            results.put("data", facts(material))
        failed = run_all(options, material, results, report=report)
    text = tables(results.sections)
    if "network" in results.sections:
        text += "\n" + network_tables(results.sections["network"])
    (options.out / "tables.md").write_text(text)
    plot_all(results.sections, options.out)
    report(f"results are in {options.out}")
    return failed


def run_all(
    options: argparse.Namespace, material: Material, results: Results, *, report: Report
) -> list[str]:
    """Run the measurements that are asked for; return the failures."""
    names, rounds = options.only or (QUICK if options.quick else USUAL), options.rounds
    names, resume = ALL if "all" in names else names, options.resume
    rounds = 1 if options.quick else rounds or (5 if options.only else 3)
    few = min(rounds, 3)
    workloads = [workload for workload in WORKLOADS if workload.name in names]
    if options.quick:
        workloads = [replace(workload, workers=workload.workers[:1]) for workload in workloads]
    plan = Plan(rounds=rounds, resume=resume)
    failed = run_races(workloads, material, results, plan=plan, report=report)
    if "network" in names:
        wanted = options.delays and [float(delay) for delay in options.delays.split(",")]
        networks = [each for each in NETWORKS if not wanted or each.delay_s * 1e3 in wanted]
        over = NetworkPlan(
            rounds=few, scenes=options.scenes, networks=tuple(networks), resume=resume
        )
        failed += run_network(material, results, plan=over, report=report)
    work = {
        "accuracy": partial(measure_accuracy, material, rounds=rounds, cases=CASES, report=report),
        "training": partial(measure_training, material, rounds=few, report=report),
    }
    for name, run in work.items():
        if name not in names or (resume and name in results.sections):
            continue
        try:
            results.put(name, run() if name == "training" else in_a_fork(run))
        except MeasurementError as error:
            failed.append(f"{name}: {error}")
            report(f"{name} failed: {error}")
    return failed


def require_libraries(data: Path) -> None:
    """Restart this process unless the path of torchcodec's FFmpeg and one thread are set."""
    links = link_libraries((data / "ffmpeg").resolve())
    paths = os.environ.get("LD_LIBRARY_PATH", "")
    if links is None or str(links) in paths.split(":"):
        return
    own = {"LD_LIBRARY_PATH": f"{links}:{paths}".rstrip(":"), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "benchmarks", *sys.argv[1:]]
    os.execve(sys.executable, command, os.environ | own)


def main() -> None:
    """Run the command line."""
    options = parse(sys.argv[1:])
    require_libraries(options.data)
    try:
        failed = measure(options, report=lambda text: print(text, file=sys.stderr, flush=True))  # noqa: T201
    except KeyboardInterrupt:
        print("stopped; run the same command with --resume to continue", file=sys.stderr)  # noqa: T201
        sys.exit(130)
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
