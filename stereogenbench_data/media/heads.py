"""A video file without its packets: a few kB that tell where each frame lies and when it is shown.

Time, place, size and key flag of every frame stand in front of Matroska's blocks and in MP4's
tables. FFmpeg tells them of packets that it reads whole. So it is given a file of the same size
whose packets are zeros but for their first bytes, and says the same of it as of the video itself.

Source: RFC 8794 (EBML), RFC 9559 (Matroska), ISO/IEC 14496-12 (MP4).
"""

from bisect import bisect_right
from collections.abc import Iterator
from contextlib import contextmanager
from io import FileIO
from pathlib import Path
from typing import Final

from stereogenbench_data.errors import explain_os_errors
from stereogenbench_data.media.container import (
    BinaryFile,
    SeekableFile,
    VideoFile,
    require_file,
)

END_BYTES: Final = 16 * 1024
"""How much of a file that is far away is looked at, at its begin and at its end."""

_BEGIN_BYTES: Final = 4096
"""Bytes that are read at the file's begin and of the first packet, which tell the pixel format."""
_HEAD_BYTES: Final = 32
"""Bytes that are read where a block or a box begins."""

_MOST_ELEMENTS: Final = 2**18
"""A file with more blocks or boxes is read through."""

_EBML: Final = b"\x1a\x45\xdf\xa3"
_ENTERED: Final = (0x18538067, 0x1F43B675, 0xA0, 0x1654AE6B, 0xAE)
"""Segments, clusters, groups of blocks, lists of tracks, and tracks: their parts are looked at."""
_BLOCKS: Final = (0xA3, 0xA1)
_VOID: Final = 0xEC
_ENCODINGS: Final = 0x6D80
"""Packets of such a track are compressed or encrypted: all their bytes are needed."""
_BLOCK_BYTES: Final = 16
"""Bytes of a block with its track, its time and its flags."""
_LACING: Final = 0x06
"""The bits of a block's flags that tell how several packets are put into it."""
_LONGEST_ELEMENT: Final = 12
"""Bytes of an element's number and size."""

_FIRST_BOXES: Final = (b"ftyp", b"styp", b"moov", b"mdat", b"free", b"skip", b"wide")
_PACKETS: Final = (b"mdat", b"free", b"skip")
"""Boxes whose content is left out."""
_BOX_BYTES: Final = 16
"""Bytes of a box's size and type, with a long size behind them."""


class Heads(SeekableFile):
    """A video whose packets seem to be zeros.

    Attributes:
        video: The video: a path, or an open file.
    """

    has_packets = False
    _is_own = False

    def __init__(self, video: VideoFile) -> None:
        """Begin with a video of which nothing is known.

        Raises:
            OSError: If it cannot be opened.
        """
        self._file: BinaryFile = FileIO(video) if isinstance(video, str | Path) else video
        self._is_own = isinstance(video, str | Path)
        super().__init__(self._file.seek(0, 2))
        self.video = video
        self._starts: list[int] = []
        self._parts: list[bytearray] = []
        self._hidden = range(0)

    def know(self, start: int, count: int) -> bytes:
        """Return bytes from a start on, not before those that were known last; fewer at the end."""
        stop = min(start + count, self.size)
        if not self._starts or start > self._starts[-1] + len(self._parts[-1]):
            self._starts.append(start)
            self._parts.append(bytearray())
        first, known = self._starts[-1], self._parts[-1]
        if first + len(known) < stop:
            end = min(max(stop, start + _HEAD_BYTES), self.size)
            known += self.exact(first + len(known), end)
        return bytes(known[start - first : stop - first])

    def exact(self, start: int, stop: int) -> bytes:
        """Return bytes of the video itself, fewer at the end."""
        stop = min(stop, self.size)
        number = bisect_right(self._starts, start) - 1
        first, known = self._starts[number], self._parts[number]
        if start >= first and stop <= first + len(known):
            return bytes(known[start - first : stop - first])
        found = b""
        self._file.seek(start)
        while len(found) < stop - start and (more := self._file.read(stop - start - len(found))):
            found += more
        return found

    def hide(self, start: int, stop: int) -> None:
        """Let the video seem to end between two places, where nothing of it is known."""
        self._hidden = range(start, stop)

    def close(self) -> None:
        """Close the video if it was opened for this."""
        if self._is_own:
            self._file.close()
        super().close()

    def _bytes(self, start: int, stop: int) -> bytes:
        if start in self._hidden:
            return b""
        stop = min(stop, self._hidden.start) if start < self._hidden.start else stop
        found = bytearray(stop - start)
        for number in range(max(0, bisect_right(self._starts, start) - 1), len(self._starts)):
            first, known = self._starts[number], self._parts[number]
            if first >= stop:
                break
            begin, end = max(start, first), min(stop, first + len(known))
            if begin < end:
                found[begin - start : end - start] = known[begin - first : end - first]
        return bytes(found)


