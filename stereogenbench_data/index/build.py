"""From a released tree to its scenes: each one is described, or listed with what is wrong.

A `Journal` keeps the described scenes, so a killed run continues where it stopped.
"""

import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

from stereogenbench_data.engine import LOCAL, Advance, Engine, Progress, no_advance, require_workers
from stereogenbench_data.errors import (
    MediaError,
    StereoGenBenchError,
    StorageError,
)
from stereogenbench_data.index.evidence import agreed_forms
from stereogenbench_data.index.folders import SceneFolder, folder_of, stamp_of
from stereogenbench_data.index.journal import Journal
from stereogenbench_data.index.parquet import IndexHead
from stereogenbench_data.index.rows import SCHEMA, SEEK_COLUMN, json_of, scene_of_json
from stereogenbench_data.index.scene_folder import (
    IncompleteScene,
    ValidDepth,
    as_agreed,
    describe_scene,
    unfinished,
)
from stereogenbench_data.index.tree import FoundScenes, find_remote_scenes, find_scene_folders
from stereogenbench_data.media.depth import require_depth_stream
from stereogenbench_data.schema.conventions import Conventions, depth_of
from stereogenbench_data.schema.document import brief
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.records import REMARKS, Scene, SceneId
from stereogenbench_data.schema.release import COMPLETE_JSON, TRAIN_MAPS, Subset, depth_name
from stereogenbench_data.schema.text import counted
from stereogenbench_data.sources.location import is_remote, shown

_NAMED: Final = 6
ALIKE: Final = 20
"""How many scenes that are broken for one reason show that it is the format."""
FORMAT_CURE: Final = (
    "Names that are understood stand in docs/release.md. For others, write where a quantity stands "
    "into a file of conventions: `stereogenbench conventions {root} -o c.toml` lists the keys that "
    'nobody reads; add a table, such as [field_of_view] with place = "$.camera_intrinsics.angle", '
    "and give the file as conventions= or --conventions."
)
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

    @property
    def head(self) -> IndexHead:
        """What an index of the scenes knows besides them."""
        return IndexHead(
            self.root, incomplete=self.incomplete, broken=self.broken, is_part=self.is_part
        )


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of one scene's folder: a scene and the digest of its files, or why not."""

    key: str
    kind: Literal["whole", "incomplete", "broken"]
    scene: Scene | None = None
    stamp: str = ""
    reason: str = ""
    has_mark: bool = True

    @classmethod
    def of_error(
        cls, key: str, error: StereoGenBenchError, *, files: Collection[str] = ()
    ) -> "Outcome":
        """Return the outcome of a scene that cannot be described; () if its files are not known."""
        kind: Literal["incomplete", "broken"] = (
            "incomplete" if isinstance(error, IncompleteScene) else "broken"
        )
        return cls(key, kind, reason=str(error), has_mark=not files or COMPLETE_JSON in files)

    @classmethod
    def of_scene(cls, scene: Scene, stamp: str = "") -> "Outcome":
        """Return the outcome of a scene that was described."""
        key, has_mark = scene.id.key, COMPLETE_JSON in scene.members
        return cls(key, "whole", scene, stamp, has_mark=has_mark)


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
    folders, is_part = find_scenes(root, wanted=wanted, if_none=if_none)
    outcomes = _reused(root, folders.keys, journal)
    total = len(folders.keys)
    if progress is not None:
        progress(len(outcomes), total)
    pending = [key for key in folders.keys if key not in outcomes]
    if engine is LOCAL and len(pending) < POOL_FROM:
        workers = 1
    task = DescribeTask(str(root), valid_depth, conventions)
    for outcome in engine.map(task, pending, name=str, workers=workers):
        outcomes[outcome.key] = outcome
        if len(outcomes) == ALIKE:
            require_not_all_alike(root, outcomes.values())
        if journal is not None and outcome.scene is not None:
            journal.record(outcome.key, json_of(outcome.scene), stamp=outcome.stamp)
        if progress is not None:
            progress(len(outcomes), total)
    in_order = [outcomes[key] for key in folders.keys]
    return report_of(root, folders, in_order, is_part=is_part)


def find_scenes(
    root: str | Path,
    *,
    wanted: Callable[[SceneId], bool] | None,
    if_none: Literal["refuse", "all"] = "refuse",
    folders: FoundScenes | None = None,
) -> tuple[FoundScenes, bool]:
    """Return the wanted scenes of a tree, and whether they are a part of it; see `walk`."""
    if folders is None:
        folders = find_remote_scenes(str(root)) if is_remote(root) else find_scene_folders(root)
    if wanted is not None and if_none == "all":
        wanted = wanted if any(wanted(parse_scene_key(key)) for key in folders.keys) else None
    if wanted is not None:
        folders = _chosen(root, folders, wanted)
    return folders, wanted is not None


