"""Training shards against the release: what a sample costs that training reads at 832x480.

The limits are bare PyAV loops, one over the released videos and one over the training shards, which
decode each needed picture once and write every array once. Costs are of one process, and include
opening files. In a loop over random frames or clips, the limit seeks to the key frame before. The
loops go through the scenes in their order, so ours runs in that order too, beside the shuffled one.
"""

import json
import resource
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from benchmarks.clock import in_a_fork
from benchmarks.contestants import limit, ours
from benchmarks.material import Material
from benchmarks.results import Report, machine
from benchmarks.workloads import Job, Workload
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.media.depth_frames import DepthFrames
from stereogenbench_data.schema.release import BASELINE_JSON
from stereogenbench_data.shards.pack import pack
from stereogenbench_data.shards.training import TrainingSettings
from stereogenbench_data.sources.members import MemberSource

SIZE: Final = (480, 832)

WORKLOADS: Final = (
    (Workload("all frames", "primary pair, all frames", 8, "all", "all", size=SIZE, batch=8), 5),
    (
        Workload(
            "all pairs", "all 15 pairs, both disparities", 4, "all", "all", pairs="all",
            both_ways=True, size=SIZE, batch=8,
        ),
        4,
    ),
    (
        Workload(
            "random frame", "one random frame a scene", 8, ("random", 1), ("random", 1), size=SIZE
        ),
        40,
    ),
    (
        Workload(
            "random frames", "8 random frames a scene", 8, ("random", 8), ("random", 8), size=SIZE
        ),
        8,
    ),
    (
        Workload(
            "random clip", "one random clip of 16 frames a scene", 8, ("random clips", 1, 16),
            ("random clips", 1, 16), size=SIZE, batch=1,
        ),
        5,
    ),
)  # fmt: skip
"""Each with the mark for training shards against the limit of the release."""

MARK_OWN: Final = 0.85
"""The mark for training shards against a bare loop over themselves."""


class _Pictures(limit.Stream):
    """The pictures of a video in a shard: on from the last, or from the key frame before."""

    def _frame(self, index: int) -> Any:
        video = self.container.streams.video[0]
        ticks = round(index / (video.time_base * video.average_rate))
        if index != self._at + 1:
            self.container.seek(ticks, stream=video)
            self._decoded = self.container.decode(video)
        self._at = index
        return next(frame for frame in self._decoded if frame.pts >= ticks)


class _Depth(DepthFrames):
    """The depth of a shard; keeps the last map."""

    _at, _kept = -1, np.empty(0)

    def units(self, index: int) -> np.ndarray:
        """Return the stored depth of a frame."""
        if index != self._at:
            self._at, self._kept = index, super().units(index)
        return self._kept

    def unit_m(self) -> float:
        """Return the metres in a stored unit."""
        tags = {**self.clip.tags, **self.clip.stream_tags}
        return next(float(value) for key, value in tags.items() if "scale" in key.lower())


def opener(folder: Path) -> Callable[..., limit.Opened]:
    """Return what opens the videos of training shards for a bare loop."""
    index = SceneIndex.open(folder)
    source = MemberSource(index.root, shards=index.shards, revision=index.digest)
    scenes = {scene.id.key: scene for scene in map(index.scene, range(len(index)))}

    def opened(job: Job, key: str, names: Sequence[str]) -> limit.Opened:
        scene = scenes[key]
        size = scene.rig.image_height_px, scene.rig.image_width_px
        streams = {
            name: _Depth(source.open(scene, name), name=name, frames="any")
            if name.endswith(".mkv")
            else _Pictures(source.open(scene, name), size)
            for name in names
        }
        return json.loads(source.read(scene, BASELINE_JSON)), streams

    return opened


def measure_training(material: Material, *, rounds: int, report: Report) -> dict[str, Any]:
    """Return the section of the results: the machine, and seconds a sample by workload.

    Each contestant runs in a process of its own, in turn, and the fastest of its runs counts.
    """
    size = SIZE if material.size_px >= SIZE[1] else (material.size_px // 2,) * 2  # in tests
    shards = material.root / "training"
    if not (shards / "index.parquet").exists():
        report(f"packing {shards}")
        pack(material.eight, shards, training=TrainingSettings(size))
    rows: dict[str, Any] = {}
    for workload, mark in WORKLOADS:
        job = Job(replace(workload, size=size), material)
        list(job.of_scene)  # computed before the clock starts
        ways: dict[str, Callable[[], Iterable[Any]]] = {
            "released": partial(limit.samples, job, job.of_scene),
            "training": partial(limit.samples, job, job.of_scene, opened=opener(shards)),
            "ours, released": partial(ours.mapped, job, job.tree),
            "ours, training": partial(ours.mapped, job, shards),
            "ours, in order": partial(ours.mapped, job, shards, shuffle=False),
        }
        found: dict[str, list[float]] = {name: [] for name in ways}
        for number in range(rounds):
            report(f"training: {workload.name}, round {number + 1} of {rounds}")
            for name, way in ways.items():
                cpu_s = in_a_fork(partial(_cpu_s, way))
                found[name].append(cpu_s / len(job.wanted))
        rows[workload.name] = {
            "title": workload.title,
            "mark": mark,
            "cpu_s": {name: min(took) for name, took in found.items()},
        }
    return {"machine": machine(), "rows": rows}


def _cpu_s(way: Callable[[], Iterable[Any]]) -> float:
    """Return the processor seconds that it takes to go through samples or batches.

    One is taken before: what a process loads once does not count.
    """
    torch.set_num_threads(1)
    next(iter(way()))
    before = resource.getrusage(resource.RUSAGE_SELF)
    for _ in way():
        pass
    after = resource.getrusage(resource.RUSAGE_SELF)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
