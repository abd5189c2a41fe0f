"""Packing a release: the plan, this part's shards, and the index once all shards are there.

Any number of processes on any number of machines may pack parts of one plan into one folder: they
need to agree on nothing but the plan, and that is a function of the release and the target size.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from stereogenbench_data.errors import ShardError
from stereogenbench_data.schema.records import Member, Scene, ShardFacts
from stereogenbench_data.storage.foreign_index import write_foreign_indexes
from stereogenbench_data.storage.index import INDEX_NAME, SceneIndex
from stereogenbench_data.storage.pool import run_tasks
from stereogenbench_data.storage.shard_plan import (
    DEFAULT_SHARD_BYTES,
    PlannedShard,
    ShardPlan,
    plan_shards,
)
from stereogenbench_data.storage.shard_writer import (
    UNFINISHED,
    PackedShard,
    ShardTask,
    find_packed,
    pack_task,
)
from stereogenbench_data.storage.unfinished import PARTS, write_whole

Progress = Callable[[int, int], None]

_PLAN_NOTE: Final = "plan.json"


@dataclass(frozen=True, slots=True)
class PackReport:
    """What a run of packing came to.

    Attributes:
        part: Names of the shards of this part, all of which are finished.
        packed: Names of those that were not finished when this run began.
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


def pack(
    data: SceneIndex | str | Path,
    out: str | Path,
    *,
    target_bytes: int = DEFAULT_SHARD_BYTES,
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
        target_bytes: The size that a shard does not exceed, unless one scene alone does.
        part: (I, N): pack every N-th shard, from the I-th on; I is 1 to N.
        workers: Processes that pack at the same time; None is one a core.
        progress: Called now and then with the bytes packed of this part, and all there are.

    Returns:
        What was packed; the index is written by whichever part is finished last.

    Raises:
        StorageError: If the release cannot be read or scenes of it are broken, or a worker died.
        ShardError: If a shard cannot be packed, or the folder holds anything else than this plan.
    """
    job = prepare(data, out, target_bytes=target_bytes, part=part)
    tasks = job.unfinished()
    after_bytes = packed_counter(job, tasks, progress)
    for _ in run_tasks(pack_task, tasks, workers=workers, after_bytes=after_bytes):
        pass
    return finish(job, packed=[task.shard.name for task in tasks])


def prepare(
    data: SceneIndex | str | Path, out: str | Path, *, target_bytes: int, part: tuple[int, int]
) -> PackJob:
    """Make the plan and take the folder for it.

    Raises:
        StorageError: If the release cannot be read or scenes of it are broken.
        ShardError: If the folder holds anything else than this plan, or there is no such part.
    """
    number, count = part
    if not 1 <= number <= count:
        raise ShardError(f"part {number}/{count}: a part is I/N with I from 1 to N, such as 1/4.")
    index = data if isinstance(data, SceneIndex) else SceneIndex.open(data)
    job = PackJob(index, plan_shards(index, target_bytes), Path(out), part)
    try:
        _take_folder(job)
    except OSError as error:
        if isinstance(error, ShardError):
            raise
        raise ShardError(
            f"{out}: cannot be written to ({error.strerror or error}). Give write permission, or "
            f"pack into another folder."
        ) from error
    return job


def finish(job: PackJob, *, packed: list[str]) -> PackReport:
    """Write the index, if all shards of the plan are there by now.

    Raises:
        StorageError: If the index cannot be written.
    """
    done = {shard.name: find_packed(job.task(shard)) for shard in job.plan.shards}
    missing = tuple(name for name, found in done.items() if found is None)
    target = None if missing else job.out / INDEX_NAME
    if target is not None:
        shards = {name: found for name, found in done.items() if found is not None}
        packed_index(job, shards).write(target)
        write_foreign_indexes(job.plan, shards, out=job.out)
    part = tuple(shard.name for shard in job.shards)
    return PackReport(part, tuple(packed), missing, target)


def packed_index(job: PackJob, shards: dict[str, PackedShard]) -> SceneIndex:
    """Return the index of finished shards: the scenes of the release, at their new places."""
    scenes = {scene.id.key: scene for scene in map(job.index.scene, range(len(job.index)))}
    facts = {
        shard.name: ShardFacts(
            size=shards[shard.name].size,
            sha256=shards[shard.name].sha256,
            members=len(shard.members),
        )
        for shard in job.plan.shards
    }
    moved = [
        scene
        for shard in job.plan.shards
        for scene in _moved(shard, shards[shard.name], scenes=scenes)
    ]
    return SceneIndex.from_scenes(moved, job.out, shards=facts)


def _moved(
    shard: PlannedShard, packed: PackedShard, *, scenes: dict[str, Scene]
) -> Iterator[Scene]:
    places: dict[str, dict[str, Member]] = {key: {} for key in shard.keys}
    for member, offset, crc32 in zip(shard.members, packed.offsets, packed.crc32s, strict=True):
        key, _, name = member.name.partition(".")
        places[key][name] = Member(shard.name, offset, member.size, crc32)
    for key, members in places.items():
        yield replace(scenes[key], members=members)


def _take_folder(job: PackJob) -> None:
    """Note the plan in the folder, or find it noted there; refuse what other plans left."""
    note = job.out / PARTS / _PLAN_NOTE
    told = {
        "plan": job.plan.digest,
        "target_bytes": job.plan.target_bytes,
        "shards": len(job.plan.shards),
    }
    if job.out.resolve() == Path(job.plan.root).resolve():
        raise ShardError(f"{job.out}: is the release itself. Pack into another folder.")
    note.parent.mkdir(parents=True, exist_ok=True)
    if not note.exists():
        _require_no_shards(job)
        write_whole(note, json.dumps(told).encode())
    try:
        found = json.loads(note.read_bytes())
    except ValueError:
        found = None
    if found != told:
        raise ShardError(
            f"{note}: this folder was begun with another plan ({_brief(found)}, and this one is "
            f"{_brief(told)}): the release or the size of the shards was another. Pack into an "
            f"empty folder, or remove what is in {job.out}."
        )
    _require_no_shards(job, but=frozenset(shard.name for shard in job.plan.shards))


def _brief(told: object) -> str:
    if not isinstance(told, dict):
        return "unreadable"
    plan, size = str(told.get("plan"))[:12], told.get("target_bytes")
    return f"{told.get('shards')} shards of {size} bytes, {plan}"


def _require_no_shards(job: PackJob, *, but: frozenset[str] = frozenset()) -> None:
    if not but and (job.out / INDEX_NAME).exists():
        raise ShardError(
            f"{job.out / INDEX_NAME}: is there, and was not packed here by this plan. Pack into "
            f"an empty folder."
        )
    for path in sorted(job.out.iterdir()):
        name = path.name.removesuffix(UNFINISHED)
        if name.endswith(".tar") and name not in but:
            raise ShardError(
                f"{path}: is there, and is no shard of this plan. Move it away, or pack into an "
                f"empty folder."
            )


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
