"""What a careful user of any library adds to its decoder: the numbers of a pair, and disparity."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np

from benchmarks.workloads import Wanted, Workload

NO_DEPTH: Final = (0, 65535)
"""Stored numbers that mean "not measured"."""


@dataclass(frozen=True, slots=True)
class PairNumbers:
    """Focal length and baseline of a pair, which turn stored depth into disparity."""

    fx_px: float
    baseline_m: float


def pair_numbers(document: dict[str, Any], *, left: int, right: int, width_px: int) -> PairNumbers:
    """Return the numbers of a pair from ``baseline.json``, for pictures of this width."""
    intrinsics = document["camera_intrinsics"]
    fx_px = intrinsics["focal_length_mm"] / intrinsics["sensor_width_mm"] * width_px
    for entry in document["pairwise_pairs"]:
        if sorted((entry["camera_index_a"], entry["camera_index_b"])) == [left, right]:
            return PairNumbers(fx_px, entry["baseline_cm"] / 100)
    raise KeyError((left, right))


def unit_m_of(container: Any) -> float:
    """Return the metres in a stored unit from the tags of a depth video."""
    tags = container.metadata | container.streams.video[0].metadata
    return float(next((tags[key] for key in tags if "scale" in key.lower()), 0.1))


def camera_files(wanted: Iterable[Wanted], *, both_ways: bool) -> list[str]:
    """Return the names of the videos that samples are made from."""
    names = set()
    for sample in wanted:
        names |= {f"cam_{camera:02d}_rgb.mp4" for camera in (sample.left, sample.right)}
        names |= {f"cam_{sample.left:02d}_depth.mkv"}
        names |= {f"cam_{sample.right:02d}_depth.mkv"} if both_ways else set()
    return sorted(names)


@cache
def nearest_places(found: tuple[int, ...], size: tuple[int, int]) -> list[np.ndarray]:
    """Return the rows and columns that a map at (height, width) takes: nearest pixel centres."""
    return [
        ((np.arange(wanted) + 0.5) * there / wanted).astype(np.intp)
        for wanted, there in zip(size, found, strict=True)
    ]


def disparity_px(
    units: np.ndarray, pair: PairNumbers, *, unit_m: float, size: tuple[int, int] | None
) -> np.ndarray:
    """Return B fx / z as float32 (1, h, w), 0 where depth was not measured."""
    if size is not None:
        rows, columns = nearest_places(units.shape, size)
        units = units[rows].take(columns, axis=1)
    measured = (units != NO_DEPTH[0]) & (units != NO_DEPTH[1])
    scale = np.float32(pair.fx_px * pair.baseline_m / unit_m)
    return np.where(measured, scale / np.maximum(units, 1).astype(np.float32), np.float32(0))[None]


def rgb_of(frame: Any, size: tuple[int, int] | None) -> np.ndarray:
    """Return a decoded picture as uint8 (3, h, w), at its own size or scaled to (height, width)."""
    scaled = {} if size is None else {"height": size[0], "width": size[1], "interpolation": "AREA"}
    found: np.ndarray = frame.to_ndarray(format="rgb24", **scaled).transpose(2, 0, 1)
    return found


def sample_of(
    workload: Workload,
    wanted: Wanted,
    document: dict[str, Any],
    *,
    colours: Callable[[int], list[np.ndarray]],
    depth: Callable[[int], tuple[list[np.ndarray], float]],
) -> dict[str, Any]:
    """Return a sample as a dict that torch's own collate takes.

    Args:
        workload: What samples hold.
        wanted: Which sample.
        document: The scene's ``baseline.json``.
        colours: Returns the pictures of a camera, one a frame.
        depth: Returns the stored depth of a camera, one map a frame, and metres in its unit.
    """
    width_px = (workload.size or (0, document["image_width"]))[1]
    pair = pair_numbers(document, left=wanted.left, right=wanted.right, width_px=width_px)
    pictures = {"left": colours(wanted.left), "right": colours(wanted.right)}
    for name, camera in (("disparity", wanted.left), ("disparity_right", wanted.right)):
        if name in workload.fields:
            stored, unit_m = depth(camera)
            pictures[name] = [
                disparity_px(units, pair, unit_m=unit_m, size=workload.size) for units in stored
            ]
    frames, cut = np.array(wanted.frames), slice(None) if workload.is_clip else 0
    return {name: np.stack(found)[cut] for name, found in pictures.items()} | {
        "baseline_m": np.float64(pair.baseline_m),
        "frame_index": frames[cut],
        "pair": np.array([wanted.left, wanted.right]),
        "scene": wanted.scene,
    }
