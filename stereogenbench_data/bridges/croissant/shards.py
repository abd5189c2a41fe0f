"""The files and record sets of shards: tables for scenes and pairs, tars for videos and JSON files.

mlcroissant does not parse JSON inside a tar, follows only one reference from a record set, and
unpacks every tar that a record set uses. So the contents of the scenes' JSON files are written once
as Parquet, from the index; where there are many shards, the record sets of files use only a few.
The same index gives the same bytes.
"""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from stereogenbench_data.bridges.croissant.nodes import (
    ENCODINGS,
    PARQUET,
    TAR,
    TEXT,
    UNKNOWN_ENCODING,
    VIDEO_TEXTS,
    Node,
    column,
    enumerations,
    field,
    file_object,
    file_set,
    of_file,
    record_set,
    refers_to,
    suffixes_of,
    text_records,
    video_records,
)
from stereogenbench_data.errors import DescriptorError, describe_os_error
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import (
    BASELINE_JSON,
    CAMERA_COUNT,
    CAMERA_PAIRS,
    COMPLETE_JSON,
    TRAJECTORY_JSON,
    baseline_bin,
)
from stereogenbench_data.sources.files import open_atomic, write_atomic

SCENES: Final = "scenes.parquet"
PAIRS: Final = "pairs.parquet"
SHARDS: Final = "shards.parquet"
SHARD_LIST: Final = "shards.txt"
MOST_SHARD_FILES: Final = 3000
"""Above this number, shards are named in a list, with their checksums in a table."""
MOST_MEDIA_BYTES: Final = 1_000_000_000
"""Above this size of all shards, record sets of files use the smallest shard of each family."""

_KEY: Final = r"^(.+?)(?:\.cam_\d{{2}}_{kind}\.{suffix})?$"
"""The scene of a video in a shard. It does not change a key: a join applies the regex twice."""
_TABLES: Final = {
    SCENES: "One row a scene.",
    PAIRS: "One row a camera pair, 15 a scene.",
    SHARDS: "One row a shard, with its checksum.",
    SHARD_LIST: "The paths of all shards, one a line.",
}


_SCENE_COLUMNS: Final = (
    ("scene_id", pa.string(), "Path of the scene: split, subset, family, map, number."),
    ("split", pa.string(), "train or eval."),
    ("eval_subset", pa.string(), "seen_map or unseen_map; none in train."),
    ("family", pa.string(), "Family of baselines."),
    ("map", pa.string(), "Environment."),
    ("scene_label", pa.string(), "The scene's label in its own metadata."),
    ("character", pa.string(), "The avatar's mesh."),
    ("animation", pa.string(), "The avatar's animation."),
    ("frames", pa.int64(), "Frames of each video."),
    ("frame_rate_hz", pa.float64(), "Frames a second."),
    ("image_width_px", pa.int64(), "Width of all videos."),
    ("image_height_px", pa.int64(), "Height of all videos."),
    ("focal_mm", pa.float64(), "Focal length of all six cameras, in mm."),
    ("sensor_width_mm", pa.float64(), "Width of the sensor, in mm."),
    ("sensor_height_mm", pa.float64(), "Height of the sensor, in mm."),
    ("primary_left", pa.int64(), "Left camera of the primary pair."),
    ("primary_right", pa.int64(), "Right camera of the primary pair."),
    (
        "pairwise_baselines_cm", pa.list_(pa.float64()),
        "Baselines of the 15 pairs 0-1, 0-2 ... 4-5, in cm.",
    ),
    (
        "depth_unit_m", pa.list_(pa.float64()),
        "Metres in a stored unit of depth, for each camera.",
    ),
    ("description", pa.string(), "Description of the scene; empty where there is none."),
)  # fmt: skip
"""Columns of the table of scenes: name, type, meaning."""
_INDEX_COLUMNS: Final = {
    "scene_id": "key",
    "eval_subset": "subset",
    "map": "map_name",
    "pairwise_baselines_cm": "baselines_cm",
    "description": "caption",
}
"""Columns that the index has under another name."""
_KINDS: Final = {pa.string(): "sc:Text", pa.int64(): "sc:Integer", pa.float64(): "sc:Float"}
_LENGTHS: Final = {"pairwise_baselines_cm": len(CAMERA_PAIRS), "depth_unit_m": CAMERA_COUNT}


