"""Thousands of scenes without an index: a few are read, the others are presumed to be like these.

Opening lists all files and reads each ``baseline.json``. Of scenes of one split and family with the
same files, a few are described in full; what these have alike (frames, key frames, picture size,
depth) the others are presumed to have, with cameras on a line as the baselines say. A scene's
trajectory and the heads of its videos are read when its first sample is: length and order of an
epoch rest on what was presumed, so a scene that is different ends the run.

Behind a URL each ``baseline.json`` is read where a selection needs them (`SceneIndex.column`), or a
file below ``metadata/`` that has a record of every scene, if it agrees with those of the scenes
that were described; and of a scene only the videos that its samples need are opened, ahead of them
where the order is known. The paper names a merged JSONL of descriptions and scene manifests there,
without their names and keys: so a record is the scene's whose path it holds, or whose split,
family, map and folder are all among its values.
"""

import json
import re
from collections import OrderedDict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from operator import eq
from pathlib import PurePosixPath
from typing import Any, Final, Literal

import numpy as np

from stereogenbench_data.errors import SchemaError, StereoGenBenchError, StorageError
from stereogenbench_data.geometry.rig import RECTIFIED_PX
from stereogenbench_data.index.build import (
    ALIKE,
    Outcome,
    Tree,
    TreeReport,
    report_of,
    tell_requests,
)
from stereogenbench_data.index.evidence import agreed_forms
from stereogenbench_data.index.scene_folder import (
    DESCRIPTIONS,
    as_agreed,
    as_kept,
    assumed_places_m,
    caption_of,
    held_name,
    members_of,
    merged_labels,
    missing_video,
    sized_as_videos,
)
from stereogenbench_data.index.tree import (
    Files,
    SceneFolder,
    in_parallel,
)
from stereogenbench_data.schema.declaration import BUILT_IN, Declaration
from stereogenbench_data.schema.parse import (
    parse_complete,
    parse_rig,
    parse_scene_key,
    require_unit,
)
from stereogenbench_data.schema.records import (
    Remark,
    Rig,
    Scene,
    SceneId,
    SceneLabels,
)
from stereogenbench_data.schema.release import (
    BASELINE_JSON,
    CAMERA_PAIRS,
    COMPLETE_JSON,
    DESCRIPTION_JSON,
    TRAINING_JSON,
    VIDEO_FILES,
    depth_name,
)
from stereogenbench_data.schema.text import shortened
from stereogenbench_data.sources.fetch_ahead import FetchAhead, Wanted
from stereogenbench_data.sources.location import shown
from stereogenbench_data.sources.remote import RemoteObject
from stereogenbench_data.sources.retry import MissingObject

FOLDER: Final = "metadata"

_LARGEST_BYTES: Final = 64 * 2**20
_KINDS: Final = (".jsonl", ".json")
_PATH: Final = re.compile(r"(?:^|/)((?:train/[^/]+|eval/[^/]+/[^/]+)/[^/]+/[^/]+)(?:/|$)")


def merged_records(root: RemoteObject, keys: Sequence[str]) -> Iterator[dict[str, bytes]]:
    """Yield the records of each file that has one of every scene: key to a JSON object.

    Raises:
        StorageError: If the folder is there, and a file of it cannot be fetched.
    """
    folder = root.below(FOLDER)
    try:
        listed = folder.listed()
    except MissingObject:
        return
    for name, (size, _) in sorted(listed.items()):
        if size is None or size > _LARGEST_BYTES or PurePosixPath(name).suffix not in _KINDS:
            continue
        text = folder.below(name, expected_size=size).read(0, size)
        found: dict[str, bytes] = {}
        scenes = _Scenes(keys)
        try:
            for name_of_record, record in _records(text.decode("utf-8-sig"), name):
                key = scenes.key_of(record, name_of_record)
                if key in found:  # records of frames or pairs, or of another release, too
                    break
                if key is not None:
                    found[key] = json.dumps(record).encode()
            else:
                if len(found) == len(keys):
                    yield found
        except (ValueError, RecursionError):
            continue  # not a file of records: each scene's own files are read


