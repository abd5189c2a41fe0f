"""Scoring one scene: each view is decoded once, each frame scored for every pair and candidate.

A few frames are in memory at a time, so that learned parts get batches; of clips, whose features
need all their frames, those of one scene.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final, Literal

import numpy as np

from stereogenbench_data.engine import Advance
from stereogenbench_data.evaluation.candidates import Candidate, Views
from stereogenbench_data.evaluation.frame_scores import PairScorer, PairScores, TargetFrame
from stereogenbench_data.evaluation.one_thread import one_thread
from stereogenbench_data.evaluation.predictions import Pair, PredictionFault, Wanted
from stereogenbench_data.evaluation.protocol import EvaluationProtocol, Tools, tools_of
from stereogenbench_data.evaluation.protocols import KeypointMatcher, Keypoints, Settings
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.fields import PAIR_FIELDS
from stereogenbench_data.samples.load import Request, Sample, SampleLoader
from stereogenbench_data.selection.plan import Address

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
