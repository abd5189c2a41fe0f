"""Export scenes to what reads several views: COLMAP, nerfstudio and gsplat, PLY.

    OUT/export.json                        the layout and the settings, the same for all of OUT
    OUT/<key of a scene>/frame_000/...     the views of one moment

Each of these folders is written beside its place and renamed, so that a stopped run goes on and a
killed one leaves nothing that is incomplete. Each writer of a format states its own axes and pixel
centres, puts the world's origin at the centre of the first camera, and say in
``stereogenbench.json`` how to come back to the scene's world.
"""

import json
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Final, Literal, Unpack

import numpy as np
from jaxtyping import Float64, Int64
from PIL import Image

from stereogenbench_data.bridges.exports import depth_setting, training_filters
from stereogenbench_data.bridges.multiview import (
    CENTRE_PX,
    VIEW_FIELDS,
    PosedImage,
    origin_at,
    posed_images,
)
from stereogenbench_data.datasets.mapped import Data, SceneViews
from stereogenbench_data.engine import Advance
from stereogenbench_data.errors import SelectionError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.jobs import (
    WORK_DEFAULTS,
    WorkOptions,
    atomic_folder,
    do_items,
    job_folder,
    named_errors,
)
from stereogenbench_data.samples.fields import Request
from stereogenbench_data.samples.load import SampleDecoder
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.selection.filters import SceneFilters, whole_number
from stereogenbench_data.selection.options import require_options
from stereogenbench_data.selection.plan import Address, FramesSpec
from stereogenbench_data.selection.signatures import list_options

ABOUT_JSON: Final = "stereogenbench.json"
"""What a folder shows, and the way back to the scene's world."""

_FAST: Final = 1
"""zlib's level of the PNGs: three times as fast as the default, a tenth larger."""
_OPENGL_FROM_OPENCV: Final = np.diag([1.0, -1.0, -1.0, 1.0])
_Z_UP_FROM_Y_DOWN: Final = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
_POINT: Final = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
)

ViewWriter = Callable[[Path, Sequence[PosedImage], int | None], None]
"""Fills an empty folder with pictures; given how many points are taken from each, None for all."""


def _placed(
    folder: Path, images: Sequence[PosedImage], *, axes: Float64[np.ndarray, "4 4"]
) -> tuple[list[PosedImage], Float64[np.ndarray, "4 4"]]:
    """Write `ABOUT_JSON`; return the pictures in the folder's world, and that from the scene's.

    Args:
        folder: The folder.
        images: The pictures; the origin of the folder's world is at the first one's camera.
        axes: Turns the scene's axes into those of the folder's world.
    """
    export_from_scene = axes @ origin_at(images[0])
    moved = [image.in_world(export_from_scene) for image in images]
    about = {
        "scene": images[0].scene,
        "frame": images[0].frame,
        "scene_from_export": np.linalg.inv(export_from_scene).tolist(),
    }
    _write_json(folder / ABOUT_JSON, about)
    return moved, export_from_scene


