"""Opening an index: from a file, a folder or a URL to a checked table of scenes.

    a file ─────────────────────┬─ read ── root of its data ── digest ── is it stale?
    a folder with an index file ┘
    a URL ──────── fetched ─────── read ────────────────────── digest
    a folder or URL without one ── its scenes are described

An index file may come from a stranger: it opens data beside itself, and any other root is the
user's own word. Conventions that are given for an index are compared with its rows (`restated`).
What was taken for granted about a tree's files is told in one line (`assumptions`). An index is old
if its folder holds other scenes or shards (`stale_message`): the names of folders tell, as copies
and unpacked archives change dates; 7 ms for 8,493 scenes.
"""

import functools
import gc
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, TypeAlias

import numpy as np
import pyarrow as pa

from stereogenbench_data.errors import (
    SchemaError,
    StorageError,
    explain_os_errors,
    text_without_secrets,
)
from stereogenbench_data.index import compute as pc
from stereogenbench_data.index.arrow import one_array, table_digest
from stereogenbench_data.index.parquet import (
    INDEX_NAME,
    IndexHead,
    made_again,
    read_index_file,
    read_seek_tables,
    seek_tables_of,
    table_of_scenes,
)
from stereogenbench_data.index.rows import SCHEMA, scene_of
from stereogenbench_data.schema.conventions import Conventions
from stereogenbench_data.schema.records import Scene, SceneId
from stereogenbench_data.schema.release import (
    BASELINE_JSON,
    CAMERA_COUNT,
    COMPLETE_JSON,
    TRAJECTORY_JSON,
    VIDEO_FILES,
)
from stereogenbench_data.schema.text import counted, shortened
from stereogenbench_data.sources.location import (
    is_remote,
    joined,
    local_path,
    shown,
    split_name,
)
from stereogenbench_data.sources.remote import RemoteObject
from stereogenbench_data.sources.retry import MissingObject, RetryPolicy

if TYPE_CHECKING:
    from stereogenbench_data.index.build import TreeReport
    from stereogenbench_data.index.presumed import Baselines, ListedTree, Presumption

MAX_INDEX_BYTES: Final = 256 * 2**20
"""The largest index that is fetched. One of 8,493 scenes has a few megabytes."""

MOST_REMOTE_SCENES: Final = 64
"""The most scenes behind a URL that are described when a tree without an index is opened."""

MOST_LEFT_OUT: Final = 0.05
"""The largest share of a tree's scenes that may be broken; one always may."""

_LONGEST_ROOT: Final = 300
_LONGEST_REASON: Final = 5000
_SHOWN: Final = 10
_LOOKED_AT: Final = 64
"""How many scenes tell what opening a tree takes for granted."""


class IncompleteSceneWarning(UserWarning):
    """Some scenes of the data cannot be used; the message names them and the reasons."""


Rows = Literal["presumed", "read"]
"""Whether the rows of many scenes without an index may be presumed; see `index.presumed`."""

SeekTables: TypeAlias = pa.BinaryArray | Path | None
"""The packed seek tables of scenes, a row each, or the index file that holds them; None where there
are none."""


class Opened(NamedTuple):
    """An index that was opened.

    Attributes:
        table: A checked table with one row per scene.
        head: What is known besides, with the root where the data are.
        stale: How the root differs from the index, with the cure; "" if it does not.
        seek_tables: Where the packets of the videos lie.
        assumed: What was taken for granted about the files of a tree; "" where nothing was.
        presumption: What describes the scenes of a table that is presumed; None for one that was
            read.
    """

    table: pa.Table
    head: IndexHead
    stale: str = ""
    seek_tables: SeekTables = None
    assumed: str = ""
    presumption: "Presumption | None" = None


