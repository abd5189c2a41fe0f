"""A scene as one row of the index: the table of columns, and the conversion both ways.

`Scene` and its parts say what the values mean.
"""

import base64
import math
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
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
from stereogenbench_data.schema.training import MOST_PSNR_DB

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


@dataclass(frozen=True, slots=True)
class Column:
    """A column of the index.

    Attributes:
        kind: Its type; lists of any length are of numbers, one for each camera, but for key frames.
        place: Where `Scene` holds its value: fields, and the number of a part of a tuple.
        allowed: The least and the greatest number, or the pattern of texts; None for any.
        is_nullable: Whether its value may be unknown.
    """

    kind: pa.DataType
    place: str
    allowed: tuple[float, float] | str | None = None
    is_nullable: bool = False


_LARGEST: Final = sys.float_info.max
_ABOVE: Final = (sys.float_info.min, _LARGEST)
_FINITE: Final = (-_LARGEST, _LARGEST)
_SIDE: Final = (1, 2**16)
_CAMERA: Final = (0, CAMERA_COUNT - 1)
_DECIBELS: Final = (0, MOST_PSNR_DB)
_NAME: Final = r"^[^/\\\x00-\x1f]{1,255}$"
_UNIT_SOURCES: Final = "^(tag|metadata|default|conventions|unreadable)$"
_WORD: Final = r"^[A-Za-z0-9_.+-]{1,40}$"

COLUMNS: Final = {
    "key": Column(_TEXT, "id.key"),
    "split": Column(_TEXT, "id.split", "^(train|eval)$"),
    "subset": Column(_TEXT, "id.subset", "^(seen_map|unseen_map)$", is_nullable=True),
    "family": Column(_TEXT, "id.family", _NAME),
    "map_name": Column(_TEXT, "id.map_name", _NAME),
    "scene_label": Column(_TEXT, "labels.scene_label", is_nullable=True),
    "scene_index": Column(_INTEGER, "labels.scene_index", is_nullable=True),
    "label_map_name": Column(_TEXT, "labels.map_name", is_nullable=True),
    "map_path": Column(_TEXT, "labels.map_path", is_nullable=True),
    "character": Column(_TEXT, "labels.character", is_nullable=True),
    "animation": Column(_TEXT, "labels.animation", is_nullable=True),
    "aperture_fstop": Column(_NUMBER, "labels.aperture_fstop", is_nullable=True),
    "caption": Column(_TEXT, "caption"),
    "focal_mm": Column(_NUMBER, "rig.focal_mm", _ABOVE),
    "sensor_width_mm": Column(_NUMBER, "rig.sensor_width_mm", _ABOVE),
    "sensor_height_mm": Column(_NUMBER, "rig.sensor_height_mm", _ABOVE),
    "image_width_px": Column(_INTEGER, "rig.image_width_px", _SIDE),
    "image_height_px": Column(_INTEGER, "rig.image_height_px", _SIDE),
    "image_size_source": Column(_TEXT, "rig.image_size_source", "^(recorded|default)$"),
    "principal_x_px": Column(_NUMBER, "rig.principal_point_px.0", _FINITE, is_nullable=True),
    "principal_y_px": Column(_NUMBER, "rig.principal_point_px.1", _FINITE, is_nullable=True),
    "baselines_cm": Column(_list(_NUMBER, len(CAMERA_PAIRS)), "rig.baselines_cm", _ABOVE),
    "primary_left": Column(_INTEGER, "rig.primary_pair.0", _CAMERA),
    "primary_right": Column(_INTEGER, "rig.primary_pair.1", _CAMERA),
    "frames": Column(_INTEGER, "frames", (1, 2**17)),
    "frame_rate_hz": Column(_NUMBER, "frame_rate_hz", (0, _LARGEST)),
    "lateral_m": Column(_NUMBERS, "lateral_m", _FINITE),
    "rig_residual_px": Column(_NUMBER, "rig_residual_px", (0, math.inf)),
    "depth_unit_m": Column(_NUMBERS, "depth_unit_m", _ABOVE),
    "depth_unit_source": Column(_TEXTS, "depth_unit_source", _UNIT_SOURCES),
    "depth_codec": Column(_TEXTS, "depth_codec"),
    "depth_pixel_format": Column(_TEXTS, "depth_pixel_format"),
    "valid_depth_ratio": Column(_NUMBER, "valid_depth_ratio", (0, 1), is_nullable=True),
    "key_frames": Column(_list(pa.int32()), "key_frames", is_nullable=True),
    "recorded_width_px": Column(_INTEGER, "rig.recorded_size_px.0", _SIDE, is_nullable=True),
    "recorded_height_px": Column(_INTEGER, "rig.recorded_size_px.1", _SIDE, is_nullable=True),
    "training_source": Column(_TEXT, "training.source_digest", "^[0-9a-f]{64}$", is_nullable=True),
    "training_quality": Column(_TEXT, "training.quality", _WORD, is_nullable=True),
    "training_codec": Column(_TEXT, "training.codec", _WORD, is_nullable=True),
    "training_settings": Column(_TEXT, "training.settings", is_nullable=True),
    "psnr_db": Column(_list(_NUMBER), "training.psnr_db", _DECIBELS, is_nullable=True),
    "worst_psnr_db": Column(_list(_NUMBER), "training.worst_psnr_db", _DECIBELS, is_nullable=True),
    "remarks": Column(_list(_REMARK), "remarks", is_nullable=True),
    "pose_form": Column(_TEXT, "pose_form", is_nullable=True),
    "depth_offset_m": Column(_list(_NUMBER), "depth_offset_m", _FINITE, is_nullable=True),
    "conventions": Column(_TEXT, "conventions", is_nullable=True),
    "members": Column(_list(_MEMBER), "members"),
}
"""The columns by name. Nan is not allowed in numbers, but where a PSNR or a unit is not known."""