@contextmanager
def heads_of(file: VideoFile, *, name: str) -> Iterator[VideoFile]:
    """Yield a video without its packets; itself where only reading it through shows where they are.

    Of a Matroska file that is far away, the first block and the file's end are looked at; in
    between it seems to end.

    Args:
        file: A path, or a seekable binary file; the latter stays the caller's to close. `Heads`
            are yielded as they are.
        name: What messages call the file.

    Raises:
        StorageError: If the file cannot be read.
        MediaError: If it is empty.
    """
    if isinstance(file, Heads):
        yield file
        return
    if isinstance(file, str | Path):
        require_file(Path(file), name=name)
    with explain_os_errors(f"{name}: cannot be read"):
        heads = Heads(file)
    with heads:
        with explain_os_errors(f"{name}: cannot be read"):
            is_known = _knows(heads)
        yield heads if is_known else file


def _knows(heads: Heads) -> bool:
    """Look at all of a video but its packets; return whether it could be understood."""
    begin = heads.know(0, _BEGIN_BYTES)
    if begin.startswith(_EBML):
        return _knows_blocks(heads)
    return begin[4:8] in _FIRST_BOXES and _knows_boxes(heads)


def _knows_blocks(heads: Heads) -> bool:
    """Look at a Matroska file; return whether it could be understood.

    The sizes of elements that are entered do not count: they may be unknown.
    """
    at, looked_at = 0, _BEGIN_BYTES
    for _ in range(_MOST_ELEMENTS):
        if at >= heads.size:
            return True
        number, begin, size = _element(heads, at)
        if number in _ENTERED:
            at = begin
            continue
        if size is None or number == _ENCODINGS:
            return False
        at = begin + size
        if number in _BLOCKS:
            if _is_laced(heads.know(begin, min(size, looked_at))):
                return False
            looked_at = _BLOCK_BYTES
            if is_far(heads):
                end = max(at, heads.size - END_BYTES)
                heads.know(end, END_BYTES)
                heads.hide(at, end)
                return True
        elif number != _VOID:
            heads.know(begin, size)
    return False


def _is_laced(block: bytes) -> bool:
    """Return whether a block has several packets, whose sizes may take up any number of bytes."""
    digits = 9 - block[:1].ljust(1, b"\0")[0].bit_length()
    return bool(int.from_bytes(block[digits + 2 : digits + 3]) & _LACING)


def _element(heads: Heads, at: int) -> tuple[int, int, int | None]:
    """Return an element's number, where its content begins, and its size if that is known."""
    head = heads.know(at, _LONGEST_ELEMENT).ljust(_LONGEST_ELEMENT, b"\0")
    digits = 9 - head[0].bit_length()
    sizes = 9 - head[min(digits, 4)].bit_length()
    if digits > 4 or sizes > 8:
        return 0, at, None
    unknown = (1 << 7 * sizes) - 1
    size = int.from_bytes(head[digits : digits + sizes]) & unknown
    return int.from_bytes(head[:digits]), at + digits + sizes, None if size == unknown else size


def _knows_boxes(heads: Heads) -> bool:
    """Look at an MP4 file; return whether it could be understood."""
    at, looked_at = 0, _BEGIN_BYTES
    for _ in range(_MOST_ELEMENTS):
        if at >= heads.size:
            return True
        head = heads.know(at, _BOX_BYTES)
        size, kind = int.from_bytes(head[:4]), head[4:8]
        if size == 1:
            size = int.from_bytes(head[8:])
        elif size == 0:
            size = heads.size - at
        if size < 8:
            return False
        if kind not in _PACKETS:
            heads.know(at, size)
        elif kind == b"mdat":
            heads.know(at, min(size, looked_at))
            looked_at = _BOX_BYTES
        at += size
    return False


def is_far(file: VideoFile) -> bool:
    """Return whether each read of a video takes as long as a request."""
    video = file.video if isinstance(file, Heads) else file
    return isinstance(video, SeekableFile) and video.is_far
