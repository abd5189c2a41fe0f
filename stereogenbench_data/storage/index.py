"""The index: one row a scene, with all that selection and loading ask before a video is opened.

On disk it is one Parquet file; in memory one Arrow table, sorted by key. Paths are relative to the
data's root and never leave it.
"""

import itertools
import json
import os
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from stereogenbench_data.errors import StorageError
from stereogenbench_data.schema.records import Scene, ShardFacts
from stereogenbench_data.storage.digest import table_digest
from stereogenbench_data.storage.rows import SCHEMA, row_of, scene_of
from stereogenbench_data.storage.source import UNSAFE_PATH
from stereogenbench_data.storage.walk import TreeReport, walk

INDEX_NAME: Final = "index.parquet"
_FORMAT: Final = 1
_METADATA_KEY: Final = b"stereogenbench_data.index"
_AGAIN: Final = "Run `stereogenbench index ROOT` again."
_SHOWN: Final = 10


class IncompleteSceneWarning(UserWarning):
    """Some scenes of the data cannot be used: the message names them and says why."""


class SceneIndex:
    """The scenes of one root, by row; rows are sorted by key.

    Attributes:
        root: The folder to which the members' paths are relative.
        incomplete: Key to reason, for scenes that were not finished when the index was made.
        broken: Key to what is wrong, for scenes that were left out for it.
        shards: What is known of each shard, by its path below the root; empty for folders.
    """

    def __init__(self, table: pa.Table, *, root: str | Path, head: Mapping[str, Any]) -> None:
        """Take a checked table; use `open` or `from_scenes` to make an index."""
        self.root = str(root)
        self.incomplete: dict[str, str] = dict(head.get("incomplete", {}))
        self.broken: dict[str, str] = dict(head.get("broken", {}))
        self.shards: dict[str, ShardFacts] = {
            path: ShardFacts(**facts) for path, facts in head.get("shards", {}).items()
        }
        self._table = table
        self._columns: dict[str, np.ndarray] = {}
        self._digest = ""

    @classmethod
    def open(cls, data: str | Path) -> "SceneIndex":
        """Return the index of some data.

        Args:
            data: An index file; a folder that holds ``index.parquet``; or a folder in the
                released layout, which is then walked (seconds for hundreds of scenes, minutes
                for all: ``stereogenbench index`` keeps the result).

        Raises:
            StorageError: If there is no such data, it holds no scene, the index is damaged or
                was made by another version, or scenes of a tree are broken.
        """
        if "://" in str(data):
            raise StorageError(
                f"{data}: a URL cannot be opened; fetch the data and pass the folder."
            )
        path = Path(data)
        if path.is_dir():
            if not (path / INDEX_NAME).is_file():
                return cls._from_tree(path)
            path /= INDEX_NAME
        elif not path.is_file():
            raise StorageError(
                f"{path}: does not exist; expected an index file, a folder with {INDEX_NAME} or "
                f"a folder in the released layout."
            )
        index = cls._from_file(path)
        _warn_of(index.incomplete | index.broken, where=str(path))
        return index

    @classmethod
    def from_scenes(
        cls,
        scenes: Iterable[Scene],
        root: str | Path,
        *,
        shards: Mapping[str, ShardFacts] | None = None,
    ) -> "SceneIndex":
        """Return the index of some scenes, in whatever order they come.

        Args:
            scenes: The scenes, with the places of their members.
            root: The folder to which these places are relative.
            shards: What is known of each shard, where the members lie in shards.

        Raises:
            StorageError: If two scenes have one key, or a path leaves the root.
        """
        rows = sorted((row_of(scene) for scene in scenes), key=lambda row: str(row["key"]))
        try:
            table = pa.Table.from_pylist(rows, schema=SCHEMA)
        except (pa.ArrowException, UnicodeEncodeError, OverflowError) as error:
            raise StorageError(f"{root}: a scene does not fit the index: {error}.") from error
        _require_sound(table, where=str(root))
        index = cls(table, root=root, head={})
        index.shards = dict(shards or {})
        return index

    @classmethod
    def from_report(cls, report: TreeReport) -> "SceneIndex":
        """Return the index of the scenes that a walk found, with those that it left out."""
        index = cls.from_scenes(report.scenes, report.root)
        index.incomplete, index.broken = report.incomplete, report.broken
        return index

    @classmethod
    def _from_tree(cls, root: Path) -> "SceneIndex":
        report = walk(root)
        if report.broken:
            raise StorageError(
                f"{root}: {_listed(report.broken)}\nRepair or remove them; or leave them out on "
                f"purpose: `stereogenbench index {root}` makes an index without them."
            )
        if not report.scenes:
            raise StorageError(f"{root}: no scene is finished: {_listed(report.incomplete)}")
        _warn_of(report.incomplete, where=str(root))
        return cls.from_report(report)

    @classmethod
    def _from_file(cls, path: Path) -> "SceneIndex":
        try:
            with pq.ParquetFile(path) as file:
                metadata = (file.schema_arrow.metadata or {}).get(_METADATA_KEY)
                head = _require_head(metadata, where=str(path))
                table = file.read().replace_schema_metadata().combine_chunks()
            table.validate(full=True)
        except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
            if isinstance(error, StorageError):
                raise
            raise StorageError(
                f"{path}: is no Parquet file that can be read ({error}). It was cut short or is "
                f"something else. {_AGAIN}"
            ) from error
        _require_sound(table, where=str(path))
        index = cls(table, root=_root_of(path, head, table), head=head)
        if index.digest != head.get("digest"):
            raise StorageError(f"{path}: its rows are not those that were written. {_AGAIN}")
        return index

    def write(self, path: str | Path) -> None:
        """Write the index as one Parquet file, whole or not at all.

        Where the file lies in the root itself, data and index can be moved together; else it
        remembers where the root is.

        Raises:
            StorageError: If the file cannot be written.
        """
        path, root = Path(path), Path(self.root)
        head = {
            "format": _FORMAT,
            "root": "." if path.parent.resolve() == root.resolve() else str(root.resolve()),
            "digest": self.digest,
            "incomplete": self.incomplete,
            "broken": self.broken,
            "shards": {path: asdict(facts) for path, facts in sorted(self.shards.items())},
        }
        table = self._table.replace_schema_metadata({_METADATA_KEY: json.dumps(head)})
        unfinished = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                pq.write_table(table, unfinished, compression="zstd")
                unfinished.replace(path)
            finally:
                unfinished.unlink(missing_ok=True)
        except OSError as error:
            raise StorageError(
                f"{path}: the index cannot be written ({error.strerror or error}). Choose "
                f"another place with --out."
            ) from error

    def __len__(self) -> int:
        """The number of scenes."""
        return int(self._table.num_rows)

    def scene(self, row: int) -> Scene:
        """Return the scene of a row.

        Raises:
            StorageError: If there is no such row.
        """
        if not 0 <= row < len(self):
            raise StorageError(f"{self.root}: there is no row {row}; the index has {len(self)}.")
        return scene_of(self._table.slice(int(row), 1).to_pylist()[0])

    def column(self, name: str) -> np.ndarray:
        """Return a column as a read-only array; `rows.SCHEMA` names them all but ``members``.

        Returns:
            (n,) numbers or, for texts, objects (None where a text is not known; nan where a
            number is not); (n, 15) float64 for ``baselines_cm``, (n, 6) for the columns with one
            value a camera.

        Raises:
            StorageError: If there is no such column.
        """
        if name not in self._columns:
            if name not in SCHEMA.names or name == "members":
                known = ", ".join(column for column in SCHEMA.names if column != "members")
                raise StorageError(f"the index has no column {name!r}; it has {known}.")
            self._columns[name] = _array(self._table.column(name).combine_chunks())
        return self._columns[name]

    @property
    def digest(self) -> str:
        """A sha256 of the rows, the same wherever and by whatever version they were written."""
        if not self._digest:
            self._digest = table_digest(self._table)
        return self._digest

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy in another process needs."""
        return self.__dict__ | {"_columns": {}}


def _array(values: Any) -> np.ndarray:
    values = values.chunk(0) if isinstance(values, pa.ChunkedArray) else values
    kind = values.type
    if pa.types.is_fixed_size_list(kind):
        flat = values.flatten().to_numpy(zero_copy_only=False)
        array = flat.reshape(-1, kind.list_size)
    else:
        array = values.to_numpy(zero_copy_only=False)
    array = np.array(array) if array.flags.writeable else array
    array.setflags(write=False)
    return array


def _listed(left_out: Mapping[str, str]) -> str:
    lines = [
        reason if key in reason else f"{key}: {reason}" for key, reason in sorted(left_out.items())
    ]
    if len(lines) > _SHOWN:
        lines[_SHOWN:] = [f"and {len(lines) - _SHOWN} more"]
    count = f"{len(left_out)} scene{'s' if len(left_out) > 1 else ''} cannot be used:"
    return "\n  ".join([count, *lines])


def _warn_of(left_out: Mapping[str, str], *, where: str) -> None:
    if left_out:
        warnings.warn(f"{where}: {_listed(left_out)}", IncompleteSceneWarning, stacklevel=3)


def _require_head(metadata: bytes | None, *, where: str) -> dict[str, Any]:
    """Return what an index says of itself, once it is known to be one of this version."""
    try:
        head = json.loads(metadata or b"null")
    except ValueError:
        head = None
    if not isinstance(head, dict):
        raise StorageError(
            f"{where}: is a Parquet file, but no index of this package. Pass another file, or "
            f"make one with `stereogenbench index ROOT`."
        )
    if head.get("format") != _FORMAT:
        raise StorageError(
            f"{where}: is an index of format {head.get('format')!r}, and this version of the "
            f"package reads format {_FORMAT}. {_AGAIN}"
        )
    tables = [head.get("incomplete"), head.get("broken"), head.get("shards")]
    if not all(isinstance(each, dict) for each in tables) or not isinstance(head["root"], str):
        raise StorageError(f"{where}: its description of itself was altered. {_AGAIN}")
    return head


def _require_sound(table: pa.Table, *, where: str) -> None:
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
            f"{_AGAIN}"
        )
    keys = table.column("key").to_pylist()
    for key, following in itertools.pairwise(keys):
        if key >= following:
            raise StorageError(f"{where}: scene {following!r} is there twice or out of order.")
    members = pc.list_flatten(table.column("members"))
    for paths in (table.column("key"), pc.struct_field(members, "path")):
        unsafe = paths.filter(pc.match_substring_regex(paths, UNSAFE_PATH))
        if len(unsafe):
            raise StorageError(
                f"{where}: {unsafe[0].as_py()!r} is no path inside the data's root. The index "
                f"was altered. {_AGAIN}"
            )
    for name, numbers, least in (
        ("frames", table.column("frames"), 1),
        ("size", pc.struct_field(members, "size"), 0),
        ("offset", pc.struct_field(members, "offset"), 0),
    ):
        lowest = pc.min(numbers).as_py()
        if lowest is not None and lowest < least:
            raise StorageError(f"{where}: {name} is {lowest}, below {least}. {_AGAIN}")


def _root_of(path: Path, head: Mapping[str, Any], table: pa.Table) -> Path:
    """Return the data's root: the index's own folder if the data are there, else the recorded."""
    beside, recorded = path.parent, Path(head["root"])
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
