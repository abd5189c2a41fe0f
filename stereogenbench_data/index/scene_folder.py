"""One scene's folder: whether it is finished, whole and consistent, and its row of the index.

Everything that an index says of a scene comes from its JSON files and the headers of its videos. No
picture is decoded unless the share of measured depth is asked for. `metadata_differences` compares
the same files with an existing row.
"""

import hashlib
import math
import os
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

import numpy as np

from stereogenbench_data.errors import (
    MediaError,
    SchemaError,
    StereoGenBenchError,
    StorageError,
    explain_os_errors,
    text_without_secrets,
)
from stereogenbench_data.geometry.camera import recorded_intrinsics
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.geometry.rig import lateral_offsets_m, rectification_residual_px
from stereogenbench_data.index.evidence import (
    SidesError,
    Understood,
    poses_as,
    shape_of,
    understood_poses,
)
from stereogenbench_data.media.clock import MOST_EXTRA_FRAMES
from stereogenbench_data.media.container import StreamFacts, depth_coding
from stereogenbench_data.media.depth import (
    ANY_DEPTH,
    grey_format,
    measured,
    open_depth,
    read_depth_units,
    require_depth_stream,
    resolve_encoding,
)
from stereogenbench_data.media.depth_frames import CODEC_NAME
from stereogenbench_data.media.seek_table import SeekTable, packed_tables, read_seek_table
from stereogenbench_data.media.video import NO_COLOUR, probe, require_pixel_aspect
from stereogenbench_data.schema.conventions import (
    UNKNOWN,
    Conventions,
    Shape,
    keys_of,
    shape_of_text,
)
from stereogenbench_data.schema.depth_contract import Statement, stated_in_json
from stereogenbench_data.schema.document import (
    MOST_LETTERS,
    brief,
    parse_object,
    parse_text,
    require_text_size,
)
from stereogenbench_data.schema.parse import (
    parse_complete,
    parse_description,
    parse_rig,
    parse_scene_key,
    require_unit,
)
from stereogenbench_data.schema.records import (
    DepthEncoding,
    DepthUnitSource,
    Member,
    Remark,
    Rig,
    Scene,
    SceneLabels,
    TrainingFacts,
)
from stereogenbench_data.schema.release import (
    BASELINE_JSON,
    CAMERA_COUNT,
    CAMERA_PAIRS,
    COMPLETE_JSON,
    DESCRIPTION_JSON,
    DESCRIPTION_TXT,
    METADATA_FILES,
    PACKED_DEPTH_NAMES,
    TRAINING_JSON,
    TRAJECTORY_JSON,
    VIDEO_FILES,
    depth_name,
)
from stereogenbench_data.schema.text import counted, shortened
from stereogenbench_data.schema.training import TrainingDocument, parse_training
from stereogenbench_data.sources.location import is_remote, joined
from stereogenbench_data.sources.members import read_text_file
from stereogenbench_data.sources.ranged_file import MemberFile, RangedFile
from stereogenbench_data.sources.remote import RemoteObject

_T = TypeVar("_T")

ValidDepth = Literal["skip", "sample"]

DESCRIPTIONS: Final = (DESCRIPTION_JSON, DESCRIPTION_TXT)
_DEPTHS: Final = frozenset(name for name in VIDEO_FILES if name.endswith("_depth.mkv"))
_LONGEST_REMARK: Final = 2000
_NO_DEPTH: Final = StreamFacts(CODEC_NAME, "gray16le", 0, 0, 0, 0.0, {})
"""What the index says of depth of a scene of training shards that has none."""
_DEVIATION_CM: Final = 0.1
_DEVIATION_SHARE: Final = 0.001
_LEAST_OFFSET_M: Final = 1e-4
_SQUARE: Final = 0.01
"""How far the sides of a pixel may differ, as a share: lengths of a sensor are rounded."""
FILES: Final = frozenset(
    {*METADATA_FILES, TRAINING_JSON, *VIDEO_FILES, *PACKED_DEPTH_NAMES.values()}
)
"""Files of a release; others in a scene's folder are ignored."""

Difference = tuple[str, str]
"""The file's name, empty for the scene's own path, and how it contradicts the index."""

_Compared = tuple[str, str, object, object]
"""A file, the name of a value, the value that the file has, and that of the index."""
_ROUNDING: Final = {"lateral_m": 1e-6, "rig_residual_px": 1e-3}


class IncompleteScene(StorageError):
    """A scene that is not finished, or of which only metadata were fetched."""