def open_table(
    data: str | Path,
    *,
    root: str | Path | None,
    retry: RetryPolicy | None,
    wanted: Callable[[SceneId], bool] | None = None,
    conventions: Conventions | None = None,
    rows: Rows = "presumed",
) -> Opened:
    """Return the scenes of some data; `SceneIndex.open` describes the arguments and the errors.

    Warnings name scenes that cannot be used, and an index that is older than its data; they point
    at the caller's caller.
    """
    named_root = None if root is None else _require_root(root)
    open_tree = functools.partial(
        _open_tree, wanted=wanted, conventions=conventions, rows=rows, retry=retry
    )
    if is_remote(data):
        where = shown(data)
        opened = _open_url(str(data), root=named_root, retry=retry, open_tree=open_tree)
    else:
        path = local_path(data)
        where = str(path)
        with explain_os_errors(f"{path}: cannot be looked at"):
            is_folder, is_file = path.is_dir(), path.is_file()
            is_tree = is_folder and not (path / INDEX_NAME).is_file()
        if is_tree:
            _require_no_root(path, named_root)
            opened = open_tree(path)
        elif is_folder or is_file:
            file = path / INDEX_NAME if is_folder else path
            opened = _open_file(file, root=named_root)
        else:
            raise StorageError(
                f"{path}: does not exist; expected an index file, a folder with {INDEX_NAME} or "
                f"a folder in the released layout."
            )
    if conventions is not None:
        stated = restated(opened.table, opened.head, conventions, retry=retry)
        if stated is not opened.table:
            head = replace(opened.head, digest=table_digest(stated))
            opened = opened._replace(table=stated, head=head)
    if left_out := opened.head.incomplete | opened.head.broken:
        message = text_without_secrets(f"{where}: {_listed(left_out)}")
        warnings.warn(message, IncompleteSceneWarning, stacklevel=3)
    if opened.stale:
        warnings.warn(opened.stale, StaleIndexWarning, stacklevel=3)
    if opened.assumed:
        warnings.warn(opened.assumed, AssumptionWarning, stacklevel=3)
    return opened


def _open_file(path: Path, *, root: str | None) -> Opened:
    """Return the index in a file. The user or, within limits, the file names its data's root.

    Raises:
        StorageError: If it is damaged or not an index of this version, or only the user may name
            the place of its data.
    """
    table, head = read_index_file(path, where=str(path))
    head = replace(head, root=_recorded_root(path, head, table) if root is None else root)
    stale = "" if is_remote(head.root) else stale_message(table, head, index_file=path)
    return Opened(table, head, stale, path)


def _open_url(
    url: str,
    *,
    root: str | None,
    retry: RetryPolicy | None,
    open_tree: Callable[[str], Opened],
) -> Opened:
    """Fetch an index. Its data are beside it, unless the user names another root."""
    beside, name = split_name(url)
    is_folder = not name.endswith(".parquet")
    if is_folder:
        beside, url = url.rstrip("/"), joined(url.rstrip("/"), INDEX_NAME)
    remote = RemoteObject(url, retry=retry)
    try:
        size = remote.size()
    except MissingObject:
        if not is_folder:
            raise
        _require_no_root(shown(beside), root)
        return open_tree(beside)
    if size > MAX_INDEX_BYTES:
        raise StorageError(
            f"{remote.where}: an index may have {MAX_INDEX_BYTES:,} bytes, this one has "
            f"{size:,}. It was not read. Check that the URL is that of an {INDEX_NAME}."
        )
    content = pa.BufferReader(remote.read(0, size))
    table, head = read_index_file(content, where=remote.where)
    head = replace(head, root=root or beside)
    content.seek(0)
    return Opened(table, head, seek_tables=read_seek_tables(content))


def _open_tree(
    root: str | Path,
    *,
    wanted: Callable[[SceneId], bool] | None,
    rows: Rows,
    conventions: Conventions | None,
    retry: RetryPolicy | None,
) -> Opened:
    """Return the scenes of a folder or URL in the released layout, without a few broken ones.

    Those of a large folder are kept in the user's cache, and presumed where that is possible.
    """
    # What describes files takes long to import, and an index needs none of it.
    from stereogenbench_data.index.build import walk
    from stereogenbench_data.index.presumed import list_tree

    with _no_collection():
        place = root if is_remote(root) else Path(root)
        tree = list_tree(place, wanted, conventions, retry=retry)
    if tree is not None and rows == "presumed" and tree.has_one_shape:
        opened = _open_presumed(tree, "read" if tree.remote is None else "when needed")
        if opened is not None:
            return opened
    opened = None if tree is None else _kept(tree, "read")
    if opened is None:
        if tree is not None and tree.remote is not None:
            _require_few(tree)
        # In this process: a script without `if __name__ == "__main__"` could start no others.
        how: Any = {"wanted": wanted, "conventions": conventions, "retry": retry}
        opened = _of_report(walk(root, workers=1, if_none="all", **how))
        if tree is not None:
            _keep(tree, "read", opened)
    return opened


