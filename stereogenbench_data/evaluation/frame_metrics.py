"""The metrics of one frame: the one table that says how each is computed, and what it needs.

A new metric is a new row of `FRAME_METRIC_ROWS`, and its columns in `columns`. Beside the table
stands what its rows are computed from: the models of a protocol, and a frame of the target.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import cached_property, lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Final

from av.video.reformatter import VideoReformatter

from stereogenbench_data.evaluation.columns import (
    IMAGE_DISTANCES,
    PAIR_METRICS,
    VIDEO_DISTANCES,
)
from stereogenbench_data.evaluation.metrics import matching, pixels, scale
from stereogenbench_data.evaluation.models import interfaces
from stereogenbench_data.evaluation.models.registry import ModelKind, load_model
from stereogenbench_data.evaluation.predictions import scaled_rgb
from stereogenbench_data.evaluation.protocol import PROTOCOL_VERSION, EvaluationProtocol
from stereogenbench_data.samples.fields import Sample

RESIZE: Final = (
    "stretched to the size without keeping the aspect, left, right and prediction alike: FFmpeg's "
    "swscale, by area where the picture shrinks and else bicubic, before the conversion to RGB; "
    "disparity and masks by the nearest pixel centre, disparity scaled with the width"
)
"""The resize of everything that is scored."""

_VERSIONS: Final = ("stereogenbench-data", "numpy", "opencv-python-headless", "opencv-python", "av")


class MetricModels:
    """The models that a protocol's metrics are computed with, loaded when first used."""

    def __init__(self, protocol: EvaluationProtocol) -> None:
        """Take the protocol; nothing is loaded yet."""
        self.protocol = protocol

    def __repr__(self) -> str:
        """Return a summary."""
        return f"MetricModels({', '.join(self.protocol.metrics)})"

    @cached_property
    def keypoint_matcher(self) -> interfaces.KeypointMatcher:
        """What finds the matches of E_match."""
        matcher: interfaces.KeypointMatcher = self._load(
            "keypoint matcher", self.protocol.keypoint_matcher
        )
        return matcher

    @cached_property
    def stereo_matcher(self) -> interfaces.StereoMatcher:
        """What finds the disparity of SD."""
        matcher: interfaces.StereoMatcher = self._load(
            "stereo matcher", self.protocol.stereo_matcher
        )
        return matcher

    @cached_property
    def pair_metrics(self) -> dict[str, interfaces.PairMetric]:
        """The learned metrics of pairs of pictures, by column."""
        return self._load_metrics("pair metric", PAIR_METRICS)

    @cached_property
    def image_features(self) -> dict[str, interfaces.ImageFeatures]:
        """The features of each distance between sets of frames."""
        return self._load_metrics("image features", IMAGE_DISTANCES)

    @cached_property
    def video_features(self) -> dict[str, interfaces.VideoFeatures]:
        """The features of each distance between sets of clips."""
        return self._load_metrics("video features", VIDEO_DISTANCES)

    def _load(self, kind: ModelKind, name: str) -> Any:
        return load_model(kind, name, self.protocol.models)

    def _load_metrics(self, kind: ModelKind, names: Mapping[str, str]) -> dict[str, Any]:
        return {
            metric: self._load(kind, names[metric])
            for metric in self.protocol.metrics
            if metric in names
        }

    def settings(self) -> dict[str, Any]:
        """Return every choice that the scores depend on, as plain values.

        Raises:
            ExtraError: If a package or weights that a metric needs are not there.
        """
        protocol = self.protocol
        height, width = protocol.size
        settings: dict[str, Any] = {
            "protocol": PROTOCOL_VERSION,
            "size": f"{width}x{height}",
            "resize": RESIZE,
            "depth": "as the files state" if protocol.depth is None else repr(protocol.depth),
            "metrics": list(protocol.metrics),
            "averages": "frames first, then scenes; intervals are Student's over scenes",
            "versions": {},
        }
        for package in _VERSIONS:
            with suppress(PackageNotFoundError):
                settings["versions"][package] = version(package)
        learned: Mapping[str, Any] = self.pair_metrics | self.image_features | self.video_features
        for name in protocol.metrics:
            found = (
                FRAME_METRIC_ROWS[name].settings(self)
                if name in FRAME_METRIC_ROWS
                else learned[name].settings
            )
            settings[name] = dict(found)
        return settings


@lru_cache(maxsize=1)
def models_of(protocol: EvaluationProtocol) -> MetricModels:
    """Return the models of a protocol, kept for the next scene that this process scores.

    ``models_of.cache_clear()`` drops them.
    """
    return MetricModels(protocol)


