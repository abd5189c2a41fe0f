"""Videos of frames that a test makes, and those of the small scenes."""

from collections.abc import Iterable, Mapping
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
    grey = [np.full((*size, 3), 40 * index, dtype=np.uint8) for index in range(frames)]
    return write_rgb(path, grey, tags=tags)


def write_depth(path: Path, maps: Iterable[Any], **how: Any) -> Path:
    """Encode 16-bit depth maps with FFV1."""
    frames = (av.VideoFrame.from_ndarray(units, format="gray16le") for units in maps)
    return write_frames(path, frames, codec="ffv1", pixel_format="gray16le", **how)


def write_rgb(path: Path, pictures: Iterable[Any], **how: Any) -> Path:
    """Encode pictures (h, w, 3) with H.264, or as is told."""
    frames = (av.VideoFrame.from_ndarray(each, format="rgb24") for each in pictures)
    return write_frames(path, frames, **({"codec": "libx264", "pixel_format": "yuv420p"} | how))
