"""The time to score one scene, beside decoding and resizing alone plus the time of the matchers.

It is part of the benchmark, and runs alone as ``python -m benchmarks.evaluation [--frames 81]
[--size 1280] [--out FILE]``. It draws one scene, writes its right views as PNG predictions, scores
them by the offline metrics at 832x480 in one process, and prints JSON. It measures processor time,
which other work on the machine hardly changes.
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.results import Report, spread_of
from stereogenbench_data.evaluation.evaluate import Workload, select_workload
from stereogenbench_data.evaluation.frame_metrics import MetricModels
from stereogenbench_data.evaluation.predictions import PredictionFolder, frame_name, item_name
from stereogenbench_data.evaluation.protocol import EvaluationProtocol
from stereogenbench_data.evaluation.scene_scores import SceneWork, one_thread, score_scene
from stereogenbench_data.samples.streams import Streams
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.schema.release import depth_name, rgb_name
from stereogenbench_data.sources.members import MemberSource
from stereogenbench_data.synthesis import synthesise
from stereogenbench_data.synthesis.request import SynthRequest

LIMIT = 3.0
"""Scoring may take so many times the decoding, beside what the matchers take."""


FRAMES = 12
"""Frames of the scene by default; all times are in proportion to them."""


class Stopwatch:
    """Adds up the processor time of calls."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def timed(self, call: Callable[..., Any]) -> Callable[..., Any]:
        """Return the call with its time added up."""

        def timed_call(*arguments: Any, **options: Any) -> Any:
            start = time.process_time()
            try:
                return call(*arguments, **options)
            finally:
                self.seconds += time.process_time() - start

        return timed_call


class TimedMatcher:
    """A matcher whose calls are timed."""

    def __init__(self, matcher: Any, watch: Stopwatch) -> None:
        self.name, self.settings = matcher.name, matcher.settings
        for name in ("detect", "match"):
            if hasattr(matcher, name):
                setattr(self, name, watch.timed(getattr(matcher, name)))
        self._call = watch.timed(matcher) if callable(matcher) else None

    def __call__(self, *views: Any) -> Any:
        """Return the result of the stereo matcher."""
        return self._call(*views) if self._call else None


def measure_evaluation(*, rounds: int, report: Report) -> dict[str, Any]:
    """Return the section of the results on scoring."""
    report(f"evaluation: drawing and scoring {FRAMES} frames")
    return measure(frames=FRAMES, size_px=1280, rounds=rounds)


def measure(
    *, frames: int, size_px: int, rounds: int = 1, workers: int | None = None
) -> dict[str, Any]:
    """Return the times of one scene in seconds of processor time, and their ratio."""
    with tempfile.TemporaryDirectory(prefix="stereogenbench-bench-") as temporary:
        root, predictions = Path(temporary) / "scenes", Path(temporary) / "predictions"
        request = SynthRequest(
            family="Uniform", scenes=1, size_px=size_px, frames=frames, seed=5, split="eval"
        )
        synthesise(root, request, workers=workers or os.cpu_count() or 1)
        protocol = EvaluationProtocol()
        workload = select_workload(root, protocol, inputs=(), options={})
        _write_right_views(workload, predictions)
        with one_thread():
            _decode(workload, predictions)  # once unmeasured: files in memory, libraries loaded
            found = [
                (_seconds(lambda: _decode(workload, predictions)),
                 *_score(workload, predictions, protocol))
                for _ in range(rounds)
            ]  # fmt: skip
    beside = spread_of((scored - matched) / decoded for decoded, scored, matched in found)
    decoding_s, scoring_s, matchers_s = (
        statistics.median(times) for times in zip(*found, strict=True)
    )
    return {
        "what": "one scene scored by the offline metrics",
        "frames": frames,
        "stored_px": size_px,
        "scored_at": "832x480",
        "rounds": rounds,
        "decoding_and_resizing_s": round(decoding_s, 3),
        "matchers_s": round(matchers_s, 3),
        "scoring_s": round(scoring_s, 3),
        "beside_matchers_over_decoding": beside,
        "limit": LIMIT,
        "versions": {
            "python": sys.version.split()[0],
            **{name: version(name) for name in ("stereogenbench-data", "numpy", "av", "torch")},
        },
    }


def _seconds(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def _write_right_views(workload: Workload, folder: Path) -> None:
    ((wanted,),) = workload.pairs
    scene = workload.index.scene(workload.rows[0])
    target = folder / item_name(wanted.scene, wanted.pair)
    target.mkdir(parents=True)
    with closing(_streams(workload)) as streams:
        for frame in wanted.frames:
            view = streams.rgb(scene, rgb_name(wanted.pair[1]), frame, size=wanted.size)
            picture = Image.fromarray(np.ascontiguousarray(view.transpose(1, 2, 0)))
            picture.save(target / frame_name(frame), compress_level=1)


def _streams(workload: Workload) -> Streams:
    index = workload.index
    return Streams(MemberSource(index.root, shards=index.shards, revision=index.digest))


def _decode(workload: Workload, predictions: Path) -> None:
    """Decode and resize all that scoring reads; do nothing else."""
    ((wanted,),) = workload.pairs
    scene = workload.index.scene(workload.rows[0])
    encoding = DepthEncoding(unit_m=scene.depth_unit_m[0])
    folder = predictions / item_name(wanted.scene, wanted.pair)
    with closing(_streams(workload)) as streams:
        for frame in wanted.frames:
            for camera in wanted.pair:
                streams.rgb(scene, rgb_name(camera), frame, size=wanted.size)
                name = depth_name(camera)
                streams.read_stored_depth(scene, name, frame, encoding=encoding, size=wanted.size)
            with Image.open(folder / frame_name(frame)) as picture:
                np.ascontiguousarray(np.asarray(picture).transpose(2, 0, 1))


def _score(
    workload: Workload, predictions: Path, protocol: EvaluationProtocol
) -> tuple[float, float]:
    """Return the times of scoring and of its matchers."""
    watch = Stopwatch()
    models = MetricModels(protocol)
    models.keypoint_matcher = TimedMatcher(models.keypoint_matcher, watch)
    models.stereo_matcher = TimedMatcher(models.stereo_matcher, watch)
    work = SceneWork(
        index=workload.index,
        pairs=workload.pairs[0],
        protocol=protocol,
        sources=(PredictionFolder("right views", predictions),),
    )
    seconds = _seconds(lambda: score_scene(work, lambda done: None, models=models))
    return seconds, watch.seconds


def main() -> None:
    """Measure, print JSON, and write it if ``--out`` is given."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--size", type=int, default=1280)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    text = json.dumps(measure(frames=arguments.frames, size_px=arguments.size), indent=1)
    sys.stdout.write(text + "\n")
    if arguments.out is not None:
        arguments.out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
