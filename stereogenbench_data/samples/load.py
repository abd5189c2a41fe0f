"""One sample: from its address to its fields, reading and decoding only what the fields need."""

from collections import OrderedDict
from collections.abc import Iterator
from copy import copy
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Shaped

from stereogenbench_data.errors import MediaError, SchemaError, ShardError, StorageError
from stereogenbench_data.geometry.camera import rig_intrinsics
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.media.depth import (
    depth_frame_index,
    measured,
)
from stereogenbench_data.samples.derive import (
    PAIR_WRITERS,
    RECTIFIED_PX,
    TEXT_BUILDERS,
    PairSample,
    SceneFacts,
)
from stereogenbench_data.samples.places import Places, Room, fresh_room
from stereogenbench_data.samples.request import Clip, Request, Sample, Transform
from stereogenbench_data.samples.streams import OPEN_STREAMS, Streams
from stereogenbench_data.samples.views import StoredDepth, Views
from stereogenbench_data.schema.records import DepthEncoding, Scene
from stereogenbench_data.schema.release import (
    CAMERA_COUNT,
    TRAJECTORY_JSON,
    depth_name,
    rgb_name,
)
from stereogenbench_data.schema.trajectory import parse_trajectory
from stereogenbench_data.selection.plan import Address
from stereogenbench_data.sources.cache import ShardCache
from stereogenbench_data.sources.members import MemberSource

__all__ = ["Clip", "Request", "Sample", "SampleLoader", "Transform", "resized_nearest"]

KEPT_POSES: Final = 32
"""Of how many scenes the poses are kept (46 kB a scene of 81 frames)."""

KEPT_SCENES: Final = 256
"""Of how many scenes the row of the index is kept."""


