"""From a released tree to its scenes: each one is described, or listed with what is wrong.

The user's cache keeps the described scenes, so a killed run continues where it stopped.
"""

import hashlib
import json
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter, thread_time
from typing import Any, Final, Literal

import numpy as np

from stereogenbench_data.engine import LOCAL, Advance, Engine, Progress, no_advance, require_workers
from stereogenbench_data.errors import StereoGenBenchError, StorageError
from stereogenbench_data.geometry.pose_evidence import MatchedPoses, settled_poses
from stereogenbench_data.index.left_out import reasons_told
from stereogenbench_data.index.rows import json_of, scene_of_json
from stereogenbench_data.index.scene_folder import (
    Description,
    IncompleteScene,
    ValidDepth,
    held_name,
    missing_video,
    require_finished,
    unfinished,
)
from stereogenbench_data.index.tree import (
    Files,
    RemoteFolder,
    RemoteTree,
    SceneFolder,
    WholeFiles,
    find_scene_folders,
    in_parallel,
    stamp_of,
)
from stereogenbench_data.index.tree_cache import NOTHING_KEPT, TreeCache
from stereogenbench_data.schema.conventions import Conventions
from stereogenbench_data.schema.declaration import BUILT_IN, Declaration
from stereogenbench_data.schema.document import brief
from stereogenbench_data.schema.parse import parse_rig, parse_scene_key
from stereogenbench_data.schema.records import Remark, Scene, SceneId, remarks_told
from stereogenbench_data.schema.release import (
    BASELINE_JSON,
    CAMERA_COUNT,
    COMPLETE_JSON,
    METADATA_FILES,
    TRAIN_MAPS,
    TRAJECTORY_JSON,
    VIDEO_FILES,
    Subset,
    depth_name,
    rgb_name,
)
from stereogenbench_data.schema.text import counted, shortened
from stereogenbench_data.sources.location import is_remote, shown
from stereogenbench_data.sources.remote import RemoteObject
from stereogenbench_data.sources.retry import RetryPolicy

_NAMED: Final = 6
Checksums = Literal["none", "all"]

FORMAT_CURE: Final = (
    "Files are read by the keys that the paper prints. For others, write where a quantity stands "
    "into a file of conventions: `stereogenbench conventions {root} -o c.toml` writes candidates "
    'as comments; keep a table, such as [focal_length] with place = "$.lens.f" and unit = "mm", '
    "below a [[shape]] if only some scenes have it there, and give the file as conventions= or "
    "--conventions. docs/release.md has examples."
)
_WARN_ABOVE_REQUESTS: Final = 2500
"""More requests are told: the Hub answers 3,000 in five minutes."""
_SETTLED_BY: Final = 20
"""How many scenes of a tree settle how its scenes are read."""
_SETTLED_BY_REMOTE: Final = 12
"""How many do so behind a URL, where each takes nine requests."""
_REQUESTS: Final = 2 * len(VIDEO_FILES) + len(METADATA_FILES)
"""The requests that describe a scene behind a URL: both ends of each video, and the small files."""
_WAITS: Final = 3.0
"""How many times as long as its work reading must take for several to wait for the disk at a time:
where files are near, threads only keep each other from working."""
_READERS: Final = 8
"""Threads that read the files of scenes on this machine, if its disk waits."""
_AT_A_TIME: Final = 128
"""How many scenes each of them reads at a time; the first so many tell how the disk is."""
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
        odd: Key to what is odd about it, for scenes in `scenes` that lack what most of them have.
        notes: What was assumed where the tree is ambiguous.
        is_part: Whether the user chose only some of the scenes.
    """

    root: str
    scenes: tuple[Scene, ...]
    incomplete: dict[str, str]
    broken: dict[str, str]
    odd: dict[str, str]
    notes: tuple[str, ...]
    is_part: bool


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one scene's folder.

    Attributes:
        key: The scene.
        found: Its row, or why it has none: `IncompleteScene` where it was never finished.
        has_mark: Whether it has its completion mark.
        poses: Its poses, where these were just read.
    """

    key: str
    found: Scene | StereoGenBenchError
    has_mark: bool = True
    poses: MatchedPoses | None = None

    @property
    def lacks_poses(self) -> bool:
        """Whether it is a scene whose poses cannot be used."""
        found = self.found
        return isinstance(found, Scene) and bool(found.remark("poses", "left"))

    @property
    def has_one_form(self) -> bool:
        """Whether it is a scene of whose poses one form is known to be right."""
        found = self.found
        return isinstance(found, Scene) and not found.remark("poses", "left", "world")


