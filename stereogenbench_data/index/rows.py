"""A scene as one row of the index: the columns, and the way there and back.

Every column is named after the record's field that it holds; `Scene` and its parts say what they
mean. A column of several numbers a scene is a list of fixed length.
"""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Final

import pyarrow as pa

from stereogenbench_data.schema.records import Member, Rig, Scene, SceneId, SceneLabels
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


def _numbers(count: int) -> pa.DataType:
    return pa.list_(pa.field("item", pa.float64(), nullable=False), count)


def _texts(count: int) -> pa.DataType:
    return pa.list_(pa.field("item", pa.string(), nullable=False), count)


_REQUIRED: Final = {
    "key": pa.string(),
    "split": pa.string(),
    "family": pa.string(),
    "map_name": pa.string(),
    "caption": pa.string(),
    "focal_mm": pa.float64(),
    "sensor_width_mm": pa.float64(),
    "sensor_height_mm": pa.float64(),
    "image_width_px": pa.int64(),
    "image_height_px": pa.int64(),
    "image_size_source": pa.string(),
    "baselines_cm": _numbers(len(CAMERA_PAIRS)),
    "primary_left": pa.int64(),
    "primary_right": pa.int64(),
    "frames": pa.int64(),
    "frame_rate_hz": pa.float64(),
    "lateral_m": _numbers(CAMERA_COUNT),
    "rig_residual_px": pa.float64(),
    "depth_unit_m": _numbers(CAMERA_COUNT),
    "depth_unit_source": _texts(CAMERA_COUNT),
    "depth_codec": _texts(CAMERA_COUNT),
    "depth_pixel_format": _texts(CAMERA_COUNT),
    "members": pa.list_(pa.field("item", _MEMBER, nullable=False)),
}
_OPTIONAL: Final = {
    "subset": pa.string(),
    "scene_label": pa.string(),
    "scene_index": pa.int64(),
    "label_map_name": pa.string(),
    "map_path": pa.string(),
    "character": pa.string(),
    "animation": pa.string(),
    "aperture_fstop": pa.float64(),
    "principal_x_px": pa.float64(),
    "principal_y_px": pa.float64(),
    "valid_depth_ratio": pa.float64(),
    "key_frames": pa.list_(pa.field("item", pa.int32(), nullable=False)),
}
ADDED: Final = ("key_frames",)
"""Columns that indexes of earlier versions lack: null means what these knew."""
SCHEMA: Final = pa.schema(
    [pa.field(name, kind, nullable=False) for name, kind in _REQUIRED.items()]
    + [pa.field(name, kind) for name, kind in _OPTIONAL.items()]
)
"""The columns of an index. Those at the end may be null."""


def row_of(scene: Scene) -> dict[str, Any]:
    """Return a scene as plain values, one for each column."""
    rig, labels = scene.rig, scene.labels
    point = rig.principal_point_px or (None, None)
    return {
        "key": scene.id.key,
        "split": scene.id.split,
        "subset": scene.id.subset,
        "family": scene.id.family,
        "map_name": scene.id.map_name,
        "scene_label": labels.scene_label,
        "scene_index": labels.scene_index,
        "label_map_name": labels.map_name,
        "map_path": labels.map_path,
        "character": labels.character,
        "animation": labels.animation,
        "aperture_fstop": labels.aperture_fstop,
        "caption": scene.caption,
        "focal_mm": rig.focal_mm,
        "sensor_width_mm": rig.sensor_width_mm,
        "sensor_height_mm": rig.sensor_height_mm,
        "image_width_px": rig.image_width_px,
        "image_height_px": rig.image_height_px,
        "image_size_source": rig.image_size_source,
        "principal_x_px": point[0],
        "principal_y_px": point[1],
        "baselines_cm": list(rig.baselines_cm),
        "primary_left": rig.primary_pair[0],
        "primary_right": rig.primary_pair[1],
        "frames": scene.frames,
        "frame_rate_hz": scene.frame_rate_hz,
        "lateral_m": list(scene.lateral_m),
        "rig_residual_px": scene.rig_residual_px,
        "depth_unit_m": list(scene.depth_unit_m),
        "depth_unit_source": list(scene.depth_unit_source),
        "depth_codec": list(scene.depth_codec),
        "depth_pixel_format": list(scene.depth_pixel_format),
        "valid_depth_ratio": scene.valid_depth_ratio,
        "key_frames": None if scene.key_frames == (0,) else list(scene.key_frames),
        "members": [
            {"name": name, **asdict(member)} for name, member in sorted(scene.members.items())
        ],
    }


def scene_of(row: Mapping[str, Any]) -> Scene:
    """Return the scene that a row's plain values mean."""
    x_px, y_px = row["principal_x_px"], row["principal_y_px"]
    return Scene(
        id=SceneId(row["key"], row["split"], row["subset"], row["family"], row["map_name"]),
        labels=SceneLabels(
            scene_label=row["scene_label"],
            scene_index=row["scene_index"],
            map_name=row["label_map_name"],
            map_path=row["map_path"],
            character=row["character"],
            animation=row["animation"],
            aperture_fstop=row["aperture_fstop"],
        ),
        caption=row["caption"],
        rig=Rig(
            focal_mm=row["focal_mm"],
            sensor_width_mm=row["sensor_width_mm"],
            sensor_height_mm=row["sensor_height_mm"],
            image_width_px=row["image_width_px"],
            image_height_px=row["image_height_px"],
            principal_point_px=None if x_px is None else (x_px, y_px),
            baselines_cm=tuple(row["baselines_cm"]),
            primary_pair=(row["primary_left"], row["primary_right"]),
            image_size_source=row["image_size_source"],
        ),
        frames=row["frames"],
        frame_rate_hz=row["frame_rate_hz"],
        lateral_m=tuple(row["lateral_m"]),
        rig_residual_px=row["rig_residual_px"],
        depth_unit_m=tuple(row["depth_unit_m"]),
        depth_unit_source=tuple(row["depth_unit_source"]),
        depth_codec=tuple(row["depth_codec"]),
        depth_pixel_format=tuple(row["depth_pixel_format"]),
        valid_depth_ratio=row["valid_depth_ratio"],
        key_frames=tuple(row["key_frames"] or (0,)),
        members={
            item["name"]: Member(item["path"], item["offset"], item["size"], item["crc32"])
            for item in row["members"]
        },
    )