class SceneFolder:
    """A scene's folder on this machine or behind a URL, which is fetched as it is read."""

    def __init__(self, root: str | Path, key: str) -> None:
        """Name the folder by the data's root and the scene's key; nothing is read yet."""
        self._root = root
        self._key = key
        self._sizes: dict[str, int] = {}

    def stamps(self) -> dict[str, tuple[int, int]]:
        """Return the size in bytes and the modification time in ns (0 if unknown) of each file.

        Raises:
            StorageError: If the folder cannot be read.
        """
        if is_remote(self._root):
            if not self._sizes:
                listed = RemoteObject(joined(str(self._root), self._key)).entries()
                self._sizes = {
                    name: size
                    for name, size in sorted(listed.items())
                    if name in FILES and size is not None
                }
            return {name: (size, 0) for name, size in self._sizes.items()}
        folder = Path(self._root, self._key)
        with (
            explain_os_errors(f"{folder}: cannot be read", "Fetch the scene again."),
            os.scandir(folder) as entries,
        ):
            found = {entry.name: entry.stat() for entry in entries if entry.name in FILES}
        return {name: (found[name].st_size, found[name].st_mtime_ns) for name in sorted(found)}

    def read(self, name: str) -> bytes:
        """Return a metadata file, whole.

        Raises:
            StorageError: If it cannot be read.
            SchemaError: If it is too large for a metadata file.
        """
        where = f"{self._key}/{name}"
        if not is_remote(self._root):
            return read_text_file(Path(self._root, where), where=where)
        size, _ = self.stamps()[name]
        require_text_size(size, where=where)
        return RemoteObject(joined(str(self._root), where)).read(0, size)

    def video(self, name: str) -> Path | MemberFile:
        """Return a video: its path, or an open file that the caller closes.

        Raises:
            StorageError: If it cannot be read.
        """
        if not is_remote(self._root):
            return Path(self._root, self._key, name)
        size, _ = self.stamps()[name]
        return RangedFile(
            RemoteObject(joined(str(self._root), f"{self._key}/{name}")).read, size=size
        )


def stamp_of(files: Mapping[str, tuple[int, int]]) -> str:
    """Return a digest of a scene's files that changes when one of them does."""
    return hashlib.sha256(repr(sorted(files.items())).encode()).hexdigest()[:32]


def describe_scene(
    root: str | Path,
    key: str,
    *,
    valid_depth: ValidDepth = "skip",
    conventions: Conventions | None = None,
    folder: SceneFolder | None = None,
    videos: Collection[str] | None = None,
) -> Scene:
    """Return the index row of a finished scene.

    What no sample needs, or only some fields, becomes a remark of the row: poses that are not
    understood (the rig is then assumed rectified), videos that cannot be opened, odd texts.

    Args:
        root: The folder that holds ``train`` and ``eval``, or its URL.
        key: The scene's path below it.
        valid_depth: "sample" decodes the first, middle and last depth picture of each camera, for
            the share of pixels that have a depth.
        conventions: Where quantities stand and how they are read; what they do not state is found.
        folder: Its folder, where that is listed already.
        videos: Names of the videos to open; None is all. The row then holds for these alone.

    Raises:
        IncompleteScene: If the scene has no video at all.
        StorageError: If files that every sample needs are missing, unreadable or contradict each
            other or the conventions, or `SchemaError` or `MediaError` if one of them is not
            understood. All problems of all files are in one message.
    """
    folder = folder or SceneFolder(root, key)
    files = folder.stamps()
    document = None
    if TRAINING_JSON in files:
        document = parse_training(folder.read(TRAINING_JSON), where=f"{key}/{TRAINING_JSON}")
    names = _videos_of(document)
    require_finished(key, files, videos=names)
    problems: list[StereoGenBenchError] = []
    remarks: list[Remark] = []
    rig, labels, shape = None, SceneLabels(), None
    facts, tables, unread = _all_probed(folder, key, files, names, opened=videos)
    try:
        where = f"{key}/{BASELINE_JSON}"
        shape = _shape_of(folder, key, files, conventions)
        text, size_px = folder.read(BASELINE_JSON), _source_size_px(facts, document)
        rig, labels, odd = parse_rig(text, where=where, shape=shape, size_px=size_px)
        family = parse_scene_key(key).family
        remarks += (*odd, *require_unit(rig, family=family, where=where))
    except StereoGenBenchError as error:
        problems.append(error)
    marked, odd = SceneLabels(), (Remark("marker", f"{key}: has no {COMPLETE_JSON}"),)
    if COMPLETE_JSON in files:
        marked, odd = parse_complete(folder.read(COMPLETE_JSON), where=f"{key}/{COMPLETE_JSON}")
    remarks += odd
    texts: dict[str, bytes] = {name: folder.read(name) for name in DESCRIPTIONS if name in files}
    caption, odd = caption_of(texts, key=key)
    remarks += odd
    try:
        frames = _common_frames(key, facts, remarks)
        _require_one_size(key, facts)
        if rig is not None:
            first = next(iter(facts.values()))
            size_px = first.width_px, first.height_px
            rig = sized_as_videos(
                key, rig, size_px, document=document, remarks=remarks, shape=shape
            )
            _require_kinds(key, rig, facts)
    except StereoGenBenchError as error:
        problems.append(error)
    if rig is None or problems:
        raise _all_of(key, problems)
    if unread:
        remarks.append(Remark("videos", "; ".join(unread.values())))
    poses, pose_form = _poses(folder, key, files, rig, frames=frames, remarks=remarks, shape=shape)
    depths = _of_each_camera({name: fact for name, fact in facts.items() if name in _DEPTHS})
    stated = _depth_in_metadata(folder, key, files)
    encodings = _depth_encodings(key, depths, stated=stated, remarks=remarks, shape=shape)
    ratio = None if valid_depth == "skip" else _valid_ratio(folder, key, frames)
    scene = Scene(
        id=parse_scene_key(key),
        labels=merged_labels(labels, marked),
        caption=caption,
        rig=rig,
        frames=frames,
        frame_rate_hz=next(iter(facts.values())).frame_rate_hz,
        lateral_m=assumed_places_m(rig) if poses is None else _places_m(poses),
        rig_residual_px=(
            0.0 if poses is None else rectification_residual_px(poses, recorded_intrinsics(rig))
        ),
        depth_unit_m=tuple(math.nan if each is None else each.known_unit_m for each in encodings),
        depth_offset_m=tuple(0.0 if each is None else each.offset_m for each in encodings),
        depth_unit_source=tuple(_source_of(each) for each in encodings),
        depth_codec=tuple(depth_coding(facts) for _, facts in depths),
        depth_pixel_format=tuple(facts.pixel_format for _, facts in depths),
        valid_depth_ratio=ratio,
        key_frames=_common_key_frames(facts, frames=frames),
        remarks=as_kept(remarks),
        pose_form=pose_form,
        conventions=None if shape is None else shape.text(),
        members={
            name: Member(f"{key}/{name}", 0, size)
            for name, (size, _) in files.items()
            if name not in unread
        },
        seek_tables=packed_tables(tables),
    )
    return scene if document is None else _of_training(scene, document)


