"""The scores of one scene: each view is decoded once, each frame scored for every pair and source.

A few frames are in memory at a time, so that learned models get batches. Clips are the exception:
their features need all frames of the scene. Scores are kept on disk, one file a scene, from which a
stopped evaluation goes on:

    OUT/evaluation.json       all that scores depend on (`jobs`); other settings are refused
    OUT/scenes/<digest>.json  a scene's scores, with what identified its right views
    OUT/scenes/<digest>.npz   the statistics of its features, where a distance needs them
"""

import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from av.video.reformatter import VideoReformatter

from stereogenbench_data.engine import Advance
from stereogenbench_data.errors import (
    EvaluationError,
    PredictionError,
    StorageError,
    explain_os_errors,
)
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
    pair_name,
    scaled_rgb,
)
from stereogenbench_data.evaluation.protocol import EvaluationProtocol
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.jobs import JobKind, read_item
from stereogenbench_data.samples.fields import PAIR_FIELDS
from stereogenbench_data.sources.files import write_atomic


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
    """

    index: SceneIndex
    pairs: tuple[PairFrames, ...]
    protocol: EvaluationProtocol
    sources: tuple[PredictionSource, ...]

    @property
    def scene(self) -> str:
        """The key of the scene."""
        return self.pairs[0].scene


def score_scene(work: SceneWork, after_frames: Advance) -> tuple[str, SceneScores]:
    """Return a scene's key, and the scores of each source and pair of it.

    Args:
        work: What to score.
        after_frames: Called with how many frames of pairs were scored since; it may raise to
            stop the work.

    Raises:
        StorageError: If a file of the data is missing or altered.
        MediaError: If a video of the data does not decode.
        ExtraError: If a package or weights that a metric needs are not there.
    """
    models, protocol = models_of(work.protocol), work.protocol
    row = list(work.index.column("key")).index(work.scene)
    needed = {*fields_of(protocol), *(each for source in work.sources for each in source.inputs)}
    fields = tuple(name for name in PAIR_FIELDS if name in needed)
    frames = work.pairs[0].frames
    with ExitStack() as stack:
        load = stack.enter_context(
            open_frames(work.index, fields, size=protocol.size, depth=protocol.depth)
        )
        load_stored = stack.enter_context(open_frames(work.index, ("right",)))
        scorers = {
            (source.name, wanted.pair): PairScorer(models, read, wanted)
            for source in work.sources
            for read in [stack.enter_context(source.open(work.index))]
            for wanted in work.pairs
        }
        for start in range(0, len(frames), protocol.batch_frames):
            matcher = None
            if "e_match" in protocol.metrics:
                matcher = CachedKeypoints(models.keypoint_matcher)
            targets: dict[Pair, list[TargetFrame]] = {wanted.pair: [] for wanted in work.pairs}
            for frame in frames[start : start + protocol.batch_frames]:
                pictures: dict[int, Any] = {}  # of each camera one array for all its pairs
                for pair in targets:
                    sample = load(row, pair, frame)
                    for camera, view in zip(pair, ("left", "right"), strict=True):
                        sample[view] = pictures.setdefault(camera, sample[view])
                    stored = partial(load_stored, row, pair, frame)
                    targets[pair].append(TargetFrame(sample, matcher, load_stored=stored))
            for (_, pair), scorer in scorers.items():
                scorer.add(targets[pair])
            after_frames(sum(map(len, targets.values())))
    with one_thread():
        return work.scene, {place: scorer.scores() for place, scorer in scorers.items()}


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


@dataclass(slots=True)
class PairScorer:
    """Gathers the scores of one source's right views of one pair.

    Attributes:
        models: What the metrics are computed with.
        read: Reads the source's right views of the scene.
        wanted: The pair.
    """

    models: MetricModels
    read: Read
    wanted: PairFrames
    _scores: PairScores = field(default_factory=PairScores)
    _clip: list[tuple[Any, Any]] = field(default_factory=list)
    _read_pixels: Any = field(default_factory=hashlib.sha256)

    def __post_init__(self) -> None:
        """Begin with no frame."""
        self._scores.columns = {name: [] for name in self.models.protocol.columns}

    def add(self, frames: Sequence[TargetFrame]) -> None:
        """Read the right views of some frames, in order, and score them.

        A view of the stored size is scaled, and compared with the rendered one scaled likewise.
        A prediction that is not what it must be is the pair's problem, and its other frames are
        skipped.
        """
        if self._scores.problem:
            return
        try:
            given = self.read(self.wanted, [frame.sample for frame in frames])
        except PredictionError as problem:
            self._scores = PairScores(problem=str(problem))
            return
        for picture in given:
            self._read_pixels.update(f"{picture.shape}".encode())
            self._read_pixels.update(np.ascontiguousarray(picture).data)
        with one_thread():
            self._score(given, frames)

    def _score(self, given: Sequence[Any], frames: Sequence[TargetFrame]) -> None:
        models, columns = self.models, self._scores.columns
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
        for name, distance in models.learned["pair metric"].items():
            columns[name].extend(distance(np.stack(pictures), np.stack(rendered)).tolist())
        for name, features in models.learned["image features"].items():
            self._merge(name, features(np.stack(pictures)), features(np.stack(rendered)))
        if models.learned["video features"]:
            self._clip.extend(zip(pictures, rendered, strict=True))

    def _merge(self, name: str, predicted: Any, target: Any) -> None:
        scores = self._scores
        for statistics, features in ((scores.predicted, predicted), (scores.target, target)):
            new = FeatureStatistics.of(features)
            statistics[name] = statistics[name].merged(new) if name in statistics else new

    def scores(self) -> PairScores:
        """Return what was gathered.

        Raises:
            EvaluationError: If a clip has fewer frames than its features need.
        """
        if not self._scores.problem:
            self._scores.views_sha256 = self._read_pixels.hexdigest()
            for name, features in self.models.learned["video features"].items():
                if len(self._clip) < features.min_frames:
                    raise EvaluationError(
                        f"{name} needs clips of at least {features.min_frames} frames, and "
                        f"{len(self._clip)} are evaluated: ask for more frames."
                    )
                sides = (np.stack(views)[None] for views in zip(*self._clip, strict=True))
                self._merge(name, *map(features, sides))
        return self._scores


Stamps = Mapping[tuple[str, Pair], str]

EVALUATION: Final = JobKind("scores", "evaluation.json", ".evaluation.lock", EvaluationError)
FORMAT: Final = 4
"""Of the files of scenes; other formats are refused."""
_SCENES: Final = "scenes"
_PARTS: Final = ("count", "mean", "root")


class PartialResults:
    """The scenes of one evaluation that are scored so far."""

    def __init__(self, folder: Path) -> None:
        """Take a folder that is held by `job_folder`."""
        self.folder = folder

    def write(self, scene: str, scores: SceneScores, *, stamps: Stamps) -> None:
        """Keep the scores of a scene, whole or not at all.

        Args:
            scene: The scene's key.
            scores: Its scores by source and pair.
            stamps: What identified the right views when they were scored.

        Raises:
            StorageError: If they cannot be written.
        """
        pairs, arrays = {}, {}
        for place, found in scores.items():
            columns = {
                name: [number if math.isfinite(number) else str(number) for number in numbers]
                for name, numbers in found.columns.items()
            }
            pairs[_place_name(place)] = {
                "stamp": stamps[place], "fault": found.problem, "views_sha256": found.views_sha256,
                "columns": columns,
            }  # fmt: skip
            for side, statistics in (("predicted", found.predicted), ("target", found.target)):
                for name, each in statistics.items():
                    for part in _PARTS:
                        arrays[f"{_place_name(place)}/{side}/{name}/{part}"] = getattr(each, part)
        path = self._path(scene)
        what = f"{path}: the scores of {scene} cannot be written"
        with explain_os_errors(what, "Choose another folder with --out."):
            path.parent.mkdir(exist_ok=True)
            if arrays:
                packed = BytesIO()
                np.savez(packed, **arrays)
                write_atomic(path.with_suffix(".npz"), packed.getvalue())
            write_atomic(path, json.dumps({"pairs": pairs}, allow_nan=False).encode())

    def problems(self, scene: str, *, stamps: Stamps) -> list[str] | None:
        """Return why pairs of a scene have no scores, if it was scored with these right views.

        Args:
            scene: The scene's key.
            stamps: What identifies the right views now.

        Returns:
            None if the scene is to be scored: it was not, or a right view has changed since.
        """
        pairs = (read_item(self._path(scene)) or {}).get("pairs", {})
        if {name: each["stamp"] for name, each in pairs.items()} != {
            _place_name(place): stamp for place, stamp in stamps.items()
        }:
            return None
        return [each["fault"] for each in pairs.values() if each["fault"]]

    def read(self, scene: str, places: Iterable[tuple[str, Pair]]) -> SceneScores:
        """Return the scores of a scene that was scored.

        Raises:
            StorageError: If they cannot be read.
        """
        path = self._path(scene)
        document = read_item(path)
        if document is None:
            raise StorageError(f"{path}: the scores of {scene} are gone. Run the evaluation again.")
        arrays: dict[str, Any] = {}
        if path.with_suffix(".npz").exists():
            with np.load(path.with_suffix(".npz"), allow_pickle=False) as packed:
                arrays = dict(packed)
        return {
            place: _pair_scores(document["pairs"], arrays, _place_name(place)) for place in places
        }

    def _path(self, scene: str) -> Path:
        digest = hashlib.sha256(scene.encode()).hexdigest()[:24]
        return self.folder / _SCENES / f"{digest}.json"


def _pair_scores(pairs: Mapping[str, Any], arrays: Mapping[str, Any], place: str) -> PairScores:
    entry = pairs[place]
    columns = {name: list(map(float, numbers)) for name, numbers in entry["columns"].items()}
    scores = PairScores(columns, problem=entry["fault"], views_sha256=entry["views_sha256"])
    for key in arrays:
        if key.startswith(f"{place}/") and key.endswith("/count"):
            start = key.removesuffix("count")
            side, name = start.removeprefix(f"{place}/").strip("/").split("/")
            count, mean, root = (arrays[start + part] for part in _PARTS)
            getattr(scores, side)[name] = FeatureStatistics(int(count), mean, root)
    return scores


def _place_name(place: tuple[str, Pair]) -> str:
    return f"{place[0]}/{pair_name(place[1])}"
