"""One shard on disk, whole or absent: written beside its place, then renamed.

The index of a shard, ``OUT/.parts/<shard>-<plan>.parquet``, is written just before the rename. A
shard under its final name is finished, and later runs keep it. Source files must be as they were
when the plan was made, and must not change while they are read.
"""

import hashlib
import io
import os
import shutil
import stat
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from io import FileIO
from pathlib import Path
from typing import Final

from stereogenbench_data.engine import Advance
from stereogenbench_data.errors import MediaError, ShardError, StorageError, explain_os_errors
from stereogenbench_data.index.parquet import INDEX_NAME, read_index_file
from stereogenbench_data.index.row_check import compared_with_files
from stereogenbench_data.index.scene_folder import derived_scene
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.media.depth import packed_depth
from stereogenbench_data.media.depth_frames import CODEC_NAME
from stereogenbench_data.schema.records import Member, Scene, ShardFacts
from stereogenbench_data.schema.release import CAMERA_COUNT, RELEASED_NAMES, TRAINING_JSON
from stereogenbench_data.schema.training import parse_training
from stereogenbench_data.shards.plan import (
    DepthCodec,
    PlannedMember,
    PlannedShard,
    planned_members,
)
from stereogenbench_data.shards.tar import END_OF_ARCHIVE, member_header, padded, read_chunks
from stereogenbench_data.shards.training import (
    Derivation,
    derive_scene,
    derived_names,
    source_bytes,
)
from stereogenbench_data.sources.files import copy_with_crc32, open_atomic, try_locked
from stereogenbench_data.sources.location import is_remote, shown
from stereogenbench_data.sources.members import MemberSource
from stereogenbench_data.sources.ranged_file import require_crc32

PARTS: Final = ".parts"
"""The folder beside the shards that holds the index of each, and locks."""


@dataclass(frozen=True, slots=True)
class ShardTask:
    """A shard to pack, with all that another process needs for it."""

    shard: PlannedShard
    root: str
    out: str
    plan_digest: str
    depth_codec: DepthCodec = "released"
    derivation: Derivation | None = None

    @property
    def derived(self) -> Path:
        """The folder of its derived files until it is finished."""
        return self.target.parent / PARTS / f"{self.target.stem}.derived"

    @property
    def source_bytes(self) -> int:
        """The size of all files that it is made from."""
        if self.derivation is None:
            return sum(file.size for each in self.shard.scenes for file in each.members.values())
        settings = self.derivation.settings
        return sum(source_bytes(each, derived_names(each, settings)) for each in self.shard.scenes)

    @property
    def target(self) -> Path:
        """The path of the shard."""
        return Path(self.out, self.shard.name)

    @property
    def index(self) -> Path:
        """The path of its index, which no other plan has."""
        name = f"{self.target.stem}-{self.plan_digest[:16]}.parquet"
        return self.target.parent / PARTS / name


def open_shards(data: str | Path, root: str | Path | None) -> SceneIndex:
    """Return the index of shards on this machine.

    Args:
        data: The folder of the shards, or its index file.
        root: The folder of the shards, if the index file is elsewhere.

    Raises:
        StorageError: If there is no index of shards, or it cannot be opened.
    """
    if is_remote(data):
        raise ShardError(f"{shown(data)}: is remote. Download the shards, and pass their folder.")
    path = Path(data)
    if path.is_dir() and not (path / INDEX_NAME).is_file():
        cure = "Pass a folder that `stereogenbench pack` made."
        if (path / PARTS).is_dir():
            cure = "Packing was not finished: run `stereogenbench pack` again."
        raise ShardError(f"{path}: holds no {INDEX_NAME}. {cure}")
    index = SceneIndex.open(path, root=root)
    if not index.shards:
        raise ShardError(
            f"{path}: is the index of a released folder, not of shards. Pack it with "
            f"`stereogenbench pack`, or pass a folder of shards."
        )
    return index


