"""Frames of a video by number, exact: frame i is the i-th in the order of presentation.

Nothing is guessed: a cut or a damaged packet, or another number of frames, is an error. A
neighbouring frame is never returned instead. Times may have gaps, as the number of a frame follows
from the order: whether frames of one number are one moment in all videos of a scene is compared
where the scene is described (`index.clocks`).
"""

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from fractions import Fraction
from typing import Any, Final, Literal

import av
import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import Interpolation, VideoReformatter
from jaxtyping import UInt8, UInt16

from stereogenbench_data.errors import MediaError
from stereogenbench_data.media.container import (
    Effort,
    FrameReader,
    FrameTimes,
    SeekableFile,
    StreamFacts,
    VideoFile,
    exact,
    is_colour_format,
    open_by_header,
    open_container,
    packet_checksums,
    require_whole_payload,
    stream_facts,
)
from stereogenbench_data.media.decoder import (
    MOST_EXTRA_FRAMES,
    Clock,
    Decoder,
    TableClock,
    UnexpectedPicture,
    steady_clock,
    table_clock,
    times_by_cues,
)
from stereogenbench_data.media.depth_frames import PACKED_SUFFIX, DepthFrames
from stereogenbench_data.media.heads import Heads, heads_of, is_far
from stereogenbench_data.media.siting import (
    CENTRE,
    Converter,
    is_subsampled,
    picture_siting,
)
from stereogenbench_data.schema.records import Rig

NO_COLOUR: Final = (
    ", and a video of views holds YUV or RGB with 8 bits or more a colour, without alpha channel "
    "and palette. Another video has this name, or it was encoded differently: fetch it again."
)
"""How the refusal of a video that should hold colours ends."""

_ASPECT_SHARE: Final = 0.01
"""How far a tagged pixel aspect, which is stored as a small fraction, may be off the rig's."""

RED_GREEN_BLUE: Final = (2, 0, 1)
"""Where the planes of FFmpeg's gbrp are."""


def probe(
    file: VideoFile, *, name: str, pixel_format: Literal["needed", "later"] = "needed"
) -> StreamFacts:
    """Return what a video file is, and when its frames are shown, from as few bytes as tell it.

    Packets are not read, unless nothing else tells where they are. Of a Matroska file that is far
    away, frames are taken to be shown at the rate in its header, with which its key frames must
    agree.

    Args:
        file: A path, or a seekable binary file; the latter stays the caller's to close.
        name: What messages call the file. A name that ends in ``.b2frame`` is of depth packed by
            blosc2.
        pixel_format: "later" decodes no picture where only that would show the pixel format.

    Raises:
        StorageError: If the file cannot be read.
        MediaError: If it is not an MP4 or Matroska video, is cut short or holds no frame.
    """
    if name.endswith(PACKED_SUFFIX):
        with DepthFrames(file, name=name, frames="any") as depth:
            return depth.facts
    with heads_of(file, name=name) as known:
        facts = _probed(known, name=name, pixel_format=pixel_format)
        is_vague = pixel_format == "needed" and not (facts and facts.pixel_format)
        if isinstance(known, Heads) and (facts is None or is_vague):
            facts = _probed(known.video, name=name, pixel_format=pixel_format)
    if facts is None or facts.frames == 0:
        raise MediaError(f"{name}: holds no frame (0 packets): fetch it again.")
    return facts


def _probed(
    file: VideoFile, *, name: str, pixel_format: Literal["needed", "later"]
) -> StreamFacts | None:
    """Return what a video is; None where its ends alone do not tell when frames are shown."""
    with open_container(file, name=name, pixel_format=pixel_format) as container:
        require_whole_payload(container, name=name)
        stream = container.streams.video[0]
        ticks: Sequence[int | Fraction] | None
        if not is_far(file) or stream.frames:
            ticks = table_clock(container, name=name).times
        else:
            found = times_by_cues(container)
            ticks = found and found[0]
        facts = stream_facts(container, name=name, frames=0)
        tick_s = exact(stream.time_base) or Fraction(1)
    if ticks is None:
        if isinstance(file, Heads):
            return None
        with open_container(file, name=name) as container:
            ticks = table_clock(container, name=name).times
    return replace(facts, frames=len(ticks), times=FrameTimes(ticks, tick_s))