def sampled_pixels(
    image: PosedImage, points: int | None
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
    """Return rows and columns of measured pixels, row by row: all, or ``points`` drawn at random.

    The same picture gives the same pixels each time.
    """
    measured = np.flatnonzero(image.depth_m > 0)
    if points is not None and points < len(measured):
        seed = (zlib.crc32(image.scene.encode()), image.camera, image.frame)
        generator = np.random.default_rng(np.random.SeedSequence(seed))
        measured = np.sort(generator.choice(measured, size=points, replace=False))
    rows, columns = np.divmod(measured, image.size[1])
    return rows, columns


def quaternion_wxyz(rotation: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, "4"]:
    """Return the unit quaternion of a rotation, with w >= 0.

    Source: Bar-Itzhack, New method for extracting the quaternion from a rotation matrix, 2000: the
    eigenvector of the largest eigenvalue, exact for every angle.
    """
    r = rotation
    upper = np.array(
        [
            [np.trace(r), r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [0.0, r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [0.0, 0.0, r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
            [0.0, 0.0, 0.0, r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    _, vectors = np.linalg.eigh(upper, UPLO="U")
    return np.asarray(vectors[:, -1] * (-1.0 if vectors[0, -1] < 0 else 1.0))


def write_colmap(folder: Path, images: Sequence[PosedImage], points: int | None) -> None:
    """Write ``sparse/0/cameras.txt``, ``images.txt``, ``points3D.txt``, pictures in ``images/``.

    Pixel centres are at 0.5 and cameras have OpenCV's axes, as here. A point comes from a pixel's
    depth, and is observed at that pixel's centre.

    Source: colmap/colmap, doc/format.rst, doc/faq.rst.
    """
    images, _ = _placed(folder, images, axes=np.eye(4))
    (folder / "images").mkdir()
    point_lines: list[str] = []
    image_lines: list[str] = []
    for number, image in enumerate(images, 1):
        _write_png(folder / "images" / f"{image.name}.png", image)
        rows, columns = sampled_pixels(image, points)
        first_point = len(point_lines) + 1
        positions, colours = image.points_world(rows, columns), image.rgb[rows, columns]
        point_lines += [
            _line(first_point + place, *position, *colour, 0, number, place)
            for place, (position, colour) in enumerate(
                zip(positions.tolist(), colours.tolist(), strict=True)
            )
        ]
        x_px, y_px = ((each + CENTRE_PX).tolist() for each in (columns, rows))
        observed = zip(x_px, y_px, range(first_point, len(point_lines) + 1), strict=True)
        pose = image.cam_from_world
        numbers = (*quaternion_wxyz(pose[:3, :3]).tolist(), *pose[:3, 3].tolist())
        image_lines += [
            _line(number, *numbers, 1, f"{image.name}.png"),
            _line(*chain.from_iterable(observed)),
        ]
    (fx, _, cx), (_, fy, cy), _ = images[0].intrinsics.tolist()
    height, width = images[0].size
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    for name, head, lines in (
        (
            "cameras",
            "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n",
            [_line(1, "PINHOLE", width, height, fx, fy, cx, cy)],
        ),
        (
            "images",
            "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
            "# POINTS2D[] as (X, Y, POINT3D_ID)\n",
            image_lines,
        ),
        (
            "points3D",
            "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n",
            point_lines,
        ),
    ):
        (model / f"{name}.txt").write_text(head + "".join(lines), encoding="utf-8")


def _line(*values: str | float) -> str:
    """Return values as a line; floats in full."""
    return " ".join(map(str, values)) + "\n"


def write_transforms(folder: Path, images: Sequence[PosedImage], points: int | None) -> None:
    """Write ``transforms.json``, ``images/``, ``depth/`` and ``sparse_pc.ply``, for nerfstudio.

    Cameras have OpenGL's axes (x right, y up, z back), the world's z points up, pixel centres are
    at 0.5. Depth is float32 in millimetres in .npy files, 0 where it is not measured: a 16-bit
    picture would end at 65.5 m.

    Source: nerfstudio-project/nerfstudio, docs/quickstart/data_conventions.md,
    nerfstudio/data/dataparsers/nerfstudio_dataparser.py, nerfstudio/data/utils/data_utils.py.
    """
    images, export_from_scene = _placed(folder, images, axes=_Z_UP_FROM_Y_DOWN)
    for name in ("images", "depth"):
        (folder / name).mkdir()
    frames = []
    for image in images:
        picture, depth = f"images/{image.name}.png", f"depth/{image.name}.npy"
        _write_png(folder / picture, image)
        np.save(folder / depth, image.depth_m * np.float32(1000), allow_pickle=False)
        pose = image.world_from_cam @ _OPENGL_FROM_OPENCV
        frames.append(
            {"file_path": picture, "depth_file_path": depth, "transform_matrix": pose.tolist()}
        )
    _write_points(folder / "sparse_pc.ply", images, points)
    (fx, _, cx), (_, fy, cy), _ = images[0].intrinsics.tolist()
    height, width = images[0].size
    transforms = {
        "camera_model": "OPENCV",
        "w": width, "h": height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy,
        "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0,
        "camera_angle_x": 2 * float(np.arctan(width / (2 * fx))),
        "camera_angle_y": 2 * float(np.arctan(height / (2 * fy))),
        "applied_transform": export_from_scene[:3].tolist(),
        "ply_file_path": "sparse_pc.ply",
        "frames": frames,
    }  # fmt: skip
    _write_json(folder / "transforms.json", transforms)


def write_ply(folder: Path, images: Sequence[PosedImage], points: int | None) -> None:
    """Write ``points.ply``: measured pixels as coloured points, in the scene's axes (y down)."""
    images, _ = _placed(folder, images, axes=np.eye(4))
    _write_points(folder / "points.ply", images, points)


def _write_points(path: Path, images: Sequence[PosedImage], points: int | None) -> None:
    """Write the points of pictures as a binary PLY file."""
    clouds = []
    for image in images:
        rows, columns = sampled_pixels(image, points)
        cloud = np.empty(len(rows), dtype=_POINT)
        cloud["x"], cloud["y"], cloud["z"] = image.points_world(rows, columns).T
        cloud["red"], cloud["green"], cloud["blue"] = image.rgb[rows, columns].T
        clouds.append(cloud)
    kinds = {"<f4": "float", "|u1": "uchar"}
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {sum(map(len, clouds))}",
        *(f"property {kinds[_POINT[name].str]} {name}" for name in _POINT.names or ()),
        "end_header",
    ]
    with path.open("wb") as file:
        file.write(("\n".join(lines) + "\n").encode("ascii"))
        file.writelines(cloud.tobytes() for cloud in clouds)


Layout = Literal["colmap", "transforms", "ply"]
WRITERS: Final[Mapping[Layout, ViewWriter]] = {
    "colmap": write_colmap,
    "transforms": write_transforms,
    "ply": write_ply,
}


def _write_png(path: Path, image: PosedImage) -> None:
    Image.fromarray(image.rgb).save(path, compress_level=_FAST)


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1), encoding="utf-8")


USUAL_POINTS: Final[dict[str, int]] = {"colmap": 5_000, "transforms": 5_000, "ply": 100_000}
"""How many points are taken from each picture, unless another number is asked for."""


class ViewExportOptions(WorkOptions, SceneFilters, total=False):
    """Which scenes and views are exported, and how; progress is in pictures.

    Attributes:
        cameras: Numbers of cameras, or "all" (the default).
        frames: As for `StereoPairs`, but no clips.
        size: (height, width) in pixels, or a text WIDTHxHEIGHT; None for the stored size.
        points: How many points are taken from each picture, "all" for every measured pixel; None
            for `USUAL_POINTS`.
        depth: A depth encoding instead of the one that files and release state.
    """

    cameras: Sequence[int] | Literal["all"]
    frames: FramesSpec
    size: tuple[int, int] | str | None
    points: int | Literal["all"] | None
    depth: DepthEncoding | None


@list_options({"cameras": "all", "frames": "first"}, WORK_DEFAULTS)
def export_views(
    data: Data, out: str | Path, *, layout: Layout, **options: Unpack[ViewExportOptions]
) -> list[Path]:
    """Export views of scenes, and return the folders that hold them, in the order of the scenes.

    Evaluation scenes are exported only where ``split`` names them or is "all". What was exported
    before is kept, so that a stopped run goes on.

    Args:
        data: What `StereoPairs` takes.
        out: The folder to write into.
        layout: "colmap": COLMAP's text model, which gsplat reads too; "transforms": nerfstudio's
            ``transforms.json``; "ply": point clouds.
        **options: Which scenes and views, and how (`ViewExportOptions`).

    Raises:
        SelectionError: If nothing matches the selection, or an option is not one.
        FieldError: If the size is not one.
        StorageError: If the folder holds another export, another process exports into it, or
            something cannot be read or written.
        MediaError: If depth cannot have been stored whole, or a video does not decode.
    """
    require_options(export_views, options)
    root = Path(out)
    if layout not in WRITERS:
        known = ", ".join(map(repr, WRITERS))
        raise SelectionError(f"layout must be one of {known}, got {layout!r}.")
    points, depth = _points(layout, options.get("points")), options.get("depth")
    index = data if isinstance(data, SceneIndex) else SceneIndex.open(data)
    filters = training_filters(options)
    frames = options.get("frames", "first")
    views = SceneViews(
        index,
        cameras=options.get("cameras", "all"),
        frames=frames,
        fields=VIEW_FIELDS,
        size=options.get("size"),
        depth=depth,
        **filters,
    )
    if views.plan.windows.is_clip:
        raise SelectionError(
            f"frames={frames!r} are clips: exports take 'all', 'first', ('every', k) or numbers of "
            "frames."
        )
    folders: dict[Path, Address] = {}
    missing: dict[int, dict[Path, Address]] = {}
    for number in range(len(views)):
        address = views.plan.locate(number, epoch=0)
        folder = root / index.scene(address.row).id.key / f"frame_{address.frames[0]:03d}"
        folders[folder] = address
        if not folder.is_dir():
            missing.setdefault(address.row, {})[folder] = address._replace(row=0)
    cameras = (address.source, *address.targets)
    split = filters["split"]
    settings: dict[str, Any] = {
        "layout": layout,
        "split": sorted([split] if isinstance(split, str) else split or ()),
        "cameras": cameras,
        "size": views.request.size,
        "points": points,
        "depth": depth_setting(depth),
        "data": index.digest,
    }
    works = [
        _SceneWork(index.only([row]), found, layout, views.request, points)
        for row, found in missing.items()
    ]
    with job_folder(root, settings):
        do_items(
            _export_scene,
            works,
            name=lambda work: str(work.index.column("key")[0]),
            options=options,
            done=len(cameras) * (len(folders) - sum(len(work.addresses) for work in works)),
            total=len(cameras) * len(folders),
        )
    return [*folders]


def _points(layout: Layout, points: Any) -> int | None:
    """Return how many points are taken from each picture, None for all."""
    if points == "all":
        return None
    points = USUAL_POINTS[layout] if points is None else points
    number = whole_number(points)
    if number is None or number < 1:
        raise SelectionError(f"points must be a number from 1, or 'all', got {points!r}.")
    return number


@dataclass(frozen=True, slots=True)
class _SceneWork:
    """The folders of one scene that are yet to be written.

    Attributes:
        index: An index of the scene alone.
        addresses: The cameras and the frame of each folder.
        layout: The format.
        request: What is read of the views.
        points: How many points are taken from each picture, None for all.
    """

    index: SceneIndex
    addresses: Mapping[Path, Address]
    layout: Layout
    request: Request
    points: int | None


def _export_scene(work: _SceneWork, advance: Advance) -> None:
    """Write the missing folders of one scene, each whole or not at all."""
    with closing(SampleDecoder(work.index, work.request)) as loader:
        for folder, address in work.addresses.items():
            images = posed_images(loader.load(address, clip="frame"))
            with named_errors(folder), atomic_folder(folder) as unfinished:
                WRITERS[work.layout](unfinished, images, work.points)
                advance(len(images))
