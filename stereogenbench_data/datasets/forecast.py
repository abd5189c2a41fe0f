"""What will limit a training: bytes by the index, decoding by this machine, the rest by a formula.

The bytes and requests of a sample follow from the selection, the fields, the order and the seek
tables of the index. What decoding takes is measured for seconds. `scaling` has the formula.
"""

import contextlib
import copy
import itertools
import math
import os
import statistics
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, TypeVar

import torch

from stereogenbench_data.datasets.batches import batch_samples
from stereogenbench_data.datasets.loader import PairsLoader
from stereogenbench_data.datasets.mapped import Data, StereoPairs
from stereogenbench_data.datasets.open_videos import (
    OpenVideosWarning,
    RepeatedDecodingWarning,
    open_scene_bytes,
    videos_to_keep,
)
from stereogenbench_data.datasets.scaling import Machine, Network, SampleCost, Scale, scale
from stereogenbench_data.errors import SelectionError, StorageError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.coming import Step
from stereogenbench_data.samples.fields import DEFAULT_PAIR_FIELDS
from stereogenbench_data.samples.load import SampleLoader
from stereogenbench_data.selection.order import EpochOrder
from stereogenbench_data.shards.pack import pack
from stereogenbench_data.shards.training import TrainingSettings
from stereogenbench_data.sources.fetch_ahead import FETCH_AHEAD_BYTES, PlannedFetches
from stereogenbench_data.sources.location import is_remote, joined
from stereogenbench_data.sources.remote import RemoteObject

ACCELERATORS: Final = (1, 8, 64, 512, 1000, 10_000)

REQUEST_CPU_S: Final = 0.0004
"""Processor seconds of a request over HTTP, measured; its bytes are copied besides."""

BYTE_CPU_S: Final = 2e-10
"""Processor seconds of a byte that comes over HTTP, measured."""

_MOST_PLANNED: Final = 16_384
"""Samples of a worker whose bytes are counted, where an epoch has more."""

_PREFETCHED: Final = 2
"""Batches that torch has each worker load ahead."""

_FEW_OPEN: Final[dict[str, Any]] = {"open_scenes": 2}
"""The order in which a part of a long epoch is measured: scenes are opened all the time."""

_SHORT: Final = 6
"""An epoch is measured whole, in its own order, if it takes less than this part of the time."""

_FAR: Final = "https://forecast.invalid"
"""What stands for the place of local data while their ranges are planned; it is never asked."""

_PROBES: Final = 5
_PROBE_BYTES: Final = 8_000_000

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a training needs, and what limits it.

    Attributes:
        samples: Samples of an epoch.
        batch_size: Samples of a batch.
        cost: What a sample takes, measured here.
        decoding_s: Of the processor time of a sample, what is not spent on HTTP.
        bytes_of: How bytes and requests were counted: "epoch", or "part" of it.
        measured_on: How many workers decoded at a time while the slowdown was measured; 0 if it was
            not, as the data are behind a URL.
        machine: Each machine.
        network: Where the data are.
        worker_bytes: Memory of a worker: what this process took, batches and what is fetched ahead.
        scales: For each number of accelerators what they need and get.
        training: The same with training shards, of which one scene was made and measured; None if
            that was not asked for.
        training_cost: What a sample of training shards takes; None without them.
    """

    samples: int
    batch_size: int
    cost: SampleCost
    decoding_s: float
    bytes_of: str
    measured_on: int
    machine: Machine
    network: Network
    worker_bytes: int
    scales: tuple[Scale, ...]
    training: tuple[Scale, ...] | None = None
    training_cost: SampleCost | None = None

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON; what is unlimited is null."""
        document: dict[str, Any] = _finite(asdict(self))
        return document


