"""Pictures to videos that every reader decodes to the same colours: H.264, tagged BT.601.

Training shards have settings of their own, and what these cost is measured.
"""

import io
import math
from dataclasses import asdict, dataclass, field
from fractions import Fraction
from io import BufferedIOBase
from pathlib import Path
from typing import Any, BinaryIO, Final, Literal, TypeVar, cast

import av
import numpy as np
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from jaxtyping import UInt8
from PIL import Image

from stereogenbench_data.errors import MediaError
from stereogenbench_data.media.container import (
    CHECKSUM_TAG,
    VideoFile,
    reserved_checksums,
    write_checksums,
)
from stereogenbench_data.media.siting import CENTRE, Converter
from stereogenbench_data.media.video import VideoReader, read_rgb
from stereogenbench_data.schema.training import MOST_PSNR_DB

PIXEL_FORMATS: Final = ("yuv420p", "yuv444p")
LARGEST_CRF: Final = 51
_PRESETS: Final = (
    "ultrafast", "superfast", "veryfast", "faster", "fast", "medium", "slow", "slower", "veryslow",
)  # fmt: skip
_CODEC: Final = "libx264"
"""H.265 is not offered: libx265 of PyAV's wheels writes beyond its memory for small pictures."""
_REPRODUCIBLE: Final = "mbtree=0"
"""With its tree of macroblocks x264 reads memory that it has not written, and bytes differ."""
_BT601: Final = 6
"""FFmpeg's number of BT.601 with 525 lines as a colour space: what readers take an untagged video
to be, and some of them any video."""
_TO_BT601: Final = 5
"""The scaler's number of the same."""
_LIMITED_RANGE: Final = 1
_Writer = TypeVar("_Writer", bound="VideoWriter")


@dataclass(frozen=True, slots=True)
class Encoding:
    """How pictures are encoded.

    Attributes:
        crf: The constant rate factor, 0 to 51; fewer is better and larger.
        preset: How much effort goes into small files, "ultrafast" to "veryslow".
        pixel_format: "yuv420p", or "yuv444p" for colours at full resolution.
        key_frame_every: The most frames from one key frame to the next; None for the codec's
            default, one in 250.

    Raises:
        MediaError: If a value is out of range.
    """

    crf: int = 12
    preset: str = "medium"
    pixel_format: str = "yuv420p"
    key_frame_every: int | None = None

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        for name, value, known in (
            ("preset", self.preset, _PRESETS),
            ("pixel_format", self.pixel_format, PIXEL_FORMATS),
        ):
            if value not in known:
                raise MediaError(f"{name} must be one of {', '.join(known)}, got {value!r}.")
        if not 0 <= self.crf <= LARGEST_CRF:
            raise MediaError(f"crf must be 0 to {LARGEST_CRF}, got {self.crf!r}.")
        if self.key_frame_every is not None and self.key_frame_every < 1:
            raise MediaError(f"key_frame_every must be at least 1, got {self.key_frame_every!r}.")

    def options(self, *, quality: Literal["as set", "lossless"]) -> dict[str, str]:
        """Return the codec's own options; "lossless" of grey pictures is exact in every value."""
        options = {"preset": self.preset, "x264-params": _REPRODUCIBLE}
        options |= {"crf": str(self.crf)} if quality == "as set" else {"qp": "0"}
        if self.key_frame_every is not None:
            options["g"] = str(self.key_frame_every)
        return options


