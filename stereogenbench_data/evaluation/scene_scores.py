"""The scores of one scene: each view is decoded once, each frame scored for every pair and source.

A few frames are in memory at a time, so that learned models get batches; of clips, whose features
need all their frames, those of one scene.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Final, Literal

import numpy as np
import torch
from av.video.reformatter import VideoReformatter

from stereogenbench_data.engine import Advance
from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.metrics.frechet import FeatureStatistics
from stereogenbench_data.evaluation.metrics.matching import (
    TargetMatches,
    match_error,
    target_matches,
)
from stereogenbench_data.evaluation.metrics.pixels import (
    PatchScore,
    outside_window,
    patch_psnr,
    psnr_db,
    ssim,
)
from stereogenbench_data.evaluation.metrics.scale import fit_scale
from stereogenbench_data.evaluation.models.interfaces import KeypointMatcher, Keypoints, Settings
from stereogenbench_data.evaluation.models.opencv import require_opencv
from stereogenbench_data.evaluation.predictions import (
    Pair,
    PairFrames,
    PredictionFault,
    PredictionReader,
    PredictionSource,
    scaled_rgb,
)
from stereogenbench_data.evaluation.protocol import EvaluationProtocol, MetricModels, models_of
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.fields import PAIR_FIELDS, Sample
from stereogenbench_data.samples.load import SampleLoader
from stereogenbench_data.samples.request import Request
from stereogenbench_data.selection.plan import Address

Faults = Literal["raise", "count"]

_STORED_RIGHT: Final = Request(kind="pairs", fields=("right",), layout="single")


@dataclass(slots=True)
class PairScores:
    """The scores of one source's right views of one pair.

    Attributes:
        columns: For each column, a number for each frame; nan where there is none.
        predicted: For each distance, the statistics of the features of the right views.
        target: The same of the rendered views.
        fault: "", or why there are no scores.
    """

    columns: dict[str, list[float]] = field(default_factory=dict)
    predicted: dict[str, FeatureStatistics] = field(default_factory=dict)
    target: dict[str, FeatureStatistics] = field(default_factory=dict)
    fault: str = ""


SceneScores = dict[tuple[str, Pair], PairScores]
"""The scores of a scene, by the source's name and the pair."""


@dataclass(frozen=True, slots=True)
class SceneWork:
    """One scene to score.

    Attributes:
        index: An index that holds the scene, and scenes that sources read views of.
        pairs: What is scored of each pair, the same frames for all.
        protocol: How.
        sources: Whose right views are scored.
        faults: "raise" at a prediction that is not what it must be, or "count" it.
    """

    index: SceneIndex
    pairs: tuple[PairFrames, ...]
    protocol: EvaluationProtocol
    sources: tuple[PredictionSource, ...]
    faults: Faults = "raise"

    @property
    def scene(self) -> str:
        """The key of the scene."""
        return self.pairs[0].scene

    @property
    def row(self) -> int:
        """The scene's row in the index."""
        return list(self.index.column("key")).index(self.scene)


def score_scene(
    work: SceneWork, after_frames: Advance, *, models: MetricModels | None = None
) -> tuple[str, SceneScores]:
    """Return a scene's key, and the scores of each source and pair of it.

    Args:
        work: What to score.
        after_frames: Called with how many frames of pairs were scored since; it may raise to
            stop the work.
        models: What the metrics are computed with, where they were loaded before.

    Raises:
        PredictionFault: If a prediction is not what it must be, and faults are not counted.
        StorageError: If a file of the data is missing or altered.
        MediaError: If a video of the data does not decode.
        ExtraError: If a package or weights that a metric needs are not there.
    """
    models = models or models_of(work.protocol)
    with ExitStack() as stack:
        scorers: dict[tuple[str, Pair], PairScorer] = {}
        for source in work.sources:
            reader = stack.enter_context(closing(source.open(work.index)))
            for wanted in work.pairs:
                scorers[source.name, wanted.pair] = PairScorer(
                    models, reader, wanted, faults=work.faults
                )
        stored = stack.enter_context(closing(SampleLoader(work.index, _STORED_RIGHT)))
        row = work.row
        for samples in _batches(work):
            matcher = None
            if "e_match" in work.protocol.metrics:
                matcher = _CachedKeypoints(models.keypoint_matcher)
            for wanted in work.pairs:
                targets = [
                    TargetFrame(
                        sample,
                        matcher,
                        stored_right=partial(_stored_right, stored, row, wanted.pair, sample),
                    )
                    for sample in samples[wanted.pair]
                ]
                for source in work.sources:
                    scorers[source.name, wanted.pair].add(targets)
                after_frames(len(targets))
    with one_thread():
        return work.scene, {place: scorer.scores() for place, scorer in scorers.items()}


