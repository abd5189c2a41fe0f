"""Seek tables: where the packets of a video lie, so that one request fetches any frame of it.

A table parts a file at the ends of its packets. What lies before the first packet and behind the
last one is the header, which the table holds; so a video that is far away is opened without a
request. What a container writes in front of a packet belongs to the packet.

A table only says which bytes to fetch. Frames are still found by the times in the file, so a wrong
table costs time and never gives another frame. Tables may come from strangers, and are checked.
"""

import json
import struct
import zlib
from bisect import bisect_right
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import av
import numpy as np
from av.container import InputContainer

from stereogenbench_data.errors import MediaError
from stereogenbench_data.media.container import (
    SeekableFile,
    VideoFile,
    open_container,
    stream_codec,
)
from stereogenbench_data.media.decoder import BLIND_JUMP, times_by_cues
from stereogenbench_data.media.depth_frames import PACKED_SUFFIX, DepthFrames
from stereogenbench_data.media.heads import END_BYTES, Heads, heads_of, is_far

LARGEST_HEADER: Final = 256 * 1024
"""Bytes of a video's header that a table holds; a video with a longer one has no table."""

READ_THROUGH: Final = 64 * 1024
"""FFmpeg reads on rather than to seek where what it wants is no further away."""

_MOST_PACKETS: Final = 2**17
_LARGEST_TABLES: Final = 64 * 2**20
_MAGIC: Final = b"seek1"
_LENGTH: Final = struct.Struct(">I")
_UNPACK_ERRORS: Final = (
    zlib.error, struct.error, ValueError, LookupError, TypeError, RecursionError, OverflowError,
)  # fmt: skip
"""What bytes raise that are no packed tables."""
_LONGEST_SPAN: Final = 2**32 - 1
_CUES: Final = b"\x1c\x53\xbb\x6b"
"""What Matroska's list of key frames begins with."""
_LOOKED_BEHIND: Final = 64
_BLOCK_HEADER_BYTES: Final = 4
"""What Matroska writes between where FFmpeg finds a packet and the packet's own bytes."""


@dataclass(frozen=True, slots=True)
class SeekTable:
    """Where the packets of a video lie, in the order in which they are decoded.

    Attributes:
        bounds: The bytes of packet i are those from bounds[i] to bounds[i + 1].
        keys: The packets, ascending from 0, at which decoding can begin. Each has the number of its
            frame.
        delay: How many more packets the decoder takes before it gives a frame.
        has_neighbours: Whether the packets around a frame are read too, to compare their times.
        opening: How many packets are read when the file is opened.
        blind_jump: How many frames the reader decodes through rather than to seek, before it knows
            the key frames; 0 where the header lists them.
        head: The bytes before the first packet.
        tail: The bytes behind the last one; empty where they are never read.
    """

    bounds: tuple[int, ...]
    keys: tuple[int, ...]
    delay: int = 0
    has_neighbours: bool = False
    opening: int = 0
    blind_jump: int = 0
    head: bytes = b""
    tail: bytes = b""

    @property
    def packets(self) -> int:
        """How many packets there are."""
        return len(self.bounds) - 1

    def key_before(self, packet: int) -> int:
        """Return the last packet, at or before one, at which decoding can begin."""
        return self.keys[bisect_right(self.keys, packet) - 1]

    def packet_end(self, byte: int) -> int:
        """Return where the packet ends that holds a byte."""
        return self.bounds[min(bisect_right(self.bounds, byte), self.packets)]

    def header_bytes(self, start: int, stop: int) -> bytes:
        """Return the bytes of the header between two places, none where packets lie."""
        end = self.bounds[-1]
        return self.head[start:stop] if start < end else self.tail[start - end : stop - end]

    def fits(self, *, file_bytes: int) -> bool:
        """Return whether it can be the table of a file of this size in bytes."""
        end = self.bounds[-1]
        return end + len(self.tail) == file_bytes if self.tail else end <= file_bytes


