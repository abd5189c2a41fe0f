"""How many samples a second machines load: a formula of what one sample costs.

A worker decodes while it fetches ahead, so a sample takes it the longer of two times:

    decoding_s = cpu_s * (1 + (slowdown - 1) * busy)
    busy       = min(1, (workers - 1) / (cores - 1))
    fetching_s = (requests * delay_s + bytes / connection_bytes_s) / connections
    worker_s   = max(decoding_s, fetching_s)

    machine_s  = min(workers / worker_s, cores / decoding_s, machine_bytes_s / bytes)
    rate_s     = min(machines * machine_s, total_bytes_s / bytes, requests_s / requests, demand_s)

Times are seconds of one sample, `machine_s`, `rate_s` and `demand_s` samples a second,
bandwidths bytes a second.
"""

import math
from dataclasses import dataclass, fields
from typing import Final, Literal

from stereogenbench_data.errors import SelectionError

UNLIMITED: Final = math.inf

Limit = Literal[
    "accelerators",
    "processor",
    "delay x connections",
    "connection bandwidth",
    "machine bandwidth",
    "total bandwidth",
    "requests",
]
"""What keeps samples from coming faster; "accelerators" where they get all they take."""


@dataclass(frozen=True, slots=True)
class SampleCost:
    """What one sample takes, on average.

    Attributes:
        cpu_s: Processor time of a worker that has the machine for itself, in seconds.
        bytes: Bytes that are read.
        requests: Ranges in which they are read.
        slowdown: How many times as long decoding takes while every core has a worker: cores share
            memory and caches. From 1.
    """

    cpu_s: float
    bytes: float
    requests: float
    slowdown: float = 1.0

    def __post_init__(self) -> None:
        """Require numbers in their ranges."""
        _require(self, above=("cpu_s",), least={"bytes": 0, "requests": 0, "slowdown": 1})


@dataclass(frozen=True, slots=True)
class Network:
    """Where the bytes come from, and by what way. The default is a disk that is never waited for.

    Attributes:
        delay_s: From a request to the first byte of its response, in seconds.
        connections: Requests that a worker makes at a time.
        connection_bytes_s: Bandwidth of each connection.
        machine_bytes_s: Bandwidth of each machine.
        total_bytes_s: Bandwidth of the server for all machines.
        requests_s: Requests a second that the server allows all machines together.
    """

    delay_s: float = 0.0
    connections: int = 8
    connection_bytes_s: float = UNLIMITED
    machine_bytes_s: float = UNLIMITED
    total_bytes_s: float = UNLIMITED
    requests_s: float = UNLIMITED

    def __post_init__(self) -> None:
        """Require numbers in their ranges."""
        limits = ("connection_bytes_s", "machine_bytes_s", "total_bytes_s", "requests_s")
        _require(self, above=limits, least={"delay_s": 0, "connections": 1})


@dataclass(frozen=True, slots=True)
class Machine:
    """A machine that trains.

    Attributes:
        cores: Cores that decode.
        accelerators: Accelerators of it.
        workers: Worker processes that it has at the most.
    """

    cores: int
    accelerators: int = 8
    workers: int = 0

    def __post_init__(self) -> None:
        """Require numbers in their ranges; 0 workers become one a core."""
        _require(self, least={"cores": 1, "accelerators": 1, "workers": 0})
        if self.workers == 0:
            object.__setattr__(self, "workers", self.cores)


@dataclass(frozen=True, slots=True)
class Scale:
    """What so many accelerators need, and what they get.

    Attributes:
        accelerators: How many.
        machines: How many machines hold them.
        demand_s: Samples a second that they take.
        cores: Cores that decode so many samples, of all machines.
        workers: Workers that so many samples take on each machine.
        workers_used: Workers that each machine has: as many as needed, up to its limit.
        bytes_s: Bytes a second that so many samples take, of all machines.
        requests_s: Requests a second that they take, of all machines.
        rate_s: Samples a second that they get.
        limit: What binds.
    """

    accelerators: int
    machines: int
    demand_s: float
    cores: int
    workers: int
    workers_used: int
    bytes_s: float
    requests_s: float
    rate_s: float
    limit: Limit

    @property
    def share(self) -> float:
        """The part of the demand that is met."""
        return self.rate_s / self.demand_s