class SampleLoader:
    """Loads samples as flat dicts of numpy arrays and texts; open files stay in this process."""

    def __init__(
        self,
        index: SceneIndex,
        request: Request,
        *,
        cache: ShardCache | None = None,
        check: Literal["opened", "metadata"] = "metadata",
        frames: Literal["shared", "used once"] = "shared",
    ) -> None:
        """Prepare to load what is requested from the index's data; nothing is opened yet.

        Args:
            index: The scenes.
            request: What to load of them.
            cache: Where to keep what comes from a URL, or None.
            check: What is compared with its checksum, as `MemberSource` says.
            frames: Whether several samples may show a frame of a camera, which is kept for them.
        """
        self._index = index
        self._request = request
        self._source = MemberSource(
            index.root,
            shards=index.shards,
            revision=index.digest,
            cache=cache,
            check=check,
            patience=index.patience,
        )
        self._streams = Streams(self._source)
        self._shares_frames = frames == "shared"
        # A transform may write into what it is given.
        self._is_changed = request.transform is not None
        self._scenes: OrderedDict[int, Scene] = OrderedDict()
        self._depths: OrderedDict[tuple[int, int], tuple[int, StoredDepth]] = OrderedDict()
        self._videos = OPEN_STREAMS
        self._poses: OrderedDict[str, CameraPoses] = OrderedDict()

    def load(
        self,
        address: Address,
        *,
        clip: Clip,
        generator: np.random.Generator,
        room: Room = fresh_room,
    ) -> Sample:
        """Return one sample.

        Args:
            address: Where it comes from.
            clip: "clip" where the fields have a time axis, else "frame".
            generator: The random numbers of the transform.
            room: What gives the array that a field is written into, once.

        Raises:
            StorageError: If a file is missing or is not the one that was indexed.
            MediaError: If a video does not decode to what the index says.
            SchemaError: If the trajectory does not follow the format.
        """
        scene = self._scene(address.row)
        places = self._places(address, clip=clip, room=room)
        try:
            for step in self._steps(address, places):
                views, facts = self._decode_or_again(scene, step, places)
                if self._request.transform is not None:
                    views = self._request.transform(views, generator)
                self._write_fields(views, facts, places)
        except (StorageError, MediaError, SchemaError) as error:
            raise type(error)(f"{scene.id.key}, frames {address.frames}: {error}") from error
        if "__key__" in self._request.fields:
            places.sample["__key__"] = _sample_key(views, facts, frames=address.frames)
        return {name: places.sample[name] for name in self._request.fields}

    def _places(self, address: Address, *, clip: Clip, room: Room) -> Places:
        places = Places(self._request.known, room, frames=len(address.frames))
        places.is_clip = clip == "clip"
        if self._request.layout == "stacked":
            places.targets = len(address.targets) + (self._request.kind == "views")
        return places

    def _steps(self, address: Address, places: Places) -> Iterator[Address]:
        """Yield what is decoded at a time: a frame, or all that a transform treats alike."""
        if self._is_changed:
            yield address
            return
        for number, frame in enumerate(address.frames):
            places.at = slice(number, number + 1)
            yield address._replace(frames=(frame,))

    def apart(self) -> "SampleLoader":
        """Return a loader of the same samples with open videos of its own."""
        apart = copy(self)
        apart._streams = Streams(self._source)
        apart._scenes, apart._depths, apart._poses = OrderedDict(), OrderedDict(), OrderedDict()
        return apart

    def keep_open(self, videos: int) -> None:
        """Keep up to so many videos open, in this process and in copies of this loader."""
        self._streams.keep(videos)
        self._videos = videos

    def release(self, row: int) -> None:
        """Close the videos of a scene that has been read to its end."""
        self._streams.release(self._scene(row))
        self._scenes.pop(row, None)
        for camera in range(CAMERA_COUNT):
            self._depths.pop((row, camera), None)

    def close(self) -> None:
        """Close the videos that are open in this process."""
        self._streams.close()
        self._scenes.clear()
        self._depths.clear()

    def _scene(self, row: int) -> Scene:
        """Return a scene of the index; those of the last rows asked for are kept."""
        scene = self._scenes.get(row)
        if scene is None:
            scene = self._scenes[row] = self._index.scene(row)
            if len(self._scenes) > KEPT_SCENES:
                self._scenes.popitem(last=False)
        return scene

    def _decode_or_again(
        self, scene: Scene, address: Address, places: Places
    ) -> tuple[Views, SceneFacts]:
        """Decode; again, where what was decoded came from a cache that was damaged since."""
        try:
            return self._decode(scene, address, places)
        except (MediaError, SchemaError, ShardError):
            names = [
                *(rgb_name(camera) for camera in self._cameras(address, suffix="rgb")),
                *(depth_name(camera) for camera in self._cameras(address, suffix="depth")),
                TRAJECTORY_JSON,
            ]
            if not self._source.drop_damaged(scene, map(scene.held_name, names)):
                raise
            self.close()
            return self._decode(scene, address, places)

    def _decode(self, scene: Scene, address: Address, places: Places) -> tuple[Views, SceneFacts]:
        encodings = {
            camera: self._encoding(scene, camera) for camera in {address.source, *address.targets}
        }
        intrinsics = rig_intrinsics(scene.rig)
        if self._request.size is not None:
            height, width = self._request.size
            intrinsics = intrinsics.resized(width_px=width, height_px=height)
        size = (intrinsics.height_px, intrinsics.width_px)
        straight = self._straight_places(address, places, size=size)
        cameras = self._cameras(address, suffix="rgb")
        pictures: dict[int, Any] = {}
        for camera in cameras:
            if camera in straight:
                pictures[camera] = straight[camera]
            elif self._is_changed:
                pictures[camera] = np.empty((len(address.frames), 3, *size), dtype=np.uint8)
        for number, frame in enumerate(address.frames):
            for camera in cameras:
                name = rgb_name(camera)
                if not self._shares_frames and camera in pictures:
                    self._streams.write_rgb(scene, name, frame, out=pictures[camera][number])
                    continue
                kept = self._streams.rgb(scene, name, frame, size=self._request.size)
                if camera in pictures:
                    pictures[camera][number] = kept
                else:
                    pictures[camera] = kept[None]
        views = Views(
            source=address.source,
            targets=address.targets,
            frames=address.frames,
            pictures=pictures,
            depths={
                camera: self._depth(scene, address, camera, encoding=encodings[camera])
                for camera in self._cameras(address, suffix="depth")
            },
            intrinsics=intrinsics,
        )
        url = self._source.url(scene, rgb_name(address.source))
        return views, SceneFacts(scene, encodings, self._camera_poses(scene), url)

    def _cameras(self, address: Address, *, suffix: Literal["rgb", "depth"]) -> list[int]:
        """Return the cameras whose colour or depth the request needs."""
        cameras = []
        if f"source_{suffix}" in self._request.streams:
            cameras.append(address.source)
        if f"target_{suffix}" in self._request.streams:
            cameras.extend(address.targets)
        return list(dict.fromkeys(cameras))

    def _encoding(self, scene: Scene, camera: int) -> DepthEncoding:
        contract = self._request.depth or DepthEncoding()
        source = scene.depth_unit_source[camera]
        if source == "unreadable":
            return contract
        return contract.with_file_unit(scene.depth_unit_m[camera], source=source)

    def _straight_places(
        self, address: Address, places: Places, *, size: tuple[int, int]
    ) -> dict[int, Any]:
        """Return where pictures that go into one field of one sample alone are decoded to."""
        if self._shares_frames or self._is_changed:
            return {}
        shape = (len(address.frames), 3, *size)
        found = {}
        for name, cameras in (
            ("left", (address.source,)),
            ("right", address.targets),
            ("image", (address.source, *address.targets)),
        ):
            if name in self._request.fields and name in self._request.known:
                for place, camera in enumerate(cameras):
                    found[camera] = places.of(name, place, shape=shape, dtype="u1")
        return found

    def _depth(
        self, scene: Scene, address: Address, camera: int, *, encoding: DepthEncoding
    ) -> StoredDepth:
        """Return a camera's stored depth over the frames; that of a single frame is kept."""
        if len(address.frames) > 1:
            parts = [
                self._stored(scene, camera, frame, encoding=encoding) for frame in address.frames
            ]
            return StoredDepth(
                units=np.concatenate([part.units for part in parts]),
                measured=np.concatenate([part.measured for part in parts]),
            )
        key, frame = (address.row, camera), address.frames[0]
        # Taken out and put back: another thread may ask for another frame of this camera.
        kept = self._depths.pop(key, None)
        if kept is None or kept[0] != frame:
            kept = (frame, self._stored(scene, camera, frame, encoding=encoding))
        self._depths[key] = kept
        if len(self._depths) > self._videos:
            self._depths.popitem(last=False)
        stored = kept[1]
        if self._is_changed:
            return StoredDepth(stored.units.copy(), stored.measured.copy())
        return stored

    def _stored(
        self, scene: Scene, camera: int, frame: int, *, encoding: DepthEncoding
    ) -> StoredDepth:
        """Return a camera's stored depth of one frame, (1, h, w)."""
        name = depth_name(camera)
        stored_frame = depth_frame_index(frame, encoding=encoding, frames=scene.frames)
        if stored_frame is None:
            size = self._request.size or (scene.rig.image_height_px, scene.rig.image_width_px)
            return StoredDepth(
                np.zeros((1, *size), dtype=np.uint16), np.zeros((1, *size), dtype=bool)
            )
        units = self._streams.depth_units(scene, name, stored_frame, encoding=encoding)
        if self._request.size is not None:
            units = resized_nearest(units, size=self._request.size)
        pixel_format = self._streams.pixel_format(scene, name)
        known = measured(units, encoding=encoding, pixel_format=pixel_format)
        return StoredDepth(units[None], known[None])

    def _camera_poses(self, scene: Scene) -> CameraPoses | None:
        needs = {self._request.known[name].needs_poses for name in self._request.fields}
        rectified = scene.rig_residual_px <= RECTIFIED_PX
        if "always" not in needs and (rectified or "unless rectified" not in needs):
            return None
        poses = self._poses.get(scene.id.key)
        if poses is None:
            text = self._source.read(scene, TRAJECTORY_JSON)
            where = self._source.label(scene, TRAJECTORY_JSON)
            poses = CameraPoses.from_trajectory(parse_trajectory(text, where=where))
            self._poses[scene.id.key] = poses
            if len(self._poses) > KEPT_POSES:
                self._poses.popitem(last=False)
        return poses

    def _write_fields(self, views: Views, facts: SceneFacts, places: Places) -> None:
        targets = views.targets
        if self._request.kind == "views":
            targets = (views.source, *targets)
        pairs = [PairSample(views, facts, target=target) for target in targets]
        for name in self._request.fields:
            if name in TEXT_BUILDERS:
                places.sample[name] = TEXT_BUILDERS[name](facts)
            elif name != "__key__":
                chosen = pairs if self._request.known[name].per_target else pairs[:1]
                for number, pair in enumerate(chosen):
                    self._write(name, pair, places, number=number)

    def _write(self, name: str, pair: PairSample, places: Places, *, number: int) -> None:
        """Write what a field has of one target into its place."""
        if self._request.kind == "pairs" and name in PAIR_WRITERS:
            frames, height, width = pair.shape
            place = places.of(name, number, shape=(frames, 1, height, width), dtype="f4")
            PAIR_WRITERS[name](pair, place[:, 0])
            return
        value = self._request.builders[name](pair)
        place = places.of(name, number, shape=value.shape, dtype=value.dtype)
        if not np.may_share_memory(value, place):
            np.copyto(place, value)


def resized_nearest(
    maps: Shaped[np.ndarray, "*batch h w"], *, size: tuple[int, int]
) -> Shaped[np.ndarray, "*batch h2 w2"]:
    """Return maps at another size by the nearest pixel centre, never averaged across an edge.

    Pixel i of n takes the source pixel that holds the centre (i + 0.5) * source / n: what torch
    calls nearest-exact.
    """
    rows, columns = (
        np.minimum((np.arange(wanted) + 0.5) * found / wanted, found - 1).astype(np.intp)
        for wanted, found in zip(size, maps.shape[-2:], strict=True)
    )
    return np.ascontiguousarray(maps[..., rows[:, None], columns])


def _sample_key(views: Views, facts: SceneFacts, *, frames: tuple[int, ...]) -> str:
    """Return scene, cameras and frames: scene/00-01/017, or scene/00-01/016-031 for a clip."""
    cameras = f"{views.source:02d}"
    if views.targets:
        cameras += "-" + "+".join(f"{target:02d}" for target in views.targets)
    first, last = frames[0], frames[-1]
    shown = f"{first:03d}" if first == last else f"{first:03d}-{last:03d}"
    return f"{facts.scene.id.key}/{cameras}/{shown}"
