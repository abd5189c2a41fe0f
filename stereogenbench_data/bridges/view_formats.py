"""Writers of multi-view formats: COLMAP's text model, transforms.json, PLY, MoGe's folders.

A writer fills one folder. It is given the pictures of one moment at a time and keeps of them only
what its last files need. Each states its format's own axes and pixel centres; all but MoGe's put
the world's origin at the centre of the first camera, and say in ``stereogenbench.json`` how to come
back to the scene's world.
"""

import json
import zlib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Float64, Int64
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from stereogenbench_data.bridges.posed_images import CENTRE_PX, PosedImage, origin_at
from stereogenbench_data.geometry.projection import Projection, visible_in_target
from stereogenbench_data.schema.records import DepthEncoding

ABOUT_JSON: Final = "stereogenbench.json"
"""What a folder shows: scene, pictures, cameras, and the way back to the scene's world."""
INDEX_TXT: Final = ".index.txt"
"""MoGe's list of its folders."""

_FAST: Final = 1
"""zlib's level of the PNGs: three times as fast as the default, a tenth larger."""
_JPEG_QUALITY: Final = 95
_OPENGL_FROM_OPENCV: Final = np.diag([1.0, -1.0, -1.0, 1.0])
_Z_UP_FROM_Y_DOWN: Final = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
_POINT: Final = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
)
_COUNT_DIGITS: Final = 12


class ViewWriter(ABC):
    """Fills a folder with pictures and what a format says of them.

    Attributes:
        axes: Turns the scene's axes into those of the format's world.
    """

    axes: Float64[np.ndarray, "4 4"] = np.eye(4)

    def __init__(
        self,
        folder: Path,
        *,
        points: int | None = None,
        encodings: Mapping[int, DepthEncoding] | None = None,
    ) -> None:
        """Begin to fill a folder.

        Args:
            folder: An empty folder.
            points: How many points are taken from each picture, None for every measured pixel.
            encodings: The depth contract of each camera.
        """
        self._folder, self._points, self._encodings = folder, points, encodings or {}
        self._export_from_scene: Any = None
        self._pictures: list[dict[str, Any]] = []
        self._scene = ""
        self.begin()

    def begin(self) -> None:  # noqa: B027 - some formats begin with nothing
        """Make what is filled picture by picture."""

    @abstractmethod
    def add(self, images: Sequence[PosedImage]) -> None:
        """Take the pictures of one moment."""

    def finish(self) -> None:
        """Write what needs all pictures."""
        about = {
            "scene": self._scene,
            "units": "metres, pixels; the centre of the top-left pixel is (0.5, 0.5)",
            "camera_axes": "x right, y down, z forward",
            "scene_from_export": np.linalg.inv(self._export_from_scene).tolist(),
            "pictures": self._pictures,
        }
        _write_json(self._folder / ABOUT_JSON, about)

    def _in_world(self, images: Sequence[PosedImage]) -> list[PosedImage]:
        """Return pictures in the folder's world, whose origin is at the first camera."""
        if self._export_from_scene is None:
            self._export_from_scene = self.axes @ origin_at(images[0])
            self._scene = images[0].scene
        moved = [image.in_world(self._export_from_scene) for image in images]
        self._pictures += [
            {
                "name": image.name,
                "camera": image.camera,
                "frame": image.frame,
                "width": image.size[1],
                "height": image.size[0],
                "intrinsics": image.intrinsics.tolist(),
                "export_from_cam": image.world_from_cam.tolist(),
            }
            for image in moved
        ]
        return moved


