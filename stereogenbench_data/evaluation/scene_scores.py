"""The scores of one scene: each view is decoded once, each frame scored for every pair and source.

A few frames are in memory at a time, so that learned models get batches. Clips are the exception:
their features need all frames of the scene.
"""

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from av.video.reformatter import VideoReformatter

from stereogenbench_data.engine import Advance
from stereogenbench_data.errors import EvaluationError, PredictionError
from stereogenbench_data.evaluation.frame_metrics import (
    FRAME_METRIC_ROWS,
    CachedKeypoints,
    MetricModels,
    TargetFrame,
    fields_of,
    models_of,
)
from stereogenbench_data.evaluation.metrics.frechet import FeatureStatistics
from stereogenbench_data.evaluation.models.opencv import require_opencv
from stereogenbench_data.evaluation.predictions import (
    Pair,
    PairFrames,
    PredictionSource,
    Read,
    open_frames,
    scaled_rgb,
)
from stereogenbench_data.evaluation.protocol import EvaluationProtocol
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.fields import PAIR_FIELDS, Sample

OnProblem = Literal["raise", "count"]


@dataclass(slots=True)
class PairScores:
    """The scores of one source's right views of one pair.

    Attributes:
        columns: For each column, a number for each frame; nan where there is none.
        predicted: For each distance, the statistics of the features of the right views.
        target: The same of the rendered views.
        problem: "", or why there are no scores.
        views_sha256: Of the right views' pixels as they were read, frame by frame.
    """

    columns: dict[str, list[float]] = field(default_factory=dict)
    predicted: dict[str, FeatureStatistics] = field(default_factory=dict)
    target: dict[str, FeatureStatistics] = field(default_factory=dict)
    problem: str = ""
    views_sha256: str = ""


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
        on_problem: "raise" at a prediction that is not what it must be, or "count" it.
    """

    index: SceneIndex
    pairs: tuple[PairFrames, ...]
    protocol: EvaluationProtocol
    sources: tuple[PredictionSource, ...]
    on_problem: OnProblem = "raise"

    @property
    def scene(self) -> str:
        """The key of the scene."""
        return self.pairs[0].scene


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
        PredictionError: If a prediction is not what it must be, and problems are not counted.
        StorageError: If a file of the data is missing or altered.
        MediaError: If a video of the data does not decode.
        ExtraError: If a package or weights that a metric needs are not there.
    """
    models = models or models_of(work.protocol)
    row = list(work.index.column("key")).index(work.scene)
    with ExitStack() as stack:
        scorers: dict[tuple[str, Pair], PairScorer] = {}
        for source in work.sources:
            read = stack.enter_context(source.open(work.index))
            for wanted in work.pairs:
                scorers[source.name, wanted.pair] = PairScorer(
                    models, read, wanted, on_problem=work.on_problem
                )
        load_stored = stack.enter_context(open_frames(work.index, ("right",)))
        for samples in _batches(work, row):
            matcher = CachedKeypoints(models)
            for wanted in work.pairs:
                targets = [
                    TargetFrame(
                        sample,
                        matcher,
                        load_stored=partial(
                            load_stored, row, wanted.pair, int(sample["frame_index"])
                        ),
                    )
                    for sample in samples[wanted.pair]
                ]
                for source in work.sources:
                    scorers[source.name, wanted.pair].add(targets)
                after_frames(len(targets))
    with one_thread():
        return work.scene, {place: scorer.scores() for place, scorer in scorers.items()}


def _batches(work: SceneWork, row: int) -> Iterator[dict[Pair, list[Sample]]]:
    """Yield the samples of a few frames of each pair; equal pictures are one array."""
    protocol, frames = work.protocol, work.pairs[0].frames
    needed = {*fields_of(protocol), *(each for source in work.sources for each in source.inputs)}
    fields = tuple(name for name in PAIR_FIELDS if name in needed)
    with open_frames(work.index, fields, size=protocol.size, depth=protocol.depth) as load:
        for start in range(0, len(frames), protocol.batch_frames):
            samples: dict[Pair, list[Sample]] = {wanted.pair: [] for wanted in work.pairs}
            for frame in frames[start : start + protocol.batch_frames]:
                pictures: dict[int, Any] = {}
                for pair in samples:
                    sample = load(row, pair, frame)
                    for camera, view in zip(pair, ("left", "right"), strict=True):
                        sample[view] = pictures.setdefault(camera, sample[view])
                    samples[pair].append(sample)
            yield samples


