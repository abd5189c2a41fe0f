"""Where the pixels of a source view land in a target view, which of them it sees, and warping.

Pixel (u, v) is column, row; the centre of the top-left pixel is (0.5, 0.5), so u falls into
column floor(u). Camera axes are x right, y down, z forward; lengths are metres. Images are
channel-first, (..., c, h, w).

Depth is along the optical axis. Two depths agree where they differ by no more than ``tolerance`` of
the projected depth plus two quanta (the steps in which depth is stored), in either direction: a
point in front of the target's depth is as inconsistent as one behind it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64, Shaped

from stereogenbench_data.geometry.arrays import (
    Array,
    array_namespace,
    as_float64,
    is_numpy_array,
    leading_offsets,
    pixel_centres,
    scatter,
    take_flat,
    take_pixels,
    values_where,
    whole_where,
)
from stereogenbench_data.geometry.camera import Intrinsics

_BLOCK_PIXELS: Final = 64 * 1280
"""How many pixels of float maps stay in a processor's cache from one step to the next."""

_INDEX_BITS: Final = 2**32 - 1
_NOTHING: Final = -(2**63)


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


def by_rows(make: Callable[..., Any], projection: Projection, *maps: Any, height_px: int) -> Any:
    """Return ``make(projection, *maps)``, made of some rows at a time where rows do not change.

    These stay in the processor's cache: results are the same, and up to twice as fast. It needs
    numpy arrays, and a target with as many rows.

    Args:
        make: A function of a projection and maps, which returns maps.
        projection: Where source pixels land.
        *maps: Maps or images (..., h, w), or numbers that hold for all pixels.
        height_px: The rows of the target.
    """
    u_px, depth_m = projection.u_px, projection.depth_m
    *images, rows, columns = u_px.shape
    step = max(1, _BLOCK_PIXELS // max(1, columns * math.prod(images)))
    is_apart = is_numpy_array(u_px) and projection.v_px is None and rows == height_px
    if not is_apart or step >= rows:
        return make(projection, *maps)
    parts = []
    for top in range(0, rows, step):
        here = (..., slice(top, top + step), slice(None))
        of_rows = [each[here] if np.ndim(each) > 1 else each for each in maps]
        parts.append(make(Projection(u_px[here], None, depth_m[here]), *of_rows))
    if isinstance(parts[0], tuple):
        return tuple(np.concatenate(each, axis=-2) for each in zip(*parts, strict=True))
    return np.concatenate(parts, axis=-2)


def project_rectified(
    depth_m: Float[Any, "*batch h w"], disparity_px: Float[Any, "*batch h w"]
) -> Projection:
    """Return the projection into a rectified target: u - d, the same row, the same depth."""
    u_px, _ = pixel_centres(disparity_px, dtype=disparity_px.dtype)
    return Projection(u_px=u_px - disparity_px, v_px=None, depth_m=depth_m)


def homography(
    intrinsics: Intrinsics,
    target_intrinsics: Intrinsics,
    target_from_source: Float64[np.ndarray, "4 4"],
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
    """Return K_t R K_s^-1 and K_t t of a rigid motion, in metres."""
    camera_matrix = target_intrinsics.matrix()
    return (
        camera_matrix @ target_from_source[:3, :3] @ np.linalg.inv(intrinsics.matrix()),
        camera_matrix @ target_from_source[:3, 3],
    )


def project_by_homography(
    depth_m: Float[Any, "*batch h w"],
    homography: Float64[Any, "*rigs 3 3"],
    step_px_m: Float64[Any, "*rigs 3"],
) -> Projection:
    """Return the projection into any target: K_t (R K_s^-1 (u, v, 1) z + t).

    The result is computed in float64 and has the depth's dtype. u and v are nan where the point is
    on or behind the target's plane, or where depth is nan or inf.

    Args:
        depth_m: Source depth along the optical axis, in metres.
        homography: K_t R K_s^-1, of one rig or of several: their shape is broadcast to the maps'.
        step_px_m: K_t t, likewise.

    Source: Hartley and Zisserman, Multiple View Geometry, 2nd ed., ch. 6.
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

    Where rows do not change, both images have one height.
    """
    u_px, v_px = projection.u_px, projection.v_px
    inside = (u_px >= 0) & (u_px < width_px)
    if v_px is not None:
        inside &= (v_px >= 0) & (v_px < height_px)
    return inside


def landing_pixels(
    projection: Projection, *, height_px: int, width_px: int
) -> tuple[Bool[Any, "*batch h w"], Int64[Any, "*batch h w"]]:
    """Return which source pixels land inside a target image, and on which of its pixels.

    The pixel is an index into flattened target maps (..., height_px, width_px). For a source pixel
    that lands outside, it is an arbitrary valid index.
    """
    inside = lands_inside(projection, height_px=height_px, width_px=width_px)
    pixel = whole_where(inside, projection.u_px)
    pixel += _starts(projection, height_px=height_px, width_px=width_px)
    if projection.v_px is not None:
        pixel += whole_where(inside, projection.v_px) * width_px
    return inside, pixel


def _starts(projection: Projection, *, height_px: int, width_px: int) -> Int64[Any, "*batch h1 1"]:
    """Return the flat index at which each target map begins; where rows do not change, each row."""
    batch = projection.u_px.shape[:-2]
    if projection.v_px is None:
        return leading_offsets((*batch, height_px, 1), step=width_px, like=projection.u_px)
    return leading_offsets((*batch, 1, 1), step=height_px * width_px, like=projection.u_px)


def visible_in_target(
    projection: Projection,
    *,
    measured: Bool[Any, "*batch h w"],
    target_depth_m: Float[Any, "*batch target_h target_w"],
    target_measured: Bool[Any, "*batch target_h target_w"],
    quantum_m: float | Float[Any, "*#batch #h #w"],
    tolerance: float = 0.02,
) -> Bool[Any, "*batch h w"]:
    """Return the source pixels that the target camera sees, decided by the target's depth.

    A pixel is visible if it was measured, lands inside the target image, and its depth there agrees
    with the depth that the target measured at the pixel that contains the point (not an average of
    neighbours).

    Args:
        projection: Where source pixels land in the target.
        measured: Where source depth was measured.
        target_depth_m: The target camera's depth in metres.
        target_measured: Where target depth was measured.
        quantum_m: The step in which depth is stored, in metres (the coarser of the two views);
            one number, or a map over source pixels if the step varies with depth.
        tolerance: Fraction of the depth by which the two may differ, in addition to two quanta.

    Returns:
        True where visible.

    Source: the StereoGenBench paper, appendix on the geometry audit, which compares projected
    points with the target's depth buffer; the tolerance is our choice.
    """
    height_px, width_px = target_depth_m.shape[-2:]

    def visible(here: Projection, *maps: Any) -> Any:
        measured, target_depth_m, target_measured, quantum_m = maps
        inside, pixel = landing_pixels(here, height_px=target_depth_m.shape[-2], width_px=width_px)
        there_m = take_flat(
            values_where(target_measured, target_depth_m, otherwise=-math.inf), pixel
        )
        visible = there_m >= here.depth_m * (1.0 - tolerance) - 2.0 * quantum_m
        visible &= there_m <= here.depth_m * (1.0 + tolerance) + 2.0 * quantum_m
        visible &= inside
        visible &= measured
        return visible

    maps = (measured, target_depth_m, target_measured, quantum_m)
    return by_rows(visible, projection, *maps, height_px=height_px)


def visible_from_source(
    projection: Projection,
    *,
    measured: Bool[Any, "*batch h w"],
    quantum_m: float | Float[Any, "*#batch #h #w"],
    tolerance: float = 0.02,
) -> Bool[Any, "*batch h w"]:
    """Return the source pixels that nothing in the source view occludes from the target.

    This is the test of `visible_in_target` with a z-buffer of the source's own points, for use
    without the target's depth. It does not know about occluders outside the source view or behind
    its surfaces, so some pixels that it calls visible are occluded.

    Args:
        projection: Where source pixels land in a target image of the same size.
        measured: Where source depth was measured.
        quantum_m: The step in which depth is stored, in metres.
        tolerance: Fraction of the depth by which a point may be behind the nearest one.

    Returns:
        True where the pixel lands inside the image and nothing in the source view occludes it.
    """

    def visible(here: Projection, measured: Any, quantum_m: Any) -> Any:
        shape = here.depth_m.shape
        inside, pixel = landing_pixels(here, height_px=shape[-2], width_px=shape[-1])
        inside &= measured
        landed_m = values_where(inside, here.depth_m, otherwise=math.inf)
        size = math.prod(shape)
        front_m = take_flat(
            scatter(landed_m, pixel, size=size, reduce="amin", empty=math.inf), pixel
        )
        inside &= front_m >= here.depth_m * (1.0 - tolerance) - 2.0 * quantum_m
        return inside

    height_px = projection.u_px.shape[-2]
    return by_rows(visible, projection, measured, quantum_m, height_px=height_px)


def front_pixels(
    projection: Projection, *, measured: Bool[Any, "*batch h w"]
) -> tuple[Int64[Any, "*batch h w"], Bool[Any, "*batch h w"]]:
    """Return which source pixel is in front at each target pixel, and where none landed.

    The target image has the source's size. The nearest point wins, and among equally near points
    the larger index, so the result is the same on every device. One pass does both: the bits of
    positive floats have the order of the floats, so the integer (-bits, index) is largest for the
    pixel in front.

    Args:
        projection: Where source pixels land.
        measured: Where source depth was measured.

    Returns:
        Flat indices into source maps (..., h, w), 0 where nothing landed; and the holes.
    """
    xp = array_namespace(projection.u_px)
    shape = projection.u_px.shape
    inside, pixel = landing_pixels(projection, height_px=shape[-2], width_px=shape[-1])
    depth_m = xp.astype(projection.depth_m, xp.float32, copy=False)
    key = xp.astype(depth_m.view(xp.int32), xp.int64)
    key *= -(2**32)
    key += leading_offsets(shape, step=1, like=key)
    key = xp.where(inside & measured, key, _NOTHING)
    best = xp.reshape(
        scatter(key, pixel, size=math.prod(shape), reduce="amax", empty=_NOTHING), shape
    )
    hole = best == _NOTHING
    best &= _INDEX_BITS  # 0 of _NOTHING
    return best, hole


def splat(
    image: Shaped[Any, "*batch c h w"],
    projection: Projection,
    *,
    measured: Bool[Any, "*batch h w"],
) -> tuple[Shaped[Any, "*batch c h w"], Bool[Any, "*batch h w"]]:
    """Return a source image warped into the target view, and its holes.

    Each measured source pixel is written to the target pixel that contains its point; the nearest
    point wins.

    Args:
        image: The source image, of any dtype.
        projection: Where its pixels land in a target image of the same size.
        measured: Where source depth was measured.

    Returns:
        The target image in the same dtype, 0 in holes; and the holes, True where nothing landed.
    """

    def splatted(here: Projection, image: Any, measured: Any) -> tuple[Any, Any]:
        xp = array_namespace(image)
        front, hole = front_pixels(here, measured=measured)
        warped = take_pixels(image, front)
        return xp.where(hole[..., None, :, :], xp.zeros_like(warped), warped), hole

    found: tuple[Any, Any] = by_rows(
        splatted, projection, image, measured, height_px=image.shape[-2]
    )
    return found


def backward_warp(
    image: Shaped[Any, "*batch c target_h target_w"], projection: Projection
) -> tuple[Float[Any, "*batch c h w"], Bool[Any, "*batch h w"]]:
    """Return the target image sampled where each source pixel lands, and which pixels land inside.

    Sampling is bilinear between pixel centres; in the outer half pixel of the border it takes the
    outermost pixel. At an occluded pixel the result shows the occluder: mask it by visibility.

    Args:
        image: The target image, of any real dtype.
        projection: Where source pixels land in it.

    Returns:
        The image in the source view, in its own dtype if that is a float and else float32,
        0 outside; and True where a source pixel lands inside the target image.
    """

    def sampled(here: Projection, image: Any) -> tuple[Any, Any]:
        xp = array_namespace(image)
        dtype = image.dtype if xp.isdtype(image.dtype, "real floating") else xp.float32
        size = {"height_px": image.shape[-2], "width_px": image.shape[-1]}
        inside = lands_inside(here, **size)
        starts = _starts(here, **size)
        left, right, to_right = _neighbours(here.u_px, inside, size_px=size["width_px"])
        to_right = xp.astype(to_right, dtype, copy=False)

        def sample_rows(starts: Array) -> Array:
            at_left = xp.astype(take_pixels(image, starts + left), dtype, copy=False)
            at_right = xp.astype(take_pixels(image, starts + right), dtype, copy=False)
            return at_left + (at_right - at_left) * to_right

        if here.v_px is None:
            warped = sample_rows(starts)
        else:
            upper, lower, down = _neighbours(here.v_px, inside, size_px=size["height_px"])
            above, below = (sample_rows(starts + row * size["width_px"]) for row in (upper, lower))
            warped = above + (below - above) * xp.astype(down, dtype, copy=False)
        return xp.where(inside[..., None, :, :], warped, 0.0), inside

    found: tuple[Any, Any] = by_rows(sampled, projection, image, height_px=image.shape[-2])
    return found


def _neighbours(
    position_px: Float[Any, "*batch h w"], inside: Bool[Any, "*batch h w"], *, size_px: int
) -> tuple[Int64[Any, "*batch h w"], Int64[Any, "*batch h w"], Float[Any, "*batch 1 h w"]]:
    """Return the two pixels around a position, and its distance from the first one's centre."""
    xp = array_namespace(position_px)
    position = xp.clip(xp.where(inside, position_px, 0.5) - 0.5, 0.0, size_px - 1.0)
    low = xp.floor(position)
    low_index = xp.astype(low, xp.int64)
    high_index = xp.clip(low_index + 1, 0, size_px - 1)
    return low_index, high_index, (position - low)[..., None, :, :]