class ReadCursor:
    """Where a reader of a video is: it tells which bytes each next frame needs.

    It does what `decoder.Decoder` does with the file. Where they differ, bytes are fetched one
    request later.
    """

    def __init__(self, table: SeekTable, *, kept_frames: int = 1) -> None:
        """Begin with a video that is not open, and of which so many frames will be kept."""
        self._table = table
        self._kept: deque[int] = deque(maxlen=kept_frames)
        self._is_open = False
        self._next = self._end = 0
        self._knows_key_frames = table.blind_jump == 0

    def needed(self, frame: int) -> list[tuple[int, int]]:
        """Return the ranges of bytes that reading a frame needs, and go on behind it."""
        table = self._table
        if not 0 <= frame < table.packets or frame in self._kept:
            return []
        self._kept.append(frame)
        opened = 0 if self._is_open else table.opening
        self._end = max(self._end, opened)
        start, stop = self._end, min(frame + table.delay + 1, table.packets)
        looked_through = 0
        if self._must_seek(frame):
            start = table.key_before(max(0, frame - 1) if table.has_neighbours else frame)
            if frame == 0 and table.has_neighbours:
                stop = min(2, table.packets)
            if table.blind_jump and start == table.keys[-1]:
                looked_through = table.packets  # FFmpeg looks for a further key frame
            self._knows_key_frames = True
        gap = table.bounds[start] - table.bounds[self._end]
        if self._end and 0 < gap <= READ_THROUGH:
            start = self._end
        self._is_open, self._next, self._end = True, frame + 1, max(start, stop)
        if start < stop and table.bounds[start] == table.bounds[stop]:
            start = table.key_before(start)  # it lies somewhere behind its key frame: keep all that
        parts = [(0, min(opened, start)), (start, max(stop, looked_through))]
        return [(table.bounds[a], table.bounds[b]) for a, b in parts if a < b]

    def _must_seek(self, frame: int) -> bool:
        if not self._is_open and self._table.opening == 0:
            return True
        if frame <= self._next:
            return frame < self._next
        if not self._knows_key_frames:
            return frame - self._next > self._table.blind_jump
        return self._table.key_before(frame) >= self._end


class HeaderFile(SeekableFile):
    """A video without its packets: where these are, the file seems to end."""

    def __init__(self, table: SeekTable) -> None:
        """Begin at the start."""
        super().__init__(table.bounds[-1] + len(table.tail))
        self._table = table

    def _bytes(self, start: int, stop: int) -> bytes:
        return self._table.header_bytes(start, stop)


def read_seek_table(file: VideoFile, *, name: str) -> SeekTable | None:
    """Return a video's seek table; None if it cannot have one.

    Packets must lie in the order in which they are decoded, and the header must not be large. Of a
    Matroska file that is far away, those from one key frame to the next count as one.

    Args:
        file: A path, or a seekable binary file; the latter stays the caller's to close.
        name: What messages call the file.

    Raises:
        StorageError: If the file cannot be read.
        MediaError: If it is not a video.
    """
    if name.endswith(PACKED_SUFFIX):
        with DepthFrames(file, name=name, frames="any") as depth:
            bounds = depth.chunk_bounds
        packed = SeekTable(bounds, tuple(range(depth.frames)))
        return _with_header(packed, file, file_bytes=bounds[-1])
    with heads_of(file, name=name) as known:
        table = _table_of(known, name=name)
        if table is None and isinstance(known, Heads) and is_far(known):
            table = _table_of(known.video, name=name)
    return table