def _batches(work: SceneWork) -> Iterator[dict[Pair, list[Sample]]]:
    """Yield the samples of a few frames of each pair; equal pictures are one array."""
    needed = {*work.protocol.fields, *(each for source in work.sources for each in source.inputs)}
    request = Request(
        kind="pairs",
        fields=tuple(name for name in PAIR_FIELDS if name in needed),
        layout="single",
        size=work.protocol.size,
        depth=work.protocol.depth,
    )
    row, frames, step = work.row, work.pairs[0].frames, work.protocol.batch_frames
    with closing(SampleLoader(work.index, request)) as loader:
        for start in range(0, len(frames), step):
            samples: dict[Pair, list[Sample]] = {wanted.pair: [] for wanted in work.pairs}
            for frame in frames[start : start + step]:
                pictures: dict[int, Any] = {}
                for source, target in samples:
                    address = Address(row, source, (target,), (frame,))
                    sample = loader.load(address, clip="frame", generator=np.random.default_rng(0))
                    sample["left"] = pictures.setdefault(source, sample["left"])
                    sample["right"] = pictures.setdefault(target, sample["right"])
                    samples[source, target].append(sample)
            yield samples


def _stored_right(loader: SampleLoader, row: int, pair: Pair, sample: Sample) -> Any:
    """Return the right view of a sample at its stored size."""
    address = Address(row, pair[0], (pair[1],), (int(sample["frame_index"]),))
    return loader.load(address, clip="frame", generator=np.random.default_rng(0))["right"]


