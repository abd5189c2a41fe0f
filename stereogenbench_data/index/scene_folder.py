"""One scene's folder: whether it is finished, whole and consistent, and its row of the index.

All that an index says of a scene comes from here: from its JSON files and the headers of its
videos. No picture is decoded unless the share of measured depth is asked for. The same files are
compared with a row that was made before by `metadata_differences`.
"""

import hashlib
import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Final, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.errors import MediaError, SchemaError, StorageError, describe_os_error
from stereogenbench_data.geometry.camera import rig_intrinsics
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.geometry.rig import (
    baseline_deviation_cm,
    lateral_offsets_m,
    rectification_residual_px,
)
from stereogenbench_data.media.container import StreamFacts
from stereogenbench_data.media.depth import (
    ANY_DEPTH,
    measured,
    open_depth,
    read_depth_units,
    require_depth_stream,
    resolve_encoding,
)
from stereogenbench_data.media.video import NO_COLOUR, probe, require_pixel_aspect
from stereogenbench_data.schema.document import parse_text, require_text_size
from stereogenbench_data.schema.parse import (
    parse_complete,
    parse_description,
    parse_rig,
    parse_scene_key,
)
from stereogenbench_data.schema.records import (
    DepthEncoding,
    DepthUnitSource,
    Member,
    Rig,
    Scene,
    SceneLabels,
    Trajectory,
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
    TRAJECTORY_JSON,
    VIDEO_FILES,
    depth_name,
    rgb_name,
)
from stereogenbench_data.schema.trajectory import parse_trajectory
from stereogenbench_data.sources.location import is_remote, joined
from stereogenbench_data.sources.members import read_text_file
from stereogenbench_data.sources.ranged_file import MemberFile, RangedFile
from stereogenbench_data.sources.remote import RemoteObject

ValidDepth = Literal["skip", "sample"]

_NEEDED: Final = (COMPLETE_JSON, BASELINE_JSON, TRAJECTORY_JSON, *VIDEO_FILES)
_DEVIATION_CM: Final = 0.1
_DEVIATION_SHARE: Final = 0.001
_LEAST_BESIDE: Final = 0.9
"""How much of a baseline must lie along camera 0's x axis: a rig turned by more than 25 degrees
against the line on which its cameras stand is no lateral rig."""
_FILES: Final = frozenset({*METADATA_FILES, *VIDEO_FILES, *PACKED_DEPTH_NAMES.values()})
"""Files of a release; others in a scene's folder are passed over."""

Difference = tuple[str, str]
"""The file's name, empty for the scene's own path, and what it tells against the index."""

_SAME_M: Final = 1e-6
_SAME_PX: Final = 1e-3
_SHOWN_LETTERS: Final = 60


class IncompleteScene(StorageError):
    """A scene that is not finished, or of which only the metadata were fetched."""


@runtime_checkable
class SceneFolder(Protocol):
    """A scene's folder, on this machine or behind a URL, as describing the scene reads it."""

    def stamps(self) -> dict[str, tuple[int, int]]:
        """Return the size in bytes and the time of change in ns (0 if unknown) of each file.

        Raises:
            StorageError: If the folder cannot be read.
        """
        ...

    def read(self, name: str) -> bytes:
        """Return a metadata file, whole.

        Raises:
            StorageError: If it cannot be read.
            SchemaError: If it is too large for a metadata file.
        """
        ...

    def video(self, name: str) -> Path | MemberFile:
        """Return a video: its path, or an open file that is the caller's to close.

        Raises:
            StorageError: If it cannot be read.
        """
        ...


def open_scene_folder(root: str | Path, key: str) -> SceneFolder:
    """Return the files of the scene with a key below a root, which may be a URL."""
    return RemoteSceneFolder(str(root), key) if is_remote(root) else LocalSceneFolder(root, key)


class LocalSceneFolder:
    """A scene's folder on this machine."""

    def __init__(self, root: str | Path, key: str) -> None:
        """Name the folder."""
        self._folder = Path(root, key)
        self._key = key

    def stamps(self) -> dict[str, tuple[int, int]]:
        """Return size and time of change of each file."""
        try:
            with os.scandir(self._folder) as entries:
                found = {entry.name: entry.stat() for entry in entries if entry.name in _FILES}
        except OSError as error:
            what = f"{self._folder}: cannot be read"
            raise StorageError(describe_os_error(what, error, "Fetch the scene again.")) from error
        return {name: (found[name].st_size, found[name].st_mtime_ns) for name in sorted(found)}

    def read(self, name: str) -> bytes:
        """Return a metadata file."""
        return read_text_file(self._folder / name, where=f"{self._key}/{name}")

    def video(self, name: str) -> Path:
        """Return a video's path."""
        return self._folder / name


