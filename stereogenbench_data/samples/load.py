"""One sample: decoded, transformed, written; read and decoded only as far as the fields need.

The videos of a process are opened when first needed, decoded forwards, and closed in turn. Samples
that share a frame (pairs of one moment, fields of one pair) share its decoding: each stream keeps
its last picture. A stream that fails is closed, and opened again when next needed.
"""

import copy
import os
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, Final, Literal, NamedTuple, TypeVar

import numpy as np
from jaxtyping import UInt8

from stereogenbench_data.errors import (
    MediaError,
    SchemaError,
    ShardError,
    StorageError,
)
from stereogenbench_data.geometry.camera import rig_intrinsics
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.media.container import SeekableFile
from stereogenbench_data.media.depth import (
    depth_frame_index,
    measured,
    open_video,
    read_depth_units,
    resized_nearest,
)
from stereogenbench_data.media.video import read_rgb, require_indexed_picture
from stereogenbench_data.samples.coming import ComingSamples, DescribedAhead, NeededFiles
from stereogenbench_data.samples.derive import SceneFacts, StoredDepth, Views
from stereogenbench_data.samples.fields import (
    Allocate,
    Clip,
    Request,
    Sample,
    SampleWriter,
    new_array,
)
from stereogenbench_data.schema.conventions import depth_of
from stereogenbench_data.schema.records import DepthEncoding, Scene
from stereogenbench_data.schema.release import (
    TRAJECTORY_JSON,
    VIDEO_FILES,
    depth_name,
    rgb_name,
)
from stereogenbench_data.selection.plan import Address, Step
from stereogenbench_data.sources.cache import ShardCache
from stereogenbench_data.sources.fetch_ahead import FetchAhead
from stereogenbench_data.sources.members import MemberSource
from stereogenbench_data.sources.ranged_file import RangedFile

T = TypeVar("T")

OPEN_STREAMS: Final = 24
"""How many videos a process keeps open: two scenes with all their cameras' colour and depth."""

_MOST_SHOWN: Final = 16
"""Of so many times the open videos it is known which frames were shown."""

_Place = tuple[str, int, int]
"""Path and offset of a video, and which run of it is read."""


class StreamStats(NamedTuple):
    """What a pool has open.

    Attributes:
        videos_open: How many videos.
        videos_limit: How many at the most.
    """

    videos_open: int
    videos_limit: int


@dataclass(slots=True)
class Work:
    """What a process, or several together, have done for samples.

    Attributes:
        samples: Samples that were made.
        packets_decoded: Packets given to decoders. More than frames used are decoded where a scene
            is begun inside, and where a video is decoded more than once.
        frames_used: Frames of videos that samples show, each once for every run in which it is
            read.
        reading_s: Seconds in which files were opened and packets read.
        decoding_s: Seconds in which packets became pictures and depth, of the size that is wanted.
        making_s: Seconds in which these became samples.
        waiting_s: Seconds in which workers waited for tasks.
    """

    samples: int = 0
    packets_decoded: int = 0
    frames_used: int = 0
    reading_s: float = 0.0
    decoding_s: float = 0.0
    making_s: float = 0.0
    waiting_s: float = 0.0

    def add(self, other: "Work") -> None:
        """Add what another has done."""
        for name in self.__slots__:
            setattr(self, name, getattr(self, name) + getattr(other, name))

    def in_words(self) -> str:
        """Return where the time went, and which is the limit; empty where nothing was done."""
        parts = {
            "reading": self.reading_s,
            "decoding": self.decoding_s,
            "making samples": self.making_s,
            "waiting for the loop": self.waiting_s,
        }
        total_s = sum(parts.values())
        if total_s <= 0:
            return ""
        shares = ", ".join(f"{name} {part_s / total_s:.0%}" for name, part_s in parts.items())
        return f"{shares}: {max(parts, key=parts.__getitem__)} is the limit"