@dataclass(frozen=True, slots=True)
class WrittenTable:
    """A table on disk: its file name, its size in bytes and its checksum in hex."""

    name: str
    size: int
    sha256: str


def packed_nodes(
    index: SceneIndex, tables: Sequence[WrittenTable], *, data_url: str, tables_url: str
) -> tuple[list[Node], list[Node]]:
    """Return the files and the record sets of shards.

    Args:
        index: The index of the shards.
        tables: The tables that `write_tables` wrote.
        data_url: URL or relative path of the folder of shards.
        tables_url: URL or relative path of the folder of tables.
    """
    bound, suffixes = _bound_shards(index), suffixes_of(index)
    is_listed = len(index.shards) > MOST_SHARD_FILES
    files = [
        file_object(
            table.name,
            url=f"{tables_url}/{table.name}",
            encoding=TEXT if table.name == SHARD_LIST else PARQUET,
            sha256=table.sha256,
            size=table.size,
            about=_TABLES[table.name],
        )
        for table in tables
    ]
    files += [
        file_object(
            shard,
            url=f"{data_url}/{shard}",
            encoding=TAR,
            sha256=index.shards[shard].sha256,
            size=index.shards[shard].size,
        )
        for shard in (bound if is_listed else sorted(index.shards))
    ]
    files += _file_sets(bound, suffixes)
    if is_listed:
        files.append(_listed_shards())
    records = [
        *enumerations(index),
        _scenes(),
        _scene_categories(),
        _pairs(),
        _shards(),
        _descriptions(),
        *_media(suffixes),
    ]
    return files, records


def _bound_shards(index: SceneIndex) -> list[str]:
    """Return the shards that record sets of files use: all, or the smallest of each family."""
    paths = sorted(index.shards)
    if sum(index.shards[path].size for path in paths) <= MOST_MEDIA_BYTES:
        return paths
    smallest: dict[str, str] = {}
    for path in paths:
        kind = path.rpartition("-")[0]
        if kind not in smallest or index.shards[path].size < index.shards[smallest[kind]].size:
            smallest[kind] = path
    return sorted(smallest.values())


def _file_sets(shards: list[str], suffixes: dict[str, str]) -> list[Node]:
    kinds = {kind: ENCODINGS.get(suffix, UNKNOWN_ENCODING) for kind, suffix in suffixes.items()}
    sets: dict[str, tuple[str | list[str], str, str]] = {
        f"{kind}-files": (kinds[kind], f"**/*.cam_??_{kind}.{suffix}", VIDEO_TEXTS[kind])
        for kind, suffix in suffixes.items()
    }
    sets |= {
        "media-files": (list(kinds.values()), "**/*.cam_??_*.*", "All videos, by name."),
        "baseline-files": ("application/json", f"**/*.{BASELINE_JSON}", "Intrinsics, baselines."),
        "trajectory-files": ("application/json", f"**/*.{TRAJECTORY_JSON}", "Poses."),
        "scene_complete-files": ("application/json", f"**/*.{COMPLETE_JSON}", "Completion marks."),
    }
    return [
        file_set(name, within=shards, encoding=encoding, includes=includes, about=text)
        for name, (encoding, includes, text) in sets.items()
    ]


def _listed_shards() -> Node:
    return {
        "@type": "cr:FileSet",
        "@id": "shard-files",
        "name": "shard-files",
        "description": "All shards, by their list; checksums are in the table of shards.",
        "containedIn": {
            "fileObject": {"@id": SHARD_LIST},
            "transform": {"readLines": True},
        },
        "encodingFormat": TAR,
        "includes": "*.tar",
    }


def _scenes() -> Node:
    scalars, arrays = [], []
    for name, kind, about in _SCENE_COLUMNS:
        at, source = f"scenes/{name}", column(SCENES, name)
        if name in _LENGTHS:
            shape = {"isArray": True, "arrayShape": str(_LENGTHS[name])}
            arrays.append(field(at, _KINDS[kind.value_type], about, **shape, **source))
        else:
            scalars.append(field(at, _KINDS[kind], about, **source))
    return record_set(
        "scenes", "Every scene once.", [*scalars, *arrays], key={"@id": "scenes/scene_id"}
    )


