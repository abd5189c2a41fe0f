"""What will limit a training: bytes by the index, decoding by this machine, the rest by a formula.

A worker decodes while it fetches ahead, so the slower of the two decides:

    fetching_s = (requests * delay_s + bytes / connection_bytes_s) / 8
    worker_s   = max(decoding_s, fetching_s)

    machine_s  = min(workers / worker_s, cores / decoding_s, machine_bytes_s / bytes)
    rate_s     = min(machines * machine_s, total_bytes_s / bytes, requests_s / requests, demand_s)

Times are seconds of one sample; `machine_s`, `rate_s` and `demand_s` are samples a second.
``docs/shards.md`` says where the numbers come from, and what is left out.
"""

import contextlib
import copy
import math
import os
import statistics
import time
import timeit
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, islice, repeat
from typing import Any, Final

from stereogenbench_data.datasets.batches import EpochBatch
from stereogenbench_data.datasets.division import WorkerShare
from stereogenbench_data.datasets.mapped import Data, StereoPairs
from stereogenbench_data.errors import SelectionError, StorageError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.load import SampleDecoder
from stereogenbench_data.schema.release import VIDEO_FILES
from stereogenbench_data.sources.fetch_ahead import CONNECTIONS, PlannedFetches
from stereogenbench_data.sources.location import is_remote, joined
from stereogenbench_data.sources.remote import RemoteObject

ACCELERATORS: Final = (1, 8, 64, 512, 1000, 10_000)
_MOST_PLANNED: Final = 16_384
"""Samples of an epoch whose bytes are counted."""


