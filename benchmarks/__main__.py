"""`python -m benchmarks`: prepares the data, measures, and writes docs/performance."""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from benchmarks.accuracy import CASES, measure_accuracy
from benchmarks.clock import MeasurementError, in_a_fork
from benchmarks.equality import differences
from benchmarks.ffmpeg_links import link_libraries
from benchmarks.material import Material, facts, prepared
from benchmarks.network import DELAYS_MS, network_tables, run_network
from benchmarks.network import Plan as NetworkPlan
from benchmarks.plots import plot_all
from benchmarks.race import Plan, run_races
from benchmarks.results import Results, machine
from benchmarks.tables import tables
from benchmarks.training import measure_training
from benchmarks.workloads import WORKLOADS, Workload

ROOT: Final = Path(__file__).parents[1]
OTHERS: Final = ("accuracy", "training")
"""Measurements beside the races; `--only` takes these names and "network" too."""

QUICK: Final = ("first", "all-frames", "random", "accuracy")


def parse(words: Sequence[str]) -> argparse.Namespace:
    """Return the options of a command line."""
    known = [workload.name for workload in WORKLOADS] + ["network", *OTHERS]
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "--only", action="append", choices=known, help="measure only this; may be repeated"
    )
    parser.add_argument("--quick", action="store_true", help="one round of " + ", ".join(QUICK))
    parser.add_argument("--rounds", type=int, default=5, help="rounds of every race [5]")
    parser.add_argument("--workers", help="worker processes of every race, such as 2,0,1,4")
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


def chosen(options: argparse.Namespace) -> tuple[list[Workload], list[str]]:
    """Return the workloads of the races, and the names of the other measurements."""
    names = options.only or (QUICK if options.quick else [w.name for w in WORKLOADS] + [*OTHERS])
    workloads = [workload for workload in WORKLOADS if workload.name in names]
    if options.workers:
        workers = tuple(int(word) for word in options.workers.split(","))
        workloads = [replace(workload, workers=workers) for workload in workloads]
    if options.quick:
        workloads = [replace(workload, workers=workload.workers[:1]) for workload in workloads]
    return workloads, [name for name in OTHERS if name in names]


def measure(options: argparse.Namespace, *, report: Callable[[str], None]) -> list[str]:
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
        rounds = 1 if options.quick else options.rounds
        workloads, others = chosen(options)
        plan = Plan(rounds=rounds, resume=options.resume)
        failed += run_races(workloads, material, results, plan=plan, report=report)
        if "network" in (options.only or ()) or not (options.only or options.quick):
            plan_over_network = network_plan(options, rounds=rounds)
            failed += run_network(material, results, plan=plan_over_network, report=report)
        failed += measure_others(others, material, results, options=options, report=report)
    write_pages(results, options.out)
    report(f"results are in {options.out}")
    return failed


def network_plan(options: argparse.Namespace, *, rounds: int) -> NetworkPlan:
    """Return the settings of the races over a network."""
    delays = options.delays.split(",") if options.delays else DELAYS_MS
    return NetworkPlan(
        rounds=min(rounds, 3), scenes=options.scenes, resume=options.resume,
        workers=int((options.workers or "2").split(",")[0]),
        delays_ms=tuple(float(delay) for delay in delays),
    )  # fmt: skip


def measure_others(
    names: list[str],
    material: Material,
    results: Results,
    *,
    options: argparse.Namespace,
    report: Callable[[str], None],
) -> list[str]:
    """Run the measurements beside the races; return a message for each failure."""
    rounds = 1 if options.quick else options.rounds
    work = {
        "accuracy": lambda: in_a_fork(
            lambda: measure_accuracy(material, rounds=rounds, cases=CASES, report=report)
        ),
        "training": lambda: measure_training(
            material, rounds=min(rounds, 3), workers=os.cpu_count() or 1, report=report
        ),
    }
    failed = []
    for name in names:
        if options.resume and name in results.sections:
            continue
        began = time.perf_counter()
        try:
            results.put(name, work[name]())
        except MeasurementError as error:
            failed.append(f"{name}: {error}")
            report(f"{name} failed: {error}")
        report(f"{name} took {time.perf_counter() - began:.0f} s")
    return failed


def write_pages(results: Results, out: Path) -> None:
    """Write tables and plots of the results."""
    text = tables(results.sections)
    if "network" in results.sections:
        text += "\n" + network_tables(results.sections["network"])
    (out / "tables.md").write_text(text)
    plot_all(results.sections, out)


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
