"""Thousands of scenes without an index: a few are read, the others are presumed to be like these.

Opening lists all files and reads each ``baseline.json``. Of scenes of one split and family with the
same files, a few are described in full; what these have alike (frames, key frames, picture size,
depth) the others are presumed to have, with cameras on a line as the baselines say. A scene's
trajectory and the heads of its videos are read when its first sample is: length and order of an
epoch rest on what was presumed, so a scene that is different ends the run.
"""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from stereogenbench_data.errors import StereoGenBenchError, StorageError
from stereogenbench_data.geometry.rig import RECTIFIED_PX
from stereogenbench_data.index.alike_rigs import Parsed, RigReader
from stereogenbench_data.index.build import (
    ALIKE,
    POOL_FROM,
    DescribeTask,
    Outcome,
    TreeReport,
    find_scenes,
    report_of,
)
from stereogenbench_data.index.evidence import agreed_forms
from stereogenbench_data.index.scene_folder import (
    DESCRIPTIONS,
    SceneFolder,
    as_agreed,
    as_kept,
    assumed_places_m,
    caption_of,
    describe_scene,
    held_name,
    merged_labels,
    missing_video,
    require_finished,
    sized_as_videos,
    stamp_of,
)
from stereogenbench_data.index.tree import FoundScenes
from stereogenbench_data.index.tree_cache import TreeCache
from stereogenbench_data.schema.conventions import Conventions
from stereogenbench_data.schema.parse import parse_complete, parse_scene_key, require_unit
from stereogenbench_data.schema.records import Member, Remark, Scene, SceneId, SceneLabels
from stereogenbench_data.schema.release import (
    BASELINE_JSON,
    CAMERA_PAIRS,
    COMPLETE_JSON,
    TRAINING_JSON,
    VIDEO_FILES,
)
from stereogenbench_data.schema.text import shortened

_LOOKED_AT: Final = 20
"""How many scenes are described in full when a tree is opened, over all groups."""
_LEAST_OF_A_GROUP: Final = 3
_READERS: Final = 8
_AT_A_TIME: Final = 128
_LONGEST_TOLD: Final = 2000
_OF_A_FORMAT: Final = ("poses", "world", "left")
"""Remarks that are presumed of all scenes of a group where each one that was read has them."""

Files = Mapping[str, tuple[int, int]]
"""Name of each file of a scene to its size in bytes and modification time in ns."""


@dataclass(frozen=True, slots=True)
class ListedTree:
    """The scenes of a folder of this machine, and their files.

    Attributes:
        root: The folder.
        folders: The keys of the scenes, and folders that are none.
        files: Key to files, or to why they cannot be listed.
        is_part: Whether the user chose only some of the scenes.
        stamp: A digest that changes when a file is added, removed or changed.
        conventions: How the files are read.
    """

    root: Path
    folders: FoundScenes
    files: dict[str, Files | StorageError]
    is_part: bool
    stamp: str
    conventions: Conventions | None

    @property
    def has_one_shape(self) -> bool:
        """Whether the conventions concern all scenes alike, whatever keys their files have."""
        return self.conventions is None or not self.conventions.shapes[0].has

    @property
    def read_as(self) -> str:
        """What the conventions state, as a text."""
        shapes = () if self.conventions is None else self.conventions.shapes
        return " ".join(shape.text() for shape in shapes)


def list_tree(
    root: Path,
    wanted: Callable[[SceneId], bool] | None,
    conventions: Conventions | None = None,
) -> ListedTree | None:
    """List the wanted scenes of a tree; None where they are few, which are better read whole."""
    folders, is_part = find_scenes(root, wanted=wanted, if_none="all")
    if len(folders.keys) < POOL_FROM:
        return None

    def listed(key: str) -> Files | StorageError:
        try:
            return SceneFolder(root, key).stamps()
        except StorageError as error:
            return error

    files = dict(zip(folders.keys, _of_each(listed, folders.keys), strict=True))
    digest = hashlib.sha256(repr((is_part, folders.refused)).encode())
    for key, found in files.items():
        digest.update(repr((key, found)).encode())
    return ListedTree(root, folders, files, is_part, digest.hexdigest()[:32], conventions)


def _of_each(read: Callable[[str], Any], keys: Sequence[str]) -> Iterator[Any]:
    """Yield what is read of each scene, in order; several wait for a slow disk at a time."""
    parts = [keys[start : start + _AT_A_TIME] for start in range(0, len(keys), _AT_A_TIME)]
    with ThreadPoolExecutor(_READERS) as pool:
        for part in pool.map(lambda part: [read(key) for key in part], parts):
            yield from part


@dataclass(frozen=True, slots=True)
class _Metadata:
    """What the small JSON files of a scene say."""

    id: SceneId
    files: Files
    parsed: Parsed
    marked: SceneLabels


