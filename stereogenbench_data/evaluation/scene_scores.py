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
from stereogenbench_data.evaluation.metrics.frechet import Spread
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
from stereogenbench_data.evaluation.models.interfaces import (
    KeypointMatcher,
    Keypoints,
    Settings,
    require_opencv,
)
from stereogenbench_data.evaluation.predictions import (
    Candidate,
    Pair,
    PredictionFault,
    Views,
    Wanted,
    scaled_rgb,
)
from stereogenbench_data.evaluation.protocol import EvaluationProtocol, Tools, tools_of
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.fields import PAIR_FIELDS, Sample
from stereogenbench_data.samples.load import SampleLoader
from stereogenbench_data.samples.request import Request
from stereogenbench_data.selection.plan import Address


@dataclass(slots=True)
class PairScores:
    """The scores of one candidate's right views of one pair.

    Attributes:
        columns: For each column, a number for each frame; nan where there is none.
        predicted: For each distance, the spread of the features of the right views.
        target: The same of the rendered views.
        fault: "", or why there are no scores.
    """

    columns: dict[str, list[float]] = field(default_factory=dict)
    predicted: dict[str, Spread] = field(default_factory=dict)
    target: dict[str, Spread] = field(default_factory=dict)
    fault: str = ""


class TargetFrame:
    """One frame of one pair, with what of its scores does not depend on the prediction."""

    def __init__(
        self,
        sample: Sample,
        protocol: EvaluationProtocol,
        matcher: KeypointMatcher | None,
        *,
        stored_right: Callable[[], Any],
    ) -> None:
        """Take the sample; nothing is computed yet.

        Args:
            sample: Its fields, pictures at the evaluated size.
            protocol: How it is scored.
            matcher: The matcher of keypoints, if one is needed.
            stored_right: Returns the rendered right view at its stored size.
        """
        self.sample = sample
        self.protocol = protocol
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
        return TargetFrame(sample, self.protocol, self._matcher, stored_right=self._stored_right)

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
            raise EvaluationError("keypoints are matched for e_match alone: ask for that metric.")
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
    """Gathers the scores of one candidate's right views of one pair."""

    def __init__(self, tools: Tools) -> None:
        """Begin with no frame."""
        self.fault = ""
        self._tools = tools
        self._columns: dict[str, list[float]] = {name: [] for name in tools.protocol.columns}
        self._predicted: dict[str, Spread] = {}
        self._target: dict[str, Spread] = {}
        self._clip: list[tuple[Any, Any]] = []

    def add(self, given: Sequence[Any], frames: Sequence[TargetFrame]) -> None:
        """Score some frames: right views, and what they are compared with.

        A view of the stored size is scaled, and compared with the rendered one scaled likewise.
        """
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
            for name, number in self._frame(picture, target).items():
                self._columns[name].append(float(number))
        for name, metric in self._tools.pair_metrics.items():
            rendered = np.stack([target.right for target in targets])
            self._columns[name].extend(metric(np.stack(pictures), rendered).tolist())
        for name, features in self._tools.image_features.items():
            shown = features(np.stack(pictures))
            self._merge(name, shown, features(np.stack([target.right for target in targets])))
        if self._tools.video_features:
            rendered_views = (target.right for target in targets)
            self._clip.extend(zip(pictures, rendered_views, strict=True))

    def _frame(self, picture: Any, target: TargetFrame) -> dict[str, float]:
        found: dict[str, float] = {}
        for name in self._tools.protocol.metrics:
            if name in _OF_FRAME:
                found |= _OF_FRAME[name](picture, target, self._tools)
        return found

    def _merge(self, name: str, predicted: Any, target: Any) -> None:
        for spreads, features in ((self._predicted, predicted), (self._target, target)):
            new = Spread.of(features)
            spreads[name] = spreads[name].merged(new) if name in spreads else new

    def scores(self) -> PairScores:
        """Return what was gathered."""
        if self.fault:
            return PairScores(fault=self.fault)
        for name, features in self._tools.video_features.items():
            if len(self._clip) < features.min_frames:
                raise EvaluationError(
                    f"{name} needs clips of at least {features.min_frames} frames, and "
                    f"{len(self._clip)} are evaluated: ask for more frames."
                )
            predicted, target = (np.stack(views)[None] for views in zip(*self._clip, strict=True))
            self._merge(name, features(predicted), features(target))
        return PairScores(self._columns, self._predicted, self._target)