def _source_size_px(
    facts: Mapping[str, StreamFacts], document: TrainingDocument | None
) -> tuple[int, int] | None:
    """Return the size of the pictures that ``baseline.json`` is of, by all else."""
    if document is not None:
        return document.source_size_px
    return next(((each.width_px, each.height_px) for each in facts.values()), None)


def as_kept(remarks: list[Remark]) -> tuple[Remark, ...]:
    """Return remarks as a row keeps them: shortened, and without secrets."""
    return tuple(
        Remark(each.about, shortened(text_without_secrets(each.text), _LONGEST_REMARK))
        for each in remarks
    )


def _shape_of(
    folder: SceneFolder, key: str, files: Mapping[str, object], conventions: Conventions | None
) -> Shape | None:
    """Return what conventions state about a scene's files."""
    if conventions is None:
        return None

    def keys() -> set[str]:
        return {
            f"{name}: {place}"
            for name in (BASELINE_JSON, TRAJECTORY_JSON) if name in files
            for place in keys_of(parse_object(folder.read(name), where=f"{key}/{name}"))
        }  # fmt: skip

    return conventions.shape_of(keys, where=key)


def _of_training(scene: Scene, document: TrainingDocument) -> Scene:
    """Return the row of a scene of training shards, which must be what its document says."""
    key = scene.id.key
    derived = replace(derived_scene(scene, document), depth_codec=scene.depth_codec)
    for what, found, said in (
        ("key", key, document.key),
        ("key frames", scene.key_frames, document.key_frames),
    ):
        if found != said:
            raise StorageError(
                f"{key}: {TRAINING_JSON} tells {what} {brief(said)}, and the scene has "
                f"{brief(found)}. A file is of another scene: fetch the scene again."
            )
    return derived


def _all_of(key: str, problems: list[StereoGenBenchError]) -> StereoGenBenchError:
    """Return one error for all problems of a scene's files."""
    if len(problems) == 1:
        return problems[0]
    listed = "\n  ".join(str(problem) for problem in problems)
    return StorageError(f"{key}: {len(problems)} of its files cannot be used:\n  {listed}")


def _all_probed(
    folder: SceneFolder,
    key: str,
    files: Mapping[str, object],
    videos: tuple[str, ...],
    *,
    opened: Collection[str] | None,
) -> tuple[dict[str, StreamFacts], dict[str, SeekTable], dict[str, str]]:
    """Return what videos are, where their packets lie, and why others cannot be opened.

    A scene without the videos of one camera still has the pairs of the others.
    """
    facts, tables, unread = {}, {}, {}
    for name in videos:
        held = held_name(files, name)
        if held not in files:
            unread[name] = missing_video(key, name)
            continue
        if opened is not None and name not in opened:
            continue
        try:
            facts[name], table = _probed(folder, key, held)
        except MediaError as error:
            unread[held] = str(error)
            continue
        if table is not None:
            tables[held] = table
    return facts, tables, unread


def missing_video(key: str, name: str) -> str:
    """Return what is remarked about a video that a scene lacks."""
    return f"{key}/{name}: is missing, and the scene is marked as complete"


