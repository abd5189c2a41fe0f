"""Scenes of a large tree that were not opened yet: their rows, and opening one when it is needed.

Of thousands of scenes without an index some 20 are opened (`build.settle`). Frames, picture size,
depth and poses of the others are taken to be as most of these have them; names, files and lengths
come from their own listing and ``baseline.json``. Behind a URL no ``baseline.json`` is read either,
unless that is asked for (`SceneIndex.with_baselines`).

When a scene's first sample is needed, its files are opened and compared with its row. Length and
order of an epoch rest on the row, so a scene that differs ends the run, with
``stereogenbench index`` as the cure.
"""

from collections import Counter, OrderedDict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, Final, Literal

from stereogenbench_data.errors import StereoGenBenchError, StorageError
from stereogenbench_data.geometry.rig import RECTIFIED_PX
from stereogenbench_data.index.build import (
    Outcome,
    Tree,
    TreeReport,
    report_of,
    require_some,
    tell_requests,
)
from stereogenbench_data.index.scene_folder import (
    DESCRIPTIONS,
    as_kept,
    assumed_places_m,
    caption_of,
    held_name,
    members_of,
    merged_labels,
    missing_video,
    sized_as_videos,
)
from stereogenbench_data.index.tree import Files, SceneFolder
from stereogenbench_data.schema.declaration import BUILT_IN
from stereogenbench_data.schema.parse import parse_complete, parse_rig, require_unit
from stereogenbench_data.schema.records import Remark, Rig, Scene, SceneLabels
from stereogenbench_data.schema.release import (
    BASELINE_JSON,
    CAMERA_COUNT,
    CAMERA_PAIRS,
    COMPLETE_JSON,
    TRAJECTORY_JSON,
    VIDEO_FILES,
    depth_name,
)
from stereogenbench_data.schema.text import counted, shortened
from stereogenbench_data.sources.fetch_ahead import FetchAhead, Wanted
from stereogenbench_data.sources.location import shown

Baselines = Literal["read", "not read"]

_OF_ALL: Final = ("poses", "world", "left")
"""Remarks that hold for all scenes of a format where they hold for one."""
_STOPPING: Final = (*_OF_ALL, "principal point", "depth", "videos")
"""Remarks that stop samples."""
_LISTED_KINDS: Final = 4
_KEPT_SCENES: Final = 512
"""Of how many scenes behind a URL what was found is kept in memory."""
_LONGEST_TOLD: Final = 2000


def unopened_report(
    tree: Tree, opened: Mapping[str, Outcome], baselines: Baselines
) -> TreeReport | None:
    """Return the rows of a tree of which some scenes are opened.

    None where every scene must be opened: training shards were unpacked there.

    Args:
        tree: The tree, whose files are listed.
        opened: What became of the scenes that were opened (`settle`).
        baselines: Whether each ``baseline.json`` is read; if not, all are taken to be alike.

    Raises:
        StorageError: If none of the scenes that are opened can be used, or no format is that of
            most of them; it lists the formats.
    """
    scenes = [each.found for each in opened.values() if isinstance(each.found, Scene)]
    if any(scene.training is not None for scene in scenes):
        return None
    require_some(tree, opened.values())
    whole = [scene for scene in scenes if TRAJECTORY_JSON in scene.members] or scenes
    alike, odd = _majority(tree, whole, baselines)
    outcomes = {key: Outcome(key, error) for key, error in odd.items()}
    others = [key for key in tree.keys if key not in outcomes]

    def row(key: str) -> Outcome:
        known = opened.get(key)
        if known is not None and not isinstance(known.found, Scene):
            return known
        try:
            files = tree.finished(key)
            scene = _row(tree, tree.folder(key), files, alike, baselines=baselines)
        except StereoGenBenchError as error:
            return Outcome(key, error)
        if scene is None:  # its poses may tell where cameras stand that are on no line
            return known or tree.outcome(tree.folder(key))
        return Outcome(key, scene, has_mark=COMPLETE_JSON in files)

    outcomes |= zip(others, tree.of_each(row, others), strict=True)
    return report_of(tree, outcomes)


