"""Pictures to a video that every reader decodes to the same colours: H.264, tagged BT.601."""

from dataclasses import dataclass
from fractions import Fraction
from io import BufferedIOBase
from pathlib import Path
from typing import Any, BinaryIO, Final, Literal, TypeVar, cast

import av
import numpy as np
from av.video.stream import VideoStream
from jaxtyping import UInt8

from stereogenbench_data.errors import MediaError

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

    def write(self, frame: av.VideoFrame) -> None:
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
            av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(
                format=self._pixel_format, dst_colorspace=_TO_BT601, dst_color_range=_LIMITED_RANGE
            )
        )