def _poses(  # noqa: PLR0913 - what poses are judged by
    folder: SceneFolder,
    key: str,
    files: Mapping[str, object],
    rig: Rig,
    *,
    frames: int,
    remarks: list[Remark],
    shape: Shape | None,
) -> tuple[CameraPoses | None, str | None]:
    """Return the poses that fit the rig and the names of their readings, or neither.

    Raises:
        SchemaError: If conventions state how poses are read, and they do not fit the rig.
    """
    where = f"{key}/{TRAJECTORY_JSON}"
    found: Understood | None = None
    try:
        found, reason = _read_poses(folder, files, rig, shape=shape, where=where)
    except SidesError as error:
        remarks.append(Remark("left", str(error)))
        reason = str(error)
    if found is not None and found.poses.frame_count < frames:
        reason = (
            f"{where}: has poses of {found.poses.frame_count} frames, and the videos have {frames}."
        )
        found = None
    if found is None:
        if not assumed_places_m(rig):
            raise StorageError(
                f"{reason} Without poses the rig is assumed to be a straight line of cameras, and "
                f"the baselines in {BASELINE_JSON} do not add up to one: correct either file."
            )
        remarks.append(Remark("poses", reason))
        return None, None
    if found.poses.frame_count > frames and not any(each.about == "frames" for each in remarks):
        told = (
            f"{where}: has poses of {found.poses.frame_count} frames, and the videos have {frames}"
        )
        remarks.append(Remark("frames", f"{told}. The first {frames} are used"))
    if found.other_pair:
        left, right = rig.primary_pair
        told = f"{found.other_pair}, and {BASELINE_JSON} cameras {left} and {right}, which count"
        remarks.append(Remark("pair", told))
    if len(found.names) > 1:
        listed = ", ".join(name.partition(" @ ")[0] for name in found.names)
        remarks.append(
            Remark(
                "world",
                f"{where}: several readings of its poses fit the rig: {listed}; `stereogenbench "
                f"doctor` tells by depth which is right",
            )
        )
    return found.poses, found.form


def _read_poses(
    folder: SceneFolder,
    files: Mapping[str, object],
    rig: Rig,
    *,
    shape: Shape | None,
    where: str,
) -> tuple[Understood | None, str]:
    """Return poses that fit the rig, or why there are none.

    Raises:
        SidesError: If they fit but for the side of the primary pair's left camera.
        SchemaError: If conventions state how poses are read, and they do not fit the rig.
    """
    named = None if shape is None else shape.poses
    if named is not None and named.form == UNKNOWN:
        return (
            None,
            f"{where}: is not read: the conventions call the form of its poses {UNKNOWN!r}.",
        )
    if TRAJECTORY_JSON not in files:
        return None, f"{where}: is missing."
    try:
        text = folder.read(TRAJECTORY_JSON)
        return understood_poses(text, rig, where=where, named=named), ""
    except SidesError:
        raise
    except SchemaError as error:
        if named is not None:
            raise
        return None, str(error)


def as_agreed(scene: Scene, agreed: Mapping[str, tuple[str, ...]]) -> Scene:
    """Return a scene whose poses are read as the scenes of its dataset agree (`agreed_forms`)."""
    if scene.pose_form is None:
        return scene
    names = scene.pose_form.split("|")
    left = [name for name in agreed.get(shape_of(scene.pose_form), names) if name in names]
    if left == names:
        return scene
    others = tuple(each for each in scene.remarks if each.about != "world")
    if left:
        more = scene.remarks if len(left) > 1 else others
        return replace(scene, pose_form="|".join(left), remarks=more)
    reason = (
        f"{scene.id.key}/{TRAJECTORY_JSON}: fits the rig only as {names[0]}, and the files of "
        f"other scenes with the same keys do not. Is it another scene's?"
    )
    return replace(
        scene,
        pose_form=None,
        lateral_m=assumed_places_m(scene.rig),
        rig_residual_px=0.0,
        remarks=(*others, Remark("poses", reason)),
    )


def _places_m(poses: CameraPoses) -> tuple[float, ...]:
    return tuple(map(float, lateral_offsets_m(poses)))


def assumed_places_m(rig: Rig) -> tuple[float, ...]:
    """Return the distance of each camera to the right of camera 0 by the baselines alone.

    The cameras are assumed to stand on a line; () where the baselines are not those of a line.
    """
    of_pair = dict(zip(CAMERA_PAIRS, rig.baselines_cm, strict=True))
    first, last = max(of_pair, key=lambda pair: of_pair[pair])
    along_cm = [
        of_pair.get((first, camera), of_pair.get((camera, first), 0.0))
        for camera in range(CAMERA_COUNT)
    ]
    for (a, b), baseline_cm in of_pair.items():
        allowed_cm = _DEVIATION_CM + _DEVIATION_SHARE * along_cm[last]
        if abs(abs(along_cm[b] - along_cm[a]) - baseline_cm) > allowed_cm:
            return ()
    left, right = rig.primary_pair
    sign = 1 if along_cm[right] > along_cm[left] else -1
    return tuple(sign * (place_cm - along_cm[0]) / 100 for place_cm in along_cm)


def _videos_of(document: TrainingDocument | None) -> tuple[str, ...]:
    """Return the names of the videos that a scene must have: all, unless it was derived."""
    if document is None:
        return VIDEO_FILES
    return tuple(
        name for name in VIDEO_FILES if PACKED_DEPTH_NAMES.get(name, name) in document.files
    )


def _of_each_camera(depths: Mapping[str, StreamFacts]) -> list[tuple[str, StreamFacts]]:
    """Return name and facts of each camera's depth; a camera without depth has another's."""
    names = [depth_name(camera) for camera in range(CAMERA_COUNT)]
    some = next(iter(depths.items()), (names[0], _NO_DEPTH))
    return [(name, depths[name]) if name in depths else some for name in names]


