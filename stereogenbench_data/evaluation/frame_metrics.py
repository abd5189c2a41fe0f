"""The metrics of one frame: the one table that says how each is computed, and what it needs.

A new metric is a new row of `FRAME_METRIC_ROWS`, and its columns in `columns`. Beside the table
stands what its rows are computed from: the models of a protocol, and a frame of the target.
"""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Final

from av.video.reformatter import VideoReformatter

from stereogenbench_data.evaluation.columns import EXPLAIN_A_FIT, LEARNED
from stereogenbench_data.evaluation.metrics import matching, pixels, scale
from stereogenbench_data.evaluation.models.loading import (
    KeypointMatcher,
    Keypoints,
    Picture,
    Settings,
    load_model,
)
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


@cache
def model_of(protocol: EvaluationProtocol, kind: str) -> Any:
    """Return a model of a protocol, kept for the next scene that this process scores.

    Args:
        protocol: Which, where it runs and where its weights are.
        kind: "keypoint_matcher", "stereo_matcher", or one of the `LEARNED` metrics.

    Raises:
        EvaluationError: If there is no such model.
        ExtraError: If a package or weights that it needs are missing.
    """
    options: dict[str, Any] = {"device": protocol.device, "weights": protocol.weights}
    if kind in LEARNED:
        return load_model("learned metric", kind, **options)
    return load_model(kind.replace("_", " "), getattr(protocol, kind), **options)


def settings_of(protocol: EvaluationProtocol) -> dict[str, Any]:
    """Return every choice that the scores depend on, as plain values.

    Raises:
        ExtraError: If a package or weights that a metric needs are not there.
    """
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
    for name in protocol.metrics:
        learned = name in LEARNED
        settings[name] = dict(
            model_of(protocol, name).settings
            if learned
            else FRAME_METRIC_ROWS[name].settings(protocol)
        )
    return settings


class CachedKeypoints:
    """A keypoint matcher that detects the keypoints of one and the same array once."""

    def __init__(self, matcher: KeypointMatcher) -> None:
        """Take the matcher."""
        self.name, self.settings, self.match = matcher.name, matcher.settings, matcher.match
        self._detect = matcher.detect
        self._found: dict[int, tuple[Any, Keypoints]] = {}

    def detect(self, picture: Picture) -> Keypoints:
        """Return the keypoints of a picture."""
        if id(picture) not in self._found:
            # The picture is kept too, so that no other takes its identity.
            self._found[id(picture)] = picture, self._detect(picture)
        return self._found[id(picture)][1]


class TargetFrame:
    """One frame of one pair, with the parts of its scores that do not depend on the prediction.

    Attributes:
        sample: Its fields, pictures at the evaluated size.
        left: The left view, uint8 (3, h, w).
        right: The rendered right view, uint8 (3, h, w).
        matcher: The matcher of keypoints; None where no metric needs one.
    """

    def __init__(self, sample: Sample, matcher: Any, *, load_stored: Callable[[], Sample]) -> None:
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


def _p_psnr(picture: Any, target: TargetFrame, protocol: EvaluationProtocol) -> dict[str, float]:
    score = pixels.patch_psnr(target.left, picture)
    return {
        "p_psnr": score.mean_db,
        "p_psnr_pooled": score.pooled_db,
        "p_psnr_ceiling": target.ceiling.mean_db,
        "p_psnr_outside": target.outside,
    }


def _e_match(picture: Any, target: TargetFrame, protocol: EvaluationProtocol) -> dict[str, float]:
    return asdict(matching.match_error(picture, against=target.matches, matcher=target.matcher))


def _sd(picture: Any, target: TargetFrame, protocol: EvaluationProtocol) -> dict[str, float]:
    """Return SD by each fit of the protocol, all of one disparity map."""
    estimated_px = model_of(protocol, "stereo_matcher")(target.left, picture)
    found: dict[str, float] = {}
    for method in scale.FITS:
        fit = scale.fit_scale(
            estimated_px,
            target.sample["disparity"][0],
            scored=target.sample["visible"][0],
            method=method,
        )
        found |= {f"sd_{method}": fit.drift, "sd_answered": fit.answered}
        found |= {f"sd_{method}_{name}": getattr(fit, name) for name in EXPLAIN_A_FIT}
    return found


@dataclass(frozen=True, slots=True)
class FrameMetric:
    """How a metric is computed frame by frame.

    Attributes:
        score: Takes the right view, the target and the protocol; returns a number for each column.
        settings: Returns every choice that the scores depend on.
        fields: The fields of a sample that it needs besides both views.
    """

    score: Callable[[Picture, TargetFrame, EvaluationProtocol], Mapping[str, float]]
    settings: Callable[[EvaluationProtocol], Settings]
    fields: tuple[str, ...] = ()


FRAME_METRIC_ROWS: Final[dict[str, FrameMetric]] = {
    "psnr": FrameMetric(
        lambda picture, target, protocol: {"psnr": pixels.psnr_db(picture, target.right)},
        lambda protocol: pixels.PSNR_SETTINGS,
    ),
    "ssim": FrameMetric(
        lambda picture, target, protocol: {"ssim": pixels.ssim(picture, target.right)},
        lambda protocol: pixels.SSIM_SETTINGS,
    ),
    "e_match": FrameMetric(
        _e_match, lambda protocol: matching.match_settings(model_of(protocol, "keypoint_matcher"))
    ),
    "p_psnr": FrameMetric(_p_psnr, lambda protocol: pixels.PATCH_SETTINGS, ("disparity", "valid")),
    "sd": FrameMetric(
        _sd,
        lambda protocol: scale.scale_settings(model_of(protocol, "stereo_matcher")),
        ("disparity", "visible"),
    ),
}
"""Every metric of a frame but the learned, by name."""


def fields_of(protocol: EvaluationProtocol) -> tuple[str, ...]:
    """Return the fields of a sample that a protocol's metrics need."""
    needed = [
        FRAME_METRIC_ROWS[name].fields for name in protocol.metrics if name in FRAME_METRIC_ROWS
    ]
    return tuple(dict.fromkeys(("left", "right", "frame_index", *sum(needed, ()))))
