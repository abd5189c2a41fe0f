"""Pictures of single cameras with depth, intrinsics and pose: what multi-view formats are made of.

Pixel (u, v) is column, row; the centre of the top-left pixel is (0.5, 0.5). Camera and world axes
are x right, y down, z forward (OpenCV), in metres. Formats differ from this in the pixel's centre,
the axes or the direction of the pose; each adapter converts from here.
"""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from jaxtyping import Float32, Float64, Int, UInt8

from stereogenbench_data.datasets.mapped import Data
from stereogenbench_data.errors import FieldError
from stereogenbench_data.geometry.pose import invert_rigid
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.samples.load import SampleLoader
from stereogenbench_data.samples.request import parse_request
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.selection.plan import Address
from stereogenbench_data.sources.cache import ShardCache

CENTRE_PX: Final = 0.5
"""Coordinate of the centre of the top-left pixel in this package."""

PAIR_FIELDS: Final = (
    "left", "right", "depth", "depth_right", "intrinsics", "world_from_left", "right_from_left",
    "frame_index", "pair", "scene",
)  # fmt: skip
"""Fields of `StereoPairs` that `posed_images` needs."""

VIEW_FIELDS: Final = (
    "image", "depth", "intrinsics", "world_from_cam", "camera", "frame_index", "scene",
)  # fmt: skip
"""Fields of `SceneViews` that `posed_images` needs."""


@dataclass(frozen=True, slots=True, eq=False)
class PosedImage:
    """One picture of one camera.

    Attributes:
        scene: Key of the scene.
        camera: Number of the camera.
        frame: Number of the frame.
        rgb: (h, w, 3) uint8.
        depth_m: (h, w) float32, metres along the optical axis; 0 where not measured.
        intrinsics: (3, 3) float64, pixels of this picture.
        world_from_cam: (4, 4) float64, metres.
    """

    scene: str
    camera: int
    frame: int
    rgb: UInt8[np.ndarray, "h w 3"]
    depth_m: Float32[np.ndarray, "h w"]
    intrinsics: Float64[np.ndarray, "3 3"]
    world_from_cam: Float64[np.ndarray, "4 4"]

    @property
    def name(self) -> str:
        """The camera and the frame, as files are named."""
        return f"cam_{self.camera:02d}_frame_{self.frame:03d}"

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.rgb.shape[0], self.rgb.shape[1]

    @property
    def cam_from_world(self) -> Float64[np.ndarray, "4 4"]:
        """The inverse of the pose."""
        return invert_rigid(self.world_from_cam)

    def intrinsics_for(self, *, centre_px: float) -> Float64[np.ndarray, "3 3"]:
        """Return the intrinsics for code that puts the top-left pixel's centre elsewhere.

        Args:
            centre_px: Coordinate of that centre: 0.5 as here, 0.0 where centres are whole numbers.
        """
        shifted = self.intrinsics.copy()
        shifted[:2, 2] += centre_px - CENTRE_PX
        return shifted

    def in_world(self, new_from_old: Float64[np.ndarray, "4 4"]) -> "PosedImage":
        """Return the picture with its pose in another world."""
        return replace(self, world_from_cam=new_from_old @ self.world_from_cam)

    def points_cam(
        self, rows: Int[np.ndarray, "*n"], columns: Int[np.ndarray, "*n"]
    ) -> Float64[np.ndarray, "*n 3"]:
        """Return the points that pixels show, in this camera's axes, in metres."""
        depth_m = self.depth_m[rows, columns].astype(np.float64)
        (fx, _, cx), (_, fy, cy), _ = self.intrinsics
        x = (columns + CENTRE_PX - cx) * depth_m / fx
        y = (rows + CENTRE_PX - cy) * depth_m / fy
        return np.stack([x, y, depth_m], axis=-1)

    def points_world(
        self, rows: Int[np.ndarray, "*n"], columns: Int[np.ndarray, "*n"]
    ) -> Float64[np.ndarray, "*n 3"]:
        """Return the points that pixels show, in the world's axes, in metres."""
        rotation, centre = self.world_from_cam[:3, :3], self.world_from_cam[:3, 3]
        points: Float64[np.ndarray, "*n 3"] = self.points_cam(rows, columns) @ rotation.T + centre
        return points


def index_of(data: Data) -> SceneIndex:
    """Return the index of a folder, an index file, or an index as it is."""
    return data if isinstance(data, SceneIndex) else SceneIndex.open(data)


