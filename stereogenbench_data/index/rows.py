"""A scene as one row of the index: the table of columns, and the conversion both ways.

`Scene` and its parts say what the values mean.
"""

import base64
from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any, Final

import pyarrow as pa

from stereogenbench_data.schema.records import (
    Member,
    Remark,
    Rig,
    Scene,
    SceneId,
    SceneLabels,
    TrainingFacts,
)
from stereogenbench_data.schema.release import CAMERA_COUNT, CAMERA_PAIRS

_MEMBER: Final = pa.struct(
    [
        pa.field("name", pa.string(), nullable=False),
        pa.field("path", pa.string(), nullable=False),
        pa.field("offset", pa.int64(), nullable=False),
        pa.field("size", pa.int64(), nullable=False),
        pa.field("crc32", pa.uint32()),
    ]
)
_REMARK: Final = pa.struct(
    [pa.field("about", pa.string(), nullable=False), pa.field("text", pa.string(), nullable=False)]
)


def _list(kind: pa.DataType, count: int = -1) -> pa.DataType:
    return pa.list_(pa.field("item", kind, nullable=False), count)


_TEXT: Final = pa.string()
_INTEGER: Final = pa.int64()
_NUMBER: Final = pa.float64()
_TEXTS: Final = _list(_TEXT, CAMERA_COUNT)
_NUMBERS: Final = _list(_NUMBER, CAMERA_COUNT)

_REQUIRED: Final = False
_NULLABLE: Final = True
_COLUMNS: Final[dict[str, tuple[pa.DataType, bool, tuple[str | int, ...]]]] = {
    "key": (_TEXT, _REQUIRED, ("id", "key")),
    "split": (_TEXT, _REQUIRED, ("id", "split")),
    "subset": (_TEXT, _NULLABLE, ("id", "subset")),
    "family": (_TEXT, _REQUIRED, ("id", "family")),
    "map_name": (_TEXT, _REQUIRED, ("id", "map_name")),
    "scene_label": (_TEXT, _NULLABLE, ("labels", "scene_label")),
    "scene_index": (_INTEGER, _NULLABLE, ("labels", "scene_index")),
    "label_map_name": (_TEXT, _NULLABLE, ("labels", "map_name")),
    "map_path": (_TEXT, _NULLABLE, ("labels", "map_path")),
    "character": (_TEXT, _NULLABLE, ("labels", "character")),
    "animation": (_TEXT, _NULLABLE, ("labels", "animation")),
    "aperture_fstop": (_NUMBER, _NULLABLE, ("labels", "aperture_fstop")),
    "caption": (_TEXT, _REQUIRED, ("caption",)),
    "focal_mm": (_NUMBER, _REQUIRED, ("rig", "focal_mm")),
    "sensor_width_mm": (_NUMBER, _REQUIRED, ("rig", "sensor_width_mm")),
    "sensor_height_mm": (_NUMBER, _REQUIRED, ("rig", "sensor_height_mm")),
    "image_width_px": (_INTEGER, _REQUIRED, ("rig", "image_width_px")),
    "image_height_px": (_INTEGER, _REQUIRED, ("rig", "image_height_px")),
    "image_size_source": (_TEXT, _REQUIRED, ("rig", "image_size_source")),
    "principal_x_px": (_NUMBER, _NULLABLE, ("rig", "principal_point_px", 0)),
    "principal_y_px": (_NUMBER, _NULLABLE, ("rig", "principal_point_px", 1)),
    "baselines_cm": (_list(_NUMBER, len(CAMERA_PAIRS)), _REQUIRED, ("rig", "baselines_cm")),
    "primary_left": (_INTEGER, _REQUIRED, ("rig", "primary_pair", 0)),
    "primary_right": (_INTEGER, _REQUIRED, ("rig", "primary_pair", 1)),
    "frames": (_INTEGER, _REQUIRED, ("frames",)),
    "frame_rate_hz": (_NUMBER, _REQUIRED, ("frame_rate_hz",)),
    "lateral_m": (_NUMBERS, _REQUIRED, ("lateral_m",)),
    "rig_residual_px": (_NUMBER, _REQUIRED, ("rig_residual_px",)),
    "depth_unit_m": (_NUMBERS, _REQUIRED, ("depth_unit_m",)),
    "depth_unit_source": (_TEXTS, _REQUIRED, ("depth_unit_source",)),
    "depth_codec": (_TEXTS, _REQUIRED, ("depth_codec",)),
    "depth_pixel_format": (_TEXTS, _REQUIRED, ("depth_pixel_format",)),
    "valid_depth_ratio": (_NUMBER, _NULLABLE, ("valid_depth_ratio",)),
    "key_frames": (_list(pa.int32()), _NULLABLE, ("key_frames",)),
    "recorded_width_px": (_INTEGER, _NULLABLE, ("rig", "recorded_size_px", 0)),
    "recorded_height_px": (_INTEGER, _NULLABLE, ("rig", "recorded_size_px", 1)),
    "training_source": (_TEXT, _NULLABLE, ("training", "source_digest")),
    "training_quality": (_TEXT, _NULLABLE, ("training", "quality")),
    "training_codec": (_TEXT, _NULLABLE, ("training", "codec")),
    "training_settings": (_TEXT, _NULLABLE, ("training", "settings")),
    "psnr_db": (_list(_NUMBER), _NULLABLE, ("training", "psnr_db")),
    "worst_psnr_db": (_list(_NUMBER), _NULLABLE, ("training", "worst_psnr_db")),
    "remarks": (_list(_REMARK), _NULLABLE, ("remarks",)),
    "pose_form": (_TEXT, _NULLABLE, ("pose_form",)),
    "depth_offset_m": (_list(_NUMBER), _NULLABLE, ("depth_offset_m",)),
    "conventions": (_TEXT, _NULLABLE, ("conventions",)),
    "members": (_list(_MEMBER), _REQUIRED, ("members",)),
}
"""Name of a column to its type, whether it may be null, and where `Scene` holds its value."""

