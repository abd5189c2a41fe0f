"""This package: the map-style dataset's loader, and the stream in torch's own `DataLoader`."""

from pathlib import Path
from typing import Any

from torch.utils.data import DataLoader

from benchmarks.workloads import SEED, Job
from stereogenbench_data import StereoPairs, StereoPairStream


def mapped(job: Job, data: Path | None = None, **options: Any) -> DataLoader[Any]:
    """Return the loader of `StereoPairs` with default options, from the released tree."""
    pairs = StereoPairs(data or job.tree, **job.selection)
    return pairs.loader(job.workload.batch, drop_last=False, seed=SEED, **options)


def from_shards(job: Job, **options: Any) -> DataLoader[Any]:
    """Return the same loader, from shards."""
    return mapped(job, job.material.shards, **options)


def streamed(job: Job, **options: Any) -> DataLoader[Any]:
    """Return torch's `DataLoader` of a `StereoPairStream` with the stream's own ``collate``."""
    stream = StereoPairStream(job.tree, job.workload.batch, drop_last=False, **job.selection)
    return DataLoader(stream, batch_size=job.workload.batch, collate_fn=stream.collate, **options)
