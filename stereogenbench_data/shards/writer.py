"""One shard on disk, whole or not there: written beside its place, read back, then renamed.

Its members are made from files of the release that are as they were planned and do not change
meanwhile.
"""

import hashlib
import io
import os
import stat
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from io import FileIO
from itertools import groupby
from pathlib import Path
from typing import Final, Literal

from stereogenbench_data.engine import Advance, no_advance
from stereogenbench_data.errors import DISK_FULL, MediaError, ShardError, cure_of, describe_os_error
from stereogenbench_data.index.scene_folder import metadata_differences
from stereogenbench_data.media.depth_packing import packed_depth
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.schema.release import METADATA_FILES
from stereogenbench_data.shards.manifest import (
    PARTS,
    PackedShard,
    ShardManifest,
    ShardTask,
    SourceStamp,
    find_packed,
    read_manifest,
    row_digest,
    write_manifest,
)
from stereogenbench_data.shards.plan import PlannedMember
from stereogenbench_data.shards.tar import (
    END_OF_ARCHIVE,
    Checksums,
    TarMember,
    member_header,
    padded,
    read_checksums,
    read_members,
)
from stereogenbench_data.sources.files import try_locked

UNFINISHED: Final = ".tmp"

_CHUNK_BYTES: Final = 4 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class ShardOutcome:
    """What became of a shard: packed just now, or found finished and kept."""

    shard: PackedShard
    work: Literal["packed", "kept"]


def pack_task(task: ShardTask, after_bytes: Advance) -> ShardOutcome:
    """Pack one shard into its folder, unless it is there already; a worker calls this.

    Raises:
        ShardError: If a source is missing, unreadable, changes meanwhile or contradicts the index;
            the disk is full; the shard does not read back as written; a file that was not packed
            here has its name; or another process is packing it.
    """
    done = find_packed(task)
    if done is not None:
        return ShardOutcome(done, "kept")
    try:
        with _open_exclusive(_unfinished_of(task)) as file:
            done = find_packed(task) or found_whole(task, after_bytes)
            if done is not None:
                return ShardOutcome(done, "kept")
            return _pack(task, file, after_bytes)
    except OSError as error:
        if isinstance(error, ShardError):
            raise
        raise ShardError(_why_not_written(task, error)) from error


def found_whole(task: ShardTask, after_bytes: Advance) -> PackedShard | None:
    """Return a finished shard that was touched and still holds the bytes of its manifest.

    Raises:
        OSError: If it cannot be read.
    """
    manifest = read_manifest(task)
    if manifest is None or not task.target.is_file():
        return None
    with task.target.open("rb", buffering=0) as file:
        status = os.fstat(file.fileno())
        if status.st_size != manifest.packed.size:
            return None
        found = read_checksums(
            file, status.st_size, parts=[], after_bytes=lambda count: after_bytes(0)
        )
    if found.sha256 != manifest.packed.sha256:
        return None
    write_manifest(task, replace(manifest, modified_ns=status.st_mtime_ns))
    after_bytes(task.shard.source_bytes)
    return manifest.packed


@contextmanager
def _open_exclusive(path: Path) -> Iterator[FileIO]:
    """Open a new, empty shard for this process alone; it is removed unless it was renamed.

    The lock is a file in ``.parts``, which stays. On a file system without locks nothing keeps two
    processes from writing one file; one of them will find it altered or gone.

    Raises:
        ShardError: If another process has it.
    """
    lock = path.parent / PARTS / f"{path.name}.lock"
    lock.parent.mkdir(parents=True, exist_ok=True)
    with try_locked(lock) as is_ours:
        if not is_ours:
            raise ShardError(
                f"{path}: another process is packing this shard. Give each process a part of its "
                f"own (--part I/N), or wait for that one."
            )
        try:
            with FileIO(path, "w+") as file:
                yield file
        finally:
            path.unlink(missing_ok=True)


def _unfinished_of(task: ShardTask) -> Path:
    return task.target.with_name(task.target.name + UNFINISHED)


def _why_not_written(task: ShardTask, error: OSError) -> str:
    if error.errno in DISK_FULL:
        return (
            f"{task.target}: the disk is full; the shard needs {task.shard.size} bytes. What was "
            f"begun is removed: make room, then run the same command again to go on from here."
        )
    what = f"{task.target}: cannot be written"
    return describe_os_error(what, error, "Pack into another folder.")


class _Output:
    """What is written, with its size, its sha256 so far and the places of its members."""

    def __init__(self, file: FileIO) -> None:
        self._file = file
        self._sha256 = hashlib.sha256()
        self.size = 0
        self.offsets: list[int] = []
        self.sizes: list[int] = []
        self.crc32s: list[int] = []
        self.sources: list[SourceStamp] = []

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

    def end_member(self, source: SourceStamp) -> None:
        self.write(bytes(padded(self.sizes[-1]) - self.sizes[-1]))
        self.sources.append(source)


