"""One shard on disk, whole or not there: written beside its place, read back, then renamed.

What was written is noted in ``OUT/.parts/<shard>.json`` just before the shard gets its name. A
shard that has both is finished; one without its note was not made here and is left alone.
"""

import errno
import hashlib
import json
import os
import stat
import zlib
from contextlib import suppress
from dataclasses import asdict, dataclass
from io import FileIO
from pathlib import Path
from typing import Final

from stereogenbench_data.errors import ShardError
from stereogenbench_data.storage.pool import AfterBytes
from stereogenbench_data.storage.shard_plan import PlannedMember, PlannedShard, ShardPlan
from stereogenbench_data.storage.tar import (
    END_OF_ARCHIVE,
    Checksums,
    TarMember,
    member_header,
    padded,
    read_checksums,
    read_members,
)
from stereogenbench_data.storage.unfinished import PARTS, alone, write_whole

UNFINISHED: Final = ".tmp"

_CHUNK_BYTES: Final = 4 * 1024 * 1024
_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})


@dataclass(frozen=True, slots=True)
class ShardTask:
    """A shard to be packed, with all that another process needs for it."""

    shard: PlannedShard
    root: str
    out: str
    plan_digest: str

    @property
    def target(self) -> Path:
        """Where the shard is to lie."""
        return Path(self.out, self.shard.name)


@dataclass(frozen=True, slots=True)
class PackedShard:
    """A finished shard; ``offsets`` and ``crc32s`` are of its planned members, in their order."""

    name: str
    size: int
    sha256: str
    offsets: tuple[int, ...]
    crc32s: tuple[int, ...]


def pack_shard(plan: ShardPlan, number: int, out: str | Path) -> PackedShard:
    """Pack one shard of a plan into a folder, unless it is there already.

    Raises:
        ShardError: If a source is missing, unreadable or changes meanwhile; the disk is full; the
            shard does not read back as written; a file that was not packed here has its name; or
            another process is packing it.
    """
    task = ShardTask(plan.shards[number], plan.root, str(out), plan.digest)
    return pack_task(task, lambda count: None)


def pack_task(task: ShardTask, after_bytes: AfterBytes) -> PackedShard:
    """Pack one shard, as `pack_shard` does; a worker process calls this."""
    done = find_packed(task)
    if done is not None:
        return done
    if task.target.exists() and not _note_of(task).is_file():
        raise ShardError(
            f"{task.target}: is there and was not packed here by this plan. Move it away, or pack "
            f"into an empty folder."
        )
    try:
        with alone(_unfinished_of(task)) as file:
            return find_packed(task) or _pack(task, file, after_bytes)
    except OSError as error:
        if isinstance(error, ShardError):
            raise
        raise ShardError(_why_not_written(task, error)) from error


def find_packed(task: ShardTask) -> PackedShard | None:
    """Return a shard that this plan has packed before, None if it is to be packed."""
    try:
        noted = json.loads(_note_of(task).read_bytes())
        packed = PackedShard(
            noted["name"], noted["size"], noted["sha256"], tuple(noted["offsets"]),
            tuple(noted["crc32s"]),
        )  # fmt: skip
        size = task.target.stat().st_size
    except (OSError, ValueError, KeyError, TypeError):
        return None
    is_same = noted.get("plan") == task.plan_digest and packed.name == task.shard.name
    return packed if is_same and packed.size == size else None


def _note_of(task: ShardTask) -> Path:
    return task.target.parent / PARTS / f"{task.target.stem}.json"


def _unfinished_of(task: ShardTask) -> Path:
    return task.target.with_name(task.target.name + UNFINISHED)


def _why_not_written(task: ShardTask, error: OSError) -> str:
    if error.errno in _FULL:
        return (
            f"{task.target}: the disk is full; the shard needs {task.shard.size} bytes. What was "
            f"begun is removed: make room, then run the same command again to go on from here."
        )
    return (
        f"{task.target}: cannot be written ({error.strerror or error}). Give write permission "
        f"there, or pack into another folder."
    )


