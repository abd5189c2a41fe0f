"""The index file: Parquet rows with a description of themselves, all checked before use.

The file may come from a stranger: other columns, and paths that lead out of the data's root, are
refused.
"""

import itertools
import json
import os
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from stereogenbench_data.errors import (
    SchemaError,
    StorageError,
    cure_of,
    describe_os_error,
    explain_os_errors,
)
from stereogenbench_data.index import compute as pc
from stereogenbench_data.index.arrow import as_numpy, one_array, table_digest
from stereogenbench_data.index.rows import (
    ADDED,
    COLUMNS,
    SCHEMA,
    SEEK_COLUMN,
    row_of,
)
from stereogenbench_data.schema.conventions import declaration_of_text
from stereogenbench_data.schema.document import MOST_LETTERS
from stereogenbench_data.schema.records import REMARKS, Scene, ShardFacts
from stereogenbench_data.schema.text import shortened
from stereogenbench_data.sources.files import open_atomic
from stereogenbench_data.sources.location import UNSAFE_PATH, is_remote, local_path, shown

INDEX_NAME: Final = "index.parquet"

_FORMAT: Final = 1
_LARGEST: Final = 2**63
_FREE_BYTES: Final = 64 * 2**20
_BYTES_A_BYTE: Final = 32
"""An index may take so much memory, and so much for each byte of its file. One of the release takes
some six bytes for each."""
_BYTES_A_ROW: Final = 1024
"""What a row takes beside its texts and lists of any length."""
_METADATA_KEY: Final = b"stereogenbench_data.index"


@dataclass(frozen=True, slots=True)
class IndexHead:
    """What an index file says besides its rows; `SceneIndex` says what the attributes mean.

    Attributes:
        digest: The sha256 of the rows, 64 hex digits; empty if it is not known yet.
    """

    root: str
    digest: str = ""
    incomplete: dict[str, str] = field(default_factory=dict)
    broken: dict[str, str] = field(default_factory=dict)
    shards: dict[str, ShardFacts] = field(default_factory=dict)
    is_part: bool = False


def made_again(where: str) -> str:
    """Return what to do about an index file that cannot be used."""
    if is_remote(where):
        return "Fetch it again; if it is damaged there, too, tell who published it."
    shards = local_path(where).parent.glob("*.tar")
    if next(shards, None) is None:
        return "Run `stereogenbench index ROOT` again."
    return (
        "It is the index of shards: fetch it again or, where they were packed, run the same "
        "`stereogenbench pack` again, which keeps finished shards."
    )


def read_index_file(file: Path | pa.BufferReader, *, where: str) -> tuple[pa.Table, IndexHead]:
    """Return the rows of an index file, in one chunk, and its head as it is stored.

    Raises:
        StorageError: If it is not an index of this version, or was altered.
    """
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(file) as parquet:
            schema, footer = parquet.schema_arrow, parquet.metadata
        head = _parse_head((schema.metadata or {}).get(_METADATA_KEY), where=where)
        names = [name for name in schema.names if name != SEEK_COLUMN]
        _require_columns(schema, names, where=where)
        table = _with_added(_read_bounded(file, footer, schema, names, where=where))
        table = table.combine_chunks()
        table.validate(full=True)
        require_sound(table, where=where)
        if table_digest(table) != head.digest:
            raise _altered(where, "its rows were changed after they were written")
    except StorageError:
        raise
    except (pa.ArrowException, OSError, UnicodeDecodeError, LookupError) as error:
        if isinstance(error, OSError) and error.errno and cure_of(error):
            error = OSError(error.errno, os.strerror(error.errno))  # Arrow's text is long
            raise StorageError(describe_os_error(f"{where}: cannot be read", error)) from error
        raise StorageError(
            f"{where}: not a readable Parquet file ({error}). It was cut short or is something "
            f"else. {made_again(where)}"
        ) from error
    return table, head


