"""Forward warping (splatting a source image into the target view) and backward warping.

Pixel (u, v) is column, row; the centre of the top-left pixel is (0.5, 0.5). Images are
channel-first, (..., c, h, w).
"""

import math
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int64, Shaped

from stereogenbench_data.geometry.arrays import (
    Array,
    array_namespace,
    leading_offsets,
    scatter_max,
    take_pixels,
)
from stereogenbench_data.geometry.projection import (
    Projection,
    image_starts,
    landing_pixels,
    lands_inside,
    row_blocks,
    row_starts,
    rows_of,
)

_INDEX_BITS: Final = 2**32 - 1
_NOTHING: Final = -(2**63)


def front_pixels(
    projection: Projection,
    *,
    measured: Bool[Any, "*batch h w"],
    landed: tuple[Bool[Any, "*batch h w"], Int64[Any, "*batch h w"]] | None = None,
) -> tuple[Int64[Any, "*batch h w"], Bool[Any, "*batch h w"]]:
    """Return which source pixel is in front at each target pixel, and where none landed.

    The target image has the source's size. The nearest point wins, and among equally near points
    the larger index, so the result is the same on every device. One pass does both: the bits of
    positive floats have the order of the floats, so the integer (-bits, index) is largest for the
    pixel in front.

    Args:
        projection: Where source pixels land.
        measured: Where source depth was measured.
        landed: What `landing_pixels` returns, if it is known.

    Returns:
        Flat indices into source maps (..., h, w), 0 where nothing landed; and the holes.
    """
    xp = array_namespace(projection.u_px)
    shape = projection.u_px.shape
    inside, pixel = landed or landing_pixels(projection, height_px=shape[-2], width_px=shape[-1])
    depth_m = xp.astype(projection.depth_m, xp.float32, copy=False)
    key = xp.astype(depth_m.view(xp.int32), xp.int64)
    key *= -(2**32)
    key += leading_offsets(shape, step=1, like=key)
    key = xp.where(inside & measured, key, _NOTHING)
    best = scatter_max(
        xp.reshape(key, (-1,)), xp.reshape(pixel, (-1,)), size=math.prod(shape), empty=_NOTHING
    )
    best = xp.reshape(best, shape)
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
    blocks = row_blocks(projection, height_px=image.shape[-2])
    if len(blocks) > 1:
        out, holes = np.empty(image.shape, dtype=image.dtype), np.empty(measured.shape, np.bool_)
        for rows in blocks:
            out[..., rows, :], holes[..., rows, :] = splat(
                image[..., rows, :], rows_of(projection, rows), measured=measured[..., rows, :]
            )
        return out, holes
    xp = array_namespace(image)
    front, hole = front_pixels(projection, measured=measured)
    warped = take_pixels(image, front)
    return xp.where(hole[..., None, :, :], xp.zeros_like(warped), warped), hole


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

    Raises:
        GeometryError: If a rectified projection's rows are not the image's.
    """
    xp = array_namespace(image)
    dtype = image.dtype if xp.isdtype(image.dtype, "real floating") else xp.float32
    blocks = row_blocks(projection, height_px=image.shape[-2])
    if len(blocks) > 1:
        shape = (*image.shape[:-1], projection.u_px.shape[-1])
        out, landed = np.empty(shape, dtype=dtype), np.empty(projection.u_px.shape, np.bool_)
        for rows in blocks:
            out[..., rows, :], landed[..., rows, :] = backward_warp(
                image[..., rows, :], rows_of(projection, rows)
            )
        return out, landed
    size = {"height_px": image.shape[-2], "width_px": image.shape[-1]}
    inside = lands_inside(projection, **size)
    left, right, to_right = _neighbours(projection.u_px, inside, size_px=size["width_px"])
    to_right = xp.astype(to_right, dtype, copy=False)

    def sample_rows(starts: Array) -> Array:
        here = xp.astype(take_pixels(image, starts + left), dtype, copy=False)
        there = xp.astype(take_pixels(image, starts + right), dtype, copy=False)
        return here + (there - here) * to_right

    if projection.v_px is None:
        warped = sample_rows(row_starts(projection, **size))
    else:
        upper, lower, down = _neighbours(projection.v_px, inside, size_px=size["height_px"])
        first = image_starts(projection, **size)
        above, below = (sample_rows(first + row * size["width_px"]) for row in (upper, lower))
        warped = above + (below - above) * xp.astype(down, dtype, copy=False)
    return xp.where(inside[..., None, :, :], warped, 0.0), inside


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