def _records(text: str, name: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the objects of a file, each with the name it stands under, if any."""
    if name.endswith(".jsonl"):
        document: Any = [json.loads(line) for line in text.splitlines() if line.strip()]
    else:
        document = json.loads(text)
    for node in (document, *(document.values() if isinstance(document, dict) else ())):
        listed = [("", each) for each in node] if isinstance(node, list) else []
        named = [*node.items()] if isinstance(node, dict) else listed
        if all(isinstance(record, dict) for _, record in named):
            yield from named


class _Scenes:
    """Finds the scene of a record."""

    def __init__(self, keys: Sequence[str]) -> None:
        self._keys = frozenset(keys)
        self._by_folder: dict[str, list[str]] = {}
        for key in keys:
            self._by_folder.setdefault(key.rpartition("/")[2], []).append(key)

    def key_of(self, record: dict[str, Any], name: str) -> str | None:
        """Return the key of the scene that a record is of, None if it tells none or several."""
        texts = {value for value in (name, *record.values()) if isinstance(value, str)}
        found = {match[1] for text in texts for match in _PATH.finditer(text)} & self._keys
        if not found:
            folders = texts & self._by_folder.keys()
            parts = ((key, key.split("/")) for name in folders for key in self._by_folder[name])
            found = {key for key, needed in parts if texts.issuperset(needed)}
        return found.pop() if len(found) == 1 else None


_LOOKED_AT: Final = 20
"""How many scenes are described in full when a tree is opened, over all groups."""
_LEAST_OF_A_GROUP: Final = 3
FEW_REMOTE: Final = 8
"""Fewer scenes behind a URL are all described."""
_KEPT_SCENES: Final = 512
"""Of how many scenes behind a URL what was described is kept in memory."""
_LONGEST_TOLD: Final = 2000
_ROUNDING: Final = 1e-6
"""A file of all scenes may round what ``baseline.json`` has in full."""
_OF_A_FORMAT: Final = ("poses", "world", "left")
"""Remarks that are presumed of all scenes of a group where each one that was read has them."""


@dataclass(frozen=True, slots=True)
class _Metadata:
    """What a scene's listing and its small JSON files say; without a rig these were not read."""

    id: SceneId
    files: Files
    rig: Rig | None = None
    labels: SceneLabels = field(default_factory=SceneLabels)
    remarks: tuple[Remark, ...] = ()


Baselines = Literal["read", "when needed"]


def presumed_report(tree: Tree, baselines: Baselines) -> TreeReport | None:
    """Return what a walk would find, of which most is presumed.

    None where nothing can be presumed: the first scenes are all broken or derived for training, or
    those that were read are not alike. Then all must be read.

    Args:
        tree: The tree.
        baselines: Whether each ``baseline.json`` is read; if not, what it says is presumed, too,
            unless the scenes that are read have different primary pairs.
    """
    tree = tree.with_settled_poses()
    outcomes: dict[str, Outcome] = {}
    groups: dict[tuple[object, ...], list[_Metadata]] = {}
    for key, found in _metadata(tree, baselines):
        if isinstance(found, StereoGenBenchError):
            # A focal length in pixels may need the size of the videos.
            is_of_rig = isinstance(found, SchemaError)
            outcomes[key] = tree.outcome(tree.folder(key)) if is_of_rig else Outcome(key, found)
            if len(outcomes) == ALIKE and not groups:
                return None
            continue
        if TRAINING_JSON in found.files:
            return None
        videos = frozenset(name for name in found.files if name.startswith("cam_"))
        groups.setdefault((found.id.split, found.id.family, videos), []).append(found)
    for group in groups.values():
        count = _LEAST_OF_A_GROUP
        if tree.remote is None:
            count = max(count, _LOOKED_AT // len(groups))
        places = np.unique(np.linspace(0, len(group) - 1, count).astype(int)).tolist()
        keys = [group[place].id.key for place in places]
        looked_at = [*in_parallel(tree.outcome, map(tree.folder, keys))]
        outcomes |= {outcome.key: outcome for outcome in looked_at}
        models = [outcome.found for outcome in looked_at if isinstance(outcome.found, Scene)]
        others = [each for each in group if each.id.key not in outcomes]
        if others and not _are_alike(models):
            return None
        if others and baselines != "read" and len({each.rig.primary_pair for each in models}) > 1:
            return presumed_report(tree, "read")
        for each in others:
            scene, key = _presumed(each, models, tree.stated), each.id.key
            presumed = scene and Outcome(key, scene, has_mark=COMPLETE_JSON in each.files)
            outcomes[key] = presumed or tree.outcome(tree.folder(key))
    return report_of(tree, outcomes)


def _metadata(
    tree: Tree, baselines: Baselines
) -> Iterator[tuple[str, _Metadata | StereoGenBenchError]]:
    """Yield what is known of each scene before it is described, or why it cannot be used."""
    keys = tree.keys
    merged = _merged(tree, tree.remote.root) if baselines == "read" and tree.remote else {}

    def read(key: str) -> tuple[Files, bytes] | StereoGenBenchError:
        try:
            files = tree.finished(key)
            if baselines != "read" or merged:
                return files, merged.get(key, b"")
            return files, tree.folder(key).read(BASELINE_JSON)
        except StereoGenBenchError as error:
            return error

    if baselines == "read" and tree.remote and not merged:
        tell_requests(tree.root, len(keys), each=1, what=BASELINE_JSON)
    for key, found in zip(keys, tree.of_each(read, keys), strict=True):
        if isinstance(found, StereoGenBenchError):
            yield key, found
            continue
        files, text = found
        try:
            known = _Metadata(parse_scene_key(key), files)
            if baselines == "read":
                folder = None if merged else tree.folder(key)
                known = _with_rig(known, text, tree.stated, folder)
        except StereoGenBenchError as error:
            yield key, error
        else:
            yield key, known


def _with_rig(
    known: _Metadata, text: bytes, stated: Declaration | None, folder: SceneFolder | None
) -> _Metadata:
    """Return what is known of a scene with what a ``baseline.json`` says."""
    where = f"{known.id.key}/{BASELINE_JSON}"
    rig, labels, odd = parse_rig(text, where=where, declared=stated or BUILT_IN)
    odd = (*odd, *require_unit(rig, family=known.id.family, where=where))
    if folder is not None:
        labels = _with_marked(labels, folder, known.files)
    return replace(known, rig=rig, labels=labels, remarks=odd)


def _with_marked(labels: SceneLabels, folder: SceneFolder, files: Files) -> SceneLabels:
    """Return labels, with those by which scenes are chosen if only the completion mark has them."""
    if COMPLETE_JSON not in files or None not in (labels.character, labels.animation):
        return labels
    marked, _ = parse_complete(folder.read(COMPLETE_JSON), where=f"{folder.key}/{COMPLETE_JSON}")
    return merged_labels(labels, marked)


def _merged(tree: Tree, root: RemoteObject) -> Mapping[str, bytes]:
    """Return a record of each scene that says what some scenes' own files say, if there is one."""
    keys = tree.keys
    places = np.unique(np.linspace(0, len(keys) - 1, _LOOKED_AT).astype(int)).tolist()
    some = [keys[place] for place in places]

    def own(key: str) -> tuple[Any, ...]:
        folder = tree.folder(key)
        rig, labels, _ = parse_rig(
            folder.read(BASELINE_JSON), where=key, declared=tree.stated or BUILT_IN
        )
        return rig, _with_marked(labels, folder, tree.finished(key))

    for records in merged_records(root, keys):
        with suppress(SchemaError, StorageError):  # of a record, or of the files of one of these
            stated = (
                parse_rig(records[key], where=key, declared=tree.stated or BUILT_IN) for key in some
            )
            both = zip(stated, in_parallel(own, some), strict=True)
            if all(a[1] == b[1] and not [*_rig_differences(a[0], b[0])] for a, b in both):
                return records
    return {}


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


def _presumed(each: _Metadata, models: Sequence[Scene], stated: Declaration | None) -> Scene | None:
    """Return a scene that is like others; None where its baselines are not those of a line."""
    key, like = each.id.key, models[0]
    remarks = [*each.remarks]
    size_px = like.rig.image_width_px, like.rig.image_height_px
    rig = sized_as_videos(key, each.rig or like.rig, size_px, remarks=remarks, shape=stated)
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
    if COMPLETE_JSON not in each.files:
        remarks.append(Remark("marker", f"{key}: has no {COMPLETE_JSON}"))
    for about in _OF_A_FORMAT:
        if all(model.remark(about) for model in models):
            text = f"{key} is presumed to be like other scenes: {like.remark(about)}"
            remarks.append(Remark(about, text))
    return replace(
        like,
        id=each.id,
        labels=each.labels,
        caption="",
        rig=rig,
        lateral_m=places_m,
        rig_residual_px=max(model.rig_residual_px for model in models),
        valid_depth_ratio=None,
        remarks=as_kept(remarks),
        pose_form=None,
        members=members_of(key, each.files),
        seek_tables=None,
    )


def _is_mirrored(scene: Scene) -> bool:
    """Return whether a scene's cameras stand the other way round than its primary pair says."""
    left, right = scene.rig.primary_pair
    return scene.lateral_m[left] > scene.lateral_m[right]


class Presumption:
    """Describes scenes of which a table holds what is presumed, when they are needed.

    Attributes:
        tree: The tree; of a folder of this machine without its files.
        was_told: Whether a scene that is odd, and can be used, was told in this process.
        is_remote: Whether the scenes are behind a URL.
        baselines: Whether each ``baseline.json`` was read.
    """

    def __init__(self, tree: Tree, *, forms: Sequence[str], baselines: Baselines) -> None:
        """Name the tree, and how the poses are read of the scenes that were read."""
        self.was_told = False
        self.is_remote = tree.remote is not None
        self.baselines = baselines
        # On a disk files are listed anew when a scene is needed, so they need not be kept.
        tree = tree.with_settled_poses()
        self.tree = tree if self.is_remote else replace(tree, files={})
        self._agreed = agreed_forms(forms)
        self._ahead = FetchAhead()
        self._planned: dict[str, int] = {}
        self._count = 0
        self._described: OrderedDict[str, tuple[Scene, frozenset[str]]] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy in another process."""
        return self.__dict__ | {"_planned": {}, "_described": OrderedDict()}

    def expect(self, presumed: Scene, videos: Collection[str]) -> None:
        """Describe a scene behind a URL in the background, as `described` will be asked for it."""
        key = presumed.id.key
        if not self.is_remote or key in self._planned or self._known(key, videos) is not None:
            return

        def fill(start: int, stop: int) -> bytes:
            self._describe(presumed, videos)
            return b""

        self._count += 1
        self._planned[key] = self._count
        self._ahead.plan(self._count, [Wanted(key, 0, 1, fill, 0)])
        self._ahead.begin(self._count)

    def described(self, presumed: Scene, videos: Collection[str] = VIDEO_FILES) -> Scene:
        """Return a scene as its files say.

        Args:
            presumed: Its row.
            videos: The videos that are needed. Behind a URL no others are opened, and of these the
                row says what is presumed.

        Raises:
            StorageError: If it is not as presumed, or cannot be read.
        """
        key = presumed.id.key
        if not self.is_remote:
            return self._compared(presumed, self._read(key, videos=None))
        planned = self._planned.pop(key, None)
        try:
            if planned is not None:
                self._ahead.read(key, 0)
            known = self._known(key, videos)
            # Another pair of the scene needs other videos: there will be more of them.
            is_more = known is None and key in self._described
            return known or self._describe(presumed, VIDEO_FILES if is_more else videos)
        finally:
            if planned is not None:
                self._ahead.release(planned)

    def _known(self, key: str, videos: Collection[str]) -> Scene | None:
        scene, opened = self._described.get(key, (None, frozenset()))
        return scene if opened.issuperset(videos) else None

    def _describe(self, presumed: Scene, videos: Collection[str]) -> Scene:
        """Return a scene behind a URL, of which some videos are opened, and keep it."""
        opened = frozenset(videos)
        scene = self._read(presumed.id.key, videos=opened)
        if opened != frozenset(VIDEO_FILES):
            scene = _with_presumed(scene, presumed, opened)
        scene = self._compared(presumed, scene)
        self._described[presumed.id.key] = scene, opened
        while len(self._described) > _KEPT_SCENES:
            self._described.popitem(last=False)
        return scene

    def _read(self, key: str, *, videos: frozenset[str] | None) -> Scene:
        try:
            return self.tree.describe(self.tree.folder(key), videos)
        except StereoGenBenchError as error:
            raise StorageError(self._contradicted(key, [str(error)])) from error

    def _compared(self, presumed: Scene, scene: Scene) -> Scene:
        """Return a scene that is as presumed."""
        key = presumed.id.key
        scene = as_agreed(scene, self._agreed)
        differences = list(_differences(presumed, scene, baselines=self.baselines))
        if differences:
            raise StorageError(self._contradicted(key, differences))
        return replace(scene, id=presumed.id)

    def captions(self, keys: Iterable[str]) -> list[str]:
        """Return the captions of scenes; one that cannot be read is empty."""

        def caption(key: str) -> str:
            folder, texts = self.tree.folder(key), dict[str, bytes]()
            for name in DESCRIPTIONS:
                with suppress(StereoGenBenchError):
                    texts[name] = folder.read(name)
            return caption_of(texts, key=key)[0]

        keys = [*keys]
        remote = self.tree.remote
        for merged in () if remote is None else merged_records(remote.root, keys):
            found = [caption_of({DESCRIPTION_JSON: merged[key]}, key=key)[0] for key in keys]
            if any(found) and all(map(eq, found, map(caption, keys[:_LEAST_OF_A_GROUP]))):
                return found
        return list(self.tree.of_each(caption, keys))

    def cures(self) -> str:
        """Return what to do about a scene that is not as presumed."""
        away = "select other scenes" if self.is_remote else "move this scene's folder away"
        return (
            f"A folder without an index is opened by a few of its scenes, and length and order of "
            f"an epoch rest on that. Run `stereogenbench index {shown(self.tree.root)}`, which "
            f"reads all scenes and tells such ones beforehand, or {away}."
        )

    def _contradicted(self, key: str, found: list[str]) -> str:
        told = shortened("; ".join(found), _LONGEST_TOLD)
        return (
            f"{shown(self.tree.root)}: {key} is not as was presumed of it: {told}. {self.cures()}"
        )


def _with_presumed(found: Scene, presumed: Scene, opened: frozenset[str]) -> Scene:
    """Return a scene with what is presumed of the videos that were not opened."""

    def of_cameras(name: str) -> tuple[Any, ...]:
        both = zip(getattr(found, name), getattr(presumed, name), strict=True)
        return tuple(
            own if depth_name(camera) in opened else other
            for camera, (own, other) in enumerate(both)
        )

    are_keys = set(presumed.key_frames) <= set(found.key_frames)
    has_pictures = any(name.endswith(".mp4") for name in opened)
    return replace(
        found,
        key_frames=presumed.key_frames if are_keys or not has_pictures else found.key_frames,
        depth_unit_m=of_cameras("depth_unit_m"),
        depth_offset_m=of_cameras("depth_offset_m"),
        depth_unit_source=of_cameras("depth_unit_source"),
        depth_codec=of_cameras("depth_codec"),
        depth_pixel_format=of_cameras("depth_pixel_format"),
    )


def _differences(presumed: Scene, found: Scene, *, baselines: Baselines) -> Iterator[str]:
    """Yield how a scene contradicts what selection, order and checks took from its row.

    Another picture size is no contradiction: it is read as it is, and scaled where that is wanted.
    """
    before, now = _format_of(presumed), _format_of(found)
    for what, value in before.items():
        if repr(now[what]) != repr(value):
            yield f"{what} presumed {value}, found {now[what]}"
    if found.members != presumed.members:
        yield found.remark("videos") or "its files have changed since it was opened"
    if found.remark("left") and not presumed.remark("left"):
        yield found.remark("left")
    if baselines == "read":
        yield from _rig_differences(presumed.rig, found.rig)
    elif presumed.rig.primary_pair != found.rig.primary_pair:
        yield f"primary pair presumed {presumed.rig.primary_pair}, found {found.rig.primary_pair}"
    before_m, now_m = presumed.lateral_m, found.lateral_m
    if any((before_m[b] > before_m[a]) != (now_m[b] > now_m[a]) for a, b in CAMERA_PAIRS):
        yield f"places of cameras in m presumed {presumed.lateral_m}, found {found.lateral_m}"
    if presumed.rig_residual_px <= RECTIFIED_PX < found.rig_residual_px:
        yield f"a rectified rig presumed, found one that is off by {found.rig_residual_px:.3g} px"


def _rig_differences(before: Rig, now: Rig) -> Iterator[str]:
    """Yield what of two rigs differs by more than the rounding of a text."""
    for name in ("primary_pair", "baselines_cm", "focal_mm", "sensor_width_mm"):
        value, there = getattr(before, name), getattr(now, name)
        if not np.allclose(there, value, rtol=_ROUNDING, atol=0):
            yield f"{name} of {BASELINE_JSON} read as {value}, and it is {there}"