def find_packed(task: ShardTask) -> SceneIndex | None:
    """Return the index of a finished shard; None if the shard is not there.

    Raises:
        ShardError: If a file has its name that this plan did not pack, or that was changed since.
    """
    try:
        size = task.target.stat().st_size
    except FileNotFoundError:
        return None
    try:
        table, head = read_index_file(task.index, where=f"{task.index}")
        packed_bytes = head.shards[task.shard.name].size
    except (StorageError, KeyError) as error:
        raise not_of_plan(task.target) from error
    if packed_bytes != size:
        raise ShardError(
            f"{task.target}: has {size} bytes, and had {packed_bytes} when it was packed. "
            f"Remove it, then run the same command again."
        )
    return SceneIndex(table, head, seek_tables=task.index)


def pack_task(task: ShardTask, after_bytes: Advance) -> str:
    """Pack one shard into its folder, unless it is finished; a worker process calls this.

    Returns:
        The name of the shard; "" if it was there.

    Raises:
        ShardError: If a source is missing, unreadable, changes meanwhile or contradicts the index;
            the disk is full; another file has its name; or another process is packing it.
    """
    with _alone(task, task.index.with_name(f"{task.target.name}.lock"), f"{task.target}"):
        if find_packed(task) is not None:
            return ""
        if task.derivation is None:
            _pack(task, after_bytes)
        else:
            for scene in task.shard.scenes:
                derive_task((task, scene), after_bytes)
            # What is copied from now on was counted when it was derived.
            _pack(task, lambda count: after_bytes(0))
            shutil.rmtree(task.derived, ignore_errors=True)
        return task.shard.name


def derive_task(work: tuple[ShardTask, Scene], after_bytes: Advance) -> None:
    """Derive the files of one scene of a shard, unless they are there; a worker calls this.

    Raises:
        ShardError: As `pack_task` says.
    """
    task, scene = work
    folder = task.derived / scene.id.key
    with _alone(task, folder.with_name(f".{folder.name}.lock"), f"{folder}"):
        if task.derivation is not None:
            derive_scene(task.derivation, scene, folder, advance=after_bytes)


@contextmanager
def _alone(task: ShardTask, lock: Path, work: str) -> Iterator[None]:
    """Do some work in one process at a time, with errors of the system that name the shard.

    A file system without locks keeps nobody from doing it twice, with the same bytes.

    Raises:
        ShardError: If another process does it.
    """
    what = f"{task.target}: cannot be written"
    with explain_os_errors(what, "Pack into another folder.", kind=ShardError):
        lock.parent.mkdir(parents=True, exist_ok=True)
        with try_locked(lock) as is_ours:
            if not is_ours:
                raise ShardError(
                    f"{work}: another process is packing it. Give each process a part of its own "
                    f"(--part I/N), or wait for that one."
                )
            yield


def _members(task: ShardTask, scene: Scene) -> list[PlannedMember]:
    """Return the files of a scene that are packed: released ones, or those derived of them."""
    if task.derivation is None:
        return planned_members(scene, depth_codec=task.depth_codec)
    key, folder = scene.id.key, task.derived.absolute() / scene.id.key
    return [
        PlannedMember(f"{key}.{name}", f"{folder / name}", (folder / name).stat().st_size)
        for name in derived_names(scene, task.derivation.settings)
    ]


def not_of_plan(path: Path) -> ShardError:
    """Return the error about a file in the folder of shards that this plan did not pack."""
    return ShardError(
        f"{path}: already exists and was not packed by this plan. Move it away, or pack into an "
        f"empty folder."
    )


