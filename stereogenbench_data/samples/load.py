"""One sample: from its address to its fields, reading and decoding only what the fields need."""

from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, Literal, NoReturn, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Shaped

from stereogenbench_data.errors import MediaError, SchemaError, ShardError, StorageError
from stereogenbench_data.geometry.camera import rig_intrinsics
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.media.depth import (
    depth_frame_index,
    measured,
    require_depth_stream,
)
from stereogenbench_data.samples.derive import (
    PAIR_BUILDERS,
    RECTIFIED_PX,
    TEXT_BUILDERS,
    VIEW_BUILDERS,
    Builder,
    PairSample,
    SceneFacts,
)
from stereogenbench_data.samples.fields import (
    PAIR_FIELDS,
    VIEW_FIELDS,
    Field,
    Stream,
    streams_of,
)
from stereogenbench_data.samples.streams import Streams
from stereogenbench_data.samples.views import StoredDepth, Views
from stereogenbench_data.schema.parse import parse_trajectory
from stereogenbench_data.schema.records import DepthEncoding, Scene
from stereogenbench_data.schema.release import TRAJECTORY_JSON, depth_name, rgb_name
from stereogenbench_data.selection.plan import Address, Plan
from stereogenbench_data.storage.cache import ShardCache
from stereogenbench_data.storage.index import SceneIndex
from stereogenbench_data.storage.source import MemberSource

Sample = dict[str, Any]
Clip = Literal["frame", "clip"]


@runtime_checkable
class Transform(Protocol):
    """What changes pictures and cameras together.

    ``swaps_views`` says whether source and target may change places, so that what one view needs
    must be read of both.
    """

    @property
    def swaps_views(self) -> bool:
        """Whether source and target may change places."""
        ...

    def __call__(self, views: Views, generator: np.random.Generator) -> Views:
        """Return the changed views."""
        ...


@dataclass(frozen=True, slots=True)
class Request:
    """What a dataset asks of every sample.

    Attributes:
        kind: "pairs" (fields of `PAIR_FIELDS`) or "views" (of `VIEW_FIELDS`).
        fields: The fields, in order.
        layout: "single": what each target has stands for itself; "stacked": with an axis of
            targets in front.
        size: (height, width) to which the decoder scales, None for the stored size.
        depth: A depth contract that overrides what the index says, or None.
        transform: What changes the views before fields are derived, or None.
    """

    kind: Literal["pairs", "views"]
    fields: tuple[str, ...]
    layout: Literal["single", "stacked"]
    size: tuple[int, int] | None = None
    depth: DepthEncoding | None = None
    transform: Transform | None = None

    @property
    def known(self) -> dict[str, Field]:
        """The table of fields of this kind of sample."""
        return PAIR_FIELDS if self.kind == "pairs" else VIEW_FIELDS

    @property
    def builders(self) -> dict[str, Builder]:
        """What builds each field that is not text."""
        return PAIR_BUILDERS if self.kind == "pairs" else VIEW_BUILDERS

    @property
    def streams(self) -> frozenset[Stream]:
        """The videos that the fields are made from, whichever way the transform turns."""
        streams = streams_of(self.fields, known=self.known)
        if self.transform is not None and self.transform.swaps_views:
            streams |= {SWAPPED[stream] for stream in streams}
        return streams


SWAPPED: Final[dict[Stream, Stream]] = {
    "source_rgb": "target_rgb",
    "target_rgb": "source_rgb",
    "source_depth": "target_depth",
    "target_depth": "source_depth",
}
KEPT_POSES: Final = 32
"""Of how many scenes the poses are kept (46 kB a scene of 81 frames)."""


