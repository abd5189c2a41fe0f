"""Opens MP4 and Matroska files, reads their headers, and never opens a second file or address.

FFmpeg also reads playlist and script formats, which open further files and addresses. Only the two
containers of the release are allowed, and a path is never read as an address.
"""

import errno
import io
import zlib
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal, Self

import av
import numpy as np
from av.container import InputContainer

from stereogenbench_data.errors import (
    NOT_WRITABLE,
    MediaError,
    StorageError,
    describe_os_error,
)
from stereogenbench_data.media.siting import coded_picture

BinaryFile = io.RawIOBase | io.BufferedIOBase
"""An open binary file that can be sought in, such as `open(path, "rb")` or `io.BytesIO`."""

VideoFile = str | Path | BinaryFile


class SeekableFile(io.RawIOBase):
    """A read-only file of known size, whose subclasses read its bytes.

    Attributes:
        opens_by_header: Whether a video is opened by its header, so that no packet is fetched.
        hides_packets: While it is set, the file seems to end where packets lie.
        has_packets: Whether packets are there to be looked into.
        is_far: Whether each read takes as long as a request.
        packets: How many packets a video has; None if that is not known.
    """

    has_packets = True
    is_far = False
    packets: int | None = None

    def __init__(self, size: int) -> None:
        """Begin at the start."""
        super().__init__()
        self.size = size
        self.opens_by_header = self.hides_packets = False
        self._position = 0

    def readable(self) -> bool:
        """Return that it can be read."""
        return True

    def seekable(self) -> bool:
        """Return that positions can be set."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        """Set the position, relative to the start, to itself or to the end; return it."""
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self.size}[whence]
        if start + offset < 0:
            raise ValueError(f"a file has no position {start + offset}: seek to 0 or later.")
        self._position = start + offset
        return self._position

    def read(self, size: int | None = -1, /) -> bytes:
        """Return the next bytes, all the rest for -1; fewer at the end, or at that of a packet."""
        stop = self.size if size is None or size < 0 else min(self._position + size, self.size)
        if stop <= self._position:
            return b""
        data = self._bytes(self._position, stop)
        self._position += len(data)
        return data

    @abstractmethod
    def _bytes(self, start: int, stop: int) -> bytes:
        """Return the bytes from start to stop, which lie within the file, or the first of them."""


@dataclass(slots=True)
class Effort:
    """What frames cost: packets that were decoded, and seconds in which they were read."""

    packets: int = 0
    reading_s: float = 0.0


class FrameReader:
    """What readers of frames have in common.

    A reader belongs to the thread and the process that opened it.

    Attributes:
        name: What messages call the file.
        frames: How many frames it has.
        header: What the file's header says; the pixel format is empty where it does not give it.
        effort: What its frames cost so far.
    """

    name: str
    frames: int
    header: "StreamFacts"
    effort: Effort

    def close(self) -> None:
        """Close the reader; closing twice does nothing."""

    def require_frame(self, index: int) -> None:
        """Refuse the number of a frame that there is not.

        Raises:
            MediaError: If so.
        """
        if not 0 <= index < self.frames:
            raise MediaError(
                f"{self.name}: has no frame {index}: ask for one of 0 to {self.frames - 1}."
            )

    def __enter__(self) -> Self:
        """Return the reader itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close the reader."""
        self.close()


_NOT_THE_FILES: Final = NOT_WRITABLE | {errno.EMFILE, errno.ENFILE}
"""Numbers of errors that say nothing of what a file holds; others may come from its content."""

_OPTIONS: Final = {"format_whitelist": "mov,matroska"}
_UNDECODED: Final = {**_OPTIONS, "probesize": "32", "skip_frame": "all"}
"""FFmpeg decodes the first picture of H.264 only to learn its pixel format: not with these."""

# PyAV 18 raises on tags that are not UTF-8 unless told otherwise; PyAV 19 never does (`text_tags`).
_TAG_ERRORS: Final[dict[str, Any]] = (
    {"metadata_errors": "replace"} if int(av.__version__.partition(".")[0]) < 19 else {}
)


@dataclass(frozen=True, slots=True)
class FrameTimes:
    """When the frames of a video are shown.

    Attributes:
        ticks: The time of each frame, ascending, in ticks.
        tick_s: A tick in seconds.
    """

    ticks: Sequence[int | Fraction]
    tick_s: Fraction


@dataclass(frozen=True, slots=True)
class StreamFacts:
    """The facts in a video file's header.

    Attributes:
        codec: FFmpeg's name of the codec, such as "h264" or "ffv1".
        pixel_format: FFmpeg's name of the stored pixel format, such as "yuv420p" or "gray16le";
            empty where the header does not give it and no picture was decoded.
        width_px: Width of every picture.
        height_px: Height of every picture.
        frames: Number of pictures.
        frame_rate_hz: Average rate; 0.0 if the file does not give one.
        tags: Metadata of the container and of the stream, keys in lower case. A key that both
            have, with another value, is kept as ``stream.<key>`` too.
        is_colour: Whether its pictures hold colours only, see `is_colour_format`; None if only
            a decoded picture could show it.
        pixel_aspect: Width of a pixel over its height; 0.0 if the file does not give it.
        key_frames: The frames at which decoding can begin, from 0, as an MP4 header lists them;
            (0,) where no header does.
        container: FFmpeg's names of the container, such as "matroska,webm".
        is_lossless: Whether a header of H.264 or HEVC says that it was coded without loss.
        siting: Where its chroma lies, see `CodedPicture`.
        times: When its frames are shown; None if only the header was read.
    """

    codec: str
    pixel_format: str
    width_px: int
    height_px: int
    frames: int
    frame_rate_hz: float
    tags: Mapping[str, str]
    is_colour: bool | None = None
    pixel_aspect: float = 0.0
    key_frames: tuple[int, ...] = (0,)
    container: str = field(default="", compare=False)
    is_lossless: bool = False
    siting: str | None = field(default=None, compare=False)
    times: FrameTimes | None = field(default=None, compare=False)


@dataclass(frozen=True, slots=True)
class Codec:
    """What reading has to know of a codec.

    Attributes:
        is_lossless: Whether it always returns what it was given.
        is_intra_only: Whether it stores each picture by itself, so that pictures are shown in the
            order of the file.
        skips_exactly: Whether its decoder drops, on NONREF, only pictures that no other is
            predicted from.
        has_slice_checksums: Whether its packets may hold checksums of their own.
    """

    is_lossless: bool = False
    is_intra_only: bool = False
    skips_exactly: bool = False
    has_slice_checksums: bool = False


_CODECS: Final = (
    dict.fromkeys(("h264", "hevc", "mpeg4"), Codec(skips_exactly=True))
    | dict.fromkeys(("mjpeg", "prores"), Codec(is_intra_only=True))
    | dict.fromkeys(
        ("ffvhuff", "huffyuv", "png", "rawvideo", "utvideo"),
        Codec(is_lossless=True, is_intra_only=True),
    )
    | {
        "ffv1": Codec(is_lossless=True, is_intra_only=True, has_slice_checksums=True),
        "blosc2": Codec(is_lossless=True),
    }
)

LOSSLESS_SUFFIX: Final = " lossless"


def codec_of(name: str) -> Codec:
    """Return a codec by FFmpeg's name."""
    return _CODECS.get(name, Codec())