def _pack(task: ShardTask, after_bytes: Advance) -> None:
    """Write a shard and its index, from files that are as the plan says."""
    sha256, size = hashlib.sha256(), 0
    rows: list[Scene] = []
    with open_atomic(task.target) as file:

        def write(content: bytes) -> None:
            nonlocal size
            file.write(content)
            sha256.update(content)
            size += len(content)

        for scene in task.shard.scenes:
            members: dict[str, Member] = {}
            for member in _members(task, scene):
                name, source = member.name.partition(".")[2], Path(task.root, member.source)
                length = member.size
                crc32 = None
                if task.derivation is None:
                    crc32 = scene.members[RELEASED_NAMES.get(name, name)].crc32
                chunks = _source_chunks(source, length, after_bytes, crc32=crc32)
                if task.derivation is None and name in RELEASED_NAMES:
                    packed = _packed_depth(source, chunks, frames=scene.frames)
                    length, chunks = len(packed), iter([packed])
                write(member_header(member.name, length))
                crc32 = copy_with_crc32(chunks, write)
                members[name] = Member(Path(file.name).name, size - length, length, crc32)
                write(bytes(padded(length) - length))
            file.flush()
            rows.append(_row_of(task, replace(scene, members=members)))
        write(END_OF_ARCHIVE)
        facts = ShardFacts(size, sha256.hexdigest(), sum(len(row.members) for row in rows))
        shards = {task.shard.name: facts}
        SceneIndex.from_scenes(rows, task.out, shards=shards).write(task.index)


def _row_of(task: ShardTask, scene: Scene) -> Scene:
    """Return the row of a scene in a shard that is being written.

    Raises:
        ShardError: If its files are not what the index was made from.
    """
    source = MemberSource(task.out, shards={})
    if task.derivation is not None:
        text, where = source.read(scene, TRAINING_JSON), source.label(scene, TRAINING_JSON)
        scene = derived_scene(scene, parse_training(text, where=where))
    elif not RELEASED_NAMES.keys().isdisjoint(scene.members):
        scene = replace(scene, depth_codec=(CODEC_NAME,) * CAMERA_COUNT)
    now, differences = compared_with_files(scene, source)
    for name, difference in differences[:1]:
        raise ShardError(
            f"{Path(task.root, scene.id.key, name)}: {difference}. The index is older than the "
            f"file: run `stereogenbench index` on the release again, then the same command."
        )
    members = {name: replace(each, path=task.shard.name) for name, each in scene.members.items()}
    return replace(scene, members=members, seek_tables=now.seek_tables)


def _source_chunks(
    source: Path, size: int, after_bytes: Advance, *, crc32: int | None
) -> Iterator[bytes]:
    """Yield all bytes of a released file of the planned size.

    Raises:
        ShardError: If it is missing, unreadable, has another size or checksum, or changes
            meanwhile.
    """
    found_crc32 = 0
    cure = "Fetch it again, then run the same command again."
    with explain_os_errors(f"{source}: cannot be read", cure, kind=ShardError):
        if not stat.S_ISREG(source.stat().st_mode):
            raise ShardError(f"{source}: is not a file. Put the release's own file in its place.")
        with FileIO(source) as file:
            before = os.fstat(file.fileno())
            if before.st_size != size:
                raise ShardError(
                    f"{source}: has {before.st_size} bytes, and had {size} when the plan was made. "
                    f"Let nothing write to the release; run `stereogenbench index` again if it has "
                    f"an index."
                )
            for chunk in read_chunks(file, size, after_bytes=after_bytes):
                found_crc32 = zlib.crc32(chunk, found_crc32)
                yield chunk
            require_crc32(found_crc32, expected=crc32, name=str(source))
            after = source.stat()
            found = (after.st_size, after.st_mtime_ns)
            if found != (size, before.st_mtime_ns) or not os.path.samestat(after, before):
                raise ShardError(
                    f"{source}: was changed while it was packed. Let nothing write to the release, "
                    f"then run the same command again."
                )


def _packed_depth(source: Path, chunks: Iterable[bytes], *, frames: int) -> bytes:
    """Return a released depth video as blosc2's frames.

    Raises:
        ShardError: If it cannot be read, or not be packed bit for bit.
    """
    try:
        return packed_depth(io.BytesIO(b"".join(chunks)), name=str(source), frames=frames)
    except MediaError as error:
        raise ShardError(str(error)) from error