class RemoteSceneFolder:
    """A scene's folder behind a URL, of which only what is asked for is fetched."""

    def __init__(self, root: str, key: str) -> None:
        """Name the folder; nothing is asked of it yet."""
        self._url = joined(root, key)
        self._key = key
        self._sizes: dict[str, int] = {}

    def stamps(self) -> dict[str, tuple[int, int]]:
        """Return the size of each file; the time of change is not known."""
        if not self._sizes:
            entries = RemoteObject(self._url).entries()
            self._sizes = {
                name: size
                for name, size in sorted(entries.items())
                if name in _FILES and size is not None
            }
        return {name: (size, 0) for name, size in self._sizes.items()}

    def read(self, name: str) -> bytes:
        """Fetch a metadata file."""
        size, _ = self.stamps()[name]
        require_text_size(size, where=f"{self._key}/{name}")
        return RemoteObject(joined(self._url, name)).read(0, size)

    def video(self, name: str) -> MemberFile:
        """Return a video that is fetched as it is read."""
        size, _ = self.stamps()[name]
        return RangedFile(RemoteObject(joined(self._url, name)).read, size=size)


def stamp_of(files: Mapping[str, tuple[int, int]]) -> str:
    """Return a short text that changes when one of a scene's files does."""
    return hashlib.sha256(repr(sorted(files.items())).encode()).hexdigest()[:32]


def describe_scene(root: str | Path, key: str, *, valid_depth: ValidDepth = "skip") -> Scene:
    """Return the index row of a finished scene.

    Args:
        root: The folder that holds ``train`` and ``eval``, or its URL.
        key: The scene's path below it.
        valid_depth: "sample" decodes the first, the middle and the last depth picture of each
            camera, to tell the share of pixels that have a depth.

    Raises:
        IncompleteScene: If the scene is not marked as complete or has no video at all.
        StorageError: If files are missing, unreadable or contradict each other.
        SchemaError: If a metadata file does not follow the format.
        MediaError: If a video is not what its header says.
    """
    folder = open_scene_folder(root, key)
    files = folder.stamps()
    _require_finished(key, files)
    rig, labels = parse_rig(folder.read(BASELINE_JSON), where=f"{key}/{BASELINE_JSON}")
    marked = parse_complete(folder.read(COMPLETE_JSON), where=f"{key}/{COMPLETE_JSON}")
    trajectory = parse_trajectory(folder.read(TRAJECTORY_JSON), where=f"{key}/{TRAJECTORY_JSON}")
    described: dict[str, bytes] = {
        name: folder.read(name) for name in (DESCRIPTION_JSON, DESCRIPTION_TXT) if name in files
    }
    caption = caption_of(described, key=key)
    depth_names = [depth_name(camera) for camera in range(CAMERA_COUNT)]
    facts = {name: _probed(folder, key, _held(files, name)) for name in VIDEO_FILES}
    frames = _common_frames(key, facts, trajectory)
    rig = _sized_as_videos(key, rig, facts)
    _require_kinds(key, rig, facts)
    poses = CameraPoses.from_trajectory(trajectory)
    _require_recorded_baselines(key, rig, poses)
    lateral_m = lateral_offsets_m(poses)
    residual_px = rectification_residual_px(poses, rig_intrinsics(rig))
    _require_lateral_rig(key, rig, lateral_m, residual_px=residual_px)
    units = [_depth_unit(facts[name], name=f"{key}/{name}") for name in depth_names]
    ratio = None if valid_depth == "skip" else _valid_ratio(folder, key, frames)
    return Scene(
        id=parse_scene_key(key),
        labels=merged_labels(labels, marked),
        caption=caption,
        rig=rig,
        frames=frames,
        frame_rate_hz=facts[rgb_name(0)].frame_rate_hz,
        lateral_m=tuple(map(float, lateral_m)),
        rig_residual_px=residual_px,
        depth_unit_m=tuple(unit_m for unit_m, _ in units),
        depth_unit_source=tuple(source for _, source in units),
        depth_codec=tuple(facts[name].codec for name in depth_names),
        depth_pixel_format=tuple(facts[name].pixel_format for name in depth_names),
        valid_depth_ratio=ratio,
        key_frames=_common_key_frames(facts, frames=frames),
        members={name: Member(f"{key}/{name}", 0, size) for name, (size, _) in files.items()},
    )


