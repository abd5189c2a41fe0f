"""One scene's folder: whether it is finished, whole and true to itself, and its index row.

All that an index says about a scene is found here, from its JSON files and the headers of its
videos; no picture is decoded, unless the share of measured depth is asked for.
"""

import hashlib
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final, Literal

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.errors import MediaError, StorageError
from stereogenbench_data.geometry.camera import rig_intrinsics
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.geometry.rig import (
    baseline_deviation_cm,
    lateral_offsets_m,
    rectification_residual_px,
)
from stereogenbench_data.index.scene_files import SceneFiles, files_of
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
from stereogenbench_data.schema.document import parse_text
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
    PACKED_DEPTH_NAMES,
    TRAJECTORY_JSON,
    VIDEO_FILES,
    depth_name,
    rgb_name,
)
from stereogenbench_data.schema.trajectory import parse_trajectory
from stereogenbench_data.sources.ranged_file import MemberFile

ValidDepth = Literal["skip", "sample"]

_NEEDED: Final = (COMPLETE_JSON, BASELINE_JSON, TRAJECTORY_JSON, *VIDEO_FILES)
_DEVIATION_CM: Final = 0.1
_DEVIATION_SHARE: Final = 0.001
_LEAST_BESIDE: Final = 0.9
"""How much of a baseline must lie along camera 0's x axis: a rig turned by more than 25 degrees
against the line on which its cameras stand is no lateral rig."""


class IncompleteScene(StorageError):
    """A scene that is not finished, or of which only the metadata were fetched."""


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
    folder = files_of(root, key)
    files = folder.stamps()
    _require_finished(key, files)
    rig, labels = parse_rig(folder.text(BASELINE_JSON), where=f"{key}/{BASELINE_JSON}")
    marked = parse_complete(folder.text(COMPLETE_JSON), where=f"{key}/{COMPLETE_JSON}")
    trajectory = parse_trajectory(folder.text(TRAJECTORY_JSON), where=f"{key}/{TRAJECTORY_JSON}")
    described: dict[str, bytes] = {
        name: folder.text(name) for name in (DESCRIPTION_JSON, DESCRIPTION_TXT) if name in files
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
        members={name: Member(f"{key}/{name}", 0, size) for name, (size, _) in files.items()},
    )


def _held(files: Mapping[str, object], name: str) -> str:
    """Return by what name a folder has one of the release's files: depth may be packed."""
    return name if name in files else PACKED_DEPTH_NAMES.get(name, name)


def _probed(folder: SceneFiles, key: str, name: str) -> StreamFacts:
    video, told = folder.video(name), f"{key}/{name}"
    try:
        if name.endswith(".mp4"):
            facts = probe(video, name=told, pixel_format="later")
            if facts.is_colour is not None:
                return facts
        return probe(video, name=told)
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
        told = f"{key}/{name}"
        require_pixel_aspect(fact.pixel_aspect, rig, name=told)
        if name.endswith("_rgb.mp4") and not fact.is_colour:
            stored = fact.pixel_format or "grey"
            raise MediaError(f"{told}: is stored by codec {fact.codec} as {stored}{NO_COLOUR}")
        if name.endswith("_depth.mkv"):
            require_depth_stream(
                codec=fact.codec, pixel_format=fact.pixel_format, encoding=ANY_DEPTH, name=told
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


def _valid_ratio(folder: SceneFiles, key: str, frames: int) -> float:
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