def forecast(  # noqa: PLR0913 - each names one thing that a user knows
    data: Data,
    *,
    samples_s: float,
    accelerators: Iterable[int] = ACCELERATORS,
    batch_size: int = 8,
    machine: Machine | None = None,
    network: Network | None = None,
    fields: Iterable[str] = DEFAULT_PAIR_FIELDS,
    size: tuple[int, int] | str | None = None,
    training: tuple[int, int] | None = None,
    measure_s: float = 6.0,
    **selection: Any,
) -> Forecast:
    """Forecast what will limit a training.

    Args:
        data: As for `StereoPairs`.
        samples_s: Samples a second that each accelerator takes.
        accelerators: Numbers of accelerators to forecast for.
        batch_size: Samples in a batch.
        machine: Each machine that trains; None is one with the cores of this machine and 8
            accelerators. Its cores count as fast as those here.
        network: Where the data will be; None measures the delay and the bandwidth of a connection
            where the data are behind a URL, and else is a disk that is never waited for.
        fields: As for `StereoPairs`.
        size: As for `StereoPairs`.
        training: (height, width) of training shards to compare with: one scene is derived in a
            temporary folder and measured. None compares with none.
        measure_s: How long to measure, in seconds.
        **selection: As for `StereoPairs`.

    Raises:
        SelectionError: If a number is out of its range, or nothing is selected.
        StorageError: If the index does not say where packets lie, or training shards are to be made
            of training shards.
    """
    if not 0 < measure_s < math.inf:
        raise SelectionError(f"measure_s must be seconds above 0, got {measure_s!r}.")
    index = data if isinstance(data, SceneIndex) else SceneIndex.open(data)
    fields, accelerators = tuple(fields), tuple(accelerators)
    if not accelerators:
        raise SelectionError("accelerators is empty: give numbers such as (1, 8, 64).")
    machine = machine or Machine(cores_here())
    network = network or (measured_network(index) if is_remote(index.root) else Network())
    options: dict[str, Any] = {"fields": fields, "size": size}
    if training is not None and index.is_derived:
        raise StorageError(
            f"{index.where}: holds {index.derivation}, and training shards are made of released "
            f"data. Leave training out, or pass the released data."
        )

    def described(pairs: StereoPairs) -> tuple[SampleCost, float, str, int, int]:
        requests, count, counted = planned_bytes(
            pairs, batch_size, workers=machine.workers, connections=network.connections
        )
        cost, memory, workers = _measured(pairs, batch_size, seconds=measure_s)
        cost, decoding = replace(cost, bytes=count, requests=requests), cost.cpu_s
        if not is_remote(pairs.index.root) and network != Network():
            http_s = requests * REQUEST_CPU_S + count * BYTE_CPU_S
            cost = replace(cost, cpu_s=cost.cpu_s + http_s)
        return cost, decoding, counted, memory, workers

    def scales(cost: SampleCost) -> tuple[Scale, ...]:
        return tuple(
            scale(cost, machine, network, accelerators=each, samples_s=samples_s)
            for each in accelerators
        )

    pairs = StereoPairs(index, **options, **selection)
    cost, decoding, bytes_of, memory, workers = described(pairs)
    if network != Network():
        memory += FETCH_AHEAD_BYTES
    found = Forecast(
        len(pairs), batch_size, cost, decoding, bytes_of, workers, machine, network, memory,
        scales(cost),
    )  # fmt: skip
    if training is None:
        return found
    with TemporaryDirectory() as folder:
        derived = _derived_scene(pairs, Path(folder), size=training)
        chosen = {name: selection[name] for name in _OF_PAIRS if name in selection}
        training_cost = described(StereoPairs(derived, **options, **chosen))[0]
    return replace(found, training=scales(training_cost), training_cost=training_cost)


_OF_PAIRS: Final = ("pairs", "direction", "baseline_cm", "frames")


