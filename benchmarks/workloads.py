"""The workloads of the races: their samples, and the slice that each contestant loads.

For contestants that read videos forwards (ours, the limit, scene-wise decoders) every frame costs
the same, so their slice is the first ``window`` frames of each scene. For those that start again at
every sample, later frames cost more, so their slice is drawn from *all* samples of the workload,
spread evenly over the video. Both are samples of the same workload.

Of as many scenes as the release has nobody goes through all. Ours, whose order depends on their
number, has all of them, and is timed for a while after it has begun; the others, for which a scene
costs the same among any number of them, go through a few.
"""

import itertools
import os
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from benchmarks.material import EIGHT, MANY, WHOLE, Material
from stereogenbench_data import StereoPairs
from stereogenbench_data.index.table import SceneIndex

Reading = Literal["forwards", "anywhere"]

SEED: Final = 7


@dataclass(frozen=True, slots=True)
class Wanted:
    """One sample: the scene's key, the two cameras, and its frames."""

    scene: str
    left: int
    right: int
    frames: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Target:
    """The targets of the ratios to the limit and to the naive loader."""

    limit: float
    naive: float


@dataclass(frozen=True)
class Workload:
    """One workload.

    Attributes:
        name: Its short name, for ``--only``.
        title: Its name in tables.
        scenes: The number of scenes.
        frames: `StereoPairs`'s ``frames``, for all of the workload.
        window: The same for the slice of contestants that read forwards.
        pairs: "primary" or "all".
        size: (height, width) that pictures are scaled to; None for the stored size.
        both_ways: Whether samples have the disparity of the right view too.
        batch: Samples in a batch.
        few: Samples in the slice of contestants that start again at every sample.
        workers: Worker processes, the first being the headline.
        target: The target ratios, if any.
        more: Further contestants in this workload.
        field: Contestants in this workload instead of the usual ones.
        part: The scenes that contestants other than ours go through; 0 is all, by all contestants.
        begun: Batches of ours that are not timed where there is a part: each of the scenes that are
            open then begins at some frame, and what lies before is decoded, too.
    """

    name: str
    title: str
    scenes: int
    frames: Any
    window: Any
    pairs: Literal["primary", "all"] = "primary"
    size: tuple[int, int] | None = None
    both_ways: bool = False
    batch: int = 2
    few: int = 4
    workers: tuple[int, ...] = (2,)
    target: Target | None = None
    more: tuple[str, ...] = ()
    field: tuple[str, ...] = ()
    part: int = 0
    begun: int = 0

    @property
    def is_clip(self) -> bool:
        """Whether samples have a time axis."""
        return isinstance(self.frames, tuple) and "clip" in self.frames[0]

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields of a sample of every contestant."""
        maps = ("disparity", "disparity_right") if self.both_ways else ("disparity",)
        return ("left", "right", *maps, "baseline_m", "frame_index", "pair", "scene")


_POWERS: Final = tuple(count for count in (1, 2, 4, 8, 16) if count <= max(2, os.cpu_count() or 1))

WORKLOADS: Final = (
    Workload(
        "first", "primary pair, first frame, 1280", 24, "first", "first", few=8,
        target=Target(0.85, 1.2),
    ),
    Workload(
        "all-frames", "primary pair, 12 frames of each of 8 scenes, 1280", 8, "all", range(12),
        workers=(2, 0, 1, 4), target=Target(0.85, 15), more=("ours-shards",),
    ),
    Workload(
        "all-pairs", f"all 15 pairs, all frames, both disparities, 1280, {WHOLE:,} scenes", WHOLE,
        "all", range(4), pairs="all", both_ways=True, batch=8, target=Target(0.75, 60),
        part=4, begun=16,
    ),
    Workload(
        "all-pairs-832", "all 15 pairs, all frames, both disparities, 832x480", 4, "all", range(4),
        pairs="all", both_ways=True, size=(480, 832), target=Target(0.85, 60),
        more=("ours-shards",),
    ),
    Workload(
        "clips", "16-frame clips, primary pair, 1280", 6, ("clips", 16, 1, 16),
        ("clips", 16, 1, 16), batch=1, target=Target(0.85, 3),
    ),
    Workload(
        "clips-longer", "16-frame clips, primary pair, 1280, of more scenes", 16,
        ("clips", 16, 1, 16), ("clips", 16, 1, 16), batch=1, field=("limit", "ours"),
    ),
    Workload(
        "random", "random single frames, 8 a scene, 1280", 4, ("random", 8), ("random", 8),
        target=Target(0.7, 3), more=("ours-shards",),
    ),
    Workload(
        "release-size", f"primary pair, all frames shuffled, 1280, {WHOLE:,} scenes", WHOLE, "all",
        range(12), batch=8, target=Target(0.85, 15), part=16, begun=16,
    ),
    Workload(
        "workers", f"the same {WHOLE:,} scenes by any number of workers", WHOLE, "all", range(12),
        batch=8, workers=_POWERS, field=("limit", "ours"), part=16, begun=16,
    ),
)  # fmt: skip


def tiny(workload: Workload) -> Workload:
    """Return a workload for tests: a few frames of a few scenes."""
    short: dict[Any, Any] = {"clips": ("clips", 2, 1, 2), "random": ("random", 2)}
    kind = workload.frames[0] if isinstance(workload.frames, tuple) else workload.frames
    frames = short.get(kind, workload.frames)
    return replace(
        workload, scenes=min(workload.scenes, 2), few=2, frames=frames, workers=(0,), batch=1,
        window=range(2) if isinstance(workload.window, range) else frames,
        size=None if workload.size is None else (24, 40), part=0,
    )  # fmt: skip


@dataclass(frozen=True)
class Job:
    """A workload on its data, as a contestant gets it.

    Attributes:
        workload: The workload.
        material: The data.
        reading: Whether the slice is that of forward readers, or a random choice of all samples.
    """

    workload: Workload
    material: Material
    reading: Reading = "forwards"

    @cached_property
    def tree(self) -> Path:
        """The released folder that this workload reads."""
        material, scenes = self.material, self.workload.scenes
        if scenes > MANY:
            return material.whole
        return material.many if scenes > EIGHT else material.eight

    def of_part(self) -> "Job":
        """Return the job of contestants that go through a part of the scenes, if there is one."""
        part = self.workload.part
        return replace(self, workload=replace(self.workload, scenes=part, part=0)) if part else self

    @cached_property
    def keys(self) -> list[str]:
        """The keys of the scenes, equally many of both families."""
        keys = SceneIndex.open(self.tree).column("key").tolist()
        half = len(keys) // 2
        mixed = [key for both in zip(keys[:half], keys[half:], strict=True) for key in both]
        return mixed[: self.workload.scenes]

    @property
    def selection(self) -> dict[str, Any]:
        """The selection, as options of `StereoPairs`."""
        workload = self.workload
        frames = workload.window if self.reading == "forwards" else workload.frames
        return {
            "scenes": self.keys,
            "pairs": workload.pairs,
            "frames": list(frames) if isinstance(frames, range) else frames,
            "size": workload.size,
            "fields": workload.fields,
            "seed": SEED,
        }

    @cached_property
    def numbers(self) -> list[int]:
        """The numbers of the slice's samples: in order for forward readers, else from all.

        The latter are one of each of ``few`` equal shares of the samples by their last frame, so
        their mean position in a video is that of all samples. Early and late ones alternate, so two
        workers that take turns have equal work.
        """
        pairs = self._pairs
        count = len(pairs)
        if self.reading == "forwards":
            return list(range(count))
        drawn = np.random.default_rng(SEED).permutation(count)
        last = [pairs.plan.locate(int(number), epoch=0).frames[-1] for number in drawn]
        by_place = drawn[np.argsort(last, kind="stable")]
        few = min(self.workload.few, count)
        shares = [int((share + 0.5) * count / few) for share in range(few)]
        turns = [shares[place : place + 2] for place in range(0, few, 2)]
        turns[1::2] = [two[::-1] for two in turns[1::2]]
        return [int(by_place[share]) for two in turns for share in two]

    @cached_property
    def wanted(self) -> list[Wanted]:
        """The samples of the slice."""
        pairs = self._pairs
        keys = pairs.index.column("key")
        found = []
        for number in self.numbers:
            address = pairs.plan.locate(number, epoch=0)
            (right,) = address.targets
            found.append(Wanted(str(keys[address.row]), address.source, right, address.frames))
        return found

    @property
    def _pairs(self) -> StereoPairs:
        return StereoPairs(self.tree, **self.selection)

    @property
    def files(self) -> list[str]:
        """The names of the files that the samples need."""
        # Imported here: the module of the rig needs `Wanted`.
        from benchmarks.contestants.rig import camera_files

        wanted = itertools.chain(*self.of_scene.values())
        return ["baseline.json", *camera_files(wanted, both_ways=self.workload.both_ways)]

    @cached_property
    def of_scene(self) -> dict[str, list[Wanted]]:
        """The samples of each scene."""
        scenes: dict[str, list[Wanted]] = {}
        for wanted in self.wanted:
            scenes.setdefault(wanted.scene, []).append(wanted)
        return scenes
