"""Scenes with one thing made wrong, by rewriting their files with PyAV and json alone."""

import json
import math
import shutil
from pathlib import Path

import av
import numpy as np

from tests.servers.tools import rewrite_json
from tests.servers.videos import write_depth, write_rgb

CAMERAS = range(6)


def copied(source: Path, root: Path) -> Path:
    """Copy a scene's folder below another root, under the same key; return the new folder."""
    parts = source.parts
    key = parts[max(i for i, part in enumerate(parts) if part in ("train", "eval")) :]
    folder = root.joinpath(*key)
    shutil.copytree(source, folder)
    for path in folder.iterdir():
        path.chmod(0o644)
    return folder


def read_depth(folder: Path, camera: int) -> tuple[np.ndarray, dict[str, str]]:
    """Return (t, h, w) uint16 and the container's tags."""
    with av.open(str(folder / f"cam_{camera:02d}_depth.mkv")) as container:
        return np.stack([f.to_ndarray() for f in container.decode(video=0)]), container.metadata


def rewrite_depth(folder: Path, change=lambda units: units, *, cameras=CAMERAS, tags=None) -> None:
    """Replace cameras' depth by change(units), and the tags; a number multiplies what they say."""
    for camera in cameras:
        units, told = read_depth(folder, camera)
        scales = {key: each for key, each in told.items() if "scale" in key.lower()}
        if isinstance(tags, float):
            scales = {key: repr(float(each) * tags) for key, each in scales.items()}
        write_depth(
            folder / f"cam_{camera:02d}_depth.mkv",
            np.asarray(change(units), np.uint16),
            tags=tags if isinstance(tags, dict) else scales,
            options={"level": "3", "slicecrc": "1"},
        )


def as_range(near_m: float, far_m: float, *, unit_m: float):
    """Return the change to numbers of which 0 is near_m and 65,535 is far_m."""

    def change(units):
        depth_m = np.clip(units * unit_m, near_m, far_m)
        return np.rint((depth_m - near_m) / (far_m - near_m) * 65535)

    return change


def rewrite_rgb(folder: Path, change, *, cameras=CAMERAS, crf: int = 18) -> None:
    """Replace cameras' pictures (t, h, w, 3) by change(pictures); 0 is without loss."""
    for camera in cameras:
        path = folder / f"cam_{camera:02d}_rgb.mp4"
        with av.open(str(path)) as container:
            pictures = np.stack([f.to_ndarray(format="rgb24") for f in container.decode(video=0)])
        write_rgb(path, np.ascontiguousarray(change(pictures)), options={"crf": f"{crf}"})


def depth_of(camera: int, change):
    """Return what replaces the depth of a camera of a scene by change(units)."""
    return lambda folder: rewrite_depth(folder, change, cameras=[camera])


def pictures_of(camera: int, change, **how):
    """Return what replaces the pictures of a camera of a scene by change(pictures)."""
    return lambda folder: rewrite_rgb(folder, change, cameras=[camera], **how)


def without_texture(folder: Path) -> None:
    """Make all pictures grey."""
    rewrite_rgb(folder, lambda pictures: np.full_like(pictures, 128))


def scale_camera(folder: Path, **factors: float) -> None:
    """Multiply lengths of the camera that baseline.json records, by their names there."""

    def change(document):
        for name, factor in factors.items():
            document["camera_intrinsics"][name] *= factor

    rewrite_json(folder / "baseline.json", change)


def edit_pairs(folder: Path, change) -> None:
    """Let change(pair) alter each recorded pair of cameras."""

    def change_all(document):
        for pair in (*document["adjacent_pairs"], *document["pairwise_pairs"]):
            change(pair)

    rewrite_json(folder / "baseline.json", change_all)


def lengthen_label(folder: Path, cameras: tuple[int, int], *, by_cm: float) -> None:
    """Make the recorded baseline of two cameras longer; the poses stay."""

    def change(pair):
        if (pair["camera_index_a"], pair["camera_index_b"]) == cameras:
            pair["baseline_cm"] += by_cm

    edit_pairs(folder, change)


def place_cameras(folder: Path, factors: dict[int, float]) -> None:
    """Record cameras so many times as far from camera 0, in the poses and the baselines alike."""

    def move(document):
        for frame in document["frames"]:
            first = {axis: frame["cameras"][0]["location"][axis] for axis in "xyz"}
            for camera, factor in factors.items():
                location = frame["cameras"][camera]["location"]
                for axis in "xyz":
                    location[axis] = first[axis] + factor * (location[axis] - first[axis])

    document = rewrite_json(folder / "trajectory.json", move)
    places = [[*camera["location"].values()] for camera in document["frames"][0]["cameras"]]

    def change(pair):
        a, b = pair["camera_index_a"], pair["camera_index_b"]
        pair["baseline_cm"] = math.dist(places[a], places[b])

    edit_pairs(folder, change)


def as_ray(folder: Path):
    """Return the change from depth along the axis to depth along the ray, by baseline.json."""
    camera = json.loads((folder / "baseline.json").read_text())["camera_intrinsics"]

    def change(units):
        known = (units > 0) & (units < 65535)
        height, width = units.shape[1:]
        x = (np.arange(width) + 0.5 - width / 2) / width * camera["sensor_width_mm"]
        y = (np.arange(height) + 0.5 - height / 2) / height * camera["sensor_height_mm"]
        lengths = np.sqrt(1 + (x**2 + y[:, None] ** 2) / camera["focal_length_mm"] ** 2)
        return np.where(known, np.minimum(np.rint(units * lengths), 65534), units)

    return change


def as_inverse(folder: Path):
    """Return the change to numbers in proportion to 1 / depth, half of them above 20,000."""
    units, _ = read_depth(folder, 0)
    middle = np.median(units[(units > 0) & (units < 65535)])

    def change(units):
        known = (units > 0) & (units < 65535)
        return np.where(known, np.minimum(np.rint(20000 * middle / np.maximum(units, 1)), 65534), 0)

    return change


def scaled(factor: float):
    """Return the change to depth so many times as large."""

    def change(units):
        known = (units > 0) & (units < 65535)
        return np.where(known, np.clip(np.rint(units * factor), 1, 65534), units)

    return change


def late(frames: int):
    """Return the change after which frame t holds what frame t - ``frames`` held."""

    def change(video):
        return video[np.clip(np.arange(len(video)) - frames, 0, len(video) - 1)]

    return change


def exchange(folder: Path, cameras: dict[int, int], *, kinds=("rgb.mp4", "depth.mkv")) -> None:
    """Give camera c the files of camera cameras[c]."""
    for kind in kinds:
        contents = {
            camera: (folder / f"cam_{camera:02d}_{kind}").read_bytes() for camera in cameras
        }
        for camera, other in cameras.items():
            (folder / f"cam_{camera:02d}_{kind}").write_bytes(contents[other])