def _table_of(file: VideoFile, *, name: str) -> SeekTable | None:
    with open_container(file, name=name) as container:
        file_bytes, begins = container.size, container.streams.video[0].start_time
        try:
            if container.streams.video[0].frames:
                found = _listed(container)
            elif is_far(file):
                found = _by_clusters(container, file)
            else:
                found = _gone_through(container, file)
        except av.FFmpegError as error:
            raise MediaError(
                f"{name}: its packets cannot be read ({error.strerror}): fetch it again."
            ) from error
    table = _with_header(found, file, file_bytes=file_bytes)
    if table is None or table.opening:
        return table
    # FFmpeg reads on, where the file would seem to end, if a key frame is near the first packet.
    near = table.bounds[0] + READ_THROUGH
    if not any(table.bounds[key] <= near for key in table.keys[1:]):
        # An MP4 file can be opened without a packet, unless it is tiny.
        with (
            suppress(MediaError),
            open_container(HeaderFile(table), name=name) as container,
        ):
            if container.streams.video[0].start_time == begins:
                return table
    return replace(table, opening=1)


def _listed(container: InputContainer) -> SeekTable | None:
    """Return the table by an MP4 header, which lists all packets."""
    stream = container.streams.video[0]
    entries = list(stream.index_entries)
    begins = stream.start_time or 0
    before = sum(entry.timestamp < begins for entry in entries)
    is_in_order = all(a.pos + a.size <= b.pos for a, b in pairwise(entries))
    if not entries or not is_in_order or any(entry.is_discard for entry in entries):
        return None
    return SeekTable(
        (*(entry.pos for entry in entries), entries[-1].pos + entries[-1].size),
        tuple(number for number, each in enumerate(entries) if each.is_keyframe),
        delay=min(max(before, stream.codec_context.reorder_depth), len(entries)),
        has_neighbours=stream_codec(container).is_intra_only,
    )


def _gone_through(container: InputContainer, file: VideoFile) -> SeekTable | None:
    """Return the table of a Matroska file, all of whose packets are read."""
    stream = container.streams.video[0]
    ends: list[int] = []
    keys: list[int] = []
    times: list[int] = []
    ahead, latest = 0, -(2**63)
    for packet in container.demux(stream):
        if packet.size == 0:
            continue
        if packet.pos is None or packet.pts is None:
            return None
        if packet.is_keyframe:
            keys.append(len(ends))
        ends.append(packet.pos + _BLOCK_HEADER_BYTES + packet.size)
        if packet.pts < latest:
            ahead = max(ahead, sum(time > packet.pts for time in times[-32:]))
        latest = max(latest, packet.pts)
        times.append(packet.pts)
    entries = stream.index_entries
    if not ends or not len(entries):
        return None
    # A cluster begins before its first packet, and the list of key frames follows the last one.
    cues = _read(file, ends[-1], ends[-1] + _LOOKED_BEHIND).find(_CUES)
    ends[-1] += max(0, cues)
    return SeekTable(
        (entries[0].pos, *ends),
        tuple(keys),
        delay=ahead,
        has_neighbours=stream_codec(container).is_intra_only,
        opening=1,
        blind_jump=BLIND_JUMP,
    )


def _by_clusters(container: InputContainer, file: VideoFile) -> SeekTable | None:
    """Return the table of a Matroska file by its list of key frames, of which each begins a part.

    The frames behind a key frame lie somewhere in its part.
    """
    found = times_by_cues(container)
    if found is None:
        return None
    times, keys = found
    places = [entry.pos for entry in container.streams.video[0].index_entries]
    frames, end_bytes = len(times), container.size
    last = _read(file, max(0, end_bytes - END_BYTES), end_bytes)
    cues = last.rfind(_CUES)
    if cues < 0:
        return None
    end = end_bytes - len(last) + cues
    bounds = [0] * frames
    ends, stops = [*places[1:], end], [*keys[1:], frames]
    for key, pos, stop, part_end in zip(keys, places, stops, ends, strict=True):
        bounds[key:stop] = [pos, *[part_end] * (stop - key - 1)]
    return SeekTable(
        (*bounds, end),
        tuple(keys),
        has_neighbours=stream_codec(container).is_intra_only,
        opening=1,
        blind_jump=BLIND_JUMP,
    )