def origin_at(image: PosedImage) -> Float64[np.ndarray, "4 4"]:
    """Return the shift of the world that puts its origin at a camera's centre; axes stay.

    Most trainers keep poses in float32, whose steps are 0.06 mm at 1 km from the origin, up to 0.1
    pixel of a near point; scenes may lie kilometres from the origin of their map.
    """
    shift = np.eye(4)
    shift[:3, 3] = -image.world_from_cam[:3, 3]
    return shift


def posed_images(sample: Sample) -> list[PosedImage]:
    """Return the pictures of a sample of `StereoPairs` or `SceneViews`, in the sample's order.

    Args:
        sample: A pair with the fields `PAIR_FIELDS`, or stacked or single views with the fields
            `VIEW_FIELDS`; of one frame, not a clip, a sweep or a batch.

    Raises:
        FieldError: If a field is missing, or the sample is not of one frame.
    """
    kind, needed = ("pair", PAIR_FIELDS) if "left" in sample else ("views", VIEW_FIELDS)
    missing = [name for name in needed if name not in sample]
    if missing:
        raise FieldError(
            f"the sample has no {', '.join(missing)}: load {kind} with fields={needed}."
        )
    arrays = {
        name: sample[name] if name == "scene" else np.asarray(sample[name]) for name in needed
    }
    if arrays["frame_index"].ndim or not isinstance(arrays["scene"], str):
        raise FieldError(
            f"the sample has frames of shape {arrays['frame_index'].shape}: give samples of one "
            "frame each, not clips or batches."
        )
    if kind == "pair":
        world_from_left = arrays["world_from_left"]
        world_from_right = world_from_left @ invert_rigid(arrays["right_from_left"])
        views = [
            (arrays["left"], arrays["depth"], world_from_left),
            (arrays["right"], arrays["depth_right"], world_from_right),
        ]
        cameras = arrays["pair"]
    else:
        cameras = np.atleast_1d(arrays["camera"])
        stacks = [arrays[name] for name in ("image", "depth", "world_from_cam")]
        if not arrays["camera"].ndim:
            stacks = [stack[None] for stack in stacks]
        views = list(zip(*stacks, strict=True))
    if any(picture.ndim != 3 for picture, *_ in views):
        raise FieldError(
            f"the sample's pictures have shape {views[0][0].shape}: give single pairs or the views "
            "of one moment, not sweeps."
        )
    return [_posed(arrays, int(camera), *view) for camera, view in zip(cameras, views, strict=True)]


def _posed(
    arrays: dict[str, Any], camera: int, picture: Any, depth: Any, world_from_cam: Any
) -> PosedImage:
    return PosedImage(
        scene=arrays["scene"],
        camera=camera,
        frame=int(arrays["frame_index"]),
        rgb=np.ascontiguousarray(picture.transpose(1, 2, 0)),
        depth_m=depth[0],
        intrinsics=arrays["intrinsics"],
        world_from_cam=world_from_cam,
    )


class PosedImageReader:
    """Reads single pictures with depth and pose; what it opens stays in this process."""

    def __init__(
        self,
        index: SceneIndex,
        *,
        size: tuple[int, int] | str | None = None,
        depth: DepthEncoding | None = None,
        cache: ShardCache | None = None,
    ) -> None:
        """Prepare to read; nothing is opened yet.

        Args:
            index: Of the data.
            size: (height, width) in pixels, or a text WIDTHxHEIGHT; None for the stored size.
            depth: A depth contract instead of the one that files and release state.
            cache: Where to keep what comes from a URL, or None.

        Raises:
            FieldError: If the size is not one.
        """
        self.request = parse_request(
            "views", "single", fields=VIEW_FIELDS, size=size, depth=depth, transform=None
        )
        self._loader = SampleLoader(index, self.request, cache=cache)

    def read(self, row: int, camera: int, frame: int) -> PosedImage:
        """Return a picture.

        Raises:
            StorageError: If a file is missing or is not the one that was indexed.
            MediaError: If a video does not decode to what the index says.
            SchemaError: If the trajectory does not follow the format.
        """
        address = Address(row, camera, (), (frame,))
        sample = self._loader.load(address, clip="frame")
        return posed_images(sample)[0]

    def close(self) -> None:
        """Close what is open; the reader can be used again."""
        self._loader.close()