@dataclass(frozen=True, slots=True)
class Scale:
    """What a number of accelerators needs, and what it gets.

    Attributes:
        accelerators: How many.
        machines: How many machines hold them.
        cores: Cores of each machine that decode all that its accelerators take.
        workers: Workers of each machine that load all that its accelerators take.
        mb_s: 10^6 bytes a second that all of them take.
        requests_s: Requests a second that all of them take.
        share: The part of their demand that is met.
        limit: What binds; "accelerators" where they get all they take.
    """

    accelerators: int
    machines: int
    cores: int
    workers: int
    mb_s: float
    requests_s: float
    share: float
    limit: str


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a training needs, and what limits it.

    Attributes:
        samples: Samples of an epoch.
        decoding_s: Seconds that a core takes for a sample, measured here.
        bytes: Bytes that are read for a sample, by the index.
        requests: Ranges in which they are read.
        delay_ms: From a request to the first byte of its response.
        scales: For each number of accelerators what they need and get.
    """

    samples: int
    decoding_s: float
    bytes: float
    requests: float
    delay_ms: float
    scales: tuple[Scale, ...]


def forecast(  # noqa: PLR0913 - each names one thing that a user knows
    data: Data,
    *,
    samples_s: float,
    accelerators: Sequence[int] = ACCELERATORS,
    per_machine: int = 8,
    cores: int | None = None,
    workers: int | None = None,
    delay_ms: float | None = None,
    connection_mb_s: float = math.inf,
    machine_mb_s: float = math.inf,
    total_mb_s: float = math.inf,
    requests_s: float = math.inf,
    batch_size: int = 8,
    measure_s: float = 6.0,
    **options: Any,
) -> Forecast:
    """Forecast what will limit a training.

    Args:
        data: As for `StereoPairs`.
        samples_s: Samples a second that each accelerator takes.
        accelerators: Numbers of accelerators to forecast for.
        per_machine: Accelerators of a machine.
        cores: Cores of a machine, as fast as those here; None for as many as here.
        workers: Worker processes of a machine, at most; None for one a core.
        delay_ms: From a request to the first byte; None measures it where the data are behind a
            URL, and else is a disk that is never waited for.
        connection_mb_s: Bandwidth of a connection, in 10^6 bytes a second.
        machine_mb_s: Bandwidth of each machine.
        total_mb_s: Bandwidth of the server for all machines.
        requests_s: Requests a second that the server allows all machines together.
        batch_size: Samples in a batch.
        measure_s: How long to decode, in seconds; two batches of each worker at the least.
        **options: As for `StereoPairs`: fields, size, and the selection.

    Raises:
        SelectionError: If a number is out of its range, or nothing is selected.
        StorageError: If the index does not say where packets lie.
    """
    here = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    cores = here if cores is None else cores
    workers = cores if workers is None else workers
    finite = [
        ("samples_s", samples_s), ("per_machine", per_machine), ("cores", cores),
        ("workers", workers), ("measure_s", measure_s),
        *(("accelerators", number) for number in [*accelerators] or [0]),
    ]  # fmt: skip
    limits = [
        ("connection_mb_s", connection_mb_s), ("machine_mb_s", machine_mb_s),
        ("total_mb_s", total_mb_s), ("requests_s", requests_s),
    ]  # fmt: skip
    for name, number in finite + limits:
        if not number > 0:
            raise SelectionError(f"{name} must be above 0, got {number!r}.")
    for name, number in [*finite, ("delay_ms", delay_ms or 0)]:
        if not 0 <= number < math.inf:
            raise SelectionError(f"{name} must be a finite number from 0, got {number!r}.")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # advice on splits and workers: nothing is trained here
        pairs = StereoPairs(data, **options)
        requests, count = planned_bytes(pairs, batch_size, workers=workers)
        decoding_s = _decoding_s(pairs, batch_size, workers=here, seconds=measure_s)
    if delay_ms is None:
        delay_ms = _delay_ms(pairs.index) if is_remote(pairs.index.root) else 0.0
    waits_s = requests * delay_ms / 1e3 / CONNECTIONS
    sends_s = count / 1e6 / connection_mb_s / CONNECTIONS
    worker_s = max(decoding_s, waits_s + sends_s)
    scales = []
    for number in accelerators:
        machines, demand = -(-number // per_machine), number * samples_s
        rates = {
            "accelerators": demand,
            "processor": _rate(machines * min(workers, cores), decoding_s),
            "delay" if waits_s >= sends_s else "connection bandwidth": _rate(
                machines * workers, waits_s + sends_s
            ),
            "machine bandwidth": _rate(machines * machine_mb_s * 1e6, count),
            "total bandwidth": _rate(total_mb_s * 1e6, count),
            "requests": _rate(requests_s, requests),
        }
        limit = min(rates, key=rates.__getitem__)
        scales.append(
            Scale(
                accelerators=number,
                machines=machines,
                cores=math.ceil(demand / machines * decoding_s),
                workers=math.ceil(demand / machines * worker_s),
                mb_s=demand * count / 1e6,
                requests_s=demand * requests,
                share=rates[limit] / demand,
                limit=limit,
            )
        )
    return Forecast(len(pairs), decoding_s, count, requests, delay_ms, tuple(scales))


def _rate(there: float, of_sample: float) -> float:
    """Return the samples a second that something allows of which each sample takes so much."""
    return there / of_sample if of_sample else math.inf


def planned_bytes(pairs: StereoPairs, batch_size: int, *, workers: int) -> tuple[float, float]:
    """Return the requests and the bytes of a sample, as ``workers`` processes would fetch them.

    Raises:
        StorageError: If the index does not say where packets lie.
    """
    index = pairs.index
    if not index.load_seek_tables():
        raise StorageError(
            f"{index.where}: its index does not say where the packets of videos lie, so the bytes "
            f"of a sample are not known. Make the index again: `stereogenbench index` for a "
            f"released tree, `stereogenbench unpack` and `pack` for shards."
        )
    if not is_remote(index.root):
        index = copy.copy(index)
        index.root = "https://forecast.invalid"  # stands for their place, and is never asked
    batches, own = pairs.loader(batch_size, drop_last=False).batches, pairs.with_own_videos()
    own.read_by(batches, WorkerShare(0, 1, 0, workers, "streams"))
    scenes = batches.of_all_ranks.order(0).open_runs()
    videos, frames = scenes * len(VIDEO_FILES), batches.rule.open_frames
    requests = count = samples = 0
    for worker in range(workers):
        ahead = PlannedFetches()
        decoder = SampleDecoder(
            index, pairs.request, check="metadata", frames="shared", ahead=ahead
        )
        decoder.keep_open(videos, frames=frames, scenes=scenes)
        share = WorkerShare(0, 1, worker, workers, "streams")
        before_first = EpochBatch((), epoch=0)
        before_first.number = -share.batches_apart
        decoder.expect(own.steps(before_first, (), share))
        most = -(-_MOST_PLANNED // workers)
        for step in islice(own.steps(before_first, (), share), most):
            decoder.begin(step.address)
            decoder.end(step.address)
            samples += 1
        requests, count = requests + ahead.requests, count + ahead.bytes
    return requests / samples, count / samples


def _decoding_s(pairs: StereoPairs, batch_size: int, *, workers: int, seconds: float) -> float:
    """Return the seconds of a core for a sample, measured once a third of the time has passed.

    Local data are loaded by a worker on each core, since workers share memory and caches, and
    counted is what each worker took for its samples. Of data behind a URL only the processor time
    is counted, of this process.
    """
    reads_url = is_remote(pairs.index.root)
    loader = pairs.loader(batch_size, num_workers=0 if reads_url else workers, drop_last=False)

    def done() -> tuple[int, float]:
        work = loader.work()
        spent_s = work.reading_s + work.decoding_s + work.making_s
        return work.samples, time.process_time() if reads_url else spent_s

    began_s, before = time.perf_counter(), None
    with contextlib.closing(loader):
        for _ in chain.from_iterable(repeat(loader)):
            passed_s = time.perf_counter() - began_s
            if before is None and passed_s > seconds / 3:
                before = done()
            elif before is not None and passed_s > seconds and done()[0] > before[0]:
                break
        samples, spent_s = done()
    before_samples, before_s = before or (0, 0.0)
    return (spent_s - before_s) / (samples - before_samples)


def _delay_ms(index: SceneIndex) -> float:
    """Return how long a server takes until the first byte, the median of five requests."""
    scene = index.scene(0)
    path = scene.members[min(scene.members)].path
    remote = RemoteObject(joined(index.root, path), retry=index.retry)
    remote.read(0, 1)  # connects
    return 1e3 * statistics.median(timeit.repeat(lambda: remote.read(0, 1), number=1, repeat=5))