def require_not_all_alike(root: str | Path, outcomes: Iterable[Outcome]) -> None:
    """Refuse a tree whose first scenes are broken for one reason: so are the others."""
    kinds = {
        out.kind + re.sub(r"[0-9.]+", "#", out.reason.replace(out.key, "")) for out in outcomes
    }
    first = min(outcomes, key=lambda out: out.key)
    if len(kinds) == 1 and first.kind == "broken":
        raise StorageError(
            f"{shown(root)}: the first {ALIKE} scenes cannot be used, all for one reason, so it is "
            f"the format of the files and no single scene. The first: {first.reason}\n"
            f"{FORMAT_CURE.format(root=shown(root))}"
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
    return replace(folders, keys=keys)


@dataclass(frozen=True, slots=True)
class DescribeTask:
    """Describes a scene by its key, in a worker process."""

    root: str
    valid_depth: ValidDepth = "skip"
    conventions: Conventions | None = None

    def __call__(self, key: str, advance: Advance = no_advance) -> Outcome:
        """Return what the scene is."""
        advance(0)
        return self.outcome(folder_of(self.root, key), key)

    def outcome(self, folder: SceneFolder, key: str) -> Outcome:
        """Return what the scene of a folder is, whose files are all read."""
        files: dict[str, tuple[int, int]] = {}
        try:
            files = folder.stamps()
            scene = describe_scene(
                self.root, key, valid_depth=self.valid_depth, conventions=self.conventions,
                folder=folder,
            )  # fmt: skip
        except StereoGenBenchError as error:
            return Outcome.of_error(key, error, files=files)
        return Outcome.of_scene(scene, stamp_of(files))


def _reused(root: str | Path, keys: Iterable[str], journal: Journal | None) -> dict[str, Outcome]:
    """Return the scenes that a journal holds and whose files have not changed."""
    outcomes: dict[str, Outcome] = {}
    for key in keys if journal is not None and len(journal) else ():
        with suppress(
            StorageError, ValueError, KeyError, TypeError, IndexError, AttributeError
        ):  # of the folder, or of a damaged row: the scene is described again
            stamp = stamp_of(folder_of(root, key).stamps())
            row = None if journal is None else journal.value(key, stamp=stamp)
            if row is not None:
                outcomes[key] = Outcome.of_scene(scene_of_json(row), stamp)
    return outcomes


def report_of(
    root: str | Path, folders: FoundScenes, outcomes: list[Outcome], *, is_part: bool
) -> TreeReport:
    """Return the report of a walk that had these outcomes, one a scene in the order of keys.

    Scenes without their completion mark are not finished, unless no scene of the tree has one.
    """
    if folders.is_marked or any(out.has_mark and out.kind != "incomplete" for out in outcomes):
        outcomes = [
            out if out.has_mark else Outcome.of_error(out.key, unfinished(out.key))
            for out in outcomes
        ]
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
            labels.append(f"{scene.id.key}: {brief(scene.labels.map_name)}")
    subsets = [
        f"eval/{folder} names no subset; a scene there counts as seen_map if its map occurs in "
        f"train, of this tree or of the release, else as unseen_map"
        for folder in sorted(unnamed)
    ]
    named = [
        f"files of {counted(len(labels), 'scene')} call the map otherwise than its folder, whose "
        f"name is used, such as {labels[0]}"
    ] if labels else []  # fmt: skip
    broken = {out.key: out.reason for out in outcomes if out.kind == "broken"}
    return TreeReport(
        root=str(root),
        scenes=tuple(scenes),
        incomplete={out.key: out.reason for out in outcomes if out.kind == "incomplete"},
        broken=dict(sorted((folders.refused | broken).items())),
        notes=(*subsets, *named, *_remarks(found), *_depth_notes(found)),
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
    notes: dict[tuple[str, str], str] = {}
    videos: Counter[tuple[str, str]] = Counter()
    for scene in scenes:
        stored = zip(scene.depth_codec, scene.depth_pixel_format, strict=True)
        for camera, kind in enumerate(stored):
            videos[kind] += 1
            if kind in notes:
                continue
            notes[kind] = ""
            try:
                require_depth_stream(
                    codec=kind[0],
                    pixel_format=kind[1],
                    encoding=depth_of(scene),
                    name=f"{scene.id.key}/{depth_name(camera)}",
                )
            except MediaError as error:
                notes[kind] = str(error)
    return [
        f"{note} ({counted(videos[kind] - 1, 'other video')} likewise.)"
        if videos[kind] > 1
        else note
        for kind, note in notes.items()
        if note
    ]