def _held(files: Mapping[str, object], name: str) -> str:
    """Return by what name a folder has one of the release's files: depth may be packed."""
    return name if name in files else PACKED_DEPTH_NAMES.get(name, name)


def _probed(folder: SceneFolder, key: str, name: str) -> StreamFacts:
    video, where = folder.video(name), f"{key}/{name}"
    try:
        if name.endswith(".mp4"):
            facts = probe(video, name=where, pixel_format="later")
            if facts.is_colour is not None:
                return facts
        return probe(video, name=where)
    finally:
        if isinstance(video, MemberFile):
            video.close()


def _require_finished(key: str, files: Mapping[str, object]) -> None:
    if not files:
        raise IncompleteScene(f"{key}: the folder is empty")
    if COMPLETE_JSON not in files:
        raise IncompleteScene(f"{key}: has no {COMPLETE_JSON}, so it was never finished")
    if not any(name in files for name in VIDEO_FILES):
        raise IncompleteScene(f"{key}: has metadata only, and none of its 12 videos")
    missing = [name for name in _NEEDED if _held(files, name) not in files]
    if missing:
        raise StorageError(
            f"{key}: is marked as complete and has no {', '.join(missing)} "
            f"(it has {', '.join(files)}). Fetch what is missing."
        )


def caption_of(texts: Mapping[str, bytes], *, key: str) -> str:
    """Return a scene's caption from its files: the detailed one, else the short one.

    Args:
        texts: File name to bytes, with the descriptions that there are.
        key: The scene's, for messages.

    Raises:
        SchemaError: If a description does not follow the format.
    """
    if DESCRIPTION_JSON in texts:
        description = parse_description(texts[DESCRIPTION_JSON], where=f"{key}/{DESCRIPTION_JSON}")
        written = description.detailed_caption or description.short_caption
        if written:
            return written
    if DESCRIPTION_TXT in texts:
        return parse_text(texts[DESCRIPTION_TXT], where=f"{key}/{DESCRIPTION_TXT}").strip()
    return ""


def merged_labels(labels: SceneLabels, marked: SceneLabels) -> SceneLabels:
    """Return the labels of baseline.json, and for those it lacks the ones of the mark."""
    missing = {
        name: getattr(marked, name)
        for name in SceneLabels.__slots__
        if getattr(labels, name) is None
    }
    return replace(labels, **missing)


def _common_frames(key: str, facts: Mapping[str, StreamFacts], trajectory: Trajectory) -> int:
    counts = {name: fact.frames for name, fact in facts.items()}
    counts[TRAJECTORY_JSON] = trajectory.frame_count
    common = Counter(counts.values()).most_common(1)[0][0]
    _require_equal(key, counts, common, what="number of frames", unit="frames")
    return common


def _common_key_frames(facts: Mapping[str, StreamFacts], *, frames: int) -> tuple[int, ...]:
    """Return the frames at which all videos of pictures have a key frame."""
    listed = [set(fact.key_frames) for name, fact in facts.items() if name.endswith(".mp4")]
    common = set(range(frames)).intersection(*listed) if listed else set()
    return tuple(sorted(common | {0}))


def _require_equal(
    key: str, found: Mapping[str, object], common: object, *, what: str, unit: str
) -> None:
    others = [f"{name} has {value}" for name, value in found.items() if value != common]
    if others:
        raise StorageError(
            f"{key}: its files must have one {what}: {len(found) - len(others)} have {common} "
            f"{unit}, but {', '.join(others)}. Fetch those again."
        )


def _sized_as_videos(key: str, rig: Rig, facts: Mapping[str, StreamFacts]) -> Rig:
    """Return the rig for pictures of the videos' size, where baseline.json records no size."""
    sizes = {name: f"{fact.width_px}x{fact.height_px}" for name, fact in facts.items()}
    common = Counter(sizes.values()).most_common(1)[0][0]
    _require_equal(key, sizes, common, what="picture size", unit="pixels")
    width_px, height_px = facts[rgb_name(0)].width_px, facts[rgb_name(0)].height_px
    if (width_px, height_px) == (rig.image_width_px, rig.image_height_px):
        return rig
    if rig.image_size_source == "recorded" or rig.principal_point_px is not None:
        raise StorageError(
            f"{key}: {BASELINE_JSON} is for pictures of {rig.image_width_px}x"
            f"{rig.image_height_px} pixels, and all videos have {common}. Correct image_width "
            f"and image_height, or fetch the videos again."
        )
    return replace(rig, image_width_px=width_px, image_height_px=height_px)