def cores_here() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def measured_network(index: SceneIndex) -> Network:
    """Return the delay of the server that has some data, and the bandwidth of one connection.

    Raises:
        StorageError: If it cannot be read.
    """
    members = [index.scene(0).members[name] for name in sorted(index.scene(0).members)]
    path = members[0].path
    remote = RemoteObject(joined(index.root, path), retry=index.retry)
    remote.read(0, 1)  # connects
    delays = []
    for _ in range(_PROBES):
        began_s = time.perf_counter()
        remote.read(0, 1)
        delays.append(time.perf_counter() - began_s)
    shard = index.shards.get(path)
    stop = min(_PROBE_BYTES, members[0].size if shard is None else shard.size)
    began_s = time.perf_counter()
    remote.read(0, stop)
    delay_s = statistics.median(delays)
    took_s = time.perf_counter() - began_s - delay_s
    # Where the bytes come as fast as the delay varies, nothing is known of the bandwidth.
    bytes_s = stop / took_s if took_s > max(delays) - min(delays) else math.inf
    return Network(delay_s=delay_s, connection_bytes_s=bytes_s)


def planned_bytes(
    pairs: StereoPairs, batch_size: int, *, workers: int, connections: int, **order: Any
) -> tuple[float, float, str]:
    """Return the requests and the bytes of a sample, by the index, and what was counted.

    Args:
        pairs: The samples.
        batch_size: Samples in a batch.
        workers: Worker processes that share the batches.
        connections: Requests that each makes at a time.
        **order: As for ``loader``.

    Raises:
        StorageError: If the index does not say where packets lie.
    """
    index = _far(pairs.index)
    loader = _loader(pairs, batch_size, **order)
    batches, plan = loader.batches, pairs.plan
    videos = _quietly(
        lambda: videos_to_keep(plan, batches.rule, streams=pairs._streams, processes=workers)
    )
    whole = len(plan) <= _MOST_PLANNED
    requests = count = samples = 0
    for worker in range(workers if whole else 1):
        numbers = range(worker, batches.end(), workers)
        most = len(plan) if whole else _MOST_PLANNED
        # What is open from the start to the end counts too much in a part of an epoch.
        before = 0 if whole else most // 4
        ahead = PlannedFetches()
        decoder = SampleLoader(index, pairs.request, check="metadata", frames="shared", ahead=ahead)
        decoder.keep_open(videos, frames=batches.rule.open_frames)
        decoder.expect(_steps(pairs, batches, numbers))
        steps = itertools.islice(_steps(pairs, batches, numbers), most)
        for place, step in enumerate(steps):
            if place == before:
                requests, count = requests - ahead.requests, count - ahead.bytes
            decoder.begin(step.address)
            decoder.end(step.address)
            samples += place >= before
        requests, count = requests + ahead.requests, count + ahead.bytes
    samples = max(1, samples)
    return requests / samples, count / samples, "epoch" if whole else "part"


def _steps(pairs: StereoPairs, batches: Any, numbers: Iterable[int]) -> Iterable[Step]:
    order = EpochOrder(pairs.plan.runs, batches.rule, epoch=0)
    for number in numbers:
        samples, ends = batch_samples(order, number, tail=batches.tail)
        for each in samples:
            address = pairs.plan.locate(each, epoch=0, group=number % order.groups)
            yield Step(address, each in ends)


def _far(index: SceneIndex) -> SceneIndex:
    """Return an index whose ranges can be planned, wherever the data are."""
    if not index.load_seek_tables():
        raise StorageError(
            f"{index.where}: its index does not say where the packets of videos lie, so the bytes "
            f"of a sample are not known. Make the index again: `stereogenbench index` for a "
            f"released tree, `stereogenbench unpack` and `pack` for shards."
        )
    if is_remote(index.root):
        return index
    twin = copy.copy(index)
    twin.root = _FAR
    return twin


def _loader(pairs: StereoPairs, batch_size: int, **options: Any) -> PairsLoader:
    options = {"tail": "uneven"} | options
    return _quietly(lambda: pairs.loader(batch_size, **options))