def read_seek_tables(file: Path | pa.BufferReader) -> pa.BinaryArray | None:
    """Return the packed seek tables of an index file, a row each; None if it has none.

    They only speed up reading, so a column that is something else is as good as none.
    """
    import pyarrow.parquet as pq

    try:
        with pq.ParquetFile(file) as parquet:
            schema, footer = parquet.schema_arrow, parquet.metadata
        if schema.names.count(SEEK_COLUMN) != 1 or schema.field(SEEK_COLUMN).type != pa.binary():
            return None
        found = _read_bounded(file, footer, schema, [SEEK_COLUMN], where=SEEK_COLUMN)
        return one_array(found.column(SEEK_COLUMN))
    except (pa.ArrowException, OSError, LookupError):
        return None


def _require_columns(schema: pa.Schema, names: list[str], *, where: str) -> None:
    """Refuse columns that are not those of an index, before one of them is read."""
    odd = [
        name
        for name in names
        if names.count(name) > 1
        or name not in SCHEMA.names
        or not schema.field(name).equals(SCHEMA.field(name))
    ]
    odd += [name for name in SCHEMA.names if name not in (*names, *ADDED)]
    if odd:
        shown_odd = shortened(", ".join(odd), 300)
        raise _altered(where, f"its columns are not those of an index (see {shown_odd})")


def _read_bounded(
    file: Path | pa.BufferReader,
    footer: Any,
    schema: pa.Schema,
    names: list[str],
    *,
    where: str,
) -> pa.Table:
    """Return columns of a Parquet file if the memory they take fits its size.

    Equal values are stored once, so a small file may stand for any number of rows and for texts of
    any length. The footer says how much the columns take with each different text once. They are
    read so, and how much they take with every text is added up before they are spread out.

    Raises:
        StorageError: If they take more than a fixed allowance and a multiple of the file's size.
    """
    import pyarrow.parquet as pq

    size = file.size() if isinstance(file, pa.BufferReader) else file.stat().st_size
    most = _FREE_BYTES + _BYTES_A_BYTE * size
    texts: dict[str, None] = {}
    need = 0
    for group in map(footer.row_group, range(footer.num_row_groups)):
        need += _BYTES_A_ROW * group.num_rows
        for column in map(group.column, range(group.num_columns)):
            if column.path_in_schema.partition(".")[0] in names:
                need += column.total_uncompressed_size + 8 * column.num_values
                if column.physical_type == "BYTE_ARRAY":
                    texts[column.path_in_schema] = None
    plain = pa.schema([schema.field(name) for name in names])
    groups = [pa.Table.from_batches([], schema=plain)]  # `empty_table` would import pandas
    with pq.ParquetFile(
        file, metadata=footer, read_dictionary=[*texts], pre_buffer=True
    ) as parquet:
        for number in range(footer.num_row_groups):
            if need > most:
                break
            group = parquet.read_row_group(number, columns=names).replace_schema_metadata()
            need += sum(_text_bytes(chunk) for each in group.columns for chunk in each.chunks)
            if need <= most:
                groups.append(group.cast(plain))
    if need <= most:
        return pa.concat_tables(groups)
    raise _altered(
        where,
        f"its {footer.num_rows:,} rows take {need:,} bytes of memory or more, and an index of "
        f"{size:,} bytes may take {most:,}",
    )


def _text_bytes(values: Any) -> int:
    """Return how many bytes the texts of a column take, each as often as it occurs."""
    kind = values.type
    if pa.types.is_struct(kind):
        return sum(map(_text_bytes, values.flatten()))
    if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        return _text_bytes(values.flatten())
    if not pa.types.is_dictionary(kind):
        return 0
    lengths = as_numpy(pc.binary_length(values.dictionary)).astype(np.int64)
    return int(lengths[as_numpy(values.indices.drop_null())].sum())


def _with_added(table: pa.Table) -> pa.Table:
    """Return a table of an earlier version with the columns that came later, which say nothing."""
    missing = [SCHEMA.field(name) for name in ADDED if name not in table.column_names]
    for added in missing:
        table = table.append_column(added, pa.nulls(table.num_rows, added.type))
    return table.select(SCHEMA.names)


