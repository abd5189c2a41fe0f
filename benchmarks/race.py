"""Races: rounds in which every entrant of a workload runs once, in turn, on the same samples."""

import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any

from benchmarks.clock import MeasurementError, measured
from benchmarks.field import CONTESTANTS, entrants, why_not
from benchmarks.material import Material
from benchmarks.results import Report, Results, entry
from benchmarks.server import WebServer, serving
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


class TimeLeft:
    """An estimate of the time left, from the durations of earlier measurements."""

    def __init__(self, results: Results, workloads: list[Workload], *, rounds: int) -> None:
        """Take the durations in the results."""
        self._took: dict[str, float] = dict(results.sections.get("took_s", {}))
        self._results = results
        self._left = {
            f"{workload.name} {entry(*entrant)}": rounds
            for workload in workloads
            for entrant in entrants(workload)
        }

    def spent(self, what: str, seconds: float) -> None:
        """Record the duration of a measurement."""
        self._took[what] = seconds
        self._results.sections["took_s"] = {k: round(v, 2) for k, v in self._took.items()}
        self.skip(what)

    def skip(self, what: str) -> None:
        """Record that a measurement will not take place."""
        self._left[what] = max(0, self._left.get(what, 0) - 1)

    def text(self) -> str:
        """Return the approximate time left as m:ss."""
        mean = sum(self._took.values()) / len(self._took) if self._took else 5.0
        seconds = sum(count * self._took.get(what, mean) for what, count in self._left.items())
        return f"{int(seconds // 60)}:{int(seconds % 60):02d}"


def run_races(
    workloads: list[Workload], material: Material, results: Results, *, plan: Plan, report: Report
) -> list[str]:
    """Run the races of some workloads; results are written after every round.

    Returns:
        A message for each failure.
    """
    left = TimeLeft(results, workloads, rounds=plan.rounds)
    with ExitStack() as stack:
        server = None
        if any(workload.source == "web" for workload in workloads):
            home = material.root / "server"
            server = stack.enter_context(serving(material.root, home=home))
        for workload in workloads:
            serves = server if workload.source == "web" else None
            _race(workload, material, results, plan=plan, report=report, left=left, server=serves)
    return [
        f"{workload.name}: {name}: {why}"
        for workload in workloads
        for name, why in results.race(workload.name)["failed"].items()
        if "/" in name  # others could not race here at all
    ]


def _race(  # noqa: PLR0913 - one race's surroundings
    workload: Workload,
    material: Material,
    results: Results,
    *,
    plan: Plan,
    report: Report,
    left: TimeLeft,
    server: WebServer | None,
) -> None:
    job = Job(workload, material, url=server.url if server else None)
    settings = {
        "title": workload.title, "scenes": workload.scenes, "batch": workload.batch,
        "few": workload.few, "window": str(workload.window), "workers": list(workload.workers),
        "samples": len(job.wanted), "server": server.kind if server else None,
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
    for number in range(plan.rounds):
        if number < len(section["rounds"]):
            for entrant in field:
                left.skip(f"{workload.name} {entry(*entrant)}")
            continue
        report(f"{workload.name}: round {number + 1} of {plan.rounds}, about {left.text()} left")
        turn = number % max(1, len(field))
        in_turn = field[turn:] + field[:turn]
        found = {}
        for name, workers in in_turn if number % 2 == 0 else in_turn[::-1]:
            began = time.perf_counter()
            try:
                found[entry(name, workers)] = _measured(name, job, workers=workers, server=server)
            except MeasurementError as error:
                section["failed"][entry(name, workers)] = str(error)[-500:]
                report(f"{workload.name}: {name} failed: {str(error)[-300:]}")
            finally:
                left.spent(f"{workload.name} {entry(name, workers)}", time.perf_counter() - began)
        section["rounds"].append(found)
        results.put_race(workload.name, section)


def _measured(name: str, job: Job, *, workers: int, server: WebServer | None) -> dict[str, float]:
    """Return the record of one contestant's turn.

    Raises:
        MeasurementError: If it failed.
    """
    reading = CONTESTANTS[name].reading if name in CONTESTANTS else "forwards"
    sent = server.sent_bytes() if server else 0
    took = measured(name, addressed(replace(job, reading=reading), name), workers=workers)
    noted = {
        "samples": took.samples,
        "seconds": round(took.seconds, 4),
        "cpu_s": round(took.cpu_s, 3),
    }
    if server and name.endswith(("-web", "-web-blosc2")):
        noted["bytes"] = server.sent_bytes() - sent
    return noted


def addressed(job: Job, name: str) -> Job:
    """Return the job with the URL of this contestant's shards."""
    if name.startswith("ours"):
        return job
    return replace(job, url=f"{job.url}/shards" if name.endswith("-web") else None)