def decoding_s(cost: SampleCost, *, workers: int, cores: int) -> float:
    """Return the processor seconds of a sample while so many workers run."""
    busy = min(1.0, (workers - 1) / (cores - 1)) if cores > 1 else 0.0
    return cost.cpu_s * (1 + (min(cost.slowdown, cores) - 1) * busy)


def fetching_s(cost: SampleCost, network: Network) -> float:
    """Return the seconds in which a worker fetches a sample, by all its connections.

    >>> cost = SampleCost(cpu_s=0.01, bytes=1e6, requests=4)
    >>> round(fetching_s(cost, Network(delay_s=0.06, connections=8, connection_bytes_s=25e6)), 6)
    0.035
    """
    one_by_one = cost.requests * network.delay_s + cost.bytes / network.connection_bytes_s
    return one_by_one / network.connections


def loading_rate(
    cost: SampleCost, machine: Machine, network: Network, *, workers: int, machines: int = 1
) -> tuple[float, Limit]:
    """Return how many samples a second machines load that nothing waits for, and what binds.

    Args:
        cost: Of a sample.
        machine: Each machine.
        network: Where the data are.
        workers: Worker processes of each machine.
        machines: How many machines.
    """
    decoding = decoding_s(cost, workers=workers, cores=machine.cores)
    fetching = fetching_s(cost, network)
    waits = cost.requests * network.delay_s
    sends = cost.bytes / network.connection_bytes_s
    slowest: Limit = "delay x connections" if waits >= sends else "connection bandwidth"
    rates: dict[Limit, float] = {
        "processor": machines * min(workers, machine.cores) / decoding,
        slowest: machines * _over(workers, fetching),
        "machine bandwidth": machines * _over(network.machine_bytes_s, cost.bytes),
        "total bandwidth": _over(network.total_bytes_s, cost.bytes),
        "requests": _over(network.requests_s, cost.requests),
    }
    limit = min(rates, key=rates.__getitem__)
    return rates[limit], limit


def scale(
    cost: SampleCost,
    machine: Machine,
    network: Network,
    *,
    accelerators: int,
    samples_s: float,
) -> Scale:
    """Return what so many accelerators need and get.

    Args:
        cost: Of a sample.
        machine: Each machine.
        network: Where the data are.
        accelerators: How many in all.
        samples_s: Samples a second that each takes.

    Raises:
        SelectionError: If a number is out of its range.
    """
    if accelerators < 1 or not (samples_s > 0 and math.isfinite(samples_s)):
        raise SelectionError(
            f"accelerators={accelerators}, samples_s={samples_s}: give at least 1 accelerator, and "
            f"the samples a second that each takes, above 0."
        )
    machines = -(-accelerators // machine.accelerators)
    demand = accelerators * samples_s
    of_machine = demand / machines
    busy_s = decoding_s(cost, workers=machine.cores, cores=machine.cores)
    by_network = machine.workers if fetching_s(cost, network) else 0
    used = next(
        (
            workers
            for workers in range(1, machine.workers + 1)
            if loading_rate(cost, machine, network, workers=workers)[0] >= of_machine
        ),
        max(by_network, min(machine.workers, machine.cores)),
    )
    rate, limit = loading_rate(cost, machine, network, workers=used, machines=machines)
    return Scale(
        accelerators=accelerators,
        machines=machines,
        demand_s=demand,
        cores=math.ceil(demand * busy_s),
        workers=math.ceil(of_machine * max(busy_s, fetching_s(cost, network))),
        workers_used=used,
        bytes_s=demand * cost.bytes,
        requests_s=demand * cost.requests,
        rate_s=min(rate, demand),
        limit="accelerators" if rate >= demand else limit,
    )


def _over(amount: float, each: float) -> float:
    return amount / each if each else UNLIMITED


def _require(
    record: SampleCost | Network | Machine,
    *,
    above: tuple[str, ...] = (),
    least: dict[str, int],
) -> None:
    for name in (field.name for field in fields(record)):
        value = getattr(record, name)
        if name in above and not value > 0:
            raise SelectionError(f"{name} must be above 0, got {value!r}.")
        if name in least and not least[name] <= value < UNLIMITED:
            raise SelectionError(f"{name} must be a number from {least[name]}, got {value!r}.")