def write_index_file(
    path: Path, table: pa.Table, head: IndexHead, *, seek_tables: pa.BinaryArray | None = None
) -> None:
    """Write an index file, whole or not at all; it records its root as `recorded_root` says.

    Raises:
        StorageError: If it cannot be written.
    """
    description = {
        "format": _FORMAT,
        "root": recorded_root(head.root, beside=path.parent),
        "digest": head.digest,
        "incomplete": head.incomplete,
        "broken": head.broken,
        "part": head.is_part,
        "shards": {name: asdict(facts) for name, facts in sorted(head.shards.items())},
    }
    if seek_tables is not None and seek_tables.null_count < len(seek_tables):
        table = table.append_column(pa.field(SEEK_COLUMN, pa.binary()), seek_tables)
    described = table.replace_schema_metadata({_METADATA_KEY: json.dumps(description)})
    what = f"{path}: the index cannot be written"
    import pyarrow.parquet as pq

    with explain_os_errors(what, "Choose another place with --out."):
        path.parent.mkdir(parents=True, exist_ok=True)
        with open_atomic(path) as file:
            pq.write_table(described, file, compression="zstd")


def recorded_root(root: str, *, beside: Path) -> str:
    """Return the root as an index file in a folder records it: "." for that folder.

    Raises:
        StorageError: If it is a URL with a login or a query, which may be secrets.
    """
    if not is_remote(root):
        whole = local_path(root).resolve()
        return "." if beside.resolve() == whole else str(whole)
    if shown(root) != root:
        raise StorageError(
            f"{shown(root)}: the URL has a login or a query, which an index file does not keep: "
            f"copy the index that is beside the data."
        )
    return root


def table_of_scenes(scenes: Iterable[Scene], *, where: str) -> pa.Table:
    """Return a checked table of scenes, one row each, sorted by key.

    Raises:
        StorageError: If two scenes have the same key, or a path leads out of the root.
    """
    rows = sorted((row_of(scene) for scene in scenes), key=lambda row: str(row["key"]))
    try:
        table = pa.Table.from_pylist(rows, schema=SCHEMA)
    except (pa.ArrowException, UnicodeEncodeError, OverflowError) as error:
        raise StorageError(f"{where}: a scene does not fit the index: {error}.") from error
    require_sound(table, where=where)
    return table


def seek_tables_of(scenes: Iterable[Scene]) -> pa.BinaryArray:
    """Return the packed seek tables of scenes, in the order of `table_of_scenes`."""
    tables = {scene.id.key: scene.seek_tables for scene in scenes}
    return pa.array([tables[key] for key in sorted(tables)], type=pa.binary())


def _parse_head(metadata: bytes | None, *, where: str) -> IndexHead:
    """Return what an index file says besides its rows, if it is of this version."""
    try:
        head = json.loads(metadata or b"null")
    except (ValueError, RecursionError):
        head = None
    if not isinstance(head, dict):
        raise StorageError(
            f"{where}: a Parquet file, but not an index of this package. Pass another file, or "
            f"make one with `stereogenbench index ROOT`."
        )
    if head.get("format") != _FORMAT:
        raise StorageError(
            f"{where}: is an index of format {shortened(repr(head.get('format')))}, and this "
            f"version of the package reads format {_FORMAT}. {made_again(where)}"
        )
    reasons: list[Any] = [head.get("incomplete"), head.get("broken")]
    shards: Any = head.get("shards")
    kinds = {"size": int, "sha256": str, "members": int}
    is_right = (
        all(isinstance(each, dict) and all(type(text) is str for text in each.values())
            for each in reasons)
        and isinstance(head.get("root"), str)
        and isinstance(shards, dict)
        and not any(re.search(UNSAFE_PATH, path) for path in shards)
        and all(isinstance(facts, dict)
                and {name: type(each) for name, each in facts.items()} == kinds
                and min(facts["size"], facts["members"]) >= 0
                and max(facts["size"], facts["members"]) < _LARGEST
                for facts in shards.values())
    )  # fmt: skip
    if not is_right:
        raise _altered(where, "its description of itself was altered")
    return IndexHead(
        root=head["root"],
        digest=str(head.get("digest")),
        incomplete=head["incomplete"],
        broken=head["broken"],
        shards={path: ShardFacts(**facts) for path, facts in shards.items()},
        # An index of an earlier version that lies elsewhere may have been made of a part.
        is_part=head.get("part", head["root"] != ".") is True,
    )


