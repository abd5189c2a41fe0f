"""Opening an index: from a file, a folder or a URL to a checked table of scenes.

    a file ─────────────────────┬─ read ── root of its data ── digest ── is it stale?
    a folder with an index file ┘
    a URL ──────── fetched ─────── read ────────────────────── digest
    a folder or URL without one ── a tree (`open_tree`)

An index file may come from a stranger: it opens data beside itself, and any other root is the
user's own word. Conventions that are given for an index are compared with its rows (`restated`).
An index is old if its folder holds other scenes or shards (`stale_message`): the names of folders
tell, as copies and unpacked archives change dates; 7 ms for 8,493 scenes.
"""

import functools
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

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
from stereogenbench_data.index.open_tree import (
    AssumptionWarning,
    IncompleteSceneWarning,
    Opened,
    Rows,
    listed,
    open_tree,
)
from stereogenbench_data.index.parquet import (
    INDEX_NAME,
    IndexHead,
    made_again,
    read_index_file,
    read_seek_tables,
)
from stereogenbench_data.index.rows import SCHEMA, scene_of
from stereogenbench_data.schema.conventions import Conventions
from stereogenbench_data.schema.records import SceneId
from stereogenbench_data.schema.release import (
    CAMERA_COUNT,
    COMPLETE_JSON,
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

MAX_INDEX_BYTES: Final = 256 * 2**20

"""The largest index that is fetched. One of 8,493 scenes has a few megabytes."""


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
    opening = functools.partial(
        open_tree, wanted=wanted, conventions=conventions, rows=rows, retry=retry
    )
    if is_remote(data):
        where = shown(data)
        opened = _open_url(str(data), root=named_root, retry=retry, open_tree=opening)
    else:
        path = local_path(data)
        where = str(path)
        with explain_os_errors(f"{path}: cannot be looked at"):
            is_folder, is_file = path.is_dir(), path.is_file()
            is_tree = is_folder and not (path / INDEX_NAME).is_file()
        if is_tree:
            _require_no_root(path, named_root)
            opened = opening(path)
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
        message = text_without_secrets(f"{where}: {listed(left_out)}")
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
        raise StorageError(
            f"{path}: its data are not beside it, and it records their root as "
            f"{shortened(repr(shown(recorded)), 300)}. An index opens data beside itself; any "
            f"other root is your own word: SceneIndex.open({str(path)!r}, root=...), or --root "
            f"with a command. Or move the index into that root."
        )
    if not folder.is_dir():
        raise StorageError(
            f"{path}: its data were at {folder}, which is not a folder now. Move the index into "
            f"the data's root, or run `stereogenbench index` again."
        )
    return str(folder)


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
    from stereogenbench_data.index.scene_folder import described_again
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
        videos = [name for name in VIDEO_FILES if scene.held_name(name) in scene.members][:1]
        _, found = described_again(scene, source, videos=videos)
        for name, difference in found[:1]:
            by = f"; so it is by {conventions.where}. Correct the conventions" if name else ""
            raise StorageError(
                f"{where}: {scene.id.key}/{name}: {difference}{by}. If the index is wrong: "
                f"{made_again(where)}"
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
    root, shards = Path(head.root), set(head.shards)
    if shards:
        what, known = "shard", shards
        new = {path.name for path in root.glob("*.tar") if path.name[0] != "."} - shards
        gone = {path for path in shards if not (root / path).exists()}
        cure = (
            "Fetch the index that belongs to these shards, move away what is not of it, or pack "
            "all scenes into an empty folder."
        )
    else:
        from stereogenbench_data.index.tree import SPLITS, search  # slow to import

        members = one_array(table.column("members"))
        first = pc.struct_field(members.values, "path").take(members.offsets[:-1])
        # Folders of scenes may have other names than the scenes' keys.
        known = {path.rpartition("/")[0] for path in first.to_pylist()}
        what, placed = "scene", {*search(root, SPLITS)[0]}
        left_out = head.broken.keys() - head.incomplete.keys()
        added = set() if head.is_part else placed - known - left_out
        new = {key for key in added if _is_finished(root, key)}
        gone = known - placed
        place = "" if index_file.parent == root else f" --out {index_file}"
        cure = f"Run `stereogenbench index {root}{place}`."
        if head.is_part:
            cure = "It is of a part of the folder: make it again."
    found = [
        f"{counted(len(names), what)} {why} "
        f"({', '.join(sorted(names)[:_NAMED])}{', ...' if len(names) > _NAMED else ''})"
        for names, why in (
            (new, "not in the index"),
            (set() if gone == known else gone, "of the index, and not there"),
        )
        if names
    ]
    return (
        f"{index_file}: is older than the folder {root}: {'; '.join(found)}. {cure}"
        if found
        else ""
    )


def _is_finished(root: Path, key: str) -> bool:
    """Return whether a folder is a scene that an index would hold, by its names."""
    from stereogenbench_data.schema.parse import parse_scene_key  # slow to import

    try:
        parse_scene_key(key)
        names = {path.name for path in (root / key).iterdir()}
    except (SchemaError, OSError):
        return False
    return COMPLETE_JSON in names and not names.isdisjoint(VIDEO_FILES)