def _majority(
    tree: Tree, scenes: Sequence[Scene], baselines: Baselines
) -> tuple[list[Scene], dict[str, StorageError]]:
    """Return the scenes that have the format of most, and what is odd about the wanted others."""
    formats = {scene.id.key: _format_of(scene, baselines) for scene in scenes}
    texts = {key: repr(found) for key, found in formats.items()}
    (common, count), *_ = votes = Counter(texts.values()).most_common()
    alike = [scene for scene in scenes if texts[scene.id.key] == common]
    usual = formats[alike[0].id.key]
    odd = {
        key: StorageError(
            f"{key}: is unlike {count} of the {len(scenes)} scenes that were looked at: "
            f"{'; '.join(_unlike(usual, found))}. {_cure_of(tree, usual, found)}"
        )
        for key, found in formats.items() if texts[key] != common
    }  # fmt: skip
    if 2 * count <= len(scenes):
        firsts = [next(key for key in texts if texts[key] == kind) for kind, _ in votes]
        listed = "".join(
            f"\n  {counted(number, 'scene')}, such as {key}"
            + (f": {'; '.join(_unlike(usual, formats[key]))}" if key in odd else "")
            for key, (_, number) in list(zip(firsts, votes, strict=True))[:_LISTED_KINDS]
        )
        raise StorageError(
            f"{shown(tree.root)}: no format is that of most of the {len(scenes)} scenes that were "
            f"looked at, so nothing can be said of the others. There are {len(votes)}:{listed}\n"
            f"Run `stereogenbench index {shown(tree.root)}`, which opens every scene, and open "
            f"that; or state what differs in a file of conventions."
        )
    return alike, {key: error for key, error in odd.items() if key in tree.keys}


def _cure_of(tree: Tree, usual: Mapping[str, object], found: Mapping[str, object]) -> str:
    """Return what to do about scenes of two formats."""
    if usual["poses"] == found["poses"]:
        return "An index of `stereogenbench index` may hold both."
    return f"`stereogenbench conventions {shown(tree.root)}` writes a file that states both."


def _unlike(usual: Mapping[str, object], found: Mapping[str, object]) -> Iterator[str]:
    """Yield how one format differs from another."""
    for what, value in usual.items():
        if repr(found[what]) != repr(value):
            yield f"{what} {found[what]}, and not {value}"


def _format_of(
    scene: Scene, baselines: Baselines, cameras: Sequence[int] = range(CAMERA_COUNT)
) -> dict[str, object]:
    """Return what is taken from a scene for others, by names for messages."""

    def of_cameras(name: str) -> tuple[object, ...]:
        values = getattr(scene, name)
        return tuple(values[camera] for camera in cameras)

    return {
        "frames": scene.frames,
        "key frames": scene.key_frames,
        "picture size in pixels": (scene.rig.image_width_px, scene.rig.image_height_px),
        "codec of depth": of_cameras("depth_codec"),
        "pixel format of depth": of_cameras("depth_pixel_format"),
        "metres in a unit of depth": of_cameras("depth_unit_m"),
        "metres of depth at the stored number 0": of_cameras("depth_offset_m"),
        "where the unit of depth stands": of_cameras("depth_unit_source"),
        "form of poses": scene.pose_form,
        "poses": " and ".join(f"refused for {about!r}" for about in _OF_ALL if scene.remark(about))
        or "as in the others",
    } | ({} if baselines == "read" else {"primary pair": scene.rig.primary_pair})


def _row(
    tree: Tree,
    folder: SceneFolder,
    files: Files,
    alike: Sequence[Scene],
    *,
    baselines: Baselines,
) -> Scene | None:
    """Return the row of a scene that was not opened; None where its cameras are on no line.

    Raises:
        StorageError: If its listing or its ``baseline.json`` shows that it cannot be used.
    """
    key, like, hollow = folder.key, alike[0], folder.hollow(files)
    if BASELINE_JSON in hollow:
        raise StorageError(hollow[BASELINE_JSON])
    rig, labels, remarks = like.rig, SceneLabels(), list[Remark]()
    if baselines == "read":
        rig, labels, remarks = _of_baseline(tree, folder, files, like)
    places_m = assumed_places_m(rig)
    if not places_m:
        return None
    lacking = [missing_video(key, name) for name in VIDEO_FILES
               if held_name(files, name) not in files]  # fmt: skip
    lacking += [why for name, why in hollow.items() if name != TRAJECTORY_JSON]
    if lacking:
        remarks.append(Remark("videos", "; ".join(lacking)))
    if COMPLETE_JSON not in files:
        remarks.append(Remark("marker", f"{key}: has no {COMPLETE_JSON}"))
    for about in _OF_ALL:
        if like.remark(about):
            text = f"{key}, which is taken to be as other scenes: {like.remark(about)}"
            remarks.append(Remark(about, text))
    if TRAJECTORY_JSON in hollow or TRAJECTORY_JSON not in files:
        why = hollow.get(TRAJECTORY_JSON, f"{key}/{TRAJECTORY_JSON}: is missing")
        remarks = [each for each in remarks if each.about != "poses"]
        remarks.append(Remark("poses", why))
    return replace(
        like,
        id=tree.ids[key],
        labels=labels,
        caption="",
        rig=rig,
        lateral_m=places_m,
        rig_residual_px=max(scene.rig_residual_px for scene in alike),
        valid_depth_ratio=None,
        remarks=as_kept(remarks),
        pose_form=None,
        members=members_of(key, files, without=hollow),
        seek_tables=None,
    )


