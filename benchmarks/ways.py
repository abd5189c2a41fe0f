"""Every way to turn stored depth into disparity and visibility, as functions of one signature."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Final, Literal

import numpy as np
import torch

from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.disparity import (
    disparity_from_depth,
    disparity_from_shifts,
    write_disparity,
)
from stereogenbench_data.geometry.pose import CameraPoses, rotation_from_rotator_deg
from stereogenbench_data.geometry.projection import homography, project_by_homography


@dataclass(frozen=True)
class Pair:
    """A rectified pair of cameras anywhere in the world.

    Attributes:
        focal_px: Focal length in pixels.
        baseline_m: Signed baseline.
        unit_m: Metres in a stored unit.
        rotator_deg: Pitch, yaw and roll of both cameras, as Unreal records them.
        offset_cm: Position of the left camera.
    """

    focal_px: float
    baseline_m: float
    unit_m: float
    rotator_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    offset_cm: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @cached_property
    def poses(self) -> CameraPoses:
        """The poses of both cameras, as cameras 0 and 1 of a rig."""
        rotation = rotation_from_rotator_deg(np.array(self.rotator_deg))
        apart_cm = np.arange(6)[:, None] * self.baseline_m * 100 * rotation[:, 1]
        locations = np.array(self.offset_cm) + apart_cm
        rotations = np.tile(rotation, (1, 6, 1, 1))
        return CameraPoses.from_unreal(locations[None], rotations, unit_m=0.01)

    def intrinsics(self, units: np.ndarray) -> Intrinsics:
        """Return the intrinsics of a map of this size."""
        height, width = units.shape
        f = self.focal_px
        return Intrinsics(f, f, width / 2, height / 2, width, height)

    def true_px(self, units: np.ndarray) -> np.ndarray:
        """Return the disparity of stored depth in extended precision."""
        exact = np.longdouble
        scale = exact(self.focal_px) * exact(self.baseline_m) / exact(self.unit_m)
        return scale / units.astype(exact)


Disparity = Callable[[np.ndarray, Pair], np.ndarray]


def float64_reference(units: np.ndarray, pair: Pair) -> np.ndarray:
    """Depth in float64, divided in float64."""
    depth_m = units * np.float64(pair.unit_m)
    return disparity_from_depth(depth_m, focal_px=pair.focal_px, baseline_m=pair.baseline_m)


def in_blocks(units: np.ndarray, pair: Pair, out: np.ndarray | None = None) -> np.ndarray:
    """The package's way for samples: the closed form, a few rows at a time."""
    out = np.empty(units.shape, dtype=np.float32) if out is None else out
    shift_units = pair.focal_px * pair.baseline_m / pair.unit_m
    write_disparity(out, units, measured=_all_measured(units.shape), shift_units=shift_units)
    return out


@cache
def _all_measured(shape: tuple[int, ...]) -> np.ndarray:
    return np.ones(shape, dtype=bool)


def closed_form(units: np.ndarray, pair: Pair) -> np.ndarray:
    """The same over the whole map at once, which is the package's way with torch's tensors."""
    stored = torch.from_numpy(units).to(torch.float64)
    shift_units = torch.tensor(pair.focal_px * pair.baseline_m / pair.unit_m, dtype=stored.dtype)
    disparity_px = disparity_from_shifts(torch.where(stored > 0, stored, torch.inf), shift_units)
    return np.asarray(disparity_px)


def float32_depth(units: np.ndarray, pair: Pair) -> np.ndarray:
    """A float32 depth map first, then the package's disparity of it."""
    depth_m = (units * np.float64(pair.unit_m)).astype(np.float32)
    return disparity_from_depth(depth_m, focal_px=pair.focal_px, baseline_m=pair.baseline_m)


def plain_divide(units: np.ndarray, pair: Pair) -> np.ndarray:
    """One float32 division by the stored number."""
    scale = np.float32(pair.focal_px * pair.baseline_m / pair.unit_m)
    with np.errstate(divide="ignore"):
        return np.divide(scale, units, dtype=np.float32, casting="same_kind")


def half_disparity(units: np.ndarray, pair: Pair) -> np.ndarray:
    """The default, stored in half precision."""
    with np.errstate(over="ignore"):
        return in_blocks(units, pair).astype(np.float16)