class VideoReader(FrameReader):
    """An open video whose frames are read by number, fastest in ascending order.

    A frame ahead within the same group of pictures is reached by decoding on; any other by
    seeking to the key frame before it. On the way, pictures that no other is predicted from are
    skipped. The last frame is kept, so that asking for it again costs nothing.

    Attributes:
        scaler: The scaler of pictures whose chroma lies where FFmpeg takes it to be.
        converter: The scaler of all others. Both keep their tables from frame to frame. Neither
            has threads: FFmpeg would wait for them for ever when a fork frees the scaler.
    """

    def __init__(self, file: VideoFile, *, name: str, frames: int) -> None:
        """Open a video that must hold ``frames`` frames.

        Args:
            file: A path, or a seekable binary file; the latter stays the caller's to close.
            name: What messages call the file.
            frames: How many frames the video must have; it may have `MOST_EXTRA_FRAMES` more.

        Raises:
            StorageError: If the file cannot be read.
            MediaError: If it is not a video, is cut short or has another number of frames, as far
                as the header shows. Other faults are raised by the frames that they concern.
        """
        self.name = name
        self.frames = frames
        self.effort = Effort()
        self.scaler = VideoReformatter()
        self.converter = Converter()
        self._file = file
        self._current: tuple[int, VideoFrame] | None = None
        self._is_closed = False
        self._decoder: Decoder | None = None
        self._is_seen = False
        container, placed = open_by_header(file, name=name)
        try:
            require_whole_payload(container, name=name)
            self._crc32s = packet_checksums(container, frames=frames, name=name)
            self.header = stream_facts(container, name=name, frames=frames)
            self._siting = self.header.siting
            steady = steady_clock(container, frames=frames, extra=_extra_frames(file, frames))
        except MediaError:
            container.close()
            raise
        if steady is None:
            container.close()
        else:
            self._decoder = Decoder(
                container, clock=steady, placed=placed, crc32s=self._crc32s, effort=self.effort
            )
        self._clock: Clock = steady or self._survey()

    @property
    def facts(self) -> StreamFacts:
        """What the header says, and the pixel format by a picture where that does not.

        Raises:
            MediaError: If a picture is needed and cannot be read.
        """
        if not self.header.pixel_format:
            self.frame(0)
        return self.header

    def frame(self, index: int) -> VideoFrame:
        """Return the frame that is the ``index``-th in the order of presentation, from 0.

        Raises:
            MediaError: If there is no such frame, or it does not decode to what was stored.
        """
        if self._is_closed:
            raise MediaError(f"{self.name}: is closed, so frame {index} cannot be read: reopen it.")
        self.require_frame(index)
        if self._current is None or self._current[0] != index:
            self._current = None
            frame = self._reach(index)
            self._require_same_picture(index, frame)
            self._current = (index, frame)
        return self._current[1]

    def colour_frame(self, index: int) -> VideoFrame:
        """Return a frame as `frame` does, of a video of views.

        Raises:
            MediaError: If it cannot be read, or is not a colour picture.
        """
        frame = self.frame(index)
        is_colour = is_colour_format(frame.format.name)
        if not is_colour or self.header.is_colour is False:
            found = "coded as grey" if is_colour else f"stored as {frame.format.name}"
            raise MediaError(f"{self.name}: frame {index} is {found}{NO_COLOUR}")
        return frame

    def siting(self, frame: VideoFrame) -> str:
        """Return where the chroma of this video lies by its tag, "center" without a tag."""
        if self._siting is None:
            self._siting = picture_siting(frame) if is_subsampled(frame) else CENTRE
        return self._siting

    def close(self) -> None:
        """Close the file and the decoder; closing twice does nothing."""
        self._is_closed = True
        self._current = None
        self._drop_decoder()

    def _reach(self, index: int) -> VideoFrame:
        if self._decoder is None:
            container, placed = open_by_header(self._file, name=self.name)
            self._decoder = Decoder(
                container,
                clock=self._clock,
                placed=placed,
                crc32s=self._crc32s,
                effort=self.effort,
            )
        try:
            return self._decoder.reach(index)
        except (UnexpectedPicture, av.FFmpegError):
            self._drop_decoder()
        return self._reach_from_start(index)

    def _reach_from_start(self, index: int) -> VideoFrame:
        """Decode a frame by the long way, by the exact times of all frames, skipping nothing."""
        if not isinstance(self._clock, TableClock):
            self._clock = self._survey()
        container = open_container(self._file, name=self.name)
        self._decoder = Decoder(
            container, clock=self._clock, crc32s=self._crc32s, effort=self.effort
        )
        try:
            return self._decoder.decode_to(index)
        except (UnexpectedPicture, av.FFmpegError) as error:
            self._drop_decoder()
            reason = error.strerror if isinstance(error, av.FFmpegError) else error
            raise MediaError(
                f"{self.name}: frame {index} cannot be decoded ({reason}). The file is damaged: "
                f"compare it with its checksum, or fetch it again."
            ) from error

    def _survey(self) -> TableClock:
        """Return the time of every frame; only of a file that is far away packets are read."""
        file, name = self._file, self.name
        near = nullcontext(file) if is_far(file) else heads_of(file, name=name)
        with near as known, open_container(known, name=name) as container:
            clock = table_clock(container, name=name)
        found, expected = len(clock.times), self.frames
        if not 0 <= found - expected <= MOST_EXTRA_FRAMES:
            raise MediaError(
                f"{self.name}: holds {found} frames where {expected} are expected. It is cut "
                f"short, or belongs to another scene: fetch it again."
            )
        return clock

    def _require_same_picture(self, index: int, frame: VideoFrame) -> None:
        if not self.header.pixel_format:
            self.header = replace(self.header, pixel_format=frame.format.name)
        header = self.header
        expected = (header.pixel_format, header.width_px, header.height_px)
        found = (frame.format.name, frame.width, frame.height)
        if found != expected:
            raise MediaError(
                f"{self.name}: frame {index} is {found[0]} {found[1]}x{found[2]} where "
                f"{expected[0]} {expected[1]}x{expected[2]} is expected: write the file again."
            )
        if self._is_seen and not frame.rotation:
            return
        # Once a video, and where it is turned, and of a tiny copy, which has the same tags: PyAV's
        # side data and their frame hold each other, so that only the garbage collector frees it.
        self._is_seen = True
        tiny = self.scaler.reformat(
            frame, 16, 16, format="gray", interpolation=Interpolation.POINT, threads=1
        )
        matrix: Any = tiny.side_data.get("DISPLAYMATRIX")
        if matrix is None:
            return
        x_x, x_y, _, y_x, y_y, *_ = np.frombuffer(bytes(matrix), "=i4")
        if not (x_x > 0 and y_y > 0 and x_y == 0 and y_x == 0):
            raise MediaError(
                f"{self.name}: frame {index} is tagged to be turned or mirrored when it is shown "
                f"(rotation {frame.rotation} degrees), and the cameras are those of the stored "
                f"picture: store the upright picture, without the tag."
            )

    def _drop_decoder(self) -> None:
        if self._decoder is not None:
            self._decoder.close()
            self._decoder = None