def _altered(where: str, what: str) -> StorageError:
    return StorageError(f"{where}: {what}. The index was altered. {made_again(where)}")


def require_sound(table: pa.Table, *, where: str) -> None:
    """Refuse a table that is not an index, or whose paths could lead out of the root."""
    members = pc.list_flatten(table.column("members"))
    keys = table.column("key").to_pylist()
    for key, following in itertools.pairwise(keys):
        if key >= following:
            raise _altered(where, f"scene {shortened(following)!r} is listed twice or out of order")
    for paths, unfit in (
        (table.column("key"), UNSAFE_PATH),
        (pc.struct_field(members, "path"), UNSAFE_PATH),
        (pc.struct_field(members, "name"), f"{UNSAFE_PATH}|/"),
    ):
        unsafe = paths.filter(pc.match_substring_regex(paths, unfit))
        if len(unsafe):
            shown_path = shortened(unsafe[0].as_py())
            raise _altered(where, f"{shown_path!r} is not a path inside the data's root")
    for name, column in COLUMNS.items():
        _require_allowed(name, table.column(name), column.allowed, where=where)
    for values, allowed_of in (
        (members, {"name": None, "path": None, "offset": _OF_BYTES, "size": _OF_BYTES}),
        (pc.list_flatten(table.column("remarks")), {"text": None, "about": _ABOUT}),
    ):
        for name, allowed in allowed_of.items():
            _require_allowed(name, pc.struct_field(values, name), allowed, where=where)
    for text in pc.unique(table.column("conventions")).drop_null().to_pylist():
        try:
            declaration_of_text(text)
        except (SchemaError, ValueError, RecursionError) as error:
            raise _odd(where, "conventions", text, f"not understood ({error})") from error


def _require_allowed(
    name: str, values: Any, allowed: tuple[float, float] | str | None, *, where: str
) -> None:
    """Refuse numbers out of bounds, and texts of another pattern."""
    values = one_array(values).drop_null()
    kind = values.type
    if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        values = values.flatten()
    if pa.types.is_string(values.type):
        length = pc.max(pc.utf8_length(values)).as_py() or 0
        if length > MOST_LETTERS:
            told = f"{name} of a scene has {length:,} letters, and it may have {MOST_LETTERS:,}"
            raise _altered(where, told)
    if isinstance(allowed, str):
        odd = values.filter(pc.invert(pc.match_substring_regex(values, allowed))).to_pylist()
        if odd:
            raise _odd(where, name, odd[0], f"not {allowed}")
    elif allowed is not None:
        numbers, (least, most) = as_numpy(values), allowed
        is_unknown = np.isnan(numbers) if name in _MAY_BE_NAN else False
        odd = numbers[~(is_unknown | ((numbers >= least) & (numbers <= most)))]
        if len(odd):
            bounds = [each if isinstance(each, int) else f"{each:g}" for each in (least, most)]
            raise _odd(where, name, odd[0].item(), f"not {bounds[0]} to {bounds[1]}")


_OF_BYTES: Final = (0, 2**61)
_ABOUT: Final = f"^({'|'.join(REMARKS)})$"
_MAY_BE_NAN: Final = ("depth_unit_m", "psnr_db", "worst_psnr_db")


def _odd(where: str, name: str, found: Any, why: str) -> StorageError:
    return _altered(where, f"{name} is {shortened(repr(found))}, {why}")
