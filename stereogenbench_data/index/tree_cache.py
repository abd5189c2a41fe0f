"""What was found out about trees without an index, kept in the user's cache folder.

    <cache>/stereogenbench/trees/<digest of the root>/
        presumed-<digest of the listing>.parquet   the rows, as an index file
        scenes/ab/<digest of the scene's files>    the row of a scene that was described
        listing/ab/<digest of the folder>          what a commit of the Hub holds
        files/ab/<digest of path and ETag>         a small file of a scene behind a URL

The listing is the path, size and modification time of every file, so what is kept is used only for
unchanged files. Any number of processes, of several machines too, may read and write: files are
renamed into place, whole or not at all, and one that is damaged or cannot be written is as good as
none.
"""

import hashlib
import json
import os
import sys
import zlib
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

import pyarrow as pa

from stereogenbench_data.errors import StorageError
from stereogenbench_data.index.arrow import table_digest
from stereogenbench_data.index.parquet import (
    IndexHead,
    read_index_file,
    read_seek_tables,
    write_index_file,
)
from stereogenbench_data.index.rows import SCHEMA
from stereogenbench_data.sources.files import write_atomic
from stereogenbench_data.sources.location import is_remote

VARIABLE: Final = "STEREOGENBENCH_CACHE"
"""The environment variable that names another folder for the cache, or is "off"."""

_FORMAT: Final = 2
_MOST_TABLES: Final = 8
"""So many selections of a tree are kept: each has a table of its own."""


def cache_folder() -> Path | None:
    """Return the user's cache folder for this package, None where there is none or it is off."""
    named = os.environ.get(VARIABLE)
    if named is not None:
        return None if named.strip().lower() in ("", "off") else Path(named)
    places = {"darwin": "~/Library/Caches", "win32": os.environ.get("LOCALAPPDATA", "~")}
    usual = os.environ.get("XDG_CACHE_HOME") or places.get(sys.platform, "~/.cache")
    folder = Path(usual).expanduser()
    return folder / "stereogenbench" if folder.is_absolute() else None


class TreeCache:
    """What is kept of one tree; nothing where there is no cache folder."""

    def __init__(self, root: str | Path, read_as: str = "") -> None:
        """Name the tree, and the conventions it is read by; nothing is read or written yet."""
        base = cache_folder()
        # What another version understood of the same files may differ.
        made_by = ""
        with suppress(PackageNotFoundError):  # of a checkout that is not installed
            made_by = version("stereogenbench-data")
        place = str(root) if is_remote(root) else os.path.realpath(root)
        what = [_FORMAT, made_by, SCHEMA.names, place, read_as]
        self._folder = None if base is None else base / "trees" / _digest(json.dumps(what))

    def table(self, name: str) -> tuple[pa.Table, IndexHead, pa.BinaryArray | None] | None:
        """Return the rows that were kept under a name, and what an index knows besides."""
        if self._folder is None:
            return None
        path = self._folder / f"{name}.parquet"
        try:
            table, head = read_index_file(path, where=str(path))
        except (StorageError, OSError):
            return None
        if head.digest != table_digest(table):
            return None
        with suppress(OSError):
            os.utime(path)
        return table, head, read_seek_tables(path)

    def keep_table(
        self, name: str, table: pa.Table, head: IndexHead, seek_tables: pa.BinaryArray | None
    ) -> None:
        """Keep rows under a name, in place of those that were used longest ago."""
        if self._folder is None:
            return
        with suppress(StorageError, OSError):
            write_index_file(self._folder / f"{name}.parquet", table, head, seek_tables=seek_tables)
            tables = sorted(self._folder.glob("*.parquet"), key=lambda path: path.stat().st_mtime)
            for old in tables[:-_MOST_TABLES]:
                old.unlink(missing_ok=True)

    def read(self, kind: str, name: str) -> bytes | None:
        """Return what was kept under a kind and a name; None if there is none, or it is damaged."""
        if self._folder is not None:
            with suppress(OSError, zlib.error):
                return zlib.decompress(self._place(kind, name).read_bytes())
        return None

    def keep(self, kind: str, name: str, content: bytes) -> None:
        """Keep bytes under a kind and a name, which changes with what they were made of."""
        if self._folder is not None:
            place = self._place(kind, name)
            with suppress(OSError):
                place.parent.mkdir(parents=True, exist_ok=True)
                write_atomic(place, zlib.compress(content, 1))

    def _place(self, kind: str, name: str) -> Path:
        digest = _digest(name)
        return Path(self._folder or "", kind, digest[:2], digest)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:32]
