"""The scores of one scene: each view is decoded once, each frame scored for every pair and source.

One table, `FRAME_METRIC_ROWS`, says how each metric of a frame is computed and what it needs. A few
frames are in memory at a time, so that learned models get batches. Clips are the exception: their
features need all frames of the scene.
"""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from importlib.metadata import PackageNotFoundError, version
from types import ModuleType
from typing import Any, Final, Generic, TypeVar

import numpy as np
import torch
from av.video.reformatter import VideoReformatter

from stereogenbench_data.engine import Advance
from stereogenbench_data.errors import EvaluationError, PredictionError
from stereogenbench_data.evaluation.columns import EXPLAIN_A_FIT, LEARNED
from stereogenbench_data.evaluation.metrics import keypoint_matches, pixels, scale
from stereogenbench_data.evaluation.metrics.frechet import FeatureStatistics
from stereogenbench_data.evaluation.models.loading import (
    Picture,
    Settings,
    load_model,
    range_of,
)
from stereogenbench_data.evaluation.models.opencv import require_opencv
from stereogenbench_data.evaluation.predictions import (
    Pair,
    PairFrames,
    PredictionSource,
    Read,
    open_frames,
    scaled_rgb,
)
from stereogenbench_data.evaluation.protocol import PROTOCOL_VERSION, EvaluationProtocol
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.fields import PAIR_FIELDS, Sample

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
        "versions": versions(),
    }
    for name in protocol.metrics:
        row = FRAME_METRIC_ROWS.get(name)
        settings[name] = dict(row.settings(protocol) if row else model_of(protocol, name).settings)
    return settings


def versions() -> dict[str, str]:
    """Return the versions of this package and of those that scores are computed with."""
    found = {}
    for package in _VERSIONS:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


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
    def ceiling(self) -> float:
        """P-PSNR of the rendered view."""
        return pixels.patch_psnr(self.left, self.right)

    @cached_property
    def outside(self) -> float:
        """The share of measured pixels whose disparity P-PSNR does not search."""
        return pixels.outside_window(self.sample["disparity"][0], self.sample["valid"][0])


def _p_psnr(picture: Any, target: TargetFrame, protocol: EvaluationProtocol) -> dict[str, float]:
    return {
        "p_psnr": pixels.patch_psnr(target.left, picture),
        "p_psnr_ceiling": target.ceiling,
        "p_psnr_outside": target.outside,
    }


def _e_match(picture: Any, target: TargetFrame, protocol: EvaluationProtocol) -> dict[str, float]:
    return keypoint_matches.match_error(
        picture, left=target.left, target=target.right, matcher=target.matcher
    )


def _sd(picture: Any, target: TargetFrame, protocol: EvaluationProtocol) -> dict[str, float]:
    """Return SD by each fit of the protocol, all of one disparity map."""
    matcher = model_of(protocol, "stereo_matcher")
    estimated_px = matcher(target.left, picture)
    found: dict[str, float] = {}
    for method in scale.FITS:
        fit = scale.fit_scale(
            estimated_px,
            target.sample["disparity"][0],
            scored=target.sample["visible"][0],
            range_px=range_of(matcher),
            method=method,
        )
        found |= {f"sd_{method}": fit.drift, "sd_beyond": fit.beyond, "sd_answered": fit.answered}
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
        _e_match,
        lambda protocol: keypoint_matches.match_settings(model_of(protocol, "keypoint_matcher")),
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


@dataclass(slots=True)
class PairScores:
    """The scores of one source's right views of one pair.

    Attributes:
        columns: For each column, a number for each frame; nan where there is none.
        predicted: For each distance, the statistics of the features of the right views.
        target: The same of the rendered views.
        problem: "", or why there are no scores.
        views_sha256: Of the right views' pixels as they were read, frame by frame.
        stamp: What identified the right views when they were scored (`PredictionSource.stamp`).
    """

    columns: dict[str, list[float]] = field(default_factory=dict)
    predicted: dict[str, FeatureStatistics] = field(default_factory=dict)
    target: dict[str, FeatureStatistics] = field(default_factory=dict)
    problem: str = ""
    views_sha256: str = ""
    stamp: str = ""