def _scene_categories() -> Node:
    targets = {
        "split": "splits",
        "eval_subset": "eval_subsets",
        "family": "families",
        "map": "maps",
    }
    fields = _columns("scene_categories", SCENES, [("scene_id", "sc:Text", "Path of the scene.")])
    fields += [
        field(
            f"scene_categories/{name}", "sc:Text", f"One of {target}.",
            **column(SCENES, name), **refers_to(f"{target}/name"),
        )
        for name, target in targets.items()
    ]  # fmt: skip
    return record_set("scene_categories", "Which part every scene belongs to.", fields)


def _pairs() -> Node:
    fields = _columns("pairs", PAIRS, [
        ("pair_id", "sc:Text", "Scene and cameras."),
        ("scene_id", "sc:Text", "Path of the scene."),
        ("camera_left", "sc:Integer", "Number of the left camera."),
        ("camera_right", "sc:Integer", "Number of the right camera."),
        ("baseline_cm", "sc:Float", "Distance of the two cameras, in cm."),
        ("baseline_bin", "sc:Text", "Bin of the distance, in cm."),
        ("is_adjacent", "sc:Boolean", "Whether the cameras stand next to each other."),
        ("is_primary", "sc:Boolean", "Whether the scene records it as its primary pair."),
    ])  # fmt: skip
    fields[1] |= refers_to("scenes/scene_id")
    return record_set(
        "pairs", "Every stereo pair once: 15 a scene.", fields, key={"@id": "pairs/pair_id"}
    )


def _shards() -> Node:
    fields = _columns("shards", SHARDS, [
        ("shard", "sc:Text", "Path of the shard."),
        ("size_bytes", "sc:Integer", "Its size."),
        ("sha256", "sc:Text", "Its checksum, in hex."),
        ("scenes", "sc:Integer", "How many scenes it holds."),
        ("members", "sc:Integer", "How many files it holds."),
    ])  # fmt: skip
    return record_set("shards", "Every shard once.", fields, key={"@id": "shards/shard"})


def _descriptions() -> Node:
    text = field(
        "descriptions/text", "sc:Text", "The description; empty where there is none.",
        **column(SCENES, "description"),
    )  # fmt: skip
    keys = _columns("descriptions", SCENES, [("scene_id", "sc:Text", "Path of the scene.")])
    return record_set("descriptions", "The description of every scene.", [*keys, text])


def _columns(records: str, file: str, rows: Iterable[tuple[str, str, str]]) -> list[Node]:
    """Return fields of a record set that are columns of a table: name, type, meaning."""
    return [
        field(f"{records}/{name}", kind, about, **column(file, name)) for name, kind, about in rows
    ]


def _media(suffixes: dict[str, str]) -> list[Node]:
    """Return the record sets of files in shards."""
    names = record_set(
        "media_files", "Every video by name.", [
            field(
                "media_files/split", "sc:Text", "train or eval; may be filtered by.",
                **of_file("media-files", "fullpath", regex=r"^(train|eval)/.+\.cam_.+$"),
            ),
            field("media_files/file", "sc:Text", "Its name.", **of_file("media-files", "filename")),
        ],
    )  # fmt: skip
    videos = [
        video_records(kind, key=_KEY.format(kind=kind, suffix=suffix))
        for kind, suffix in suffixes.items()
    ]
    texts = text_records(scene_of=r"^(.+)\.{file}$")
    return [names, *videos, *texts]


def write_tables(index: SceneIndex, folder: Path) -> list[WrittenTable]:
    """Write the tables of an index into a folder.

    Args:
        index: The scenes. ``shards.parquet`` is written if they are in shards, and ``shards.txt``
            if there are too many shards for a descriptor.
        folder: Where to write; created if it does not exist.

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
            describe_os_error(
                f"{folder}: tables cannot be written", error, "Choose another place with --out."
            )
        ) from error
    return [_written(folder / name) for name in names]


def scenes_table(index: SceneIndex) -> pa.Table:
    """Return one row per scene: identity, camera, 15 baselines, description."""
    columns = {
        name: pa.array(index.column(_INDEX_COLUMNS.get(name, name)).tolist(), kind)
        for name, kind, _ in _SCENE_COLUMNS
    }
    if index.shards:
        columns["shard"] = pa.array([_shard_of(index, row) for row in range(len(index))])
    return pa.table(columns)


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