def held_name(files: Mapping[str, object], name: str) -> str:
    """Return the name under which a folder holds a released file: depth may be packed."""
    return name if name in files else PACKED_DEPTH_NAMES.get(name, name)


def _probed(folder: SceneFolder, key: str, name: str) -> tuple[StreamFacts, SeekTable | None]:
    """Return what a video is, and where its packets lie."""
    video, where = folder.video(name), f"{key}/{name}"
    try:
        is_later: Literal["later", "needed"] = "later" if name.endswith(".mp4") else "needed"
        facts = probe(video, name=where, pixel_format=is_later)
        if is_later == "later" and facts.is_colour is None:
            facts = probe(video, name=where)
        is_near = isinstance(video, Path)
        return facts, read_seek_table(video, name=where, reads="all" if is_near else "little")
    finally:
        if isinstance(video, MemberFile):
            video.close()


def unfinished(key: str) -> IncompleteScene:
    """Return the error of a scene without its completion mark, in a tree that has such marks."""
    return IncompleteScene(f"{key}: has no {COMPLETE_JSON}, so it was never finished")


def require_finished(
    key: str, files: Mapping[str, object], *, videos: tuple[str, ...] = VIDEO_FILES
) -> None:
    """Refuse a scene of which the listing of its files shows that it cannot be used.

    Raises:
        IncompleteScene: If it has no video at all.
        StorageError: If it has no ``baseline.json``.
    """
    if not files:
        raise IncompleteScene(f"{key}: the folder is empty")
    if not any(held_name(files, name) in files for name in videos):
        raise IncompleteScene(f"{key}: has metadata only, and none of its {len(videos)} videos")
    if BASELINE_JSON not in files:
        raise StorageError(
            f"{key}: has no {BASELINE_JSON} (it has {', '.join(files)}). Fetch what is missing."
        )


def caption_of(texts: Mapping[str, bytes], *, key: str) -> tuple[str, tuple[Remark, ...]]:
    """Return a scene's caption from its files: the detailed one, else the short one, else ""."""
    remarks: tuple[Remark, ...] = ()
    if DESCRIPTION_JSON in texts:
        where = f"{key}/{DESCRIPTION_JSON}"
        description, remarks = parse_description(texts[DESCRIPTION_JSON], where=where)
        written = description.detailed_caption or description.short_caption
        if written:
            return written, remarks
    if DESCRIPTION_TXT in texts:
        where = f"{key}/{DESCRIPTION_TXT}"
        try:
            written = parse_text(texts[DESCRIPTION_TXT], where=where).strip()
        except SchemaError as error:
            return "", (*remarks, Remark("caption", str(error)))
        if len(written) > MOST_LETTERS:
            odd = f"{where}: may have {MOST_LETTERS:,} letters, this one has {len(written):,}"
            return "", (*remarks, Remark("caption", odd))
        return written, remarks
    return "", remarks


def merged_labels(labels: SceneLabels, marked: SceneLabels) -> SceneLabels:
    """Return the labels of baseline.json; those it lacks come from the completion mark."""
    values = {each.name: getattr(labels, each.name) for each in fields(SceneLabels)}
    lacking = [name for name, value in values.items() if value is None]
    return SceneLabels(**(values | {name: getattr(marked, name) for name in lacking}))


def _common_key_frames(facts: Mapping[str, StreamFacts], *, frames: int) -> tuple[int, ...]:
    """Return the frames at which all videos of pictures have a key frame."""
    listed = [set(fact.key_frames) for name, fact in facts.items() if name.endswith(".mp4")]
    common = set(range(frames)).intersection(*listed) if listed else set()
    return tuple(sorted(common | {0}))


def _common_frames(key: str, facts: Mapping[str, StreamFacts], remarks: list[Remark]) -> int:
    """Return how many frames all videos have."""
    if not facts:
        raise MediaError(f"{key}: none of its videos can be opened. Fetch the scene again.")
    counts = {name: fact.frames for name, fact in facts.items()}
    common = Counter(counts.values()).most_common(1)[0][0]
    odd = [f"{name} has {count}" for name, count in counts.items() if count != common]
    told = (
        f"{key}: its videos must have one number of frames: {len(counts) - len(odd)} have "
        f"{common}, but {', '.join(odd)}"
    )
    if any(abs(count - common) > MOST_EXTRA_FRAMES for count in counts.values()):
        raise StorageError(f"{told}. Fetch those again.")
    frames = min(counts.values())
    if odd:
        remarks.append(Remark("frames", f"{told}. The first {frames} of all are used"))
    return frames


def _require_one_size(key: str, facts: Mapping[str, StreamFacts]) -> None:
    sizes = {name: f"{fact.width_px}x{fact.height_px}" for name, fact in facts.items()}
    common = Counter(sizes.values()).most_common(1)[0][0]
    odd = [f"{name} has {size}" for name, size in sizes.items() if size != common]
    if odd:
        raise StorageError(
            f"{key}: its files must have one picture size: {len(sizes) - len(odd)} have {common} "
            f"pixels, but {', '.join(odd)}. Fetch those again."
        )