def _require_kinds(key: str, rig: Rig, facts: Mapping[str, StreamFacts]) -> None:
    """Refuse views that are no colours, and depth that is none or unlike the other cameras'.

    Depth that lost something is let pass: a user's own `DepthEncoding` may accept it.
    """
    for name, fact in facts.items():
        where = f"{key}/{name}"
        require_pixel_aspect(fact.pixel_aspect, rig, name=where)
        if name.endswith("_rgb.mp4") and not fact.is_colour:
            stored = fact.pixel_format or "grey"
            raise MediaError(f"{where}: is stored by codec {fact.codec} as {stored}{NO_COLOUR}")
        if name.endswith("_depth.mkv"):
            require_depth_stream(
                codec=fact.codec, pixel_format=fact.pixel_format, encoding=ANY_DEPTH, name=where
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


def _require_recorded_baselines(key: str, rig: Rig, poses: CameraPoses) -> None:
    if baseline_deviation_cm(poses, rig) <= _DEVIATION_CM:
        return
    for (camera_a, camera_b), recorded_cm in zip(CAMERA_PAIRS, rig.baselines_cm, strict=True):
        for frame in range(poses.frame_count):
            posed_cm = poses.baseline_m(frame, camera_a, camera_b) * 100
            allowed_cm = _DEVIATION_CM + _DEVIATION_SHARE * recorded_cm
            if not abs(posed_cm - recorded_cm) <= allowed_cm:
                raise StorageError(
                    f"{key}: {BASELINE_JSON} says that cameras {camera_a} and {camera_b} are "
                    f"{recorded_cm:.6g} cm apart, and by the poses of {TRAJECTORY_JSON} they are "
                    f"{posed_cm:.6g} cm apart in frame {frame} (allowed: {allowed_cm:.3g} cm). "
                    f"Is one of the files another scene's, or the unit wrong?"
                )


def _require_lateral_rig(
    key: str, rig: Rig, lateral_m: Float64[np.ndarray, "6"], *, residual_px: float
) -> None:
    """Refuse poses by which the cameras do not stand beside each other and look the same way."""
    for (camera_a, camera_b), recorded_cm in zip(CAMERA_PAIRS, rig.baselines_cm, strict=True):
        beside_cm = abs(float(lateral_m[camera_b] - lateral_m[camera_a])) * 100
        if not math.isfinite(residual_px) or beside_cm < _LEAST_BESIDE * recorded_cm:
            raise StorageError(
                f"{key}: by the poses of {TRAJECTORY_JSON}, cameras {camera_a} and {camera_b} are "
                f"{beside_cm:.6g} cm beside each other as camera 0 looks, and {BASELINE_JSON} says "
                f"that they are {recorded_cm:.6g} cm apart; or a camera looks away from what the "
                f"others see. Are the rotations transposed, in other axes, or in radians? Correct "
                f"rotation_representation or the poses."
            )


def _depth_unit(facts: StreamFacts, *, name: str) -> tuple[float, DepthUnitSource]:
    """Return metres in a stored unit and where that stands; nan where the tags contradict.

    Such a scene can be used all the same, for its colours, or with the user's own unit.
    """
    try:
        encoding = resolve_encoding(facts, name=name)
    except MediaError:
        return math.nan, "unreadable"
    return encoding.known_unit_m, "tag" if encoding.source == "tag" else "default"


def _valid_ratio(folder: SceneFolder, key: str, frames: int) -> float:
    shares = []
    encoding = DepthEncoding()
    files = folder.stamps()
    for name in (_held(files, depth_name(camera)) for camera in range(CAMERA_COUNT)):
        with open_depth(folder.video(name), name=f"{key}/{name}", frames=frames) as reader:
            for frame in sorted({0, frames // 2, frames - 1}):
                units = read_depth_units(reader, frame, encoding=encoding)
                known = measured(units, encoding=encoding, pixel_format=reader.facts.pixel_format)
                shares.append(float(np.mean(known)))
    return float(np.mean(shares))


def metadata_differences(scene: Scene, texts: Mapping[str, bytes]) -> list[Difference]:
    """Return where a scene's metadata files differ from its row of an index.

    Compared are path, split, family, map, rig, baselines, labels, caption, number of frames, the
    cameras' places and the rig's residual; not what the videos alone tell.

    Args:
        scene: The row.
        texts: File name to bytes; files that are not given are not compared.
    """
    found = [*_differing_place(scene)]
    for names, compare in (
        ((BASELINE_JSON,), _differing_rig),
        ((BASELINE_JSON, COMPLETE_JSON), _differing_labels),
        ((TRAJECTORY_JSON,), _differing_poses),
        ((), _differing_caption),
    ):
        if all(name in texts for name in names):
            try:
                found += compare(scene, texts)
            except SchemaError as error:
                message = str(error).removeprefix(f"{scene.id.key}/")
                name, _, reason = message.partition(": ")
                found.append((name, reason.rstrip(".")))
    return list(dict.fromkeys(found))


def _difference(name: str, what: str, found: object, indexed: object) -> Difference:
    return name, f"tells {what} {_brief(found)}, and by the index it is {_brief(indexed)}"


def _brief(value: object) -> str:
    text = repr(value)
    return text if len(text) <= _SHOWN_LETTERS else f"{text[:_SHOWN_LETTERS]}..."


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
            yield "", f"its path tells {name} {found!r}, and by the index it is {indexed!r}"


def _differing_rig(scene: Scene, texts: Mapping[str, bytes]) -> Iterator[Difference]:
    rig, _ = parse_rig(texts[BASELINE_JSON], where=f"{scene.id.key}/{BASELINE_JSON}")
    for each in fields(Rig):
        if each.name.startswith("image_") and rig.image_size_source == "default":
            continue
        found, indexed = getattr(rig, each.name), getattr(scene.rig, each.name)
        if not _same(found, indexed):
            yield _difference(BASELINE_JSON, each.name, found, indexed)


def _differing_labels(scene: Scene, texts: Mapping[str, bytes]) -> Iterator[Difference]:
    key = scene.id.key
    _, labels = parse_rig(texts[BASELINE_JSON], where=f"{key}/{BASELINE_JSON}")
    marked = parse_complete(texts[COMPLETE_JSON], where=f"{key}/{COMPLETE_JSON}")
    merged = merged_labels(labels, marked)
    for each in fields(SceneLabels):
        found, indexed = getattr(merged, each.name), getattr(scene.labels, each.name)
        if found != indexed:
            is_marked = getattr(labels, each.name) is None and found is not None
            yield _difference(
                COMPLETE_JSON if is_marked else BASELINE_JSON, each.name, found, indexed
            )


def _differing_poses(scene: Scene, texts: Mapping[str, bytes]) -> Iterator[Difference]:
    where = f"{scene.id.key}/{TRAJECTORY_JSON}"
    trajectory = parse_trajectory(texts[TRAJECTORY_JSON], where=where)
    if trajectory.frame_count != scene.frames:
        yield _difference(TRAJECTORY_JSON, "frames", trajectory.frame_count, scene.frames)
        return
    poses = CameraPoses.from_trajectory(trajectory)
    lateral_m = lateral_offsets_m(poses)
    if not np.allclose(lateral_m, scene.lateral_m, rtol=0, atol=_SAME_M):
        places_m = tuple(map(float, lateral_m))
        yield _difference(TRAJECTORY_JSON, "lateral_m", places_m, scene.lateral_m)
    residual_px = rectification_residual_px(poses, rig_intrinsics(scene.rig))
    if not math.isclose(residual_px, scene.rig_residual_px, rel_tol=_SAME_PX, abs_tol=_SAME_PX):
        yield _difference(TRAJECTORY_JSON, "rig_residual_px", residual_px, scene.rig_residual_px)


def _differing_caption(scene: Scene, texts: Mapping[str, bytes]) -> Iterator[Difference]:
    names = [name for name in (DESCRIPTION_JSON, DESCRIPTION_TXT) if name in texts]
    caption = caption_of(texts, key=scene.id.key)
    if names and caption != scene.caption:
        yield _difference(names[0], "the caption", caption, scene.caption)


def _same(found: Any, indexed: Any) -> bool:
    """Return whether two values are equal, numbers as far as a sum may round them."""
    if isinstance(found, tuple) and isinstance(indexed, tuple):
        return len(found) == len(indexed) and all(map(_same, found, indexed))
    if isinstance(found, float) and isinstance(indexed, float):
        return math.isclose(found, indexed, rel_tol=1e-9)
    return bool(found == indexed)
