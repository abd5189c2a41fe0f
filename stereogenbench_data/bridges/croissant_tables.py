"""Tables that a descriptor's record sets are read from: scenes, pairs, shards, descriptions.

mlcroissant reads no JSON inside a tar, so what the scenes' JSON files say is written once as
Parquet, from the index. The same index gives the same bytes.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from stereogenbench_data.errors import DescriptorError, cure_of
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import CAMERA_PAIRS, baseline_bin
from stereogenbench_data.sources.files import open_atomic, write_atomic

SCENES: Final = "scenes.parquet"
PAIRS: Final = "pairs.parquet"
SHARDS: Final = "shards.parquet"
SHARD_LIST: Final = "shards.txt"
MOST_SHARD_FILES: Final = 3000
"""Beyond so many shards a descriptor names them in a list, with their checksums in a table."""


@dataclass(frozen=True, slots=True)
class WrittenTable:
    """A table on disk.

    Attributes:
        name: Its file name.
        size: Its bytes.
        sha256: Their checksum, in hex.
    """

    name: str
    size: int
    sha256: str


def write_tables(index: SceneIndex, folder: Path) -> list[WrittenTable]:
    """Write the tables of an index into a folder.

    Args:
        index: The scenes; ``shards.parquet`` is written if they lie in shards, and ``shards.txt``
            if these are too many for a descriptor.
        folder: Where to write; made if it is not there.

    Raises:
        DescriptorError: If the folder cannot be written.
    """
    tables = {SCENES: scenes_table(index), PAIRS: pairs_table(index)}
    if index.shards:
        tables[SHARDS] = shards_table(index)
    names = [*tables]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, table in tables.items():
            with open_atomic(folder / name) as file:
                pq.write_table(table, file, compression="zstd")
        if len(index.shards) > MOST_SHARD_FILES:
            listed = "".join(f"{path}\n" for path in sorted(index.shards))
            write_atomic(folder / SHARD_LIST, listed.encode())
            names.append(SHARD_LIST)
    except OSError as error:
        raise DescriptorError(
            f"{folder}: tables cannot be written ({error.strerror or error}). "
            + cure_of(error, "Name another file.")
        ) from error
    return [_written(folder / name) for name in names]


def scenes_table(index: SceneIndex) -> pa.Table:
    """Return one row a scene: what it is, its camera, its 15 baselines, its descriptions."""
    keys = index.column("key")
    baselines_cm = index.column("baselines_cm")
    columns: dict[str, pa.Array] = {
        "scene_id": pa.array(keys, pa.string()),
        "split": pa.array(index.column("split"), pa.string()),
        "eval_subset": pa.array(index.column("subset"), pa.string()),
        "family": pa.array(index.column("family"), pa.string()),
        "map": pa.array(index.column("map_name"), pa.string()),
        "scene_label": pa.array(index.column("scene_label"), pa.string()),
        "character": pa.array(index.column("character"), pa.string()),
        "animation": pa.array(index.column("animation"), pa.string()),
        "frames": pa.array(index.column("frames"), pa.int64()),
        "frame_rate_hz": pa.array(index.column("frame_rate_hz"), pa.float64()),
        "image_width_px": pa.array(index.column("image_width_px"), pa.int64()),
        "image_height_px": pa.array(index.column("image_height_px"), pa.int64()),
        "focal_mm": pa.array(index.column("focal_mm"), pa.float64()),
        "sensor_width_mm": pa.array(index.column("sensor_width_mm"), pa.float64()),
        "sensor_height_mm": pa.array(index.column("sensor_height_mm"), pa.float64()),
        "primary_left": pa.array(index.column("primary_left"), pa.int64()),
        "primary_right": pa.array(index.column("primary_right"), pa.int64()),
        "pairwise_baselines_cm": pa.array(baselines_cm.tolist(), pa.list_(pa.float64())),
        "depth_unit_m": pa.array(index.column("depth_unit_m").tolist(), pa.list_(pa.float64())),
        "description": pa.array(index.column("caption"), pa.string()),
    }
    if index.shards:
        columns["shard"] = pa.array([_shard_of(index, row) for row in range(len(index))])
    return pa.table(columns)


def pairs_table(index: SceneIndex) -> pa.Table:
    """Return one row a camera pair, 15 a scene, in the order of `CAMERA_PAIRS`."""
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
    """Return one row a shard: its path, size and checksum, and how much it holds."""
    paths = sorted(index.shards)
    scenes = dict.fromkeys(paths, 0)
    for row in range(len(index)):
        scenes[_shard_of(index, row)] += 1
    return pa.table(
        {
            "shard": paths,
            "size_bytes": [index.shards[path].size for path in paths],
            "sha256": [index.shards[path].sha256 for path in paths],
            "scenes": [scenes[path] for path in paths],
            "members": [index.shards[path].members for path in paths],
        }
    )


def _shard_of(index: SceneIndex, row: int) -> str:
    return next(iter(index.scene(row).members.values())).path


def _written(path: Path) -> WrittenTable:
    content = path.read_bytes()
    return WrittenTable(path.name, len(content), hashlib.sha256(content).hexdigest())