def stream_codec(container: InputContainer) -> Codec:
    """Return the codec of the first video of an open container."""
    return codec_of(container.streams.video[0].codec_context.codec.canonical_name)


def depth_coding(facts: StreamFacts) -> str:
    """Return the codec of a depth video, and whether one that can lose coded it without loss.

    >>> depth_coding(StreamFacts("hevc", "gray12le", 8, 8, 1, 15.0, {}, is_lossless=True))
    'hevc lossless'
    """
    return facts.codec + (LOSSLESS_SUFFIX if facts.is_lossless else "")


def open_container(
    file: VideoFile, *, name: str, pixel_format: Literal["needed", "later"] = "later"
) -> InputContainer:
    """Open a video file for reading.

    Args:
        file: A path, or a seekable binary file; the latter stays the caller's to close.
        name: What messages call the file.
        pixel_format: With "later", it may be missing until a picture is decoded.

    Raises:
        StorageError: If a path is missing, not a file or not readable.
        MediaError: If the content is not an MP4 or Matroska file with at least one video stream.
    """
    if isinstance(file, str | Path):
        require_file(Path(file), name=name)
    try:
        container = _open(file, options=_OPTIONS if pixel_format == "needed" else _UNDECODED)
        if not container.streams.video or container.streams.video[0].start_time is None:
            container.close()
            container = _open(file, options=_OPTIONS)
    except av.FFmpegError as error:
        if isinstance(error, OSError) and error.errno in _NOT_THE_FILES:
            raise StorageError(describe_os_error(f"{name}: cannot be opened", error)) from error
        raise MediaError(
            f"{name}: cannot be opened as MP4 or Matroska ({error.strerror}). The file is cut "
            f"short, damaged or something else: fetch it again."
        ) from error
    if not container.streams.video:
        found = ", ".join(stream.type for stream in container.streams) or "nothing"
        container.close()
        raise MediaError(f"{name}: holds no video stream (it holds {found}): fetch it again.")
    if container.streams.video[0].codec_context is None:
        container.close()
        raise MediaError(
            f"{name}: its video codec is unknown to this FFmpeg: store it with another codec."
        )
    return container