@dataclass(frozen=True, slots=True)
class CachedKeypoints:
    """The models' keypoint matcher; it detects the keypoints of one and the same array once."""

    models: MetricModels
    found: dict[int, tuple[Any, interfaces.Keypoints]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Its name."""
        return self.models.keypoint_matcher.name

    @property
    def settings(self) -> interfaces.Settings:
        """Its settings."""
        return self.models.keypoint_matcher.settings

    def detect(self, picture: interfaces.Picture) -> interfaces.Keypoints:
        """Return the keypoints of a picture."""
        if id(picture) not in self.found:
            # The picture is kept too, so that no other takes its identity.
            self.found[id(picture)] = picture, self.models.keypoint_matcher.detect(picture)
        return self.found[id(picture)][1]

    def match(self, left: interfaces.Keypoints, right: interfaces.Keypoints) -> Any:
        """Return indices of matched keypoints."""
        return self.models.keypoint_matcher.match(left, right)


class TargetFrame:
    """One frame of one pair, with the parts of its scores that do not depend on the prediction.

    Attributes:
        sample: Its fields, pictures at the evaluated size.
        left: The left view, uint8 (3, h, w).
        right: The rendered right view, uint8 (3, h, w).
        matcher: The matcher of keypoints.
    """

    def __init__(
        self, sample: Sample, matcher: CachedKeypoints, *, load_stored: Callable[[], Sample]
    ) -> None:
        """Take the sample; ``load_stored`` returns the one whose right view has its stored size."""
        self.sample = sample
        self.left, self.right = sample["left"], sample["right"]
        self.matcher = matcher
        self._load_stored = load_stored

    @cached_property
    def scaled_from_stored(self) -> "TargetFrame":
        """The frame whose right view is scaled in RGB, as predictions of the stored size are.

        The one of the sample is scaled before it becomes RGB, with other roundings.
        """
        stored, size = self._load_stored()["right"], self.right.shape[1:]
        right = scaled_rgb(stored, size=size, scaler=VideoReformatter())
        sample = {**self.sample, "right": right}
        return TargetFrame(sample, self.matcher, load_stored=self._load_stored)

    @cached_property
    def ceiling(self) -> pixels.PatchScore:
        """P-PSNR of the rendered view."""
        return pixels.patch_psnr(self.left, self.right)

    @cached_property
    def outside(self) -> float:
        """The share of measured pixels whose disparity P-PSNR does not search."""
        return pixels.outside_window(self.sample["disparity"][0], self.sample["valid"][0])

    @cached_property
    def matches(self) -> matching.TargetMatches:
        """The matches of left and rendered right view."""
        return matching.target_matches(self.left, self.right, matcher=self.matcher)


def _p_psnr(picture: Any, target: TargetFrame, models: MetricModels) -> dict[str, float]:
    score = pixels.patch_psnr(target.left, picture)
    return {
        "p_psnr": score.mean_db,
        "p_psnr_pooled": score.pooled_db,
        "p_psnr_ceiling": target.ceiling.mean_db,
        "p_psnr_outside": target.outside,
    }


def _e_match(picture: Any, target: TargetFrame, models: MetricModels) -> dict[str, float]:
    return asdict(matching.match_error(picture, against=target.matches, matcher=target.matcher))


def _sd(picture: Any, target: TargetFrame, models: MetricModels) -> dict[str, float]:
    """Return SD by each fit of the protocol, all of one disparity map."""
    estimated_px = models.stereo_matcher(target.left, picture)
    found: dict[str, float] = {}
    for method in scale.FITS:
        fit = scale.fit_scale(
            estimated_px,
            target.sample["disparity"][0],
            scored=target.sample["visible"][0],
            method=method,
        )
        found |= {
            f"sd_{method}": fit.drift,
            f"sd_{method}_slope": fit.slope,
            f"sd_{method}_offset_px": fit.offset_px,
            f"sd_{method}_valid": fit.valid_ratio,
            f"sd_{method}_outliers": fit.outlier_ratio,
            f"sd_{method}_residual_px": fit.residual_std_px,
            f"sd_{method}_r2": fit.r_squared,
            "sd_answered": fit.answered_ratio,
        }
    return found


@dataclass(frozen=True, slots=True)
class FrameMetric:
    """How a metric is computed frame by frame.

    Attributes:
        score: Takes the right view, the target and the models; returns a number for each column.
        settings: Returns every choice that the scores depend on.
        fields: The fields of a sample that it needs besides both views.
    """

    score: Callable[[interfaces.Picture, TargetFrame, MetricModels], Mapping[str, float]]
    settings: Callable[[MetricModels], interfaces.Settings]
    fields: tuple[str, ...] = ()


FRAME_METRIC_ROWS: Final[dict[str, FrameMetric]] = {
    "psnr": FrameMetric(
        lambda picture, target, models: {"psnr": pixels.psnr_db(picture, target.right)},
        lambda models: pixels.PSNR_SETTINGS,
    ),
    "ssim": FrameMetric(
        lambda picture, target, models: {"ssim": pixels.ssim(picture, target.right)},
        lambda models: pixels.SSIM_SETTINGS,
    ),
    "e_match": FrameMetric(
        _e_match, lambda models: matching.match_settings(models.keypoint_matcher)
    ),
    "p_psnr": FrameMetric(_p_psnr, lambda models: pixels.PATCH_SETTINGS, ("disparity", "valid")),
    "sd": FrameMetric(
        _sd,
        lambda models: scale.scale_settings(models.stereo_matcher),
        ("disparity", "visible"),
    ),
}
"""Every metric of a frame but learned distances (`MetricModels.pair_metrics`), by name."""


def fields_of(protocol: EvaluationProtocol) -> tuple[str, ...]:
    """Return the fields of a sample that a protocol's metrics need."""
    needed = [
        FRAME_METRIC_ROWS[name].fields for name in protocol.metrics if name in FRAME_METRIC_ROWS
    ]
    return tuple(dict.fromkeys(("left", "right", "frame_index", *sum(needed, ()))))