ADDED: Final = tuple(COLUMNS)[[*COLUMNS].index("key_frames") : -1]
"""Columns that indexes of earlier versions lack: null means what these knew."""

SCHEMA: Final = pa.schema(
    pa.field(name, column.kind, nullable=is_nullable)
    for is_nullable in (False, True)
    for name, column in COLUMNS.items()
    if column.is_nullable == is_nullable
)
"""The columns of an index; those at the end may be null."""


SEEK_COLUMN: Final = "seek_tables"
"""A further column of an index file, which is read only where it is needed: `Scene.seek_tables`. It
is no part of the digest, so that data indexed again are the same data."""


def row_of(scene: Scene) -> dict[str, Any]:
    """Return a scene as plain values, one for each column."""
    row: dict[str, Any] = {}
    for name, parts in _PARTS.items():
        value: Any = scene
        for part in parts:
            if value is not None:
                value = getattr(value, part) if type(part) is str else value[part]
        row[name] = list(value) if type(value) is tuple else value
    if scene.key_frames == (0,):
        row["key_frames"] = None
    if not any(scene.depth_offset_m):
        row["depth_offset_m"] = None
    row["remarks"] = [asdict(remark) for remark in scene.remarks] or None
    row["members"] = [
        {"name": name, "path": at.path, "offset": at.offset, "size": at.size, "crc32": at.crc32}
        for name, at in sorted(scene.members.items())
    ]
    return row


_PARTS: Final = {
    name: [int(part) if part.isdigit() else part for part in column.place.split(".")]
    for name, column in COLUMNS.items()
}
_FIELDS: Final[dict[str, dict[str, str]]] = {
    owner: {str(parts[-1]): name for name, parts in _PARTS.items() if parts[:-1] == owner.split()}
    for owner in ("", "id", "labels", "rig", "training")
}
"""A part of `Scene` to its fields and their columns."""


def scene_of(row: Mapping[str, Any]) -> Scene:
    """Return the scene of a row's plain values."""

    def values(owner: str = "") -> dict[str, Any]:
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
