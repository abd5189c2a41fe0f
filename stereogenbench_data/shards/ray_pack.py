"""Packing on a Ray cluster: the same plan, one Ray task a shard. Needs the extra ``ray``."""

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from stereogenbench_data.errors import ExtraError, ShardError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.shards.manifest import ShardTask
from stereogenbench_data.shards.pack import (
    PackJob,
    PackReport,
    Progress,
    finish,
    packed_counter,
    prepare,
)
from stereogenbench_data.shards.plan import DEFAULT_SHARD_BYTES, DepthCodec
from stereogenbench_data.shards.writer import ShardOutcome, pack_task

_CANCEL_S: Final = 30.0
"""How long to wait for tasks that are called off to remove what they began."""


def pack_on_ray(
    data: SceneIndex | str | Path,
    out: str | Path,
    *,
    target_bytes: int = DEFAULT_SHARD_BYTES,
    depth_codec: DepthCodec = "released",
    part: tuple[int, int] = (1, 1),
    progress: Progress | None = None,
) -> PackReport:
    """Pack a release, or one part of it, as `pack.pack` does, by tasks of a Ray cluster.

    It is the cluster that Ray is connected to, or else one that runs already and that Ray finds
    by itself; none is started. Release and folder must be at the same paths on all its nodes.

    Args:
        data: The release: its folder or index.
        out: Folder for the shards, on storage that all nodes share.
        target_bytes: The size that a shard does not exceed, unless one scene alone does; depth
            that is packed anew counts with its released size.
        depth_codec: "released" keeps depth as it is; "blosc2" packs it, on nodes that have it.
        part: (I, N): pack every N-th shard, from the I-th on.
        progress: Called after each shard with the bytes packed of this part, and all there are.

    Raises:
        StorageError: If the release cannot be read or scenes of it are broken.
        ShardError: If Ray is not installed, runs nowhere or lost a task, a shard cannot be packed,
            or the folder holds anything else than this plan.
    """
    ray = _ray()
    with _connected(ray):
        job = prepare(data, out, target_bytes=target_bytes, depth_codec=depth_codec, part=part)
        packed = _packed(ray, job, progress)
    return finish(job, packed=packed)


def _ray() -> Any:
    try:
        return importlib.import_module("ray")
    except ImportError as error:
        raise ShardError(
            f"Ray cannot be imported ({error}): install `stereogenbench-data[ray]`, or pack "
            f"without it."
        ) from error


@contextmanager
def _connected(ray: Any) -> Iterator[None]:
    if ray.is_initialized():
        yield
        return
    try:
        ray.init(address="auto", log_to_driver=False)
    except ConnectionError as error:
        raise ShardError(
            f"no Ray cluster was found ({str(error).splitlines()[0]}): start one with `ray start "
            f"--head` and tell its address by RAY_ADDRESS, or pack without Ray."
        ) from error
    try:
        yield
    finally:
        ray.shutdown()


def _packed(ray: Any, job: PackJob, progress: Progress | None) -> list[str]:
    tasks = job.unfinished()
    after_bytes = packed_counter(job, tasks, progress)
    remote = ray.remote(max_retries=0)(_pack_quietly)
    running = {remote.remote(task): task for task in tasks}
    packed = []
    try:
        while running:
            done, _ = ray.wait(list(running), num_returns=1)
            for reference in done:
                task = running.pop(reference)
                if _result(ray, reference, task).work == "packed":
                    packed.append(task.shard.name)
                after_bytes(sum(member.size for member in task.shard.members))
    finally:
        for reference in running:
            ray.cancel(reference)
        if running:
            ray.wait(list(running), num_returns=len(running), timeout=_CANCEL_S)
    return packed


def _pack_quietly(task: ShardTask) -> ShardOutcome | str:
    """Pack one shard; an error of ours comes back as its text, without Ray's wrapping."""
    try:
        return pack_task(task, lambda count: None)
    except (ShardError, ExtraError) as error:
        return str(error)


def _result(ray: Any, reference: Any, task: ShardTask) -> ShardOutcome:
    try:
        outcome: ShardOutcome | str = ray.get(reference)
    except ray.exceptions.RayError as error:
        raise ShardError(
            f"{task.target}: Ray lost its task ({str(error).strip().splitlines()[0]}). Run the "
            f"same command again: finished shards are kept."
        ) from error
    if isinstance(outcome, str):
        raise ShardError(outcome)
    return outcome
