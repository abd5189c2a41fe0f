"""The columns of scores: what each is called, which way is better, and the metric it belongs to."""

from dataclasses import dataclass
from typing import Any, Final, Literal

from stereogenbench_data.errors import EvaluationError


@dataclass(frozen=True, slots=True)
class Column:
    """One number of every frame.

    Attributes:
        label: What tables call it.
        better: Which way is better; "neither" for what only explains another column.
        digits: Decimals in tables.
        metric: The metric that fills it.
    """

    label: str
    better: Literal["higher", "lower", "neither"]
    digits: int
    metric: str


_SD_FITS: Final = {"filtered": "filtered", "least_squares": "least squares"}
"""The fits of SD and what tables call them; the first is the one to compare with the paper's, which
leaves outliers out and does not state by which rule."""

EXPLAIN_A_FIT: Final = {
    "slope": ("a", 4),
    "offset_px": ("b", 2),
    "valid": ("fit pixels", 3),
    "outliers": ("outliers", 3),
    "residual_px": ("residual", 2),
    "r2": ("R2", 3),
}
"""What explains a fit of SD: the attribute of a `ScaleFit`, its label and decimals."""

QUANTILES: Final = {"a50": 0.50, "a90": 0.90, "a95": 0.95, "a99": 0.99}
"""Quantiles of the error of disparity, by their columns."""

BAD_PX: Final = {"bad_0.5": 0.5, "bad_1": 1.0, "bad_2": 2.0, "bad_3": 3.0, "bad_4": 4.0}
"""Errors of disparity that are counted as bad, by their columns."""

COLUMNS: Final[dict[str, Column]] = {
    "psnr": Column("PSNR", "higher", 2, "psnr"),
    "ssim": Column("SSIM", "higher", 4, "ssim"),
    "lpips": Column("LPIPS", "lower", 4, "lpips"),
    "e_match": Column("E_match", "lower", 2, "e_match"),
    "p_psnr": Column("P-PSNR", "higher", 2, "p_psnr"),
    **{f"sd_{fit}": Column(f"SD {words}", "lower", 4, "sd") for fit, words in _SD_FITS.items()},
    "p_psnr_ceiling": Column("P-PSNR of target", "neither", 2, "p_psnr"),
    "p_psnr_outside": Column("outside window", "neither", 3, "p_psnr"),
    "keypoints": Column("keypoints", "neither", 0, "e_match"),
    "target_matches": Column("M_gt", "neither", 0, "e_match"),
    "predicted_matches": Column("M_pred", "neither", 0, "e_match"),
    "common_matches": Column("M_both", "neither", 0, "e_match"),
    "sd_beyond": Column("beyond range", "neither", 3, "sd"),
    "sd_answered": Column("answered", "neither", 3, "sd"),
    **{
        f"sd_{fit}_{name}": Column(f"{label} {words}", "neither", digits, "sd")
        for fit, words in _SD_FITS.items()
        for name, (label, digits) in EXPLAIN_A_FIT.items()
    },
    # Of disparity: the measure, and of which pixels; `metrics.disparity` defines them.
    "epe": Column("EPE px, answered", "lower", 3, "disparity"),
    "rms": Column("RMS px, answered", "lower", 3, "disparity"),
    **{name: Column(f"{name.upper()} px, answered", "lower", 3, "disparity") for name in QUANTILES},
    **{
        name: Column(f"bad {limit:g}, scored", "lower", 4, "disparity")
        for name, limit in BAD_PX.items()
    },
    "d1": Column("D1, scored", "lower", 4, "disparity"),
    "invalid": Column("invalid, scored", "lower", 4, "disparity"),
    "beyond": Column("left out, valid", "neither", 4, "disparity"),
}
"""Columns of frames, headline columns first; `FRAME_METRIC_ROWS` says how each is computed."""

MATCHERS: Final = {"e_match": "keypoint_matcher", "sd": "stereo_matcher"}
"""The metrics that depend on a matcher, with a protocol's attribute that names it."""

HEAVY_TAILED: Final = frozenset(f"sd_{fit}" for fit in _SD_FITS)
"""Columns whose mean a few scenes can dominate: their median is shown and judged."""

LEARNED: Final = ("lpips", "fid", "fvd")
"""The metrics that are computed with learned weights.

FID and FVD are distances between sets: of the features of frames, or of clips, one clip a pair.
"""

METRICS: Final = ("psnr", "ssim", "lpips", "e_match", "p_psnr", "sd", "fid", "fvd")
OFFLINE_METRICS: Final = ("psnr", "ssim", "e_match", "p_psnr", "sd")
"""What is computed by default: nothing that needs weights."""


def require_metrics(names: Any) -> tuple[str, ...]:
    """Return metrics in the order of the tables.

    Args:
        names: Names of `METRICS`, or one text that separates them by commas; "all" for all.

    Raises:
        EvaluationError: If one is unknown, or there is none.

    >>> require_metrics("ssim,psnr")
    ('psnr', 'ssim')
    """
    if names == "all":
        return METRICS
    given = names.split(",") if isinstance(names, str) else list(names)
    wanted = {str(name).strip() for name in given}
    unknown = sorted(wanted - set(METRICS))
    if unknown or not wanted:
        what = f"there is no metric {unknown[0]!r}" if unknown else "no metric was given"
        raise EvaluationError(f"{what}: choose among {', '.join(METRICS)}.")
    return tuple(name for name in METRICS if name in wanted)
