"""Which frame a time stands for, and one run of a decoder that seeks, skips, and misses none.

Clocks map presentation times to frame numbers, counted in the order of presentation: `SteadyClock`
needs only the header and holds for a constant frame rate; `TableClock` knows the time of every
frame. Times are integers in ticks of the stream's time base.

A `Decoder` raises `UnexpectedPicture` at the first picture that is not due by its clock. Its caller
decides whether the file is at fault.

FFV1 keeps a checksum in each slice of a picture. FFmpeg's decoder replaces a damaged slice with
that of the picture before and only logs it. So checksums are verified before a packet is decoded.

Source: RFC 9043, sections 4.8 (slice footer) and 4.9.3 (CRC-32, most significant bit first).
"""

import zlib
from bisect import bisect_left
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain, islice, pairwise
from time import perf_counter
from typing import TYPE_CHECKING, Final

import av
from av.container import InputContainer
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from stereogenbench_data.errors import MediaError
from stereogenbench_data.media.container import (
    Effort,
    Placed,
    exact,
    frames_by_duration,
    stream_codec,
)

if TYPE_CHECKING:
    VideoPacket = Packet[VideoStream]
else:
    VideoPacket = Packet  # generic only in PyAV's stubs

MOST_EXTRA_FRAMES: Final = 2
"""How many frames a video may have beyond those that its scene uses."""

BLIND_JUMP: Final = 8
"""Frames to decode through rather than to seek, while a file's key frames are not known."""

_SIZE_BYTES: Final = 3
_FOOTER_BYTES: Final = 8
"""A footer with a checksum: three bytes of size, one of error status, four of checksum."""

_MIRRORED: Final = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
"""Bytes with their bits in reverse order: zlib's CRC-32 takes the least significant bit first."""

_CHECKSUM_STARTS: Final = (0xFFFFFFFF, 0xA1CEFD61)
"""What zlib's CRC-32 starts from, and ends at over a whole slice: FFV1 of version 3, and of
version 4 as FFmpeg's experimental encoder writes it."""


@dataclass(frozen=True, slots=True)
class SteadyClock:
    """Frames at one rate: frame i is shown at start + i * step ticks, give or take a rounding."""

    start: int
    step: Fraction

    # A time may be off by a tick, or by a quarter of a step where that is less. It is computed in
    # integers, as every packet asks.

    def index(self, pts: int) -> int | None:
        """Return the frame that is shown at a time, None where the time fits no frame."""
        step, parts = self.step.numerator, self.step.denominator
        since_start = (pts - self.start) * parts
        index = (2 * since_start + step) // (2 * step)
        off = abs(since_start - index * step)
        return index if 4 * off <= min(4 * parts, step) else None

    def latest(self, index: int) -> int:
        """Return the greatest time that counts as a frame's."""
        step, parts = self.step.numerator, self.step.denominator
        return self.start + (4 * index * step + min(4 * parts, step)) // (4 * parts)


@dataclass(frozen=True, slots=True)
class TableClock:
    """Frames at any times, in ascending order."""

    times: Sequence[int]

    def index(self, pts: int) -> int | None:
        """Return the frame that is shown at a time, None where no frame is."""
        index = bisect_left(self.times, pts)
        return index if index < len(self.times) and self.times[index] == pts else None

    def latest(self, index: int) -> int:
        """Return a frame's time."""
        return self.times[index]


Clock = SteadyClock | TableClock


def steady_clock(
    container: InputContainer, *, frames: int, extra: int = MOST_EXTRA_FRAMES
) -> SteadyClock | None:
    """Return the clock that the header describes, None if it contradicts itself or ``frames``.

    An MP4 header lists all samples: their number and decoding times must be those of ``frames``
    frames at one rate, or of at most ``extra`` more. A Matroska header gives only the duration.
    """
    stream = container.streams.video[0]
    rate, time_base = exact(stream.average_rate), exact(stream.time_base)
    if stream.start_time is None or rate is None or time_base is None:
        return None
    step = 1 / (rate * time_base)
    if stream.frames == 0:
        agrees = 0 <= frames_by_duration(container) - frames <= extra
    else:
        entries = list(stream.index_entries)
        agrees = (
            0 <= stream.frames - frames <= extra
            and stream.frames == len(entries)
            and not any(entry.is_discard for entry in entries)
            and all(abs(b.timestamp - a.timestamp - step) <= 1 for a, b in pairwise(entries))
        )
    return SteadyClock(stream.start_time, step) if agrees else None


