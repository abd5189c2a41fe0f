"""One run of a decoder over a stream: seeking, skipping, and checking that no picture is missing.

A `Decoder` gives up (`Astray`) at the first picture that is not the one its clock told; whoever
drives it decides whether the file is at fault.
"""

from collections import deque
from collections.abc import Iterator
from itertools import chain
from typing import TYPE_CHECKING, Final

import av
from av.container import InputContainer
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from stereogenbench_data.media.clock import Clock
from stereogenbench_data.media.integrity import fails_slice_checksums

if TYPE_CHECKING:
    VideoPacket = Packet[VideoStream]
else:
    VideoPacket = Packet  # generic in PyAV's stubs alone

_SKIPS_EXACTLY: Final = frozenset({"h264", "hevc", "mpeg4"})
"""Codecs whose decoders drop, on NONREF, only pictures that no other is predicted from."""

_BLIND_JUMP: Final = 8
"""Frames to decode through rather than to seek, while a file's key frames are not known."""


class Astray(Exception):
    """The pictures that came are not those that the clock told."""


class Decoder:
    """The decoder of an open container's first video stream; it closes the container.

    Damage is an error (``err_detect=explode``), never concealed. Threads work on slices of one
    picture: frame threads would run ahead of the frame asked for, and blur which one failed.
    """

    def __init__(self, container: InputContainer, *, clock: Clock, threads: int) -> None:
        """Take over a container that stands at its start."""
        self._container = container
        self._clock = clock
        self._stream: VideoStream = container.streams.video[0]
        self._context = self._stream.codec_context
        self._context.options = {"err_detect": "explode"}
        self._context.thread_count = threads
        self._context.thread_type = "SLICE"
        self._can_skip = self._context.codec.canonical_name in _SKIPS_EXACTLY
        # FFV1 before version 3 keeps no record beside its packets, and no checksums in them.
        is_ffv1 = self._context.codec.canonical_name == "ffv1"
        self._has_checksums = is_ffv1 and bool(self._context.extradata)
        self._knows_key_frames = self._stream.frames > 0
        self._packets: Iterator[VideoPacket] = container.demux(self._stream)
        self._pending: deque[tuple[int, VideoFrame]] = deque()
        # The frame that comes next, if no picture is skipped; None just after a seek.
        self._next: int | None = 0
        # The frame at which decoding began: pictures shown before it are not whole.
        self._key: int | None = 0
        self._newest_pts = clock.latest(0)
        self._skip_until_pts: int | None = None

    def close(self) -> None:
        """Close the container."""
        self._pending.clear()
        self._container.close()

    def reach(self, index: int) -> VideoFrame:
        """Return a frame by the shortest way: decoding on, or from the key frame before it.

        Raises:
            Astray: If other pictures come than the clock tells.
            av.FFmpegError: If a packet cannot be read or decoded.
        """
        if self._must_seek(index):
            self._seek(index)
        if self._can_skip and self._next != index:
            self._next = None
            self._skip_until_pts = self._clock.earliest(index)
        return self.decode_to(index)

    def decode_to(self, index: int) -> VideoFrame:
        """Return a frame by decoding on, all the way.

        Raises:
            Astray: If other pictures come than the clock tells.
            av.FFmpegError: If a packet cannot be read or decoded.
        """
        while True:
            found, frame = self._pull()
            if self._key is not None and found < self._key:
                continue
            if frame.is_corrupt:
                raise Astray(f"the picture of frame {found} is damaged")
            if found > index or self._next not in (None, found):
                due = index if self._next is None else self._next
                raise Astray(f"frame {found} came where frame {due} was due")
            if found == index:
                self._next = index + 1
                self._skip_until_pts = None
                return frame
            if self._next is not None:
                self._next += 1

    def _must_seek(self, index: int) -> bool:
        if self._next is None or index < self._next:
            return True
        if index == self._next:
            return False
        if not self._knows_key_frames and index - self._next > _BLIND_JUMP:
            return True
        entries = self._stream.index_entries
        key = entries.search_timestamp(self._clock.latest(index))
        return key >= 0 and entries[key].timestamp > self._newest_pts

    def _seek(self, index: int) -> None:
        """Go to a key frame at or before a frame, in the order of presentation and of storage."""
        pts = self._clock.latest(index)
        first = self._seek_pts(pts)
        if first.dts is not None and first.pts is not None and first.pts > pts:
            # MP4 seeks by decoding time, and this key frame is shown after the frame sought.
            first = self._seek_pts(first.dts - 1)
        self._packets = chain([first], self._packets)
        self._pending.clear()
        self._knows_key_frames = True
        self._next = self._key = None

    def _seek_pts(self, pts: int) -> VideoPacket:
        self._container.seek(pts, stream=self._stream)
        self._packets = self._container.demux(self._stream)
        first = next(self._packets, None)
        if first is None:
            raise Astray("nothing is stored where it should be")
        return first

    def _pull(self) -> tuple[int, VideoFrame]:
        """Return the next picture with its number, from as many packets as it takes."""
        while not self._pending:
            packet = next(self._packets, None)
            if packet is None:
                raise Astray("the stream ends before it")
            self._feed(packet)
        return self._pending.popleft()

    def _feed(self, packet: VideoPacket) -> None:
        is_whole = True
        if packet.size and not packet.is_discard:
            is_whole = self._register(packet)
        # A picture shown before the key frame lacks what it is predicted from: it may fail.
        try:
            frames = packet.decode()
        except av.FFmpegError:
            if is_whole:
                raise
            return
        for frame in frames:
            index = None if frame.pts is None else self._clock.index(frame.pts)
            if index is None:
                raise Astray(f"a picture is shown at {frame.pts} ticks, where no frame is due")
            self._pending.append((index, frame))

    def _register(self, packet: VideoPacket) -> bool:
        """Take note of a packet; return whether its picture can be decoded whole."""
        pts = packet.pts
        index = None if pts is None else self._clock.index(pts)
        if pts is None or index is None:
            raise Astray(f"a packet is shown at {pts} ticks, where no frame is due")
        if packet.is_corrupt:
            raise Astray(f"the packet of frame {index} is cut short")
        if self._has_checksums and fails_slice_checksums(bytes(packet)):
            raise Astray(f"the packet of frame {index} fails its checksum")
        self._newest_pts = max(self._newest_pts, pts)
        if self._key is None:
            self._key = index
        skips = self._skip_until_pts is not None and pts < self._skip_until_pts
        self._context.skip_frame = "NONREF" if skips else "DEFAULT"
        return index >= self._key
