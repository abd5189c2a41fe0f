"""From a released tree to its scenes: each one is described, or listed with what is wrong.

A `Journal` keeps the described scenes, so a killed run continues where it stopped.
"""

import base64
import re
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

from stereogenbench_data.engine import LOCAL, Advance, Engine, Progress, require_workers
from stereogenbench_data.errors import (
    MediaError,
    StereoGenBenchError,
    StorageError,
)
from stereogenbench_data.index.evidence import agreed_forms
from stereogenbench_data.index.journal import Journal
from stereogenbench_data.index.rows import SCHEMA, SEEK_COLUMN, row_of, scene_of
from stereogenbench_data.index.scene_folder import (
    IncompleteScene,
    SceneFolder,
    ValidDepth,
    as_agreed,
    describe_scene,
    stamp_of,
)
from stereogenbench_data.index.tree import FoundScenes, find_remote_scenes, find_scene_folders
from stereogenbench_data.media.depth import require_depth_stream
from stereogenbench_data.schema.conventions import Conventions, depth_of
from stereogenbench_data.schema.document import brief
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.records import REMARKS, Scene, SceneId
from stereogenbench_data.schema.release import TRAIN_MAPS, Subset, depth_name
from stereogenbench_data.schema.text import counted
from stereogenbench_data.sources.location import is_remote, shown

_NAMED: Final = 6
ALIKE: Final = 20
"""How many scenes that are broken for one reason show that it is the format."""
POOL_FROM: Final = 64
"""How many scenes there must be for worker processes to be worth their start."""


@dataclass(frozen=True, slots=True)
class TreeReport:
    """What a walk found.

    Attributes:
        root: The folder that was walked.
        scenes: Every whole scene, by key.
        incomplete: Key to reason, for scenes without their completion mark or without any video.
        broken: Key (or path below the root) to what is wrong and what to do.
        notes: What was assumed where the tree is ambiguous.
        is_part: Whether the user chose only some of the scenes.
    """

    root: str
    scenes: tuple[Scene, ...]
    incomplete: dict[str, str]
    broken: dict[str, str]
    notes: tuple[str, ...]
    is_part: bool


@dataclass(frozen=True, slots=True)
class _Outcome:
    """The outcome of one scene's folder: a scene and the digest of its files, or why not."""

    key: str
    kind: Literal["whole", "incomplete", "broken"]
    scene: Scene | None = None
    stamp: str = ""
    reason: str = ""


def scene_journal(path: Path, *, walk: str) -> Journal:
    """Return the journal of the scenes that a walk has described; see `Journal`."""
    return Journal(path, work={"walk": walk, "columns": [*SCHEMA.names, SEEK_COLUMN]})


