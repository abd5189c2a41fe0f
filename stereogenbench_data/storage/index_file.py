"""The index file: Parquet rows with a description of themselves, checked before they are believed.

It is read from untrusted places: rows that are not the index's columns, or whose paths would lead
out of the data's root, are refused.
"""

import itertools
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from stereogenbench_data.errors import StorageError, cure_of
from stereogenbench_data.storage.location import is_remote, local_path, shown
from stereogenbench_data.storage.rows import SCHEMA
from stereogenbench_data.storage.source import UNSAFE_PATH
from stereogenbench_data.storage.unfinished import writing_whole

_OF_RELEASE: Final = "Run `stereogenbench index ROOT` again."
_OF_SHARDS: Final = (
    "It is the index of shards: fetch it again or, where they were packed, run the same "
    "`stereogenbench pack` again, which keeps finished shards."
)

_FORMAT: Final = 1
_UNSAFE: Final = re.compile(UNSAFE_PATH)
_METADATA_KEY: Final = b"stereogenbench_data.index"


def made_again(where: str) -> str:
    """Return what to do about an index, found there, that cannot be used."""
    if is_remote(where):
        return "Fetch it again; if it is damaged there, too, tell who published it."
    shards = local_path(where).parent.glob("*.tar")
    return _OF_RELEASE if next(shards, None) is None else _OF_SHARDS


def read_index_file(file: Path | pa.BufferReader, *, where: str) -> tuple[pa.Table, dict[str, Any]]:
    """Return an index file's rows, and what it says of itself.

    Raises:
        StorageError: If it is no index of this version, or was altered.
    """
    try:
        with pq.ParquetFile(file) as parquet:
            metadata = (parquet.schema_arrow.metadata or {}).get(_METADATA_KEY)
            head = _require_head(metadata, where=where)
            table = parquet.read().replace_schema_metadata().combine_chunks()
        table.validate(full=True)
    except StorageError:
        raise
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        if isinstance(error, OSError) and error.errno and cure_of(error):
            raise StorageError(
                f"{where}: cannot be read ({os.strerror(error.errno)}). {cure_of(error)}"
            ) from error
        raise StorageError(
            f"{where}: is no Parquet file that can be read ({error}). It was cut short or is "
            f"something else. {made_again(where)}"
        ) from error
    require_sound(table, where=where)
    return table, head


def write_index_file(path: Path, table: pa.Table, description: Mapping[str, Any]) -> None:
    """Write an index file, whole or not at all.

    Raises:
        StorageError: If it cannot be written.
    """
    head = json.dumps({"format": _FORMAT} | dict(description))
    described = table.replace_schema_metadata({_METADATA_KEY: head})
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with writing_whole(path) as file:
            pq.write_table(described, file, compression="zstd")
    except OSError as error:
        raise StorageError(
            f"{path}: the index cannot be written ({error.strerror or error}). "
            + cure_of(error, "Choose another place with --out.")
        ) from error


def root_told(root: str, *, beside: Path) -> str:
    """Return the root as an index in a folder remembers it.

    Raises:
        StorageError: If it is a URL with something secret in it, which no file shall keep.
    """
    if not is_remote(root):
        whole = local_path(root).resolve()
        return "." if beside.resolve() == whole else str(whole)
    if shown(root) != root:
        raise StorageError(
            f"{shown(root)}: the URL has a login or a query, which an index file does not keep: "
            f"copy the index that lies beside the data."
        )
    return root


def root_of(path: Path, head: Mapping[str, Any], table: pa.Table) -> str | Path:
    """Return the data's root: the index's own folder if the data are there, else the recorded."""
    beside, recorded = path.parent, Path(head["root"])
    if is_remote(head["root"]):
        return str(head["root"])
    if head["root"] == "." or not table.num_rows:
        return beside
    first = table.column("members")[0].as_py()[0]["path"]
    if (beside / first).exists():
        return beside
    if not recorded.is_dir():
        raise StorageError(
            f"{path}: its data were at {recorded}, which is no folder now. Move the index into "
            f"the data's root, or run `stereogenbench index` again."
        )
    return recorded


def _require_head(metadata: bytes | None, *, where: str) -> dict[str, Any]:
    """Return what an index says of itself, once it is known to be one of this version."""
    try:
        head = json.loads(metadata or b"null")
    except (ValueError, RecursionError):
        head = None
    if not isinstance(head, dict):
        raise StorageError(
            f"{where}: is a Parquet file, but no index of this package. Pass another file, or "
            f"make one with `stereogenbench index ROOT`."
        )
    if head.get("format") != _FORMAT:
        raise StorageError(
            f"{where}: is an index of format {head.get('format')!r}, and this version of the "
            f"package reads format {_FORMAT}. {made_again(where)}"
        )
    tables = [head.get("incomplete"), head.get("broken"), head.get("shards")]
    if (
        not all(isinstance(each, dict) for each in tables)
        or not isinstance(head.get("root"), str)
        or not all(map(_are_shard_facts, head["shards"].values()))
        or any(map(_UNSAFE.search, head["shards"]))
        or not isinstance(head.get("passed_over", []), list)
    ):
        raise StorageError(f"{where}: its description of itself was altered. {made_again(where)}")
    return head


def _are_shard_facts(value: Any) -> bool:
    kinds = {"size": int, "sha256": str, "members": int}
    return isinstance(value, dict) and {name: type(each) for name, each in value.items()} == kinds


def require_sound(table: pa.Table, *, where: str) -> None:
    """Refuse a table that is no index, or whose rows could lead out of the root."""
    if not table.schema.equals(SCHEMA):
        odd = [
            field.name
            for field in SCHEMA
            if field.name not in table.schema.names
            or not table.schema.field(field.name).equals(field)
        ]
        raise StorageError(
            f"{where}: its columns are not those of an index (see {', '.join(odd) or 'order'}). "
            f"{made_again(where)}"
        )
    keys = table.column("key").to_pylist()
    for key, following in itertools.pairwise(keys):
        if key >= following:
            raise StorageError(
                f"{where}: scene {following!r} is there twice or out of order. {made_again(where)}"
            )
    members = pc.list_flatten(table.column("members"))
    for paths, unfit in (
        (table.column("key"), UNSAFE_PATH),
        (pc.struct_field(members, "path"), UNSAFE_PATH),
        (pc.struct_field(members, "name"), f"{UNSAFE_PATH}|/"),
    ):
        unsafe = paths.filter(pc.match_substring_regex(paths, unfit))
        if len(unsafe):
            raise StorageError(
                f"{where}: {unsafe[0].as_py()!r} is no path inside the data's root. The index "
                f"was altered. {made_again(where)}"
            )
    for name, numbers, least in (
        ("frames", table.column("frames"), 1),
        ("size", pc.struct_field(members, "size"), 0),
        ("offset", pc.struct_field(members, "offset"), 0),
    ):
        lowest = pc.min(numbers).as_py()
        if lowest is not None and lowest < least:
            raise StorageError(f"{where}: {name} is {lowest}, below {least}. {made_again(where)}")