def _quietly(make: Callable[[], _T]) -> _T:
    """Return what is made, without advice on the number of workers: none trains here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RepeatedDecodingWarning)
        warnings.simplefilter("ignore", OpenVideosWarning)
        warnings.filterwarnings("ignore", message="This DataLoader will create")
        return make()


def _measured(
    pairs: StereoPairs, batch_size: int, *, seconds: float
) -> tuple[SampleCost, int, int]:
    """Return what decoding takes, a worker's memory, and how many workers slowed each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as in workers
    try:
        order: dict[str, Any] = _FEW_OPEN | {"shuffle_groups": 1}
        with contextlib.closing(_loader(pairs, batch_size, **order)) as loader:
            alone_s, _ = _seconds_a_sample(loader, time.process_time, seconds=seconds / 8)
        is_short = alone_s * len(pairs) < seconds / _SHORT
        if is_short:
            order = {}
        with_one = _loader(pairs, batch_size, **order)
        alone_s, batch_bytes = _seconds_a_sample(with_one, time.process_time, seconds=seconds / 2)
        with_one.close()
        rule = _loader(pairs, batch_size).batches.rule
        open_scenes = rule.most_open(pairs.plan.runs.lengths)
        memory = _own_bytes() + (_PREFETCHED + 1) * batch_bytes
        memory += open_scenes * open_scene_bytes(pairs.index, pairs.plan)
        if is_remote(pairs.index.root):
            return SampleCost(alone_s, 0, 0), memory, 0
        workers, found = min(cores_here(), len(with_one)), []
        for number in sorted({1, workers}):
            loader = _loader(
                pairs,
                batch_size,
                num_workers=number,
                persistent_workers=True,
                **(order if is_short else _FEW_OPEN | {"shuffle_groups": number}),
            )
            took_s, _ = _seconds_a_sample(loader, time.perf_counter, seconds=seconds / 4)
            loader.close()
            found.append(took_s * number)
    finally:
        torch.set_num_threads(threads)
    # A worker takes what decoding takes, and a little to hand over its batches.
    cpu_s = max(alone_s, found[0])
    return SampleCost(cpu_s, 0, 0, slowdown=max(1.0, found[-1] / cpu_s)), memory, workers


def _seconds_a_sample(
    loader: PairsLoader, clock: Callable[[], float], *, seconds: float
) -> tuple[float, int]:
    """Return the seconds a sample takes by a clock, and the bytes of a batch.

    Whole passes are timed, after one. Where a pass takes longer, its batches after a third of the
    time are timed: videos are open by then.
    """
    began_s = time.perf_counter()
    spent_s, samples, batch_bytes, passes, is_long = 0.0, 0, 0, 0, False
    while not samples or time.perf_counter() - began_s < seconds:
        start_s, taken = clock(), 0
        for batch in loader:
            tensors = [each for each in batch.values() if isinstance(each, torch.Tensor)]
            batch_bytes = batch_bytes or sum(each.nbytes for each in tensors)
            waited_s = time.perf_counter() - began_s
            if passes == 0 and not is_long and waited_s > seconds / 3:
                is_long, start_s, taken = True, clock(), 0
                continue
            taken += len(tensors[0])
            if is_long and waited_s > seconds:
                break
        if (passes or is_long) and taken:
            spent_s, samples = spent_s + clock() - start_s, samples + taken
        passes += 1
    return spent_s / samples, batch_bytes


def _own_bytes() -> int:
    """Return the most memory that this process had; 0 where the system does not say."""
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _derived_scene(pairs: StereoPairs, folder: Path, *, size: tuple[int, int]) -> SceneIndex:
    """Return training shards of the first selected scene, with the cameras that its pairs need."""
    plan = pairs.plan
    first = [plan.locate(number, epoch=0) for number in range(int(plan.first_pair[1]))]
    cameras = sorted({camera for each in first for camera in (each.source, *each.targets)})
    row = int(plan.scene_rows[0])
    shards = folder / "shards"
    settings = TrainingSettings(size, cameras=tuple(cameras))
    pack(pairs.index, shards, training=settings, rows=[row], workers=1)
    return SceneIndex.open(shards)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _finite(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