def require_whole_depth(index: SceneIndex, plan: Plan, request: Request) -> None:
    """Refuse, before anything is read, depth that cannot have been stored whole.

    Raises:
        MediaError: Naming the first file that a sample needs whose codec or pixel format loses
            depth, unless the request's depth contract accepts it.
    """
    if not request.streams & {"source_depth", "target_depth"}:
        return
    encoding = request.depth or DepthEncoding()
    units_told = index.column("depth_unit_source") != "unreadable"
    stored = np.stack([index.column("depth_codec"), index.column("depth_pixel_format")], axis=-1)
    whole = np.zeros(units_told.shape, dtype=bool)
    for codec, pixel_format in set(map(tuple, stored.reshape(-1, 2))):
        try:
            require_depth_stream(
                codec=codec, pixel_format=pixel_format, encoding=encoding, name="depth"
            )
        except MediaError:
            continue
        whole |= (stored == (codec, pixel_format)).all(axis=-1)
    usable = whole & (units_told | (encoding.unit_m is not None))
    if usable.all():
        return
    for row, camera in _depth_reads(plan, request):
        if not usable[row, camera]:
            _refuse_depth(index.scene(row), camera, encoding=encoding)


def _refuse_depth(scene: Scene, camera: int, *, encoding: DepthEncoding) -> NoReturn:
    name = scene.members[depth_name(camera)].path
    if not name.endswith(depth_name(camera)):
        name = f"{name}: {scene.id.key}.{depth_name(camera)}"
    require_depth_stream(
        codec=scene.depth_codec[camera],
        pixel_format=scene.depth_pixel_format[camera],
        encoding=encoding,
        name=name,
    )
    raise MediaError(
        f"{name}: its tags do not tell one positive number of metres in a stored unit of depth. "
        "Correct the tags, or pass DepthEncoding(unit_m=...)."
    )


def _depth_reads(plan: Plan, request: Request) -> Iterator[tuple[int, int]]:
    """Yield the (row, camera) of every depth video that samples need."""
    pairs = plan.pairs
    if "source_depth" in request.streams:
        yield from zip(pairs.row.tolist(), pairs.source.tolist(), strict=True)
    if "target_depth" in request.streams:
        for row, targets in zip(pairs.row.tolist(), pairs.targets.tolist(), strict=True):
            yield from ((row, target) for target in targets if target >= 0)


