"""Depth to disparity and back, and the error of disparity due to the rounding of stored depth.

A point at depth z along the optical axis moves by d = u_source - u_target = B fx / z pixels
between two rectified cameras. B, the baseline in metres, is positive for a target to the right
of the source and negative for one to the left; d takes its sign. Pixels are those of the image
that focal_px is for. In a depth map inf is sky; 0, nan and negative values are "not measured". The
disparity of all of these is 0, so a disparity map needs the mask of measured pixels beside it.
"""

import math
from functools import lru_cache
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Integer

from stereogenbench_data.geometry.arrays import (
    array_namespace,
    as_float64,
    pixel_centres,
    quotient,
)
from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.schema.records import DepthForm

_EXACT_FACTORS: Final = (128.0, 256.0)
"""From the first to below the second: whole numbers whose product with a 16-bit number is exact in
the 24 bits of float32. Smaller ones are these divided by a power of two, and round in the same way.
"""

_BLOCK_PIXELS: Final = 128 * 1024
"""How many pixels of a disparity map stay in a processor's cache from one step to the next."""

_NEARLY_EXACT: Final = 2.0**-29
"""A relative error that is at most 1/32 ulp of a float32."""


def disparity_from_depth(
    depth_m: Float[Any, "*batch h w"], *, focal_px: float, baseline_m: float
) -> Float[Any, "*batch h w"]:
    """Return how far left each source pixel moves in the target image, in pixels.

    Args:
        depth_m: Depth along the optical axis (not the length of the ray), in metres.
        focal_px: Horizontal focal length in pixels of this image: rescale it with the image.
        baseline_m: Signed baseline in metres, positive for a target to the right.

    Returns:
        Disparity in pixels, in the depth's dtype, rounded once from the float64 result;
        0 for sky and where depth was not measured.

    Source: Szeliski, Computer Vision: Algorithms and Applications, 2nd ed., ch. 12.

    >>> disparity_from_depth(np.array([[2.0, np.inf, 0.0]]), focal_px=800.0, baseline_m=0.1)
    array([[40.,  0.,  0.]])
    """
    xp = array_namespace(depth_m)
    disparity_px = quotient(focal_px * baseline_m, as_float64(_inf_where_not_positive(depth_m)))
    return xp.astype(disparity_px, depth_m.dtype, copy=False)


def disparity_from_shifts(
    stored: Float64[Any, "*batch h w"],
    shift_units: Float64[Any, "*rigs"],
    *,
    form: DepthForm = "depth",
) -> Float32[Any, "*batch h w"]:
    """Return the disparity in pixels of stored 16-bit depth of several rigs, without a depth map.

    The result is within 0.55 ulp of the float64 one: the shift is multiplied by the j in 128..255
    that brings the product nearest to a float32, and units * j is exact. If no j brings it near
    enough, the float64 result is rounded. The quotient is computed in float64, which has digits
    enough that rounding it to float32 is rounding the exact quotient: `write_disparity` gives the
    same, bit for bit.

    Args:
        stored: Stored numbers below 2 ** 16; with ``form="depth"``, inf instead of 0.
        shift_units: Focal length in pixels times signed baseline, divided by metres in a stored
            unit; with ``form="inverse"``, by the depth of the number 1. Its shape is broadcast to
            the maps'.
        form: Whether a stored number is proportional to depth or to its inverse.

    Returns:
        Disparity in pixels, 0 where the stored number is 0.
    """
    xp = array_namespace(stored)
    if form == "inverse":
        return xp.astype(stored * shift_units, xp.float32)
    product, factor, is_exact = _exact_quotients(shift_units)
    product, factor = xp.where(is_exact, product, shift_units), xp.where(is_exact, factor, 1.0)
    return xp.astype(product / (stored * factor), xp.float32)


