"""PSNR and SSIM of one picture against its target."""

import math
from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.pictures import require_opencv, require_pictures
from stereogenbench_data.evaluation.protocols import Picture, Settings

_PEAK: Final = 255.0
_WINDOW_PX: Final = 11
_SIGMA_PX: Final = 1.5
_K1: Final = 0.01
_K2: Final = 0.03
_BAND_ROWS: Final = 64
"""How many rows of windows are worked on at once: so many that they stay in the cache."""

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

    The squared error is summed in integers, so the result does not depend on an order.

    Returns:
        Infinity where the two are identical: count these, an average of them says nothing.

    Raises:
        EvaluationError: If they are no pictures of one size.
    """
    require_pictures(predicted, target)
    error = predicted.astype(np.int32)
    error -= target
    flat = error.reshape(-1)
    np.multiply(flat, flat, out=flat)
    squared = int(flat.sum(dtype=np.int64))
    return 10 * math.log10(_PEAK * _PEAK * flat.size / squared) if squared else math.inf


def ssim(predicted: Picture, target: Picture) -> float:
    """Return the structural similarity of two uint8 RGB pictures (3, h, w).

    11 x 11 Gaussian window of sigma 1.5, K = (0.01, 0.03), population covariance, mean over the
    windows that lie wholly inside, then over the channels. What skimage's structural_similarity
    gives with gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=255.

    Raises:
        EvaluationError: If they are no pictures of one size, or smaller than the window.
        ExtraError: If OpenCV is not installed.

    Source: Wang, Bovik, Sheikh & Simoncelli, IEEE TIP 13(4), 2004.
    """
    require_pictures(predicted, target)
    height, width = predicted.shape[1:]
    if min(height, width) < _WINDOW_PX:
        raise EvaluationError(
            f"SSIM needs pictures of at least {_WINDOW_PX}x{_WINDOW_PX} pixels, "
            f"got {width}x{height}."
        )
    cv2 = require_opencv()
    rows, columns = int(height) - _WINDOW_PX + 1, int(width) - _WINDOW_PX + 1
    bands = [
        slice(top, min(top + _BAND_ROWS, rows) + _WINDOW_PX - 1)
        for top in range(0, rows, _BAND_ROWS)
    ]
    sums = (
        _summed_ssim(cv2, x[band], y[band])
        for x, y in zip(predicted, target, strict=True)
        for band in bands
    )
    return math.fsum(sums) / (len(predicted) * rows * columns)


def _summed_ssim(cv2: Any, x8: Any, y8: Any) -> float:
    """Return the sum of the SSIM of all windows inside a part of one channel.

    The variances are only needed as their sum, so four filters do: of x, y, xx + yy and xy.
    """
    x, y = x8.astype(np.float64), y8.astype(np.float64)
    mean_x, mean_y = _filtered(cv2, x), _filtered(cv2, y)
    products = x * y
    x *= x
    y *= y
    x += y
    means = mean_x * mean_y
    covariance = _filtered(cv2, products)
    covariance -= means
    mean_x *= mean_x
    mean_y *= mean_y
    mean_x += mean_y
    variances = _filtered(cv2, x)
    variances -= mean_x
    c1, c2 = (_K1 * _PEAK) ** 2, (_K2 * _PEAK) ** 2
    similar = (2 * means + c1) * (2 * covariance + c2)
    similar /= (mean_x + c1) * (variances + c2)
    return float(similar.sum())


def _filtered(cv2: Any, values: Float64[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
    """Return the Gaussian means of the windows that lie wholly inside."""
    inside = slice(_WINDOW_PX // 2, -(_WINDOW_PX // 2))
    filtered = cv2.sepFilter2D(values, -1, _KERNEL, _KERNEL)
    return np.asarray(filtered[inside, inside])


def _gaussian() -> Float64[np.ndarray, " window"]:
    offsets = np.arange(_WINDOW_PX) - _WINDOW_PX // 2
    weights = np.exp(-0.5 * (offsets / _SIGMA_PX) ** 2)
    return np.asarray(weights / weights.sum())


_KERNEL: Final = _gaussian()
