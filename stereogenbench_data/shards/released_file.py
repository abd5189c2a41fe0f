"""Reading a file of a release for packing: the one that was planned, unchanged all the while."""

import io
import os
import stat
import zlib
from collections.abc import Callable
from io import FileIO
from pathlib import Path
from typing import Final

from stereogenbench_data.engine import Advance
from stereogenbench_data.errors import MediaError, ShardError, cure_of
from stereogenbench_data.media.depth_packing import packed_depth
from stereogenbench_data.shards.manifest import SeenFile

_CHUNK_BYTES: Final = 4 * 1024 * 1024


def read_released(
    source: Path, size: int, *, take: Callable[[bytes], object], after_bytes: Advance
) -> SeenFile:
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
    return SeenFile(size, before.st_mtime_ns, crc32)


def read_packed_depth(
    source: Path, size: int, *, frames: int, after_bytes: Advance
) -> tuple[bytes, SeenFile]:
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