def sized_as_videos(
    key: str,
    rig: Rig,
    size_px: tuple[int, int],
    *,
    document: TrainingDocument | None,
    remarks: list[Remark],
    shape: Shape | None,
) -> Rig:
    """Return the rig for pictures of the videos' size, which counts whatever baseline.json says.

    A principal point, in pixels of the recorded image, moves with the size.
    """
    width_px, height_px = size_px
    if document is not None and (width_px, height_px) != document.size_px:
        raise StorageError(
            f"{key}: {TRAINING_JSON} is for pictures of {document.size_px[0]}x"
            f"{document.size_px[1]} pixels, and all videos have {width_px}x{height_px} pixels. "
            f"Fetch the scene again."
        )
    recorded_px = (width_px, height_px) if document is None else document.source_size_px
    known_px = rig.image_width_px, rig.image_height_px
    if rig.image_size_source == "recorded" and known_px != recorded_px:
        if shape is not None and not {"image_width", "image_height"}.isdisjoint(shape.numbers):
            raise StorageError(
                f"{key}: by the conventions pictures have {known_px[0]}x{known_px[1]} pixels, and "
                f"all videos have {recorded_px[0]}x{recorded_px[1]}. Correct [image_width] and "
                f"[image_height], or leave them out: the videos' size counts."
            )
        remarks.append(
            Remark(
                "size",
                f"{key}: {BASELINE_JSON} is for pictures of {known_px[0]}x{known_px[1]} pixels, "
                f"and all videos have {recorded_px[0]}x{recorded_px[1]}, which counts",
            )
        )
    point_px = rig.principal_point_px
    if point_px is not None and known_px != recorded_px:
        scales = [recorded / known for recorded, known in zip(recorded_px, known_px, strict=True)]
        if rig.image_size_source == "default":  # in pixels of the videos, then
            scales = [1.0, 1.0]
        point_px = (point_px[0] * scales[0], point_px[1] * scales[1])
        if all(abs(at - side / 2) <= 1 for at, side in zip(point_px, recorded_px, strict=True)):
            point_px = None
    height_mm = rig.sensor_height_mm
    if height_mm == rig.sensor_width_mm * known_px[1] / known_px[0]:
        # Recorded pixels are square, and Unreal renders square pixels at any size.
        height_mm = rig.sensor_width_mm * recorded_px[1] / recorded_px[0]
    aspect = rig.sensor_width_mm / height_mm * recorded_px[1] / recorded_px[0]
    if abs(aspect - 1) > _SQUARE:
        remarks.append(
            Remark(
                "pixels",
                f"{key}: a sensor of {rig.sensor_width_mm:.6g} x {height_mm:.6g} mm and pictures "
                f"of {recorded_px[0]}x{recorded_px[1]} pixels have pixels that are not square "
                f"({aspect:.4g} times as wide as high)",
            )
        )
    return replace(
        rig,
        principal_point_px=point_px,
        sensor_height_mm=height_mm,
        image_width_px=width_px,
        image_height_px=height_px,
        recorded_size_px=None if document is None else document.source_size_px,
    )


def _require_kinds(key: str, rig: Rig, facts: Mapping[str, StreamFacts]) -> None:
    """Refuse views without colours, and depth videos that hold colours.

    Lossy depth passes: a user's own `DepthEncoding` may accept it.
    """
    for name, fact in facts.items():
        where = f"{key}/{name}"
        require_pixel_aspect(fact.pixel_aspect, rig, name=where)
        if name.endswith("_rgb.mp4") and not fact.is_colour:
            stored = fact.pixel_format or "grey"
            raise MediaError(f"{where}: is stored by codec {fact.codec} as {stored}{NO_COLOUR}")
        if name.endswith("_depth.mkv"):
            require_depth_stream(
                codec=depth_coding(fact),
                pixel_format=fact.pixel_format,
                encoding=ANY_DEPTH,
                name=where,
            )
    depths = {name: fact for name, fact in facts.items() if name.endswith("_depth.mkv")}
    grey = sum(not fact.is_colour for fact in depths.values())
    for name, fact in depths.items():
        if fact.is_colour and (grey or "matroska" not in fact.container):
            raise MediaError(
                f"{key}/{name}: holds colours (codec {fact.codec}, {fact.pixel_format}, container "
                f"{fact.container}), and depth is one number a pixel, as in {grey} other depth "
                f"videos of the scene. Another video stands under this name: fetch it again."
            )


def _depth_in_metadata(
    folder: SceneFolder, key: str, files: Mapping[str, object]
) -> list[Statement]:
    """Return what the scene's JSON files say of its depth, most say nothing."""
    found: list[Statement] = []
    for name in (BASELINE_JSON, TRAJECTORY_JSON, COMPLETE_JSON):
        text = folder.read(name) if name in files else b""
        if b"depth" in text.lower():
            with suppress(SchemaError):
                document = parse_object(text, where=name)
                found += stated_in_json(document, name=f"{key}/{name}")
    return found


