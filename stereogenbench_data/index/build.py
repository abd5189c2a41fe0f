"""From a released tree to its scenes: each one is described, or listed with what is wrong.

A `Journal` keeps the described scenes, so a killed run continues where it stopped.
"""

import json
import re
import warnings
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal, TextIO

from stereogenbench_data.engine import LOCAL, Advance, Engine, Progress, no_advance, require_workers
from stereogenbench_data.errors import (
    MediaError,
    StereoGenBenchError,
    StorageError,
    explain_os_errors,
)
from stereogenbench_data.index.evidence import agreed_forms
from stereogenbench_data.index.parquet import IndexHead
from stereogenbench_data.index.rows import SCHEMA, SEEK_COLUMN, json_of, scene_of_json
from stereogenbench_data.index.scene_folder import (
    IncompleteScene,
    ValidDepth,
    as_agreed,
    describe_scene,
    missing_video,
    unfinished,
)
from stereogenbench_data.index.tree import (
    FoundScenes,
    SceneFolder,
    find_scene_folders,
    folder_of,
    stamp_of,
)
from stereogenbench_data.media.depth import require_depth_stream
from stereogenbench_data.schema.conventions import Conventions, depth_of
from stereogenbench_data.schema.document import brief
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.records import Remark, Scene, SceneId, remarks_told
from stereogenbench_data.schema.release import (
    COMPLETE_JSON,
    METADATA_FILES,
    TRAIN_MAPS,
    VIDEO_FILES,
    Subset,
    depth_name,
)
from stereogenbench_data.schema.text import counted
from stereogenbench_data.sources.location import is_remote, shown
from stereogenbench_data.sources.remote import RemoteObject
from stereogenbench_data.sources.retry import RetryPolicy

_JOURNAL_FORMAT: Final = 2


class Journal:
    """JSON values by scene, on disk; leaving its block keeps the file, `delete` removes it."""

    def __init__(self, path: Path, *, work: Mapping[str, Any]) -> None:
        """Read a journal; that of other work is ignored, and replaced by the first new value.

        Args:
            path: The journal's file.
            work: What the work is, as JSON: runs of the same work share their values.

        Raises:
            StorageError: If the file exists and cannot be read.
        """
        self._path = path
        self._file: TextIO | None = None
        self._head = json.dumps({"journal": _JOURNAL_FORMAT, **work})
        what = f"{path}: the journal of an earlier run cannot be read"
        self._known: dict[str, tuple[str, Any]] = {}
        with (
            explain_os_errors(what, "Remove it, or write the result to another folder."),
            suppress(FileNotFoundError, NotADirectoryError),
        ):
            lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
            for line in lines[1:] if lines[:1] == [self._head] else ():
                with suppress(ValueError, KeyError, TypeError):
                    entry: Any = json.loads(line)
                    self._known[str(entry["key"])] = (entry["stamp"], entry["value"])

    def __len__(self) -> int:
        """The number of scenes that earlier runs have done."""
        return len(self._known)

    def value(self, key: str, *, stamp: str) -> Any:
        """Return a scene's value; None if there is none, or its files have changed."""
        known = self._known.get(key)
        return known[1] if known is not None and known[0] == stamp else None

    def record(self, key: str, value: Any, *, stamp: str) -> None:
        """Write a scene's value, any JSON but null.

        Raises:
            StorageError: If the file cannot be written.
        """
        line = json.dumps({"key": key, "stamp": stamp, "value": value})
        what = f"{self._path}: the journal cannot be written"
        with explain_os_errors(what, "Write the result to another folder."):
            if self._file is None:
                self._path.parent.mkdir(parents=True, exist_ok=True)
                self._file = self._path.open("a" if self._known else "w", encoding="utf-8")
                self._file.write("\n" if self._known else f"{self._head}\n")
            self._file.write(f"{line}\n")
            self._file.flush()

    def delete(self) -> None:
        """Remove the file, whose values were written elsewhere."""
        self.__exit__()
        self._path.unlink(missing_ok=True)

    def __enter__(self) -> "Journal":
        """Return the journal itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close the file, and keep it."""
        if self._file is not None:
            self._file.close()