Placed = Literal["at the first packet", "anywhere"]
"""Where an open container stands: it is read on from the first packet, or has to seek first."""


def open_by_header(file: VideoFile, *, name: str) -> tuple[InputContainer, Placed]:
    """Open a video as `open_container` does, without a packet where its file allows that.

    The pixel format may be missing until a picture is decoded.

    Raises:
        StorageError: If a path is missing, not a file or not readable.
        MediaError: If the content is not an MP4 or Matroska file with at least one video stream.
    """
    if isinstance(file, SeekableFile) and file.opens_by_header:
        file.hides_packets = True
        try:
            # Where its header is not enough, the whole file says what is wrong with it.
            with suppress(av.FFmpegError):
                container = _open(file, options=_UNDECODED)
                video = container.streams.video
                if video and video[0].start_time is not None and video[0].codec_context is not None:
                    return container, "anywhere"
                container.close()
        finally:
            file.hides_packets = False
    return open_container(file, name=name), "at the first packet"


def _open(file: VideoFile, *, options: dict[str, str]) -> InputContainer:
    if isinstance(file, str | Path):
        place: str | BinaryFile = f"file:{file}"
    else:
        file.seek(0)
        place = file
        if isinstance(file, SeekableFile) and not file.has_packets:
            # Parsers look into packets, for what the container tells too.
            options = options | {"fflags": "+noparse"}
    container: InputContainer = av.open(place, mode="r", options=options, **_TAG_ERRORS)
    return container


def require_file(path: Path, *, name: str) -> None:
    """Refuse a path that is not a file, or an empty one.

    Raises:
        StorageError: If it is missing, a folder or not readable.
        MediaError: If it is empty.
    """
    if path.is_dir():
        raise StorageError(f"{name}: is a folder, not a video file: pass the file's path.")
    try:
        size = path.stat().st_size
    except OSError as error:
        what = f"{name}: cannot be read at {path}"
        cure = "Fetch it, or correct the path."
        raise StorageError(describe_os_error(what, error, cure)) from error
    if size == 0:
        raise MediaError(f"{name}: is empty (0 bytes at {path}): fetch it again.")


def exact(ratio: Any) -> Fraction | None:
    """Return a rate, time base or aspect as a fraction, None if the file does not give it.

    PyAV 18 gives None for a value that is not set, PyAV 19 a ratio of zero or with a zero below,
    and it rounds the product of two of its ratios.
    """
    return Fraction(ratio.numerator, ratio.denominator) if ratio else None


def text_tags(metadata: Mapping[str, str]) -> dict[str, str]:
    """Return the tags of a container or stream, with a replacement character for what is not UTF-8.

    PyAV 19 gives such bytes as surrogates, which cannot be printed.
    """

    def text(tag: str) -> str:
        return tag.encode("utf-8", "surrogateescape").decode("utf-8", "replace")

    return {text(key): text(value) for key, value in metadata.items()}


def stream_facts(container: InputContainer, *, name: str, frames: int) -> StreamFacts:
    """Return the header's facts; ``frames`` is what the caller knows of the number of pictures.

    The pixel format is empty if the header does not give it.

    Raises:
        MediaError: If the header lacks the pictures' size.
    """
    stream = container.streams.video[0]
    context = stream.codec_context
    if not (context.width > 0 and context.height > 0):
        raise MediaError(
            f"{name}: its header describes no picture (codec {context.name}, {context.width}x"
            f"{context.height}). The file is cut short or damaged: fetch it again."
        )
    coded = coded_picture(context.codec.canonical_name, context.extradata)
    is_colour = coded.has_chroma
    if context.pix_fmt is not None and is_colour is not False:
        is_colour = is_colour_format(context.pix_fmt)
    return StreamFacts(
        codec=context.codec.canonical_name,
        pixel_format=context.pix_fmt or "",
        width_px=context.width,
        height_px=context.height,
        frames=frames,
        frame_rate_hz=float(exact(stream.average_rate) or 0),
        tags=merged_tags(text_tags(container.metadata), text_tags(stream.metadata)),
        is_colour=is_colour,
        pixel_aspect=float(exact(stream.sample_aspect_ratio) or 0),
        key_frames=_key_frames(container),
        container=container.format.name,
        is_lossless=coded.is_lossless,
        siting=coded.siting,
    )


def _key_frames(container: InputContainer) -> tuple[int, ...]:
    """Return the frames at which decoding can begin.

    An MP4 header lists the packets whose pictures refer to none before. Such a picture is shown
    after all those that come before it, so the packet's number is the frame's.
    """
    if "mp4" not in container.format.name:
        return (0,)
    entries = container.streams.video[0].index_entries
    return tuple(number for number, each in enumerate(entries) if each.is_keyframe) or (0,)