def sampled_pixels(
    image: PosedImage, points: int | None
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]:
    """Return rows and columns of measured pixels, row by row: all, or so many drawn at random.

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


class ColmapWriter(ViewWriter):
    """``sparse/0/cameras.txt``, ``images.txt``, ``points3D.txt``, and the pictures in ``images/``.

    Pixel centres are at 0.5 and cameras have OpenCV's axes, as here. A point comes from a pixel's
    depth. The first observation of its track is that pixel's centre; the others are where it
    projects in the other pictures of its moment whose own depth agrees.

    Source: colmap/colmap, doc/format.rst, doc/faq.rst.
    """

    def begin(self) -> None:
        """Make the folder of pictures."""
        self._camera = ""
        self._image_lines: list[str] = []
        self._point_lines: list[str] = []
        (self._folder / "images").mkdir()

    def add(self, images: Sequence[PosedImage]) -> None:
        """Take the pictures of one moment."""
        images = self._in_world(images)
        (fx, _, cx), (_, fy, cy), _ = images[0].intrinsics.tolist()
        height, width = images[0].size
        self._camera = f"1 PINHOLE {width} {height} {fx!r} {fy!r} {cx!r} {cy!r}\n"
        first_id = len(self._image_lines) + 1
        observed: list[list[str]] = [[] for _ in images]
        for place, image in enumerate(images):
            rows, columns = sampled_pixels(image, self._points)
            world = image.points_world(rows, columns)
            here = (columns + CENTRE_PX, rows + CENTRE_PX, np.ones(len(rows), dtype=bool))
            others = [number for number in range(len(images)) if number != place]
            landed = [(place, *here)]
            landed += [(each, *self._landed(image, images[each], world)) for each in others]
            for point, (position, colour) in enumerate(
                zip(world.tolist(), image.rgb[rows, columns].tolist(), strict=True)
            ):
                point_id = len(self._point_lines) + 1
                track = []
                for number, u_px, v_px, seen in landed:
                    if seen[point]:
                        track.append(f"{first_id + number} {len(observed[number])}")
                        at = f"{float(u_px[point])!r} {float(v_px[point])!r}"
                        observed[number].append(f"{at} {point_id}")
                line = " ".join([str(point_id), *map(repr, position), *map(str, colour), "0"])
                self._point_lines.append(f"{line} {' '.join(track)}\n")
        for number, image in enumerate(images):
            _write_png(self._folder / "images" / f"{image.name}.png", image)
            pose = image.cam_from_world
            numbers = [*quaternion_wxyz(pose[:3, :3]).tolist(), *pose[:3, 3].tolist()]
            self._image_lines.append(
                f"{first_id + number} {' '.join(map(repr, numbers))} 1 {image.name}.png\n"
                f"{' '.join(observed[number])}\n"
            )

    def _landed(self, image: PosedImage, other: PosedImage, world: Any) -> tuple[Any, Any, Any]:
        """Return where points of a picture lie in another one, and which that one sees."""
        cam = world @ other.cam_from_world[:3, :3].T + other.cam_from_world[:3, 3]
        (fx, _, cx), (_, fy, cy), _ = other.intrinsics
        depth_m = np.where(cam[:, 2] > 0, cam[:, 2], np.nan)
        u_px, v_px = fx * cam[:, 0] / depth_m + cx, fy * cam[:, 1] / depth_m + cy
        steps = [_depth_step_m(self._encodings[each.camera], depth_m) for each in (image, other)]
        seen = visible_in_target(
            Projection(u_px[None], v_px[None], depth_m[None]),
            measured=np.isfinite(depth_m)[None],
            target_depth_m=other.depth_m,
            target_measured=other.depth_m > 0,
            quantum_m=np.maximum(*steps)[None],
        )
        return u_px, v_px, seen[0]

    def finish(self) -> None:
        """Write the model."""
        model = self._folder / "sparse" / "0"
        model.mkdir(parents=True)
        heads = {
            "cameras": "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n",
            "images": "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
            "# POINTS2D[] as (X, Y, POINT3D_ID)\n",
            "points3D": "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, "
            "TRACK[] as (IMAGE_ID, POINT2D_IDX)\n",
        }
        texts = ([self._camera], self._image_lines, self._point_lines)
        for (name, head), lines in zip(heads.items(), texts, strict=True):
            with (model / f"{name}.txt").open("w", encoding="utf-8") as file:
                file.writelines([head, *lines])
        super().finish()


def _depth_step_m(encoding: DepthEncoding, depth_m: Any) -> Any:
    """Return the steps between depths that can be stored, at some depths."""
    if encoding.form == "depth":
        return np.full_like(depth_m, encoding.known_unit_m)
    return depth_m**2 / encoding.known_unit_m


class TransformsWriter(ViewWriter):
    """``transforms.json`` with ``images/``, ``depth/`` and ``sparse_pc.ply``, for nerfstudio.

    Cameras have OpenGL's axes (x right, y up, z back), the world's z points up, pixel centres are
    at 0.5. Depth is float32 in millimetres in .npy files, 0 where it is not measured: a 16-bit
    picture would end at 65.5 m.

    Source: nerfstudio-project/nerfstudio, docs/quickstart/data_conventions.md,
    nerfstudio/data/dataparsers/nerfstudio_dataparser.py, nerfstudio/data/utils/data_utils.py.
    """

    axes = _Z_UP_FROM_Y_DOWN

    def begin(self) -> None:
        """Make the folders of pictures and depth, and the cloud."""
        self._cloud = _PointFile(self._folder / "sparse_pc.ply", self._points)
        self._frames: list[dict[str, Any]] = []
        self._lens: dict[str, Any] = {}
        for name in ("images", "depth"):
            (self._folder / name).mkdir()

    def add(self, images: Sequence[PosedImage]) -> None:
        """Take the pictures of one moment."""
        for image in self._in_world(images):
            (fx, _, cx), (_, fy, cy), _ = image.intrinsics.tolist()
            height, width = image.size
            self._lens = {
                "camera_model": "OPENCV",
                "w": width, "h": height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy,
                "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0,
                "camera_angle_x": 2 * float(np.arctan(width / (2 * fx))),
                "camera_angle_y": 2 * float(np.arctan(height / (2 * fy))),
            }  # fmt: skip
            _write_png(self._folder / "images" / f"{image.name}.png", image)
            depth_mm = image.depth_m * np.float32(1000)
            np.save(self._folder / "depth" / f"{image.name}.npy", depth_mm, allow_pickle=False)
            self._frames.append(
                {
                    "file_path": f"images/{image.name}.png",
                    "depth_file_path": f"depth/{image.name}.npy",
                    "transform_matrix": (image.world_from_cam @ _OPENGL_FROM_OPENCV).tolist(),
                }
            )
            self._cloud.add(image)

    def finish(self) -> None:
        """Write the cameras."""
        self._cloud.close()
        applied = self._export_from_scene[:3].tolist()
        transforms = self._lens | {
            "applied_transform": applied,
            "ply_file_path": "sparse_pc.ply",
            "frames": self._frames,
        }
        _write_json(self._folder / "transforms.json", transforms)
        super().finish()


class PlyWriter(ViewWriter):
    """``points.ply``: measured pixels as coloured points, in the scene's axes (y down)."""

    def begin(self) -> None:
        """Make the cloud."""
        self._cloud = _PointFile(self._folder / "points.ply", self._points)

    def add(self, images: Sequence[PosedImage]) -> None:
        """Take the pictures of one moment."""
        for image in self._in_world(images):
            self._cloud.add(image)

    def finish(self) -> None:
        """Write how many points there are, and what they are."""
        self._cloud.close()
        super().finish()