def _kept(cache: OrderedDict[Any, Any], key: Any, make: Callable[[], T], *, most: int) -> T:
    """Return what a cache holds under a key, made now unless it is there; the oldest makes room."""
    if key not in cache:
        while len(cache) >= most:
            cache.popitem(last=False)
        cache[key] = make()
    found: T = cache[key]
    return found


@dataclass(slots=True)
class _Stream:
    """An open video, and what was read of it last.

    Attributes:
        reader: A `VideoReader` or, of depth that blosc2 packed, `DepthFrames`.
        file: What it reads.
        kept: Pictures and stored depth, by their frames.
    """

    reader: Any
    file: Path | SeekableFile
    kept: OrderedDict[Any, Any] = field(default_factory=OrderedDict)

    def close(self) -> None:
        self.reader.close()
        if not isinstance(self.file, Path):
            self.file.close()


class Streams:
    """A pool of open videos, for one thread at a time of the process that opened them.

    Pictures and depth come back read-only, because the pool may hand out the same ones again.

    Attributes:
        limit: How many videos it keeps open.
        kept_frames: How many frames of each it keeps.
        work: What it has done.
    """

    def __init__(
        self, source: MemberSource, *, limit: int = OPEN_STREAMS, kept_frames: int = 1
    ) -> None:
        """Open videos from a source; none is opened yet."""
        self._source = source
        self.limit = limit
        self.kept_frames = kept_frames
        self.work = Work()
        self._open: OrderedDict[_Place, _Stream] = OrderedDict()
        # The frames of each video that were shown, as bits: kept when the pool closes a video that
        # is read on, so that what is decoded twice is not taken for two frames.
        self._shown: OrderedDict[_Place, int] = OrderedDict()

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
        with self._stream(scene, name, run, index) as stream:
            if out is not None:
                size = (out.shape[-2], out.shape[-1])
                read_rgb(stream.reader, index, size=size, out=out, content="colour")
                return out

            def read() -> np.ndarray:  # its shape in words would be parsed at each call
                picture = read_rgb(stream.reader, index, size=size, content="colour")
                picture.flags.writeable = False
                return picture

            return _kept(stream.kept, (index, size), read, most=self.kept_frames)

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
            encoding: The depth encoding.
            size: (height, width) to take the nearest pixels of, None for the stored size.
            run: As for `rgb`.

        Raises:
            StorageError: If the video cannot be read.
            MediaError: If it is not one that the encoding describes or does not decode.
        """
        with self._stream(scene, name, run, index) as stream:

            def read() -> StoredDepth:
                units = read_depth_units(stream.reader, index, encoding=encoding)
                if size is not None:
                    units = resized_nearest(units, size=size)
                pixel_format = stream.reader.facts.pixel_format
                known = measured(units, encoding=encoding, pixel_format=pixel_format)
                units.flags.writeable = False
                return StoredDepth(units, known)

            return _kept(stream.kept, (index, size, encoding), read, most=self.kept_frames)

    @property
    def stats(self) -> "StreamStats":
        """What is open."""
        return StreamStats(len(self._open), self.limit)

    def release(self, scene: Scene, *, run: int = 0) -> None:
        """Close the videos of a scene's run, of which no more is wanted for now."""
        for member in scene.members.values():
            place = (member.path, member.offset, run)
            self._shown.pop(place, None)
            stream = self._open.pop(place, None)
            if stream is not None:
                stream.close()

    def close(self) -> None:
        """Close every video; the pool can be used again."""
        while self._open:
            self._open.popitem()[1].close()
        self._shown.clear()

    @contextmanager
    def _stream(self, scene: Scene, name: str, run: int, index: int) -> Iterator[_Stream]:
        """Yield an open video, a frame of which is read; it stays open unless that fails."""
        began_s = perf_counter()
        member, name = scene.member(name), scene.held_name(name)
        place = (member.path, member.offset, run)
        self._mark_shown(place, index)
        is_new = place not in self._open
        if is_new:
            while len(self._open) >= self.limit:
                self._open.popitem(last=False)[1].close()
            file = self._source.open(scene, name)
            with _cause_raised(file):
                label = self._source.label(scene, name)
                reader = open_video(file, name=label, frames=scene.frames)
            self._open[place] = _Stream(reader, file)
        self._open.move_to_end(place)
        stream, work = self._open[place], self.work
        effort, opened_s = stream.reader.effort, perf_counter()
        packets, reading_s = effort.packets, effort.reading_s
        try:
            with _cause_raised(stream.file):
                if is_new:
                    require_indexed_picture(stream.reader, scene.rig)
                yield stream
            read_s = effort.reading_s - reading_s
            work.packets_decoded += effort.packets - packets
            work.reading_s += opened_s - began_s + read_s
            work.decoding_s += perf_counter() - opened_s - read_s
        except (MediaError, StorageError):
            self._open.pop(place).close()
            raise

    def _mark_shown(self, place: _Place, index: int) -> None:
        """Count a frame that a sample shows, unless another one did."""
        shown = self._shown.pop(place, 0)
        self.work.frames_used += not shown >> index & 1
        self._shown[place] = shown | 1 << index
        while len(self._shown) > _MOST_SHOWN * max(self.limit, OPEN_STREAMS):
            self._shown.popitem(last=False)


