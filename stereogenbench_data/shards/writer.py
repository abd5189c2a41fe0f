"""One shard on disk, whole or not there: written beside its place, read back, then renamed."""

import errno
import hashlib
import os
import zlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from io import FileIO
from itertools import groupby
from pathlib import Path
from typing import Final, Literal

from stereogenbench_data.engine import Advance
from stereogenbench_data.errors import ShardError, cure_of
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.schema.release import METADATA_FILES
from stereogenbench_data.shards.manifest import (
    PackedShard,
    SeenFile,
    ShardNote,
    ShardTask,
    find_packed,
    read_note,
    row_digest,
    write_note,
)
from stereogenbench_data.shards.plan import PlannedMember, ShardPlan
from stereogenbench_data.shards.released_file import read_packed_depth, read_released
from stereogenbench_data.shards.repack_check import require_indexed_metadata
from stereogenbench_data.shards.tar import (
    END_OF_ARCHIVE,
    Checksums,
    TarMember,
    member_header,
    padded,
    read_checksums,
    read_members,
)
from stereogenbench_data.sources.files import open_exclusive

UNFINISHED: Final = ".tmp"

_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})


@dataclass(frozen=True, slots=True)
class ShardOutcome:
    """What became of a shard: packed just now, or found finished and kept."""

    shard: PackedShard
    work: Literal["packed", "kept"]


def pack_shard(plan: ShardPlan, number: int, out: str | Path) -> PackedShard:
    """Pack one shard of a plan into a folder, unless it is there already.

    Raises:
        ShardError: If a source is missing, unreadable, changes meanwhile or tells otherwise than
            the index; the disk is full; the shard does not read back as written; a file that was
            not packed here has its name; or another process is packing it.
    """
    task = ShardTask(plan.shards[number], plan.root, str(out), plan.digest)
    return pack_task(task, lambda count: None).shard


def pack_task(task: ShardTask, after_bytes: Advance) -> ShardOutcome:
    """Pack one shard, as `pack_shard` does; a worker process calls this."""
    done = find_packed(task)
    if done is not None:
        return ShardOutcome(done, "kept")
    try:
        with open_exclusive(_unfinished_of(task)) as file:
            done = find_packed(task) or found_whole(task, after_bytes)
            if done is not None:
                return ShardOutcome(done, "kept")
            return _pack(task, file, after_bytes)
    except OSError as error:
        if isinstance(error, ShardError):
            raise
        raise ShardError(_why_not_written(task, error)) from error


def found_whole(task: ShardTask, after_bytes: Advance) -> PackedShard | None:
    """Return a finished shard that was touched and holds the bytes that were noted all the same.

    Raises:
        OSError: If it cannot be read.
    """
    note = read_note(task)
    if note is None or not task.target.is_file():
        return None
    with task.target.open("rb", buffering=0) as file:
        status = os.fstat(file.fileno())
        if status.st_size != note.packed.size:
            return None
        found = read_checksums(
            file, status.st_size, parts=[], after_bytes=lambda count: after_bytes(0)
        )
    if found.sha256 != note.packed.sha256:
        return None
    write_note(task, replace(note, modified_ns=status.st_mtime_ns))
    after_bytes(sum(member.size for member in task.shard.members))
    return note.packed


def _unfinished_of(task: ShardTask) -> Path:
    return task.target.with_name(task.target.name + UNFINISHED)


def _why_not_written(task: ShardTask, error: OSError) -> str:
    if error.errno in _FULL:
        return (
            f"{task.target}: the disk is full; the shard needs {task.shard.size} bytes. What was "
            f"begun is removed: make room, then run the same command again to go on from here."
        )
    cure = cure_of(error, "Pack into another folder.")
    return f"{task.target}: cannot be written ({error.strerror or error}). {cure}"


class _Output:
    """What is written, with its size, its sha256 so far and the places of its members."""

    def __init__(self, file: FileIO) -> None:
        self._file = file
        self._sha256 = hashlib.sha256()
        self.size = 0
        self.offsets: list[int] = []
        self.sizes: list[int] = []
        self.crc32s: list[int] = []
        self.sources: list[SeenFile] = []

    @property
    def sha256(self) -> str:
        return self._sha256.hexdigest()

    def write(self, content: bytes) -> None:
        self._sha256.update(content)
        self.size += len(content)
        left = memoryview(content)
        while left:
            left = left[self._file.write(left) :]

    def begin_member(self, name: str, size: int) -> None:
        self.write(member_header(name, size))
        self.offsets.append(self.size)
        self.sizes.append(size)
        self.crc32s.append(0)

    def write_member(self, content: bytes) -> None:
        self.write(content)
        self.crc32s[-1] = zlib.crc32(content, self.crc32s[-1])

    def end_member(self, source: SeenFile) -> None:
        self.write(bytes(padded(self.sizes[-1]) - self.sizes[-1]))
        self.sources.append(source)


