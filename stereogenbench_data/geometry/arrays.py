"""Array operations that numpy and torch spell differently.

All functions take and return arrays of either library. The rest of the layer is written once,
against the array API standard. The arrays of one call must be of one library and on one device.
"""

import math
from typing import Any, Literal

import numpy as np

Array = Any
"""A numpy array or a torch tensor; jaxtyping checks its shape and dtype under test."""


def is_numpy_array(values: Array) -> bool:
    """Return whether an array is one of numpy's."""
    return isinstance(values, (np.ndarray, np.generic))


def array_namespace(values: Array) -> Any:
    """Return the functions of the array API standard for the library of an array."""
    if is_numpy_array(values):
        from array_api_compat import numpy

        return numpy
    from array_api_compat import torch

    return torch


def pixel_centres(like: Array, *, dtype: Any) -> tuple[Array, Array]:
    """Return u (w,) and v (h, 1) of the pixel centres of maps shaped (..., h, w)."""
    xp = array_namespace(like)
    height, width = like.shape[-2:]
    place = {"dtype": dtype, "device": like.device}
    return xp.arange(width, **place) + 0.5, (xp.arange(height, **place) + 0.5)[:, None]


def as_float64(values: Array) -> Array:
    """Return an array's values as float64."""
    xp = array_namespace(values)
    return xp.astype(values, xp.float64, copy=False)


def quotient(number: float | Array, divisor: Array) -> Array:
    """Return number / divisor, rounded once; torch would multiply by the rounded reciprocal."""
    xp = array_namespace(divisor)
    return xp.asarray(number, dtype=divisor.dtype, device=divisor.device) / divisor


def whole_where(mask: Array, values: Array) -> Array:
    """Return values rounded towards 0 as int64, and 0 where the mask is False.

    Where it is True, values must be below 2 ** 31: two conversions by way of int32 are faster than
    one to int64.
    """
    xp = array_namespace(values)
    if is_numpy_array(values):
        with np.errstate(invalid="ignore"):
            whole = values.astype(np.int32)
    else:
        whole = xp.astype(values, xp.int32)
    whole *= mask
    return xp.astype(whole, xp.int64)


def values_where(mask: Array, values: Array, *, otherwise: float) -> Array:
    """Return ``xp.where(mask, values, otherwise)``; maybe ``values`` itself if all are kept.

    With numpy, copying and then overwriting runs is up to three times as fast as ``where``.
    """
    xp = array_namespace(values)
    if not is_numpy_array(values):
        return xp.where(mask, values, otherwise)
    if mask.all():
        return values
    chosen = values.copy()
    np.copyto(chosen, otherwise, where=~mask)
    return chosen


def take_flat(values: Array, index: Array) -> Array:
    """Return ``values`` (any shape, read in row-major order) at ``index``, in the index's shape.

    The index must be in range: the fastest mode of numpy does not check it.
    """
    if is_numpy_array(values):
        return np.take(values.reshape(-1), index, mode="wrap")
    # array_api_compat's take first looks for negative numbers, in three passes.
    return values.reshape(-1).index_select(0, index.reshape(-1)).reshape(index.shape)


def take_pixels(image: Array, index: Array) -> Array:
    """Return (..., c, rows, columns) of an image (..., c, h, w) at an index (..., rows, columns).

    The index counts pixels of flattened maps (..., h, w), so it serves all channels.
    """
    xp = array_namespace(image)
    channels = image.shape[-3]
    flat = xp.reshape(xp.moveaxis(image, -3, 0), (channels, -1))
    places = xp.reshape(index, (-1,))
    if is_numpy_array(image):
        taken = xp.take(flat, places, axis=1)
    else:
        # Seven times as fast as index_select along the second axis.
        taken = flat.gather(1, places.expand(channels, -1))
    return xp.moveaxis(xp.reshape(taken, (channels, *index.shape)), 0, -3)


def scatter(
    values: Array, index: Array, *, size: int, reduce: Literal["amax", "amin"], empty: float | int
) -> Array:
    """Return ``size`` cells with the largest or smallest of the values that ``index`` sends there.

    Cells without a value are ``empty``, which must be beyond all values. The result does not depend
    on the order in which cells are written.
    """
    xp = array_namespace(values)
    cells = xp.full((size,), empty, dtype=values.dtype, device=values.device)
    values, index = xp.reshape(values, (-1,)), xp.reshape(index, (-1,))
    if not is_numpy_array(values):
        return cells.scatter_reduce(0, index, values, reduce=reduce)
    (np.maximum if reduce == "amax" else np.minimum).at(cells, index, values)
    return cells


def leading_offsets(shape: tuple[int, ...], *, step: int, like: Array) -> Array:
    """Return 0, step, 2 step ... for each index of ``shape``, int64, on the device of ``like``."""
    xp = array_namespace(like)
    offsets = xp.arange(math.prod(shape), dtype=xp.int64, device=like.device)
    return xp.reshape(offsets * step, shape)
