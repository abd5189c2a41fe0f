"""The forecast of loading rates against measured ones: workers, networks, two kinds of shards.

The decoding of each kind of shards is measured once, from the local disk; the forecast of a point
is the formula with the network and the workers of the point. The server runs on the same cores as
the workers, which the formula does not know. Rates are those behind the first batch.
"""

import math
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

from benchmarks.clock import in_a_fork
from benchmarks.material import Material
from benchmarks.network import LOCAL, OURS, Job, Turn, link_shards, measured
from benchmarks.network import WORKLOADS as NETWORK_WORKLOADS
from benchmarks.results import Report
from benchmarks.server import Network as Served
from benchmarks.tables import table
from stereogenbench_data.datasets.forecast import forecast
from stereogenbench_data.datasets.scaling import Machine, Network, loading_rate
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.shards.pack import pack
from stereogenbench_data.shards.training import TrainingSettings

MARK: Final = 0.2
"""How far a forecast may be from what is measured."""


@dataclass(frozen=True, slots=True)
class Point:
    """What is forecast and measured.

    Attributes:
        workload: The name of a workload of the races over a network.
        kind: "released" or "training" shards.
        workers: Worker processes.
        network: What lies between; None reads from the local disk.
    """

    workload: str
    kind: str
    workers: int
    network: Served | None


POINTS: Final = (
    Point("all-frames", "released", 1, None),
    Point("all-frames", "released", 2, None),
    Point("all-frames", "released", 2, Served(0.06)),
    Point("all-frames", "released", 1, Served(0.0, connection_mb_s=0.2)),
    Point("all-frames", "released", 2, Served(0.0, total_mb_s=3.0)),
    Point("all-frames", "training", 1, None),
    Point("all-frames", "training", 2, Served(0.06)),
    Point("all-frames", "training", 2, Served(0.0, total_mb_s=8.0)),
    Point("random", "released", 1, Served(0.06, connection_mb_s=0.5)),
    Point("random", "training", 1, Served(0.3)),
    Point("random", "training", 2, Served(0.3)),
)


@dataclass(frozen=True, slots=True)
class _Derived(Material):
    """The drawn scenes, in a training shard of the stored size, of which the first counts."""

    @property
    def shards(self) -> Path:
        """The training shards."""
        return self.root / "derived"


class _TrainingJob(Job):
    """A workload on training shards."""

    @property
    def shards(self) -> Path:
        """The shards and their index."""
        return self.root / f"training-{self.scenes}"


def measure_forecast(
    material: Material,
    *,
    scenes: int = 24,
    points: Sequence[Point] = POINTS,
    seconds: float = 24.0,
    rounds: int = 3,
    report: Report,
) -> list[dict[str, Any]]:
    """Return forecast and measured samples a second of each point.

    Args:
        material: The data; its shards exist.
        scenes: How many scenes each workload has.
        points: What to compare.
        seconds: How long the decoding of a kind of shards is measured.
        rounds: How often each point is measured; the median counts.
        report: Takes what is done.
    """
    jobs = {(each.workload, each.kind): _job(material, each, scenes=scenes) for each in points}
    known = {}
    for (workload, kind), job in jobs.items():
        report(f"forecast: decoding of {kind} shards, {workload}")
        known[workload, kind] = in_a_fork(lambda job=job: _decoding(job, seconds=seconds))
    rows = []
    for point in points:
        report(f"forecast: {point}")
        job, found = jobs[point.workload, point.kind], known[point.workload, point.kind]
        expected, limit = expected_rate(found, point)
        name = LOCAL if point.network is None else OURS
        turns = [
            measured(name, job, point.network or Served(), workers=point.workers)
            for _ in range(rounds)
        ]
        rates = sorted(_rate(turn) for turn in turns)
        rows.append(
            {
                "workload": point.workload, "kind": point.kind, "workers": point.workers,
                "network": None if point.network is None else asdict(point.network),
                "forecast": expected, "limit": limit, "measured": statistics.median(rates),
                "rates": rates,
            }
        )  # fmt: skip
    return rows


def expected_rate(found: dict[str, Any], point: Point) -> tuple[float, str]:
    """Return the forecast of a point, in samples a second, and what binds."""
    served = point.network
    if served is None:
        network = Network()
    else:
        network = Network(
            delay_s=served.delay_s,
            connection_bytes_s=served.connection_mb_s * 1e6 or math.inf,
            total_bytes_s=served.total_mb_s * 1e6 or math.inf,
        )
    cost = found["far"] if served else found["local"]
    return loading_rate(cost, Machine(found["cores"]), network, workers=point.workers)


def _decoding(job: Job, *, seconds: float) -> dict[str, Any]:
    workload = job.workload
    found = forecast(
        job.shards, samples_s=1, accelerators=(1,), batch_size=workload.batch, measure_s=seconds,
        pairs="primary", frames=workload.frames, fields=workload.fields,
        network=Network(delay_s=1e-9),
    )  # fmt: skip
    local = replace(found.cost, cpu_s=found.decoding_s)
    return {"far": found.cost, "local": local, "cores": found.machine.cores}


def _rate(turn: Turn) -> float:
    """Return the samples a second behind the first batch."""
    return (turn.samples - turn.first_samples) / (turn.seconds - turn.first_s)


def _job(material: Material, point: Point, *, scenes: int) -> Job:
    (workload,) = (each for each in NETWORK_WORKLOADS if each.name == point.workload)
    root = material.root / "network"
    released = Job(workload, root, scenes)
    link_shards(material, released)
    if point.kind == "released":
        return released
    job = _TrainingJob(workload, root, scenes)
    derived = _Derived(material.root, material.size_px, material.frames)
    if not (derived.shards / INDEX_NAME).exists():
        settings = TrainingSettings((material.size_px, material.size_px))
        pack(material.release, derived.shards, training=settings)
    link_shards(derived, job)
    return job


def forecast_section(rows: Sequence[dict[str, Any]]) -> str:
    """Return the comparison as a section of Markdown."""
    head = (
        "frames", "shards", "workers", "network", "forecast, samples/s", "limit", "measured",
        "range", "forecast off by",
    )  # fmt: skip
    lines = [
        [
            row["workload"], row["kind"], str(row["workers"]), _named(row["network"]),
            f"{row['forecast']:.1f}", row["limit"], f"{row['measured']:.1f}",
            f"{row['rates'][0]:.1f} to {row['rates'][-1]:.1f}",
            f"{row['forecast'] / row['measured'] - 1:+.0%}",
        ]
        for row in rows
    ]  # fmt: skip
    within = sum(abs(row["forecast"] / row["measured"] - 1) <= MARK for row in rows)
    return (
        f"## Forecasts\n\nThe formula of `stereogenbench forecast` against samples a second behind "
        f"the first batch; {within} of {len(rows)} lie within {MARK:.0%}. The server runs on the "
        f"same cores.\n\n" + table(head, lines)
    )


def _named(network: dict[str, Any] | None) -> str:
    if network is None:
        return "local disk"
    words = [f"{network['delay_s'] * 1e3:g} ms"]
    words += [f"{network['connection_mb_s']:g} MB/s each"] if network["connection_mb_s"] else []
    words += [f"{network['total_mb_s']:g} MB/s in all"] if network["total_mb_s"] else []
    return ", ".join(words)