class _PointFile:
    """A binary PLY file that is written picture by picture; the count is put in at the end."""

    def __init__(self, path: Path, points: int | None) -> None:
        self._path, self._points = path, points
        self._count = 0
        path.write_bytes(self._head())

    def _head(self) -> bytes:
        kinds = {"<f4": "float", "|u1": "uchar"}
        lines = [
            "ply",
            "format binary_little_endian 1.0",
            f"element vertex {self._count:0{_COUNT_DIGITS}d}",
            *(f"property {kinds[_POINT[name].str]} {name}" for name in _POINT.names or ()),
            "end_header",
        ]
        return ("\n".join(lines) + "\n").encode("ascii")

    def add(self, image: PosedImage) -> None:
        """Append the points of a picture."""
        rows, columns = sampled_pixels(image, self._points)
        points = np.empty(len(rows), dtype=_POINT)
        world = image.points_world(rows, columns)
        for axis, name in enumerate(("x", "y", "z")):
            points[name] = world[:, axis]
        for channel, name in enumerate(("red", "green", "blue")):
            points[name] = image.rgb[rows, columns, channel]
        with self._path.open("ab") as file:
            file.write(points.tobytes())
        self._count += len(points)

    def close(self) -> None:
        """Write how many points there are."""
        with self._path.open("r+b") as file:
            file.write(self._head())


class MogeWriter(ViewWriter):
    """A folder a picture: ``image.jpg``, ``depth.png``, ``meta.json``.

    Depth is 16 bits on a logarithmic scale between the nearest and the farthest of the picture, 0
    where it is not measured. Intrinsics are those of a picture of width and height 1.

    Source: microsoft/MoGe, docs/train.md, moge/utils/io.py.
    """

    def add(self, images: Sequence[PosedImage]) -> None:
        """Take the pictures of one moment."""
        for image in images:
            place = self._folder / f"cam_{image.camera:02d}"
            place.mkdir()
            Image.fromarray(image.rgb).save(
                place / "image.jpg", quality=_JPEG_QUALITY, subsampling=0
            )
            _write_log_depth(place / "depth.png", image.depth_m)
            height, width = image.size
            scale = np.diag([1 / width, 1 / height, 1.0])
            meta = {
                "intrinsics": (scale @ image.intrinsics).tolist(),
                "scene": image.scene,
                "camera": image.camera,
                "frame": image.frame,
            }
            _write_json(place / "meta.json", meta)

    def finish(self) -> None:
        """Do nothing: every picture stands for itself."""


Layout = Literal["colmap", "transforms", "ply", "moge"]
WRITERS: Final[Mapping[Layout, type[ViewWriter]]] = {
    "colmap": ColmapWriter,
    "transforms": TransformsWriter,
    "ply": PlyWriter,
    "moge": MogeWriter,
}


def _write_log_depth(path: Path, depth_m: Any) -> None:
    """Write depth as MoGe reads it: near ** (1 - t) * far ** t, where t = (number - 1) / 65533."""
    measured = depth_m > 0
    near_m, far_m = 1.0, 1.1
    if measured.any():
        near_m = float(depth_m[measured].min())
        far_m = max(float(depth_m[measured].max()), near_m * 1.1)
    numbers = np.zeros(depth_m.shape, dtype=np.uint16)
    place = np.log(depth_m[measured].astype(np.float64) / near_m) / np.log(far_m / near_m)
    numbers[measured] = 1 + np.round(np.clip(place, 0, 1) * 65533).astype(np.uint16)
    about = PngInfo()
    about.add_text("near", repr(near_m))
    about.add_text("far", repr(far_m))
    Image.fromarray(numbers).save(path, pnginfo=about, compress_level=_FAST)


def _write_png(path: Path, image: PosedImage) -> None:
    Image.fromarray(image.rgb).save(path, compress_level=_FAST)


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1), encoding="utf-8")