@dataclass(frozen=True, slots=True)
class Tree:
    """The scenes of a folder or URL in the released layout, and how their files are read.

    Attributes:
        root: The folder, or the URL.
        keys: The wanted scenes, sorted.
        refused: Path to reason and cure, for folders of misplaced scenes.
        is_part: Whether the user chose only some of the scenes.
        ids: Every scene, wanted or not, by key; those of eval with their subsets.
        is_marked: Whether some scene, wanted or not, is known to have its completion mark.
        cache: Where what is found out is kept.
        remote: What lists the files behind the URL; None on this machine.
        conventions: Where quantities stand in the files; what they do not state is the release's.
        valid_depth: Whether depth pictures are decoded, see `walk`.
        checksums: Whether rows hold checksums, see `walk`.
        files: Key to files, of scenes behind a URL whose files are listed.
        stamp: A digest of all this, which changes when a file is added, removed or changed
            (`listed`).
        settled: Where poses stand in all scenes and in which form; None where that is settled for
            each scene.
    """

    root: Path | str
    keys: tuple[str, ...]
    refused: dict[str, str]
    is_part: bool
    ids: Mapping[str, SceneId]
    is_marked: bool
    cache: TreeCache
    remote: RemoteTree | None = None
    conventions: Conventions | None = None
    valid_depth: ValidDepth = "skip"
    checksums: Checksums = "none"
    files: Mapping[str, Files] = field(default_factory=dict)
    stamp: str = ""
    settled: MatchedPoses | None = None

    def with_poses_of(self, scene: Outcome) -> "Tree":
        """Return the tree with how one scene has its poses; that of conventions of one shape."""
        if scene.poses is not None:
            return replace(self, settled=scene.poses)
        key, declared = scene.key, self.stated or BUILT_IN
        folder = self.folder(key)
        with suppress(StereoGenBenchError):
            rig, _, _ = parse_rig(folder.read(BASELINE_JSON), where=key, declared=declared)
            text = folder.read(TRAJECTORY_JSON)
            frames = scene.found.frames if isinstance(scene.found, Scene) else 0
            found = settled_poses(text, rig, where=key, named=declared.poses, frames=frames)
            return replace(self, settled=found)
        return self

    def listed(self, *, by: Literal["files", "folders"] = "files") -> "Tree":
        """Return the tree with a stamp of its scenes; behind a URL with their files, too.

        Args:
            by: What the stamp changes with: every file, or on a disk the names in each folder and
                each ``baseline.json``, which is an eighth of the work.
        """
        files, refused, stamps = dict[str, Files](), dict[str, str](), list[object]()
        if self.remote is None:
            stamp = self.file_stamp if by == "files" else lambda key: self.folder(key).times()
            stamps += self.of_each(stamp, self.keys)
        else:
            files, refused = self.remote.files(self.keys)
            stamps += files.items()
        refused = self.refused | dict(sorted(refused.items()))
        is_marked = self.is_marked or any(COMPLETE_JSON in each for each in files.values())
        maps = {scene.map_name for scene in self.ids.values() if scene.split == "train"}
        chosen = (self.is_part, sorted(maps), is_marked, refused, self.keys)
        digest = hashlib.sha256(repr(chosen).encode())
        for each in stamps:
            digest.update(repr(each).encode())
        stamp_of_all = digest.hexdigest()[:32]
        return replace(self, files=files, refused=refused, is_marked=is_marked, stamp=stamp_of_all)

    def file_stamp(self, key: str) -> str:
        """Return a digest of a scene's files; "" where they cannot be listed."""
        with suppress(StorageError):
            return stamp_of(self.folder(key).stamps())
        return ""

    def folder(self, key: str) -> SceneFolder:
        """Return a scene's folder; on this machine its files are listed anew."""
        if self.remote is None:
            return (SceneFolder if self.checksums == "none" else WholeFiles)(self.root, key)
        return RemoteFolder(self.remote.root, key, self.files.get(key), self.cache)

    def finished(self, key: str) -> Files:
        """Return a scene's files, by whose names it is finished.

        Raises:
            StorageError: If they cannot be listed, or the scene cannot be used.
        """
        files = self.files[key] if key in self.files else self.folder(key).stamps()
        require_finished(key, files)
        if self.is_marked and COMPLETE_JSON not in files:
            raise unfinished(key)
        return files

    @property
    def stated(self) -> Declaration | None:
        """What conventions state of all scenes."""
        return None if self.conventions is None else self.conventions.shapes[0]

    def of_each(self, read: Callable[[str], Any], keys: Sequence[str]) -> Iterator[Any]:
        """Yield what is read of each scene, in order; of a disk that waits several at a time."""
        if self.remote is not None:
            yield from in_parallel(read, keys)
            return
        begins_s, worked_s = perf_counter(), thread_time()
        yield from map(read, keys[:_AT_A_TIME])
        if perf_counter() - begins_s < _WAITS * (thread_time() - worked_s):
            yield from map(read, keys[_AT_A_TIME:])
            return
        starts = range(_AT_A_TIME, len(keys), _AT_A_TIME)
        parts = [keys[start : start + _AT_A_TIME] for start in starts]
        with ThreadPoolExecutor(_READERS) as pool:
            for part in pool.map(lambda part: [*map(read, part)], parts):
                yield from part

    def kept(self, name: str) -> Scene | None:
        """Return the scene that the user's cache holds by its `name_of`; None if there is none."""
        text = self.cache.read("scenes", name)
        return None if text is None else scene_of_json(json.loads(text))

    def name_of(self, folder: SceneFolder, videos: Collection[str] | None = None) -> str:
        """Return what a scene that is described is kept under.

        Raises:
            StorageError: If its files cannot be listed.
        """
        opened = "all" if videos is None else sorted(videos)
        how = self.valid_depth, self.checksums
        return repr((folder.key, opened, *how, stamp_of(folder.stamps())))

    def opened(
        self, folder: SceneFolder, videos: Collection[str] | None = None
    ) -> tuple[Scene, MatchedPoses | None]:
        """Return a scene as its files say, and its poses; the user's cache then holds it.

        Raises:
            StorageError: If it cannot be used.
        """
        name = self.name_of(folder, videos)
        described = Description(folder, folder.key, self.settled)
        scene = described.scene(self.conventions, videos=videos, valid_depth=self.valid_depth)
        if self.checksums == "all" and isinstance(folder, WholeFiles):
            members = {
                name: replace(each, crc32=folder.crc32(name))
                for name, each in scene.members.items()
            }
            scene = replace(scene, members=members)
        self.cache.keep("scenes", name, json.dumps(json_of(scene)).encode())
        return scene, described.understood

    def settling(
        self,
        folder: SceneFolder,
        videos: Collection[str] | None,
        *,
        kept: Literal["used", "ignored"] = "used",
    ) -> Outcome:
        """Return what becomes of a scene, of which some videos are opened if they are there."""
        files: Files = {}
        try:
            files = folder.stamps()
            if videos is not None and not all(held_name(files, name) in files for name in videos):
                videos = None
            scene = self.kept(self.name_of(folder, videos)) if kept == "used" else None
            found = (scene, None) if scene is not None else self.opened(folder, videos)
            return Outcome(folder.key, found[0], COMPLETE_JSON in files, poses=found[1])
        except StereoGenBenchError as error:
            return Outcome(folder.key, error, not files or COMPLETE_JSON in files)

    def outcome(self, folder: SceneFolder, advance: Advance = no_advance) -> Outcome:
        """Return what becomes of a scene whose files are all read, in a worker process too."""
        return replace(self.settling(folder, None), poses=None)


