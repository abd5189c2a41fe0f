"""Metrics of pixel values: PSNR and SSIM against the target, P-PSNR against the left picture.

P-PSNR asks how well each patch of the left picture is found again along its row in the right one.
"""

import math
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from numpy.lib.stride_tricks import sliding_window_view

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.models.loading import Picture, Settings
from stereogenbench_data.evaluation.models.opencv import require_opencv

_PEAK: Final = 255.0
_WINDOW_PX: Final = 11
_SIGMA_PX: Final = 1.5
_K1: Final = 0.01
_K2: Final = 0.03

PSNR_SETTINGS: Final[Settings] = {
    "data_range": _PEAK,
    "colour": "RGB, one mean squared error of all channels",
    "identical": "infinite; counted, not averaged",
}
SSIM_SETTINGS: Final[Settings] = {
    "data_range": _PEAK,
    "colour": "RGB, mean of the channels",
    "window_px": _WINDOW_PX,
    "window": "gaussian",
    "sigma_px": _SIGMA_PX,
    "k1": _K1,
    "k2": _K2,
    "covariance": "population",
    "border": "windows that lie wholly inside",
    "precision": "float64",
}


def psnr_db(predicted: Picture, target: Picture) -> float:
    """Return 10 log10(255^2 / mean squared error) of two uint8 RGB pictures (3, h, w), in dB.

    The squared error is summed in integers, so the result does not depend on the order.

    Returns:
        Infinity where the two are identical: count these, since an average of them says nothing.
    """
    error = predicted.astype(np.int32) - target
    squared = int(np.sum(error**2, dtype=np.int64))
    return 10 * math.log10(_PEAK * _PEAK * error.size / squared) if squared else math.inf


def ssim(predicted: Picture, target: Picture) -> float:
    """Return the structural similarity of two uint8 RGB pictures (3, h, w).

    11 x 11 Gaussian window of sigma 1.5, K = (0.01, 0.03), population covariance, mean over the
    windows that lie wholly inside, then over the channels. Equals skimage's structural_similarity
    with gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255.

    Raises:
        EvaluationError: If they are smaller than the window.
        ExtraError: If OpenCV is not installed.

    Source: Wang, Bovik, Sheikh & Simoncelli, IEEE TIP 13(4), 2004.
    """
    height, width = predicted.shape[1:]
    if min(height, width) < _WINDOW_PX:
        raise EvaluationError(
            f"SSIM needs pictures of at least {_WINDOW_PX}x{_WINDOW_PX} pixels, "
            f"got {width}x{height}."
        )
    cv2, inside = require_opencv(), slice(_WINDOW_PX // 2, -(_WINDOW_PX // 2))

    def means(values: Float64[np.ndarray, "h w 3"]) -> Float64[np.ndarray, "inner_h inner_w 3"]:
        """Return the Gaussian means of the windows that lie wholly inside."""
        filtered = cv2.sepFilter2D(values, -1, _KERNEL, _KERNEL)
        return np.asarray(filtered[inside, inside])

    x, y = (view.transpose(1, 2, 0).astype(np.float64, order="C") for view in (predicted, target))
    mean_x, mean_y = means(x), means(y)
    powers, product = mean_x**2 + mean_y**2, mean_x * mean_y
    # The variances are only needed as their sum, so four filters do.
    variances, covariance = means(x**2 + y**2) - powers, means(x * y) - product
    c1, c2 = (_K1 * _PEAK) ** 2, (_K2 * _PEAK) ** 2
    similar = (2 * product + c1) * (2 * covariance + c2) / ((powers + c1) * (variances + c2))
    return float(similar.mean())


_OFFSETS_PX: Final = np.arange(_WINDOW_PX) - _WINDOW_PX // 2
_WEIGHTS: Final = np.exp(-0.5 * (_OFFSETS_PX / _SIGMA_PX) ** 2)
_KERNEL: Final = np.asarray(_WEIGHTS / _WEIGHTS.sum())


_PATCH_PX: Final = 16
_LEAST_PX: Final = 2
_LARGEST_PX: Final = 48
_MSE_FLOOR: Final = 1 / 12
"""The error of rounding to whole numbers: 8-bit patches can show no smaller one."""

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


def patch_psnr(left: Picture, right: Picture) -> float:
    """Return the P-PSNR of a predicted right picture in dB; of the rendered target, its ceiling.

    Both are uint8 (3, h, w). Patches of 16 x 16 pixels stand side by side from the top left. What
    is left over at the right and at the bottom is not scored, nor is a patch all of whose
    candidates leave the picture. It is nan without patches.
    """
    squared = _least_squared_error(left, right).reshape(-1)
    if squared.size == 0:
        return math.nan
    mse = np.maximum(squared / (3 * _PATCH_PX**2), _MSE_FLOOR)
    return float(np.mean(10 * np.log10(_PEAK**2 / mse)))


def outside_window(disparity_px: Float[np.ndarray, "h w"], valid: Bool[np.ndarray, "h w"]) -> float:
    """Return the share of valid pixels whose true disparity P-PSNR does not search.

    Args:
        disparity_px: True disparity at the resolution that is scored.
        valid: Where it is known.

    Returns:
        Between 0 and 1; nan if nothing is valid.
    """
    known = disparity_px[valid]
    if len(known) == 0:
        return math.nan
    inside = (known >= _LEAST_PX) & (known <= _LARGEST_PX)
    return 1 - int(np.count_nonzero(inside)) / len(known)


def _least_squared_error(left: Picture, right: Picture) -> Int64[np.ndarray, "rows columns"]:
    """Return the summed squared error of each patch's best match.

    It is the sum of the squares less twice the products, and the products of a patch with all
    candidates are one matrix product, summed along diagonals. Values are centred on 128, so every
    partial sum is a whole number of at most 3 * 16^2 * 128^2 < 2^24: exact in float32, added up in
    any order.
    """
    rows, columns = left.shape[1] // _PATCH_PX, left.shape[2] // _PATCH_PX
    if rows == 0 or columns < 2:
        return np.empty((rows, 0), dtype=np.int64)
    patches = _strips(left, rows=rows, columns=columns, pad_px=0)
    candidates = _strips(right, rows=rows, columns=columns, pad_px=_LARGEST_PX)
    shifts = _LARGEST_PX - _LEAST_PX + 1
    # The product of each column of a patch with each column that may lie below it; a shift, the
    # furthest first, pairs them along a diagonal.
    reached = sliding_window_view(candidates, _PATCH_PX + shifts - 1, axis=2)[:, :, ::_PATCH_PX]
    by_column = np.matmul(
        patches.reshape(rows, -1, columns, _PATCH_PX).transpose(0, 2, 3, 1),
        reached[:, :, :columns].transpose(0, 2, 1, 3),
    )
    products = sum(by_column[:, :, x, x : x + shifts] for x in range(_PATCH_PX))
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
    """Return rows of patches; the values of a column are those of all channels together."""
    whole = picture[:, : rows * _PATCH_PX, : columns * _PATCH_PX]
    strips = np.zeros((rows, 3, _PATCH_PX, pad_px + whole.shape[2]), dtype=np.float32)
    split = whole.reshape(3, rows, _PATCH_PX, -1).swapaxes(0, 1)
    np.subtract(split, np.float32(128), out=strips[..., pad_px:])
    return strips.reshape(rows, 3 * _PATCH_PX, -1)
