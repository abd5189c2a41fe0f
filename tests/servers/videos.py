"""Videos of frames that a test makes, and those of the small scenes."""

from collections.abc import Iterable, Mapping
from fractions import Fraction
from pathlib import Path
from types import MappingProxyType
from typing import Any

import av
import numpy as np

FRAMES = 4
SIZE = (24, 32)


def write_frames(
    path: Path,
    frames: Iterable[av.VideoFrame],
    *,
    codec: str,
    pixel_format: str,
    tags: Mapping[str, str] = MappingProxyType({}),
    options: Mapping[str, str] | None = None,
    file_options: Mapping[str, str] | None = None,
) -> Path:
    """Encode frames of one size, 15 a second."""
    with av.open(str(path), "w", options=dict(file_options or {})) as container:
        container.metadata.update(tags)
        stream = container.add_stream(codec, rate=15, options=dict(options or {}))
        for number, frame in enumerate(frames):
            if number == 0:
                stream.width, stream.height = frame.width, frame.height
                stream.pix_fmt = pixel_format
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def write_video(
    path: Path, *, frames: int = FRAMES, size: tuple[int, int] = SIZE, tags: dict[str, str]
) -> Path:
    """Write an H.264 clip (mp4) or FFV1 16-bit depth of which the first row is not measured."""
    if path.suffix == ".mkv":
        maps = [np.full(size, 3000 + index, dtype=np.uint16) for index in range(frames)]
        for units in maps:
            units[0] = 0
        return write_depth(path, maps, tags=tags)
    step = min(40, 255 // frames)
    grey = [np.full((*size, 3), step * index, dtype=np.uint8) for index in range(frames)]
    return write_rgb(path, grey, tags=tags)


def write_depth(path: Path, maps: Iterable[Any], **how: Any) -> Path:
    """Encode 16-bit depth maps with FFV1."""
    frames = (av.VideoFrame.from_ndarray(units, format="gray16le") for units in maps)
    return write_frames(path, frames, codec="ffv1", pixel_format="gray16le", **how)


def write_rgb(path: Path, pictures: Iterable[Any], **how: Any) -> Path:
    """Encode pictures (h, w, 3) with H.264, or as is told."""
    frames = (av.VideoFrame.from_ndarray(each, format="rgb24") for each in pictures)
    return write_frames(path, frames, **({"codec": "libx264", "pixel_format": "yuv420p"} | how))


def write_at(
    path: Path,
    times: Iterable[Fraction | float],
    *,
    codec: str | None = None,
    tick_s: Fraction | None = None,
    rate_hz: Fraction | int = 15,
    **how: Any,
) -> Path:
    """Encode frames of a scene, each darker than the next, that are shown at some times in s.

    A path that ends in ``.mkv`` is of depth, another of pictures.
    """
    is_depth = path.suffix == ".mkv"
    tick_s = tick_s or Fraction(1, 1000 if is_depth else 15360)
    with av.open(str(path), "w", options=how.get("file_options", {})) as container:
        container.metadata.update({"DEPTH_SCALE": "0.001"} if is_depth else {})
        codec = codec or ("ffv1" if is_depth else "libx264")
        stream = container.add_stream(codec, rate=rate_hz, options=how.get("options", {}))
        stream.height, stream.width = SIZE
        stream.pix_fmt = how.get("pixel_format", "gray16le" if is_depth else "yuv420p")
        stream.codec_context.time_base = stream.time_base = tick_s
        for number, time_s in enumerate(times):
            shown = (
                av.VideoFrame.from_ndarray(np.full(SIZE, 3000 + number, np.uint16), "gray16le")
                if is_depth
                else av.VideoFrame.from_ndarray(np.full((*SIZE, 3), 8 * number, np.uint8), "rgb24")
            )
            shown.pts, shown.time_base = round(time_s / tick_s), tick_s
            container.mux(stream.encode(shown))
        container.mux(stream.encode(None))
    return path