def walk(  # noqa: PLR0913 - each is an option of the command
    root: str | Path,
    *,
    workers: int | None = None,
    engine: Engine = LOCAL,
    progress: Progress | None = None,
    valid_depth: ValidDepth = "skip",
    checksums: Checksums = "none",
    wanted: Callable[[SceneId], bool] | None = None,
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
        valid_depth: "sample" decodes some depth pictures of each scene, for the share of pixels
            that have a depth.
        checksums: "all" reads all files of a folder on this machine through, for the crc32 of each.
        wanted: Returns whether to describe the scene of a path; None is all.
        conventions: Where quantities stand in the files and how they are read.

    Raises:
        StorageError: If there is no such scene below the root, or a worker process died; or if none
            of the scenes that settle how files are read can be used.
    """
    require_workers(workers)
    if checksums == "all" and is_remote(root):
        raise StorageError(
            f"{shown(root)}: checksums are made of files on a disk. Download the scenes, or index "
            f"them without checksums."
        )
    tree = find_tree(root, wanted=wanted, conventions=conventions)
    tree = replace(tree, valid_depth=valid_depth, checksums=checksums)
    return walk_tree(tree, workers=workers, engine=engine, progress=progress)


def walk_tree(
    tree: Tree,
    *,
    workers: int | None = None,
    engine: Engine = LOCAL,
    progress: Progress | None = None,
) -> TreeReport:
    """Return every scene of a tree, and what is wrong with the others; see `walk`."""
    tree = tree if tree.remote is None or tree.files else tree.listed()
    outcomes, pending = _kept_scenes(tree)
    total = len(tree.keys)
    if progress is not None:
        progress(len(outcomes), total)
    if pending:
        tree, opened = settle(tree, progress=progress)
        if len(opened) >= min(_SETTLED_BY, _SETTLED_BY_REMOTE):
            require_some(tree, opened.values())
        outcomes |= {key: opened[key] for key in tree.keys if key in opened}
        pending = [folder for folder in pending if folder.key not in opened]
    if engine is LOCAL and len(pending) < POOL_FROM:
        workers = 1
    bare = replace(tree, keys=(), ids={}, refused={}, files={})
    if tree.remote is not None:
        tell_requests(tree.root, len(pending), each=_REQUESTS, what="all files")
    others = engine.map(bare.outcome, pending, name=lambda folder: folder.key, workers=workers)
    for outcome in others:
        outcomes[outcome.key] = outcome
        if progress is not None:
            progress(len(outcomes), total)
    return report_of(tree, outcomes)


def _kept_scenes(tree: Tree) -> tuple[dict[str, Outcome], list[SceneFolder]]:
    """Return the scenes that the user's cache holds, and the folders of the others."""
    outcomes, pending = dict[str, Outcome](), list[SceneFolder]()
    # The rows are kept, which stand for the small files.
    for folder in map(replace(tree, cache=NOTHING_KEPT).folder, tree.keys):
        scene = None
        with suppress(StorageError):  # of its folder: that is found again
            scene = tree.kept(tree.name_of(folder))
        if scene is None:
            pending.append(folder)
        else:
            outcomes[folder.key] = Outcome(folder.key, scene, COMPLETE_JSON in scene.members)
    return outcomes, pending


def settle(
    tree: Tree,
    *,
    videos: Literal["all", "of one camera"] = "all",
    progress: Progress | None = None,
) -> tuple[Tree, dict[str, Outcome]]:
    """Open some scenes of a tree: the same ones, whichever are wanted or were opened before.

    Args:
        tree: The tree.
        videos: Which videos of each scene are opened: all, or those of another camera each time.
        progress: Called after each scene with the number of scenes done and that of all.

    Returns:
        The tree with how most of these scenes have their poses, and what became of each, in order.

    Raises:
        StorageError: If no form of poses is that of most; it lists the forms.
    """
    keys = sorted(tree.ids)
    count = _SETTLED_BY if tree.remote is None else _SETTLED_BY_REMOTE
    places = np.unique(np.linspace(0, len(keys) - 1, count).astype(int)).tolist()
    chosen = [tree.folder(keys[place]) for place in places]
    names = [None if videos == "all" else (rgb_name(camera), depth_name(camera))
             for camera in (place % CAMERA_COUNT for place in range(len(chosen)))]  # fmt: skip
    outcomes: dict[str, Outcome] = {}
    several_shapes = bool((tree.stated or BUILT_IN).has)
    guided = tree
    if tree.remote is None:
        for folder in chosen:
            outcome = guided.settling(folder, None)
            if guided.settled is not None and outcome.lacks_poses:
                outcome = tree.settling(folder, None)
            outcomes[folder.key] = outcome
            if progress is not None:
                progress(len(outcomes), len(tree.ids))
            if guided.settled is None and outcome.has_one_form and not several_shapes:
                guided = tree.with_poses_of(outcome)
    else:
        found = in_parallel(lambda each: tree.settling(*each), zip(chosen, names, strict=True))
        outcomes = {outcome.key: outcome for outcome in found}
    if several_shapes:
        return tree, outcomes
    return _with_common_poses(guided, chosen, names, outcomes)


def _with_common_poses(
    tree: Tree,
    chosen: Sequence[SceneFolder],
    names: Sequence[Collection[str] | None],
    outcomes: dict[str, Outcome],
) -> tuple[Tree, dict[str, Outcome]]:
    """Return a tree that reads poses as most of some scenes have them, and these read so."""
    forms = {key: each.found.pose_form for key, each in outcomes.items()
             if isinstance(each.found, Scene) and each.has_one_form}  # fmt: skip
    votes = Counter(forms.values()).most_common()
    if not votes:
        return tree, outcomes
    form, count = votes[0]
    of_form = {each: key for key, each in reversed(forms.items())}  # the first scene of each
    if 2 * count <= len(forms):
        listed = "".join(
            f"\n  {counted(number, 'scene')}, such as {of_form[each]}: "
            f"{shortened(each or _USUAL_FORM, 200)}"
            for each, number in votes[:_NAMED]
        )
        raise StorageError(
            f"{shown(tree.root)}: no form of poses is that of most scenes. Of those that were "
            f"looked at{listed}\n`stereogenbench conventions {shown(tree.root)}` writes a file "
            f"with a [[shape]] for each kind that has keys of its own: give it as conventions= or "
            f"--conventions."
        )
    if tree.settled is None or tree.settled.form != form:
        tree = tree.with_poses_of(outcomes[of_form[form]])
    for folder, videos in zip(chosen, names, strict=True):
        outcome = outcomes[folder.key]
        if isinstance(outcome.found, Scene) and outcome.found.pose_form != form and (
            not outcome.lacks_poses
        ):  # fmt: skip
            outcomes[folder.key] = tree.settling(folder, videos, kept="ignored")
    return tree, outcomes


_USUAL_FORM: Final = "the form that the paper prints"


class ManyReadsWarning(UserWarning):
    """So much is read that it takes a while."""


def tell_requests(root: str | Path, scenes: int, *, each: int, what: str) -> None:
    """Warn of the requests that scenes behind a URL take, if a server may let them wait."""
    requests, where = scenes * each, shown(root)
    if requests > _WARN_ABOVE_REQUESTS:
        message = (
            f"{where}: reads {what} of {scenes} scenes in {requests:,} requests: on the Hub "
            f"without a login some {requests // 600} minutes. An interrupted run goes on where it "
            f"stopped; an index holds them: `stereogenbench index {where}`."
        )
        warnings.warn(message, ManyReadsWarning, stacklevel=2)


def find_tree(
    root: str | Path,
    *,
    wanted: Callable[[SceneId], bool] | None,
    if_none: Literal["refuse", "all"] = "refuse",
    conventions: Conventions | None = None,
    retry: RetryPolicy | None = None,
) -> Tree:
    """Return the wanted scenes of a folder or URL, whose files are not listed yet; see `walk`."""
    remote = RemoteTree(RemoteObject(str(root), retry=retry)) if is_remote(root) else None
    keys, refused = find_scene_folders(Path(root)) if remote is None else remote.scenes()
    is_marked = remote is None and any(Path(root, key, COMPLETE_JSON).exists() for key in keys)
    ids = _with_subsets(map(parse_scene_key, keys))
    chosen = [key for key, scene in ids.items() if wanted is None or wanted(scene)]
    if not chosen and if_none == "refuse":
        there = sorted({key.rpartition("/")[0] for key in keys})
        more = f" and {len(there) - _NAMED} folders more" if len(there) > _NAMED else ""
        raise StorageError(
            f"{shown(root)}: none of its {counted(len(keys), 'scene')} matches; there are scenes "
            f"in {', '.join(there[:_NAMED])}{more}. Check the filters' spelling."
        )
    shapes = () if conventions is None else conventions.shapes
    return Tree(
        root,
        tuple(chosen or keys),
        refused,
        is_part=wanted is not None and bool(chosen),
        ids=ids,
        is_marked=is_marked,
        cache=TreeCache(root, " ".join(shape.text() for shape in shapes)),
        remote=remote,
        conventions=conventions,
    )


def _with_subsets(scenes: Iterable[SceneId]) -> dict[str, SceneId]:
    """Return scenes by key; those of eval whose path names no subset get it by their map.

    It counts as seen if a scene of train has it, of this tree or of the release.
    """
    scenes = [*scenes]
    maps = TRAIN_MAPS | {scene.map_name for scene in scenes if scene.split == "train"}
    found = {scene.key: scene for scene in scenes}
    for scene in scenes:
        if scene.split == "eval" and scene.subset is None:
            subset: Subset = "seen_map" if scene.map_name in maps else "unseen_map"
            found[scene.key] = replace(scene, subset=subset)
    return found


def require_some(tree: Tree, outcomes: Collection[Outcome]) -> None:
    """Refuse a tree if none of the scenes that were looked at can be used.

    Raises:
        StorageError: It tells each reason once; where it is the format of files, the cure.
    """
    if any(isinstance(out.found, Scene) for out in outcomes):
        return
    where = shown(tree.root)
    told = reasons_told({out.key: str(out.found) for out in outcomes})
    is_format = not all(isinstance(out.found, IncompleteScene) for out in outcomes)
    cure = f"\n{FORMAT_CURE.format(root=where)}" if is_format else ""
    raise StorageError(
        f"{where}: none of the {counted(len(outcomes), 'scene')} that were looked at can be used:"
        f"\n  {told}{cure}"
    )


def report_of(tree: Tree, of_keys: Mapping[str, Outcome]) -> TreeReport:
    """Return the report of a walk that had these outcomes, one a scene.

    Scenes without their completion mark are not finished, unless no scene of the tree has one.
    """
    outcomes = [of_keys[key] for key in tree.keys]
    if tree.is_marked:
        outcomes = [out if out.has_mark else Outcome(out.key, unfinished(out.key))
                    for out in outcomes]  # fmt: skip
    left_out = {out.key: out.found for out in outcomes if not isinstance(out.found, Scene)}
    incomplete = {key: str(error) for key, error in left_out.items()
                  if isinstance(error, IncompleteScene)}  # fmt: skip
    broken = {key: str(error) for key, error in left_out.items() if key not in incomplete}
    found = [out.found for out in outcomes if isinstance(out.found, Scene)]
    found = _without_unfetched(found)
    ids = tree.ids
    scenes = [scene if scene.id == ids[scene.id.key] else replace(scene, id=ids[scene.id.key])
              for scene in found]  # fmt: skip
    eval_keys = (key for key in tree.keys if key.startswith("eval/"))
    unnamed = {key.split("/")[1] for key in eval_keys if parse_scene_key(key).subset is None}
    labels = [f"{scene.id.key}: {brief(scene.labels.map_name)}" for scene in scenes
              if scene.labels.map_name not in (None, scene.id.map_name)]  # fmt: skip
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
        root=str(tree.root),
        scenes=tuple(scenes),
        incomplete=incomplete,
        broken=dict(sorted((tree.refused | broken).items())),
        odd=_odd_ones(scenes),
        notes=(*subsets, *named, *remarks_told(found)),
        is_part=tree.is_part,
    )


def _odd_ones(scenes: Sequence[Scene]) -> dict[str, str]:
    """Return what is odd about scenes and not about most others, by their keys."""
    counts = Counter(remark.about for scene in scenes for remark in scene.remarks)
    told = {
        scene.id.key: "; ".join(
            each.text for each in scene.remarks if 2 * counts[each.about] < len(scenes)
        )
        for scene in scenes
    }
    return {key: text for key, text in told.items() if text}


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
