"""The protocol: every choice that scores depend on, and the tools that these choices name."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Final

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.backends import (
    Where,
    load_image_features,
    load_keypoint_matcher,
    load_pair_metric,
    load_stereo_matcher,
    load_video_features,
)
from stereogenbench_data.evaluation.columns import (
    COLUMNS,
    IMAGE_DISTANCES,
    OFFLINE_METRICS,
    VIDEO_DISTANCES,
    columns_of,
    require_metrics,
)
from stereogenbench_data.evaluation.matching import match_settings
from stereogenbench_data.evaluation.patches import PATCH_SETTINGS
from stereogenbench_data.evaluation.pixels import PSNR_SETTINGS, SSIM_SETTINGS
from stereogenbench_data.evaluation.protocols import (
    ImageFeatures,
    KeypointMatcher,
    PairMetric,
    StereoMatcher,
    VideoFeatures,
)
from stereogenbench_data.evaluation.scale import FitMethod, fits_of, require_fit, scale_settings
from stereogenbench_data.samples.size import require_size
from stereogenbench_data.schema.records import DepthEncoding

PAPER_SIZE: Final = (480, 832)
"""(height, width) at which the paper's frame-wise metrics are computed."""

RESIZE: Final = (
    "stretched to the size without keeping the aspect, left, right and prediction alike: FFmpeg's "
    "swscale, by area where the picture shrinks and else bicubic, before the conversion to RGB; "
    "disparity and masks by the nearest pixel centre, disparity scaled with the width"
)
"""The resize of everything that is scored."""

PAPER_BACKENDS: Final = {"keypoint_matcher": "dedode", "stereo_matcher": "foundation-stereo"}
"""What the paper measures E_match and SD with."""

_VERSIONS: Final = ("stereogenbench-data", "numpy", "opencv-python-headless", "opencv-python", "av")


@dataclass(frozen=True, slots=True)
class EvaluationProtocol:
    """What is computed and how.

    Attributes:
        metrics: Names of `METRICS`.
        size: (height, width) in pixels at which everything is scored.
        keypoint_matcher: What finds the matches of E_match.
        stereo_matcher: What finds the disparity of SD.
        fit: The fit of SD by which relations between controls are judged. Every report shows SD
            "filtered" and by "least_squares", whatever this is, and "theil_sen" if it is that.
        depth: A depth contract instead of the one that files and release state.
        where: Where learned parts run and where their weights are.
        batch_frames: How many frames are held, and given to learned parts, at a time.
    """

    metrics: tuple[str, ...] = OFFLINE_METRICS
    size: tuple[int, int] = PAPER_SIZE
    keypoint_matcher: str = "sift"
    stereo_matcher: str = "sgbm"
    fit: FitMethod = "filtered"
    depth: DepthEncoding | None = None
    where: Where = field(default_factory=Where)
    batch_frames: int = 8

    def __post_init__(self) -> None:
        """Put metrics in order, and refuse what cannot be."""
        object.__setattr__(self, "metrics", require_metrics(self.metrics))
        object.__setattr__(self, "size", require_size(self.size))
        require_fit(self.fit)
        if self.batch_frames < 1:
            raise EvaluationError(f"batch_frames must be at least 1, got {self.batch_frames}.")

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields of a sample that the metrics need."""
        needed = ["left", "right", "frame_index"]
        if {"p_psnr", "sd"} & set(self.metrics):
            needed.append("disparity")
        if "p_psnr" in self.metrics:
            needed.append("valid")
        if "sd" in self.metrics:
            needed.append("visible")
        return tuple(needed)

    @property
    def fits(self) -> tuple[FitMethod, ...]:
        """The fits that SD is computed by."""
        return fits_of(self.fit)

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of every frame, in the order of `COLUMNS`."""
        fits = ("", *self.fits)
        return tuple(name for name in columns_of(self.metrics) if COLUMNS[name].fit in fits)

    def label(self, column: str) -> str:
        """Return what tables call a column: with the backend, where it is not the paper's."""
        known = COLUMNS[column]
        if not known.backend or self.is_papers(column):
            return known.label
        return f"{known.label} ({getattr(self, known.backend)})"

    def is_papers(self, column: str) -> bool:
        """Return whether a column is measured with what the paper measures it with."""
        backend = COLUMNS[column].backend
        return not backend or getattr(self, backend) == PAPER_BACKENDS[backend]


class Tools:
    """What a protocol's metrics are computed with, loaded when first used."""

    def __init__(self, protocol: EvaluationProtocol) -> None:
        """Take the protocol; nothing is loaded yet."""
        self.protocol = protocol

    @cached_property
    def keypoint_matcher(self) -> KeypointMatcher:
        """What finds the matches of E_match."""
        return load_keypoint_matcher(self.protocol.keypoint_matcher, self.protocol.where)

    @cached_property
    def stereo_matcher(self) -> StereoMatcher:
        """What finds the disparity of SD."""
        return load_stereo_matcher(self.protocol.stereo_matcher, self.protocol.where)

    @cached_property
    def pair_metrics(self) -> dict[str, PairMetric]:
        """The learned metrics of pairs of pictures, by column."""
        return {
            name: load_pair_metric(name, self.protocol.where)
            for name in self.protocol.metrics
            if name == "lpips"
        }

    @cached_property
    def image_features(self) -> dict[str, ImageFeatures]:
        """The features of each distance between sets of frames."""
        return {
            name: load_image_features(IMAGE_DISTANCES[name], self.protocol.where)
            for name in self.protocol.metrics
            if name in IMAGE_DISTANCES
        }

    @cached_property
    def video_features(self) -> dict[str, VideoFeatures]:
        """The features of each distance between sets of clips."""
        return {
            name: load_video_features(VIDEO_DISTANCES[name], self.protocol.where)
            for name in self.protocol.metrics
            if name in VIDEO_DISTANCES
        }

    def settings(self) -> dict[str, Any]:
        """Return every choice that the scores depend on, as plain values.

        Raises:
            ExtraError: If a package or weights that a metric needs are not there.
        """
        protocol = self.protocol
        height, width = protocol.size
        told: dict[str, Any] = {
            "size": f"{width}x{height}",
            "resize": RESIZE,
            "depth": "as the files state" if protocol.depth is None else repr(protocol.depth),
            "metrics": list(protocol.metrics),
            "averages": "frames first, then scenes; intervals are Student's over scenes",
            "versions": _versions(),
        }
        of_metric: dict[str, Any] = {
            "psnr": lambda: PSNR_SETTINGS,
            "ssim": lambda: SSIM_SETTINGS,
            "p_psnr": lambda: PATCH_SETTINGS,
            "e_match": lambda: match_settings(self.keypoint_matcher),
            "sd": lambda: scale_settings(self.stereo_matcher, method=protocol.fit),
        }
        parts: Mapping[str, Any] = self.pair_metrics | self.image_features | self.video_features
        for name in protocol.metrics:
            found = of_metric[name]() if name in of_metric else parts[name].settings
            told[name] = dict(found)
        return told


@lru_cache(maxsize=1)
def tools_of(protocol: EvaluationProtocol) -> Tools:
    """Return the tools of a protocol, kept for the next scene that this process scores.

    ``tools_of.cache_clear()`` lets go of what was loaded.
    """
    return Tools(protocol)


def _versions() -> dict[str, str]:
    found = {}
    for package in _VERSIONS:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
