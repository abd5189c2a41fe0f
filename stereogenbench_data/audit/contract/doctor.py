"""The doctor: find out which depth encoding explains the pictures of a data set.

Matching along the rows of two pictures gives disparity without any depth. Each hypothesis on the
contract predicts another disparity for the same pixels, at which the pictures are compared. The
declared contract is changed as little as the pictures ask for. The report names all contracts that
fit equally well.

Unit, focal length and baselines enter disparity as one quotient. So the pictures do not show which
of them is wrong, and two wrong ones may cancel out.
"""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from stereogenbench_data.audit.contract import limits
from stereogenbench_data.audit.contract.diagnosis import SceneDiagnosis, diagnose_scene
from stereogenbench_data.audit.contract.row_matches import SceneFrames
from stereogenbench_data.audit.contract.stretch import stretch_of
from stereogenbench_data.audit.contract.verdict import Verdict, group_by_contract, judge
from stereogenbench_data.audit.contract.worlds import (
    Shares,
    WorldVerdict,
    explained_shares,
    is_stated,
    judge_worlds,
    rival_readings,
)
from stereogenbench_data.audit.scene_access import source_of, spread
from stereogenbench_data.engine import LOCAL, Advance, Engine, Progress
from stereogenbench_data.errors import StorageError
from stereogenbench_data.geometry.pose_evidence import poses_of, shape_of
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.load import Streams
from stereogenbench_data.schema.conventions import depth_of
from stereogenbench_data.schema.records import DepthEncoding, Scene
from stereogenbench_data.schema.release import CAMERA_COUNT, TRAJECTORY_JSON
from stereogenbench_data.selection.filters import SceneFilters, filter_scenes
from stereogenbench_data.sources.members import MemberSource

_MOST_KEPT_PIXELS: Final = 5 * 2**20
"""How much of each video stays decoded: every lag for small pictures."""


@dataclass(frozen=True, slots=True)
class DoctorReport:
    """The diagnosis of a data set.

    Attributes:
        data: The root of the data.
        scenes: Each scene's own diagnosis, sorted by key.
        verdicts: One for each group of scenes with the same contract, the largest group first.
        left_out: Maps the keys of scenes that cannot be judged to the reason.
        worlds: Which of several readings of the poses is right, for each shape of files of which
            not one alone fits the rigs.
    """

    data: str
    scenes: tuple[SceneDiagnosis, ...]
    verdicts: tuple[Verdict, ...]
    left_out: dict[str, str]
    worlds: tuple[WorldVerdict, ...] = ()

    @property
    def is_wrong(self) -> bool:
        """Whether another contract or reading of poses is clearly better, or a camera is odd."""
        return any(each.is_wrong for each in self.verdicts) or any(
            each.is_wrong for each in self.worlds
        )


@dataclass(frozen=True, slots=True)
class DiagnosisTask:
    """One scene to diagnose; can be sent to worker processes."""

    scene: Scene
    source: MemberSource
    frames: int
    encoding: DepthEncoding

    @contextmanager
    def scene_frames(self) -> Iterator[SceneFrames]:
        """Open the scene's videos."""
        pixels = self.scene.rig.image_width_px * self.scene.rig.image_height_px
        kept = max(1, _MOST_KEPT_PIXELS // pixels)
        with closing(Streams(self.source, kept_frames=kept)) as streams:
            yield SceneFrames(self.scene, streams, encoding=self.encoding)


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
    """Return which depth encoding the pictures of some scenes confirm.

    Args:
        data: What `SceneIndex.open` takes, or an index.
        scenes: How many scenes to diagnose, at least 1, spread over those that pass the filters.
        frames: How many frames of each scene, at least 1.
        depth: The contract under test; None for what files, conventions and release state.
        workers: Number of processes, None for one a core.
        engine: Where they run: `engine.LOCAL`, or an `engine.RayCluster`.
        progress: Called with the number of scenes done and of all scenes.
        filters: Which scenes; None for all.

    Raises:
        SelectionError: If no scene passes the filters.
        StorageError: If a file cannot be read.
        MediaError: If a video does not decode to what the index says.
    """
    index = data if isinstance(data, SceneIndex) else SceneIndex.open(data)
    index.require_released("The doctor")
    rows = filter_scenes(index, filters or {})
    residual_px = index.column("rig_residual_px")[rows]
    is_whole = index.video_counts()[rows] == 2 * CAMERA_COUNT
    left_out = {
        str(index.column("key")[row]): (
            f"its rig is not rectified (by {residual:.3g} px)" if whole
            else index.scene(int(row)).remark("videos").partition("; ")[0]
            or "not all videos of its six cameras are there, and the doctor compares all"
        )
        for row, residual, whole in zip(rows, residual_px, is_whole, strict=True)
        if not (whole and residual <= limits.MOST_RESIDUAL_PX)
    }  # fmt: skip
    if not is_whole.any():
        key, reason = next(iter(left_out.items()))
        raise StorageError(
            f"{index.where}: no scene has all videos of its six cameras, and the doctor compares "
            f"all. The first: {key}: {reason}. Fetch them again, or download the other cameras too."
        )
    usable = rows[is_whole & (residual_px <= limits.MOST_RESIDUAL_PX)]
    chosen = usable[list(spread(len(usable), scenes))]
    tasks = [
        DiagnosisTask(scene, source_of(index, scene), frames, depth or depth_of(scene))
        for scene in (index.scene(int(row)) for row in chosen)
    ]
    found: list[SceneDiagnosis] = []
    shares: dict[str, Shares] = {}
    results = engine.map(_diagnose, tasks, name=lambda task: task.scene.id.key, workers=workers)
    with closing(results):
        for diagnosis, explained in results:
            found.append(diagnosis)
            shares |= {diagnosis.key: explained} if explained else {}
            if progress is not None:
                progress(len(found), len(tasks))
    found.sort(key=lambda diagnosis: diagnosis.key)
    verdicts = tuple(map(judge, group_by_contract(found)))
    worlds: dict[tuple[str, str], list[Shares]] = {}
    for scene in (task.scene for task in tasks if task.scene.id.key in shares):
        taken = str(scene.pose_form)
        is_one = is_stated(scene) and "|" not in taken
        about = shape_of(taken), taken if is_one else ""
        worlds.setdefault(about, []).append(shares[scene.id.key])
    judged = tuple(judge_worlds(each, stated=stated) for (_, stated), each in worlds.items())
    return DoctorReport(index.where, tuple(found), verdicts, left_out, judged)


def _diagnose(task: DiagnosisTask, after_bytes: Advance) -> tuple[SceneDiagnosis, Shares]:
    """Return a scene's diagnosis, and what each reading of its poses explains if several fit."""
    after_bytes(0)
    scene = task.scene
    with task.scene_frames() as views:
        shares: Shares = {}
        if scene.pose_form and (scene.remark("world") or is_stated(scene)):
            text = task.source.read(scene, TRAJECTORY_JSON)
            names = rival_readings(scene, text)
            shares = explained_shares(views, text, names) if len(names) > 1 else {}
        diagnosis = diagnose_scene(views, frames=task.frames)
        if not (diagnosis.problem or scene.remark("poses", "world", "left")):
            text = task.source.read(scene, TRAJECTORY_JSON)
            poses = poses_of(scene, text, where=scene.id.key)
            if diagnosis.is_scaled and diagnosis.best == diagnosis.declared:
                measured_m = diagnosis.unit_m / diagnosis.scale
                views = views.read_as(replace(views.encoding, unit_m=measured_m))
            diagnosis = replace(diagnosis, stretch=stretch_of(views, poses))
        return diagnosis, shares
