"""The columns of scores: what each is called, which way is better, and the metric it belongs to."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final, Literal

from stereogenbench_data.errors import EvaluationError

Better = Literal["higher", "lower", "neither"]


@dataclass(frozen=True, slots=True)
class Column:
    """One number of every frame.

    Attributes:
        label: What tables call it.
        better: Which way is better; "neither" for what only explains another column.
        digits: Decimals in tables.
        meaning: What it is, with its unit.
        backend: Which of a protocol's backends it was measured with, "" for none.
    """

    label: str
    better: Better
    digits: int
    meaning: str
    backend: Literal["", "keypoint_matcher", "stereo_matcher"] = ""


COLUMNS: Final[dict[str, Column]] = {
    "psnr": Column("PSNR", "higher", 2, "dB; identical pictures are counted, not averaged"),
    "ssim": Column("SSIM", "higher", 4, "structural similarity"),
    "lpips": Column("LPIPS", "lower", 4, "learned perceptual distance"),
    "e_match": Column(
        "E_match", "lower", 2, "%; change of the set of matched keypoints", "keypoint_matcher"
    ),
    "p_psnr": Column("P-PSNR", "higher", 2, "dB; mean over patches of the best match's"),
    "sd": Column("SD", "lower", 4, "|slope - 1| of disparity, true on found", "stereo_matcher"),
    "p_psnr_pooled": Column("P-PSNR pooled", "neither", 2, "dB of the best matches' mean MSE"),
    "p_psnr_ceiling": Column("P-PSNR of target", "neither", 2, "dB; what the rendered view gets"),
    "p_psnr_outside": Column(
        "outside window", "neither", 3, "share of measured pixels whose disparity is not searched"
    ),
    "keypoints": Column("keypoints", "neither", 0, "of the left view", "keypoint_matcher"),
    "target_matches": Column("M_gt", "neither", 0, "matches of the target", "keypoint_matcher"),
    "predicted_matches": Column(
        "M_pred", "neither", 0, "matches of the prediction", "keypoint_matcher"
    ),
    "common_matches": Column("M_both", "neither", 0, "matches of both", "keypoint_matcher"),
    "sd_slope": Column("a", "neither", 4, "slope of true on found disparity", "stereo_matcher"),
    "sd_offset_px": Column("b", "neither", 2, "px; offset of the fit", "stereo_matcher"),
    "sd_valid": Column("fit pixels", "neither", 3, "share of pixels in the fit", "stereo_matcher"),
    "sd_answered": Column(
        "answered", "neither", 3, "share of visible pixels with a found disparity", "stereo_matcher"
    ),
    "sd_outliers": Column(
        "outliers", "neither", 3, "share of answered pixels left out of the fit", "stereo_matcher"
    ),
    "sd_residual_px": Column(
        "residual", "neither", 2, "px; standard deviation of the residuals", "stereo_matcher"
    ),
    "sd_r2": Column("R2", "neither", 3, "share of variance explained", "stereo_matcher"),
}
"""Columns of frames, headline columns first."""

FRAME_METRICS: Final[dict[str, tuple[str, ...]]] = {
    "psnr": ("psnr",),
    "ssim": ("ssim",),
    "lpips": ("lpips",),
    "e_match": (
        "e_match", "keypoints", "target_matches", "predicted_matches", "common_matches",
    ),
    "p_psnr": ("p_psnr", "p_psnr_pooled", "p_psnr_ceiling", "p_psnr_outside"),
    "sd": (
        "sd", "sd_slope", "sd_offset_px", "sd_valid", "sd_answered", "sd_outliers",
        "sd_residual_px", "sd_r2",
    ),
}  # fmt: skip
"""The columns of each metric that is computed frame by frame, its headline first."""

IMAGE_DISTANCES: Final[dict[str, str]] = {"fid": "inception", "fd-colour": "colour-statistics"}
"""Distances between sets of frames, and the features that each is of."""

VIDEO_DISTANCES: Final[dict[str, str]] = {"fvd": "i3d", "fd-motion": "motion-statistics"}
"""Distances between sets of clips, one clip a pair, and the features that each is of."""

METRICS: Final = (*FRAME_METRICS, *IMAGE_DISTANCES, *VIDEO_DISTANCES)
OFFLINE_METRICS: Final = ("psnr", "ssim", "e_match", "p_psnr", "sd")
"""What is computed unless asked otherwise: nothing that needs weights."""


def require_metrics(names: Any) -> tuple[str, ...]:
    """Return metrics in the order of the tables.

    Args:
        names: Names of `METRICS`, or one text with commas between them.

    Raises:
        EvaluationError: If one is unknown, or there is none.

    >>> require_metrics("ssim,psnr")
    ('psnr', 'ssim')
    """
    asked = names.split(",") if isinstance(names, str) else list(names)
    wanted = {str(name).strip() for name in asked}
    unknown = sorted(wanted - set(METRICS))
    if unknown or not wanted:
        raise EvaluationError(
            f"there is no metric {unknown[0]!r}: choose among {', '.join(METRICS)}."
            if unknown
            else f"no metric was asked for: choose among {', '.join(METRICS)}."
        )
    return tuple(name for name in METRICS if name in wanted)


def columns_of(metrics: Iterable[str]) -> tuple[str, ...]:
    """Return the columns that metrics fill, in the order of `COLUMNS`."""
    filled = {column for name in metrics for column in FRAME_METRICS.get(name, ())}
    return tuple(column for column in COLUMNS if column in filled)