def _psnr(picture: Any, target: TargetFrame, tools: Tools) -> dict[str, float]:
    return {"psnr": psnr_db(picture, target.right)}


def _ssim(picture: Any, target: TargetFrame, tools: Tools) -> dict[str, float]:
    return {"ssim": ssim(picture, target.right)}


def _p_psnr(picture: Any, target: TargetFrame, tools: Tools) -> dict[str, float]:
    score = patch_psnr(target.left, picture)
    return {
        "p_psnr": score.mean_db,
        "p_psnr_pooled": score.pooled_db,
        "p_psnr_ceiling": target.ceiling.mean_db,
        "p_psnr_outside": target.outside,
    }


def _e_match(picture: Any, target: TargetFrame, tools: Tools) -> dict[str, float]:
    score = match_error(picture, against=target.matches, matcher=target.matcher)
    return {
        "e_match": score.error,
        "keypoints": score.keypoints,
        "target_matches": score.target_matches,
        "predicted_matches": score.predicted_matches,
        "common_matches": score.common,
    }


def _sd(picture: Any, target: TargetFrame, tools: Tools) -> dict[str, float]:
    """Return SD by each fit of the protocol, all of one disparity map."""
    estimated_px = tools.stereo_matcher(target.left, picture)
    found: dict[str, float] = {}
    for method in tools.protocol.fits:
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
    "psnr": _psnr,
    "ssim": _ssim,
    "p_psnr": _p_psnr,
    "e_match": _e_match,
    "sd": _sd,
}