def walk(  # noqa: PLR0913 - each is an option of the command
    root: str | Path,
    *,
    workers: int | None = None,
    engine: Engine = LOCAL,
    progress: Progress | None = None,
    journal: Journal | None = None,
    valid_depth: ValidDepth = "skip",
    wanted: Callable[[SceneId], bool] | None = None,
    if_none: Literal["refuse", "all"] = "refuse",
    conventions: Conventions | None = None,
) -> TreeReport:
    """Return every scene of a tree in the released layout, and what is wrong with the others.

    Args:
        root: The folder that holds ``train`` and ``eval``, or its URL, of which folders can be
            listed (``hf://datasets/...``, ``s3://...``).
        workers: Processes that read at the same time; None is one per core. With few scenes this
            process reads them all.
        engine: Where these processes run: `engine.LOCAL`, or an `engine.RayCluster`.
        progress: Called after each scene with the number of scenes done and that of all.
        journal: Where described scenes are kept for a later walk.
        valid_depth: "sample" decodes some depth pictures of each scene, for the share of pixels
            that have a depth.
        wanted: Returns whether to describe the scene of a path; None is all.
        if_none: What to do where no scene is wanted: refuse, or describe all of them.
        conventions: Where quantities stand in the files and how they are read.

    Raises:
        StorageError: If there is no such scene below the root, or a worker process died; or if the
            first `ALIKE` scenes are broken for one reason, so that it is the format of the files.
    """
    require_workers(workers)
    folders = find_remote_scenes(str(root)) if is_remote(root) else find_scene_folders(root)
    if wanted is not None and if_none == "all":
        wanted = wanted if any(wanted(parse_scene_key(key)) for key in folders.keys) else None
    if wanted is not None:
        folders = _chosen(root, folders, wanted)
    outcomes = _reused(root, folders.keys, journal)
    total = len(folders.keys)
    if progress is not None:
        progress(len(outcomes), total)
    pending = [key for key in folders.keys if key not in outcomes]
    if engine is LOCAL and len(pending) < POOL_FROM:
        workers = 1
    task = _DescribeTask(str(root), valid_depth, conventions)
    for outcome in engine.map(task, pending, name=str, workers=workers):
        outcomes[outcome.key] = outcome
        if len(outcomes) == ALIKE:
            _require_not_all_alike(root, outcomes.values())
        if journal is not None and outcome.scene is not None:
            journal.record(outcome.key, _journalled(outcome.scene), stamp=outcome.stamp)
        if progress is not None:
            progress(len(outcomes), total)
    in_order = [outcomes[key] for key in folders.keys]
    return _report(root, folders, in_order, is_part=wanted is not None)


def _require_not_all_alike(root: str | Path, outcomes: Iterable[_Outcome]) -> None:
    """Refuse a tree whose first scenes are broken for one reason: so are the others."""
    kinds = {
        out.kind + re.sub(r"[0-9.]+", "#", out.reason.replace(out.key, "")) for out in outcomes
    }
    first = min(outcomes, key=lambda out: out.key)
    if len(kinds) == 1 and first.kind == "broken":
        raise StorageError(
            f"{shown(root)}: the first {ALIKE} scenes cannot be used, all for one reason, so it is "
            f"the format of the files and no single scene. The first: {first.reason}\nThe names "
            f"that are understood stand in docs/formats.md; ask for others with this message."
        )


def _chosen(
    root: str | Path, folders: FoundScenes, wanted: Callable[[SceneId], bool]
) -> FoundScenes:
    keys = tuple(key for key in folders.keys if wanted(parse_scene_key(key)))
    if not keys:
        there = sorted({key.rpartition("/")[0] for key in folders.keys})
        more = f" and {len(there) - _NAMED} folders more" if len(there) > _NAMED else ""
        raise StorageError(
            f"{shown(root)}: none of its {counted(len(folders.keys), 'scene')} is asked for; "
            f"there are scenes in {', '.join(there[:_NAMED])}{more}. Check the filters' spelling."
        )
    return FoundScenes(keys, folders.refused)


@dataclass(frozen=True, slots=True)
class _DescribeTask:
    """Describes a scene by its key, in a worker process."""

    root: str
    valid_depth: ValidDepth
    conventions: Conventions | None

    def __call__(self, key: str, advance: Advance) -> _Outcome:
        advance(0)
        try:
            stamp = stamp_of(SceneFolder(self.root, key).stamps())
            scene = describe_scene(
                self.root, key, valid_depth=self.valid_depth, conventions=self.conventions
            )
        except IncompleteScene as error:
            return _Outcome(key, "incomplete", reason=str(error))
        except StereoGenBenchError as error:
            return _Outcome(key, "broken", reason=str(error))
        return _Outcome(key, "whole", scene, stamp)