def half_depth(units: np.ndarray, pair: Pair) -> np.ndarray:
    """Depth in metres stored in half precision, then divided in float32."""
    depth_m = (units * np.float32(pair.unit_m)).astype(np.float16)
    with np.errstate(divide="ignore"):
        return np.float32(pair.focal_px * pair.baseline_m) / depth_m.astype(np.float32)


def table_look_up(units: np.ndarray, pair: Pair) -> np.ndarray:
    """The disparity of all 65,536 stored numbers, computed in float64, then looked up."""
    numbers = np.arange(65536, dtype=np.float64)
    numbers[0] = np.inf
    table = (pair.focal_px * pair.baseline_m / pair.unit_m / numbers).astype(np.float32)
    return table[units]


def poses_float64(units: np.ndarray, pair: Pair) -> np.ndarray:
    """Every pixel through the poses, float64 throughout."""
    return _through_poses(units * np.float64(pair.unit_m), pair)


def poses_float32_maps(units: np.ndarray, pair: Pair) -> np.ndarray:
    """The package's way for a rig that is not rectified, with float32 maps in and out."""
    return _through_poses((units * np.float64(pair.unit_m)).astype(np.float32), pair)


def _through_poses(depth_m: np.ndarray, pair: Pair) -> np.ndarray:
    intrinsics = pair.intrinsics(depth_m)
    target_from_source = pair.poses.cam_from_cam(0, target=1, source=0)
    moved = project_by_homography(depth_m, *homography(intrinsics, intrinsics, target_from_source))
    return np.arange(depth_m.shape[1]) + 0.5 - moved.u_px


def poses_textbook_float32(units: np.ndarray, pair: Pair) -> np.ndarray:
    """The textbook chain, all in float32: to world coordinates and back."""
    height, width = units.shape
    camera = pair.intrinsics(units).matrix().astype(np.float32)
    left, right = (pair.poses.world_from_cam(0, cam).astype(np.float32) for cam in (0, 1))
    u_px, v_px = np.meshgrid(
        np.arange(width, dtype=np.float32) + np.float32(0.5),
        np.arange(height, dtype=np.float32) + np.float32(0.5),
    )
    rays = np.linalg.inv(camera) @ np.stack([u_px, v_px, np.ones_like(u_px)]).reshape(3, -1)
    points = rays * (units.astype(np.float32) * np.float32(pair.unit_m)).reshape(1, -1)
    world = left[:3, :3] @ points + left[:3, 3:]
    seen = camera @ (right[:3, :3].T @ (world - right[:3, 3:]))
    return u_px - (seen[0] / seen[2]).reshape(height, width)


@dataclass(frozen=True, slots=True)
class Way:
    """One way.

    Attributes:
        name: What tables call it.
        run: The function.
        offered: Whether the package uses it.
    """

    name: str
    run: Disparity
    offered: Literal["default", "offered", "not taken"]


DEFAULT: Final = "float32 closed form from stored units, in blocks"

WAYS: Final = (
    Way("float64 reference", float64_reference, "offered"),
    Way(DEFAULT, in_blocks, "default"),
    Way("float32 closed form, the whole map at once (torch)", closed_form, "offered"),
    Way("float32 depth map, then its disparity", float32_depth, "offered"),
    Way("one float32 division", plain_divide, "not taken"),
    Way("look-up table of stored units", table_look_up, "not taken"),
    Way("closed form stored as float16", half_disparity, "not taken"),
    Way("depth stored as float16", half_depth, "not taken"),
    Way("pose chain, float64 maps", poses_float64, "offered"),
    Way("pose chain, float32 maps", poses_float32_maps, "offered"),
    Way("pose chain, all float32 (textbook)", poses_textbook_float32, "not taken"),
)


def interpolated(values: np.ndarray, *, size: tuple[int, int], mode: str) -> np.ndarray:
    """Return a map at another size, by one of torch's policies."""
    options = {"antialias": False, "align_corners": False} if mode == "bilinear" else {}
    found = torch.nn.functional.interpolate(
        torch.from_numpy(values)[None, None], size, mode=mode, **options
    )
    return found[0, 0].numpy()
