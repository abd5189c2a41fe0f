"""A Croissant 1.1 descriptor with RAI 1.0 properties, written from an index.

Its files and record sets are templates, one for each kind of data:

    shards.json     shards, with tables of scenes and pairs beside the descriptor
    release.json    the public release, whose record sets hold their data themselves
    common.json     the context and the enumerations of both

mlcroissant parses no JSON inside a tar, so what the shards' JSON files hold is written once as
Parquet tables, from the index. Where there are many shards, record sets of files use only a few.

A word such as ``@rgb@`` in a template is filled in here. A regex that takes the scene of a path
does not change a scene's key, because mlcroissant's joins apply it twice. Where mlcroissant 1.1
reads a narrower form than the specification allows, the narrower form is written. What a descriptor
says of the dataset as a whole is in `dataset_facts`.

Source: the Croissant 1.1 and RAI 1.0 specifications.
"""

import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from stereogenbench_data.bridges import dataset_facts
from stereogenbench_data.errors import DescriptorError, explain_os_errors
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import CAMERA_PAIRS, baseline_bin
from stereogenbench_data.sources.files import open_atomic, write_atomic
from stereogenbench_data.sources.location import is_remote, shown

MOST_MEDIA_BYTES: Final = 1_000_000_000
"""Above this size of all shards, record sets of files use the smallest shard of each family."""

_SEEN_AFTER_ALL: Final = "in train, though scenes of unseen_map have it"
"""The meaning of a map that contradicts the subset of its scenes."""

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


def bound_shards(index: SceneIndex) -> list[str]:
    """Return the shards that record sets of files use: all, or the smallest of each family."""
    sizes = {path: index.shards[path].size for path in sorted(index.shards)}
    if sum(sizes.values()) <= MOST_MEDIA_BYTES:
        return [*sizes]
    smallest: dict[str, str] = {}
    for path in sorted(sizes, key=lambda path: sizes[path]):
        smallest.setdefault(path.rpartition("-")[0], path)
    return sorted(smallest.values())


def write_tables(index: SceneIndex, folder: Path) -> dict[str, bytes]:
    """Write the tables of shards into a folder, and return their bytes by name.

    Args:
        index: The index of shards.
        folder: Where to write; created if it does not exist.

    Raises:
        DescriptorError: If the folder cannot be written.
    """
    tables = {
        "scenes.parquet": scenes_table(index),
        "pairs.parquet": pairs_table(index),
        "shards.parquet": shards_table(index),
    }
    cannot = f"{folder}: tables cannot be written"
    with explain_os_errors(cannot, "Choose another place with --out.", kind=DescriptorError):
        folder.mkdir(parents=True, exist_ok=True)
        for name, table in tables.items():
            with open_atomic(folder / name) as file:
                pq.write_table(table, file, compression="zstd")
        return {name: (folder / name).read_bytes() for name in tables}


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


Node = dict[str, Any]

_HUB_FILE: Final = re.compile(r"(https?://[^/]+/datasets/[^/]+/[^/]+)/(?:resolve|tree|blob|raw)/")
"""A URL of files of a dataset on the Hub; the group is the dataset's page."""
_VERSION: Final = re.compile(r"\d+\.\d+\.\d+")
_DAY: Final = re.compile(r"\d{4}-\d{2}(-\d{2})?")
_MEDIA_TYPES: Final = {"mp4": "video/mp4", "mkv": "video/x-matroska"}
"""By suffix. Depth packed by blosc2 has no media type of its own."""
_TAR, _PARQUET = "application/x-tar", "application/x-parquet"
_TABLES: Final = {
    "scenes.parquet": "One row a scene.",
    "pairs.parquet": "One row a camera pair, 15 a scene.",
    "shards.parquet": "One row a shard, with its checksum.",
}