def _reused(root: str | Path, keys: Iterable[str], journal: Journal | None) -> dict[str, _Outcome]:
    """Return the scenes that a journal holds and whose files have not changed."""
    outcomes: dict[str, _Outcome] = {}
    for key in keys if journal is not None and len(journal) else ():
        with suppress(
            StorageError, ValueError, KeyError, TypeError, IndexError, AttributeError
        ):  # of the folder, or of a damaged row: the scene is described again
            stamp = stamp_of(SceneFolder(root, key).stamps())
            row = None if journal is None else journal.value(key, stamp=stamp)
            if row is not None:
                tables = base64.b64decode(row.pop("seek_tables"))
                scene = replace(scene_of(row), seek_tables=tables)
                outcomes[key] = _Outcome(key, "whole", scene, stamp)
    return outcomes


def _journalled(scene: Scene) -> dict[str, Any]:
    """Return a scene as JSON."""
    return row_of(scene) | {"seek_tables": base64.b64encode(scene.seek_tables or b"").decode()}


def _report(
    root: str | Path, folders: FoundScenes, outcomes: list[_Outcome], *, is_part: bool
) -> TreeReport:
    ids = [parse_scene_key(key) for key in folders.keys]
    maps = {scene.map_name for scene in ids if scene.split == "train"} | TRAIN_MAPS
    found = [outcome.scene for outcome in outcomes if outcome.scene is not None]
    agreed = agreed_forms(scene.pose_form for scene in found if scene.pose_form)
    found = [as_agreed(scene, agreed) for scene in found]
    scenes, unnamed, labels = [], set(), []
    for scene in found:
        if scene.id.split == "eval" and scene.id.subset is None:
            unnamed.add(scene.id.key.split("/")[1])
            subset: Subset = "seen_map" if scene.id.map_name in maps else "unseen_map"
            scenes.append(replace(scene, id=replace(scene.id, subset=subset)))
        else:
            scenes.append(scene)
        if scene.labels.map_name not in (None, scene.id.map_name):
            labels.append(
                f"{scene.id.key}: its files call the map {brief(scene.labels.map_name)}; the "
                f"folder's name is used"
            )
    subsets = [
        f"eval/{folder} names no subset; a scene there counts as seen_map if its map occurs in "
        f"train, of this tree or of the release, else as unseen_map"
        for folder in sorted(unnamed)
    ]
    broken = {out.key: out.reason for out in outcomes if out.kind == "broken"}
    return TreeReport(
        root=str(root),
        scenes=tuple(scenes),
        incomplete={out.key: out.reason for out in outcomes if out.kind == "incomplete"},
        broken=dict(sorted((folders.refused | broken).items())),
        notes=(*subsets, *labels, *_remarks(found), *_depth_notes(found)),
        is_part=is_part,
    )


def _remarks(scenes: list[Scene]) -> list[str]:
    """Return what is remarked about scenes, once for each kind, and what it holds up."""
    first: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for scene in scenes:
        for about in {remark.about for remark in scene.remarks}:
            counts[about] += 1
            first.setdefault(about, scene.remark(about))
    return [
        f"{about} of {counted(counts[about], 'scene')} (holds up {REMARKS[about]}), such as {text}"
        for about, text in sorted(first.items())
    ]


def _depth_notes(scenes: list[Scene]) -> list[str]:
    """Describe depth that loading refuses unless the user's `DepthEncoding` accepts it."""
    first: dict[tuple[str, str], str] = {}
    others: Counter[tuple[str, str]] = Counter()
    for scene in scenes:
        stored = zip(scene.depth_codec, scene.depth_pixel_format, strict=True)
        for camera, (codec, pixel_format) in enumerate(stored):
            if (codec, pixel_format) in first:
                others[codec, pixel_format] += 1
                continue
            try:
                require_depth_stream(
                    codec=codec,
                    pixel_format=pixel_format,
                    encoding=depth_of(scene),
                    name=f"{scene.id.key}/{depth_name(camera)}",
                )
            except MediaError as error:
                first[codec, pixel_format] = str(error)
    return [
        f"{note} ({counted(others[kind], 'other video')} likewise.)" if others[kind] else note
        for kind, note in first.items()
    ]