def use_one_thread() -> None:
    """Let OpenCV and torch compute in this process with the calling thread alone.

    Raises:
        ExtraError: If OpenCV is not installed.
    """
    require_opencv().setNumThreads(1)
    torch.set_num_threads(1)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let OpenCV and torch compute with the calling thread alone while the block runs.

    Raises:
        ExtraError: If OpenCV is not installed.
    """
    opencv = require_opencv()
    before = opencv.getNumThreads(), torch.get_num_threads()
    use_one_thread()
    try:
        yield
    finally:
        opencv.setNumThreads(before[0])
        torch.set_num_threads(before[1])


Faults = Literal["raise", "count"]


@dataclass(frozen=True, slots=True)
class SceneWork:
    """One scene to score.

    Attributes:
        index: An index that holds the scene, and scenes that candidates take views from.
        wanted: What is to be scored of each pair, the same frames for all.
        protocol: How.
        candidates: Whose right views are scored.
        faults: "raise" at a prediction that is not what it must be, or "count" it.
    """

    index: SceneIndex
    wanted: tuple[Wanted, ...]
    protocol: EvaluationProtocol
    candidates: tuple[Candidate, ...]
    faults: Faults = "raise"

    @property
    def scene(self) -> str:
        """The key of the scene."""
        return self.wanted[0].scene


_STORED_RIGHT: Final = Request(kind="pairs", fields=("right",), layout="single")

SceneScores = dict[tuple[str, Pair], PairScores]


def score_scene(
    work: SceneWork, after_frames: Advance, *, tools: Tools | None = None
) -> SceneScores:
    """Return the scores of each candidate and pair of a scene.

    Args:
        work: What to score.
        after_frames: Called with how many frames of pairs were scored since; there the work may
            be called off.
        tools: What the metrics are computed with, where they were loaded before.

    Raises:
        PredictionFault: If a prediction is not what it must be, and faults are not counted.
        StorageError: If a file of the data is missing or altered.
        MediaError: If a video of the data does not decode.
        ExtraError: If a package or weights that a metric needs are not there.
    """
    tools = tools or tools_of(work.protocol)
    scorers = {
        (candidate.name, wanted.pair): PairScorer(tools)
        for candidate in work.candidates
        for wanted in work.wanted
    }
    with ExitStack() as stack:
        views = {
            candidate.name: stack.enter_context(closing(candidate.open(work.index)))
            for candidate in work.candidates
        }
        stored = stack.enter_context(closing(SampleLoader(work.index, _STORED_RIGHT)))
        for frames in _loaded(work):
            for wanted in work.wanted:
                targets = [
                    TargetFrame(
                        sample,
                        tools.protocol,
                        frames.matcher(tools),
                        stored_right=partial(_stored_right, stored, work, wanted.pair, sample),
                    )
                    for sample in frames.samples[wanted.pair]
                ]
                for name, given in views.items():
                    scorer = scorers[name, wanted.pair]
                    _score(scorer, given, wanted, targets, faults=work.faults)
                after_frames(len(targets))
    with one_thread():
        return {place: scorer.scores() for place, scorer in scorers.items()}


def _stored_right(loader: SampleLoader, work: SceneWork, pair: Pair, sample: Sample) -> Any:
    """Return the right view of a sample at its stored size."""
    row = list(work.index.column("key")).index(work.scene)
    address = Address(row, pair[0], (pair[1],), (int(sample["frame_index"]),))
    return loader.load(address, clip="frame", generator=np.random.default_rng(0))["right"]


def _score(
    scorer: PairScorer,
    views: Views,
    wanted: Wanted,
    targets: Sequence[TargetFrame],
    *,
    faults: Faults,
) -> None:
    if scorer.fault:
        return
    try:
        pictures = views.read(wanted, [target.sample for target in targets])
    except PredictionFault as fault:
        if faults == "raise":
            raise
        scorer.fault = str(fault)
        return
    with one_thread():
        scorer.add(pictures, targets)


@dataclass(frozen=True, slots=True, eq=False)
class _LoadedFrames:
    """The samples of some frames; pictures of one camera and frame are one array."""

    samples: dict[Pair, list[Sample]]
    found: dict[int, tuple[Any, Keypoints]] = field(default_factory=dict)

    def matcher(self, tools: Tools) -> KeypointMatcher | None:
        """Return the matcher, which looks at each of these pictures once."""
        if "e_match" not in tools.protocol.metrics:
            return None
        return _OnceAPicture(tools.keypoint_matcher, self.found)


def _loaded(work: SceneWork) -> Iterator[_LoadedFrames]:
    """Yield the samples of a few frames after each other."""
    needed = {*work.protocol.fields, *(each for one in work.candidates for each in one.inputs)}
    request = Request(
        kind="pairs",
        fields=tuple(name for name in PAIR_FIELDS if name in needed),
        layout="single",
        size=work.protocol.size,
        depth=work.protocol.depth,
    )
    rows = {str(key): row for row, key in enumerate(work.index.column("key"))}
    frames = work.wanted[0].frames
    with closing(SampleLoader(work.index, request)) as loader:
        for start in range(0, len(frames), work.protocol.batch_frames):
            chosen = frames[start : start + work.protocol.batch_frames]
            samples: dict[Pair, list[Sample]] = {wanted.pair: [] for wanted in work.wanted}
            for frame in chosen:
                pictures: dict[int, Any] = {}
                for source, target in samples:
                    address = Address(rows[work.scene], source, (target,), (frame,))
                    sample = loader.load(address, clip="frame", generator=np.random.default_rng(0))
                    sample["left"] = pictures.setdefault(source, sample["left"])
                    sample["right"] = pictures.setdefault(target, sample["right"])
                    samples[source, target].append(sample)
            yield _LoadedFrames(samples)


@dataclass(frozen=True, slots=True)
class _OnceAPicture:
    """A keypoint matcher that keeps what it found in each picture, by the picture's identity."""

    matcher: KeypointMatcher
    found: dict[int, tuple[Any, Keypoints]]

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