def times_by_cues(container: InputContainer) -> tuple[list[Fraction], list[int]] | None:
    """Return the times of frames at the rate of a Matroska header, and the key frames it lists.

    None where the two do not agree, or one is missing.
    """
    stream = container.streams.video[0]
    frames = frames_by_duration(container)
    clock = steady_clock(container, frames=frames)
    if clock is None or frames == 0:
        return None
    with suppress(av.FFmpegError):
        container.seek(clock.latest(frames - 1), stream=stream)
    keys = [clock.index(entry.timestamp) for entry in stream.index_entries]
    known = [key for key in keys if key is not None]
    if len(known) != len(keys) or known[:1] != [0]:
        return None
    return [clock.start + i * clock.step for i in range(frames)], known


def table_clock(container: InputContainer, *, name: str) -> TableClock:
    """Return the times of all frames, read by going through all packets from where they stand.

    Frames of an intra-only codec are counted in the order of the file, with which their times
    must agree.

    Args:
        container: An open file.
        name: What messages call it.

    Raises:
        MediaError: If a packet is cut short or carries another packet's time, or one that
            contradicts the order of the file.
    """
    times: list[int] = []

    def cut_short(why: str | None) -> MediaError:
        return MediaError(
            f"{name}: cannot be read past its frame number {len(times)} as stored ({why}): fetch "
            f"it again."
        )

    try:
        for packet in container.demux(container.streams.video[0]):
            if packet.is_corrupt:
                raise cut_short("its packet is cut short")
            # Without a time no frame can be found: there is one too few, then.
            if packet.size and packet.pts is not None and not packet.is_discard:
                times.append(packet.pts)
    except av.FFmpegError as error:
        raise cut_short(error.strerror) from error
    if stream_codec(container).is_intra_only:
        for number, pts in enumerate(times):
            if number and pts <= times[number - 1]:
                raise MediaError(
                    f"{name}: its frame number {number} as stored is shown at {pts} ticks, the one "
                    f"before at {times[number - 1]}, and its codec stores frames in the order in "
                    f"which they are shown. A time was altered: compare the file with its "
                    f"checksum, or fetch it again."
                )
    times.sort()
    twice = next((a for a, b in pairwise(times) if a == b), None)
    if twice is not None:
        raise MediaError(
            f"{name}: two frames are shown at the same time ({twice} ticks), so their order is "
            f"not defined: write it again with one time for each frame."
        )
    return TableClock(times)


class UnexpectedPicture(Exception):
    """The decoder gave another picture than the one that is due by the clock."""