@cache
def is_colour_format(pixel_format: str) -> bool:
    """Return whether a pixel format holds three colours of 8 bits or more, and nothing else.

    Palettes and alpha channels are refused: what they mean for a view is not defined.
    """
    layout = av.VideoFormat(pixel_format)
    return (
        len(layout.components) == 3
        and not layout.has_palette
        and all(each.bits >= 8 and not each.is_alpha for each in layout.components)
    )


def merged_tags(container: Mapping[str, str], stream: Mapping[str, str]) -> dict[str, str]:
    """Return the tags of a container and of its stream as `StreamFacts` has them."""
    tags = {key.lower(): value for key, value in container.items()}
    for key, value in stream.items():
        known = tags.setdefault(key.lower(), value)
        if known != value:
            tags[f"stream.{key.lower()}"] = value
    return tags


def frames_by_duration(container: InputContainer) -> int:
    """Return how many frames fill the time from start to end, 0 if it is not a whole number.

    Matroska's duration, as FFmpeg writes it, is the time at which the last frame ends.
    """
    stream = container.streams.video[0]
    rate, time_base = exact(stream.average_rate), exact(stream.time_base)
    start = stream.start_time
    if container.duration is None or start is None or rate is None or time_base is None:
        return 0
    count = rate * (Fraction(container.duration, 1_000_000) - start * time_base)
    whole = round(count)
    return whole if whole > 0 and abs(count - whole) <= Fraction(1, 10) else 0


def require_whole_payload(container: InputContainer, *, name: str) -> None:
    """Refuse a file that ends before the last sample of its header's table (MP4).

    Raises:
        MediaError: If so, with both sizes.
    """
    entries = container.streams.video[0].index_entries
    end = max((entry.pos + entry.size for entry in entries), default=0)
    if 0 < container.size < end:
        raise MediaError(
            f"{name}: is cut short: its header places frames up to byte {end}, the file ends at "
            f"{container.size}: fetch it again."
        )


# Checksums that a video holds of its own packets, so that a single frame is checked as it is read.

# A decoder of H.264 or JPEG shows something for most damaged packets, without a word. So videos of
# training shards hold, in the tag ``comment``, the CRC-32 of what their header says of the pictures
# and of each packet in the order of the file. Videos without that tag are read unchecked.

CHECKSUM_TAG: Final = "comment"
_BEGIN: Final = "CRC-32 of header and packets: "
_DIGITS: Final = 8


def reserved_checksums(packets: int) -> str:
    """Return the tag of a video that is about to be written: as long as the one it will have."""
    return _BEGIN + "-" * (packets + 1) * _DIGITS


def write_checksums(video: Path, *, packets: int) -> None:
    """Put the checksums of a video that was just written into the place reserved for them.

    Raises:
        OSError: If it cannot be read or written.
    """
    with open_container(video, name=str(video)) as container:
        found = [_header_crc32(container)]
        stream = container.streams.video[0]
        found += [zlib.crc32(bytes(packet)) for packet in container.demux(stream) if packet.size]
    content, reserved = video.read_bytes(), reserved_checksums(packets).encode()
    tag = _BEGIN + "".join(f"{crc32:0{_DIGITS}x}" for crc32 in found)
    video.write_bytes(content.replace(reserved, tag.encode()))


def packet_checksums(container: InputContainer, *, frames: int, name: str) -> Sequence[int]:
    """Return the CRC-32 of each packet that an open video holds; empty if it holds none.

    Raises:
        MediaError: If the header of the video is not the one that was written, or is of another
            number of frames.
    """
    digits = container.metadata.get(CHECKSUM_TAG, "").removeprefix(_BEGIN)
    if digits == container.metadata.get(CHECKSUM_TAG, ""):
        return ()
    try:
        crc32s: list[int] = np.frombuffer(bytes.fromhex(digits), dtype=">u4").tolist()
        header, *packets = crc32s
    except ValueError:
        header, packets = -1, []
    if header != _header_crc32(container):
        raise MediaError(
            f"{name}: its header is not the one that was written with it. The file is damaged: "
            f"compare it with its checksum, or fetch it again."
        )
    if len(packets) != frames:
        raise MediaError(
            f"{name}: holds {len(packets)} frames where {frames} are expected. It belongs to "
            f"another scene: fetch it again."
        )
    return packets


def _header_crc32(container: InputContainer) -> int:
    """Return a checksum of what a header says of the pictures, read without decoding one."""
    context = container.streams.video[0].codec_context
    said = (context.codec.canonical_name, context.width, context.height)
    return zlib.crc32(bytes(context.extradata or b""), zlib.crc32(repr(said).encode()))
