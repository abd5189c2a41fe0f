"""Pack a release into shards: the plan, this part's shards, and the index once all are there.

Any number of processes on any number of machines may pack parts of one plan into one folder: they
need to agree on nothing but the plan, and that is a function of the release and the target size.
"""

import json
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from stereogenbench_data.engine import LOCAL, Engine, Progress, advance_of, no_advance
from stereogenbench_data.errors import ShardError, cure_of
from stereogenbench_data.index.open import warn_if_stale
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.media.depth_frames import CODEC_NAME, blosc2_module
from stereogenbench_data.schema.records import Member, Scene, ShardFacts
from stereogenbench_data.schema.release import CAMERA_COUNT, METADATA_FILES, PACKED_DEPTH_NAMES
from stereogenbench_data.shards.companion_files import write_companion_files
from stereogenbench_data.shards.manifest import (
    PARTS,
    PackedShard,
    ShardManifest,
    ShardTask,
    SourceStamp,
    find_packed,
    read_manifest,
    row_digest,
)
from stereogenbench_data.shards.plan import (
    DEFAULT_SHARD_BYTES,
    DepthCodec,
    PlannedShard,
    ShardPlan,
    plan_shards,
)
from stereogenbench_data.shards.tar import read_members
from stereogenbench_data.shards.writer import (
    UNFINISHED,
    found_whole,
    pack_task,
    require_indexed_metadata,
)
from stereogenbench_data.sources.files import write_atomic
from stereogenbench_data.sources.members import require_own_files

_PLAN_FILE: Final = "plan.json"
_CHUNK_BYTES: Final = 4 * 1024 * 1024


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
    engine: Engine = LOCAL,
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
        engine: Where they are: `engine.LOCAL`, or an `engine.RayCluster`, of which all nodes find
            release and folder at the same paths.
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
    total = sum(shard.source_bytes for shard in job.shards)
    left = sum(task.shard.source_bytes for task in tasks)
    advance = advance_of(progress, done=total - left, total=total)
    advance(0)
    outcomes = engine.map(
        pack_task,
        tasks,
        name=lambda task: str(task.target),
        workers=workers,
        advance=advance,
    )
    return _finish(job, packed=[each.shard.name for each in outcomes if each.work == "packed"])


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
        _claim_folder(job.plan, job.out)
        for task, manifest in _finished(job):
            _require_same_sources(task, manifest)
            _require_same_rows(task, manifest)
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


def _finish(job: PackJob, *, packed: list[str]) -> PackReport:
    """Write the index, if all shards of the plan are there by now.

    Raises:
        StorageError: If the index cannot be written.
        ShardError: If it would contradict the metadata in the shards.
    """
    done = {
        task.shard.name: find_packed(task) or found_whole(task, no_advance)
        for task in map(job.task, job.plan.shards)
    }
    missing = tuple(name for name, found in done.items() if found is None)
    target = None if missing else job.out / INDEX_NAME
    if target is not None:
        for task, manifest in _finished(job):
            _require_same_rows(task, manifest)
        shards = {name: found for name, found in done.items() if found is not None}
        index = _packed_index(job, shards)
        # The index comes last: where there is one, everything is.
        write_companion_files(index, out=job.out)
        index.write(target)
        warn_if_stale(job.out)
    part = tuple(shard.name for shard in job.shards)
    return PackReport(part, tuple(name for name in part if name in packed), missing, target)


def _packed_index(job: PackJob, shards: dict[str, PackedShard]) -> SceneIndex:
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


def _finished(job: PackJob) -> Iterator[tuple[ShardTask, ShardManifest]]:
    """Yield every finished shard of the plan, of whatever part, with its manifest."""
    for task in map(job.task, job.plan.shards):
        manifest = read_manifest(task)
        if manifest is not None and task.target.is_file():
            yield task, manifest


# The folder that shards are packed into: which plan it is for, and that nothing else is in it.


def _claim_folder(plan: ShardPlan, out: Path) -> None:
    """Write the plan into the folder, unless it is there; refuse before anything is written.

    Raises:
        ShardError: If the folder lies in the release, or holds what other plans left.
        OSError: If it cannot be written to.
    """
    place = out / PARTS / _PLAN_FILE
    expected = {
        "plan": plan.digest,
        "target_bytes": plan.target_bytes,
        "shards": len(plan.shards),
    } | ({} if plan.depth_codec == "released" else {"depth": plan.depth_codec})
    _require_beside_release(plan, out)
    if not place.exists():
        _require_own_shards(plan, out)
        place.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(place, json.dumps(expected).encode())
    try:
        found = json.loads(place.read_bytes())
    except ValueError:
        found = None
    if found != expected:
        raise ShardError(
            f"{place}: this folder was begun with another plan ({_brief(found)}, and this one is "
            f"{_brief(expected)}): the release, the size of the shards or the depth codec was "
            f"another. Pack into an empty folder, or remove what is in {out}."
        )
    _require_no_others(plan, out)


