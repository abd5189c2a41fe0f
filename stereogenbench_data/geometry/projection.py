"""Where the pixels of a source view land in a target view.

Pixel (u, v) is column, row; the centre of the top-left pixel is (0.5, 0.5), so u falls into
column floor(u). Camera axes are x right, y down, z forward; lengths are metres.
"""

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from stereogenbench_data.errors import GeometryError
from stereogenbench_data.geometry.arrays import (
    array_namespace,
    as_float64,
    device,
    is_numpy_array,
    leading_offsets,
    pixel_centres,
    whole_where,
)
from stereogenbench_data.geometry.camera import Intrinsics, require_picture_size

_BLOCK_PIXELS: Final = 64 * 1280
"""How many pixels of float maps stay in a processor's cache from one step to the next."""


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """The position in the target image, and the depth there, of each source pixel's point.

    Attributes:
        u_px: Column coordinate in the target image; nan where the point does not project.
        v_px: Row coordinate, or None where rows do not change (a rectified pair).
        depth_m: Depth along the target's optical axis, in metres.
    """

    u_px: Float[Any, "*batch h w"]
    v_px: Float[Any, "*batch h w"] | None
    depth_m: Float[Any, "*batch h w"]


def row_blocks(projection: Projection, *, height_px: int) -> list[slice]:
    """Return the rows of a projection in blocks that can be processed one after another.

    There are several blocks if rows do not change, the target has as many rows, and the maps are
    numpy arrays; else there is one. Results are the same, and up to twice as fast.
    """
    *images, rows, columns = projection.u_px.shape
    apart = is_numpy_array(projection.u_px) and projection.v_px is None and rows == height_px
    step = max(1, _BLOCK_PIXELS // max(1, columns * math.prod(images)) if apart else rows)
    return [slice(top, top + step) for top in range(0, max(1, rows), step)]


def rows_of(projection: Projection, rows: slice) -> Projection:
    """Return some rows of a rectified projection."""
    return Projection(
        u_px=projection.u_px[..., rows, :], v_px=None, depth_m=projection.depth_m[..., rows, :]
    )


def project_rectified(
    depth_m: Float[Any, "*batch h w"], disparity_px: Float[Any, "*batch h w"]
) -> Projection:
    """Return the projection into a rectified target: u - d, the same row, the same depth."""
    u_px, _ = pixel_centres(disparity_px, dtype=disparity_px.dtype)
    return Projection(u_px=u_px - disparity_px, v_px=None, depth_m=depth_m)


def project_through_poses(
    depth_m: Float[Any, "*batch h w"],
    *,
    intrinsics: Intrinsics,
    target_intrinsics: Intrinsics,
    target_from_source: Float64[np.ndarray, "4 4"],
) -> Projection:
    """Return the projection into any target: K_t (R K_s^-1 (u, v, 1) z + t).

    The result is computed in float64 and has the depth's dtype. u and v are nan where the point is
    on or behind the target's plane, or where depth is nan or inf.

    Args:
        depth_m: Source depth along the optical axis, in metres.
        intrinsics: Intrinsics of the source image, which has the size of the map.
        target_intrinsics: Intrinsics of the target image.
        target_from_source: Rigid motion from source to target camera axes, in metres.

    Raises:
        GeometryError: If the map does not have the image size of the intrinsics.

    Source: Hartley and Zisserman, Multiple View Geometry, 2nd ed., ch. 6.
    """
    require_picture_size(depth_m.shape, intrinsics, name="the depth map")
    xp = array_namespace(depth_m)
    camera_matrix = target_intrinsics.matrix()
    homography = camera_matrix @ target_from_source[:3, :3] @ np.linalg.inv(intrinsics.matrix())
    step = camera_matrix @ target_from_source[:3, 3]
    place = device(depth_m)
    return project_by_homography(
        depth_m, xp.asarray(homography, device=place), xp.asarray(step, device=place)
    )


def project_by_homography(
    depth_m: Float[Any, "*batch h w"],
    homography: Float64[Any, "*rigs 3 3"],
    step_px_m: Float64[Any, "*rigs 3"],
) -> Projection:
    """Return the projection homography (u, v, 1) z + step, as `project_through_poses` does.

    Args:
        depth_m: Source depth along the optical axis, in metres.
        homography: K_t R K_s^-1, of one rig or of several: their shape is broadcast to the maps'.
        step_px_m: K_t t, likewise.
    """
    xp = array_namespace(depth_m)
    dtype = depth_m.dtype
    u_px, v_px = pixel_centres(depth_m, dtype=xp.float64)
    source_m = as_float64(depth_m)
    rows, shifts = homography[..., None, None], step_px_m[..., None, None]
    x, y, z = (
        source_m
        * (
            rows[..., axis, 0, :, :] * u_px
            + (rows[..., axis, 1, :, :] * v_px + rows[..., axis, 2, :, :])
        )
        + shifts[..., axis, :, :]
        for axis in range(3)
    )
    in_front = xp.where((z > 0) & xp.isfinite(z), z, xp.nan)
    return Projection(
        u_px=xp.astype(x / in_front, dtype, copy=False),
        v_px=xp.astype(y / in_front, dtype, copy=False),
        depth_m=xp.astype(z, dtype, copy=False),
    )


def lands_inside(
    projection: Projection, *, height_px: int, width_px: int
) -> Bool[Any, "*batch h w"]:
    """Return which source pixels land inside a target image of this size.

    Raises:
        GeometryError: If rows do not change but the two images differ in height.
    """
    u_px, v_px = projection.u_px, projection.v_px
    inside = (u_px >= 0) & (u_px < width_px)
    if v_px is not None:
        inside &= (v_px >= 0) & (v_px < height_px)
    elif u_px.shape[-2] != height_px:
        raise GeometryError(
            f"a rectified projection of {u_px.shape[-2]} rows cannot land in an image of "
            f"{height_px} rows: resize or crop both views alike."
        )
    return inside


def landing_pixels(
    projection: Projection, *, height_px: int, width_px: int
) -> tuple[Bool[Any, "*batch h w"], Int64[Any, "*batch h w"]]:
    """Return which source pixels land inside a target image, and on which of its pixels.

    The pixel is an index into flattened target maps (..., height_px, width_px). For a source pixel
    that lands outside, it is an arbitrary valid index.

    Raises:
        GeometryError: If rows do not change but the two images differ in height.
    """
    inside = lands_inside(projection, height_px=height_px, width_px=width_px)
    pixel = whole_where(inside, projection.u_px)
    if projection.v_px is None:
        pixel += row_starts(projection, height_px=height_px, width_px=width_px)
    else:
        pixel += whole_where(inside, projection.v_px) * width_px
        pixel += image_starts(projection, height_px=height_px, width_px=width_px)
    return inside, pixel


def image_starts(
    projection: Projection, *, height_px: int, width_px: int
) -> Int64[Any, "*batch 1 1"]:
    """Return the flat index of the first pixel of each target map of a batch."""
    batch = projection.u_px.shape[:-2]
    return leading_offsets((*batch, 1, 1), step=height_px * width_px, like=projection.u_px)


def row_starts(
    projection: Projection, *, height_px: int, width_px: int
) -> Int64[Any, "*batch h 1"]:
    """Return the flat index of the first pixel of each row of each target map of a batch."""
    batch = projection.u_px.shape[:-2]
    return leading_offsets((*batch, height_px, 1), step=width_px, like=projection.u_px)