SceneScores = dict[tuple[str, Pair], PairScores]
"""The scores of a scene, by the source's name and the pair."""


How = TypeVar("How")
"""The protocol: of right views, or of disparity."""


ScoredPairs = Mapping[int, Sequence[PairFrames]]
"""What is scored of the pairs of each scene, by its row in an index, ascending."""


@dataclass(frozen=True)
class Run(Generic[How]):
    """What is scored and how, and what identifies its results.

    Attributes:
        index: The index of the scenes.
        scenes: Which of their pairs and frames; of all pairs of a scene the same frames.
        protocol: The choices that scores depend on.
        sources: Whose predictions are scored.
        tier: What the sources were given.
        donors: For each scene, by row, another one that sources read views of, if any.
        settings: What else the scores depend on, as plain values.
    """

    index: SceneIndex
    scenes: ScoredPairs
    protocol: How
    sources: tuple[PredictionSource, ...]
    tier: str
    donors: Mapping[int, int] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)

    def of_scene(self, row: int) -> "Run[How]":
        """Return the run of one scene, to be pickled: its index has what the sources read alone."""
        rows = sorted({row, self.donors.get(row, row)})
        scenes = {rows.index(row): self.scenes[row]}
        return replace(self, index=self.index.only(rows), scenes=scenes, donors={})

    @property
    def pairs(self) -> tuple[PairFrames, ...]:
        """The pairs of all scenes."""
        return tuple(pair for pairs in self.scenes.values() for pair in pairs)


@contextmanager
def open_scene(
    work: Run[Any], fields: Sequence[str]
) -> Iterator[tuple[Callable[[Pair, int], Sample], dict[str, Read]]]:
    """Yield what loads the sample of a pair and a frame, and what reads each source, by its name.

    Args:
        work: What to score of one scene.
        fields: What scoring needs of a sample, besides what sources need.
    """
    (row,) = work.scenes
    needed = {*fields, *(each for source in work.sources for each in source.inputs)}
    known = tuple(name for name in PAIR_FIELDS if name in needed)
    size, depth = work.protocol.size, work.protocol.depth
    with ExitStack() as stack:
        load = stack.enter_context(open_frames(work.index, known, size=size, depth=depth))
        reads = {each.name: stack.enter_context(each.open(work.index)) for each in work.sources}
        yield partial(load, row), reads


def score_scene(work: Run[EvaluationProtocol], after_frames: Advance) -> tuple[str, SceneScores]:
    """Return a scene's key, and the scores of each source and pair of it.

    Args:
        work: What to score of one scene.
        after_frames: Called with how many frames of pairs were scored since; it may raise to
            stop the work.

    Raises:
        StorageError: If a file of the data is missing or altered.
        MediaError: If a video of the data does not decode.
        ExtraError: If a package or weights that a metric needs are not there.
    """
    protocol, (row,), pairs = work.protocol, work.scenes, work.pairs
    frames = pairs[0].frames
    with (
        open_scene(work, fields_of(protocol)) as (load, reads),
        open_frames(work.index, ("right",)) as load_stored,
    ):
        scorers = {
            (name, wanted.pair): PairScorer(protocol, read, wanted)
            for name, read in reads.items()
            for wanted in pairs
        }
        for start in range(0, len(frames), protocol.batch_frames):
            matcher = None
            if "e_match" in protocol.metrics:
                matcher = keypoint_matches.MatchedOnce(model_of(protocol, "keypoint_matcher"))
            targets: dict[Pair, list[TargetFrame]] = {wanted.pair: [] for wanted in pairs}
            for frame in frames[start : start + protocol.batch_frames]:
                pictures: dict[int, Any] = {}  # of each camera one array for all its pairs
                for pair in targets:
                    sample = load(pair, frame)
                    for camera, view in zip(pair, ("left", "right"), strict=True):
                        sample[view] = pictures.setdefault(camera, sample[view])
                    stored = partial(load_stored, row, pair, frame)
                    targets[pair].append(TargetFrame(sample, matcher, load_stored=stored))
            for (_, pair), scorer in scorers.items():
                scorer.add(targets[pair])
            after_frames(sum(map(len, targets.values())))
    with one_thread(require_opencv()):
        return pairs[0].scene, {place: scorer.scores() for place, scorer in scorers.items()}


