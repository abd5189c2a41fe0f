"""The contestants by name: the function that makes their batches, and the slice that they load."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final

from torch.utils.data import DataLoader

from benchmarks.contestants import naive, ours, random_access, scenewise
from benchmarks.workloads import Job, Reading, Workload

LIMIT: Final = "limit"
NAIVE: Final = "naive"
OURS: Final = "ours"


@dataclass(frozen=True, slots=True)
class Contestant:
    """One contestant.

    Attributes:
        name: Its name in results.
        title: Its name in tables.
        reading: The slice that it loads.
        batches: Returns the `DataLoader` for a job, with the given options.
        module: A module that it needs beside the package, if any.
    """

    name: str
    title: str
    reading: Reading
    batches: Callable[..., DataLoader[Any]]
    module: str | None = None


def _anywhere(dataset: Callable[[Job], Any]) -> Callable[..., DataLoader[Any]]:
    """Return a `DataLoader` of single samples, independent of each other."""
    return lambda job, **options: DataLoader(dataset(job), batch_size=1, **options)


def _forwards(dataset: Callable[[Job], Any]) -> Callable[..., DataLoader[Any]]:
    return lambda job, **options: DataLoader(dataset(job), batch_size=job.workload.batch, **options)


_TITLES: Final = {
    LIMIT: "limit: bare PyAV loop",
    NAIVE: "naive: the paper's snippet",
    "webdataset": "webdataset + decode step",
    "datasets": "HF datasets streaming + decode step",
    "torchcodec": "torchcodec RGB, PyAV depth",
    "decord": "decord RGB, PyAV depth",
    OURS: "ours, StereoPairs.loader",
    "ours-stream": "ours, StereoPairStream",
    "ours-shards": "ours, from shards",
}

_CONTESTANTS: Final = (
    Contestant(NAIVE, _TITLES[NAIVE], "anywhere", _anywhere(naive.NaivePairs)),
    Contestant(
        "webdataset", _TITLES["webdataset"], "forwards",
        _forwards(scenewise.webdataset_samples), "webdataset",
    ),
    Contestant(
        "datasets", _TITLES["datasets"], "forwards",
        _forwards(scenewise.hugging_face_samples), "datasets",
    ),
    Contestant(
        "torchcodec", _TITLES["torchcodec"], "anywhere",
        _anywhere(lambda job: random_access.KeptOpenPairs(job, random_access.TorchcodecVideo)),
        "torchcodec",
    ),
    Contestant(
        "decord", _TITLES["decord"], "anywhere",
        _anywhere(lambda job: random_access.KeptOpenPairs(job, random_access.DecordVideo)),
        "decord",
    ),
    Contestant(
        OURS, _TITLES[OURS], "forwards", lambda job, **o: ours.mapped(job, job.tree, **o)
    ),
    Contestant(
        "ours-stream", _TITLES["ours-stream"], "forwards",
        lambda job, **o: ours.streamed(job, job.tree, **o),
    ),
    Contestant(
        "ours-shards", _TITLES["ours-shards"], "forwards",
        lambda job, **o: ours.mapped(job, job.material.shards, **o),
    ),
)  # fmt: skip
CONTESTANTS: Final = {contestant.name: contestant for contestant in _CONTESTANTS}


def title(name: str) -> str:
    """Return the name of a contestant in tables."""
    return _TITLES[name]


def why_not(name: str) -> str | None:
    """Return why a contestant cannot race here, None where it can."""
    contestant = CONTESTANTS.get(name)
    if contestant is None or contestant.module is None:
        return None
    try:
        import_module(contestant.module)
    except (ImportError, RuntimeError, OSError) as error:
        return f"{contestant.module} cannot be imported: {str(error).splitlines()[0]}"
    return None


def entrants(workload: Workload) -> list[tuple[str, int]]:
    """Return the entrants of a workload: names, each with a number of worker processes.

    All contestants race with the first number of workers, the headline. With the others only the
    limit and ours race.
    """
    names = workload.field or (
        LIMIT, OURS, "ours-stream", NAIVE, "webdataset", "datasets", "torchcodec", "decord",
        *workload.more,
    )  # fmt: skip
    others = [(name, count) for count in workload.workers[1:] for name in (LIMIT, OURS)]
    return [(name, workload.workers[0]) for name in names] + others