def _open_presumed(tree: "ListedTree", baselines: "Baselines") -> Opened | None:
    """Return the scenes of a tree, most of them presumed; None where nothing can be presumed."""
    from stereogenbench_data.index.presumed import Presumption, presumed_report

    name: Literal["presumed", "listed"] = "presumed" if baselines == "read" else "listed"
    opened = _kept(tree, name)
    if opened is None:
        with _no_collection():
            report = presumed_report(tree, baselines)
            opened = None if report is None else _keep(tree, name, _of_report(report))
    if opened is None:
        return None
    forms = opened.table.column("pose_form").drop_null().to_pylist()
    presumption = Presumption(tree, forms=forms, baselines=baselines)
    return opened._replace(presumption=presumption)


def with_baselines(presumption: "Presumption", table: pa.Table) -> "tuple[pa.Table, Presumption]":
    """Return presumed rows once each ``baseline.json`` was read.

    Raises:
        StorageError: If one of them cannot be used, or read.
    """
    if presumption.baselines == "read":
        return table, presumption
    opened = _open_presumed(presumption.tree, "read")
    if opened is None or opened.presumption is None or opened.table["key"] != table["key"]:
        why = "" if opened is None else _listed(opened.head.incomplete | opened.head.broken)
        raise StorageError(
            f"{shown(presumption.tree.root)}: not all scenes are as was presumed: {why}. "
            f"{presumption.cures()}"
        )
    return opened.table, opened.presumption


def _require_few(tree: "ListedTree") -> None:
    """Refuse to describe many scenes behind a URL each time they are opened."""
    count, where = len(tree.folders.keys), shown(tree.root)
    if count > MOST_REMOTE_SCENES:
        raise StorageError(
            f"{where}: has no {INDEX_NAME}, its scenes cannot be presumed to be alike, and {count} "
            f"are too many to fetch their headers each time. Index it once, or the part you need: "
            f"`stereogenbench index {where} -o index.parquet --split eval`, and open that file "
            f"with --root {where}, or SceneIndex.open('index.parquet', root=...)."
        )


