"""Tar files as shards use them: POSIX ustar with regular files and ASCII names only.

Python's ``tarfile`` makes and parses the headers. A shard's bytes depend on the names, sizes and
contents of its members alone. Reading refuses everything else that a tar can hold, and extracts
nothing.

A member is a header of one block of 512 bytes, its bytes, and zeros up to a whole block. The
archive ends with two blocks of zeros. The further zeros with which tar fills 10,240 bytes are
accepted but not written.

Source: POSIX.1-2017, pax, "ustar Interchange Format".
"""

import hashlib
import re
import tarfile
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

from stereogenbench_data.engine import Advance, no_advance
from stereogenbench_data.errors import ShardError
from stereogenbench_data.media.container import BinaryFile
from stereogenbench_data.sources.files import copy_with_crc32
from stereogenbench_data.sources.members import UNSAFE_PATH

BLOCK_BYTES: Final = tarfile.BLOCKSIZE
END_OF_ARCHIVE: Final = bytes(2 * BLOCK_BYTES)

LARGEST_MEMBER_BYTES: Final = 8**11 - 1
"""Eleven octal digits: 8 GiB less one byte."""

CODE_SUFFIXES: Final = frozenset(
    {"pickle", "pkl", "pk", "pyd", "pyc", "py", "so", "dill", "joblib"}
    | {"pt", "pth", "ckpt", "npy", "npz"}
)
"""Suffixes of files that loaders may unpickle or run. No shard holds such a member."""

CHUNK_BYTES: Final = 4 * 1024 * 1024
"""How much of a file is read at a time."""

_CHECKSUM: Final = slice(148, 156)
_DEVICES: Final = slice(329, 345)
_UNSAFE_NAME: Final = re.compile(rf"{UNSAFE_PATH}|[^ -~]")
FETCH_AGAIN: Final = "Fetch the shard again, or pack it again."


class TarMember(NamedTuple):
    """A file in a tar: ``size`` bytes that start at byte ``offset`` of the tar."""

    name: str
    offset: int
    size: int


