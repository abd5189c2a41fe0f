"""Packing a release: the plan, this part's shards, and the index once all shards are there.

Any number of processes on any number of machines may pack parts of one plan into one folder: they
need to agree on nothing but the plan, and that is a function of the release and the target size.
"""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from stereogenbench_data.engine.process_pool import run_tasks
from stereogenbench_data.errors import ShardError, cure_of
from stereogenbench_data.index.table import INDEX_NAME, SceneIndex, warn_if_stale
from stereogenbench_data.media.depth_frames import CODEC_NAME, blosc2_module
from stereogenbench_data.schema.records import Member, Scene, ShardFacts
from stereogenbench_data.schema.release import CAMERA_COUNT, PACKED_DEPTH_NAMES
from stereogenbench_data.shards.companion_files import write_foreign_indexes
from stereogenbench_data.shards.manifest import (
    PackedShard,
    ShardNote,
    ShardTask,
    find_packed,
    read_note,
)
from stereogenbench_data.shards.pack_folder import take_folder
from stereogenbench_data.shards.plan import (
    DEFAULT_SHARD_BYTES,
    DepthCodec,
    PlannedShard,
    ShardPlan,
    plan_shards,
)
from stereogenbench_data.shards.repack_check import require_same_rows, require_same_sources
from stereogenbench_data.shards.writer import found_whole, pack_task
from stereogenbench_data.sources.members import require_own_files

Progress = Callable[[int, int], None]


class OversizedSceneWarning(UserWarning):
    """Some scenes alone exceed the size that shards were to have: the message says which."""


@dataclass(frozen=True, slots=True)
class PackReport:
    """What a run of packing came to.

    Attributes:
        part: Names of the shards of this part, all of which are finished.
        packed: Names of those that this run packed, and not another before it or beside it.
        missing: Names of the plan's shards that other parts have not finished yet.
        index: The index file; None while shards are missing.
    """

    part: tuple[str, ...]
    packed: tuple[str, ...]
    missing: tuple[str, ...]
    index: Path | None


@dataclass(frozen=True, slots=True)
class PackJob:
    """One part of a plan, in the folder that it is packed into; `prepare` makes it."""

    index: SceneIndex
    plan: ShardPlan
    out: Path
    part: tuple[int, int]

    def task(self, shard: PlannedShard) -> ShardTask:
        """Return a shard as work for any process."""
        return ShardTask(shard, self.plan.root, str(self.out), self.plan.digest)

    @property
    def shards(self) -> tuple[PlannedShard, ...]:
        """The shards of this part: every N-th, from the I-th on."""
        number, count = self.part
        return self.plan.shards[number - 1 :: count]

    def unfinished(self) -> list[ShardTask]:
        """Return this part's tasks, without those that are done."""
        tasks = [self.task(shard) for shard in self.shards]
        return [task for task in tasks if find_packed(task) is None]


def pack(  # noqa: PLR0913 - each is an option of the command
    data: SceneIndex | str | Path,
    out: str | Path,
    *,
    target_bytes: int = DEFAULT_SHARD_BYTES,
    depth_codec: DepthCodec = "released",
    part: tuple[int, int] = (1, 1),
    workers: int | None = None,
    progress: Progress | None = None,
) -> PackReport:
    """Pack a release into tar shards, or one part of it.

    Shards that are finished are kept, so that a run that was stopped goes on if it is run again.
    The same release and target give the same bytes, whatever the parts and the workers.

    Args:
        data: The release: its folder or index.
        out: Folder for the shards; made if need be.
        target_bytes: The size that a shard does not exceed, unless one scene alone does; depth
            that is packed anew counts with its released size.
        depth_codec: "released" keeps depth as it is; "blosc2" packs it so that each frame stands
            alone and decodes faster, bit for bit (extra ``blosc2``).
        part: (I, N): pack every N-th shard, from the I-th on; I is 1 to N.
        workers: Processes that pack at the same time; None is one a core.
        progress: Called now and then with the bytes packed of this part, and all there are.

    Returns:
        What was packed; the index is written by whichever part is finished last.

    Raises:
        StorageError: If the release cannot be read or scenes of it are broken, or a worker died.
        ShardError: If a shard cannot be packed, or the folder lies in the release, or it holds
            anything else than this plan or shards that were packed from other files.
    """
    job = prepare(data, out, target_bytes=target_bytes, depth_codec=depth_codec, part=part)
    tasks = job.unfinished()
    after_bytes = packed_counter(job, tasks, progress)
    outcomes = run_tasks(pack_task, tasks, workers=workers, after_bytes=after_bytes)
    return finish(job, packed=[each.shard.name for each in outcomes if each.work == "packed"])


