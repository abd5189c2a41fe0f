"""Tar files as shards use them: POSIX ustar with regular files and ASCII names only.

Python's ``tarfile`` makes the headers. A shard's bytes depend on the names, sizes and contents of
its members alone, and its index says where each lies: no tar is parsed, and nothing extracted.

A member is a header of one block of 512 bytes, its bytes, and zeros up to a whole block. The
archive ends with two blocks of zeros.

Source: POSIX.1-2017, pax, "ustar Interchange Format".
"""

import tarfile
from collections.abc import Iterator
from typing import Final

from stereogenbench_data.engine import Advance, no_advance
from stereogenbench_data.errors import ShardError
from stereogenbench_data.media.container import BinaryFile

BLOCK_BYTES: Final = tarfile.BLOCKSIZE
END_OF_ARCHIVE: Final = bytes(2 * BLOCK_BYTES)

CHUNK_BYTES: Final = 4 * 1024 * 1024
"""How much of a file is read at a time."""

_SHORT_NAME: Final = 100
_FITTING_BYTES: Final = 8**11
"""What a header holds without a prefix of the name: so many characters, and fewer bytes."""

_CHECKSUM: Final = slice(148, 156)
_DEVICES: Final = slice(329, 345)


def padded(size: int) -> int:
    """Return a size rounded up to whole blocks."""
    return -(-size // BLOCK_BYTES) * BLOCK_BYTES


def member_header(name: str, size: int) -> bytes:
    """Return the header block of a member, with mode 0644, owner 0 and time 0.

    Raises:
        ShardError: If ustar cannot hold such a member.
    """
    info = tarfile.TarInfo(name)
    info.size = size
    try:
        header = bytearray(info.tobuf(tarfile.USTAR_FORMAT, "ascii", "strict"))
    except ValueError as error:
        raise ShardError(
            f"member {name!r}: has {size} bytes, and ustar cannot hold it ({error}): its names are "
            f"in ASCII and have 100 characters, or 155 before a slash and 100 after it, its files "
            f"less than 8 GiB. Rename its folders, or split the file."
        ) from error
    header[_DEVICES] = b"0000000\0" * 2  # in which the versions of tarfile differ
    header[_CHECKSUM] = b" " * 8
    header[_CHECKSUM] = b"%06o\0 " % sum(header)
    return bytes(header)


def require_member(name: str, size: int) -> None:
    """Refuse a member that ustar cannot hold.

    Raises:
        ShardError: If so.
    """
    # Nearly every member is of this kind, and a header costs 60 times as much as a look.
    if not (name.isascii() and len(name) <= _SHORT_NAME and size < _FITTING_BYTES):
        member_header(name, size)


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