@contextmanager
def _cause_raised(file: Path | SeekableFile) -> Iterator[None]:
    """Raise the failed fetch that made a video fail, if there was one, and close the file."""
    try:
        yield
    except (MediaError, StorageError) as error:
        if not isinstance(file, Path):
            file.close()
        failure = file.failure if isinstance(file, RangedFile) else None
        if failure is None or failure is error:
            raise
        raise failure from error


KEPT_SCENES: Final = 256
"""Of so many scenes at least row and poses are kept (poses of 81 frames take 46 kB)."""


class SampleDecoder:
    """Loads samples: flat dicts of numpy arrays and texts.

    Rows of the index, poses, open videos and their current frames are kept for later samples.
    Threads may share a loader: they decode by turns. Files that it opens stay in this process: a
    fork, like any copy, begins with nothing read and nothing open.
    """

    def __init__(
        self,
        index: SceneIndex,
        request: Request,
        *,
        cache: ShardCache | None = None,
        check: Literal["opened", "metadata"] = "metadata",
        frames: Literal["shared", "used once"] = "shared",
        ahead: FetchAhead | None = None,
    ) -> None:
        """Prepare to decode; nothing is opened yet.

        Args:
            index: The scenes.
            request: What is needed of them.
            cache: Where to keep what comes from a URL, or None.
            check: What is compared with its checksum, as `MemberSource` says.
            frames: Whether several samples may show a frame of a camera, which is kept for them.
            ahead: What fetches the bytes of samples from a URL; None fetches each as it is read.
        """
        self._index = index
        self._request = request
        self._source = MemberSource(
            index.root,
            shards=index.shards,
            revision=index.digest,
            cache=cache,
            check=check,
            retry=index.retry,
            ahead=ahead,
        )
        self._ahead = ahead
        self._frames = frames
        self._needs = request.streams
        self._needs_of_poses = {request.known[name].needs_poses for name in request.fields}
        # A transform may write into what it is given.
        self._is_changed = request.transform is not None
        self._limits, self._kept_scenes = (OPEN_STREAMS, 1), KEPT_SCENES
        self._begin_anew()

    def _begin_anew(self) -> None:
        """Begin with nothing read and nothing open."""
        _loaders.add(self)
        self._lock = threading.RLock()
        limit, kept_frames = self._limits
        self._streams = Streams(self._source, limit=limit, kept_frames=kept_frames)
        self._coming = None
        if self._ahead is not None:
            self._coming = ComingSamples(self._source, self._ahead, self._streams)
        self._described: DescribedAhead | None = None
        self._scenes: OrderedDict[int, SceneFacts] = OrderedDict()

    @property
    def stats(self) -> StreamStats:
        """What this process has open."""
        return self._streams.stats

    def take_work(self) -> Work:
        """Return what this process has done since this was asked before."""
        work, self._streams.work = self._streams.work, Work()
        return work

    def keep_open(self, videos: int, *, frames: int = 1, scenes: int = 0) -> None:
        """Set how many videos, and how many frames of each, every process keeps open.

        Args:
            videos: How many videos.
            frames: How many frames of each.
            scenes: Of how many scenes these are at the most: what is known of as many that came
                before is kept, too.
        """
        self._limits = self._streams.limit, self._streams.kept_frames = videos, frames
        self._kept_scenes = max(KEPT_SCENES, 2 * scenes)

    def is_next(self, address: Address) -> bool:
        """Return whether a sample is the one expected next; True where none is fetched."""
        with self._lock:
            return self._coming is None or self._coming.is_next(address, self._needed_files)

    def expect(self, steps: Iterable[Step]) -> None:
        """Take the samples that will be decoded next, so that their bytes are fetched ahead."""
        with self._lock:
            if self._coming is not None:
                if self._index.unopened is not None:
                    self._described = steps = DescribedAhead(steps, self._open_soon)
                self._coming.expect(steps)

    def begin(self, address: Address) -> None:
        """Fetch what a sample needs, which is decoded next, and what those after it need."""
        with self._lock:
            if self._coming is not None:
                if self._described is not None:
                    self._described.begin(address.row)
                self._coming.begin(address, self._needed_files)

    def end(self, address: Address) -> None:
        """Forget the bytes that a sample needed, which was decoded."""
        with self._lock:
            if self._coming is not None:
                self._coming.end(address)

    def release(self, address: Address) -> None:
        """Close the videos of a run that has been read to its end."""
        with self._lock:
            self._streams.release(self._known_scene(address).scene, run=address.run)

    def stop_fetching(self) -> None:
        """End requests, and expect no sample."""
        with self._lock:
            if self._coming is not None:
                self._coming.close()

    def close(self) -> None:
        """Close the videos that are open in this process, and end its requests."""
        with self._lock:
            self.stop_fetching()
            self._streams.close()
            self._scenes.clear()

    def _open_soon(self, address: Address) -> None:
        """Open a sample's scene in the background."""
        if self._index.unopened is not None:
            row = self._index.indexed_scene(address.row)
            self._index.unopened.expect(row, self._videos(address))

    def _videos(self, address: Address) -> tuple[str, ...]:
        """Return the names of the videos that a sample needs."""
        return (
            *(rgb_name(camera) for camera in self._cameras(address, "rgb")),
            *(depth_name(camera) for camera in self._cameras(address, "depth")),
        )

    def _known_scene(self, address: Address) -> SceneFacts:
        """Return what is known of a sample's scene; that of the last rows asked for is kept."""
        row, unopened = address.row, self._index.unopened
        known = self._scenes.get(row)
        is_far = unopened is not None and unopened.is_remote
        videos = self._videos(address) if is_far else ()
        if known is None or not known.videos.issuperset(videos):
            scene = self._index.scene(row, videos=videos or VIDEO_FILES)
            if self._coming is not None and not is_far:
                scene = replace(scene, seek_tables=self._index.seek_tables(row))
            intrinsics = rig_intrinsics(scene.rig)
            if self._request.size is not None:
                height, width = self._request.size
                intrinsics = intrinsics.resized(width_px=width, height_px=height)
            encodings = {
                camera: scene.depth_encoding(camera, self._request.depth or depth_of(scene))
                for camera in range(len(scene.depth_unit_m))
            }
            url = partial(self._source.url, scene)
            facts = SceneFacts(scene, intrinsics, encodings, url, frozenset(videos))
            if known is not None:
                facts.videos, facts.poses = facts.videos | known.videos, known.poses
            known = self._scenes[row] = facts
            while len(self._scenes) > self._kept_scenes:
                self._scenes.popitem(last=False)
        self._scenes.move_to_end(row)
        return known

    def load(
        self,
        address: Address,
        *,
        clip: Clip,
        seeds: tuple[int, ...] = (0,),
        allocate: Allocate = new_array,
    ) -> Sample:
        """Return one sample.

        Args:
            address: Where it comes from.
            clip: "clip" where the fields have a time axis, else "frame".
            seeds: The seeds of the random numbers that a transform draws.
            allocate: Returns the array that a field is written into; called once for each.

        Raises:
            StorageError: If a file is missing or is not the one that was indexed.
            MediaError: If a video does not decode to what the index says.
            SchemaError: If the trajectory does not follow the format.
        """
        began_s, work = perf_counter(), self._streams.work
        before_s = work.reading_s + work.decoding_s
        request, known = self._request, self._known_scene(address)
        size = (known.intrinsics.height_px, known.intrinsics.width_px)
        writer = SampleWriter(request, address, clip=clip, allocate=allocate)
        decodes_in_place = self._frames == "used once" and not self._is_changed
        # One frame at a time, or all that a transform treats alike.
        step = 1 if request.transform is None else len(address.frames)
        self.begin(address)
        try:
            for start in range(0, len(address.frames), step):
                frames = slice(start, start + step)
                out = writer.pictures(frames, size=size) if decodes_in_place else {}
                with self._lock:
                    views = self._decoded(known, address, frames=frames, out=out)
                if request.transform is not None:
                    views = request.transform(views, np.random.default_rng(seeds))
                writer.write(views, known, frames)
        except (StorageError, MediaError, SchemaError) as error:
            raise type(error)(f"{known.scene.id.key}, frames {address.frames}: {error}") from error
        finally:
            self.end(address)
        work.samples += 1
        work.making_s += perf_counter() - began_s - (work.reading_s + work.decoding_s - before_s)
        return {name: writer.sample[name] for name in request.fields}

    def _decoded(
        self, known: SceneFacts, address: Address, *, frames: slice, out: Mapping[int, Any]
    ) -> Views:
        """Return the views of a sample, of some of its frames; poses become known if needed.

        What was decoded from a cache that was damaged since is decoded again.

        Args:
            known: Its scene.
            address: The sample.
            frames: Which of its frames: one, or with a transform any number.
            out: By camera, the (t, 3, h, w) uint8 arrays to decode into, where each picture is used
                once and nothing changes it.
        """
        try:
            return self._decode(known, address, frames=frames, out=out)
        except (MediaError, SchemaError, ShardError):
            names = (*self._videos(address), TRAJECTORY_JSON)
            if not self._source.drop_damaged(known.scene, map(known.scene.held_name, names)):
                raise
            self.close()
            return self._decode(known, address, frames=frames, out=out)

    def _decode(
        self, known: SceneFacts, address: Address, *, frames: slice, out: Mapping[int, Any]
    ) -> Views:
        scene, numbers, camera_px = known.scene, address.frames[frames], known.intrinsics
        shape = (len(numbers), 3, camera_px.height_px, camera_px.width_px)
        rgb = partial(self._streams.rgb, scene, run=address.run)
        pictures: dict[int, Any] = {}
        for camera in self._cameras(address, "rgb"):
            name, size = rgb_name(camera), self._request.size
            if self._frames == "shared" and not self._is_changed:
                # Without a transform frames come one by one: the kept picture is all of it.
                pictures[camera] = rgb(name=name, index=numbers[0], size=size)[None]
                continue
            found = out[camera] if camera in out else np.empty(shape, dtype=np.uint8)
            for place, frame in zip(found, numbers, strict=True):
                if self._frames == "shared":
                    place[...] = rgb(name=name, index=frame, size=size)
                else:
                    rgb(name=name, index=frame, out=place)
            pictures[camera] = found
        if known.poses is None and self._needs_poses(known):
            known.poses = self._read_poses(scene)
        return Views(
            source=address.source,
            targets=address.targets,
            frames=numbers,
            pictures=pictures,
            depths={
                camera: self._depth(known, address, camera, numbers)
                for camera in self._cameras(address, "depth")
            },
            intrinsics=camera_px,
        )

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy needs."""
        own = ("_lock", "_streams", "_coming", "_described", "_scenes")
        return self.__dict__ | dict.fromkeys(own)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Become a copy, with nothing read, open or fetched."""
        self.__dict__.update(state)
        if self._ahead is not None:
            self._ahead = copy.copy(self._ahead)
            self._source = self._source.fetching_by(self._ahead)
        self._begin_anew()

    def _needed_files(self, address: Address) -> NeededFiles:
        """Return what a sample is read from."""
        known = self._known_scene(address)
        scene = known.scene
        frames = {rgb_name(camera): [*address.frames] for camera in self._cameras(address, "rgb")}
        for camera in self._cameras(address, "depth"):
            encoding = known.encodings[camera]
            lagged = [
                depth_frame_index(frame, encoding=encoding, frames=scene.frames)
                for frame in address.frames
            ]
            frames[depth_name(camera)] = [frame for frame in lagged if frame is not None]
        texts = (TRAJECTORY_JSON,) if self._needs_poses(known) else ()
        return NeededFiles(scene, frames, texts)

    def _needs_poses(self, known: SceneFacts) -> bool:
        needs = self._needs_of_poses
        return "always" in needs or ("unless rectified" in needs and not known.is_rectified)

    def _cameras(self, address: Address, suffix: Literal["rgb", "depth"]) -> list[int]:
        """Return the cameras whose colour or depth is needed."""
        cameras = [address.source] if f"source_{suffix}" in self._needs else []
        if f"target_{suffix}" in self._needs:
            cameras.extend(address.targets)
        return list(dict.fromkeys(cameras))

    def _depth(
        self, known: SceneFacts, address: Address, camera: int, frames: tuple[int, ...]
    ) -> StoredDepth:
        """Return a camera's stored depth over frames; that of single frames is kept."""
        parts = [self._stored(known, camera, frame, run=address.run) for frame in frames]
        if len(parts) == 1 and not self._is_changed:
            return parts[0]
        return StoredDepth(
            units=np.concatenate([part.units for part in parts]),
            measured=np.concatenate([part.measured for part in parts]),
        )

    def _stored(self, known: SceneFacts, camera: int, frame: int, *, run: int) -> StoredDepth:
        """Return a camera's stored depth at a frame of its pictures, (1, h, w)."""
        scene, encoding = known.scene, known.encodings[camera]
        index = depth_frame_index(frame, encoding=encoding, frames=scene.frames)
        if index is None:
            shape = (1, known.intrinsics.height_px, known.intrinsics.width_px)
            return StoredDepth(np.zeros(shape, dtype=np.uint16), np.zeros(shape, dtype=bool))
        kept = self._streams.read_stored_depth(
            scene, depth_name(camera), index, encoding=encoding, size=self._request.size, run=run
        )
        stored = StoredDepth(kept.units[None], kept.measured[None])
        # Where depth of several frames is kept, what is computed from it would be too much.
        return stored if self._streams.kept_frames > 1 else replace(stored, derived=kept.derived)

    def _read_poses(self, scene: Scene) -> CameraPoses:
        from stereogenbench_data.geometry.pose_evidence import poses_of  # slow to import

        text = self._source.read(scene, TRAJECTORY_JSON)
        where = self._source.label(scene, TRAJECTORY_JSON)
        return poses_of(scene, text, where=where)


_loaders: Final[weakref.WeakSet[SampleDecoder]] = weakref.WeakSet()
"""The loaders of this process: a fork begins anew with each, before it has any other thread."""

_inherited: Final[list[object]] = []
"""Videos that came over a fork. They share file offsets with the parent, so they are neither read
nor closed here: the operating system takes them back when the process ends."""


def _begin_in_fork() -> None:
    for loader in tuple(_loaders):
        _inherited.append(loader._streams)
        loader._begin_anew()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_in_fork)
