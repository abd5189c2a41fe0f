"""A member's bytes as a seekable, read-only file of their own."""

import errno
import os
import stat
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Final

from stereogenbench_data.errors import ShardError, StorageError
from stereogenbench_data.media.container import SeekableFile
from stereogenbench_data.media.seek_table import SeekTable
from stereogenbench_data.schema.records import Member

FIRST_BLOCK: Final = 64 * 1024
"""Bytes of the first block where reading starts."""

LARGEST_BLOCK: Final = 1024 * 1024
"""Bytes to which blocks grow while reading continues where the previous one ended."""

KEPT_BYTES: Final = 2 * LARGEST_BLOCK
"""Bytes of a member that are kept for reading again: a file's header, nearby frames."""


class FileSlice(SeekableFile):
    """A member of a local shard or of the cache; it stays readable if the file is replaced."""

    def __init__(self, path: Path, member: Member) -> None:
        """Open the file that holds the member's bytes.

        Raises:
            OSError: If it cannot be opened, or is not a file.
        """
        super().__init__(member.size)
        self._path = path
        self._offset = member.offset
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):  # opening a pipe would wait for its writer
            code = errno.EISDIR if stat.S_ISDIR(mode) else errno.EINVAL
            raise OSError(code, "not a regular file")
        self._file = path.open("rb")

    def status(self) -> os.stat_result:
        """Return what the operating system knows of the whole file that holds the member."""
        return os.fstat(self._file.fileno())

    def crc32(self) -> int:
        """Return the crc32 of the member's bytes, having read them all."""
        crc32 = 0
        for start in range(0, self.size, LARGEST_BLOCK):
            stop = min(start + LARGEST_BLOCK, self.size)
            crc32 = zlib.crc32(self._bytes(start, stop), crc32)
        return crc32

    def close(self) -> None:
        """Close the file."""
        # This is also called when __init__ has failed.
        if not self.closed and hasattr(self, "_file"):
            self._file.close()
        super().close()

    def _bytes(self, start: int, stop: int) -> bytes:
        self._file.seek(self._offset + start)
        data = self._file.read(stop - start)
        if len(data) < stop - start:
            raise StorageError(
                f"{self._path}: ends at byte {self._file.tell()}, within a member of "
                f"{self.size} bytes from {self._offset} on. It was cut short while it was "
                f"open: fetch it again."
            )
        return data