def _depth_encodings(
    key: str,
    depths: Sequence[tuple[str, StreamFacts]],
    *,
    stated: Sequence[Statement],
    remarks: list[Remark],
    shape: Shape | None,
) -> list[DepthEncoding | None]:
    """Return what files state of each camera's depth, None where that is not understood.

    Such a scene can still be used, for its colours or with the user's own unit.

    Raises:
        MediaError: If conventions state another unit than a tag.
    """
    found: list[DepthEncoding | None] = []
    problems: list[str] = []
    for name, facts in depths:
        try:
            found.append(resolve_encoding(facts, name=f"{key}/{name}", stated=stated))
        except MediaError as error:
            found.append(None)
            problems.append(str(error))
    depth = None if shape is None else shape.depth
    if depth is not None and depth.encoding.unit_m is not None:
        known_m = depth.instead_of_tag_m or depth.encoding.unit_m
        for (name, _), each in zip(depths, found, strict=True):
            if each is None or each.source not in ("tag", "metadata"):
                continue
            if not math.isclose(each.known_unit_m, known_m):
                raise MediaError(
                    f"{key}/{name}: its tag states {each.known_unit_m:g} m in a stored unit of "
                    f"depth, and the conventions expect {known_m:g} m. Correct unit_m in [depth]; "
                    f"or, if the tag is known to be wrong, add "
                    f"instead_of_tag_m = {each.known_unit_m:g}."
                )
            offset_m = depth.encoding.offset_m
            if depth.instead_of_tag_m is None and not math.isclose(
                each.offset_m, offset_m, abs_tol=_LEAST_OFFSET_M
            ):
                raise MediaError(
                    f"{key}/{name}: states a range that begins at {each.offset_m:g} m, and by the "
                    f"conventions the stored number 0 is {offset_m:g} m. Correct offset_m in "
                    f"[depth]; or, if the range is known to be wrong, add "
                    f"instead_of_tag_m = {each.known_unit_m:g}."
                )
        return [depth.encoding] * len(found)
    if problems:
        others = len(problems) - 1
        more = f" ({counted(others, 'other video')} likewise.)" if others else ""
        remarks.append(Remark("depth", problems[0] + more))
    return found


def _source_of(encoding: DepthEncoding | None) -> DepthUnitSource:
    if encoding is None or encoding.source == "user":
        return "unreadable"
    return encoding.source