class Decoder:
    """The decoder of an open container's first video stream; it closes the container.

    Damage is an error (``err_detect=explode``), never concealed. There is one thread: frame threads
    would run ahead of the frame asked for, and blur which one failed.

    Attributes:
        effort: What its packets cost so far; shared with the decoders before it of the same file.
    """

    def __init__(
        self,
        container: InputContainer,
        *,
        clock: Clock,
        placed: Placed = "at the first packet",
        crc32s: Sequence[int] = (),
        effort: Effort | None = None,
    ) -> None:
        """Take over a container that was just opened.

        Args:
            container: It is closed with the decoder.
            clock: When each frame is shown.
            placed: Where the container stands.
            crc32s: What `packet_checksums` found, of a codec whose packets come in the order in
                which they are shown.
            effort: What counts its packets.
        """
        self.effort = effort or Effort()
        self._container = container
        self._is_placed = placed == "at the first packet"
        self._clock = clock
        self._stream: VideoStream = container.streams.video[0]
        self._context = self._stream.codec_context
        self._context.options = {"err_detect": "explode"}
        self._context.thread_count = 1
        codec = stream_codec(container)
        self._can_skip = codec.skips_exactly
        self._is_intra_only = codec.is_intra_only
        # FFV1 before version 3 keeps no record beside its packets, and no checksums in them.
        self._has_checksums = codec.has_slice_checksums and bool(self._context.extradata)
        self._crc32s = crc32s
        self._knows_key_frames = self._stream.frames > 0
        self._packets: Iterator[VideoPacket] = container.demux(self._stream)
        self._pending: deque[tuple[int, VideoFrame]] = deque()
        # The frame that the packet before stood for, in the order of the file.
        self._stored_before: int | None = -1
        # The frame after the last one given, and the frames whose packets came from there on.
        self._next = 0
        self._fed: set[int] = set()
        self._newest = 0
        self._skip_until = 0

    def close(self) -> None:
        """Close the container."""
        self._pending.clear()
        self._container.close()

    def reach(self, index: int) -> VideoFrame:
        """Return a frame by the shortest way: decoding on, or from the key frame before it.

        Raises:
            UnexpectedPicture: If another picture comes than is due by the clock.
            av.FFmpegError: If a packet cannot be read or decoded.
        """
        if self._must_seek(index):
            self._seek(index)
        if self._can_skip:
            self._skip_until = index
        return self.decode_to(index)

    def decode_to(self, index: int) -> VideoFrame:
        """Return a frame by decoding on, all the way.

        Raises:
            UnexpectedPicture: If another picture comes than is due by the clock.
            av.FFmpegError: If a packet cannot be read or decoded.
        """
        found = -1
        while found < index:
            found, frame = self._pull()
            if frame.is_corrupt:
                raise UnexpectedPicture(f"the picture of frame {found} is damaged")
        if found > index:
            raise UnexpectedPicture(f"frame {found} came where frame {index} was due")
        # All that is shown before a picture is stored before the decoder gives it.
        missing = set(range(self._next, index)) - self._fed
        if missing:
            raise UnexpectedPicture(f"frame {min(missing)} is missing before it")
        self._fed = {fed for fed in self._fed if fed > index}
        self._next = index + 1
        return frame

    def _must_seek(self, index: int) -> bool:
        if not self._is_placed:
            return True
        if index <= self._next:
            return index < self._next
        if not self._knows_key_frames and index - self._next > BLIND_JUMP:
            return True
        entries = self._stream.index_entries
        key = entries.search_timestamp(self._clock.latest(index))
        return key >= 0 and entries[key].timestamp > self._clock.latest(self._newest)

    def _seek(self, index: int) -> None:
        """Go to a key frame that is shown at or before a frame."""
        # The time of one packet may have been altered: of two that follow each other, it shows.
        pts = self._clock.latest(max(0, index - 1) if self._is_intra_only else index)
        self._stored_before = None
        first = self._seek_pts(pts)
        if first.dts is not None and first.pts is not None and first.pts > pts:
            # MP4 seeks by decoding time, and this key frame is shown after the frame sought.
            first = self._seek_pts(first.dts - 1)
        found = self._in_file_order(first, index) if self._is_intra_only else [first]
        self._packets = chain(found, self._packets)
        self._pending.clear()
        self._fed.clear()
        self._next = self._index(found[0])
        self._newest = 0
        self._knows_key_frames = self._is_placed = True

    def _in_file_order(self, first: VideoPacket, index: int) -> list[VideoPacket]:
        """Return the packets to decode first for a frame of an intra-only codec.

        Of what is stored before a key frame only the times are read: nothing of it is decoded.

        Args:
            first: The packet that the stream is at: a key frame before the frame, or the first.
            index: The frame.
        """
        if not first.is_keyframe:
            # FFV1 keeps its statistics from the last key frame on, and shows nonsense without.
            raise UnexpectedPicture(f"the packet shown at {first.pts} ticks is no key frame")
        place = self._index(first)
        if place > max(0, index - 1):
            raise UnexpectedPicture(f"frame {place} by its time is stored where another is due")
        if index == 0:
            after = list(islice(self._packets, 1))
            if any(packet.size and self._index(packet) != 1 for packet in after):
                raise UnexpectedPicture("the packet after the first one is not of frame 1")
            return [first, *after]
        entries = self._stream.index_entries
        key = entries.search_timestamp(self._clock.latest(index))
        if place < index - 1 and (key < 0 or self._clock.index(entries[key].timestamp) != index):
            return [first]
        found = [first]
        for due, packet in enumerate(islice(self._packets, index - place), place + 1):
            if not packet.size or self._index(packet) != due:
                raise UnexpectedPicture(
                    f"something shown at {packet.pts} ticks is stored as frame {due}"
                )
            if packet.is_keyframe:
                self._stored_before = due - 1
                found.clear()
            found.append(packet)
        return found

    def _seek_pts(self, pts: int) -> VideoPacket:
        self._container.seek(pts, stream=self._stream)
        self._packets = self._container.demux(self._stream)
        first = next(self._packets, None)
        if first is None:
            raise UnexpectedPicture("nothing is stored where it should be")
        return first

    def _index(self, shown: VideoPacket | VideoFrame) -> int:
        """Return the number of the frame of a packet or picture."""
        index = None if shown.pts is None else self._clock.index(shown.pts)
        if index is None:
            raise UnexpectedPicture(
                f"something is shown at {shown.pts} ticks, where no frame is due"
            )
        return index

    def _pull(self) -> tuple[int, VideoFrame]:
        """Return the next picture with its number, from as many packets as it takes."""
        while not self._pending:
            began_s = perf_counter()
            packet = next(self._packets, None)
            self.effort.reading_s += perf_counter() - began_s
            if packet is None:
                raise UnexpectedPicture("the stream ends before it")
            if packet.size and not packet.is_discard:
                self._register(packet)
                self.effort.packets += 1
            self._pending.extend((self._index(frame), frame) for frame in packet.decode())
        return self._pending.popleft()

    def _register(self, packet: VideoPacket) -> None:
        """Check a packet that is about to be decoded, and record its frame."""
        index = self._index(packet)
        if self._is_intra_only:
            if self._stored_before is not None and index != self._stored_before + 1:
                raise UnexpectedPicture(
                    f"frame {index} by its time is stored after frame {self._stored_before}"
                )
            self._stored_before = index
        if packet.is_corrupt:
            raise UnexpectedPicture(f"the packet of frame {index} is cut short")
        if self._has_checksums and fails_slice_checksums(bytes(packet)):
            raise UnexpectedPicture(f"the packet of frame {index} fails its checksum")
        if self._crc32s and zlib.crc32(packet) != self._crc32s[index]:
            raise UnexpectedPicture(f"the packet of frame {index} fails its checksum")
        self._fed.add(index)
        self._newest = max(self._newest, index)
        self._context.skip_frame = "NONREF" if index < self._skip_until else "DEFAULT"


def fails_slice_checksums(packet: bytes) -> bool:
    """Return whether a packet of FFV1 version 3 or later contradicts its own checksums.

    A packet whose slices carry no checksums never does.
    """
    if _slice_ends(packet, footer_bytes=_SIZE_BYTES) is not None:
        return False
    ends = _slice_ends(packet, footer_bytes=_FOOTER_BYTES)
    if ends is None:
        return True
    slices = (packet[start:end].translate(_MIRRORED) for start, end in pairwise(ends))
    return any(
        all(zlib.crc32(mirrored, start) != start for start in _CHECKSUM_STARTS)
        for mirrored in slices
    )


def _slice_ends(packet: bytes, *, footer_bytes: int) -> list[int] | None:
    """Return 0 and where each slice ends, None if the sizes in the footers do not add up."""
    ends = [len(packet)]
    while ends[-1] > 0:
        footer = ends[-1] - footer_bytes
        size = int.from_bytes(packet[max(footer, 0) : footer + _SIZE_BYTES], "big")
        ends.append(footer - size)
    return ends[::-1] if ends[-1] == 0 else None