@contextmanager
def _no_collection() -> Iterator[None]:
    """Collect no garbage: beside torch's objects, the rows of thousands of scenes cost a third."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def _kept(tree: "ListedTree", rows: Rows | Literal["listed"]) -> Opened | None:
    """Return the rows of a tree that an earlier opening has kept."""
    found = tree.cache.table(f"{rows}-{tree.stamp}")
    if found is None:
        return None
    table, head, tables = found
    # Without a digest: the user has made no index file.
    return Opened(
        table,
        replace(head, root=str(tree.root), digest=""),
        seek_tables=tables,
        assumed=_assumed_of(table, where=str(tree.root)),
    )


def _keep(tree: "ListedTree", rows: Rows | Literal["listed"], opened: Opened) -> Opened:
    """Keep the rows of a tree for later openings, and return them."""
    if not isinstance(opened.seek_tables, Path):
        head = replace(opened.head, digest=table_digest(opened.table))
        name = f"{rows}-{tree.stamp}"
        tree.cache.keep_table(name, opened.table, head, opened.seek_tables)
    return opened


def _of_report(report: "TreeReport") -> Opened:
    """Return the scenes that a walk found.

    Raises:
        StorageError: If no scene is whole, or more than a few are broken.
    """
    from stereogenbench_data.index.build import FORMAT_CURE

    where = shown(report.root)
    if not report.scenes:
        cure = f"\n{FORMAT_CURE.format(root=where)}" if report.broken else ""
        raise StorageError(
            f"{where}: no scene is complete: {_listed(report.broken | report.incomplete)}{cure}"
        )
    found = len(report.scenes) + len(report.broken)
    if len(report.broken) > max(1, found * MOST_LEFT_OUT):
        raise StorageError(
            f"{where}: {_listed(report.broken)}\nRepair or remove them; or leave them out on "
            f"purpose: `stereogenbench index {where}` makes an index without them."
        )
    opened = opened_report(report)
    return opened._replace(assumed=_assumed_of(opened.table, where=where))


def opened_report(report: "TreeReport") -> Opened:
    """Return the scenes that a walk found as an index."""
    table = table_of_scenes(report.scenes, where=shown(report.root))
    return Opened(table, report.head, seek_tables=seek_tables_of(report.scenes))


def _assumed_of(table: pa.Table, *, where: str) -> str:
    """Return what was taken for granted, by some of the scenes whose files were all read."""
    is_odd = pc.or_(pc.is_valid(table.column("pose_form")), pc.is_valid(table.column("remarks")))
    scenes = table.filter(is_odd).slice(0, _LOOKED_AT).to_pylist()
    return assumptions(map(scene_of, scenes), where=where)


def _require_root(root: str | Path) -> str:
    """Return the root that the user named: any URL, or a folder."""
    if is_remote(root):
        return str(root)
    folder = local_path(root)
    if not str(root) or not folder.is_dir():
        raise StorageError(
            f"{str(root)!r}: not a folder, and was named as the root of an index's data. Name the "
            f"folder or URL to which the paths in the index are relative."
        )
    return str(folder)


def _require_no_root(where: str | Path, root: str | None) -> None:
    if root is not None:
        raise StorageError(
            f"{where}: has no {INDEX_NAME}, and a root was named for the data of one. Leave root "
            f"out, or pass the index file."
        )


def _recorded_root(path: Path, head: IndexHead, table: pa.Table) -> str:
    """Return the data's root: the index's own folder, or a recorded folder below it.

    Raises:
        StorageError: If the user must name the root, or it is not a folder.
    """
    beside, recorded = path.parent, head.root
    if recorded == "." or not table.num_rows:
        return str(beside)
    if any((beside / file["path"]).exists() for file in table.column("members")[0].as_py()):
        return str(beside)
    folder = None
    with suppress(OSError, ValueError, RuntimeError):  # not a path
        is_url = recorded[:5].lower() == "file:"
        place = local_path(recorded) if is_url else Path(recorded)
        folder = None if is_remote(recorded) else (beside / place).resolve()
    if folder is None or not folder.is_relative_to(beside.resolve()):
        raise _must_be_named(path, recorded)
    if not folder.is_dir():
        raise StorageError(
            f"{path}: its data were at {folder}, which is not a folder now. Move the index into "
            f"the data's root, or run `stereogenbench index` again."
        )
    return str(folder)


def _must_be_named(path: Path, recorded: str) -> StorageError:
    place = shown(recorded)
    if not place.isprintable() or len(place) > _LONGEST_ROOT:
        place = repr(shortened(place, _LONGEST_ROOT))
    return StorageError(
        f"{path}: its data are not beside it, and it records their root as {place}. An index opens "
        f"data beside itself; any other root is your own word: SceneIndex.open({str(path)!r}, "
        f"root=...), or --root with a command. Or move the index into that root."
    )


def _listed(left_out: Mapping[str, str]) -> str:
    lines = [
        shortened(reason if key in reason else f"{key}: {reason}", _LONGEST_REASON)
        for key, reason in sorted(left_out.items())[:_SHOWN]
    ]
    if len(left_out) > _SHOWN:
        lines.append(f"and {len(left_out) - _SHOWN} more")
    return "\n  ".join([f"{counted(len(left_out), 'scene')} cannot be used:", *lines])


_OF_DEPTH: Final = ("key", "depth_unit_m", "depth_offset_m", "depth_unit_source")
_READ_AGAIN: Final = 3
"""How many scenes' files are read again by the conventions."""


