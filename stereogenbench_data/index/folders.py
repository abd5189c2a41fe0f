"""One scene's folder, on this machine or behind a URL: its files, their bytes, and its videos.

Behind a URL several files are fetched at a time, of large videos both ends alone; small files may
be kept in the user's cache by path, size and digest.
"""

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final, TypeVar

from stereogenbench_data.errors import StorageError, explain_os_errors
from stereogenbench_data.index.tree_cache import TreeCache
from stereogenbench_data.schema.document import MAX_TEXT_BYTES, require_text_size
from stereogenbench_data.schema.release import (
    METADATA_FILES,
    PACKED_DEPTH_NAMES,
    TRAINING_JSON,
    VIDEO_FILES,
)
from stereogenbench_data.sources.location import is_remote, joined
from stereogenbench_data.sources.members import read_text_file
from stereogenbench_data.sources.ranged_file import FIRST_BLOCK, MemberFile, RangedFile
from stereogenbench_data.sources.remote import RemoteObject

_T = TypeVar("_T")
_Item = TypeVar("_Item")

Files = Mapping[str, tuple[int, int]]
"""Name of each file of a scene to its size in bytes, and a number that changes with the file."""

FILES: Final = frozenset(
    {*METADATA_FILES, TRAINING_JSON, *VIDEO_FILES, *PACKED_DEPTH_NAMES.values()}
)
"""Files of a release; others in a scene's folder are ignored."""

_AT_A_TIME: Final = 12
_READ_WHOLE: Final = 4 * FIRST_BLOCK
"""Videos of so many bytes are fetched whole when a scene is described, of larger ones both ends."""


def in_parallel(read: Callable[[_Item], _T], items: Iterable[_Item]) -> Iterator[_T]:
    """Yield what is read of each item, in order; several wait for the server at a time."""
    with ThreadPoolExecutor(_AT_A_TIME) as pool:
        yield from pool.map(read, items)


def folder_of(root: str | Path, key: str) -> "SceneFolder":
    """Return a scene's folder on this machine or behind a URL; nothing is read yet."""
    return RemoteFolder(str(root), key) if is_remote(root) else SceneFolder(root, key)


def stamp_of(files: Files) -> str:
    """Return a digest of a scene's files that changes when one of them does."""
    return hashlib.sha256(repr(sorted(files.items())).encode()).hexdigest()[:32]


class SceneFolder:
    """A scene's folder on this machine."""

    def __init__(self, root: str | Path, key: str) -> None:
        """Name the folder by the data's root and the scene's key; nothing is read yet."""
        self._root = root
        self._key = key

    def stamps(self) -> dict[str, tuple[int, int]]:
        """Return the size in bytes and the modification time in ns of each file.

        Raises:
            StorageError: If the folder cannot be read.
        """
        folder = Path(self._root, self._key)
        with (
            explain_os_errors(f"{folder}: cannot be read", "Fetch the scene again."),
            os.scandir(folder) as entries,
        ):
            found = {entry.name: entry.stat() for entry in entries if entry.name in FILES}
        return {name: (found[name].st_size, found[name].st_mtime_ns) for name in sorted(found)}

    def fetch(self, names: Iterable[str]) -> None:
        """Fetch files at a time, if they are behind a URL."""

    def read(self, name: str) -> bytes:
        """Return a metadata file, whole.

        Raises:
            StorageError: If it cannot be read.
            SchemaError: If it is too large for a metadata file.
        """
        where = f"{self._key}/{name}"
        return read_text_file(Path(self._root, where), where=where)

    def video(self, name: str) -> Path | MemberFile:
        """Return a video: its path, or an open file that the caller closes.

        Raises:
            StorageError: If it cannot be read.
        """
        return Path(self._root, self._key, name)


class RemoteFolder(SceneFolder):
    """A scene's folder behind a URL."""

    def __init__(
        self, root: str, key: str, files: Files | None = None, kept: TreeCache | None = None
    ) -> None:
        """Name the folder, its files if they are listed already, and where small ones are kept."""
        super().__init__(root, key)
        self._listed = files
        self._kept = kept
        self._objects: dict[str, RemoteObject] = {}
        self._parts: dict[str, list[tuple[int, bytes]]] = {}

    @property
    def _files(self) -> Files:
        if self._listed is None:
            found = RemoteObject(joined(str(self._root), self._key)).entries()
            sizes = {name: found[name] for name in sorted(found) if name in FILES}
            self._listed = {name: (size, 0) for name, size in sizes.items() if size is not None}
        return self._listed

    def stamps(self) -> dict[str, tuple[int, int]]:
        """Return the size in bytes of each file, and a number that changes with it."""
        return dict(self._files)

    def fetch(self, names: Iterable[str]) -> None:
        """Fetch small files, and both ends of videos, at a time.

        Raises:
            StorageError: If one cannot be read.
        """
        parts: list[tuple[str, int, int]] = []
        for name in names:
            is_video = name.startswith("cam_")
            is_read = is_video or self._files.get(name, (0, 0))[0] <= MAX_TEXT_BYTES
            if name in self._files and name not in self._objects and is_read:
                size, _ = self._files[name]
                url = joined(str(self._root), f"{self._key}/{name}")
                self._objects[name] = RemoteObject(url, expected_size=size)
                if is_video and size > _READ_WHOLE:
                    parts += (name, 0, FIRST_BLOCK), (name, size - FIRST_BLOCK, size)
                else:
                    parts.append((name, 0, size))
        for part, data in zip(parts, in_parallel(self._part, parts), strict=True):
            self._parts.setdefault(part[0], []).append((part[1], data))

    def read(self, name: str) -> bytes:
        """Return a metadata file, whole.

        Raises:
            StorageError: If it cannot be read.
            SchemaError: If it is too large for a metadata file.
        """
        if name not in self._files:
            raise StorageError(f"{self._key}/{name}: is missing.")
        require_text_size(self._files[name][0], where=f"{self._key}/{name}")
        self.fetch([name])
        return self._parts[name][0][1]

    def video(self, name: str) -> RangedFile:
        """Return a video, an open file that the caller closes.

        Raises:
            StorageError: If it cannot be read.
        """
        self.fetch([name])
        remote, parts = self._objects[name], self._parts[name]

        def fetch(start: int, stop: int) -> bytes:
            for first, data in parts:
                if first <= start and stop <= first + len(data):
                    return data[start - first : stop - first]
            return remote.read(start, stop)

        return RangedFile(fetch, size=self._files[name][0])

    def _part(self, part: tuple[str, int, int]) -> bytes:
        name, start, stop = part
        if name.startswith("cam_"):
            return self._objects[name].read(start, stop)
        version = f"{self._key}/{name} {self._files[name]}"
        kept = None if self._kept is None else self._kept.read("files", version)
        if kept is None:
            kept = self._objects[name].read(start, stop)
            if self._kept is not None:
                self._kept.keep("files", version, kept)
        return kept
