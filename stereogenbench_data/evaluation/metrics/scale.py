"""SD: the factor by which a predicted pair's disparity misses the true one."""

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Bool, Float, Float64

from stereogenbench_data.evaluation.models.loading import Settings, StereoMatcher

FitMethod = Literal["filtered", "least_squares"]

_OUTLIER_SIGMAS: Final = 3.0
_OUTLIER_PX: Final = 1.0
_MAD_TO_SIGMA: Final = 1.4826
_FEWEST_PIXELS: Final = 100
_FEWEST_SHARE: Final = 0.01
_MEDIAN_PIXELS: Final = 20_000
"""About how many pixels, evenly spaced in reading order, the medians of a fit are taken of."""

SD_OF_THE_PAPER: Final = (
    "the paper fits after 'outlier and occlusion filtering' and does not state its rule for "
    "outliers. SD depends on that rule, by a factor of two and more where the matcher errs, so "
    "two fits are reported: 'SD filtered' leaves out outliers by this package's own rule, 'SD "
    "least squares' leaves out none. The paper's numbers stand in 'SD filtered', because the "
    "paper leaves outliers out; a difference as large as that of the two fits may be the rule's"
)
"""What to know when SD is compared with the paper's."""

FITS: Final[dict[FitMethod, str]] = {
    "filtered": "least squares without outliers: those farther from a median line (Theil's "
    f"incomplete method, of about {_MEDIAN_PIXELS} pixels) than {_OUTLIER_SIGMAS:g} robust "
    f"standard deviations and {_OUTLIER_PX:g} px",
    "least_squares": "least squares of all answered pixels",
}
"""The fits of SD: reports show both, because SD depends on the choice and the paper leaves it open.

The first stands beside the paper's numbers.
"""


@dataclass(frozen=True, slots=True)
class ScaleFit:
    """The line true = slope * estimated + offset through the disparities of one pair.

    Where there is no line, its numbers are nan.

    Attributes:
        drift: SD, |slope - 1|.
        slope: Below 1 where the predicted pair's disparity is too large.
        offset_px: True disparity where none is estimated.
        outliers: The share of the answered pixels that were left out of the fit.
        valid: The share of the picture's pixels that the line was fitted to.
        answered: The share of the scored pixels for which the matcher had an answer.
        residual_px: Root mean squared residual of the fitted pixels.
        r2: The share of the fitted pixels' true variance that the line explains.
    """

    drift: float = math.nan
    slope: float = math.nan
    offset_px: float = math.nan
    outliers: float = math.nan
    valid: float = 0.0
    answered: float = math.nan
    residual_px: float = math.nan
    r2: float = math.nan


def fit_scale(
    estimated_px: Float[np.ndarray, "h w"],
    true_px: Float[np.ndarray, "h w"],
    *,
    scored: Bool[np.ndarray, "h w"],
    method: FitMethod = "filtered",
) -> ScaleFit:
    """Return the line through true over estimated disparity, and SD.

    A random prediction has a slope near 0 and so an SD near 1. Twice the true disparity gives a
    slope of 0.5 and an SD of 0.5; half of it, a slope of 2 and an SD of 1. Errors of the matcher
    alone make the slope smaller, the more the less the disparity varies.

    Args:
        estimated_px: A matcher's disparity of (left, predicted right); nan where it has none.
        true_px: The true disparity at the same resolution.
        scored: Where the truth is known and the point is seen by both cameras.
        method: How to fit; `FITS` says what each does.
    """
    answered = np.flatnonzero(scored & np.isfinite(estimated_px) & np.isfinite(true_px))
    estimated, true = (
        values.reshape(-1)[answered].astype(np.float64) for values in (estimated_px, true_px)
    )
    wanted = int(np.count_nonzero(scored))
    kept = np.ones(true.size, dtype=bool)
    has_line = _has_line(estimated, wanted=wanted)
    if has_line and method == "filtered":
        some = slice(None, None, max(1, len(answered) // _MEDIAN_PIXELS))
        if estimated[some].min() == estimated[some].max():
            some = slice(None)
        slope, offset = _median_line(estimated[some], true[some])
        apart = np.abs(true - slope * estimated - offset)
        sigma = _MAD_TO_SIGMA * float(np.median(apart[some]))
        kept = apart <= max(_OUTLIER_SIGMAS * sigma, _OUTLIER_PX)
        has_line = _has_line(estimated[kept], wanted=wanted)
    share = estimated.size / wanted if wanted else math.nan
    if not has_line:
        return ScaleFit(answered=share)
    slope, offset = _least_squares(estimated[kept], true[kept])
    residual = (true - slope * estimated - offset)[kept]
    pixels = int(np.count_nonzero(kept))
    variance = float(np.var(true[kept]))
    mean_squared = float(np.mean(residual**2))
    return ScaleFit(
        drift=abs(slope - 1),
        slope=slope,
        offset_px=offset,
        outliers=(estimated.size - pixels) / estimated.size,
        valid=pixels / scored.size,
        answered=share,
        residual_px=math.sqrt(mean_squared),
        r2=1 - mean_squared / variance if variance else math.nan,
    )


def scale_settings(matcher: StereoMatcher) -> Settings:
    """Return every choice that SD depends on, and what each of its columns is."""
    return {
        "matcher": matcher.name,
        **{f"sd_{method}": what for method, what in FITS.items()},
        "paper": SD_OF_THE_PAPER,
        "occlusion": "pixels that the right camera does not see are not scored, by true depth",
        "direction": "true over estimated disparity",
        "fewest_pixels": _FEWEST_PIXELS,
        "fewest_share": _FEWEST_SHARE,
        **matcher.settings,
    }


def _has_line(estimated: Float64[np.ndarray, " n"], *, wanted: int) -> bool:
    """Return whether a line can be fitted.

    A matcher answers few pixels of unlike pictures, and a line through those can have any slope.
    """
    enough = max(_FEWEST_PIXELS, _FEWEST_SHARE * wanted)
    return estimated.size >= enough and bool(estimated.min() < estimated.max())


def _least_squares(
    estimated: Float64[np.ndarray, " n"], true: Float64[np.ndarray, " n"]
) -> tuple[float, float]:
    """Return slope and offset; centred first, so that a common offset costs no digits.

    Summed by numpy, not as a scalar product: that would depend on the number of threads.
    """
    mean_estimated, mean_true = estimated.mean(), true.mean()
    centred = estimated - mean_estimated
    slope = float(np.sum(centred * (true - mean_true)) / np.sum(centred**2))
    return slope, float(mean_true - slope * mean_estimated)


def _median_line(
    estimated: Float64[np.ndarray, " n"], true: Float64[np.ndarray, " n"]
) -> tuple[float, float]:
    """Return slope and offset by medians.

    Pixels are sorted by their estimate, and each of the lower half is paired with the one half of
    all pixels further on. The slope is the median of the slopes of these pairs.
    """
    order = np.argsort(estimated, kind="stable")
    half = estimated.size // 2
    low, high = order[:half], order[-half:]
    run = estimated[high] - estimated[low]
    apart = run > 0
    if not apart.any():
        return _least_squares(estimated, true)
    slope = float(np.median((true[high] - true[low])[apart] / run[apart]))
    return slope, float(np.median(true - slope * estimated))
