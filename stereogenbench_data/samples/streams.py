"""The open videos of one process: opened when first needed, decoded forwards, closed in turn.

Samples that share a frame (pairs of one moment, fields of one pair) share its decoding: each
stream keeps its last picture. A stream that fails is closed, and opened again when next needed.

`Views` are what is decoded for one sample, before anything is derived from it. Transforms map one
`Views` to another: they move pictures, stored depth and cameras together, so what is derived fits.
"""

import os
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, UInt8, UInt16

from stereogenbench_data.errors import FieldError, MediaError, StorageError
from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.media.depth import measured, open_video, read_depth_units, resized_nearest
from stereogenbench_data.media.video import read_rgb, require_indexed_picture
from stereogenbench_data.schema.records import DepthEncoding, Scene
from stereogenbench_data.sources.members import MemberSource
from stereogenbench_data.sources.ranged_file import MemberFile, RangedFile

Pictures = UInt8[np.ndarray, "t 3 h w"]


@dataclass(frozen=True, slots=True, eq=False)
class StoredDepth:
    """Depth as it is stored, of one frame or over the frames of a sample.

    Attributes:
        units: (t, h, w) or (h, w) uint16, stored numbers.
        measured: (t, h, w) or (h, w) bool, where they mean a depth.
        derived: Maps computed from these numbers, kept for other pairs, by what they are.
    """

    units: UInt16[np.ndarray, "*t h w"]
    measured: Bool[np.ndarray, "*t h w"]
    derived: dict[object, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """The pictures and stored depths of a sample's cameras, with their common intrinsics.

    Attributes:
        source: The camera whose pixels have the disparity.
        targets: The cameras that it is paired with.
        frames: The frame numbers, one for each place of the time axis.
        pictures: (t, 3, h, w) uint8 for each camera whose picture is wanted.
        depths: Stored depth for each camera whose depth is wanted.
        intrinsics: Of every camera, after what was done to the pictures.
        world: "as recorded", or "mirrored" (x negated) after a horizontal flip.
        padded: (h, w) bool, pixels of every view that are padding or were averaged with padding.
            They are never `measured`. None where no pixel is padding.
        erased: (h, w) bool for each camera whose picture was painted over: where.

    Raises:
        FieldError: If ``padded`` or ``erased`` is not of the pictures' size.
    """

    source: int
    targets: tuple[int, ...]
    frames: tuple[int, ...]
    pictures: dict[int, Any]
    depths: dict[int, StoredDepth]
    intrinsics: Intrinsics
    world: Literal["as recorded", "mirrored"] = "as recorded"
    padded: Bool[np.ndarray, "h w"] | None = None
    erased: dict[int, Bool[np.ndarray, "h w"]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Require that `padded` and `erased` have the size of the pictures."""
        height_px, width_px = self.intrinsics.height_px, self.intrinsics.width_px
        for name, maps in (("padded", [self.padded]), ("erased", self.erased.values())):
            for pixels in maps:
                if pixels is not None and pixels.shape != (height_px, width_px):
                    raise FieldError(
                        f"`{name}` of the views has shape {pixels.shape}, their pictures are "
                        f"{height_px} pixels high and {width_px} wide: a transform that moves "
                        f"pictures must move `{name}` with them."
                    )

    def unseen(self, camera: int) -> Bool[np.ndarray, "h w"] | None:
        """Return where a picture does not show what its camera saw, None for nowhere."""
        maps = [pixels for pixels in (self.padded, self.erased.get(camera)) if pixels is not None]
        return np.logical_or.reduce(maps) if maps else None


OPEN_STREAMS: Final = 24
"""How many videos a process keeps open: two scenes with all their cameras' colour and depth."""

_Place = tuple[str, int, int]
"""Path and offset of a video, and which run of it is read."""

_inherited: Final[list[object]] = []
"""Readers that came over a fork. They share file offsets with the parent, so they are neither read
nor closed here: the operating system takes them back when the process ends."""


class StreamStats(NamedTuple):
    """What a pool has open.

    Attributes:
        videos_open: How many videos.
        videos_limit: How many at the most.
    """

    videos_open: int
    videos_limit: int


@dataclass(slots=True)
class _Stream:
    """An open video, and what was read of it last.

    Attributes:
        reader: A `VideoReader` or, of depth that blosc2 packed, `DepthFrames`.
        file: What it reads.
        kept: Pictures and stored depth, by their frames.
        memories: The memory of its last pictures, and weak references to them, the oldest first.
    """

    reader: Any
    file: Path | MemberFile
    kept: OrderedDict[Any, Any] = field(default_factory=OrderedDict)
    memories: list[tuple[memoryview, Callable[[], object]]] = field(default_factory=list)

    def keep(self, key: Any, make: Callable[[], Any], *, most: int) -> Any:
        """Return what is kept under a key, made now unless it is there; the oldest makes room."""
        if key not in self.kept:
            while len(self.kept) >= most:
                self.kept.popitem(last=False)
            self.kept[key] = make()
        return self.kept[key]

    def picture(self, *, height: int, width: int, most: int) -> UInt8[np.ndarray, "3 h w"]:
        """Return an array to write a picture into, of any content.

        It lies in the memory of an earlier picture that nobody holds. New memory costs more than
        what is written into it: the system clears it first. A weak reference shows whether anybody
        holds a picture, or a view or tensor of it. Where an interpreter frees objects late, the
        next picture gets memory of its own.
        """
        size = 3 * height * width
        memory = np.empty(0, dtype=np.uint8).data
        if len(self.memories) >= most:
            memory, held = self.memories.pop(0)
            memory = memory if held() is None else memory[:0]
        if memory.nbytes != size:
            memory = np.empty(size, dtype=np.uint8).data
        # All views of the picture are based on this array, and none on what is below it.
        base = np.frombuffer(memory, dtype=np.uint8)
        self.memories.append((memory, weakref.ref(base)))
        return base.reshape(3, height, width)

    def close(self) -> None:
        self.reader.close()
        if isinstance(self.file, MemberFile):
            self.file.close()


class Streams:
    """A pool of open videos that survives fork and spawn: each process opens its own.

    Threads of one process take turns. Pictures and depth come back read-only, because the pool may
    hand out the same ones again.

    Attributes:
        limit: How many videos it keeps open.
        kept_frames: How many frames of each it keeps.
    """

    def __init__(
        self, source: MemberSource, *, limit: int = OPEN_STREAMS, kept_frames: int = 1
    ) -> None:
        """Open videos from a source; none is opened yet."""
        self._source = source
        self.limit = limit
        self.kept_frames = kept_frames
        self._open: OrderedDict[_Place, _Stream] = OrderedDict()
        self._lock = threading.RLock()
        self._process = os.getpid()

    def rgb(
        self,
        scene: Scene,
        name: str,
        index: int,
        *,
        size: tuple[int, int] | None = None,
        out: UInt8[np.ndarray, "3 h w"] | None = None,
        run: int = 0,
    ) -> UInt8[np.ndarray, "3 h w"]:
        """Return one frame of a scene's video as RGB.

        Args:
            scene: The scene.
            name: The video, such as "cam_00_rgb.mp4".
            index: Which frame.
            size: (height, width) to scale it to, None for the stored size.
            out: Where to write it, scaled to fit: for pictures that are needed once, which the pool
                does not keep.
            run: Each run of a video has a decoder of its own, so that several can be read by turns.

        Raises:
            StorageError: If the video cannot be read.
            MediaError: If it does not decode to the scene's number of colour pictures.
        """
        most = self.kept_frames
        height, width = size or (scene.rig.image_height_px, scene.rig.image_width_px)
        with self._stream(scene, name, run) as stream:
            if out is not None:
                shape = (out.shape[-2], out.shape[-1])
                read_rgb(stream.reader, index, size=shape, out=out, content="colour")
                return out

            def read() -> Any:
                place = stream.picture(height=height, width=width, most=most)
                return _read_only(
                    read_rgb(stream.reader, index, size=size, out=place, content="colour")
                )

            kept: UInt8[np.ndarray, "3 h w"] = stream.keep((index, size), read, most=most)
            return kept

    def read_stored_depth(
        self,
        scene: Scene,
        name: str,
        index: int,
        *,
        encoding: DepthEncoding,
        size: tuple[int, int] | None = None,
        run: int = 0,
    ) -> StoredDepth:
        """Return one depth frame of a scene's video, (h, w): stored numbers, where measured.

        Args:
            scene: The scene.
            name: The video, such as "cam_00_depth.mkv".
            index: Which frame of the file; `depth_frame_index` tells which an RGB frame needs.
            encoding: The depth contract.
            size: (height, width) to take the nearest pixels of, None for the stored size.
            run: As for `rgb`.

        Raises:
            StorageError: If the video cannot be read.
            MediaError: If it is not one that the encoding describes or does not decode.
        """
        with self._stream(scene, name, run) as stream:

            def read() -> StoredDepth:
                units = read_depth_units(stream.reader, index, encoding=encoding)
                if size is not None:
                    units = resized_nearest(units, size=size)
                pixel_format = stream.reader.facts.pixel_format
                known = measured(units, encoding=encoding, pixel_format=pixel_format)
                return StoredDepth(_read_only(units), known)

            kept: StoredDepth = stream.keep((index, size, encoding), read, most=self.kept_frames)
            return kept

    @property
    def stats(self) -> "StreamStats":
        """What this process has open."""
        is_own = os.getpid() == self._process
        return StreamStats(len(self._open) if is_own else 0, self.limit)

    def release(self, scene: Scene, *, run: int = 0) -> None:
        """Close the videos of a scene's run, of which no more is wanted for now."""
        self._drop_inherited()
        with self._lock:
            for member in scene.members.values():
                stream = self._open.pop((member.path, member.offset, run), None)
                if stream is not None:
                    stream.close()

    def close(self) -> None:
        """Close every video; the pool can be used again."""
        self._drop_inherited()
        with self._lock:
            while self._open:
                self._open.popitem()[1].close()

    @contextmanager
    def _stream(self, scene: Scene, name: str, run: int) -> Iterator[_Stream]:
        """Yield an open video; it stays open unless reading it fails."""
        self._drop_inherited()
        with self._lock:
            member, name = scene.member(name), scene.held_name(name)
            place = (member.path, member.offset, run)
            if place not in self._open:
                while len(self._open) >= self.limit:
                    self._open.popitem(last=False)[1].close()
                file = self._source.open(scene, name)
                with _cause_raised(file):
                    label = self._source.label(scene, name)
                    reader = open_video(file, name=label, frames=scene.frames)
                    try:
                        require_indexed_picture(reader, scene.rig)
                    except MediaError:
                        reader.close()
                        raise
                self._open[place] = _Stream(reader, file)
            self._open.move_to_end(place)
            stream = self._open[place]
            try:
                with _cause_raised(stream.file):
                    yield stream
            except (MediaError, StorageError):
                self._open.pop(place).close()
                raise

    def _drop_inherited(self) -> None:
        if os.getpid() != self._process:
            _inherited.append(self._open)
            self._open = OrderedDict()
            self._lock = threading.RLock()
            self._process = os.getpid()

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what another process makes a pool of its own from."""
        again = partial(Streams, limit=self.limit, kept_frames=self.kept_frames)
        return again, (self._source,)


def _read_only(picture: Any) -> Any:
    picture.flags.writeable = False
    return picture


@contextmanager
def _cause_raised(file: Path | MemberFile) -> Iterator[None]:
    """Raise the failed fetch that made a video fail, if there was one, and close the file."""
    try:
        yield
    except (MediaError, StorageError) as error:
        if isinstance(file, MemberFile):
            file.close()
        failure = file.failure if isinstance(file, RangedFile) else None
        if failure is None or failure is error:
            raise
        raise failure from error
