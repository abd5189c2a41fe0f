"""Disparity seen in two rectified pictures, with no depth in it: correlation along each row.

Every pixel of a row is compared with every pixel of the same row of the other picture, so there is
no range to be told and no near optimum to lock to, whatever the depth claims. What is found in
both directions is kept. numpy alone does it: a row's comparisons are one product of matrices.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float32, Int64
from numpy.lib.stride_tricks import sliding_window_view

_WIDEST_PX: Final = 512
_ROWS: Final = 64
_RADIUS_PX: Final = 4
_LEAST_CORRELATION: Final = 0.75
_LEAST_LEAD: Final = 0.04
"""How much better than the second best place, more than `_NEAR_PX` away, a match must be."""
_NEAR_PX: Final = 3
_LEAST_SLOPE: Final = 2.0
"""Root mean square of the horizontal slope in a patch, in grey levels a pixel: texture."""
_BLOCK: Final = 2**18
"""Multiplications in one product of matrices. BLAS starts threads for more; in several processes
on a busy machine they wait for one another (25 times slower, measured)."""

Luma = Float32[np.ndarray, "h w"]


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Pixels of a left picture that were found again in the right one.

    Attributes:
        rows: (n,) rows.
        columns: (n,) columns.
        disparity_px: (n,) how far to the left each was found, negative for to the right.
        textured: How many pixels were looked for.
        grain_px: Size of the pixels that were compared.
    """

    rows: Int64[np.ndarray, " n"]
    columns: Int64[np.ndarray, " n"]
    disparity_px: Float32[np.ndarray, " n"]
    textured: int
    grain_px: float = 1.0


def match_rows(left: Luma, right: Luma) -> Matches:
    """Return what a left picture has in common with the right one of a rectified pair.

    Large pictures are matched at 512 columns or fewer, and then disparity is good to half a pixel
    of the full size; else to about 0.2 pixels.

    Args:
        left: (h, w) grey levels.
        right: (h, w) grey levels of the other view, rows aligned.
    """
    factor = -(-left.shape[1] // _WIDEST_PX)
    small_left, small_right = (_reduced(picture, factor=factor) for picture in (left, right))
    height = small_left.shape[0]
    if min(small_left.shape) <= 2 * _RADIUS_PX:
        return _gathered([], factor=factor, textured=0)
    inner = np.arange(_RADIUS_PX, height - _RADIUS_PX)
    rows = inner[np.unique(np.linspace(0, len(inner) - 1, min(_ROWS, len(inner))).astype(int))]
    found, textured = [], 0
    for row in rows:
        here, is_textured = _patches(small_left, row)
        there, _ = _patches(small_right, row)
        textured += int(is_textured.sum())
        columns, disparity_px = _match_row(_product(here, there), is_textured)
        found.append((np.full(len(columns), row), columns + _RADIUS_PX, disparity_px))
    return _gathered(found, factor=factor, textured=textured)


def _reduced(picture: Luma, *, factor: int) -> Luma:
    """Return the means of blocks of factor x factor pixels."""
    height, width = (side // factor * factor for side in picture.shape)
    blocks = picture[:height, :width].reshape(height // factor, factor, width // factor, factor)
    reduced: Luma = blocks.mean(axis=(1, 3), dtype=np.float32)
    return reduced


def _patches(picture: Luma, row: int) -> tuple[Float32[np.ndarray, "columns pixels"], np.ndarray]:
    """Return the normalised patches of a row's inner columns, and which of them have texture."""
    band = picture[row - _RADIUS_PX : row + _RADIUS_PX + 1]
    side = 2 * _RADIUS_PX + 1
    windows = sliding_window_view(band, (side, side))[0]
    slopes = np.diff(windows, axis=-1)
    textured = np.sqrt((slopes**2).mean(axis=(1, 2))) >= _LEAST_SLOPE
    flat = windows.reshape(len(windows), -1)
    flat = flat - flat.mean(axis=1, keepdims=True)
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    return flat / np.maximum(length, 1e-3), textured


def _product(
    here: Float32[np.ndarray, "left pixels"], there: Float32[np.ndarray, "right pixels"]
) -> Float32[np.ndarray, "left right"]:
    """Return here @ there.T, a few rows at a time."""
    few = max(1, _BLOCK // there.size)
    product = np.empty((len(here), len(there)), dtype=np.float32)
    for start in range(0, len(here), few):
        np.matmul(here[start : start + few], there.T, out=product[start : start + few])
    return product


def _match_row(
    correlation: Float32[np.ndarray, "left right"], textured: np.ndarray
) -> tuple[Int64[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
    """Return the columns that match one place well, alone and both ways, and their disparity."""
    width = correlation.shape[1]
    columns = np.flatnonzero(textured)
    scores = correlation[columns]
    best = scores.argmax(axis=1)
    top = scores.max(axis=1, initial=-1.0)
    back = correlation.argmax(axis=0)[best]
    near = np.abs(np.arange(width) - best[:, None]) <= _NEAR_PX
    second = np.where(near, -1.0, scores).max(axis=1, initial=-1.0)
    keep = (top >= _LEAST_CORRELATION) & (top - second >= _LEAST_LEAD)
    keep &= (np.abs(back - columns) <= 1) & (best > 0) & (best < width - 1)
    columns, best, scores = columns[keep], best[keep], scores[keep]
    each = np.arange(len(best))
    before, peak, after = (scores[each, best + step] for step in (-1, 0, 1))
    curvature = before - 2 * peak + after
    shift = np.where(curvature < 0, (before - after) / np.where(curvature < 0, 2 * curvature, 1), 0)
    return columns, (columns - best - np.clip(shift, -0.5, 0.5)).astype(np.float32)


def _gathered(
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]], *, factor: int, textured: int
) -> Matches:
    """Put rows together and return to the full size, where a block's centre is a pixel or near."""
    empty = (np.zeros(0, int), np.zeros(0, int), np.zeros(0, np.float32))
    rows, columns, disparity_px = (
        np.concatenate(part) for part in zip(*[empty, *found], strict=True)
    )
    return Matches(
        rows=rows.astype(np.int64) * factor + factor // 2,
        columns=columns.astype(np.int64) * factor + factor // 2,
        disparity_px=(disparity_px * factor).astype(np.float32),
        textured=textured,
        grain_px=float(factor),
    )