def _pack(task: ShardTask, file: FileIO, after_bytes: Advance) -> ShardOutcome:
    # A shard without a note is kept if it is what packing gives: its notes were removed.
    is_unknown = read_note(task) is None and task.target.exists()
    note = _written(task, file, after_bytes)
    _require_read_back(task, file, note.packed)
    if is_unknown:
        note = _require_same_shard(task, note)
    write_note(task, note)
    if is_unknown:
        return ShardOutcome(note.packed, "kept")
    _unfinished_of(task).replace(task.target)
    _sync_folder(task.target.parent)
    return ShardOutcome(note.packed, "packed")


def _require_same_shard(task: ShardTask, note: ShardNote) -> ShardNote:
    """Return the note for a shard that lies there, which must hold the bytes just written."""
    with task.target.open("rb", buffering=0) as file:
        status = os.fstat(file.fileno())
        found = read_checksums(file, status.st_size, parts=[], after_bytes=lambda count: None)
    if found.sha256 != note.packed.sha256:
        raise ShardError(
            f"{task.target}: is there and was not packed here by this plan. Move it away, or pack "
            f"into an empty folder."
        )
    return replace(note, modified_ns=status.st_mtime_ns)


def _sync_folder(folder: Path) -> None:
    """Have a rename outlive a power cut, where folders can be synchronised."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            os.fsync(handle)
    finally:
        os.close(handle)


def _written(task: ShardTask, file: FileIO, after_bytes: Advance) -> ShardNote:
    """Write a shard's bytes; return what is to be noted of it."""
    output = _Output(file)
    scenes = {scene.id.key: scene for scene in task.shard.scenes}
    for key, members in groupby(task.shard.members, key=lambda each: each.name.partition(".")[0]):
        _write_scene(task, list(members), output, scene=scenes.get(key), after_bytes=after_bytes)
    output.write(END_OF_ARCHIVE)
    os.fsync(file.fileno())
    packed = PackedShard(
        task.shard.name, output.size, output.sha256, tuple(output.offsets), tuple(output.sizes),
        tuple(output.crc32s),
    )  # fmt: skip
    modified_ns = os.fstat(file.fileno()).st_mtime_ns
    rows = {key: row_digest(scene) for key, scene in scenes.items()}
    return ShardNote(packed, modified_ns, tuple(output.sources), rows)


def _write_scene(
    task: ShardTask,
    members: Sequence[PlannedMember],
    output: _Output,
    *,
    scene: Scene | None,
    after_bytes: Advance,
) -> None:
    """Write a scene's files, its metadata first; these must be what the index was made from."""
    texts: dict[str, bytes] = {}
    for member in members:
        name = member.name.partition(".")[2]
        source = Path(task.root, member.source)
        if name in METADATA_FILES:
            parts: list[bytes] = []
            seen = read_released(source, member.size, take=parts.append, after_bytes=after_bytes)
            texts[name] = b"".join(parts)
            output.begin_member(member.name, member.size)
            output.write_member(texts[name])
            output.end_member(seen)
            continue
        _require_indexed(scene, texts, task=task)
        if member.form == "released" or scene is None:
            output.begin_member(member.name, member.size)
            take = output.write_member
            seen = read_released(source, member.size, take=take, after_bytes=after_bytes)
        else:
            content, seen = read_packed_depth(
                source, member.size, frames=scene.frames, after_bytes=after_bytes
            )
            output.begin_member(member.name, len(content))
            output.write_member(content)
        output.end_member(seen)
    _require_indexed(scene, texts, task=task)


def _require_indexed(scene: Scene | None, texts: dict[str, bytes], *, task: ShardTask) -> None:
    """Compare once, when all of a scene's metadata have been read."""
    if scene is not None and texts:
        require_indexed_metadata(scene, texts, root=task.root)
        texts.clear()


def _require_read_back(task: ShardTask, file: FileIO, packed: PackedShard) -> None:
    """Read a shard from the disk, not from memory where the system allows, and compare."""
    if hasattr(os, "posix_fadvise"):
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    planned = [
        TarMember(member.name, offset, size)
        for member, offset, size in zip(
            task.shard.members, packed.offsets, packed.sizes, strict=True
        )
    ]
    found = read_members(file, packed.size, where=str(task.target))
    checksums = read_checksums(
        file,
        os.fstat(file.fileno()).st_size,
        parts=[(member.offset, member.size) for member in planned],
        after_bytes=lambda count: None,
    )
    if (found, checksums) != (planned, Checksums(packed.sha256, packed.crc32s)):
        raise ShardError(
            f"{task.target}: does not read back as it was written. Check the disk and the memory "
            f"of this machine, then run the same command again."
        )