def template(name: str, **words: str) -> Node:
    """Return a template of this folder, with words filled in."""
    text = Path(__file__).with_name(f"{name}.json").read_text(encoding="utf-8")
    for word, value in words.items():
        text = text.replace(f"@{word}@", value)
    node: Node = json.loads(text)
    return node


def write_descriptor(
    index: SceneIndex | None,
    path: Path,
    *,
    about: dataset_facts.About | None = None,
    data_url: str | None = None,
) -> Node:
    """Write the descriptor of an index's data, and its tables beside it.

    Args:
        index: The index of shards; None for the release in its own repository.
        path: The descriptor to write, such as ``croissant/sample.json``; the tables of shards are
            written into the folder of the same name without its suffix.
        about: What the user states of the scenes, as for `dataset_facts.facts_of`. The version is
            1.0.0 and the day of publication is today, unless they are stated.
        data_url: URL of the folder of shards, pinned to a revision. With None, shards have paths
            relative to the descriptor.

    Returns:
        The descriptor as written.

    Raises:
        DescriptorError: If a file cannot be written, ``data_url`` is not valid or contains a login
            or a query, it is None but shards are behind a URL, the data are not shards, or who
            made the scenes is not known.
    """
    facts = dataset_facts.facts_of(index, about=about)
    _require_valid(facts, data_url)
    if index is None:
        data_url = data_url or facts["url"]
        files = template("release", repository=data_url)
    elif index.shards:
        tables_url = f"{data_url}/{path.stem}" if data_url else path.stem
        data_url = data_url or _relative(index.root, to=path.parent)
        tables = write_tables(index, path.with_suffix(""))
        files = _shard_nodes(index, tables, data_url=data_url, tables_url=tables_url)
        facts = facts | dataset_facts.packing_facts(index, facts)
    else:
        raise DescriptorError(
            f"{index.where}: these are folders of scenes. Pack them first: shards are described "
            "where they are."
        )
    head = _head(facts, url=_page(data_url, beside=path))
    records = [*_enumerations(index), *files["recordSet"]]
    descriptor = head | {"distribution": files["distribution"], "recordSet": records}
    write_node(descriptor, path)
    return descriptor


def write_node(node: Mapping[str, Any], path: Path) -> None:
    """Write a JSON object as descriptors are written.

    Raises:
        DescriptorError: If the file cannot be written.
    """
    cannot = f"{path}: cannot be written"
    with explain_os_errors(cannot, "Choose another place with --out.", kind=DescriptorError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, (json.dumps(node, indent=1, ensure_ascii=False) + "\n").encode())


def _require_valid(facts: Mapping[str, Any], data_url: str | None) -> None:
    version, day = facts.get("version", "1.0.0"), facts.get("datePublished", "2026-01")
    if not _VERSION.fullmatch(str(version)):
        raise DescriptorError(
            f"{version!r} is not a version: it must be MAJOR.MINOR.PATCH, such as 1.0.0."
        )
    if not _DAY.fullmatch(str(day)):
        raise DescriptorError(f"datePublished is {day!r}, not a day: write it as 2026-11-21.")
    if data_url is not None and (not is_remote(data_url) or shown(data_url) != data_url):
        raise DescriptorError(
            f"{shown(data_url)!r} is not a URL under which others find the data, such as "
            "https://HOST/PATH, without a login or a query: give one, or leave it out."
        )


def _of_videos(index: SceneIndex) -> Node:
    """Return the template of shards with the suffixes of videos, without the kinds they lack."""
    held = index.scene(0).held_videos
    words: dict[str, str] = {}
    missing = set()
    for kind in ("rgb", "depth"):
        suffix = next((each.rpartition(".")[2] for each in held if f"_{kind}." in each), "")
        media_type = _MEDIA_TYPES.get(suffix, "application/octet-stream") if suffix else ""
        words |= {kind: suffix, f"{kind}_type": media_type}
        if not suffix:
            missing |= {f"{kind}-files", f"{kind}_videos"}
    nodes = template("shards", **words)
    for files in nodes["distribution"]:
        if isinstance(files["encodingFormat"], list):
            files["encodingFormat"] = [each for each in files["encodingFormat"] if each]
    return {
        part: [each for each in found if each["@id"] not in missing]
        for part, found in nodes.items()
    }


