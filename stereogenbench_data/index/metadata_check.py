"""A scene's metadata files held against its row of an index: what they say must be the same."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Any, Final

import numpy as np

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.geometry.camera import rig_intrinsics
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.geometry.rig import lateral_offsets_m, rectification_residual_px
from stereogenbench_data.index.scene_folder import caption_of, merged_labels
from stereogenbench_data.schema.parse import (
    parse_complete,
    parse_rig,
    parse_scene_key,
)
from stereogenbench_data.schema.records import Rig, Scene, SceneLabels
from stereogenbench_data.schema.release import (
    BASELINE_JSON,
    COMPLETE_JSON,
    DESCRIPTION_JSON,
    DESCRIPTION_TXT,
    TRAJECTORY_JSON,
)
from stereogenbench_data.schema.trajectory import parse_trajectory

Difference = tuple[str, str]
"""The file's name, empty for the scene's own path, and what it tells against the index."""

_SAME_M: Final = 1e-6
_SAME_PX: Final = 1e-3
_SHOWN_LETTERS: Final = 60


def metadata_differences(scene: Scene, texts: Mapping[str, bytes]) -> list[Difference]:
    """Return what a scene's metadata files tell otherwise than its row of an index.

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
                told = str(error).removeprefix(f"{scene.id.key}/")
                name, _, reason = told.partition(": ")
                found.append((name, reason.rstrip(".")))
    return list(dict.fromkeys(found))


def _told(name: str, what: str, found: object, indexed: object) -> Difference:
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
        is_told = found is not None or scene.id.split == "train"
        if is_told and found != indexed:
            yield "", f"its path tells {name} {found!r}, and by the index it is {indexed!r}"


def _differing_rig(scene: Scene, texts: Mapping[str, bytes]) -> Iterator[Difference]:
    rig, _ = parse_rig(texts[BASELINE_JSON], where=f"{scene.id.key}/{BASELINE_JSON}")
    for each in fields(Rig):
        if each.name.startswith("image_") and rig.image_size_source == "default":
            continue
        found, indexed = getattr(rig, each.name), getattr(scene.rig, each.name)
        if not _same(found, indexed):
            yield _told(BASELINE_JSON, each.name, found, indexed)


def _differing_labels(scene: Scene, texts: Mapping[str, bytes]) -> Iterator[Difference]:
    key = scene.id.key
    _, labels = parse_rig(texts[BASELINE_JSON], where=f"{key}/{BASELINE_JSON}")
    marked = parse_complete(texts[COMPLETE_JSON], where=f"{key}/{COMPLETE_JSON}")
    merged = merged_labels(labels, marked)
    for each in fields(SceneLabels):
        found, indexed = getattr(merged, each.name), getattr(scene.labels, each.name)
        if found != indexed:
            is_marked = getattr(labels, each.name) is None and found is not None
            yield _told(COMPLETE_JSON if is_marked else BASELINE_JSON, each.name, found, indexed)


def _differing_poses(scene: Scene, texts: Mapping[str, bytes]) -> Iterator[Difference]:
    where = f"{scene.id.key}/{TRAJECTORY_JSON}"
    trajectory = parse_trajectory(texts[TRAJECTORY_JSON], where=where)
    if trajectory.frame_count != scene.frames:
        yield _told(TRAJECTORY_JSON, "frames", trajectory.frame_count, scene.frames)
        return
    poses = CameraPoses.from_trajectory(trajectory)
    lateral_m = lateral_offsets_m(poses)
    if not np.allclose(lateral_m, scene.lateral_m, rtol=0, atol=_SAME_M):
        places_m = tuple(map(float, lateral_m))
        yield _told(TRAJECTORY_JSON, "lateral_m", places_m, scene.lateral_m)
    residual_px = rectification_residual_px(poses, rig_intrinsics(scene.rig))
    if not math.isclose(residual_px, scene.rig_residual_px, rel_tol=_SAME_PX, abs_tol=_SAME_PX):
        yield _told(TRAJECTORY_JSON, "rig_residual_px", residual_px, scene.rig_residual_px)


def _differing_caption(scene: Scene, texts: Mapping[str, bytes]) -> Iterator[Difference]:
    names = [name for name in (DESCRIPTION_JSON, DESCRIPTION_TXT) if name in texts]
    caption = caption_of(texts, key=scene.id.key)
    if names and caption != scene.caption:
        yield _told(names[0], "the caption", caption, scene.caption)


def _same(found: Any, indexed: Any) -> bool:
    """Return whether two values are equal, numbers as far as a sum may round them."""
    if isinstance(found, tuple) and isinstance(indexed, tuple):
        return len(found) == len(indexed) and all(map(_same, found, indexed))
    if isinstance(found, float) and isinstance(indexed, float):
        return math.isclose(found, indexed, rel_tol=1e-9)
    return bool(found == indexed)
