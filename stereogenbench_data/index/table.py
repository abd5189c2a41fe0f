"""The index: one row a scene, with all that selection and loading ask before a video is opened.

On disk it is one Parquet file; in memory one Arrow table, sorted by key. Paths are relative to the
data's root and never leave it.
"""

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from stereogenbench_data.errors import StorageError
from stereogenbench_data.index.arrow_arrays import as_numpy
from stereogenbench_data.index.build import TreeReport, walk
from stereogenbench_data.index.digest import table_digest
from stereogenbench_data.index.parquet import (
    made_again,
    read_index_file,
    require_sound,
    root_of,
    root_told,
    write_index_file,
)
from stereogenbench_data.index.remote_tree import find_remote_scenes
from stereogenbench_data.index.rows import SCHEMA, row_of, scene_of
from stereogenbench_data.index.stale import (
    Indexed,
    StaleIndexWarning,
    stale_message,
)
from stereogenbench_data.schema.records import Scene, ShardFacts
from stereogenbench_data.sources.filesystems import MissingObject
from stereogenbench_data.sources.location import (
    is_remote,
    joined,
    local_path,
    shown,
    split_name,
)
from stereogenbench_data.sources.remote import RemoteObject
from stereogenbench_data.sources.retry import RetryPolicy

INDEX_NAME: Final = "index.parquet"
MAX_INDEX_BYTES: Final = 256 * 2**20
"""The largest index that is fetched. One of 8,493 scenes has a few megabytes."""

MOST_REMOTE_SCENES: Final = 64
"""The most scenes behind a URL that are described when a tree without an index is opened."""

_SHOWN: Final = 10


class IncompleteSceneWarning(UserWarning):
    """Some scenes of the data cannot be used: the message names them and says why."""