def _valid_ratio(folder: SceneFolder, key: str, frames: int) -> float:
    shares = []
    encoding = ANY_DEPTH
    files = folder.stamps()
    for name in (held_name(files, depth_name(camera)) for camera in range(CAMERA_COUNT)):
        if name not in files:
            continue
        with open_depth(folder.video(name), name=f"{key}/{name}", frames=frames) as reader:
            for frame in sorted({0, frames // 2, frames - 1}):
                units = read_depth_units(reader, frame, encoding=encoding)
                known = measured(units, encoding=encoding, pixel_format=reader.facts.pixel_format)
                shares.append(float(np.mean(known)))
    return float(np.mean(shares)) if shares else 0.0


def derived_scene(scene: Scene, document: TrainingDocument) -> Scene:
    """Return the row of a scene of training shards, from its released row or its own.

    The rig keeps what ``baseline.json`` records, and knows the size of the derived pictures. The
    places of the files are not changed.
    """
    names = [*document.files]
    is_packed = not set(names).isdisjoint(PACKED_DEPTH_NAMES.values())
    return replace(
        scene,
        rig=replace(
            scene.rig,
            image_width_px=document.size_px[0],
            image_height_px=document.size_px[1],
            recorded_size_px=document.source_size_px,
        ),
        depth_codec=(CODEC_NAME,) * CAMERA_COUNT if is_packed else scene.depth_codec,
        depth_pixel_format=tuple(map(grey_format, scene.depth_pixel_format))
        if is_packed
        else scene.depth_pixel_format,
        key_frames=document.key_frames,
        training=document.facts,
    )


def metadata_differences(scene: Scene, texts: Mapping[str, bytes]) -> list[Difference]:
    """Return where a scene's metadata files differ from its row of an index.

    Compared are path, split, family, map, rig, baselines, labels, caption, number of frames, the
    cameras' places and the rig's residual; not what is known from the videos alone.

    Args:
        scene: The row.
        texts: File name to bytes; missing files are not compared.
    """
    found = [*_differing_place(scene)]
    for names, values in (
        ((BASELINE_JSON,), _recorded_rig),
        ((TRAINING_JSON,), _recorded_derivation),
        ((TRAJECTORY_JSON,), _recorded_poses),
        ((), _recorded_caption),
    ):
        if all(name in texts for name in names):
            try:
                found += [
                    (name, _differs(what, now, indexed))
                    for name, what, now, indexed in values(scene, texts)
                    if not _same(now, indexed, within=_ROUNDING.get(what, 0.0))
                ]
            except SchemaError as error:
                message = str(error).removeprefix(f"{scene.id.key}/")
                name, _, reason = message.partition(": ")
                found.append((name, reason.rstrip(".")))
    return list(dict.fromkeys(found))


def _differs(what: str, found: object, indexed: object) -> str:
    return f"tells {what} {brief(found)}, and by the index it is {brief(indexed)}"


def _differing_place(scene: Scene) -> Iterator[Difference]:
    try:
        place = parse_scene_key(scene.id.key)
    except SchemaError as error:
        yield "", str(error).rstrip(".")
        return
    for name in ("split", "subset", "family", "map_name"):
        found, indexed = getattr(place, name), getattr(scene.id, name)
        is_known = found is not None or scene.id.split == "train"
        if is_known and found != indexed:
            told = f"its path tells {name} {brief(found)}"
            yield "", f"{told}, and by the index it is {brief(indexed)}"


def _recorded_rig(scene: Scene, texts: Mapping[str, bytes]) -> Iterator[_Compared]:
    key, shape = scene.id.key, _stated_of(scene)
    recorded = scene.rig
    if recorded.recorded_size_px is not None:
        width_px, height_px = recorded.recorded_size_px
        recorded = replace(
            recorded, image_width_px=width_px, image_height_px=height_px, recorded_size_px=None
        )
    text, where, size_px = texts[BASELINE_JSON], f"{key}/{BASELINE_JSON}", _size_px(recorded)
    rig, labels, _ = parse_rig(text, where=where, shape=shape, size_px=size_px)
    is_resized = _size_px(rig) != _size_px(recorded)
    if is_resized and (rig.image_size_source == "default" or scene.remark("size")):
        rig = sized_as_videos(key, rig, size_px, document=None, remarks=[], shape=None)
    for each in fields(Rig):
        yield BASELINE_JSON, each.name, getattr(rig, each.name), getattr(recorded, each.name)
    if COMPLETE_JSON in texts:
        marked, _ = parse_complete(texts[COMPLETE_JSON], where=f"{key}/{COMPLETE_JSON}")
        merged = merged_labels(labels, marked)
        for each in fields(SceneLabels):
            now, indexed = getattr(merged, each.name), getattr(scene.labels, each.name)
            is_marked = getattr(labels, each.name) is None and now is not None
            yield COMPLETE_JSON if is_marked else BASELINE_JSON, each.name, now, indexed


def _stated_of(scene: Scene) -> Shape | None:
    """Return what conventions state about a scene's files, by its row."""
    return None if scene.conventions is None else shape_of_text(scene.conventions)


def _size_px(rig: Rig) -> tuple[int, int]:
    return rig.image_width_px, rig.image_height_px


def _recorded_derivation(scene: Scene, texts: Mapping[str, bytes]) -> Iterator[_Compared]:
    where = f"{scene.id.key}/{TRAINING_JSON}"
    document = parse_training(texts[TRAINING_JSON], where=where)
    values: dict[str, tuple[object, object]] = {
        "the key": (document.key, scene.id.key),
        "the picture size": (document.size_px, _size_px(scene.rig)),
        "the recorded size": (document.source_size_px, scene.rig.recorded_size_px),
        "the key frames": (document.key_frames, scene.key_frames),
    }
    for each in fields(TrainingFacts):
        of_index = getattr(scene.training, each.name, None)
        values[each.name] = getattr(document.facts, each.name), of_index
    for name, file in document.files.items():
        member = scene.members.get(name)
        if member is not None:
            crc32 = file.crc32 if member.crc32 is None else member.crc32
            values[name] = (file.size, file.crc32), (member.size, crc32)
    for what, (now, indexed) in values.items():
        yield TRAINING_JSON, what, now, indexed


def _recorded_poses(scene: Scene, texts: Mapping[str, bytes]) -> Iterator[_Compared]:
    if scene.remark("poses"):
        return
    text, where, shape = (
        texts[TRAJECTORY_JSON],
        f"{scene.id.key}/{TRAJECTORY_JSON}",
        _stated_of(scene),
    )
    poses = poses_as(text, scene.pose_form, where=where)
    if shape is not None and shape.poses is not None:
        poses = understood_poses(text, scene.rig, where=where, named=shape.poses).poses
    is_longer = poses.frame_count > scene.frames
    if poses.frame_count != scene.frames and not (is_longer and scene.remark("frames")):
        yield TRAJECTORY_JSON, "frames", poses.frame_count, scene.frames
        return
    yield TRAJECTORY_JSON, "lateral_m", _places_m(poses), scene.lateral_m
    residual_px = rectification_residual_px(poses, recorded_intrinsics(scene.rig))
    yield TRAJECTORY_JSON, "rig_residual_px", residual_px, scene.rig_residual_px


def _recorded_caption(scene: Scene, texts: Mapping[str, bytes]) -> Iterator[_Compared]:
    caption, _ = caption_of(texts, key=scene.id.key)
    for name in [name for name in DESCRIPTIONS if name in texts][:1]:
        yield name, "the caption", caption, scene.caption


def _same(found: Any, indexed: Any, *, within: float = 0.0) -> bool:
    """Return whether two values are equal; numbers may differ by rounding, and nan equals nan."""
    if isinstance(found, tuple) and isinstance(indexed, tuple):
        return len(found) == len(indexed) and all(
            _same(one, other, within=within) for one, other in zip(found, indexed, strict=True)
        )
    if isinstance(found, float) and isinstance(indexed, float):
        is_close = math.isclose(found, indexed, rel_tol=max(within, 1e-9), abs_tol=within)
        return is_close or (math.isnan(found) and math.isnan(indexed))
    return bool(found == indexed)
