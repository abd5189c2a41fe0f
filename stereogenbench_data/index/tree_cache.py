"""What was found out about trees without an index, kept in the user's cache.

    <cache>/stereogenbench/trees/<digest of the root>/
        settled-<digest of the listing>.parquet    the rows, as an index file
        scenes/ab/<digest of the scene's files>    the row of a scene that was opened
        odd/ab/<digest of a table's name>          the files of its scenes that cannot be used
        listing/ab/<digest of the folder>          what a commit of the Hub holds
        files/ab/<digest of path and ETag>         a small file of a scene behind a URL

The listing is the times of every folder and its ``baseline.json``; where all scenes are opened,
behind a URL, and of scenes that cannot be used, those of every file. What it does not tell is
compared when a scene is first used. What is kept is used by the same code alone. Any number of
processes, of several machines too, may read and write: files are renamed into place, whole or not
at all, and a damaged one counts as missing.
"""

import functools
import hashlib
import json
import os
import sys
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

import pyarrow as pa

from stereogenbench_data.errors import StorageError
from stereogenbench_data.index.parquet import (
    IndexHead,
    read_index_file,
    read_seek_tables,
    write_index_file,
)
from stereogenbench_data.sources.files import write_atomic
from stereogenbench_data.sources.location import is_remote

CACHE_VARIABLE: Final = "STEREOGENBENCH_CACHE"
"""The environment variable that names another folder for the cache, or is "off"."""

_MOST_TABLES: Final = 8
"""So many selections of a tree are kept: each has a table of its own."""


def cache_folder() -> Path | None:
    """Return the user's cache folder for this package, None where there is none or it is off."""
    named = os.environ.get(CACHE_VARIABLE)
    if named is not None:
        return None if named.strip().lower() in ("", "off") else Path(named)
    places = {"darwin": "~/Library/Caches", "win32": os.environ.get("LOCALAPPDATA", "~")}
    usual = os.environ.get("XDG_CACHE_HOME") or places.get(sys.platform, "~/.cache")
    folder = Path(usual).expanduser()
    return folder / "stereogenbench" if folder.is_absolute() else None


class TreeCache:
    """What is kept of one tree; nothing of None, or where there is no cache folder."""

    def __init__(self, root: str | Path | None, read_as: str = "") -> None:
        """Name the tree, and the conventions it is read by; nothing is read or written yet."""
        self._folder = Path(os.devnull)  # below a device nothing can be read or kept
        base = None if root is None else cache_folder()
        if root is not None and base is not None:
            place = str(root) if is_remote(root) else os.path.realpath(root)
            what = json.dumps([_own_code(), place, read_as])
            self._folder = base / "trees" / _digest(what)

    def table(self, name: str) -> tuple[pa.Table, IndexHead, pa.BinaryArray | None] | None:
        """Return the rows that were kept under a name, and what an index knows besides."""
        path = self._folder / f"{name}.parquet"
        try:
            table, head = read_index_file(path, where=str(path))
        except (StorageError, OSError):
            return None
        with suppress(OSError):
            os.utime(path)
        return table, head, read_seek_tables(path)

    def keep_table(
        self, name: str, table: pa.Table, head: IndexHead, seek_tables: pa.BinaryArray | None
    ) -> None:
        """Keep rows under a name, in place of those that were used longest ago."""
        with suppress(StorageError, OSError):
            write_index_file(self._folder / f"{name}.parquet", table, head, seek_tables=seek_tables)
            tables = sorted(self._folder.glob("*.parquet"), key=lambda path: path.stat().st_mtime)
            for old in tables[:-_MOST_TABLES]:
                old.unlink(missing_ok=True)

    def forget_tables(self) -> None:
        """Remove all rows, as files have changed that no listing tells."""
        with suppress(OSError):
            for table in self._folder.glob("*.parquet"):
                table.unlink(missing_ok=True)

    def read(self, kind: str, name: str) -> bytes | None:
        """Return what was kept under a kind and a name; None if there is none, or it is damaged."""
        with suppress(OSError, zlib.error):
            return zlib.decompress(self._place(kind, name).read_bytes())
        return None

    def keep(self, kind: str, name: str, content: bytes) -> None:
        """Keep bytes under a kind and a name, which changes with what they were made of."""
        place = self._place(kind, name)
        with suppress(OSError):
            place.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(place, zlib.compress(content, 1), flush_to="system")

    def once(self, kind: str, name: str, find: Callable[[], bytes]) -> bytes:
        """Return what was kept under a kind and a name, or find it now and keep it."""
        found = self.read(kind, name)
        if found is None:
            found = find()
            self.keep(kind, name, found)
        return found

    def forget(self, kind: str, name: str) -> None:
        """Remove what was kept under a kind and a name."""
        with suppress(OSError):
            self._place(kind, name).unlink()

    def _place(self, kind: str, name: str) -> Path:
        digest = _digest(name)
        return self._folder / kind / digest[:2] / digest


@functools.cache
def _own_code() -> str:
    """Return a digest of the code that reads scenes: other code may understand files otherwise."""
    code = hashlib.sha256()
    for layer in ("schema", "geometry", "media", "index"):
        for path in sorted(Path(__file__).parents[1].joinpath(layer).rglob("*.py")):
            code.update(path.read_bytes())
    return code.hexdigest()


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:32]


NOTHING_KEPT: Final = TreeCache(None)