_NAMED: Final = 6
ALIKE: Final = 20
"""How many scenes that are broken for one reason show that it is the format."""
FORMAT_CURE: Final = (
    "Names that are understood stand in docs/release.md. For others, write where a quantity stands "
    "into a file of conventions: `stereogenbench conventions {root} -o c.toml` lists the keys that "
    'nobody reads; add a table, such as [field_of_view] with place = "$.camera_intrinsics.angle", '
    "and give the file as conventions= or --conventions."
)
_MOST_UNTOLD: Final = 2500
"""More requests are told: the Hub answers 3,000 in five minutes."""
_REQUESTS: Final = 2 * len(VIDEO_FILES) + len(METADATA_FILES)
"""The requests that describe a scene behind a URL: both ends of each video, and the small files."""
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
    """What became of one scene's folder.

    Attributes:
        key: The scene.
        found: Its row, or why it has none: `IncompleteScene` where it was never finished.
        stamp: A digest of its files.
        has_mark: Whether it has its completion mark.
    """

    key: str
    found: Scene | StereoGenBenchError
    stamp: str = ""
    has_mark: bool = True


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
    retry: RetryPolicy | None = None,
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
        retry: How slow a server may be.

    Raises:
        StorageError: If there is no such scene below the root, or a worker process died; or if the
            first `ALIKE` scenes are broken for one reason, so that it is the format of the files.
    """
    require_workers(workers)
    folders, is_part = find_scenes(root, wanted=wanted, if_none=if_none, retry=retry)
    task = DescribeTask(str(root), valid_depth, conventions, retry)
    outcomes = _reused(task, folders.keys, journal)
    total = len(folders.keys)
    if progress is not None:
        progress(len(outcomes), total)
    pending = [key for key in folders.keys if key not in outcomes]
    if engine is LOCAL and len(pending) < POOL_FROM:
        workers = 1
    if is_remote(root):
        tell_requests(root, len(pending), each=_REQUESTS, what="all files")
    for outcome in engine.map(task, pending, name=str, workers=workers):
        outcomes[outcome.key] = outcome
        if len(outcomes) == ALIKE:
            require_not_all_alike(root, outcomes.values())
        if journal is not None and isinstance(outcome.found, Scene):
            journal.record(outcome.key, json_of(outcome.found), stamp=outcome.stamp)
        if progress is not None:
            progress(len(outcomes), total)
    in_order = [outcomes[key] for key in folders.keys]
    return report_of(root, folders, in_order, is_part=is_part)


class ManyRequestsWarning(UserWarning):
    """So many requests are made that a server may let them wait."""


def tell_requests(root: str | Path, scenes: int, *, each: int, what: str) -> None:
    """Warn of the requests that scenes behind a URL take, if a server may let them wait."""
    requests, where = scenes * each, shown(root)
    if requests > _MOST_UNTOLD:
        message = (
            f"{where}: reads {what} of {scenes} scenes, in {requests:,} requests: on the Hub "
            f"without a login some {requests // 600} minutes. An interrupted run goes on where it "
            f"stopped; an index holds them: `stereogenbench index {where}`."
        )
        warnings.warn(message, ManyRequestsWarning, stacklevel=2)


def find_scenes(
    root: str | Path,
    *,
    wanted: Callable[[SceneId], bool] | None,
    if_none: Literal["refuse", "all"] = "refuse",
    folders: FoundScenes | None = None,
    retry: RetryPolicy | None = None,
) -> tuple[FoundScenes, bool]:
    """Return the wanted scenes of a tree, and whether they are a part of it; see `walk`."""
    if folders is None:
        place = RemoteObject(str(root), retry=retry) if is_remote(root) else Path(root)
        folders = find_scene_folders(place)
    if wanted is None:
        return folders, False
    keys = tuple(key for key in folders.keys if wanted(parse_scene_key(key)))
    if keys:
        return replace(folders, keys=keys), True
    if if_none == "all":
        return folders, False
    there = sorted({key.rpartition("/")[0] for key in folders.keys})
    more = f" and {len(there) - _NAMED} folders more" if len(there) > _NAMED else ""
    raise StorageError(
        f"{shown(root)}: none of its {counted(len(folders.keys), 'scene')} matches; there are "
        f"scenes in {', '.join(there[:_NAMED])}{more}. Check the filters' spelling."
    )


def require_not_all_alike(root: str | Path, outcomes: Collection[Outcome]) -> None:
    """Refuse a tree whose first scenes are broken for one reason: so are the others."""
    reasons = {
        "" if isinstance(out.found, Scene)
        else re.sub(r"[0-9.]+", "#", str(out.found).replace(out.key, ""))
        for out in outcomes
    }  # fmt: skip
    first = min(outcomes, key=lambda out: out.key).found
    if len(reasons) == 1 and not isinstance(first, Scene | IncompleteScene):
        raise StorageError(
            f"{shown(root)}: the first {ALIKE} scenes cannot be used, all for one reason, so it is "
            f"the format of the files and no single scene. The first: {first}\n"
            f"{FORMAT_CURE.format(root=shown(root))}"
        )


@dataclass(frozen=True, slots=True)
class DescribeTask:
    """Describes a scene by its key, in a worker process."""

    root: str
    valid_depth: ValidDepth = "skip"
    conventions: Conventions | None = None
    retry: RetryPolicy | None = None

    def folder(self, key: str) -> SceneFolder:
        """Return a scene's folder; nothing is read yet."""
        return folder_of(self.root, key, retry=self.retry)

    def __call__(self, key: str, advance: Advance = no_advance) -> Outcome:
        """Return what the scene is."""
        advance(0)
        folder = self.folder(key)
        files: dict[str, tuple[int, int]] = {}
        try:
            files = folder.stamps()
            scene = describe_scene(
                self.root, key, valid_depth=self.valid_depth, conventions=self.conventions,
                folder=folder,
            )  # fmt: skip
        except StereoGenBenchError as error:
            return Outcome(key, error, has_mark=not files or COMPLETE_JSON in files)
        return Outcome(key, scene, stamp_of(files), has_mark=COMPLETE_JSON in files)