def restated(
    table: pa.Table, head: IndexHead, conventions: Conventions, *, retry: RetryPolicy | None
) -> pa.Table:
    """Return the rows of an index with conventions, which must be those of its scenes.

    Raises:
        StorageError: If the rows were described by other conventions, or files contradict these.
    """
    from stereogenbench_data.index.scene_folder import metadata_differences
    from stereogenbench_data.sources.members import MemberSource

    texts = [shape.text() for shape in conventions.shapes]
    if {*table.column("conventions").to_pylist()} <= {*texts}:
        return table
    where, shape = shown(head.root), conventions.shapes[0]
    if shape.has:
        raise StorageError(
            f"{where}: which of the {len(texts)} shapes of {conventions.where} a scene has is not "
            f"in its index. Name the conventions where it is made: `stereogenbench index ROOT "
            f"--conventions FILE`, and pack again."
        )
    source = MemberSource(head.root, shards=head.shards, revision=head.digest, retry=retry)
    rows = np.unique(np.linspace(0, table.num_rows - 1, _READ_AGAIN).astype(int))
    for row in rows.tolist():
        scene = replace(scene_of(table.slice(row, 1).to_pylist()[0]), conventions=texts[0])
        names = [name for name in (BASELINE_JSON, TRAJECTORY_JSON) if name in scene.members]
        found = metadata_differences(scene, {name: source.read(scene, name) for name in names})
        if found:
            name, difference = found[0]
            raise StorageError(
                f"{where}: {scene.id.key}/{name}: {difference}; so it is by {conventions.where}. "
                f"Correct the conventions. If the index is wrong: {made_again(where)}"
            )
    replaced: dict[str, Any] = {"conventions": texts[0]}
    encoding = None if shape.depth is None else shape.depth.encoding
    if shape.depth is not None and encoding is not None and encoding.unit_m is not None:
        columns = (table.column(name).to_pylist() for name in _OF_DEPTH)
        for key, units_m, offsets_m, sources in zip(*columns, strict=True):
            stated = zip(units_m, offsets_m or [0.0] * CAMERA_COUNT, sources, strict=True)
            for unit_m, stored_m, source in stated:
                if source not in ("default", "unreadable"):
                    shape.depth.require(unit_m, stored_m, where=f"{where}: {key}")
        offset_m = encoding.offset_m
        replaced["depth_unit_m"] = [encoding.unit_m] * CAMERA_COUNT
        replaced["depth_unit_source"] = ["conventions"] * CAMERA_COUNT
        replaced["depth_offset_m"] = [offset_m] * CAMERA_COUNT if offset_m else None
    for name, value in replaced.items():
        column = pa.array([value] * table.num_rows, type=SCHEMA.field(name).type)
        table = table.set_column(SCHEMA.get_field_index(name), SCHEMA.field(name), column)
    return table.combine_chunks()


_PHRASES: Final = {
    "size": "the videos' picture size counts, where baseline.json has another",
    "stated": "the videos and baseline.json count, where files state otherwise",
    "baselines": "baselines that are not recorded are sums of their neighbours",
    "pair": "the primary pair of baseline.json counts, where another file has another",
    "frames": "the frames that all videos have are used",
    "lens": "a pinhole lens is assumed, where baseline.json states another model",
    "marker": "no scene has _scene_complete.json, so it is not known which were finished",
    "world": "several readings of the poses fit the baselines, and fields that depend on the "
    "reading are refused",
}
_PLAIN: Final = "unreal axes"


class AssumptionWarning(UserWarning):
    """Files of a tree are not as the paper prints them, and something was taken for granted."""