class SceneIndex:
    """The scenes of one root, by row; rows are sorted by key.

    Attributes:
        root: The folder or URL to which the members' paths are relative, with its login if it has
            one; `where` is what may be shown.
        retry: How reading from a URL deals with a slow or failing server; None for the defaults.
        incomplete: Key to reason, for scenes that were not finished when the index was made.
        broken: Key to what is wrong, for scenes that were left out for it.
        shards: What is known of each shard, by its path below the root; empty for folders.
        is_part: Whether it was made of a part of the root on purpose.
        passed_over: Keys of scenes that the root holds and the index leaves out on purpose.
        stale: What the root holds that the index does not know, or lacks of it, and the cure;
            empty where nothing of that can be seen. A URL is not looked at.
    """

    def __init__(self, table: pa.Table, *, root: str | Path, head: Mapping[str, Any]) -> None:
        """Take a checked table; use `open` or `from_scenes` to make an index."""
        self.root = str(root)
        self.retry: RetryPolicy | None = None
        self.incomplete: dict[str, str] = dict(head.get("incomplete", {}))
        self.broken: dict[str, str] = dict(head.get("broken", {}))
        self.shards: dict[str, ShardFacts] = {
            path: ShardFacts(**facts) for path, facts in head.get("shards", {}).items()
        }
        # An index of an earlier version that lies elsewhere may have been made of a part.
        self.is_part: bool = head.get("part", head.get("root", ".") != ".") is True
        self.passed_over: tuple[str, ...] = tuple(map(str, head.get("passed_over", ())))
        self.stale = ""
        self._table = table
        self._columns: dict[str, np.ndarray] = {}
        self._digest = ""

    @classmethod
    def open(
        cls,
        data: str | Path,
        *,
        root: str | Path | None = None,
        retry: RetryPolicy | None = None,
    ) -> "SceneIndex":
        """Return the index of some data.

        Data are looked for beside the index first. An index that was written elsewhere remembers
        where its data are, but a file may be anybody's: without ``root`` it is believed only if it
        names a folder below its own, or a plain URL (``https://``, ``http://``, ``hf://``,
        ``s3://``) without a login that is not of this machine's own network.

        Args:
            data: An index file; a folder that holds ``index.parquet``, such as one of shards; the
                URL of either (``https://``, ``hf://datasets/``, ``s3://`` or whatever fsspec
                opens), of which only the index is fetched; or a folder in the released layout,
                which is then walked (seconds for hundreds of scenes, minutes for all:
                ``stereogenbench index`` keeps the result).
            root: Where the data of an index file are, on your word and whatever the file says: any
                folder or URL.
            retry: How often to try a server that fails, and how slow it may be.

        Raises:
            StorageError: If there is no such data, it holds no scene, the index is damaged or
                was made by another version, its data are where only your word lets them be opened,
                or scenes of a tree are broken.
        """
        index = cls._opened(data, root=None if root is None else _root_said(root), retry=retry)
        where = shown(data) if is_remote(data) else str(local_path(data))
        _warn_of(index.incomplete | index.broken, where=where)
        if index.stale:
            warnings.warn(index.stale, StaleIndexWarning, stacklevel=2)
        index.retry = retry
        return index

    @classmethod
    def _opened(
        cls, data: str | Path, *, root: str | None, retry: RetryPolicy | None
    ) -> "SceneIndex":
        if is_remote(data):
            return cls._from_url(str(data), root=root, retry=retry)
        path = local_path(data)
        if path.is_dir():
            if not (path / INDEX_NAME).is_file():
                _require_no_root(path, root)
                return cls._from_tree(path)
            path /= INDEX_NAME
        elif not path.is_file():
            raise StorageError(
                f"{path}: does not exist; expected an index file, a folder with {INDEX_NAME} or "
                f"a folder in the released layout."
            )
        return cls._from_file(path, root=root)

    @classmethod
    def from_scenes(
        cls,
        scenes: Iterable[Scene],
        root: str | Path,
        *,
        shards: Mapping[str, ShardFacts] | None = None,
        retry: RetryPolicy | None = None,
    ) -> "SceneIndex":
        """Return the index of some scenes, in whatever order they come.

        Args:
            scenes: The scenes, with the places of their members.
            root: The folder to which these places are relative.
            shards: What is known of each shard, where the members lie in shards.
            retry: As for `open`.

        Raises:
            StorageError: If two scenes have one key, or a path leaves the root.
        """
        rows = sorted((row_of(scene) for scene in scenes), key=lambda row: str(row["key"]))
        try:
            table = pa.Table.from_pylist(rows, schema=SCHEMA)
        except (pa.ArrowException, UnicodeEncodeError, OverflowError) as error:
            raise StorageError(
                f"{shown(str(root))}: a scene does not fit the index: {error}."
            ) from error
        require_sound(table, where=shown(str(root)))
        index = cls(table, root=root, head={})
        index.shards, index.retry = dict(shards or {}), retry
        return index

    @classmethod
    def from_report(cls, report: TreeReport) -> "SceneIndex":
        """Return the index of the scenes that a walk found, with those that it left out."""
        index = cls.from_scenes(report.scenes, report.root)
        index.incomplete, index.broken = report.incomplete, report.broken
        index.is_part = report.is_part
        return index

    @classmethod
    def _from_tree(cls, root: str | Path) -> "SceneIndex":
        # In this process: a script without `if __name__ == "__main__"` could start no others.
        report, where = walk(root, workers=1), shown(root)
        if report.broken:
            raise StorageError(
                f"{where}: {_listed(report.broken)}\nRepair or remove them; or leave them out on "
                f"purpose: `stereogenbench index {where}` makes an index without them."
            )
        if not report.scenes:
            raise StorageError(f"{where}: no scene is finished: {_listed(report.incomplete)}")
        return cls.from_report(report)

    @classmethod
    def _from_file(cls, path: Path, *, root: str | None) -> "SceneIndex":
        table, head = read_index_file(path, where=str(path))
        place = root_of(path, head, table) if root is None else root
        index = cls._checked(table, head, root=place, where=str(path))
        index._look_around(path)
        return index

    @classmethod
    def _from_url(cls, url: str, *, root: str | None, retry: RetryPolicy | None) -> "SceneIndex":
        """Fetch an index; its data lie beside it, unless the user says where."""
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
            return cls._from_remote_tree(beside)
        if size > MAX_INDEX_BYTES:
            raise StorageError(
                f"{remote.where}: an index may have {MAX_INDEX_BYTES:,} bytes, this one has "
                f"{size:,}. It was not read: is it another file?"
            )
        content = pa.BufferReader(remote.read(0, size))
        table, head = read_index_file(content, where=remote.where)
        return cls._checked(table, head, root=root or beside, where=remote.where)

    @classmethod
    def _from_remote_tree(cls, root: str) -> "SceneIndex":
        """Walk a tree behind a URL, if it is small enough to be walked each time it is opened."""
        found = find_remote_scenes(root)
        if len(found.keys) > MOST_REMOTE_SCENES:
            raise StorageError(
                f"{shown(root)}: has no {INDEX_NAME}, and the headers of {len(found.keys)} scenes "
                "are too many to be fetched each time. Index it once, or the part you need: "
                f"`stereogenbench index {shown(root)} -o index.parquet --split eval`, and open "
                "that file."
            )
        return cls._from_tree(root)

    @classmethod
    def _checked(
        cls, table: pa.Table, head: Mapping[str, Any], *, root: str | Path, where: str
    ) -> "SceneIndex":
        """Return the index that a file's rows and its description of itself are."""
        index = cls(table, root=root, head=head)
        if index.digest != head.get("digest"):
            raise StorageError(
                f"{where}: its rows are not those that were written. {made_again(where)}"
            )
        return index

    def _folders(self) -> list[str]:
        """Return the folder of each scene's first file, below the root."""
        members = self._table.column("members").combine_chunks()
        first = pc.struct_field(members.values, "path").take(members.offsets[:-1])
        return [path.rpartition("/")[0] for path in first.to_pylist()]

    def _look_around(self, path: Path) -> None:
        """Compare what is indexed with what its folder holds now, by names."""
        if is_remote(self.root):
            return
        # Of scenes in folders, the folders that their files are in, which may have other names.
        keys = self.column("key").tolist() if self.shards else self._folders()
        indexed = Indexed(
            keys=keys,
            passed_over={*self.incomplete, *self.broken, *self.passed_over},
            unfinished=self.incomplete.keys(),
            shards=self.shards.keys(),
            is_part=self.is_part,
        )
        self.stale = stale_message(Path(self.root), indexed, index_file=path)

    def write(self, path: str | Path) -> None:
        """Write the index as one Parquet file, whole or not at all.

        Where the file lies in the root itself, data and index can be moved together; else it
        remembers where the root is.

        Raises:
            StorageError: If the file cannot be written.
        """
        path = Path(path)
        description = {
            "root": root_told(self.root, beside=path.parent),
            "digest": self.digest,
            "incomplete": self.incomplete,
            "broken": self.broken,
            "part": self.is_part,
            "passed_over": list(self.passed_over),
            "shards": {path: asdict(facts) for path, facts in sorted(self.shards.items())},
        }
        write_index_file(path, self._table, description)

    @property
    def where(self) -> str:
        """The root as messages, reports and other files show it: without login and query."""
        return shown(self.root)

    def __len__(self) -> int:
        """The number of scenes."""
        return int(self._table.num_rows)

    def scene(self, row: int) -> Scene:
        """Return the scene of a row.

        Raises:
            StorageError: If there is no such row.
        """
        if not 0 <= row < len(self):
            raise StorageError(f"{self.where}: there is no row {row}; the index has {len(self)}.")
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

    def video_counts(self) -> np.ndarray:
        """Return how many videos each scene has, (n,) int64: below 12 in a part of a release."""
        lists = self._table.column("members").combine_chunks()
        lists = lists.chunk(0) if isinstance(lists, pa.ChunkedArray) else lists
        names = pc.struct_field(lists.flatten(), "name")
        is_video = as_numpy(pc.starts_with(names, "cam_"))
        rows = as_numpy(pc.list_parent_indices(lists))
        return np.bincount(rows[is_video], minlength=len(self))

    @property
    def digest(self) -> str:
        """A sha256 of the rows, the same wherever and by whatever version they were written."""
        if not self._digest:
            self._digest = table_digest(self._table)
        return self._digest

    def parted(self) -> tuple[pa.Table, dict[str, Any]]:
        """Return the rows, and all else that `of_parts` needs: for who shares the rows."""
        rest = self.__getstate__()
        return rest.pop("_table"), rest

    @classmethod
    def of_parts(cls, table: pa.Table, rest: Mapping[str, Any]) -> "SceneIndex":
        """Return the index that was `parted`, over the same rows wherever they lie."""
        index = cls.__new__(cls)
        index.__dict__.update(rest, _table=table)
        return index

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy in another process needs."""
        return self.__dict__ | {"_columns": {}}


def _root_said(root: str | Path) -> str:
    """Return a root that the user names: whatever URL it is, or a folder.

    Raises:
        StorageError: If it is a path, and no folder.
    """
    if is_remote(root):
        return str(root)
    folder = local_path(root)
    if not str(root) or not folder.is_dir():
        raise StorageError(
            f"{str(root)!r}: is no folder, and was named as the root of an index's data. Name the "
            f"folder, or the URL, to which the paths in the index are relative."
        )
    return str(folder)


def _require_no_root(where: str | Path, root: str | None) -> None:
    if root is not None:
        raise StorageError(
            f"{where}: has no {INDEX_NAME}, and a root was named for the data of one. Leave root "
            f"out, or pass the index file."
        )


def warn_if_stale(root: str | Path) -> None:
    """Warn if a folder has an index that does not know what was just written into it."""
    path = local_path(root) / INDEX_NAME
    if not path.is_file():
        return
    try:
        stale = SceneIndex._from_file(path, root=None).stale
    except StorageError:
        return  # an index that cannot be read says so to whoever opens it
    if stale:
        warnings.warn(stale, StaleIndexWarning, stacklevel=3)


def _array(values: Any) -> np.ndarray:
    values = values.chunk(0) if isinstance(values, pa.ChunkedArray) else values
    array = as_numpy(values)
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