@contextmanager
def one_thread(*libraries: ModuleType) -> Iterator[None]:
    """Let torch, and OpenCV if it is given, compute on the calling thread alone in the block.

    Scores are then the same to the last digit, whatever else the process does.
    """
    counts = [(torch.get_num_threads, torch.set_num_threads)]
    counts += [(each.getNumThreads, each.setNumThreads) for each in libraries]
    before = [now() for now, _ in counts]
    for _, change in counts:
        change(1)
    try:
        yield
    finally:
        for (_, change), threads in zip(counts, before, strict=True):
            change(threads)


class PairScorer:
    """Gathers the scores of one source's right views of one pair."""

    def __init__(self, protocol: EvaluationProtocol, read: Read, wanted: PairFrames) -> None:
        """Begin with no frame; ``read`` reads the right views of the pair that is wanted."""
        self.protocol, self.read, self.wanted = protocol, read, wanted
        self._scores = PairScores({name: [] for name in protocol.columns})
        self._clip: list[tuple[Any, Any]] = []
        self._read_pixels = hashlib.sha256()

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
        with one_thread(require_opencv()):
            self._score(given, frames)

    def _score(self, given: Sequence[Any], frames: Sequence[TargetFrame]) -> None:
        protocol, columns = self.protocol, self._scores.columns
        scaler = VideoReformatter()
        pictures, targets = [], []
        for picture, frame in zip(given, frames, strict=True):
            has_size = picture.shape == frame.right.shape
            targets.append(frame if has_size else frame.scaled_from_stored)
            pictures.append(scaled_rgb(picture, size=frame.right.shape[1:], scaler=scaler))
            for metric in protocol.metrics:
                if metric not in LEARNED:
                    numbers = FRAME_METRIC_ROWS[metric].score(pictures[-1], targets[-1], protocol)
                    for name, number in numbers.items():
                        columns[name].append(float(number))
        rendered = [target.right for target in targets]
        if "lpips" in protocol.metrics:
            distance = model_of(protocol, "lpips")
            columns["lpips"].extend(distance(np.stack(pictures), np.stack(rendered)).tolist())
        if "fid" in protocol.metrics:
            self._merge("fid", np.stack(pictures), np.stack(rendered))
        if "fvd" in protocol.metrics:
            self._clip.extend(zip(pictures, rendered, strict=True))

    def _merge(self, metric: str, predicted: Any, target: Any) -> None:
        """Add the features of right views and of their targets to the statistics of a distance."""
        features, scores = model_of(self.protocol, metric), self._scores
        for statistics, views in ((scores.predicted, predicted), (scores.target, target)):
            new = FeatureStatistics.of(features(views))
            statistics[metric] = statistics[metric].merged(new) if metric in statistics else new

    def scores(self) -> PairScores:
        """Return what was gathered.

        Raises:
            EvaluationError: If a clip has fewer frames than its features need.
        """
        if self._scores.problem:
            return self._scores
        self._scores.views_sha256 = self._read_pixels.hexdigest()
        if "fvd" in self.protocol.metrics:
            least = model_of(self.protocol, "fvd").min_frames
            if len(self._clip) < least:
                raise EvaluationError(
                    f"fvd needs clips of at least {least} frames, and {len(self._clip)} are "
                    f"evaluated: ask for more frames."
                )
            predicted, rendered = zip(*self._clip, strict=True)
            self._merge("fvd", np.stack(predicted)[None], np.stack(rendered)[None])
        return self._scores
