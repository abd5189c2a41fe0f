"""Timing of a contestant in its own process, from the start of its workers to the last batch.

Each measurement forks from this process, which has imported everything and opened nothing. So none
inherits memory, files or threads of another. Time runs from the moment at which worker processes
have started (the mean over several) until the last batch has arrived. So opening files, filling
queues and the uneven end all count.

A pass over as many scenes as the release has is timed in part: from one of its batches to another.
Workers make their batches side by side, so as many lie between as make whole rounds, a batch of
each worker.
"""

import multiprocessing
import resource
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from typing import Any, Final

import torch
from torch.utils.data import DataLoader

from benchmarks.contestants import limit
from benchmarks.field import CONTESTANTS
from benchmarks.workloads import Job, Wanted

LONGEST_S: Final = 300.0
"""A contestant that takes longer counts as hanging."""

Scenes = list[tuple[str, list[Wanted]]]

_FORK = multiprocessing.get_context("fork")


@dataclass(frozen=True, slots=True)
class Measured:
    """A measurement.

    Attributes:
        samples: The number of samples.
        seconds: Wall time from the start of the workers to the last batch; of a part of a pass,
            that between its batches.
        cpu_s: Processor time of all processes.
        first_samples: The samples of the first batch; 0 of the limit, which has no batches.
        first_s: Wall time to the first batch.
    """

    samples: int
    seconds: float
    cpu_s: float
    first_samples: int = 0
    first_s: float = 0.0


class MeasurementError(Exception):
    """A contestant failed; the message is its own."""


def measured(name: str, job: Job, *, workers: int) -> Measured:
    """Return the time that a contestant needs to load the slice of a job.

    Raises:
        MeasurementError: If it fails; the message gives the reason.
    """
    return in_a_fork(lambda: _run(name, job, workers=workers), longest_s=LONGEST_S)


def in_a_fork(work: Callable[[], Any], *, longest_s: float | None = None) -> Any:
    """Return what a function returns in a process forked from this one.

    Raises:
        MeasurementError: If it raises, its process dies, or it takes longer than ``longest_s``.
    """
    here, there = _FORK.Pipe(duplex=False)
    process = _FORK.Process(target=_report, args=(work, there))
    process.start()
    there.close()
    done, result = False, f"took longer than {longest_s} s"
    if here.poll(longest_s):
        try:
            done, result = here.recv()
        except EOFError:
            result = "the process died"
    else:
        process.kill()
    process.join()
    if not done:
        raise MeasurementError(result)
    return result


def _report(work: Callable[[], Any], to: Connection) -> None:
    try:
        to.send((True, work()))
    except Exception as error:  # noqa: BLE001 - whatever a contestant raises is a result
        to.send((False, f"{type(error).__name__}: {error}"))


def _run(name: str, job: Job, *, workers: int) -> Measured:
    torch.set_num_threads(1)
    batches = CONTESTANTS[name].batches
    if batches is not None and job.workload.part:
        return part_of_pass(partial(batches, job), job=job, workers=workers)
    list(job.of_scene)  # Computed before the clock starts.
    if batches is not None:
        return whole_pass(partial(batches, job), workers=workers)
    before = _cpu_s()
    samples, seconds = _bare(job, processes=max(1, workers))
    return Measured(samples, seconds, _cpu_s() - before)


def _cpu_s() -> float:
    """Return the processor time of this process and of its children, ended or not."""
    running = multiprocessing.active_children()
    spent = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    # Linux has a clock for each process, whose number is made of the process's.
    clocks = [~child.pid << 3 | 2 for child in running if child.pid is not None]
    return sum(usage.ru_utime + usage.ru_stime for usage in spent) + sum(
        map(time.clock_gettime, clocks)
    )


def whole_pass(make: Callable[..., DataLoader[Any]], *, workers: int) -> Measured:
    """Return what one pass takes over a loader, which is made with the options of its workers."""
    before = _cpu_s()
    loader, started = _started(make, workers=workers)
    arrived: list[tuple[int, float]] = []
    for batch in loader:
        arrived.append((len(batch["scene"]), time.perf_counter()))
    del batch, loader  # ends the workers, whose processor time counts
    began = float(started.mean())
    (first_samples, first), (_, last) = arrived[0], arrived[-1]
    return Measured(
        sum(samples for samples, _ in arrived), last - began, _cpu_s() - before,
        first_samples, first - began,
    )  # fmt: skip


def part_of_pass(make: Callable[..., DataLoader[Any]], *, job: Job, workers: int) -> Measured:
    """Return what as many samples as others go through take, after some batches of a pass."""
    workload, count = job.workload, len(job.of_part().wanted)
    begun, timed = (
        _whole_rounds(batches, workers=workers)
        for batches in (workload.begun, -(-count // workload.batch))
    )
    loader, started = _started(make, workers=workers)
    samples, cpu_s, arrived = [], [], []
    for number, batch in enumerate(loader, start=1):
        arrived.append(time.perf_counter())
        samples.append(len(batch["scene"]))
        if number in (begun, begun + timed):
            cpu_s.append(_cpu_s())
        if number == begun + timed:
            break
    return Measured(
        sum(samples[begun:]), arrived[-1] - arrived[begun - 1], cpu_s[1] - cpu_s[0],
        samples[0], arrived[0] - float(started.mean()),
    )  # fmt: skip


def _whole_rounds(batches: int, *, workers: int) -> int:
    """Return the batches of whole rounds of some workers, two rounds at least."""
    return max(2, -(-batches // max(1, workers))) * max(1, workers)


def _started(
    make: Callable[..., DataLoader[Any]], *, workers: int
) -> tuple[DataLoader[Any], torch.Tensor]:
    """Return a loader, and the times at which its workers start; its own, where it has none."""
    torch.set_num_threads(1)
    started = torch.zeros(max(1, workers), dtype=torch.float64).share_memory_()

    def note_start(worker: int) -> None:
        torch.set_num_threads(1)
        started[worker] = time.perf_counter()

    warnings.filterwarnings("ignore", message="This DataLoader will create")
    loader = make(num_workers=workers, worker_init_fn=note_start)
    note_start(0)
    return loader, started


def _bare(job: Job, *, processes: int) -> tuple[int, float]:
    """Run the limit: N loops over different scenes; their rates are added up."""
    scenes = list(job.of_scene.items())
    if processes == 1:
        return _timed_loop(job, scenes)
    barrier = _FORK.Barrier(processes)
    here, there = _FORK.Pipe(duplex=False)

    def loop(own: Scenes) -> None:
        barrier.wait()
        there.send(_timed_loop(job, own))

    running = [
        _FORK.Process(target=loop, args=(scenes[place::processes],)) for place in range(processes)
    ]
    for process in running:
        process.start()
    there.close()  # Waiting ends if all of them die.
    found = [here.recv() for _ in running]
    for process in running:
        process.join()
    samples = sum(samples for samples, _ in found)
    return samples, samples / sum(count / seconds for count, seconds in found)


def _timed_loop(job: Job, scenes: Scenes) -> tuple[int, float]:
    begin = time.perf_counter()
    samples = sum(1 for _ in limit.samples(job, dict(scenes)))
    return samples, time.perf_counter() - begin