def _extra_frames(file: VideoFile, frames: int) -> int:
    """Return how many frames more than it must have the header of a video may tell of.

    They may be missing among those that it must have. Where all packets can be looked at, or are
    known to be as many, their times are taken instead.
    """
    is_known = not isinstance(file, SeekableFile) or not file.is_far or file.packets == frames
    return 0 if is_known else MOST_EXTRA_FRAMES


def require_indexed_picture(reader: FrameReader, rig: Rig) -> None:
    """Refuse a video whose picture size or pixel aspect differs from the index.

    Raises:
        MediaError: If so.
    """
    found = (reader.header.width_px, reader.header.height_px)
    indexed = (rig.image_width_px, rig.image_height_px)
    if found != indexed:
        raise MediaError(
            f"{reader.name}: holds pictures of {found[0]}x{found[1]} pixels where the index says "
            f"{indexed[0]}x{indexed[1]}. The video or the index was replaced or altered: fetch "
            f"them again, or run `stereogenbench index` again."
        )
    require_pixel_aspect(reader.header.pixel_aspect, rig, name=reader.name)


def require_pixel_aspect(pixel_aspect: float, rig: Rig, *, name: str) -> None:
    """Refuse a video whose header gives pixels another shape than the rig's sensor has.

    Args:
        pixel_aspect: Width of a pixel over its height; 0 if the header does not give it. Many
            writers tag all videos with square pixels, so 1 is accepted.
        rig: Its sensor and picture size give the shape of the pixels.
        name: What messages call the file.

    Raises:
        MediaError: If so.
    """
    width_mm = rig.sensor_width_mm / rig.image_width_px
    height_mm = rig.sensor_height_mm / rig.image_height_px
    if pixel_aspect not in (0, 1) and abs(pixel_aspect * height_mm / width_mm - 1) > _ASPECT_SHARE:
        raise MediaError(
            f"{name}: is tagged to have pixels {pixel_aspect:.4g} times as wide as high, and those "
            f"of the rig's sensor are {width_mm / height_mm:.4g} times as wide as high. It was "
            f"stretched for another shape: fetch it again, or store it without that tag."
        )


def plane_numbers(
    frame: VideoFrame, plane: int, *, dtype: str
) -> UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]:
    """Return a plane (h, w) as high as the picture, as a view of the frame's own memory.

    Args:
        frame: A picture, whose rows may be padded.
        plane: Which plane, from 0.
        dtype: "u1", "<u2" or ">u2", as the numbers are stored.
    """
    source = frame.planes[plane]
    row_length = source.line_size // np.dtype(dtype).itemsize
    numbers = np.frombuffer(memoryview(source), dtype=dtype, count=frame.height * row_length)
    return numbers.reshape(frame.height, row_length)[:, : frame.width]