@contextmanager
def one_thread() -> Iterator[None]:
    """Let OpenCV and torch compute on the calling thread alone while the block runs.

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


class PairScorer:
    """Gathers the scores of one source's right views of one pair."""

    def __init__(
        self,
        models: MetricModels,
        read: Read,
        wanted: PairFrames,
        *,
        on_problem: OnProblem = "raise",
    ) -> None:
        """Begin with no frame.

        Args:
            models: What the metrics are computed with.
            read: Reads the source's right views of the scene.
            wanted: The pair.
            on_problem: "raise" at a prediction that is not what it must be, or "count" it.
        """
        self._models = models
        self._read = read
        self._wanted = wanted
        self._on_problem = on_problem
        self._scores = PairScores({name: [] for name in models.protocol.columns})
        self._clip: list[tuple[Any, Any]] = []
        self._read_pixels = hashlib.sha256()

    def add(self, frames: Sequence[TargetFrame]) -> None:
        """Read the right views of some frames, in order, and score them.

        A view of the stored size is scaled, and compared with the rendered one scaled likewise.
        After a problem that is counted, the pair's other frames are skipped.

        Raises:
            PredictionError: If a prediction is not what it must be, and problems are not counted.
        """
        if self._scores.problem:
            return
        try:
            given = self._read(self._wanted, [frame.sample for frame in frames])
        except PredictionError as problem:
            if self._on_problem == "raise":
                raise
            self._scores = PairScores(problem=str(problem))
            return
        for picture in given:
            self._read_pixels.update(f"{picture.shape}".encode())
            self._read_pixels.update(np.ascontiguousarray(picture).data)
        with one_thread():
            self._score(given, frames)

    def _score(self, given: Sequence[Any], frames: Sequence[TargetFrame]) -> None:
        models, columns = self._models, self._scores.columns
        scaler = VideoReformatter()
        pictures, targets = [], []
        for picture, frame in zip(given, frames, strict=True):
            has_size = picture.shape == frame.right.shape
            targets.append(frame if has_size else frame.scaled_from_stored)
            pictures.append(scaled_rgb(picture, size=frame.right.shape[1:], scaler=scaler))
            for metric in models.protocol.metrics:
                if metric in FRAME_METRIC_ROWS:
                    numbers = FRAME_METRIC_ROWS[metric].score(pictures[-1], targets[-1], models)
                    for name, number in numbers.items():
                        columns[name].append(float(number))
        rendered = [target.right for target in targets]
        for name, distance in models.pair_metrics.items():
            columns[name].extend(distance(np.stack(pictures), np.stack(rendered)).tolist())
        for name, features in models.image_features.items():
            self._merge(name, features(np.stack(pictures)), features(np.stack(rendered)))
        if models.video_features:
            self._clip.extend(zip(pictures, rendered, strict=True))

    def _merge(self, name: str, predicted: Any, target: Any) -> None:
        scores = self._scores
        for statistics, features in ((scores.predicted, predicted), (scores.target, target)):
            new = FeatureStatistics.of(features)
            statistics[name] = statistics.get(name, FeatureStatistics.empty(new.dim)).merged(new)

    def scores(self) -> PairScores:
        """Return what was gathered.

        Raises:
            EvaluationError: If a clip has fewer frames than its features need.
        """
        if not self._scores.problem:
            self._scores.views_sha256 = self._read_pixels.hexdigest()
            for name, features in self._models.video_features.items():
                if len(self._clip) < features.min_frames:
                    raise EvaluationError(
                        f"{name} needs clips of at least {features.min_frames} frames, and "
                        f"{len(self._clip)} are evaluated: ask for more frames."
                    )
                sides = (np.stack(views)[None] for views in zip(*self._clip, strict=True))
                self._merge(name, *map(features, sides))
        return self._scores