@dataclass(frozen=True, slots=True)
class _CachedKeypoints:
    """A keypoint matcher that caches the keypoints of each picture, by the picture's identity."""

    matcher: KeypointMatcher
    found: dict[int, tuple[Any, Keypoints]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return self.matcher.name

    @property
    def settings(self) -> Settings:
        return self.matcher.settings

    def detect(self, picture: Any) -> Keypoints:
        if id(picture) not in self.found:
            # The picture is kept too, so that no other takes its identity.
            self.found[id(picture)] = picture, self.matcher.detect(picture)
        return self.found[id(picture)][1]

    def match(self, left: Keypoints, right: Keypoints) -> Any:
        return self.matcher.match(left, right)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let OpenCV and torch compute with the calling thread only while the block runs.

    Scores are then the same to the last digit, whatever else the process does.

    Raises:
        ExtraError: If OpenCV is not installed.
    """
    opencv = require_opencv()
    before = opencv.getNumThreads(), torch.get_num_threads()
    opencv.setNumThreads(1)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        opencv.setNumThreads(before[0])
        torch.set_num_threads(before[1])


class TargetFrame:
    """One frame of one pair, with the parts of its scores that do not depend on the prediction."""

    def __init__(
        self,
        sample: Sample,
        matcher: KeypointMatcher | None,
        *,
        stored_right: Callable[[], Any],
    ) -> None:
        """Take the sample; nothing is computed yet.

        Args:
            sample: Its fields, pictures at the evaluated size.
            matcher: The matcher of keypoints, if one is needed.
            stored_right: Returns the rendered right view at its stored size.
        """
        self.sample = sample
        self._matcher = matcher
        self._stored_right = stored_right

    @cached_property
    def scaled_from_stored(self) -> "TargetFrame":
        """The frame whose right view is scaled in RGB, as predictions of the stored size are.

        The one of the sample is scaled before it becomes RGB, with other roundings.
        """
        right = scaled_rgb(
            self._stored_right(), size=self.right.shape[1:], scaler=VideoReformatter()
        )
        sample = {**self.sample, "right": right}
        return TargetFrame(sample, self._matcher, stored_right=self._stored_right)

    @property
    def left(self) -> Any:
        """The left view, uint8 (3, h, w)."""
        return self.sample["left"]

    @property
    def right(self) -> Any:
        """The rendered right view, uint8 (3, h, w)."""
        return self.sample["right"]

    @property
    def matcher(self) -> KeypointMatcher:
        """The matcher of keypoints."""
        if self._matcher is None:
            raise EvaluationError("keypoints are only matched for e_match: ask for that metric.")
        return self._matcher

    @cached_property
    def ceiling(self) -> PatchScore:
        """P-PSNR of the rendered view."""
        return patch_psnr(self.left, self.right)

    @cached_property
    def outside(self) -> float:
        """The share of measured pixels whose disparity P-PSNR does not search."""
        return outside_window(self.sample["disparity"][0], self.sample["valid"][0])

    @cached_property
    def matches(self) -> TargetMatches:
        """The matches of left and rendered right view."""
        return target_matches(self.left, self.right, matcher=self.matcher)


class PairScorer:
    """Gathers the scores of one source's right views of one pair."""

    def __init__(
        self,
        models: MetricModels,
        reader: PredictionReader,
        wanted: PairFrames,
        *,
        faults: Faults = "raise",
    ) -> None:
        """Begin with no frame.

        Args:
            models: What the metrics are computed with.
            reader: Reads the source's right views of the scene.
            wanted: The pair.
            faults: "raise" at a prediction that is not what it must be, or "count" it.
        """
        self._models = models
        self._reader = reader
        self._wanted = wanted
        self._faults = faults
        self._fault = ""
        self._columns: dict[str, list[float]] = {name: [] for name in models.protocol.columns}
        self._predicted: dict[str, FeatureStatistics] = {}
        self._target: dict[str, FeatureStatistics] = {}
        self._clip: list[tuple[Any, Any]] = []

    def add(self, frames: Sequence[TargetFrame]) -> None:
        """Read the right views of some frames, in order, and score them.

        A view of the stored size is scaled, and compared with the rendered one scaled likewise.
        After a fault that is counted the pair's other frames are passed over.

        Raises:
            PredictionFault: If a prediction is not what it must be, and faults are not counted.
        """
        if self._fault:
            return
        try:
            given = self._reader.read(self._wanted, [frame.sample for frame in frames])
        except PredictionFault as fault:
            if self._faults == "raise":
                raise
            self._fault = str(fault)
            return
        with one_thread():
            self._score(given, frames)

    def _score(self, given: Sequence[Any], frames: Sequence[TargetFrame]) -> None:
        scaler = VideoReformatter()
        pictures = [
            scaled_rgb(picture, size=frame.right.shape[1:], scaler=scaler)
            for picture, frame in zip(given, frames, strict=True)
        ]
        targets = [
            frame if picture.shape == frame.right.shape else frame.scaled_from_stored
            for picture, frame in zip(given, frames, strict=True)
        ]
        for picture, target in zip(pictures, targets, strict=True):
            numbers: dict[str, float] = {}
            for name in self._models.protocol.metrics:
                if name in _OF_FRAME:
                    numbers |= _OF_FRAME[name](picture, target, self._models)
            for name, number in numbers.items():
                self._columns[name].append(float(number))
        for name, metric in self._models.pair_metrics.items():
            rendered = np.stack([target.right for target in targets])
            self._columns[name].extend(metric(np.stack(pictures), rendered).tolist())
        for name, features in self._models.image_features.items():
            shown = features(np.stack(pictures))
            self._merge(name, shown, features(np.stack([target.right for target in targets])))
        if self._models.video_features:
            rendered_views = (target.right for target in targets)
            self._clip.extend(zip(pictures, rendered_views, strict=True))

    def _merge(self, name: str, predicted: Any, target: Any) -> None:
        for statistics, features in ((self._predicted, predicted), (self._target, target)):
            new = FeatureStatistics.of(features)
            statistics[name] = statistics[name].merged(new) if name in statistics else new

    def scores(self) -> PairScores:
        """Return what was gathered."""
        if self._fault:
            return PairScores(fault=self._fault)
        for name, features in self._models.video_features.items():
            if len(self._clip) < features.min_frames:
                raise EvaluationError(
                    f"{name} needs clips of at least {features.min_frames} frames, and "
                    f"{len(self._clip)} are evaluated: ask for more frames."
                )
            predicted, target = (np.stack(views)[None] for views in zip(*self._clip, strict=True))
            self._merge(name, features(predicted), features(target))
        return PairScores(self._columns, self._predicted, self._target)


def _p_psnr(picture: Any, target: TargetFrame, models: MetricModels) -> dict[str, float]:
    score = patch_psnr(target.left, picture)
    return {
        "p_psnr": score.mean_db,
        "p_psnr_pooled": score.pooled_db,
        "p_psnr_ceiling": target.ceiling.mean_db,
        "p_psnr_outside": target.outside,
    }


def _e_match(picture: Any, target: TargetFrame, models: MetricModels) -> dict[str, float]:
    score = match_error(picture, against=target.matches, matcher=target.matcher)
    return {
        "e_match": score.error,
        "keypoints": score.keypoints,
        "target_matches": score.target_matches,
        "predicted_matches": score.predicted_matches,
        "common_matches": score.common,
    }


def _sd(picture: Any, target: TargetFrame, models: MetricModels) -> dict[str, float]:
    """Return SD by each fit of the protocol, all of one disparity map."""
    estimated_px = models.stereo_matcher(target.left, picture)
    found: dict[str, float] = {}
    for method in models.protocol.fits:
        fit = fit_scale(
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


_OF_FRAME: Mapping[str, Any] = {
    "psnr": lambda picture, target, models: {"psnr": psnr_db(picture, target.right)},
    "ssim": lambda picture, target, models: {"ssim": ssim(picture, target.right)},
    "p_psnr": _p_psnr,
    "e_match": _e_match,
    "sd": _sd,
}
