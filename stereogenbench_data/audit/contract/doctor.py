"""The depth contract, measured: which of many explains what the pictures themselves show.

Pixels that are found again along the rows of the other picture give disparity without any depth.
Every hypothesis on the contract predicts another disparity for them; the pictures are compared
at that disparity, on the same pixels for all. The declared contract is changed as little as the
pictures ask for. Where two contracts fit alike, the report names both.

What cannot be seen: unit, focal length and baselines enter disparity as one quotient, so that a
wrong one looks like a wrong other, and two may make up for each other.
"""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from stereogenbench_data.audit.contract.diagnosis import SceneDiagnosis, diagnose_scene
from stereogenbench_data.audit.contract.matching import SceneFrames
from stereogenbench_data.audit.contract.verdict import Verdict, group_by_contract, judge
from stereogenbench_data.engine import LOCAL, Advance, Engine
from stereogenbench_data.errors import SelectionError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.streams import Streams
from stereogenbench_data.schema.records import DepthEncoding, Scene, ShardFacts
from stereogenbench_data.selection.filters import SceneFilters, filter_scenes
from stereogenbench_data.sources.members import MemberSource
from stereogenbench_data.sources.retry import RetryPolicy

MOST_RESIDUAL_PX: Final = 0.5
"""Rigs that are further from rectified are left out: disparity alone does not explain them."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class DoctorReport:
    """What the pictures say.

    Attributes:
        data: The root of the data.
        declared: The contract under test.
        scenes: Each scene's own diagnosis, sorted by key.
        verdicts: One for each group of scenes with one contract, the largest group first.
        left_out: Key to the reason, for scenes that could not be judged.
    """

    data: str
    declared: DepthEncoding
    scenes: tuple[SceneDiagnosis, ...]
    verdicts: tuple[Verdict, ...]
    left_out: dict[str, str]

    @property
    def is_wrong(self) -> bool:
        """Whether for some scene another contract is clearly better, or a camera does not fit."""
        return any(verdict.is_wrong for verdict in self.verdicts)


@dataclass(frozen=True, slots=True)
class DiagnosisTask:
    """One scene to be judged, in whatever process."""

    scene: Scene
    root: str
    shards: dict[str, ShardFacts]
    revision: str
    frames: int
    encoding: DepthEncoding
    retry: RetryPolicy | None = None

    def streams(self) -> Streams:
        """Return the scene's videos."""
        source = MemberSource(
            self.root, shards=self.shards, revision=self.revision, retry=self.retry
        )
        return Streams(source)


def diagnose(  # noqa: PLR0913 - each names one thing that a user chooses
    data: str | Path | SceneIndex,
    *,
    scenes: int = 6,
    frames: int = 4,
    depth: DepthEncoding | None = None,
    workers: int | None = None,
    engine: Engine = LOCAL,
    progress: Progress | None = None,
    filters: SceneFilters | None = None,
) -> DoctorReport:
    """Return which depth contract the pictures of some scenes confirm.

    Args:
        data: What `SceneIndex.open` takes, or an index.
        scenes: How many scenes to look at, spread over those that pass the filters.
        frames: How many frames of each, in up to five pairs.
        depth: The contract to ask about; None for what files and release state.
        workers: Processes, None for one a core.
        engine: Where they are: `engine.LOCAL`, or an `engine.RayCluster`.
        progress: Called with the scenes done and all there are.
        filters: Which scenes; None for all.

    Raises:
        SelectionError: If no scene passes the filters, or a number is below 1.
        StorageError: If a file cannot be read.
        MediaError: If a video does not decode to what the index says.
    """
    if scenes < 1 or frames < 1:
        raise SelectionError(
            f"scenes and frames must be at least 1, got {scenes} and {frames}: ask for more."
        )
    index = data if isinstance(data, SceneIndex) else SceneIndex.open(data)
    encoding = depth or DepthEncoding()
    rows = filter_scenes(index, filters or {})
    residual_px = index.column("rig_residual_px")[rows]
    left_out = {
        str(index.column("key")[row]): f"its rig is not rectified (by {residual:.3g} px)"
        for row, residual in zip(rows, residual_px, strict=True)
        if not residual <= MOST_RESIDUAL_PX
    }
    usable = rows[residual_px <= MOST_RESIDUAL_PX]
    chosen = usable[
        np.unique(np.linspace(0, len(usable) - 1, min(scenes, len(usable))).astype(int))
    ]
    tasks = [_task(index, int(row), frames=frames, encoding=encoding) for row in chosen]
    found = []
    with closing(
        engine.map(_diagnose, tasks, name=lambda task: task.scene.id.key, workers=workers)
    ) as diagnoses:
        for diagnosis in diagnoses:
            found.append(diagnosis)
            if progress is not None:
                progress(len(found), len(tasks))
    found.sort(key=lambda diagnosis: diagnosis.key)
    verdicts = tuple(judge(group, declared=encoding) for group in group_by_contract(found))
    return DoctorReport(index.where, encoding, tuple(found), verdicts, left_out)


def scene_task(data: SceneIndex, key: str, *, encoding: DepthEncoding) -> DiagnosisTask:
    """Return the task that judges one scene by one frame."""
    (row,) = filter_scenes(data, {"scenes": key})
    return _task(data, int(row), frames=1, encoding=encoding)


def _task(index: SceneIndex, row: int, *, frames: int, encoding: DepthEncoding) -> DiagnosisTask:
    scene = index.scene(row)
    paths = {member.path for member in scene.members.values()}
    shards = {path: facts for path, facts in index.shards.items() if path in paths}
    return DiagnosisTask(scene, index.root, shards, index.digest, frames, encoding, index.retry)


def _diagnose(task: DiagnosisTask, after_bytes: Advance) -> SceneDiagnosis:
    after_bytes(0)
    with closing(task.streams()) as streams:
        views = SceneFrames(task.scene, streams, encoding=task.encoding)
        return diagnose_scene(views, frames=task.frames)
