"""The contestants by name: the function that makes their batches, and the slice that they load."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any, Final, Literal

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
        title: Its name in tables.
        reading: The slice that it loads.
        batches: Returns the `DataLoader` for a job, with the given options; None of the limit,
            which has no batches.
        module: A module that it needs beside the package, if any.
        scenes: Whether it has all scenes of a workload that others go through in part.
    """

    title: str
    reading: Reading
    batches: Callable[..., DataLoader[Any]] | None
    module: str | None = None
    scenes: Literal["all", "part"] = "part"


def _torch(dataset: Callable[[Job], Any]) -> Callable[..., DataLoader[Any]]:
    """Return torch's own `DataLoader`; samples that are independent come one by one."""
    return lambda job, **options: DataLoader(
        dataset(job), batch_size=1 if job.reading == "anywhere" else job.workload.batch, **options
    )


_torchcodec = partial(random_access.KeptOpenPairs, video=random_access.TorchcodecVideo)
_decord = partial(random_access.KeptOpenPairs, video=random_access.DecordVideo)

CONTESTANTS: Final = {
    LIMIT: Contestant("limit: bare PyAV loop", "forwards", None),
    NAIVE: Contestant("naive: the paper's snippet", "anywhere", _torch(naive.NaivePairs)),
    "webdataset": Contestant(
        "webdataset + decode step", "forwards", _torch(scenewise.webdataset_samples), "webdataset"
    ),
    "datasets": Contestant(
        "HF datasets streaming + decode step", "forwards",
        _torch(scenewise.hugging_face_samples), "datasets",
    ),
    "torchcodec": Contestant(
        "torchcodec RGB, PyAV depth", "anywhere", _torch(_torchcodec), "torchcodec"
    ),
    "decord": Contestant("decord RGB, PyAV depth", "anywhere", _torch(_decord), "decord"),
    OURS: Contestant("ours, StereoPairs.loader", "forwards", ours.mapped, scenes="all"),
    "ours-stream": Contestant(
        "ours, StereoPairStream", "forwards", ours.streamed, scenes="all"
    ),
    "ours-shards": Contestant("ours, from shards", "forwards", ours.from_shards),
}  # fmt: skip


def unavailable(load: Callable[[], object]) -> str | None:
    """Return why a library cannot be imported here, None where it can."""
    try:
        load()
    except (ImportError, RuntimeError, OSError) as error:
        return f"cannot be imported: {str(error).splitlines()[0]}"
    return None


def why_not(name: str) -> str | None:
    """Return why a contestant cannot race here, None where it can."""
    module = CONTESTANTS[name].module
    reason = None if module is None else unavailable(partial(import_module, module))
    return None if reason is None else f"{module} {reason}"


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
