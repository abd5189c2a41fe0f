"""The open videos of one process: opened when first needed, decoded forwards, closed in turn.

Samples that share a frame (pairs of one moment, fields of one pair) share its decoding: each
stream keeps the last picture that it gave.
"""

import os
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import UInt8, UInt16

from stereogenbench_data.media.depth import read_depth_units
from stereogenbench_data.media.video import VideoReader, read_rgb
from stereogenbench_data.schema.records import DepthEncoding

OPEN_STREAMS: Final = 24
"""How many videos a process keeps open: two scenes with all their cameras' colour and depth."""

_inherited: Final[list[object]] = []
"""Readers that came over a fork. They share file offsets with the parent, so they are neither read
nor closed here: the operating system takes them back when the process ends."""


@dataclass(slots=True)
class _Stream:
    reader: VideoReader
    last: dict[object, Any] = field(default_factory=dict)


class Streams:
    """A pool of open videos that survives fork and spawn: each process opens its own.

    Pictures come back read-only, because the pool may hand out the same one again.
    """

    def __init__(self, *, limit: int = OPEN_STREAMS) -> None:
        """Keep at most ``limit`` videos open."""
        self._limit = limit
        self._open: OrderedDict[Path, _Stream] = OrderedDict()
        self._process = os.getpid()

    def rgb(
        self, path: Path, index: int, *, frames: int, size: tuple[int, int] | None
    ) -> UInt8[np.ndarray, "3 h w"]:
        """Return one frame as RGB, scaled to (height, width) where a size is given.

        Raises:
            MediaError: If the video does not decode to so many frames.
        """
        stream = self._stream(path, frames=frames)
        picture: UInt8[np.ndarray, "3 h w"] = _kept(
            stream, (index, size), lambda: read_rgb(stream.reader, index, size=size)
        )
        return picture

    def depth_units(
        self, path: Path, index: int, *, frames: int, encoding: DepthEncoding
    ) -> UInt16[np.ndarray, "h w"]:
        """Return one depth frame as stored numbers.

        Raises:
            MediaError: If the stream is not one that the encoding describes or does not decode.
        """
        stream = self._stream(path, frames=frames)
        units: UInt16[np.ndarray, "h w"] = _kept(
            stream, index, lambda: read_depth_units(stream.reader, index, encoding=encoding)
        )
        return units

    def pixel_format(self, path: Path, *, frames: int) -> str:
        """Return the pixel format of a video."""
        return self._stream(path, frames=frames).reader.facts.pixel_format

    def close(self) -> None:
        """Close every video; the pool can be used again."""
        self._drop_inherited()
        while self._open:
            self._open.popitem()[1].reader.close()

    def _stream(self, path: Path, *, frames: int) -> _Stream:
        self._drop_inherited()
        if path in self._open:
            self._open.move_to_end(path)
            return self._open[path]
        while len(self._open) >= self._limit:
            self._open.popitem(last=False)[1].reader.close()
        stream = self._open[path] = _Stream(VideoReader(path, name=str(path), frames=frames))
        return stream

    def _drop_inherited(self) -> None:
        if os.getpid() != self._process:
            _inherited.append(self._open)
            self._open = OrderedDict()
            self._process = os.getpid()

    def __getstate__(self) -> dict[str, int]:
        return {"limit": self._limit}

    def __setstate__(self, state: dict[str, int]) -> None:
        self.__init__(limit=state["limit"])  # type: ignore[misc]


def _kept(stream: _Stream, key: object, read: Callable[[], Any]) -> Any:
    """Return what a stream gave last, if that is what is asked for; else read it and keep it."""
    if key not in stream.last:
        picture = read()
        picture.flags.writeable = False
        stream.last = {key: picture}
    return stream.last[key]