TRAINING_COLUMNS: Final = tuple(
    name for name, (_, _, place) in _COLUMNS.items() if place[0] == "training"
)
"""Columns of what training shards say; all are null for released scenes."""

ADDED: Final = (
    "key_frames", "recorded_width_px", "recorded_height_px", *TRAINING_COLUMNS, "remarks",
    "pose_form", "depth_offset_m", "conventions",
)  # fmt: skip
"""Columns that indexes of earlier versions lack: null means what these knew."""

SCHEMA: Final = pa.schema(
    pa.field(name, kind, nullable=nullable)
    for wanted in (_REQUIRED, _NULLABLE)
    for name, (kind, nullable, _) in _COLUMNS.items()
    if nullable == wanted
)
"""The columns of an index; those at the end may be null."""


SEEK_COLUMN: Final = "seek_tables"
"""A further column of an index file, which is read only where it is needed: `Scene.seek_tables`. It
is no part of the digest, so that data indexed again are the same data."""


def row_of(scene: Scene) -> dict[str, Any]:
    """Return a scene as plain values, one for each column."""
    row: dict[str, Any] = {}
    for name, (_, _, place) in _COLUMNS.items():
        value: Any = scene
        for part in place:
            if value is not None:
                value = getattr(value, part) if isinstance(part, str) else value[part]
        row[name] = list(value) if isinstance(value, tuple) else value
    if scene.key_frames == (0,):
        row["key_frames"] = None
    if not any(scene.depth_offset_m):
        row["depth_offset_m"] = None
    row["remarks"] = [asdict(remark) for remark in scene.remarks] or None
    row["members"] = [
        {
            "name": name,
            "path": member.path,
            "offset": member.offset,
            "size": member.size,
            "crc32": member.crc32,
        }
        for name, member in sorted(scene.members.items())
    ]
    return row


_FIELDS: Final[dict[tuple[str, ...], dict[str, str]]] = {
    owner: {str(place[-1]): name for name, (_, _, place) in _COLUMNS.items() if place[:-1] == owner}
    for owner in [(), ("id",), ("labels",), ("rig",), ("training",)]
}
"""A part of `Scene` to its fields and their columns."""


def scene_of(row: Mapping[str, Any]) -> Scene:
    """Return the scene of a row's plain values."""

    def values(*owner: str) -> dict[str, Any]:
        found = ((field, row[name]) for field, name in _FIELDS[owner].items())
        return {field: tuple(value) if type(value) is list else value for field, value in found}

    def pair(first: str, second: str) -> Any:
        return None if row[first] is None else (row[first], row[second])

    scene = values()
    scene["key_frames"] = scene["key_frames"] or (0,)
    scene["depth_offset_m"] = scene["depth_offset_m"] or (0.0,) * CAMERA_COUNT
    scene["remarks"] = tuple(Remark(**each) for each in scene["remarks"] or ())
    scene["members"] = {
        item["name"]: Member(item["path"], item["offset"], item["size"], item["crc32"])
        for item in row["members"]
    }
    return Scene(
        id=SceneId(**values("id")),
        labels=SceneLabels(**values("labels")),
        rig=Rig(
            principal_point_px=pair("principal_x_px", "principal_y_px"),
            recorded_size_px=pair("recorded_width_px", "recorded_height_px"),
            primary_pair=(row["primary_left"], row["primary_right"]),
            **values("rig"),
        ),
        training=None if row["training_quality"] is None else TrainingFacts(**values("training")),
        **scene,
    )


def json_of(scene: Scene) -> dict[str, Any]:
    """Return a scene as JSON, with its seek tables."""
    return row_of(scene) | {SEEK_COLUMN: base64.b64encode(scene.seek_tables or b"").decode()}


def scene_of_json(row: Mapping[str, Any]) -> Scene:
    """Return the scene that `json_of` wrote."""
    tables = base64.b64decode(row[SEEK_COLUMN])
    return replace(scene_of(row), seek_tables=tables)