def prepare(
    data: SceneIndex | str | Path,
    out: str | Path,
    *,
    target_bytes: int,
    part: tuple[int, int],
    depth_codec: DepthCodec = "released",
) -> PackJob:
    """Make the plan and take the folder for it.

    Raises:
        StorageError: If the release cannot be read or scenes of it are broken.
        ShardError: If the folder lies in the release, holds anything else than this plan or
            shards that were packed from other files; if no scene fits into a shard, or there is
            no such part.
        ExtraError: If the codec needs something that is not installed.
    """
    number, count = part
    if not 1 <= number <= count:
        raise ShardError(f"part {number}/{count}: a part is I/N with I from 1 to N, such as 1/4.")
    index = data if isinstance(data, SceneIndex) else SceneIndex.open(data)
    if depth_codec == "blosc2":
        blosc2_module()
    plan = plan_shards(index, target_bytes, depth_codec=depth_codec)
    require_own_files(
        plan.root, (member.source for shard in plan.shards for member in shard.members)
    )
    job = PackJob(index, plan, Path(out), part)
    _require_fitting(job.plan)
    try:
        take_folder(job.plan, job.out)
        for task, note in _noted(job):
            require_same_sources(task, note)
            require_same_rows(task, note)
    except OSError as error:
        if isinstance(error, ShardError):
            raise
        raise ShardError(
            f"{out}: cannot be written to ({error.strerror or error}). "
            + cure_of(error, "Pack into another folder.")
        ) from error
    return job


def _require_fitting(plan: ShardPlan) -> None:
    """Warn of scenes that exceed the size of a shard; refuse a size that none fits into."""
    above = plan.oversized
    if not above:
        return
    sizes = {shard.size: shard.keys[0] for shard in above}
    least, most = min(sizes), max(sizes)
    if len(above) == len(plan.shards):
        raise ShardError(
            f"no scene fits into a shard of {plan.target_bytes} bytes: the smallest, "
            f"{sizes[least]}, needs {least}. Choose a larger size of shards."
        )
    warnings.warn(
        f"{len(above)} of {len(plan.shards)} shards exceed {plan.target_bytes} bytes, each by the "
        f"one scene it holds: the largest, {sizes[most]}, needs {most}",
        OversizedSceneWarning,
        stacklevel=3,
    )


def finish(job: PackJob, *, packed: list[str]) -> PackReport:
    """Write the index, if all shards of the plan are there by now.

    Raises:
        StorageError: If the index cannot be written.
        ShardError: If it would tell scenes otherwise than their shards do.
    """
    done = {
        task.shard.name: find_packed(task) or found_whole(task, lambda count: None)
        for task in map(job.task, job.plan.shards)
    }
    missing = tuple(name for name, found in done.items() if found is None)
    target = None if missing else job.out / INDEX_NAME
    if target is not None:
        for task, note in _noted(job):
            require_same_rows(task, note)
        shards = {name: found for name, found in done.items() if found is not None}
        index = packed_index(job, shards)
        # The index comes last: where there is one, everything is.
        write_foreign_indexes(index, out=job.out)
        index.write(target)
        warn_if_stale(job.out)
    part = tuple(shard.name for shard in job.shards)
    return PackReport(part, tuple(name for name in part if name in packed), missing, target)


def packed_index(job: PackJob, shards: dict[str, PackedShard]) -> SceneIndex:
    """Return the index of finished shards: the scenes of the release, at their new places."""
    facts = {
        shard.name: ShardFacts(
            size=shards[shard.name].size,
            sha256=shards[shard.name].sha256,
            members=len(shard.members),
        )
        for shard in job.plan.shards
    }
    moved = [scene for shard in job.plan.shards for scene in _moved(shard, shards[shard.name])]
    return SceneIndex.from_scenes(moved, job.out, shards=facts)


def _moved(shard: PlannedShard, packed: PackedShard) -> Iterator[Scene]:
    places: dict[str, dict[str, Member]] = {key: {} for key in shard.keys}
    placed = zip(packed.offsets, packed.sizes, packed.crc32s, strict=True)
    for member, (offset, size, crc32) in zip(shard.members, placed, strict=True):
        key, _, name = member.name.partition(".")
        places[key][name] = Member(shard.name, offset, size, crc32)
    for scene in shard.scenes:
        members = places[scene.id.key]
        is_packed = not members.keys().isdisjoint(PACKED_DEPTH_NAMES.values())
        codec = (CODEC_NAME,) * CAMERA_COUNT if is_packed else scene.depth_codec
        yield replace(scene, members=members, depth_codec=codec)


def _noted(job: PackJob) -> Iterator[tuple[ShardTask, ShardNote]]:
    """Yield every shard of the plan that is finished, of whatever part."""
    for task in map(job.task, job.plan.shards):
        note = read_note(task)
        if note is not None and task.target.is_file():
            yield task, note


def packed_counter(
    job: PackJob, tasks: list[ShardTask], progress: Progress | None
) -> Callable[[int], None]:
    """Return what counts bytes of members, beginning with those that were packed before."""
    sizes = {shard.name: sum(member.size for member in shard.members) for shard in job.shards}
    total = sum(sizes.values())
    done = total - sum(sizes[task.shard.name] for task in tasks)

    def after_bytes(count: int) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress(min(done, total), total)

    after_bytes(0)
    return after_bytes