def presumed_report(tree: ListedTree) -> TreeReport | None:
    """Return what a walk would find, of which most is presumed.

    None where nothing can be presumed: the first scenes are all broken or derived for training, or
    those that were read are not alike. Then all must be read.
    """
    outcomes: dict[str, Outcome] = {}
    groups: dict[tuple[object, ...], list[_Metadata]] = {}
    for key, found in _metadata(tree):
        if isinstance(found, StereoGenBenchError):
            outcomes[key] = Outcome.of_error(key, found)
            if len(outcomes) == ALIKE and not groups:
                return None
            continue
        if TRAINING_JSON in found.files:
            return None
        videos = frozenset(name for name in found.files if name.startswith("cam_"))
        groups.setdefault((found.id.split, found.id.family, videos), []).append(found)
    describe = DescribeTask(str(tree.root), conventions=tree.conventions)
    for group in groups.values():
        count = max(_LEAST_OF_A_GROUP, _LOOKED_AT // len(groups))
        places = np.unique(np.linspace(0, len(group) - 1, count).astype(int)).tolist()
        looked_at = [describe(group[place].id.key) for place in places]
        outcomes |= {outcome.key: outcome for outcome in looked_at}
        models = [outcome.scene for outcome in looked_at if outcome.scene is not None]
        others = [each for each in group if each.id.key not in outcomes]
        if others and not _are_alike(models):
            return None
        for each in others:
            scene = _presumed(each, models, tree.conventions)
            key = each.id.key
            outcomes[key] = describe(key) if scene is None else Outcome(key, "whole", scene)
    in_order = [outcomes[key] for key in tree.folders.keys]
    return report_of(tree.root, tree.folders, in_order, is_part=tree.is_part)


def _metadata(tree: ListedTree) -> Iterator[tuple[str, _Metadata | StereoGenBenchError]]:
    """Yield what the small JSON files of each scene say, or why the scene cannot be used."""
    rigs = RigReader(None if tree.conventions is None else tree.conventions.shapes[0])

    def baseline_text(key: str) -> tuple[Files, bytes] | StereoGenBenchError:
        files = tree.files[key]
        try:
            if isinstance(files, StorageError):
                return files
            require_finished(key, files)
            return files, SceneFolder(tree.root, key).read(BASELINE_JSON)
        except StereoGenBenchError as error:
            return error

    keys = tree.folders.keys
    for key, read in zip(keys, _of_each(baseline_text, keys), strict=True):
        if isinstance(read, StereoGenBenchError):
            yield key, read
            continue
        try:
            scene_id, where = parse_scene_key(key), f"{key}/{BASELINE_JSON}"
            rig, labels, odd = rigs.read(read[1], where=where)
            parsed = rig, labels, (*odd, *require_unit(rig, family=scene_id.family, where=where))
            marked = SceneLabels()
            if labels.character is None or labels.animation is None:  # scenes are chosen by these
                text = SceneFolder(tree.root, key).read(COMPLETE_JSON)
                marked, _ = parse_complete(text, where=f"{key}/{COMPLETE_JSON}")
        except StereoGenBenchError as error:
            yield key, error
            continue
        yield key, _Metadata(scene_id, read[0], parsed, marked)


def _are_alike(models: Sequence[Scene]) -> bool:
    """Return whether scenes have alike what is presumed of others."""
    formats = {repr(_format_of(scene)) for scene in models}
    sizes = {(scene.rig.image_width_px, scene.rig.image_height_px) for scene in models}
    return len(formats) == len(sizes) == 1


def _format_of(scene: Scene) -> dict[str, object]:
    """Return what selection, order and checks take from a presumed row, by names for messages."""
    return {
        "frames": scene.frames,
        "key frames": scene.key_frames,
        "codec of depth": scene.depth_codec,
        "pixel format of depth": scene.depth_pixel_format,
        "metres in a unit of depth": scene.depth_unit_m,
        "metres of depth at the stored number 0": scene.depth_offset_m,
        "where the unit of depth stands": scene.depth_unit_source,
    }


def _presumed(
    each: _Metadata, models: Sequence[Scene], conventions: Conventions | None
) -> Scene | None:
    """Return a scene that is like others; None where its baselines are not those of a line."""
    key, like = each.id.key, models[0]
    rig, labels, odd = each.parsed
    remarks = [*odd]
    size_px = like.rig.image_width_px, like.rig.image_height_px
    shape = None if conventions is None else conventions.shapes[0]
    rig = sized_as_videos(key, rig, size_px, document=None, remarks=remarks, shape=shape)
    places_m = assumed_places_m(rig)
    if not places_m:
        return None
    if all(_is_mirrored(model) for model in models):
        places_m = tuple(-place_m for place_m in places_m)
    missing = [
        missing_video(key, name)
        for name in VIDEO_FILES
        if held_name(each.files, name) not in each.files
    ]
    if missing:
        remarks.append(Remark("videos", "; ".join(missing)))
    for about in _OF_A_FORMAT:
        if all(model.remark(about) for model in models):
            text = f"{key} is presumed to be like other scenes: {like.remark(about)}"
            remarks.append(Remark(about, text))
    return replace(
        like,
        id=each.id,
        labels=merged_labels(labels, each.marked),
        caption="",
        rig=rig,
        lateral_m=places_m,
        rig_residual_px=max(model.rig_residual_px for model in models),
        valid_depth_ratio=None,
        remarks=as_kept(remarks),
        pose_form=None,
        members={name: Member(f"{key}/{name}", 0, size) for name, (size, _) in each.files.items()},
        seek_tables=None,
    )


def _is_mirrored(scene: Scene) -> bool:
    """Return whether a scene's cameras stand the other way round than its primary pair says."""
    left, right = scene.rig.primary_pair
    return scene.lateral_m[left] > scene.lateral_m[right]


class Presumption:
    """Describes scenes of which a table holds what is presumed, when they are needed.

    Attributes:
        was_told: Whether a scene that is odd, and can be used, was told in this process.
    """

    def __init__(self, tree: ListedTree, *, forms: Sequence[str]) -> None:
        """Name the tree, and how the poses are read of the scenes that were read."""
        self.was_told = False
        self._root = tree.root
        self._conventions = tree.conventions
        self._agreed = agreed_forms(forms)
        self._cache = TreeCache(tree.root, tree.read_as)

    def described(self, presumed: Scene) -> Scene:
        """Return a scene as its files say.

        Raises:
            StorageError: If it is not as presumed, or cannot be read.
        """
        key = presumed.id.key
        try:
            stamp = stamp_of(SceneFolder(self._root, key).stamps())
            scene = self._cache.scene(key, stamp=stamp)
            if scene is None:
                scene = describe_scene(self._root, key, conventions=self._conventions)
                self._cache.keep_scene(scene, stamp=stamp)
        except StereoGenBenchError as error:
            raise StorageError(self._contradicted(key, [str(error)])) from error
        scene = as_agreed(scene, self._agreed)
        differences = list(_differences(presumed, scene))
        if differences:
            raise StorageError(self._contradicted(key, differences))
        return replace(scene, id=presumed.id)

    def captions(self, keys: Iterable[str]) -> list[str]:
        """Return the captions of scenes; one that cannot be read is empty."""

        def caption(key: str) -> str:
            folder, texts = SceneFolder(self._root, key), dict[str, bytes]()
            for name in DESCRIPTIONS:
                with suppress(StereoGenBenchError):
                    texts[name] = folder.read(name)
            return caption_of(texts, key=key)[0]

        return list(_of_each(caption, [*keys]))

    def cures(self) -> str:
        """Return what to do about a scene that is not as presumed."""
        return (
            f"A folder without an index is opened by a few of its scenes, and length and order of "
            f"an epoch rest on that. Run `stereogenbench index {self._root}`, which reads all "
            f"scenes and tells such ones beforehand, or move this scene's folder away."
        )

    def _contradicted(self, key: str, found: list[str]) -> str:
        told = shortened("; ".join(found), _LONGEST_TOLD)
        return f"{self._root}: {key} is not as was presumed of it: {told}. {self.cures()}"


def _differences(presumed: Scene, found: Scene) -> Iterator[str]:
    """Yield how a scene contradicts what selection, order and checks took from its row.

    A picture of another size is none: it is read at its own size, and scaled where that is wanted.
    """
    before, now = _format_of(presumed), _format_of(found)
    for what, value in before.items():
        if repr(now[what]) != repr(value):
            yield f"{what} presumed {value}, found {now[what]}"
    if found.remark("videos") != presumed.remark("videos"):
        yield found.remark("videos") or "videos that were missing are there"
    elif found.members != presumed.members:
        yield "its files have changed since it was opened"
    if found.remark("left") and not presumed.remark("left"):
        yield found.remark("left")
    for name in ("baselines_cm", "primary_pair", "focal_mm", "sensor_width_mm"):
        value, there = getattr(presumed.rig, name), getattr(found.rig, name)
        if there != value:
            yield f"{name} of {BASELINE_JSON} read as {value}, and it is {there}"
    if any((before > 0) != (now > 0) for before, now in _steps_m(presumed, found)):
        yield f"places of cameras in m presumed {presumed.lateral_m}, found {found.lateral_m}"
    if presumed.rig_residual_px <= RECTIFIED_PX < found.rig_residual_px:
        yield f"a rectified rig presumed, found one that is off by {found.rig_residual_px:.3g} px"


def _steps_m(presumed: Scene, found: Scene) -> Iterator[tuple[float, float]]:
    for a, b in CAMERA_PAIRS:
        yield (
            presumed.lateral_m[b] - presumed.lateral_m[a],
            found.lateral_m[b] - found.lateral_m[a],
        )