def _brief(content: object) -> str:
    if not isinstance(content, dict):
        return "unreadable"
    plan, size = str(content.get("plan"))[:12], content.get("target_bytes")
    depth = content.get("depth", "released")
    return f"{content.get('shards')} shards of {size} bytes, depth {depth}, {plan}"


def _require_beside_release(plan: ShardPlan, out: Path) -> None:
    root, place = Path(plan.root).resolve(), out.resolve()
    if place == root:
        raise ShardError(f"{out}: is the release itself. Pack into another folder.")
    for split in ("train", "eval"):
        if any(place.is_relative_to(each) for each in (root / split, (root / split).resolve())):
            raise ShardError(
                f"{out}: lies in {plan.root}/{split}, among the scenes of the release. "
                f"Pack into a folder outside it."
            )


def _require_own_shards(plan: ShardPlan, out: Path) -> None:
    """Refuse a folder without a plan that holds anything else than the plan's shards.

    Shards that hold the plan's files by name may be finished ones without their manifests: they
    are compared byte for byte when their turn comes.
    """
    _require_no_others(plan, out)
    ours = [shard for shard in plan.shards if (out / shard.name).exists()]
    for shard in ours:
        path = out / shard.name
        try:
            with path.open("rb") as file:
                found = read_members(file, path.stat().st_size, where=str(path))
            is_ours = [each.name for each in found] == [each.name for each in shard.members]
        except ShardError:
            is_ours = False
        if not is_ours:
            raise _not_ours(path)
    if not ours and (out / INDEX_NAME).exists():
        raise _not_ours(out / INDEX_NAME)


def _not_ours(path: Path) -> ShardError:
    return ShardError(
        f"{path}: is there, and was not packed here by this plan. Move it away, or pack into an "
        f"empty folder."
    )


def _require_no_others(plan: ShardPlan, out: Path) -> None:
    """Refuse a folder with a shard that is none of the plan's."""
    known = {shard.name for shard in plan.shards}
    for path in sorted(out.iterdir()) if out.exists() else []:
        name = path.name.removesuffix(UNFINISHED)
        if name.endswith(".tar") and name not in known:
            raise ShardError(
                f"{path}: is there, and is no shard of this plan. Move it away, or pack into an "
                f"empty folder."
            )


# Whether a finished shard is still what packing it now would give. Files that have gone since do
# not contradict it.


def _require_same_sources(task: ShardTask, manifest: ShardManifest) -> None:
    """Refuse to keep a finished shard if the files that it was made from are others now.

    Metadata files are read, of videos the size and the time of change are looked at; where these
    differ they are read too.

    Raises:
        ShardError: Naming the first such file, and what to do.
    """
    for member, seen, _ in manifest.members(task):
        key, _, name = member.name.partition(".")
        found = _stamp_now(Path(task.root, member.source), seen, is_text=name in METADATA_FILES)
        if found is not None and found != (seen.size, seen.crc32):
            raise ShardError(
                f"{key}: its {member.source.rpartition('/')[2]} is not the one that "
                f"{task.target} was packed from: it has {found[0]} bytes with crc32 "
                f"{found[1]:08x}, and had {seen.size} with {seen.crc32:08x}. Remove that shard to "
                f"have it packed anew and run the same command again, or put the file back, or "
                f"pack into an empty folder."
            )


def _require_same_rows(task: ShardTask, manifest: ShardManifest) -> None:
    """Refuse to keep a finished shard if the index contradicts its metadata.

    Raises:
        ShardError: Naming the first such scene, and what to do.
    """
    for scene in task.shard.scenes:
        key = scene.id.key
        if manifest.rows.get(key) == row_digest(scene):
            continue
        texts = {}
        with task.target.open("rb") as file:
            for member, seen, offset in manifest.members(task):
                of_scene, _, name = member.name.partition(".")
                if of_scene == key and name in METADATA_FILES:
                    file.seek(offset)
                    texts[name] = file.read(seen.size)
        require_indexed_metadata(scene, texts, root=task.root)


def _stamp_now(source: Path, seen: SourceStamp, *, is_text: bool) -> tuple[int, int] | None:
    """Return a source's size and crc32, of the manifest if it was not touched; None if gone."""
    try:
        status = source.stat()
        is_untouched = (status.st_size, status.st_mtime_ns) == (seen.size, seen.modified_ns)
        if is_untouched and not is_text:
            return seen.size, seen.crc32
        crc32 = 0
        with source.open("rb", buffering=0) as file:
            while chunk := file.read(_CHUNK_BYTES):
                crc32 = zlib.crc32(chunk, crc32)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise ShardError(
            f"{source}: cannot be read ({error.strerror}). "
            + cure_of(error, "Check the disk, then run the same command again.")
        ) from error
    return status.st_size, crc32
