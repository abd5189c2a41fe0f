"""Scoring a selection: scenes in parallel processes, each kept on disk as it is done."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Final

from stereogenbench_data.datasets.mapped import StereoPairs
from stereogenbench_data.engine.process_pool import AfterBytes, run_tasks
from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.candidates import Candidate
from stereogenbench_data.evaluation.partial import PartialResults
from stereogenbench_data.evaluation.predictions import Pair, PredictionFault, Wanted
from stereogenbench_data.evaluation.protocol import EvaluationProtocol
from stereogenbench_data.evaluation.scoring import SceneScores, SceneWork, score_scene
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.text import counted
from stereogenbench_data.selection.plan import Plan
from stereogenbench_data.selection.windows import Random

Progress = Callable[[int, int], None]
Place = tuple[str, Pair]

_TOLD: Final = 2


def no_progress(done: int, total: int) -> None:
    """Say nothing."""


@dataclass(frozen=True, slots=True)
class Extent:
    """What is scored: the scenes of an index with their pairs and frames.

    Attributes:
        index: The index.
        rows: The scenes' rows, ascending.
        wanted: For each scene, what is to be scored of its pairs.
    """

    index: SceneIndex
    rows: tuple[int, ...]
    wanted: tuple[tuple[Wanted, ...], ...]

    @property
    def frames(self) -> int:
        """How many frames of pairs there are."""
        return sum(len(each.frames) for pairs in self.wanted for each in pairs)


def extent_of(pairs: StereoPairs, *, size: tuple[int, int]) -> Extent:
    """Return what a dataset's selection has to be scored.

    Raises:
        EvaluationError: If its samples are clips, random frames, sweeps or right to left.
    """
    plan = pairs.plan
    chosen = plan.pairs
    if plan.windows.is_clip or isinstance(plan.windows, Random):
        raise EvaluationError(
            "frames must be 'all', 'first', numbers of frames or ('every', k): the same single "
            "frames for every method."
        )
    if chosen.targets.shape[1] != 1 or (chosen.source > chosen.targets[:, 0]).any():
        raise EvaluationError(
            "a right view is generated from the view to its left: choose pairs='primary', "
            "'adjacent', 'all' or (left, right) numbers."
        )
    wanted = [_wanted(pairs.index, plan, place, size=size) for place in range(len(plan.scene_rows))]
    return Extent(pairs.index, tuple(int(row) for row in plan.scene_rows), tuple(wanted))


def _wanted(
    index: SceneIndex, plan: Plan, place: int, *, size: tuple[int, int]
) -> tuple[Wanted, ...]:
    scene = index.scene(int(plan.scene_rows[place]))
    windows = plan.windows.count(scene.frames)
    frames = tuple(
        plan.windows.window(number, frames=scene.frames, draw=(0,))[0] for number in range(windows)
    )
    first, last = int(plan.first_pair[place]), int(plan.first_pair[place + 1])
    return tuple(
        Wanted(
            scene=scene.id.key,
            pair=(int(plan.pairs.source[number]), int(plan.pairs.targets[number, 0])),
            frames=frames,
            scene_frames=scene.frames,
            size=size,
            stored_size=(scene.rig.image_height_px, scene.rig.image_width_px),
        )
        for number in range(first, last)
    )


@dataclass(frozen=True, slots=True)
class Run:
    """How a selection is scored.

    Attributes:
        protocol: The choices that scores depend on.
        candidates: Whose right views are scored.
        allow_missing: How many right views of pairs may be missing or unusable, and are counted.
        workers: How many processes, None for one a core.
        beside: For each scene, by key, the one that candidates read beside it, if any.
    """

    protocol: EvaluationProtocol
    candidates: tuple[Candidate, ...]
    allow_missing: int = 0
    workers: int | None = None
    beside: Mapping[str, str] = field(default_factory=dict)


def score_all(extent: Extent, run: Run, *, partial: PartialResults, progress: Progress) -> None:
    """Score what is not scored yet, and keep each scene's scores as soon as it is done.

    Raises:
        PredictionFault: If a right view is missing or is not what it must be, and is not allowed.
        EvaluationError: If more are than are allowed, or those scored before were changed since.
        StorageError: If data or results cannot be read or written.
    """
    stamps: dict[str, dict[Place, str]] = {}
    works: list[SceneWork] = []
    missing: list[str] = []
    faults: list[str] = []
    done = 0
    rows = {str(key): row for row, key in enumerate(extent.index.column("key"))}
    for pairs in extent.wanted:
        scene = pairs[0].scene
        stamps[scene] = {
            (candidate.name, each.pair): _stamp(candidate, each, missing=missing)
            for candidate in run.candidates
            for each in pairs
        }
        if partial.is_done(scene, stamps=stamps[scene], columns=run.protocol.columns):
            done += sum(len(each.frames) for each in pairs)
            faults.extend(partial.faults(scene))
            continue
        needed = sorted({rows[scene], rows[run.beside.get(scene, scene)]})
        works.append(
            SceneWork(
                index=_part_of(extent.index, needed),
                wanted=pairs,
                protocol=run.protocol,
                candidates=run.candidates,
                faults="count" if run.allow_missing else "raise",
            )
        )
    _require_few(missing, allowed=run.allow_missing)
    total = extent.frames

    def after_frames(count: int) -> None:
        nonlocal done
        done += count
        progress(done, total)

    after_frames(0)
    _require_few(faults, allowed=run.allow_missing)
    for scene, scores in _scored(works, workers=run.workers, after_frames=after_frames):
        partial.write(scene, scores, stamps=stamps[scene])
        faults.extend(found.fault for found in scores.values() if found.fault)
        _require_few(faults, allowed=run.allow_missing)
    progress(total, total)


def _scored(
    works: Sequence[SceneWork], *, workers: int | None, after_frames: AfterBytes
) -> Iterator[tuple[str, SceneScores]]:
    results = run_tasks(_score, works, workers=workers, after_bytes=after_frames)
    with closing(results):
        yield from results


def _score(work: SceneWork, after_frames: AfterBytes) -> tuple[str, SceneScores]:
    return work.scene, score_scene(work, after_frames)


def _stamp(candidate: Candidate, wanted: Wanted, *, missing: list[str]) -> str:
    """Return the stamp of a pair's right views; "" where there are none, which is noted."""
    try:
        return candidate.stamp(wanted)
    except PredictionFault as fault:
        missing.append(str(fault))
        return ""


def _require_few(faults: Sequence[str], *, allowed: int) -> None:
    if len(faults) <= allowed:
        return
    more = f"; and {len(faults) - _TOLD} more" if len(faults) > _TOLD else ""
    raise EvaluationError(
        f"{counted(len(faults), 'prediction')} missing or unusable, and {allowed} allowed "
        f"(--allow-missing): {'; '.join(each.rstrip('.') for each in faults[:_TOLD])}{more}."
    )


def _part_of(index: SceneIndex, rows: Sequence[int]) -> SceneIndex:
    """Return an index of a few rows, small enough to be sent to a process with its work."""
    return SceneIndex.from_scenes(
        [index.scene(row) for row in rows],
        index.root,
        shards=index.shards,
        patience=index.patience,
    )
