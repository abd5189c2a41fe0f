"""How an epoch is divided among ranks and their workers, and what is told where that is costly."""

import math
import os
import warnings
from contextlib import suppress
from typing import Literal, NamedTuple

import torch.distributed
from torch.utils.data import get_worker_info

from stereogenbench_data.errors import SelectionError, users_level
from stereogenbench_data.samples.load import OPEN_STREAMS
from stereogenbench_data.selection.filters import whole_number
from stereogenbench_data.selection.order import EpochOrder

SPARE_FILES = 128
"""Open files that are left to everything else."""


class WorkerShare(NamedTuple):
    """Which samples of its rank's batches one of a rank's workers decodes.

    Attributes:
        rank: The rank, from 0.
        world_size: How many ranks there are.
        worker: The worker, from 0.
        workers: How many the rank has.
        of: "streams": those of its own streams, of every batch, as `EpochOrder.workers_of` deals
            them. "batches": all of every batch in turn.
    """

    rank: int
    world_size: int
    worker: int
    workers: int
    of: Literal["streams", "batches"]

    @classmethod
    def of_this_process(cls, rank: int, world_size: int) -> "WorkerShare":
        """Return what this process decodes of the batches that it, or a worker, takes in turn."""
        info = get_worker_info()
        worker, workers = (0, 1) if info is None else (info.id, info.num_workers)
        return cls(rank, world_size, worker, workers, "batches")

    @property
    def batches_apart(self) -> int:
        """How far the numbers of two batches lie apart that it decodes one after the other."""
        return self.world_size * (self.workers if self.of == "batches" else 1)

    def groups(self, order: EpochOrder) -> range:
        """Return the shuffle groups of the batches that it reads, wholly or in parts."""
        first = self.rank + (self.world_size * self.worker if self.of == "batches" else 0)
        apart = math.gcd(order.groups, self.batches_apart)
        return range(first % apart, order.groups, apart)

    def open_runs(self, order: EpochOrder) -> int:
        """Return how many runs of frames, of videos or of their parts, it has open at the most."""
        of_rank = order.open_runs(self.groups(order))
        return of_rank if self.of == "batches" else -(-of_rank // self.workers)


def torchs_group() -> tuple[int, int] | None:
    """Return rank and world size as torch.distributed says, None where it is not initialised."""
    if torch.distributed.is_available() and torch.distributed.is_initialized():
        return torch.distributed.get_rank(), torch.distributed.get_world_size()
    return None


class UnsharedRanksWarning(UserWarning):
    """Several ranks were started, and nothing tells their numbers, so each gets all batches."""


def require_group(rank: int | None, world_size: int | None) -> tuple[int, int]:
    """Return rank and world size, given or as torch.distributed says."""
    if rank is None and world_size is None:
        group, ranks = torchs_group(), os.environ.get("WORLD_SIZE", "")
        if group is None and ranks.isdecimal() and int(ranks) > 1 and get_worker_info() is None:
            warnings.warn(
                f"WORLD_SIZE says that {ranks} ranks were started, and there is no process group, "
                f"so each of them reads all batches. Make loaders after init_process_group, or "
                f"give rank= and world_size=; rank=0, world_size=1 reads all without a word.",
                UnsharedRanksWarning,
                stacklevel=users_level(),
            )
        return group or (0, 1)
    numbers = whole_number(rank), whole_number(world_size)
    if numbers[0] is None or numbers[1] is None or not 0 <= numbers[0] < numbers[1]:
        raise SelectionError(
            f"rank must be a number from 0 below world_size, and both be given: got rank={rank!r}, "
            f"world_size={world_size!r}."
        )
    return numbers[0], numbers[1]


class OpenVideosWarning(UserWarning):
    """More videos are needed at a time than this process may open: some are opened repeatedly."""


class RepeatedDecodingWarning(UserWarning):
    """Several processes read the same shuffle group, so each of them decodes its videos."""


class IdleWorkersWarning(UserWarning):
    """A loader has more workers than open scenes, so some have nothing to do."""


def warn_of_division(order: EpochOrder, share: WorkerShare, *, videos_per_scene: int) -> None:
    """Warn where processes decode the same videos, have nothing to do, or may not open enough.

    Args:
        order: The order of an epoch.
        share: How they are divided among its workers.
        videos_per_scene: How many videos of an open scene are read.
    """
    if not (order.rule.shuffle and videos_per_scene):
        return
    readers, groups = share.batches_apart, share.groups(order)
    together, scenes = readers // math.gcd(order.groups, readers), len(order.runs.pairs)
    cure = "Use fewer ranks or a smaller batch_size: ranks times batch at most the scenes."
    is_avoidable = True
    if share.of == "batches":
        cure = "Use pairs.loader(...), whose workers share the videos out, or shuffle_groups="
        cure += f"{readers}, which is another order."
        is_avoidable = readers * order.rule.batch_size <= scenes
    if together > 1 and is_avoidable and order.runs.lengths.max() > 1:
        warnings.warn(
            f"every video is decoded {together} times, as {readers} processes read {order.groups} "
            f"shuffle groups of {scenes} runs of frames. {cure}",
            RepeatedDecodingWarning,
            stacklevel=users_level(),
        )
    open_scenes = order.open_runs(groups)
    if share.of == "streams" and share.workers > open_scenes:
        warnings.warn(
            f"{share.workers - open_scenes} of {share.workers} workers have nothing to do: a "
            f"rank has {open_scenes} scenes open at a time, and one worker decodes a scene. "
            f"Use num_workers={open_scenes}, or open_scenes="
            f"{-(-share.workers // len(groups))} where there are as many scenes.",
            IdleWorkersWarning,
            stacklevel=users_level(),
        )
    wanted, allowed = share.open_runs(order) * videos_per_scene, videos_allowed()
    if wanted > allowed:
        warnings.warn(
            f"up to {wanted} videos would be open at a time, and this process may open {allowed}: "
            "they will be closed and opened again, which is slow. Raise the limit (`ulimit -n "
            f"{wanted + SPARE_FILES}`), use more workers, or fewer open_scenes than "
            f"{order.rule.open_scenes}.",
            OpenVideosWarning,
            stacklevel=users_level(),
        )


def videos_allowed() -> int:
    """Return how many videos this process may have open."""
    files = 512  # where the system does not say
    with suppress(ImportError):
        import resource

        files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return max(OPEN_STREAMS, files - SPARE_FILES)
