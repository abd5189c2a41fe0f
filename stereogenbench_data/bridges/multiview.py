"""Several views of a moment: what multi-view formats are made of, and as DUSt3R and VGGT take them.

Pixel (u, v) is column, row; the centre of the top-left pixel is (0.5, 0.5). Camera and world axes
are x right, y down, z forward (OpenCV), in metres. Formats differ from this in the pixel's centre,
the axes or the direction of the pose; each adapter converts from here.

DUSt3R and VGGT take depth along the optical axis in metres with 0 where it is not measured, and
poses in float32; so the world's origin is put at the first view's camera. Their axes of the world
stay those of the scene. `examples/dust3r_dataset.py` and `examples/vggt_dataset.py` put them behind
the projects' own base classes.

>>> from stereogenbench_data import SceneViews
>>> from stereogenbench_data.bridges.multiview import VIEW_FIELDS
>>> moments = SceneViews(getfixture("small_release"), split="train", fields=VIEW_FIELDS)
>>> sorted(dust3r_views(moments[0])[0])[:4]
['camera_intrinsics', 'camera_pose', 'dataset', 'depthmap']
>>> record = vggt_record(moments[0])
>>> record["frame_num"], record["world_points"][0].shape
(6, (64, 64, 3))
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from jaxtyping import Float32, Float64, Int, UInt8
from PIL import Image

from stereogenbench_data.errors import FieldError
from stereogenbench_data.geometry.pose import invert_rigid
from stereogenbench_data.samples.fields import Sample

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
    arrays: dict[str, Any] = {
        name: sample[name] if name == "scene" else np.asarray(sample[name]) for name in needed
    }
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
    if arrays["frame_index"].ndim or any(picture.ndim != 3 for picture, *_ in views):
        raise FieldError(
            f"the sample's pictures have shape {views[0][0].shape}: give samples of one frame and "
            "of single pairs or the views of one moment, not clips, sweeps or batches."
        )
    return [
        PosedImage(
            scene=arrays["scene"],
            camera=int(camera),
            frame=int(arrays["frame_index"]),
            rgb=np.ascontiguousarray(picture.transpose(1, 2, 0)),
            depth_m=depth[0],
            intrinsics=arrays["intrinsics"],
            world_from_cam=world_from_cam,
        )
        for camera, (picture, depth, world_from_cam) in zip(cameras, views, strict=True)
    ]


DATASET: Final = "StereoGenBench"


def dust3r_views(sample: Sample) -> list[dict[str, Any]]:
    """Return a sample's pictures as view dicts of DUSt3R and MASt3R.

    Args:
        sample: A pair or views of one frame, as `posed_images` takes them.

    Returns:
        For each view ``img`` (PIL, RGB), ``depthmap`` (h, w) float32 in metres with 0 where it is
        not measured, ``camera_pose`` (4, 4) float32 from the camera to a world with its origin at
        the first view's camera, ``camera_intrinsics`` (3, 3) float32 with cx and cy half a pixel
        less than ours, and the texts ``dataset``, ``label`` (scene and frame), ``instance``
        (camera).

    Raises:
        FieldError: If a field is missing, or the sample is not of one frame.

    Source: naver/dust3r, dust3r/datasets/base/base_stereo_view_dataset.py, utils/geometry.py.
    """
    images = posed_images(sample)
    return [
        {
            "img": Image.fromarray(image.rgb),
            "depthmap": np.ascontiguousarray(image.depth_m),
            "camera_pose": image.in_world(origin_at(images[0])).world_from_cam.astype(np.float32),
            "camera_intrinsics": image.intrinsics_for(centre_px=0.0).astype("f4"),
            "dataset": DATASET,
            "label": f"{image.scene}/{image.frame:03d}",
            "instance": f"cam_{image.camera:02d}",
        }
        for image in images
    ]


def vggt_record(
    sample: Sample, *, ids: Sequence[int] | None = None, pixel_centre_px: float = 0.0
) -> dict[str, Any]:
    """Return the views of a moment as ``get_data`` of VGGT's datasets does.

    Args:
        sample: Views of one frame, as `posed_images` takes them.
        ids: Which of the views, in which order; None for all.
        pixel_centre_px: Where the code that takes the record puts the centre of the top-left
            pixel: 0.0, as VGGT's main branch, or 0.5, as VGGT-Omega. It moves cx and cy.

    Returns:
        ``seq_name``, ``ids`` (n,) int64 and ``frame_num`` n; lists of n: ``images`` (h, w, 3)
        uint8, ``depths`` (h, w) float32 in metres, ``extrinsics`` (3, 4) float64 from the world
        to the camera, ``intrinsics`` (3, 3) float64, ``cam_points`` and ``world_points``
        (h, w, 3) float32, ``point_masks`` (h, w) bool, ``original_sizes`` (height, width). The
        world's origin is at the first view's camera. ``tracks`` is None: VGGT makes them.

    Raises:
        FieldError: If a field is missing, or the sample is not of one frame.
        IndexError: If there is no such view.

    Source: facebookresearch/vggt, training/data/base_dataset.py, datasets/vkitti.py.
    """
    images = posed_images(sample)
    chosen = np.arange(len(images)) if ids is None else np.asarray(ids, dtype=np.int64)
    views = [images[number] for number in chosen]
    shift = origin_at(views[0])
    values = [_vggt_view(view.in_world(shift), pixel_centre_px) for view in views]
    return {
        "seq_name": f"{DATASET}_{views[0].scene}/{views[0].frame:03d}",
        "dataset": DATASET,
        "is_synthetic": True,
        "ids": chosen,
        "frame_num": len(chosen),
        **{name: [each[name] for each in values] for name in values[0]},
        "tracks": None,
        "track_masks": None,
    }


def _vggt_view(image: PosedImage, centre_px: float) -> dict[str, Any]:
    """Return the values of one picture by the names of the record's lists."""
    rows, columns = np.indices(image.size)
    return {
        "images": image.rgb,
        "depths": np.ascontiguousarray(image.depth_m),
        "extrinsics": image.cam_from_world[:3],
        "intrinsics": image.intrinsics_for(centre_px=centre_px),
        "cam_points": image.points_cam(rows, columns).astype(np.float32),
        "world_points": image.points_world(rows, columns).astype(np.float32),
        "point_masks": image.depth_m > 0,
        "original_sizes": np.array(image.size),
    }