class _Output:
    """What is written, with its size and sha256 so far."""

    def __init__(self, file: FileIO) -> None:
        self._file = file
        self._sha256 = hashlib.sha256()
        self.size = 0

    @property
    def sha256(self) -> str:
        return self._sha256.hexdigest()

    def write(self, content: bytes) -> None:
        self._sha256.update(content)
        self.size += len(content)
        left = memoryview(content)
        while left:
            left = left[self._file.write(left) :]


def _pack(task: ShardTask, file: FileIO, after_bytes: AfterBytes) -> PackedShard:
    packed = _written(task, file, after_bytes)
    _require_read_back(task, file, packed)
    write_whole(_note_of(task), _note(task, packed))
    _unfinished_of(task).replace(task.target)
    _sync_folder(task.target.parent)
    return packed


def _note(task: ShardTask, packed: PackedShard) -> bytes:
    members = [member.name for member in task.shard.members]
    noted = asdict(packed) | {"plan": task.plan_digest, "members": members}
    return json.dumps(noted).encode()


def _sync_folder(folder: Path) -> None:
    """Have a rename outlive a power cut, where folders can be synchronised."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            os.fsync(handle)
    finally:
        os.close(handle)


def _written(task: ShardTask, file: FileIO, after_bytes: AfterBytes) -> PackedShard:
    output = _Output(file)
    offsets, crc32s = [], []
    for member in task.shard.members:
        output.write(member_header(member.name, member.size))
        offsets.append(output.size)
        crc32s.append(_copied(Path(task.root, member.source), member, output, after_bytes))
        output.write(bytes(padded(member.size) - member.size))
    output.write(END_OF_ARCHIVE)
    os.fsync(file.fileno())
    return PackedShard(task.shard.name, output.size, output.sha256, tuple(offsets), tuple(crc32s))


def _copied(source: Path, member: PlannedMember, output: _Output, after_bytes: AfterBytes) -> int:
    """Copy a file's bytes, which must be the same file all the while; return their crc32."""
    with _opened(source) as file:
        before = os.fstat(file.fileno())
        _require_planned_size(source, member, before.st_size)
        crc32, left = 0, member.size
        while left:
            chunk = _read(source, file, min(left, _CHUNK_BYTES))
            if not chunk:
                _require_planned_size(source, member, member.size - left)
            output.write(chunk)
            crc32 = zlib.crc32(chunk, crc32)
            left -= len(chunk)
            after_bytes(len(chunk))
        if _identity(_status(source)) != _identity(before):
            raise ShardError(
                f"{source}: was changed while it was packed. Let nothing write to the release, "
                f"then run the same command again."
            )
    return crc32


def _opened(source: Path) -> FileIO:
    if not stat.S_ISREG(_status(source).st_mode):
        raise ShardError(f"{source}: is no file. Put the release's own file in its place.")
    try:
        return FileIO(source)
    except OSError as error:
        raise _unreadable(source, error) from error


def _status(source: Path) -> os.stat_result:
    try:
        return source.stat()
    except OSError as error:
        raise _unreadable(source, error) from error


def _read(source: Path, file: FileIO, size: int) -> bytes:
    try:
        return file.read(size)
    except OSError as error:
        raise _unreadable(source, error) from error


def _unreadable(source: Path, error: OSError) -> ShardError:
    return ShardError(
        f"{source}: cannot be read ({error.strerror}). Fetch it again or give read permission, "
        f"then run the same command again."
    )


def _identity(status: os.stat_result) -> tuple[int, int, int]:
    return status.st_ino, status.st_size, status.st_mtime_ns


def _require_planned_size(source: Path, member: PlannedMember, size: int) -> None:
    if size != member.size:
        raise ShardError(
            f"{source}: has {size} bytes, and had {member.size} when the plan was made. Let "
            f"nothing write to the release; run `stereogenbench index` again if it has an index."
        )


def _require_read_back(task: ShardTask, file: FileIO, packed: PackedShard) -> None:
    """Read a shard from the disk, not from memory where the system allows, and compare."""
    if hasattr(os, "posix_fadvise"):
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    planned = [
        TarMember(member.name, offset, member.size)
        for member, offset in zip(task.shard.members, packed.offsets, strict=True)
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
