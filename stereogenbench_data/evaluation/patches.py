"""P-PSNR: how well each patch of the left picture is found again along its row in the right one."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int64
from numpy.lib.stride_tricks import as_strided

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.pictures import require_pictures
from stereogenbench_data.evaluation.protocols import Picture, Settings

_PATCH_PX: Final = 16
_LEAST_PX: Final = 2
_LARGEST_PX: Final = 48
_PEAK: Final = 255.0
_MSE_FLOOR: Final = 1 / 12
"""The error of rounding to whole numbers: two 8-bit patches cannot be told to be closer."""

PATCH_SETTINGS: Final[Settings] = {
    "patch_px": _PATCH_PX,
    "stride_px": _PATCH_PX,
    "least_disparity_px": _LEAST_PX,
    "largest_disparity_px": _LARGEST_PX,
    "candidates": "left patch at x against right patch at x - d, for d of at most x",
    "colour": "RGB, one mean squared error of all channels",
    "data_range": _PEAK,
    "mse_floor": _MSE_FLOOR,
    "aggregation": "mean over patches of the dB of the best match",
}


@dataclass(frozen=True, slots=True)
class PatchScore:
    """P-PSNR of one pair.

    Attributes:
        mean_db: Mean over the patches of the PSNR of their best match; nan without patches.
        pooled_db: PSNR of the mean squared error of all patches' best matches.
        patches: How many patches have a candidate.
        floored: Of how many the squared error was raised to the floor.
    """

    mean_db: float
    pooled_db: float
    patches: int
    floored: int


def patch_psnr(left: Picture, right: Picture) -> PatchScore:
    """Return the P-PSNR of a predicted right picture; of the rendered target, its ceiling.

    Patches of 16 x 16 pixels stand side by side from the top left; what is left over at the
    right and at the bottom is not scored, nor are patches that no candidate lies inside of the
    picture for.

    Args:
        left: The left picture (3, h, w).
        right: The right picture of the same size.

    Raises:
        EvaluationError: If they are no pictures of one size.
    """
    require_pictures(left, right)
    squared = _least_squared_error(left, right).reshape(-1)
    if squared.size == 0:
        return PatchScore(mean_db=float("nan"), pooled_db=float("nan"), patches=0, floored=0)
    mse = squared / (3 * _PATCH_PX**2)
    floored = np.maximum(mse, _MSE_FLOOR)
    return PatchScore(
        mean_db=float(np.mean(10 * np.log10(_PEAK**2 / floored))),
        pooled_db=float(10 * np.log10(_PEAK**2 / np.mean(floored))),
        patches=squared.size,
        floored=int(np.count_nonzero(mse < _MSE_FLOOR)),
    )


def outside_window(disparity_px: Float[np.ndarray, "h w"], valid: Bool[np.ndarray, "h w"]) -> float:
    """Return the share of valid pixels whose true disparity P-PSNR does not search.

    Args:
        disparity_px: True disparity at the resolution that is scored.
        valid: Where it is known.

    Returns:
        Between 0 and 1; nan if nothing is valid.

    Raises:
        EvaluationError: If the maps are of different sizes.
    """
    if disparity_px.shape != valid.shape:
        raise EvaluationError(
            f"disparity is of shape {disparity_px.shape}, but its valid map of {valid.shape}."
        )
    known = disparity_px[valid]
    if len(known) == 0:
        return float("nan")
    inside = (known >= _LEAST_PX) & (known <= _LARGEST_PX)
    return 1 - int(np.count_nonzero(inside)) / len(known)


def _least_squared_error(left: Picture, right: Picture) -> Int64[np.ndarray, "rows columns"]:
    """Return the summed squared error of each patch's best match.

    The sum is that of the squares less twice the products, and the products of a patch with all
    candidates are one matrix product summed along diagonals. Values are centred on 128, so that
    every partial sum is a whole number of at most 3 * 16^2 * 128^2 < 2^24: exact in float32, in
    whatever order it is added up.
    """
    rows, columns = left.shape[1] // _PATCH_PX, left.shape[2] // _PATCH_PX
    if rows == 0 or columns < 2:
        return np.empty((rows, 0), dtype=np.int64)
    patches = _strips(left, rows=rows, columns=columns, pad_px=0)
    candidates = _strips(right, rows=rows, columns=columns, pad_px=_LARGEST_PX)
    shifts = _LARGEST_PX - _LEAST_PX + 1
    products = _products(patches, candidates, columns=columns, shifts=shifts)
    own = np.sum(patches**2, axis=1).reshape(rows, columns, _PATCH_PX).sum(axis=2)
    summed = np.zeros((rows, candidates.shape[2] + 1))
    np.cumsum(np.sum(candidates**2, axis=1), axis=1, dtype=np.float64, out=summed[:, 1:])
    boxes = summed[:, _PATCH_PX:] - summed[:, :-_PATCH_PX]
    starts = np.arange(columns)[:, None] * _PATCH_PX + np.arange(shifts)
    squared = own[..., None] + boxes[:, starts] - 2.0 * products
    squared[:, starts < _LARGEST_PX] = np.inf
    return np.asarray(squared[:, 1:].min(axis=2), dtype=np.int64)


def _strips(
    picture: Picture, *, rows: int, columns: int, pad_px: int
) -> Float[np.ndarray, "rows values width"]:
    """Return rows of patches, each with the values of a column of all channels together."""
    whole = picture[:, : rows * _PATCH_PX, : columns * _PATCH_PX]
    strips = np.zeros((rows, 3, _PATCH_PX, pad_px + whole.shape[2]), dtype=np.float32)
    split = whole.reshape(3, rows, _PATCH_PX, -1).swapaxes(0, 1)
    np.subtract(split, np.float32(128), out=strips[..., pad_px:])
    return strips.reshape(rows, 3 * _PATCH_PX, -1)


def _products(
    patches: Float[np.ndarray, "rows values width"],
    candidates: Float[np.ndarray, "rows values padded"],
    *,
    columns: int,
    shifts: int,
) -> Float[np.ndarray, "rows columns shifts"]:
    """Return the scalar product of each patch with the candidates, the furthest shift first."""
    rows, values, _ = patches.shape
    reach = _PATCH_PX + shifts - 1
    size = patches.itemsize
    theirs = as_strided(
        candidates,
        (rows, columns, values, reach),
        (candidates.strides[0], _PATCH_PX * size, candidates.strides[1], size),
        writeable=False,
    )
    ours = patches.reshape(rows, values, columns, _PATCH_PX).transpose(0, 2, 3, 1)
    by_column = np.matmul(ours, theirs)
    diagonals = as_strided(
        by_column,
        (rows, columns, shifts, _PATCH_PX),
        (*by_column.strides[:2], size, by_column.strides[2] + size),
        writeable=False,
    )
    return np.asarray(diagonals.sum(axis=3))