class VideoWriter:
    """A video to write, as a context manager; it is whole after an exit without error.

    One thread encodes, so that the same frames give the same bytes.
    """

    def __init__(
        self,
        file: Path | BinaryIO | BufferedIOBase,
        *,
        container: str,
        codec: str,
        rate_hz: float,
        options: dict[str, str],
        tags: dict[str, str] | None = None,
    ) -> None:
        """Begin a video.

        Args:
            file: Where it goes; an open file stays the caller's to close.
            container: FFmpeg's name of the container.
            codec: FFmpeg's name of the codec.
            rate_hz: Frames a second.
            options: The codec's own options.
            tags: Metadata of the container.
        """
        self._rate = Fraction(rate_hz).limit_denominator(1001)
        self._container = av.open(
            file, "w", format=container, container_options={"fflags": "+bitexact"}
        )
        self._container.metadata.update(tags or {})
        self._stream = cast(
            VideoStream, self._container.add_stream(codec, rate=self._rate, options=options)
        )
        self._stream.codec_context.thread_count = 1
        self._frames = 0

    def write(self, frame: VideoFrame) -> None:
        """Append a frame; the first one sets the video's size and pixel format.

        Raises:
            OSError: If the file cannot be written.
        """
        if self._frames == 0:
            self._stream.width, self._stream.height = frame.width, frame.height
            self._stream.pix_fmt = frame.format.name
        frame.pts, frame.time_base = self._frames, 1 / self._rate
        self._frames += 1
        self._container.mux(self._stream.encode(frame))

    def __enter__(self: _Writer) -> _Writer:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        try:
            if kind is None:
                self._container.mux(self._stream.encode(None))
        finally:
            self._container.close()


class VideoEncoder(VideoWriter):
    """An MP4 video of RGB pictures to write: H.264, tagged BT.601."""

    def __init__(
        self,
        file: BinaryIO | BufferedIOBase,
        *,
        rate_hz: float,
        encoding: Encoding,
        quality: Literal["as set", "lossless"] = "as set",
    ) -> None:
        """Begin a video.

        Args:
            file: Is written to, and stays the caller's to close.
            rate_hz: Frames a second.
            encoding: How pictures are encoded.
            quality: "lossless" instead of the encoding's rate factor.
        """
        options = encoding.options(quality=quality)
        super().__init__(file, container="mp4", codec=_CODEC, rate_hz=rate_hz, options=options)
        self._pixel_format = encoding.pixel_format
        context: Any = self._stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = _BT601
        context.color_range = _LIMITED_RANGE

    def write_picture(self, picture: UInt8[np.ndarray, "h w 3"]) -> None:
        """Append an RGB picture.

        Raises:
            MediaError: If a side is odd, and the pixel format halves colours.
            OSError: If the file cannot be written.
        """
        height, width = picture.shape[:2]
        if self._pixel_format == "yuv420p" and (height % 2 or width % 2):
            raise MediaError(
                f"pictures of {width}x{height} pixels have an odd side, which yuv420p cannot "
                "store: choose an even size, or pixel_format yuv444p."
            )
        self.write(
            VideoFrame.from_ndarray(picture, format="rgb24").reformat(
                format=self._pixel_format, dst_colorspace=_TO_BT601, dst_color_range=_LIMITED_RANGE
            )
        )


# Pictures of training shards.

# Training reads few frames of many scenes, in any order, so a video begins anew every few frames
# (closed groups of pictures, none added where the scene changes). Frames are encoded by one thread
# with fixed settings, so the same pictures and libraries give the same bytes.
#
# Source of the settings: docs/performance/README.md, "Codecs of training shards".

Quality = Literal["small", "balanced", "high"]

Pictures = UInt8[np.ndarray, "t 3 h w"]

_TO_YUV: Final = "area+accurate_rnd+full_chroma_inp"
_LEAST_ERROR: Final = 1.0
"""The mean squared error, in grey levels, below which a frame is never taken for its neighbour."""
_THINNED: Final = (slice(None), slice(None, None, 4), slice(None, None, 4))
"""The pixels that a frame is compared with its neighbours by."""
_NEARER: Final = 0.5
"""A frame is its neighbour if its error against that one is less than this share of its own."""


