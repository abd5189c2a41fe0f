"""SD: the factor by which a predicted pair's disparity misses the true one."""

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from jaxtyping import Bool, Float, Float64

from stereogenbench_data.evaluation.models.loading import (
    Range,
    Settings,
    StereoMatcher,
    range_of,
)

FitMethod = Literal["filtered", "least_squares"]

_OUTLIER_SIGMAS: Final = 3.0
_OUTLIER_PX: Final = 1.0
_MAD_TO_SIGMA: Final = 1.4826
_FEWEST_PIXELS: Final = 100
_FEWEST_SHARE: Final = 0.01
_FEWEST_IN_RANGE: Final = 0.5
LEAST_R2: Final = 0.1
"""The share of variance below which a line says nothing: its slope, and so SD, may be any."""
_MEDIAN_PIXELS: Final = 20_000
"""About how many pixels, evenly spaced in reading order, the medians of a fit are taken of."""

FITS: Final[dict[FitMethod, str]] = {
    "filtered": "least squares without outliers: those farther from a median line (Theil's "
    f"incomplete method, of about {_MEDIAN_PIXELS} pixels) than {_OUTLIER_SIGMAS:g} robust "
    f"standard deviations and {_OUTLIER_PX:g} px",
    "least_squares": "least squares of all answered pixels",
}
"""The fits of SD: reports show both, because SD depends on the choice and the paper leaves it open.

The first is the one to compare with the paper's numbers.
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
        answered: The share of the scored pixels within the matcher's range for which it had an
            answer.
        beyond: The share of the scored pixels whose true disparity the matcher cannot find, and
            which are left out.
        residual_px: Root mean squared residual of the fitted pixels.
        r2: The share of the fitted pixels' true variance that the line explains.
    """

    drift: float = math.nan
    slope: float = math.nan
    offset_px: float = math.nan
    outliers: float = math.nan
    valid: float = 0.0
    answered: float = math.nan
    beyond: float = math.nan
    residual_px: float = math.nan
    r2: float = math.nan


def fit_scale(
    estimated_px: Float[np.ndarray, "h w"],
    true_px: Float[np.ndarray, "h w"],
    *,
    scored: Bool[np.ndarray, "h w"],
    range_px: Range = (-math.inf, math.inf),
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
        range_px: The least and the largest disparity that the matcher can find. Pixels whose true
            one is beyond are left out; if those are more than half, there is no line.
        method: How to fit; `FITS` says what each does.
    """
    in_view = int(np.count_nonzero(scored))
    scored = scored & (true_px >= range_px[0]) & (true_px <= range_px[1])
    answered = np.flatnonzero(scored & np.isfinite(estimated_px) & np.isfinite(true_px))
    estimated, true = (
        values.reshape(-1)[answered].astype(np.float64) for values in (estimated_px, true_px)
    )
    wanted = int(np.count_nonzero(scored))
    share = estimated.size / wanted if wanted else math.nan
    beyond = 1 - wanted / in_view if in_view else math.nan
    kept = np.zeros(true.size, dtype=bool)
    if beyond <= 1 - _FEWEST_IN_RANGE and _has_line(estimated, wanted=wanted):
        kept = _near_the_median_line(estimated, true) if method == "filtered" else ~kept
    if not _has_line(estimated[kept], wanted=wanted):
        return ScaleFit(answered=share, beyond=beyond)
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
        beyond=beyond,
        residual_px=math.sqrt(mean_squared),
        r2=1 - mean_squared / variance if variance else math.nan,
    )


def scale_settings(matcher: StereoMatcher) -> Settings:
    """Return every choice that SD depends on, and what each of its columns is."""
    least_px, largest_px = (
        edge_px if math.isfinite(edge_px) else None for edge_px in range_of(matcher)
    )
    return {
        "matcher": matcher.name,
        **{f"sd_{method}": what for method, what in FITS.items()},
        "occlusion": "pixels that the right camera does not see are not scored, by true depth",
        "range": "pixels whose true disparity the matcher cannot find are not scored, nor is a "
        f"frame of which they are more than {1 - _FEWEST_IN_RANGE:.0%}",
        "least_px": least_px,
        "largest_px": largest_px,
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
    return bool(estimated.size >= enough and estimated.min() < estimated.max())


def _near_the_median_line(
    estimated: Float64[np.ndarray, " n"], true: Float64[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Return which pixels are no outliers."""
    some = slice(None, None, max(1, len(estimated) // _MEDIAN_PIXELS))
    if estimated[some].min() == estimated[some].max():
        some = slice(None)
    slope, offset = _median_line(estimated[some], true[some])
    apart = np.abs(true - slope * estimated - offset)
    sigma = _MAD_TO_SIGMA * float(np.median(apart[some]))
    return apart <= max(_OUTLIER_SIGMAS * sigma, _OUTLIER_PX)


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