def _pack(task: ShardTask, file: FileIO, after_bytes: Advance) -> ShardOutcome:
    # A shard whose manifest was removed is kept if it is what packing gives.
    is_unknown = read_manifest(task) is None and task.target.exists()
    manifest = _written(task, file, after_bytes)
    _require_read_back(task, file, manifest.packed)
    if is_unknown:
        manifest = _require_same_shard(task, manifest)
    write_manifest(task, manifest)
    if is_unknown:
        return ShardOutcome(manifest.packed, "kept")
    _unfinished_of(task).replace(task.target)
    _sync_folder(task.target.parent)
    return ShardOutcome(manifest.packed, "packed")


def _require_same_shard(task: ShardTask, manifest: ShardManifest) -> ShardManifest:
    """Return the manifest of a shard that is there, which must hold the bytes just written."""
    with task.target.open("rb", buffering=0) as file:
        status = os.fstat(file.fileno())
        found = read_checksums(file, status.st_size, parts=[], after_bytes=no_advance)
    if found.sha256 != manifest.packed.sha256:
        raise ShardError(
            f"{task.target}: is there and was not packed here by this plan. Move it away, or pack "
            f"into an empty folder."
        )
    return replace(manifest, modified_ns=status.st_mtime_ns)


def _sync_folder(folder: Path) -> None:
    """Have a rename outlive a power cut, where folders can be synchronised."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            os.fsync(handle)
    finally:
        os.close(handle)


def _written(task: ShardTask, file: FileIO, after_bytes: Advance) -> ShardManifest:
    """Write a shard's bytes; return its manifest."""
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
    return ShardManifest(packed, modified_ns, tuple(output.sources), rows)


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
        after_bytes=no_advance,
    )
    if (found, checksums) != (planned, Checksums(packed.sha256, packed.crc32s)):
        raise ShardError(
            f"{task.target}: does not read back as it was written. Check the disk and the memory "
            f"of this machine, then run the same command again."
        )


def require_indexed_metadata(scene: Scene, texts: Mapping[str, bytes], *, root: str) -> None:
    """Refuse to pack metadata files that contradict the index of their release.

    Raises:
        ShardError: Naming the first such file, what it says and what to do.
    """
    for name, difference in metadata_differences(scene, texts)[:1]:
        where = Path(root, scene.id.key, name)
        raise ShardError(
            f"{where}: {difference}. The index is older than the file: run `stereogenbench index` "
            f"on the release again, then the same command."
        )


def read_released(
    source: Path, size: int, *, take: Callable[[bytes], object], after_bytes: Advance
) -> SourceStamp:
    """Hand over all bytes of a file, in pieces of a few megabytes.

    Args:
        source: The file.
        size: How many bytes it had when the plan was made.
        take: Called with each piece, in order.
        after_bytes: Called with the number of bytes, after each piece.

    Returns:
        The file as it was while it was read.

    Raises:
        ShardError: If it is missing, unreadable, has another size or changes meanwhile.
    """
    with _opened(source) as file:
        before = os.fstat(file.fileno())
        _require_planned_size(source, size, before.st_size)
        crc32, left = 0, size
        while left:
            chunk = _read(source, file, min(left, _CHUNK_BYTES))
            if not chunk:
                _require_planned_size(source, size, size - left)
            take(chunk)
            crc32 = zlib.crc32(chunk, crc32)
            left -= len(chunk)
            after_bytes(len(chunk))
        if _identity(_status(source)) != _identity(before):
            raise ShardError(
                f"{source}: was changed while it was packed. Let nothing write to the release, "
                f"then run the same command again."
            )
    return SourceStamp(size, before.st_mtime_ns, crc32)


def read_packed_depth(
    source: Path, size: int, *, frames: int, after_bytes: Advance
) -> tuple[bytes, SourceStamp]:
    """Return a released depth video as blosc2's frames, and the file as it was.

    Args:
        source: The video.
        size: How many bytes it had when the plan was made.
        frames: How many frames it must have.
        after_bytes: Called with the number of the video's bytes that each frame stands for.

    Raises:
        ShardError: If it cannot be read, or not be packed bit for bit.
    """
    parts: list[bytes] = []
    seen = read_released(source, size, take=parts.append, after_bytes=lambda count: after_bytes(0))
    left = size

    def after_frame() -> None:
        nonlocal left
        after_bytes(min(size // frames, left))
        left -= min(size // frames, left)

    try:
        content = packed_depth(
            io.BytesIO(b"".join(parts)), name=str(source), frames=frames, after_frame=after_frame
        )
    except MediaError as error:
        raise ShardError(str(error)) from error
    after_bytes(left)
    return content, seen


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
        f"{source}: cannot be read ({error.strerror}). "
        + cure_of(error, "Fetch it again, then run the same command again.")
    )


def _identity(status: os.stat_result) -> tuple[int, int, int]:
    return status.st_ino, status.st_size, status.st_mtime_ns


def _require_planned_size(source: Path, planned: int, size: int) -> None:
    if size != planned:
        raise ShardError(
            f"{source}: has {size} bytes, and had {planned} when the plan was made. Let nothing "
            f"write to the release; run `stereogenbench index` again if it has an index."
        )