def _reused(task: DescribeTask, keys: Iterable[str], journal: Journal | None) -> dict[str, Outcome]:
    """Return the scenes that a journal holds and whose files have not changed."""
    outcomes: dict[str, Outcome] = {}
    for key in keys if journal is not None and len(journal) else ():
        with suppress(
            StorageError, ValueError, KeyError, TypeError, IndexError, AttributeError
        ):  # of the folder, or of a damaged row: the scene is described again
            stamp = stamp_of(task.folder(key).stamps())
            row = None if journal is None else journal.value(key, stamp=stamp)
            if row is not None:
                scene = scene_of_json(row)
                outcomes[key] = Outcome(key, scene, stamp, COMPLETE_JSON in scene.members)
    return outcomes


def report_of(
    root: str | Path, folders: FoundScenes, outcomes: list[Outcome], *, is_part: bool
) -> TreeReport:
    """Return the report of a walk that had these outcomes, one a scene in the order of keys.

    Scenes without their completion mark are not finished, unless no scene of the tree has one.
    """
    is_incomplete = [isinstance(out.found, IncompleteScene) for out in outcomes]
    marked = (out.has_mark for out, lacks in zip(outcomes, is_incomplete, strict=True) if not lacks)
    if folders.is_marked or any(marked):
        outcomes = [out if out.has_mark else Outcome(out.key, unfinished(out.key))
                    for out in outcomes]  # fmt: skip
    left_out = {out.key: out.found for out in outcomes if not isinstance(out.found, Scene)}
    incomplete = {key: str(error) for key, error in left_out.items()
                  if isinstance(error, IncompleteScene)}  # fmt: skip
    broken = {key: str(error) for key, error in left_out.items() if key not in incomplete}
    ids = [parse_scene_key(key) for key in folders.keys]
    maps = {scene.map_name for scene in ids if scene.split == "train"} | TRAIN_MAPS
    found = [out.found for out in outcomes if isinstance(out.found, Scene)]
    agreed = agreed_forms(scene.pose_form for scene in found if scene.pose_form)
    found = _without_unfetched([as_agreed(scene, agreed) for scene in found])
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
    return TreeReport(
        root=str(root),
        scenes=tuple(scenes),
        incomplete=incomplete,
        broken=dict(sorted((folders.refused | broken).items())),
        notes=(*subsets, *named, *remarks_told(found), *_depth_notes(found)),
        is_part=is_part,
    )


def _without_unfetched(scenes: list[Scene]) -> list[Scene]:
    """Return scenes without remarks on the cameras, or on the pictures or depth, that all lack.

    These were not fetched, as in the part that a download writes. What one scene lacks is told.
    """
    if not all(scene.remark("videos") for scene in scenes):
        return scenes
    told = [scene.remark("videos").split("; ") for scene in scenes]
    absent = {
        name for name in VIDEO_FILES
        if all(missing_video(scene.id.key, name) in each
               for scene, each in zip(scenes, told, strict=True))
    }  # fmt: skip
    there = [name for name in VIDEO_FILES if name not in absent]
    cameras, streams = {name[:6] for name in there}, {name[6:] for name in there}
    if len(there) != len(cameras) * len(streams):
        return scenes
    kept = []
    for scene, each in zip(scenes, told, strict=True):
        left = [text for text in each
                if text not in {missing_video(scene.id.key, name) for name in absent}]  # fmt: skip
        remarks = [remark for remark in scene.remarks if remark.about != "videos"]
        remarks += [Remark("videos", "; ".join(left))] if left else []
        kept.append(replace(scene, remarks=tuple(remarks)))
    return kept


def _depth_notes(scenes: list[Scene]) -> list[str]:
    """Describe depth that loading refuses unless the user's `DepthEncoding` accepts it."""
    videos: dict[tuple[str, str], list[tuple[Scene, int]]] = defaultdict(list)
    for scene in scenes:
        stored = zip(scene.depth_codec, scene.depth_pixel_format, strict=True)
        for camera, kind in enumerate(stored):
            videos[kind].append((scene, camera))
    notes = []
    for (codec, pixel_format), found in videos.items():
        (scene, camera), others = found[0], len(found) - 1
        name = f"{scene.id.key}/{depth_name(camera)}"
        try:
            require_depth_stream(
                codec=codec, pixel_format=pixel_format, encoding=depth_of(scene), name=name
            )
        except MediaError as error:
            more = f" ({counted(others, 'other video')} likewise.)" if others else ""
            notes.append(f"{error}{more}")
    return notes