def _of_baseline(
    tree: Tree, folder: SceneFolder, files: Files, like: Scene
) -> tuple[Rig, SceneLabels, list[Remark]]:
    """Return what a ``baseline.json`` says, for pictures of the size that others have."""
    key, size_px = folder.key, (like.rig.image_width_px, like.rig.image_height_px)
    text, where = folder.read(BASELINE_JSON), f"{key}/{BASELINE_JSON}"
    rig, labels, odd = parse_rig(
        text, where=where, declared=tree.stated or BUILT_IN, size_px=size_px
    )
    remarks = [*odd, *require_unit(rig, family=tree.ids[key].family, where=where)]
    rig = sized_as_videos(key, rig, size_px, remarks=remarks, shape=tree.stated)
    if COMPLETE_JSON in files and None in (labels.character, labels.animation):
        marked = f"{key}/{COMPLETE_JSON}"
        labels = merged_labels(labels, parse_complete(folder.read(COMPLETE_JSON), where=marked)[0])
    return rig, labels, remarks


class UnopenedScenes:
    """Opens scenes of a tree when they are needed, and compares them with their rows.

    Attributes:
        tree: The tree.
        is_remote: Whether the scenes are behind a URL.
        baselines: Whether each ``baseline.json`` was read.
        opened: The scenes that were opened with the tree.
    """

    def __init__(self, tree: Tree, opened: Mapping[str, Outcome], *, baselines: Baselines) -> None:
        """Name the tree, with how its poses are read, and the scenes that settled that."""
        self.is_remote = tree.remote is not None
        self.baselines = baselines
        # On a disk files are listed anew when a scene is needed, so nothing of others is kept.
        self.tree = tree if self.is_remote else replace(tree, keys=(), ids={}, files={})
        found = (each.found for each in opened.values())
        self.outcomes = opened
        self.opened = tuple(scene for scene in found if isinstance(scene, Scene))
        self._ahead = FetchAhead()
        self._planned: dict[str, int] = {}
        self._count = 0
        self._found: OrderedDict[str, tuple[Scene, frozenset[str]]] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy in another process."""
        return self.__dict__ | {"_planned": {}, "_found": OrderedDict()}

    def told(self, row: Scene, keys: Collection[str]) -> str:
        """Return how many scenes were not opened yet, and what is taken for granted of them.

        Args:
            row: The row of any of them.
            keys: The keys of all rows.
        """
        count = len({*keys} - {scene.id.key for scene in self.opened})
        size = f"{row.rig.image_width_px}x{row.rig.image_height_px}"
        more = "" if self.baselines == "read" else f", {BASELINE_JSON}"
        return (
            f"{counted(count, 'scene')} of {len(keys):,} not opened yet; taken to be as in "
            f"{len(self.opened)} that were: {row.frames} frames, {size} pixels, "
            f"{row.depth_unit_m[0]:g} m in a unit of depth, poses{more}"
        )

    def cures(self) -> str:
        """Return what to do about a scene that is not as its row says."""
        away = "select other scenes" if self.is_remote else "move this scene's folder away"
        return (
            f"Length and order of an epoch rest on the scenes that were opened first. Run "
            f"`stereogenbench index {shown(self.tree.root)}`, which opens all scenes and tells "
            f"such ones beforehand, or {away}."
        )

    def expect(self, row: Scene, videos: Collection[str]) -> None:
        """Open a scene behind a URL in the background, as `scene` will be asked for it."""
        key = row.id.key
        if not self.is_remote or key in self._planned or self._known(key, videos) is not None:
            return

        def fill(start: int, stop: int) -> bytes:
            self._open(row, videos)
            return b""

        self._count += 1
        self._planned[key] = self._count
        self._ahead.plan(self._count, [Wanted(key, 0, 1, fill, 0)])
        self._ahead.begin(self._count)

    def scene(self, row: Scene, videos: Collection[str] = VIDEO_FILES) -> Scene:
        """Return a scene as its files say.

        Args:
            row: Its row.
            videos: The videos that are needed. Behind a URL no others are opened, and what the
                scene says of these is not known.

        Raises:
            StorageError: If it is not as its row says, or cannot be read.
        """
        key = row.id.key
        if not self.is_remote:
            return self._read(row, None)
        planned = self._planned.pop(key, None)
        try:
            if planned is not None:
                self._ahead.read(key, 0)
            known = self._known(key, videos)
            # Another pair of the scene needs other videos: there will be more of them.
            is_more = known is None and key in self._found
            return known or self._open(row, VIDEO_FILES if is_more else videos)
        finally:
            if planned is not None:
                self._ahead.release(planned)

    def _known(self, key: str, videos: Collection[str]) -> Scene | None:
        scene, opened = self._found.get(key, (None, frozenset()))
        return scene if opened.issuperset(videos) else None

    def _open(self, row: Scene, videos: Collection[str]) -> Scene:
        """Return a scene behind a URL, of which some videos are opened, and keep it."""
        opened = frozenset(videos)
        scene = self._read(row, opened)
        self._found[row.id.key] = scene, opened
        while len(self._found) > _KEPT_SCENES:
            self._found.popitem(last=False)
        return scene

    def _read(self, row: Scene, videos: frozenset[str] | None) -> Scene:
        """Return a scene that is as its row says."""
        key = row.id.key
        opened = frozenset(VIDEO_FILES) if videos is None else videos
        scene = self.tree.settling(self.tree.folder(key), videos).found
        if isinstance(scene, Scene):
            # Fewer videos may have more key frames in common; the order is by those of the row.
            if opened != {*VIDEO_FILES} and (
                not any(name.endswith(".mp4") for name in opened)
                or {*row.key_frames} <= {*scene.key_frames}
            ):
                scene = replace(scene, key_frames=row.key_frames)
            differences = [*_differences(row, scene, opened, self.baselines)]
            if not differences:
                return replace(scene, id=row.id)
        else:
            differences = [str(scene)]
        self.tree.cache.forget_tables()
        told = shortened("; ".join(differences), _LONGEST_TOLD)
        raise StorageError(
            f"{shown(self.tree.root)}: {key} is not as the scenes that were opened first: "
            f"{told.rstrip('.')}. {self.cures()}"
        )

    def captions(self, keys: Iterable[str]) -> list[str]:
        """Return the captions of scenes; one that cannot be read is empty."""

        def caption(key: str) -> str:
            folder, texts = self.tree.folder(key), dict[str, bytes]()
            for name in DESCRIPTIONS:
                with suppress(StereoGenBenchError):
                    texts[name] = folder.read(name)
            return caption_of(texts, key=key)[0]

        keys = [*keys]
        if self.is_remote:
            tell_requests(self.tree.root, len(keys), each=1, what="descriptions")
        return list(self.tree.of_each(caption, keys))


def _differences(
    row: Scene, found: Scene, opened: Collection[str], baselines: Baselines
) -> Iterator[str]:
    """Yield how a scene contradicts what selection, order and checks took from its row."""
    cameras = [each for each in range(CAMERA_COUNT) if depth_name(each) in opened]
    stopped = [about for about in _STOPPING if found.remark(about) and not row.remark(about)]
    yield from (found.remark(about) for about in stopped)
    now, usual = (_format_of(each, baselines, cameras) for each in (found, row))
    for name in ("form of poses", "poses"):
        del now[name], usual[name]
    yield from _unlike(usual, now)
    before_m, now_m = row.lateral_m, found.lateral_m
    if any((before_m[b] > before_m[a]) != (now_m[b] > now_m[a]) for a, b in CAMERA_PAIRS):
        yield f"places of cameras in m {now_m}, and not {before_m}"
    if row.rig_residual_px <= RECTIFIED_PX < found.rig_residual_px:
        yield f"a rig that is off by {found.rig_residual_px:.3g} px from a rectified one"