def _read(file: VideoFile, start: int, stop: int) -> bytes:
    if isinstance(file, Heads):
        return file.exact(start, stop)
    if isinstance(file, str | Path):
        with Path(file).open("rb", buffering=0) as opened:
            opened.seek(start)
            return opened.read(stop - start)
    file.seek(start)
    return file.read(stop - start)


def _with_header(table: SeekTable | None, file: VideoFile, *, file_bytes: int) -> SeekTable | None:
    """Return a table with the header's bytes, None if it is not sound or the header is large."""
    if table is None or not _is_sound(table):
        return None
    first, last = table.bounds[0], table.bounds[-1]
    if first + file_bytes - last > LARGEST_HEADER:
        return None
    return replace(table, head=_read(file, 0, first), tail=_read(file, last, file_bytes))


def _is_sound(table: SeekTable) -> bool:
    """Return whether packets follow each other, and decoding can begin at the first one."""
    bounds, keys = table.bounds, table.keys
    return (
        2 <= len(bounds) <= _MOST_PACKETS
        and keys[:1] == (0,)
        and bounds[0] >= 0
        and all(0 <= b - a <= _LONGEST_SPAN for a, b in pairwise(bounds))
        and all(a < b for a, b in pairwise((*keys, table.packets)))
        and min(table.delay, table.opening, table.blind_jump) >= 0
        and max(table.delay, table.opening) <= table.packets
    )


def packed_tables(tables: Mapping[str, SeekTable]) -> bytes:
    """Return the tables of a scene's videos in few bytes."""
    described = []
    headers, spans = b"", b""
    for name, each in sorted(tables.items()):
        keys = np.diff(each.keys, prepend=0).tolist()
        reads = (each.delay, int(each.has_neighbours), each.opening, each.blind_jump)
        sizes = (len(each.head), len(each.tail), each.bounds[0])
        described.append([name, each.packets, keys, *reads, *sizes])
        headers += each.head + each.tail
        # As MP4 headers hold the sizes of packets, so that they are compressed to nothing.
        spans += np.diff(each.bounds).astype(">u4").tobytes()
    text = json.dumps(described, separators=(",", ":")).encode()
    return _MAGIC + zlib.compress(_LENGTH.pack(len(text)) + text + headers + spans, 9)


def parse_tables(packed: bytes) -> dict[str, SeekTable]:
    """Return the tables that `packed_tables` packed; {} if these bytes are not such tables."""
    if packed[: len(_MAGIC)] != _MAGIC:
        return {}
    try:
        content = zlib.decompressobj().decompress(packed[len(_MAGIC) :], _LARGEST_TABLES)
        (length,) = _LENGTH.unpack_from(content)
        content = content[_LENGTH.size :]
        return _parsed(json.loads(content[:length]), content[length:])
    except _UNPACK_ERRORS:
        return {}


def _parsed(described: Any, content: bytes) -> dict[str, SeekTable]:
    tables = {}
    at, spans_at = 0, sum(int(row[7]) + int(row[8]) for row in described)
    for name, packets, keys, *reads in described:
        delay, has_neighbours, opening, blind_jump, head, tail, first = map(int, reads)
        if packets > _MOST_PACKETS:
            return {}
        spans = np.frombuffer(content, dtype=">u4", count=packets, offset=spans_at)
        tables[str(name)] = table = SeekTable(
            (first, *(first + np.cumsum(spans, dtype=np.int64)).tolist()),
            tuple(np.cumsum(keys, dtype=np.int64).tolist()),
            delay=delay,
            has_neighbours=bool(has_neighbours),
            opening=opening,
            blind_jump=blind_jump,
            head=content[at : at + head],
            tail=content[at + head : at + head + tail],
        )
        sizes = (table.packets, len(table.head), first, len(table.tail))
        if sizes != (packets, head, head, tail) or not _is_sound(table):
            return {}
        at += head + tail
        spans_at += 4 * packets
    return tables
