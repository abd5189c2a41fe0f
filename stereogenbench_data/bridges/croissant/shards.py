"""The tables beside the descriptor of shards: scenes, pairs, shards.

mlcroissant parses no JSON inside a tar, so what the shards' JSON files hold is written once as
Parquet, from the index. Where there are many shards, the record sets of files use only a few. The
same index gives the same bytes.
"""

import hashlib
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from stereogenbench_data.errors import DescriptorError, explain_os_errors
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import CAMERA_PAIRS, baseline_bin
from stereogenbench_data.sources.files import open_atomic, write_atomic

SHARD_LIST: Final = "shards.txt"
MOST_SHARD_FILES: Final = 3000
"""Above this number, shards are named in a list, with their checksums in a table."""
MOST_MEDIA_BYTES: Final = 1_000_000_000
"""Above this size of all shards, record sets of files use the smallest shard of each family."""

_TEXT, _WHOLE, _NUMBER = pa.string(), pa.int64(), pa.float64()
_SCENE_COLUMNS: Final = {
    "scene_id": ("key", _TEXT),
    "split": ("split", _TEXT),
    "eval_subset": ("subset", _TEXT),
    "family": ("family", _TEXT),
    "map": ("map_name", _TEXT),
    "scene_label": ("scene_label", _TEXT),
    "character": ("character", _TEXT),
    "animation": ("animation", _TEXT),
    "frames": ("frames", _WHOLE),
    "frame_rate_hz": ("frame_rate_hz", _NUMBER),
    "image_width_px": ("image_width_px", _WHOLE),
    "image_height_px": ("image_height_px", _WHOLE),
    "focal_mm": ("focal_mm", _NUMBER),
    "sensor_width_mm": ("sensor_width_mm", _NUMBER),
    "sensor_height_mm": ("sensor_height_mm", _NUMBER),
    "primary_left": ("primary_left", _WHOLE),
    "primary_right": ("primary_right", _WHOLE),
    "pairwise_baselines_cm": ("baselines_cm", pa.list_(_NUMBER)),
    "depth_unit_m": ("depth_unit_m", pa.list_(_NUMBER)),
    "description": ("caption", _TEXT),
}
"""Columns of the table of scenes: the index's column and the type."""


@dataclass(frozen=True, slots=True)
class WrittenTable:
    """A table on disk: its file name, its size in bytes and its checksum in hex."""

    name: str
    size: int
    sha256: str


def bound_shards(index: SceneIndex) -> list[str]:
    """Return the shards that record sets of files use: all, or the smallest of each family."""
    sizes = {path: index.shards[path].size for path in sorted(index.shards)}
    if sum(sizes.values()) <= MOST_MEDIA_BYTES:
        return [*sizes]
    smallest: dict[str, str] = {}
    for path in sorted(sizes, key=lambda path: sizes[path]):
        smallest.setdefault(path.rpartition("-")[0], path)
    return sorted(smallest.values())


def write_tables(index: SceneIndex, folder: Path) -> list[WrittenTable]:
    """Write the tables of shards into a folder.

    Args:
        index: The index of shards. If there are too many for a descriptor, their paths are
            written as ``shards.txt``.
        folder: Where to write; created if it does not exist.

    Raises:
        DescriptorError: If the folder cannot be written.
    """
    tables = {
        "scenes.parquet": scenes_table(index),
        "pairs.parquet": pairs_table(index),
        "shards.parquet": shards_table(index),
    }
    names = [*tables]
    cannot = f"{folder}: tables cannot be written"
    with explain_os_errors(cannot, "Choose another place with --out.", kind=DescriptorError):
        folder.mkdir(parents=True, exist_ok=True)
        for name, table in tables.items():
            with open_atomic(folder / name) as file:
                pq.write_table(table, file, compression="zstd")
        if len(index.shards) > MOST_SHARD_FILES:
            listed = "".join(f"{path}\n" for path in sorted(index.shards))
            write_atomic(folder / SHARD_LIST, listed.encode())
            names.append(SHARD_LIST)
    contents = {name: (folder / name).read_bytes() for name in names}
    return [
        WrittenTable(name, len(content), hashlib.sha256(content).hexdigest())
        for name, content in contents.items()
    ]


def scenes_table(index: SceneIndex) -> pa.Table:
    """Return one row per scene: identity, camera, 15 baselines, description, shard."""
    columns = {
        name: pa.array(index.column(source).tolist(), kind)
        for name, (source, kind) in _SCENE_COLUMNS.items()
    }
    return pa.table(columns | {"shard": pa.array(_shards_of(index))})


def pairs_table(index: SceneIndex) -> pa.Table:
    """Return one row per camera pair, 15 per scene, in the order of `CAMERA_PAIRS`."""
    scenes, count = len(index), len(CAMERA_PAIRS)
    left, right = np.array(CAMERA_PAIRS, dtype=np.int64).T
    baselines_cm = index.column("baselines_cm").reshape(-1)
    primary = np.stack([index.column("primary_left"), index.column("primary_right")], axis=-1)
    is_primary = (np.array(CAMERA_PAIRS)[None] == np.sort(primary, axis=-1)[:, None]).all(axis=-1)
    keys = np.repeat(index.column("key"), count)
    lefts, rights = np.tile(left, scenes), np.tile(right, scenes)
    return pa.table(
        {
            "pair_id": [f"{key}:{a}-{b}" for key, a, b in zip(keys, lefts, rights, strict=True)],
            "scene_id": pa.array(keys, pa.string()),
            "camera_left": lefts,
            "camera_right": rights,
            "baseline_cm": baselines_cm,
            "baseline_bin": [baseline_bin(float(each)) for each in baselines_cm],
            "is_adjacent": rights - lefts == 1,
            "is_primary": is_primary.reshape(-1),
        }
    )


def shards_table(index: SceneIndex) -> pa.Table:
    """Return one row per shard: path, size, checksum, and the number of scenes and members."""
    paths, scenes = sorted(index.shards), Counter(_shards_of(index))
    return pa.table(
        {
            "shard": paths,
            "size_bytes": [index.shards[path].size for path in paths],
            "sha256": [index.shards[path].sha256 for path in paths],
            "scenes": [scenes[path] for path in paths],
            "members": [index.shards[path].members for path in paths],
        }
    )


def _shards_of(index: SceneIndex) -> list[str]:
    """Return the shard of each scene."""
    scenes = (index.scene(row) for row in range(len(index)))
    return [next(iter(scene.members.values())).path for scene in scenes]
