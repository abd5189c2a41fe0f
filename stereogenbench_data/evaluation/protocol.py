"""The protocol: what methods are given, every choice that scores depend on, and the models named.

Scores of different inference tiers answer different questions, so they are never ranked together.

Source: the StereoGenBench paper, section "Benchmark Protocol" and its appendix on inference
conditions.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Final, Literal

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.columns import (
    COLUMNS,
    FRAME_METRICS,
    IMAGE_DISTANCES,
    OFFLINE_METRICS,
    VIDEO_DISTANCES,
    require_metrics,
)
from stereogenbench_data.evaluation.metrics.matching import match_settings
from stereogenbench_data.evaluation.metrics.pixels import (
    PATCH_SETTINGS,
    PSNR_SETTINGS,
    SSIM_SETTINGS,
)
from stereogenbench_data.evaluation.metrics.scale import (
    FitMethod,
    fits_of,
    require_fit,
    scale_settings,
)
from stereogenbench_data.evaluation.models.interfaces import (
    ImageFeatures,
    KeypointMatcher,
    PairMetric,
    StereoMatcher,
    VideoFeatures,
)
from stereogenbench_data.evaluation.models.registry import ModelKind, ModelOptions, load_model
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
class Tier:
    """One inference condition of the paper.

    Attributes:
        name: "G0", "G1" or "G2".
        meaning: What the tier measures.
        inputs: The fields of a sample (`PAIR_FIELDS`) that a method is given.
    """

    name: Literal["G0", "G1", "G2"]
    meaning: str
    inputs: tuple[str, ...]

    def inputs_of(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """Return the fields of a sample that a method of this tier may see."""
        return {name: sample[name] for name in self.inputs}


TIERS: Final[dict[str, Tier]] = {
    "G0": Tier(
        "G0",
        "oracle geometry: rendering and inpainting under known target geometry",
        ("left", "disparity", "warped_right", "hole"),
    ),
    "G1": Tier(
        "G1",
        "calibrated target camera: no depth or disparity",
        ("left", "baseline_m", "intrinsics"),
    ),
    "G2": Tier("G2", "unaligned monocular: the left view alone", ("left",)),
}


def require_tier(name: object) -> Tier:
    """Return a tier by its name.

    Raises:
        EvaluationError: If there is no such tier.
    """
    if not isinstance(name, str) or name not in TIERS:
        known = "; ".join(f"{tier.name} ({tier.meaning})" for tier in TIERS.values())
        raise EvaluationError(f"there is no tier {name!r}: choose one of {known}.")
    return TIERS[name]


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
        models: Where learned models run and where their weights are.
        batch_frames: How many frames are held, and given to learned parts, at a time.
    """

    metrics: tuple[str, ...] = OFFLINE_METRICS
    size: tuple[int, int] = PAPER_SIZE
    keypoint_matcher: str = "sift"
    stereo_matcher: str = "sgbm"
    fit: FitMethod = "filtered"
    depth: DepthEncoding | None = None
    models: ModelOptions = field(default_factory=ModelOptions)
    batch_frames: int = 8

    def __post_init__(self) -> None:
        """Put the metrics in order and check the values."""
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
        filled = {name for metric in self.metrics for name in FRAME_METRICS.get(metric, ())}
        fits = ("", *self.fits)
        return tuple(name for name in COLUMNS if name in filled and COLUMNS[name].fit in fits)

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


class MetricModels:
    """The models that a protocol's metrics are computed with, loaded when first used."""

    def __init__(self, protocol: EvaluationProtocol) -> None:
        """Take the protocol; nothing is loaded yet."""
        self.protocol = protocol

    @cached_property
    def keypoint_matcher(self) -> KeypointMatcher:
        """What finds the matches of E_match."""
        matcher: KeypointMatcher = self._load("keypoint matcher", self.protocol.keypoint_matcher)
        return matcher

    @cached_property
    def stereo_matcher(self) -> StereoMatcher:
        """What finds the disparity of SD."""
        matcher: StereoMatcher = self._load("stereo matcher", self.protocol.stereo_matcher)
        return matcher

    @cached_property
    def pair_metrics(self) -> dict[str, PairMetric]:
        """The learned metrics of pairs of pictures, by column."""
        return self._load_metrics("pair metric", {"lpips": "lpips"})

    @cached_property
    def image_features(self) -> dict[str, ImageFeatures]:
        """The features of each distance between sets of frames."""
        return self._load_metrics("image features", IMAGE_DISTANCES)

    @cached_property
    def video_features(self) -> dict[str, VideoFeatures]:
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
        of_metric: dict[str, Any] = {
            "psnr": lambda: PSNR_SETTINGS,
            "ssim": lambda: SSIM_SETTINGS,
            "p_psnr": lambda: PATCH_SETTINGS,
            "e_match": lambda: match_settings(self.keypoint_matcher),
            "sd": lambda: scale_settings(self.stereo_matcher, method=protocol.fit),
        }
        learned: Mapping[str, Any] = self.pair_metrics | self.image_features | self.video_features
        for name in protocol.metrics:
            found = of_metric[name]() if name in of_metric else learned[name].settings
            settings[name] = dict(found)
        return settings


@lru_cache(maxsize=1)
def models_of(protocol: EvaluationProtocol) -> MetricModels:
    """Return the models of a protocol, kept for the next scene that this process scores.

    ``models_of.cache_clear()`` drops them.
    """
    return MetricModels(protocol)
