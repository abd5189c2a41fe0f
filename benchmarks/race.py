"""Races: rounds in which every entrant of a workload runs once, in turn, on the same samples."""

from dataclasses import asdict, dataclass, replace
from typing import Any

from benchmarks.clock import MeasurementError, measured
from benchmarks.field import CONTESTANTS, entrants, why_not
from benchmarks.material import Material
from benchmarks.results import Report, Results, entry
from benchmarks.workloads import Job, Workload


@dataclass(frozen=True, slots=True)
class Plan:
    """The settings of a race.

    Attributes:
        rounds: The number of rounds.
        resume: Whether rounds of the same settings in the results count.
    """

    rounds: int = 5
    resume: bool = False


def run_races(
    workloads: list[Workload], material: Material, results: Results, *, plan: Plan, report: Report
) -> list[str]:
    """Run the races of some workloads; results are written after every round.

    Returns:
        A message for each failure.
    """
    for workload in workloads:
        _race(workload, material, results, plan=plan, report=report)
    return [
        f"{workload.name}: {name}: {why}"
        for workload in workloads
        for name, why in results.race(workload.name)["failed"].items()
        if "/" in name  # others could not race here at all
    ]


def _race(
    workload: Workload,
    material: Material,
    results: Results,
    *,
    plan: Plan,
    report: Report,
) -> None:
    job = Job(workload, material)
    settings = {
        "title": workload.title, "scenes": workload.scenes, "batch": workload.batch,
        "few": workload.few, "window": str(workload.window), "workers": list(workload.workers),
        "samples": len(job.of_part().wanted),
    }  # fmt: skip
    section: dict[str, Any] = results.race(workload.name)
    if not plan.resume or section["settings"] != settings:
        section = {"settings": settings, "rounds": [], "failed": {}}
    reasons = {name: why_not(name) for name, _ in entrants(workload)}
    section["failed"] = {
        **{name: why for name, why in section["failed"].items() if "/" in name},
        **{name: why for name, why in reasons.items() if why is not None},
    }
    field = [(name, workers) for name, workers in entrants(workload) if reasons[name] is None]
    for number in range(len(section["rounds"]), plan.rounds):
        report(f"{workload.name}: round {number + 1} of {plan.rounds}")
        turn = number % max(1, len(field))
        in_turn = field[turn:] + field[:turn]
        found = {}
        for name, workers in in_turn if number % 2 == 0 else in_turn[::-1]:
            try:
                contestant = CONTESTANTS[name]
                own = job if contestant.scenes == "all" else job.of_part()
                own = replace(own, reading=contestant.reading)
                found[entry(name, workers)] = asdict(measured(name, own, workers=workers))
            except MeasurementError as error:
                section["failed"][entry(name, workers)] = str(error)[-500:]
                report(f"{workload.name}: {name} failed: {str(error)[-300:]}")
        section["rounds"].append(found)
        results.put_race(workload.name, section)