class RangedFile(SeekableFile):
    """A member whose bytes are fetched in blocks as they are read, ahead of the reader.

    Blocks start small and double while reading continues where one ended, so a first frame costs
    little and a whole pass needs few requests. A forward pass fetches no byte twice, and none
    beyond the member. Once all bytes have arrived, they are compared with their checksum.

    A video whose seek table is known is opened by the table's header, and read by packets: bytes
    are fetched up to the end of their packet, and fewer than asked for are returned there. Bytes
    that were fetched ahead come from there.

    Attributes:
        failure: The error of the first fetch that failed, which was raised; the file ends there.
    """

    is_far = True

    def __init__(
        self,
        fetch: Callable[[int, int], bytes],
        *,
        size: int,
        name: str = "",
        crc32: int | None = None,
        table: SeekTable | None = None,
        ahead: Callable[[int], tuple[int, bytes] | None] = lambda at: None,
    ) -> None:
        """Prepare to read; nothing is fetched yet.

        Args:
            fetch: Returns the bytes of the member from a start to a stop.
            size: The size of the member in bytes.
            name: What messages call it.
            crc32: Its checksum; None compares nothing.
            table: Where its packets lie, of a video.
            ahead: Returns what was fetched ahead around a byte, and where that begins, which may
                be before the member, and end behind it; None if nothing was.
        """
        super().__init__(size)
        self.failure: StorageError | None = None
        self._fetch = fetch
        self._table = table
        self._ahead = ahead
        self._fed_from: int | None = None
        self.opens_by_header = table is not None and table.opening == 0
        self.packets = None if table is None else table.packets
        self._blocks: list[tuple[int, bytes]] = []
        self._checksum = None if crc32 is None else _Checksum(crc32, size=size, name=name)
        if self._checksum is not None and table is not None:
            self._checksum.add(0, table.head)
            self._checksum.add(table.bounds[-1], table.tail)

    def keep(self, start: int, data: bytes) -> None:
        """Keep bytes from a start on that were fetched before."""
        self._blocks.append((start, data))

    def close(self) -> None:
        """Free what was fetched."""
        self._blocks.clear()
        super().close()

    def _bytes(self, start: int, stop: int) -> bytes:
        if self.failure is not None:
            return b""  # FFmpeg tries again, and PyAV raises the first error, if there is no other
        table = self._table
        if table is not None:
            header = table.header_bytes(start, stop)
            if header or self.hides_packets:
                return header
            first, data = self._piece(start, table.packet_end(start))
            return data[start - first : stop - first]
        parts: list[bytes] = []
        while start < stop:
            first, data = self._piece(start, stop)
            parts.append(data[start - first : stop - first])
            start += len(parts[-1])
        return b"".join(parts)

    def _piece(self, start: int, stop: int) -> tuple[int, bytes]:
        """Return bytes from start on, with where they begin: fetched ahead, or now."""
        try:
            found = self._ahead(start)
            if found is None:
                return self._block(start, min(stop, self.size))
            if self._checksum is not None and found[0] != self._fed_from:
                self._fed_from, own = found[0], max(0, found[0])
                self._checksum.add(own, found[1][own - found[0] : max(0, self.size - found[0])])
        except StorageError as error:
            self.failure = error
            raise
        return found

    def _block(self, start: int, stop: int) -> tuple[int, bytes]:
        """Return a block that holds the byte at start; the last one used comes last."""
        for number, (first, data) in enumerate(self._blocks):
            if first <= start < first + len(data):
                self._blocks.append(self._blocks.pop(number))
                return self._blocks[-1]
        before = [len(data) for first, data in self._blocks if first + len(data) == start]
        length = min(2 * max(before, default=FIRST_BLOCK // 2), LARGEST_BLOCK)
        behind = [first for first, _ in self._blocks if first > start]
        end = min(max(start + length, stop), self.size, *behind)
        block = (start, self._fetch(start, end))
        if self._checksum is not None:
            self._checksum.add(*block)
        self._blocks.append(block)
        while sum(len(data) for _, data in self._blocks) > KEPT_BYTES and len(self._blocks) > 1:
            self._blocks.pop(0)
        return block


class _Checksum:
    """The crc32 of a member whose parts arrive in nearly ascending order.

    A part that lies ahead, such as an MP4 file's table at its end, waits for those before it. If
    too much would have to wait, as when single frames are read, nothing is compared.
    """

    def __init__(self, expected: int, *, size: int, name: str) -> None:
        self._expected = expected
        self._size = size
        self._name = name
        self._crc32 = 0
        self._end = 0
        self._ahead: dict[int, bytes] = {}

    def add(self, start: int, data: bytes) -> None:
        """Add a part; the last one completes the comparison.

        Raises:
            ShardError: If the checksum is another than the one expected.
        """
        if self._end >= min(self._size, start + len(data)):
            return
        seen = max(0, self._end - start)
        self._ahead[start + seen] = data[seen:]
        while self._end in self._ahead:
            following = self._ahead.pop(self._end)
            self._crc32 = zlib.crc32(following, self._crc32)
            self._end += len(following)
        if sum(map(len, self._ahead.values())) > LARGEST_BLOCK:
            self._end = self._size + 1
            self._ahead.clear()
        if self._end == self._size:
            require_crc32(self._crc32, expected=self._expected, name=self._name)


def require_crc32(found: int, *, expected: int | None, name: str) -> None:
    """Refuse a member whose bytes have changed since it was indexed.

    Raises:
        ShardError: If the checksum is another than the one expected; None expects any.
    """
    if expected not in (None, found):
        raise ShardError(
            f"{name}: has crc32 {found:08x}, and the index says {expected:08x}. It was damaged or "
            f"replaced: fetch it again."
        )