def padded(size: int) -> int:
    """Return a size rounded up to whole blocks."""
    return -(-size // BLOCK_BYTES) * BLOCK_BYTES


def member_header(name: str, size: int) -> bytes:
    """Return the header block of a member, with mode 0644, owner 0 and time 0.

    Raises:
        ShardError: If ustar cannot hold such a member.
    """
    unfit = _unfit_name(name)
    if unfit:
        raise ShardError(f"member {name!r}: {unfit}. Rename it.")
    if not 0 <= size <= LARGEST_MEMBER_BYTES:
        raise ShardError(
            f"member {name!r}: has {size} bytes, and ustar holds 0 to {LARGEST_MEMBER_BYTES}. "
            f"Split the file."
        )
    info = tarfile.TarInfo(name)
    info.size = size
    try:
        header = bytearray(info.tobuf(tarfile.USTAR_FORMAT, "ascii", "strict"))
    except ValueError as error:
        raise ShardError(
            f"member {name!r}: has {len(name)} characters, and ustar holds 100, or 155 "
            f"before a slash and 100 after it. Shorten its folders' names."
        ) from error
    header[_DEVICES] = b"0000000\0" * 2  # in which the versions of tarfile differ
    header[_CHECKSUM] = b" " * 8
    header[_CHECKSUM] = b"%06o\0 " % sum(header)
    return bytes(header)


def _unfit_name(name: str) -> str:
    """Return why a member may not have this name, or an empty text."""
    if _UNSAFE_NAME.search(name):
        return "its name is not a relative path in ASCII that stays inside its folder"
    code = sorted(CODE_SUFFIXES & set(name.rpartition("/")[2].lower().split(".")[1:]))
    return f"may hold code that runs when it is loaded (.{code[0]})" if code else ""


def read_members(file: BinaryFile, size: int, *, where: str) -> list[TarMember]:
    """Return the members of an open tar. Its headers and its end are read, not its contents.

    Args:
        file: Open for reading, seekable.
        size: How many bytes it has.
        where: What messages call it.

    Raises:
        ShardError: If it is cut short or damaged, or holds anything but regular files with plain
            names. The message names the member and the byte.
    """
    members: dict[str, TarMember] = {}
    last, at = "its start", 0
    while True:
        place = f"{where}: at byte {at}, after {last},"
        file.seek(at)
        block = file.read(min(BLOCK_BYTES, size - at))
        if len(block) < BLOCK_BYTES:
            what = f"only {len(block)} of the {BLOCK_BYTES} bytes" if block else "nothing"
            raise ShardError(
                f"{place} there is {what} of a header or of the end of the archive: the shard is "
                f"cut short. {FETCH_AGAIN}"
            )
        if not any(block):
            _require_end(file, size - at, place=place)
            return list(members.values())
        name, length = _parse_header(block, place=place)
        member = TarMember(name, at + BLOCK_BYTES, length)
        if name in members:
            raise ShardError(f"{place} member {name!r} occurs a second time. {FETCH_AGAIN}")
        following = member.offset + padded(length)
        if following > size:
            raise ShardError(
                f"{place} member {name!r} claims {length} bytes. With padding they end at byte "
                f"{following}, and the shard has {size}: it is cut short, or the size is wrong. "
                f"{FETCH_AGAIN}"
            )
        members[name] = member
        last, at = repr(name), following


def _require_end(file: BinaryFile, left: int, *, place: str) -> None:
    if left < len(END_OF_ARCHIVE):
        raise ShardError(
            f"{place} there are only {left} of the {len(END_OF_ARCHIVE)} zeros that end the "
            f"archive: the shard is cut short. {FETCH_AGAIN}"
        )
    for chunk in read_chunks(file, left - BLOCK_BYTES):
        if chunk.strip(b"\0"):
            raise ShardError(
                f"{place} zeros end the archive, but other bytes follow them: a header was "
                f"overwritten, or something was appended. {FETCH_AGAIN}"
            )


def _parse_header(block: bytes, *, place: str) -> tuple[str, int]:
    """Return the name and size in a header, which must be that of a regular file."""
    try:
        info = tarfile.TarInfo.frombuf(block, "latin-1", "strict")
    except tarfile.HeaderError as error:
        raise ShardError(f"{place} the header is damaged ({error}). {FETCH_AGAIN}") from error
    refused = f"{place} member {info.name!r}"
    kind = block[156:157]
    if kind != tarfile.REGTYPE or block[257:265] != tarfile.POSIX_MAGIC:
        raise ShardError(
            f"{refused} is of the tar kind {kind!r} with the magic {block[257:265]!r}, but a shard "
            f"holds regular files of POSIX ustar only. Use a shard that this package packed."
        )
    unfit = _unfit_name(info.name)
    if unfit:
        raise ShardError(f"{refused}: {unfit}. Do not use this shard.")
    if info.size < 0:
        raise ShardError(f"{refused} has the size {info.size}. Do not use this shard.")
    return info.name, info.size


class Checksums(NamedTuple):
    """The sha256 of a whole file in hex, and zlib's crc32 of parts of it."""

    sha256: str
    crc32s: tuple[int, ...]


def read_checksums(
    file: BinaryFile,
    size: int,
    *,
    parts: Sequence[tuple[int, int]],
    after_bytes: Advance,
) -> Checksums:
    """Return the checksums of an open file, read once from start to end.

    Args:
        file: Open for reading, seekable.
        size: How many bytes it has.
        parts: (offset, size) of each part; ascending, inside the file, none over another.
        after_bytes: Called with the number of bytes, after each few megabytes.

    Raises:
        ShardError: If the file ends before its size.
    """
    whole = hashlib.sha256()
    crc32s, at = [], 0
    file.seek(0)

    def crc32_of_next(length: int) -> int:
        return copy_with_crc32(read_chunks(file, length, after_bytes=after_bytes), whole.update)

    for offset, length in parts:
        crc32_of_next(offset - at)
        crc32s.append(crc32_of_next(length))
        at = offset + length
    crc32_of_next(size - at)
    return Checksums(whole.hexdigest(), tuple(crc32s))


def read_chunks(
    file: BinaryFile, length: int, *, after_bytes: Advance = no_advance
) -> Iterator[bytes]:
    """Yield the next ``length`` bytes of a file, a few megabytes at a time.

    Raises:
        ShardError: If the file ends before.
    """
    left = length
    while left > 0:
        chunk = file.read(min(left, CHUNK_BYTES))
        if not chunk:
            raise ShardError(
                f"{getattr(file, 'name', 'the shard')}: ends {left} bytes before its size. It is "
                f"being changed: wait until that is over, then try again."
            )
        left -= len(chunk)
        yield chunk
        after_bytes(len(chunk))