def _shard_nodes(
    index: SceneIndex, tables: Mapping[str, bytes], *, data_url: str, tables_url: str
) -> Node:
    """Return the files and record sets of shards."""
    nodes = _of_videos(index)
    bound = bound_shards(index)
    files = []
    for name, content in tables.items():
        sha256, about = hashlib.sha256(content).hexdigest(), {"description": _TABLES[name]}
        place = f"{tables_url}/{name}"
        files.append(_file(name, place, _PARQUET, sha256, len(content), about))
    for shard in sorted(index.shards):
        facts = index.shards[shard]
        files.append(_file(shard, f"{data_url}/{shard}", _TAR, facts.sha256, facts.size, {}))
    contained: Any = [{"@id": each} for each in bound]
    for each in nodes["distribution"]:
        if each["containedIn"] == []:
            each["containedIn"] = contained if len(bound) != 1 else contained[0]
        files.append(each)
    return {"distribution": files, "recordSet": nodes["recordSet"]}


def _file(name: str, url: str, kind: str, sha256: str, size: int, about: Mapping[str, str]) -> Node:
    node: Node = {"@type": "cr:FileObject", "@id": name, "name": name, **about}
    node |= {"contentSize": f"{size} B", "contentUrl": url}
    return node | {"encodingFormat": kind, "sha256": sha256}


def _enumerations(index: SceneIndex | None) -> list[Node]:
    """Return the record sets of all splits, subsets, families and maps; the release's for None."""
    nodes: list[Node] = template("common")["recordSet"]
    if index is None:
        return nodes
    train = set(index.column("map_name")[index.column("split") == "train"])
    contradicted = {*index.seen_maps_called_unseen().values()}
    maps = sorted(set(index.column("map_name")))

    def meaning(name: str) -> str:
        if name in contradicted:
            return _SEEN_AFTER_ALL
        return "in train" if name in train else "in eval alone"

    _, _, families, places = nodes
    known = {row["families/name"]: row["families/meaning"] for row in families["data"]}
    families["data"] = [
        {"families/name": name, "families/meaning": known.get(name, "A family of its own.")}
        for name in sorted(set(index.column("family")))
    ]
    places["data"] = [{"maps/name": name, "maps/meaning": meaning(name)} for name in maps]
    return nodes


def _page(data_url: str, *, beside: Path) -> str:
    """Return the page of data: on the Hub, or their README.md if they are local."""
    found = _HUB_FILE.match(f"{data_url}/")
    if found:
        return found[1]
    readme = f"{data_url}/README.md"
    return readme if "://" not in data_url and (beside.parent / readme).is_file() else data_url


def _relative(root: str, *, to: Path) -> str:
    if "://" in root:
        raise DescriptorError(
            f"{shown(root)}: the shards are behind a URL, so paths cannot be relative. Give their "
            "URL for the descriptor, pinned to a revision (--base-url)."
        )
    return Path(os.path.relpath(root, to)).as_posix()


def _head(facts: Mapping[str, Any], *, url: str) -> Node:
    """Return the properties of the dataset as a whole, in the order in which people read them."""
    head = template("common")
    del head["recordSet"]
    head |= {
        "name": facts["name"],
        "description": facts["description"],
        "url": url,
        "license": facts["license"],
        "usageInfo": facts["usageInfo"],
        "version": facts.get("version", "1.0.0"),
        "datePublished": facts.get("datePublished", str(datetime.now(UTC).date())),
    }
    rest = {name: value for name, value in facts.items() if name not in head}
    return head | rest | {"inLanguage": facts.get("inLanguage", "en")}