def write_disparity(
    out: Float32[np.ndarray, "*batch h w"],
    units: Integer[np.ndarray, "*batch h w"],
    *,
    measured: Bool[np.ndarray, "*batch h w"],
    shift_units: float,
    form: DepthForm = "depth",
) -> None:
    """Write what `disparity_from_shifts` gives for one rig, and 0 where depth was not measured.

    It is computed at float32's speed where a j brings the product near enough. A few rows at a time
    go through all steps, so that they stay in the processor's cache.

    Args:
        out: The array to write disparity in pixels to.
        units: Stored numbers.
        measured: Where depth was measured; with ``form="depth"`` it must be False where the stored
            number is 0.
        shift_units: Focal length in pixels times signed baseline, divided by metres in a stored
            unit.
        form: Whether a stored number is proportional to depth or to its inverse.
    """
    product, factor, dtype = _exact_quotient(shift_units)
    dtype = "float64" if form == "inverse" else dtype
    rows = max(1, _BLOCK_PIXELS // max(1, out.shape[-1]))
    blocks = [slice(top, top + rows) for top in range(0, out.shape[-2], rows)]
    with np.errstate(divide="ignore"):
        for here in ((*place, block) for place in np.ndindex(out.shape[:-2]) for block in blocks):
            found, known = out[here], measured[here]
            # New memory costs as much as a step: float32 is computed in place.
            work = found if dtype == "float32" else np.empty(found.shape, dtype=dtype)
            np.copyto(work, units[here])
            if form == "inverse":
                np.multiply(work, shift_units, out=work)
            else:
                np.multiply(work, work.dtype.type(factor), out=work)
                np.divide(work.dtype.type(product), work, out=work)
            if work is not found:
                np.copyto(found, work, casting="same_kind")
            if not known.all():
                np.copyto(found, 0, where=~known)


@lru_cache(maxsize=1024)
def _exact_quotient(shift_units: float) -> tuple[float, float, Literal["float32", "float64"]]:
    """Return product, factor and dtype with shift / units = product / (units * factor)."""
    product, factor, is_exact = _exact_quotients(np.array(shift_units))
    if is_exact:
        return float(product), float(factor), "float32"
    return shift_units, 1.0, "float64"


def _exact_quotients(
    shift_units: Float64[Any, "*rigs"],
) -> tuple[Float64[Any, "*rigs"], Float64[Any, "*rigs"], Bool[Any, "*rigs"]]:
    """Return the float32 product and the factor of `_exact_quotient`, and whether they will do."""
    xp = array_namespace(shift_units)
    # Made where they are used: a copy to a GPU would wait for all that is queued there.
    factors = xp.arange(*_EXACT_FACTORS, dtype=xp.float64, device=shift_units.device)
    products = shift_units[..., None] * factors
    rounded = as_float64(xp.astype(products, xp.float32))
    misses = xp.abs(rounded / products - 1.0)
    best = xp.argmin(misses, axis=-1)
    chosen = factors - _EXACT_FACTORS[0] == best[..., None]
    product, factor, miss = (
        xp.sum(xp.where(chosen, values, 0.0), axis=-1) for values in (rounded, factors, misses)
    )
    return product, factor, miss <= _NEARLY_EXACT


def disparity_error_px(
    depth_m: Float[Any, "*batch h w"],
    *,
    shift_px_m: float | Float[Any, "*#batch h1 w1"],
    half_step_m: float | Float[Any, "*#batch h1 w1"],
) -> Float[Any, "*batch h w"]:
    """Return the largest error of disparity due to the steps in which depth is stored.

    True depth lies within half a step of the stored one, so disparity is off by at most
    |d| (q / 2) / (z - q / 2). The bound also covers the rounding of depth and disparity to
    the map's dtype (2 eps of |d|), which matters where steps are fine and depth is large.

    Args:
        depth_m: Stored depth along the optical axis, in metres.
        shift_px_m: Focal length in pixels of this image times baseline in metres, not negative: one
            number, or one of each rig in the depth's dtype.
        half_step_m: Half the step q between neighbouring depths in metres, likewise; 0 for exact
            depth.

    Returns:
        The bound in pixels, never negative, in the depth's dtype: inf where depth is half a
        step or less (the true depth may be arbitrarily small), 0 for sky and where depth was
        not measured.

    >>> depth_m = np.array([[10.0, np.inf, 0.0]])
    >>> disparity_error_px(depth_m, shift_px_m=80.0, half_step_m=0.05).round(4)
    array([[0.0402, 0.    , 0.    ]])
    """
    xp = array_namespace(depth_m)
    eps = float(xp.finfo(depth_m.dtype).eps)
    stored_m = _inf_where_not_positive(depth_m)
    nearest_m = stored_m * (1.0 - 2.0 * eps) - half_step_m
    relative = quotient(half_step_m, stored_m) + 2.0 * eps
    bounded = nearest_m > 0
    bound_px = shift_px_m * relative / xp.where(bounded, nearest_m, 1.0)
    return xp.where(bounded, bound_px, math.inf)


def planar_from_ray(
    ray_m: Float[Any, "*batch h w"], intrinsics: Intrinsics
) -> Float[Any, "*batch h w"]:
    """Return depth along the optical axis from distances to the camera's centre, both in metres.

    The intrinsics are those of an image of this size.

    Source: Roberts et al., Hypersim, 2021, whose depth_meters is the length of the ray.
    """
    return ray_m / ray_per_planar(
        ray_m,
        focal_px=(intrinsics.fx_px, intrinsics.fy_px),
        centre_px=(intrinsics.cx_px, intrinsics.cy_px),
    )


def ray_per_planar(
    like: Float[Any, "*batch h w"], *, focal_px: tuple[Any, Any], centre_px: tuple[Any, Any]
) -> Float[Any, "..."]:
    """Return |(x, y, 1)| of the ray through each pixel's centre, in the dtype of ``like``.

    Args:
        like: Maps of that size.
        focal_px: fx and fy in pixels; float64 arrays, to be broadcast to the maps, or floats.
        centre_px: cx and cy, likewise.
    """
    xp = array_namespace(like)
    u_px, v_px = pixel_centres(like, dtype=xp.float64)
    x = (u_px - centre_px[0]) / focal_px[0]
    y = (v_px - centre_px[1]) / focal_px[1]
    return xp.astype(xp.sqrt(x * x + (y * y + 1.0)), like.dtype, copy=False)


def _inf_where_not_positive(values: Float[Any, "*batch h w"]) -> Float[Any, "*batch h w"]:
    xp = array_namespace(values)
    return xp.where(values > 0, values, math.inf)