def read_rgb(
    reader: VideoReader,
    index: int,
    *,
    size: tuple[int, int] | None = None,
    out: UInt8[np.ndarray, "3 h w"] | None = None,
    content: Literal["any", "colour"] = "any",
) -> UInt8[np.ndarray, "3 h w"]:
    """Return a frame as red, green and blue planes.

    At the stored size the numbers equal those of ``ffmpeg -pix_fmt rgb24``, bit for bit for
    progressive 8-bit video, its colour matrix and range as the file gives them. Chroma lies where
    the file's tag says, or in the middle of its pixels without a tag. At another size
    they are scaled before the conversion, antialiased, with pixel centres kept (u' = s u, where
    the first pixel's centre is 0.5): by area where the picture shrinks, else bicubic. The scaled
    conversion of yuv420p rounds, where ffmpeg's unscaled one cuts off: it is 1.1 grey levels
    brighter on average.

    Args:
        reader: An open video.
        index: Which frame, from 0.
        size: (height, width) to scale to; None for the stored size.
        out: Where to write, uint8 (3, h, w); None for a new array.
        content: Whether the video must hold colour pictures, as views do.

    Returns:
        uint8 (3, h, w), C-contiguous where ``out`` is; ``out`` itself if given.

    Raises:
        MediaError: If the frame cannot be decoded or is not what it must be.
    """
    frame = reader.colour_frame(index) if content == "colour" else reader.frame(index)
    height, width = size or (frame.height, frame.width)
    if out is None:
        out = np.empty((3, height, width), dtype=np.uint8)
    try:
        picture = _converted(reader, frame, size=(height, width))
    except av.FFmpegError as error:
        raise MediaError(
            f"{reader.name}: frame {index} ({frame.format.name}, {frame.width}x{frame.height}) "
            f"cannot be converted to RGB of {width}x{height} ({error.strerror}): write it again."
        ) from error
    if picture.format.name == "rgb24":
        out[...] = picture.to_ndarray().transpose(2, 0, 1)
        return out
    for channel, plane in enumerate(RED_GREEN_BLUE):
        out[channel] = plane_numbers(picture, plane, dtype="u1")
    return out


def _converted(reader: VideoReader, frame: VideoFrame, *, size: tuple[int, int]) -> VideoFrame:
    """Return a picture as gbrp or rgb24 at a size, its chroma from where it lies.

    At the stored size, FFmpeg's own conversion takes subsampled chroma of 8 bits to lie in the
    middle, whatever the tag; it is not used where chroma lies elsewhere.
    """
    stored = (frame.height, frame.width)
    siting, is_thinned = reader.siting(frame), is_subsampled(frame)
    pixel_format = "gbrp"
    flags = "area" if size[0] * size[1] < frame.height * frame.width else "bicubic"
    if size != stored:
        if is_thinned and (frame.width % 2 or frame.height % 2):
            # FFmpeg stretches the chroma that reaches half a pixel beyond the edge.
            frame = _converted(reader, frame, size=stored)
    elif is_thinned and siting != CENTRE:
        flags = "bicubic+accurate_rnd"
    else:
        pixel_format = "gbrp" if _has_exact_planes(frame) else "rgb24"
        if _ignores_siting(frame):
            return reader.scaler.reformat(
                frame, format=pixel_format, interpolation=Interpolation.BICUBIC, threads=1
            )
    return reader.converter.convert(
        frame, size=size, pixel_format=pixel_format, flags=flags, siting=siting
    )


def _ignores_siting(frame: VideoFrame) -> bool:
    """Return whether FFmpeg converts a picture at its stored size without a look at the tag."""
    return not is_subsampled(frame) or (
        frame.format.name in ("yuv420p", "yuvj420p", "yuv422p", "yuvj422p")
        and frame.height % 2 == 0
        and frame.width % 2 == 0
    )


def _has_exact_planes(frame: VideoFrame) -> bool:
    """Return whether FFmpeg's unscaled conversion to planes equals the one to rgb24.

    It is 1.6 ms faster at 1280x1280. But its last columns are garbage where 1 to 8 are left over
    from groups of 16 (measured with FFmpeg 8: 24, 360 and 854 pixels wide, for example), unless
    every pixel has chroma of its own (measured for widths of 1 to 69 and some larger).
    """
    return frame.format.name in ("yuv444p", "yuvj444p") or (
        frame.format.name in ("yuv420p", "yuvj420p")
        and frame.height % 2 == 0
        and not 1 <= frame.width % 16 <= 8
    )
