"""The files and record sets of shards: tables for scenes and pairs, tars for videos and JSON files.

mlcroissant parses no JSON inside a tar, follows one reference from a record set, and unpacks every
tar that a record set touches. So scenes and pairs come from tables, and the record sets of files
are bound to a few shards where there are many.
"""

from collections.abc import Sequence
from typing import Final

from stereogenbench_data.bridges.croissant_enumerations import enumerations
from stereogenbench_data.bridges.croissant_media import (
    ENCODINGS,
    UNKNOWN_ENCODING,
    suffixes_of,
    text_records,
    video_records,
)
from stereogenbench_data.bridges.croissant_tables import (
    MOST_SHARD_FILES,
    PAIRS,
    SCENES,
    SHARD_LIST,
    SHARDS,
    WrittenTable,
)
from stereogenbench_data.bridges.croissant_terms import (
    PARQUET,
    TAR,
    TEXT,
    Node,
    column,
    field,
    file_object,
    file_set,
    of_file,
    record_set,
    refers_to,
)
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import BASELINE_JSON, COMPLETE_JSON, TRAJECTORY_JSON

MOST_MEDIA_BYTES: Final = 1_000_000_000
"""Beyond so many bytes of shards, record sets of files are bound to the smallest of each family."""

_KEY: Final = r"^(.+?)(?:\.cam_\d{{2}}_{kind}\.{suffix})?$"
"""The scene of a video in a shard. A key is left as it is: a join may apply the regex twice."""


def packed_nodes(
    index: SceneIndex, tables: Sequence[WrittenTable], *, data_url: str, tables_url: str
) -> tuple[list[Node], list[Node]]:
    """Return the files and the record sets of shards.

    Args:
        index: Of the shards.
        tables: The tables as written.
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


_TABLES: Final = {
    SCENES: "One row a scene.",
    PAIRS: "One row a camera pair, 15 a scene.",
    SHARDS: "One row a shard, with its checksum.",
    SHARD_LIST: "The paths of all shards, one a line.",
}


def _bound_shards(index: SceneIndex) -> list[str]:
    """Return the shards whose files are records: all, or the smallest of each family if large."""
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
        f"{kind}-files": (kinds[kind], f"**/*.cam_??_{kind}.{suffix}", _VIDEOS[kind])
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


_VIDEOS: Final = {"rgb": "RGB videos.", "depth": "Depth videos."}


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
    fields = [
        field(f"scenes/{name}", kind, text, **column(SCENES, name))
        for name, kind, text in (
            ("scene_id", "sc:Text", "Path of the scene: split, subset, family, map, number."),
            ("split", "sc:Text", "train or eval."),
            ("eval_subset", "sc:Text", "seen_map or unseen_map; none in train."),
            ("family", "sc:Text", "Family of baselines."),
            ("map", "sc:Text", "Environment."),
            ("scene_label", "sc:Text", "The scene's label in its own metadata."),
            ("character", "sc:Text", "The avatar's mesh."),
            ("animation", "sc:Text", "The avatar's animation."),
            ("frames", "sc:Integer", "Frames of each video."),
            ("frame_rate_hz", "sc:Float", "Frames a second."),
            ("image_width_px", "sc:Integer", "Width of all videos."),
            ("image_height_px", "sc:Integer", "Height of all videos."),
            ("focal_mm", "sc:Float", "Focal length of all six cameras, in mm."),
            ("sensor_width_mm", "sc:Float", "Width of the sensor, in mm."),
            ("sensor_height_mm", "sc:Float", "Height of the sensor, in mm."),
            ("primary_left", "sc:Integer", "Left camera of the primary pair."),
            ("primary_right", "sc:Integer", "Right camera of the primary pair."),
            ("description", "sc:Text", "Machine-written description; empty where there is none."),
        )
    ]
    arrays = [
        field(
            "scenes/pairwise_baselines_cm", "sc:Float",
            "Baselines of the 15 pairs 0-1, 0-2 ... 4-5, in cm.",
            isArray=True, arrayShape="15", **column(SCENES, "pairwise_baselines_cm"),
        ),
        field(
            "scenes/depth_unit_m", "sc:Float", "Metres in a stored unit of depth, for each camera.",
            isArray=True, arrayShape="6", **column(SCENES, "depth_unit_m"),
        ),
    ]  # fmt: skip
    return record_set(
        "scenes", "Every scene once.", [*fields, *arrays], key={"@id": "scenes/scene_id"}
    )


def _scene_categories() -> Node:
    targets = {
        "split": "splits",
        "eval_subset": "eval_subsets",
        "family": "families",
        "map": "maps",
    }
    fields = [
        field(
            "scene_categories/scene_id", "sc:Text", "Path of the scene.",
            **column(SCENES, "scene_id"),
        ),
        *(
            field(
                f"scene_categories/{name}", "sc:Text", f"One of {target}.",
                **column(SCENES, name), **refers_to(f"{target}/name"),
            )
            for name, target in targets.items()
        ),
    ]  # fmt: skip
    return record_set("scene_categories", "Which part every scene belongs to.", fields)


def _pairs() -> Node:
    fields = [
        field("pairs/pair_id", "sc:Text", "Scene and cameras.", **column(PAIRS, "pair_id")),
        field(
            "pairs/scene_id", "sc:Text", "Path of the scene.",
            **column(PAIRS, "scene_id"), **refers_to("scenes/scene_id"),
        ),
        *(
            field(f"pairs/{name}", kind, text, **column(PAIRS, name))
            for name, kind, text in (
                ("camera_left", "sc:Integer", "Number of the left camera."),
                ("camera_right", "sc:Integer", "Number of the right camera."),
                ("baseline_cm", "sc:Float", "Distance of the two cameras, in cm."),
                ("baseline_bin", "sc:Text", "Bin of the distance, in cm."),
                ("is_adjacent", "sc:Boolean", "Whether the cameras stand next to each other."),
                ("is_primary", "sc:Boolean", "Whether the scene records it as its primary pair."),
            )
        ),
    ]  # fmt: skip
    return record_set(
        "pairs", "Every stereo pair once: 15 a scene.", fields, key={"@id": "pairs/pair_id"}
    )


def _shards() -> Node:
    fields = [
        field(f"shards/{name}", kind, text, **column(SHARDS, name))
        for name, kind, text in (
            ("shard", "sc:Text", "Path of the shard."),
            ("size_bytes", "sc:Integer", "Its size."),
            ("sha256", "sc:Text", "Its checksum, in hex."),
            ("scenes", "sc:Integer", "How many scenes it holds."),
            ("members", "sc:Integer", "How many files it holds."),
        )
    ]
    return record_set("shards", "Every shard once.", fields, key={"@id": "shards/shard"})


def _descriptions() -> Node:
    fields = [
        field(
            "descriptions/scene_id", "sc:Text", "Path of the scene.", **column(SCENES, "scene_id")
        ),
        field(
            "descriptions/text", "sc:Text", "Machine-written; empty where there is none.",
            **column(SCENES, "description"),
        ),
    ]  # fmt: skip
    return record_set("descriptions", "What a model says of every scene.", fields)


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