@dataclass(frozen=True, slots=True)
class PictureCodec:
    """How pictures are encoded.

    Attributes:
        codec: FFmpeg's name: "h264", or "mjpeg" for JPEG pictures in a video.
        pixel_format: FFmpeg's name.
        options: Of the encoder.
        key_frame_distance: Frames from a key frame to the next.
        bits_a_pixel: About how many bits a pixel of a frame takes: shards are planned by it.
    """

    codec: Literal["h264", "mjpeg"]
    pixel_format: str
    options: dict[str, str]
    key_frame_distance: int
    bits_a_pixel: float = field(compare=False)

    def description(self) -> dict[str, Any]:
        """Return what ``training.json`` says of it."""
        return {name: value for name, value in asdict(self).items() if name != "bits_a_pixel"}


def _h264(rate_factor: int, *, key_frame_distance: int, bits_a_pixel: float) -> PictureCodec:
    # Without B-frames each packet gives its picture at once: nothing beyond a run is decoded.
    parameters = {
        "keyint": key_frame_distance, "min-keyint": key_frame_distance, "scenecut": 0,
        "open-gop": 0, "bframes": 0, "mbtree": 0, "fast-pskip": 0, "dct-decimate": 0,
        "cpu-independent": 1,
        "colormatrix": "smpte170m", "fullrange": "off", "chromaloc": 1,
    }  # fmt: skip
    options = {
        "crf": str(rate_factor),
        "preset": "medium",
        "tune": "fastdecode",
        "x264-params": ":".join(f"{name}={value}" for name, value in parameters.items()),
    }
    return PictureCodec("h264", "yuv420p", options, key_frame_distance, bits_a_pixel)


QUALITIES: Final[dict[Quality, PictureCodec]] = {
    "small": _h264(18, key_frame_distance=8, bits_a_pixel=0.8),
    "balanced": _h264(10, key_frame_distance=4, bits_a_pixel=2.0),
    "high": PictureCodec(
        "mjpeg", "yuvj444p", {"quality": "95", "subsampling": "4:4:4"}, 1, bits_a_pixel=5.0
    ),
}
"""Points between speed, size and error, by name."""


@dataclass(frozen=True, slots=True)
class PictureError:
    """PSNR in dB of encoded pictures, rounded down to a thousandth; see `measured_error`."""

    psnr_db: float
    worst_psnr_db: float
    worst_frame: int


def require_encodable(size: tuple[int, int], quality: Quality) -> None:
    """Refuse a (height, width) in pixels that a quality cannot store.

    Raises:
        MediaError: If the chroma of H.264 halves an odd side.
    """
    if QUALITIES[quality].pixel_format == "yuv420p" and (size[0] % 2 or size[1] % 2):
        raise MediaError(
            f"size {size[1]}x{size[0]}: quality {quality!r} stores one colour for 2x2 pixels, so "
            f"both sides must be even. Choose {size[1] // 2 * 2}x{size[0] // 2 * 2}, or quality "
            f"'high'."
        )