class SampleLoader:
    """Loads samples as flat dicts of numpy arrays and texts; open files stay in this process."""

    def __init__(
        self, index: SceneIndex, request: Request, *, cache: ShardCache | None = None
    ) -> None:
        """Prepare to load what is requested from the index's data; nothing is opened yet."""
        self._index = index
        self._request = request
        self._source = MemberSource(
            index.root, shards=index.shards, revision=index.digest, cache=cache
        )
        self._streams = Streams(self._source)
        self._poses: OrderedDict[str, CameraPoses] = OrderedDict()

    def load(self, address: Address, *, clip: Clip, generator: np.random.Generator) -> Sample:
        """Return one sample.

        Args:
            address: Where it comes from.
            clip: "clip" where the fields have a time axis, else "frame".
            generator: The random numbers of the transform.

        Raises:
            StorageError: If a file is missing or is not the one that was indexed.
            MediaError: If a video does not decode to what the index says.
            SchemaError: If the trajectory does not follow the format.
        """
        scene = self._index.scene(address.row)
        try:
            views, facts = self._decode_or_again(scene, address)
        except (StorageError, MediaError, SchemaError) as error:
            raise type(error)(f"{scene.id.key}, frames {address.frames}: {error}") from error
        if self._request.transform is not None:
            views = self._request.transform(views, generator)
        return self._fields(views, facts, clip=clip)

    def keep_open(self, videos: int) -> None:
        """Keep up to so many videos open, in this process and in copies of this loader."""
        self._streams.keep(videos)

    def release(self, row: int) -> None:
        """Close the videos of a scene that has been read to its end."""
        self._streams.release(self._index.scene(row))

    def close(self) -> None:
        """Close the videos that are open in this process."""
        self._streams.close()

    def _decode_or_again(self, scene: Scene, address: Address) -> tuple[Views, SceneFacts]:
        """Decode; again, where what was decoded came from a cache that was damaged since."""
        try:
            return self._decode(scene, address)
        except (MediaError, SchemaError, ShardError):
            names = [
                *(rgb_name(camera) for camera in self._cameras(address, suffix="rgb")),
                *(depth_name(camera) for camera in self._cameras(address, suffix="depth")),
                TRAJECTORY_JSON,
            ]
            if not self._source.drop_damaged(scene, names):
                raise
            self._streams.close()
            return self._decode(scene, address)

    def _decode(self, scene: Scene, address: Address) -> tuple[Views, SceneFacts]:
        encodings = {
            camera: self._encoding(scene, camera) for camera in {address.source, *address.targets}
        }
        intrinsics = rig_intrinsics(scene.rig)
        if self._request.size is not None:
            height, width = self._request.size
            intrinsics = intrinsics.resized(width_px=width, height_px=height)
        pictures: dict[int, list[Any]] = {}
        depths: dict[int, list[StoredDepth]] = {}
        for frame in address.frames:
            for camera in self._cameras(address, suffix="rgb"):
                pictures.setdefault(camera, []).append(self._picture(scene, camera, frame))
            for camera in self._cameras(address, suffix="depth"):
                stored = self._stored(scene, camera, frame, encoding=encodings[camera])
                depths.setdefault(camera, []).append(stored)
        views = Views(
            source=address.source,
            targets=address.targets,
            frames=address.frames,
            pictures={camera: np.stack(found) for camera, found in pictures.items()},
            depths={
                camera: StoredDepth(
                    units=np.stack([stored.units for stored in found]),
                    measured=np.stack([stored.measured for stored in found]),
                )
                for camera, found in depths.items()
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

    def _picture(self, scene: Scene, camera: int, frame: int) -> Any:
        return self._streams.rgb(scene, rgb_name(camera), frame, size=self._request.size)

    def _stored(
        self, scene: Scene, camera: int, frame: int, *, encoding: DepthEncoding
    ) -> StoredDepth:
        name = depth_name(camera)
        stored_frame = depth_frame_index(frame, encoding=encoding, frames=scene.frames)
        if stored_frame is None:
            size = self._request.size or (scene.rig.image_height_px, scene.rig.image_width_px)
            return StoredDepth(np.zeros(size, dtype=np.uint16), np.zeros(size, dtype=bool))
        units = self._streams.depth_units(scene, name, stored_frame, encoding=encoding)
        if self._request.size is not None:
            units = resized_nearest(units, size=self._request.size)
        pixel_format = self._streams.pixel_format(scene, name)
        return StoredDepth(units, measured(units, encoding=encoding, pixel_format=pixel_format))

    def _camera_poses(self, scene: Scene) -> CameraPoses | None:
        needs = {self._request.known[name].needs_poses for name in self._request.fields}
        rectified = scene.rig_residual_px <= RECTIFIED_PX
        if "always" not in needs and (rectified or "unless rectified" not in needs):
            return None
        if scene.id.key not in self._poses:
            text = self._source.read(scene, TRAJECTORY_JSON)
            where = self._source.label(scene, TRAJECTORY_JSON)
            trajectory = parse_trajectory(text, where=where)
            self._poses[scene.id.key] = CameraPoses.from_trajectory(trajectory)
            while len(self._poses) > KEPT_POSES:
                self._poses.popitem(last=False)
        return self._poses[scene.id.key]

    def _fields(self, views: Views, facts: SceneFacts, *, clip: Clip) -> Sample:
        targets = views.targets
        if self._request.kind == "views":
            targets = (views.source, *targets)
        pairs = [PairSample(views, facts, target=target) for target in targets]
        sample: Sample = {}
        for name in self._request.fields:
            field = self._request.known[name]
            if name == "__key__":
                sample[name] = _sample_key(views, facts)
            elif name in TEXT_BUILDERS:
                sample[name] = TEXT_BUILDERS[name](facts)
            else:
                build = self._request.builders[name]
                cut = field.per_frame and clip == "frame"
                found = [
                    build(pair)[0] if cut else build(pair)
                    for pair in (pairs if field.per_target else pairs[:1])
                ]
                stacked = field.per_target and self._request.layout == "stacked"
                sample[name] = np.stack(found) if stacked else found[0]
        return sample


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


def _sample_key(views: Views, facts: SceneFacts) -> str:
    """Return scene, cameras and frames: scene/00-01/017, or scene/00-01/016-031 for a clip."""
    cameras = f"{views.source:02d}"
    if views.targets:
        cameras += "-" + "+".join(f"{target:02d}" for target in views.targets)
    first, last = views.frames[0], views.frames[-1]
    frames = f"{first:03d}" if first == last else f"{first:03d}-{last:03d}"
    return f"{facts.scene.id.key}/{cameras}/{frames}"