def assumptions(scenes: Iterable[Scene], *, where: str) -> str:
    """Return what was taken for granted about scenes and what was measured; "" if nothing."""
    counts: Counter[str] = Counter()
    firsts: dict[str, str] = {}
    for scene in scenes:
        if scene.conventions is not None:
            continue
        found = {_PHRASES[each.about]: each for each in scene.remarks if each.about in _PHRASES}
        counts.update(found.keys())
        for phrase, each in found.items():
            if each.about in ("size", "pair", "stated"):
                firsts.setdefault(phrase, f", such as {each.text}")
        pixels = scene.remark("pixels").partition(": ")[2]
        counts.update([f"{pixels}; disparity follows from the sensor's width"] if pixels else [])
        form = (scene.pose_form or "").split("|")[0].partition(" @ ")[0]
        if form and _PLAIN not in form and not scene.remark("world"):
            counts[f"poses are read as {shortened(form, 200)}: measured, the cameras' distances "
                   "are the baselines"] += 1  # fmt: skip
    if not counts:
        return ""
    told = "; ".join(
        f"{phrase} ({counted(count, 'scene')}{firsts.get(phrase, '')})"
        for phrase, count in counts.items()
    )
    return (
        f"{where}: {told}. `stereogenbench conventions {where} -o conventions.toml` writes down "
        f"how its files are read, for conventions=."
    )


_NAMED: Final = 3


class StaleIndexWarning(UserWarning):
    """A folder holds scenes or shards that its index lacks, or lacks some that it lists."""


def stale_message(table: pa.Table, head: IndexHead, *, index_file: Path) -> str:
    """Return how an index differs from its root, and the cure; "" if it does not.

    Folders of the tree that may not be listed are ignored. An index without any of its data is not
    called old.

    Args:
        table: The rows of the index.
        head: What is known besides them; its root is a folder of this machine.
        index_file: Where the index is.
    """
    from stereogenbench_data.index.tree import PlacedFolders  # slow to import

    root, shards = Path(head.root), set(head.shards)
    if shards:  # folders of scenes may have other names than the scenes' keys
        keys = set(table.column("key").to_pylist())
    else:
        members = one_array(table.column("members"))
        first = pc.struct_field(members.values, "path").take(members.offsets[:-1])
        keys = {path.rpartition("/")[0] for path in first.to_pylist()}
    listed = PlacedFolders(root)
    new, tars, gone_scenes = set[str](), set[str](), set[str]()
    if not head.is_part:
        new = listed.keys - keys - (head.broken.keys() - head.incomplete.keys())
    for folder in {path.rpartition("/")[0] for path in shards} | {""} if shards else ():
        names = (path.name for path in (root / folder).glob("*.tar"))
        tars |= {f"{folder}/{name}".lstrip("/") for name in names if name[0] != "."}
    gone_shards = {path for path in shards - tars if not (root / path).exists()}
    if not shards:
        gone_scenes = {key for key in keys - listed.keys if not listed.may_hold(key)}
    found = [
        f"{counted(len(names), what)} {why} "
        f"({', '.join(names[:_NAMED])}{', ...' if len(names) > _NAMED else ''})"
        for names, what, why in (
            ([key for key in sorted(new) if _is_finished(root, key)], "scene", "not in the index"),
            (sorted(tars - shards), "shard", "not in the index"),
            (sorted(gone_shards if gone_shards != shards else ()), "shard", _GONE),
            (sorted(gone_scenes if gone_scenes != keys else ()), "scene", _GONE),
        )
        if names
    ]
    if not found:
        return ""
    place = "" if index_file.parent == root else f" --out {index_file}"
    cure = f"Run `stereogenbench index {root}{place}`."
    if shards:
        cure = (
            "Fetch the index that belongs to these shards, move away what is not of it, or pack "
            "all scenes into an empty folder."
        )
    elif head.is_part:
        cure = "It is of a part of the folder: make it again."
    return f"{index_file}: is older than the folder {root}: {'; '.join(found)}. {cure}"


_GONE: Final = "of the index, and not there"


def _is_finished(root: Path, key: str) -> bool:
    """Return whether a folder is a scene that an index would hold, by its names."""
    from stereogenbench_data.schema.parse import parse_scene_key  # slow to import

    try:
        parse_scene_key(key)
        names = {path.name for path in (root / key).iterdir()}
    except (SchemaError, OSError):
        return False
    return COMPLETE_JSON in names and not names.isdisjoint(VIDEO_FILES)