def write_pictures(
    pictures: Pictures,
    target: Path,
    *,
    quality: Quality,
    rate_hz: Fraction,
) -> None:
    """Write pictures as an MP4 video, the same bytes for the same pictures and libraries.

    Args:
        pictures: (t, 3, h, w) uint8.
        target: The file.
        quality: Which settings, of `QUALITIES`.
        rate_hz: Frames a second.

    Raises:
        MediaError: If this PyAV cannot encode, or the size cannot be stored.
        OSError: If it cannot be written.
    """
    codec = QUALITIES[quality]
    height, width = pictures.shape[-2:]
    require_encodable((height, width), quality)
    options = {"fflags": "+bitexact", "movflags": "+faststart"}
    try:
        with av.open(target, "w", format="mp4", container_options=options) as container:
            encoder = "libx264" if codec.codec == "h264" else "mjpeg"
            settings = codec.options if codec.codec == "h264" else {}
            stream: Any = container.add_stream(encoder, rate=rate_hz, options=dict(settings))
            stream.width, stream.height, stream.pix_fmt = width, height, codec.pixel_format
            stream.codec_context.thread_count = 1
            container.metadata[CHECKSUM_TAG] = reserved_checksums(len(pictures))
            converter = Converter()
            for index, picture in enumerate(pictures):
                pixels = np.ascontiguousarray(picture.transpose(1, 2, 0))
                if codec.codec == "mjpeg":
                    packet = av.Packet(_jpeg(pixels, codec))
                    packet.stream, packet.is_keyframe = stream, True
                    packet.pts = packet.dts = index
                    packet.duration, packet.time_base = 1, 1 / rate_hz
                    container.mux(packet)
                else:
                    frame = converter.convert(
                        VideoFrame.from_ndarray(pixels, format="rgb24"),
                        size=(height, width),
                        pixel_format=codec.pixel_format,
                        flags=f"{_TO_YUV}:out_color_matrix=smpte170m:out_range=tv"
                        f":out_chroma_loc={CENTRE}",
                        siting=CENTRE,
                    )
                    frame.pts, frame.time_base = index, 1 / rate_hz
                    container.mux(stream.encode(frame))
            if codec.codec == "h264":
                container.mux(stream.encode(None))
    except (av.FFmpegError, ValueError) as error:
        if isinstance(error, OSError) and (error.errno or 0) > 0:  # not one of FFmpeg's own
            raise
        raise MediaError(
            f"{target}: {width}x{height} pictures cannot be encoded as {codec.codec} ({error}). "
            f"Check that this PyAV has libx264, or choose another quality."
        ) from error
    write_checksums(target, packets=len(pictures))


def _jpeg(pixels: UInt8[np.ndarray, "h w 3"], codec: PictureCodec) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(
        file,
        "jpeg",
        quality=int(codec.options["quality"]),
        subsampling=codec.options["subsampling"],
    )
    return file.getvalue()


def measured_error(pictures: Pictures, video: VideoFile, *, name: str) -> PictureError:
    """Decode a video of pictures again, as readers do, and compare it with them.

    Args:
        pictures: (t, 3, h, w) uint8, what was encoded.
        video: What was written.
        name: What messages call it.

    Returns:
        The mean over frames, and the least, of 10 log10(255^2 / mean squared error over pixels and
        colours), at most `MOST_PSNR_DB`.

    Raises:
        MediaError: If the video has another number of frames, does not decode, or shows a
            neighbouring frame in the place of one.
    """
    count, found = len(pictures), []
    with VideoReader(video, name=name, frames=count) as reader:
        for index in range(count):
            decoded = read_rgb(reader, index, content="colour")
            found.append(_squared_error(decoded, pictures[index]))
            thinned = decoded[_THINNED]
            error = _squared_error(thinned, pictures[index][_THINNED])
            for other in (index - 1, index + 1):
                if error <= _LEAST_ERROR or not 0 <= other < count:
                    continue
                if _squared_error(thinned, pictures[other][_THINNED]) < _NEARER * error:
                    raise MediaError(
                        f"{name}: frame {index} shows frame {other} of its source. Check the "
                        f"version of PyAV, then write it again."
                    )
    decibels = [_decibels(error) for error in found]
    worst = int(np.argmin(decibels))
    mean_db = math.floor(float(np.mean(decibels)) * 1000) / 1000
    return PictureError(mean_db, min(mean_db, math.floor(decibels[worst] * 1000) / 1000), worst)


def _squared_error(one: np.ndarray, other: np.ndarray) -> float:
    """Return the mean squared difference of two uint8 arrays, exact on every machine."""
    difference = np.where(one > other, one - other, other - one)
    total = np.square(difference, dtype=np.uint16).sum(dtype=np.int64)
    return float(total / difference.size)


def _decibels(error: float) -> float:
    return min(MOST_PSNR_DB, 10 * math.log10(255**2 / error)) if error else MOST_PSNR_DB
