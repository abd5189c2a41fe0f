"""A released tree behind a URL: listed in few requests, its small files read at most once.

The Hub lists a thousand files a request, so the listing of a whole release takes some hundred. The
listing of a commit, and small files by path, size and digest, are kept in the user's cache.
"""

import re
import sys
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final, TypeVar

from stereogenbench_data.errors import StorageError
from stereogenbench_data.index.scene_folder import FILES, SceneFolder
from stereogenbench_data.index.tree import FoundScenes, find_remote_scenes
from stereogenbench_data.index.tree_cache import TreeCache
from stereogenbench_data.schema.document import MAX_TEXT_BYTES, require_text_size
from stereogenbench_data.sources.location import joined
from stereogenbench_data.sources.ranged_file import FIRST_BLOCK, RangedFile
from stereogenbench_data.sources.remote import RemoteObject

_T = TypeVar("_T")
_Item = TypeVar("_Item")

Files = Mapping[str, tuple[int, int]]
"""Name of each file of a scene to its size in bytes, and a number that changes with the file."""

_AT_A_TIME: Final = 12
_READ_WHOLE: Final = 4 * FIRST_BLOCK
"""Videos of so many bytes are fetched whole when a scene is described, of larger ones both ends."""
_FEW: Final = 32
"""Of fewer scenes of a folder each is listed by itself."""


def in_parallel(read: Callable[[_Item], _T], items: Iterable[_Item]) -> Iterator[_T]:
    """Yield what is read of each item, in order; several wait for the server at a time."""
    with ThreadPoolExecutor(_AT_A_TIME) as pool:
        yield from pool.map(read, items)


class RemoteTree:
    """The scenes of a tree behind a URL, and their files."""

    def __init__(self, url: str) -> None:
        """Ask for the commit of a tree of the Hub; nothing else is requested yet.

        Raises:
            StorageError: If the server cannot be asked.
        """
        self.url = url
        pinned = RemoteObject(url).pinned()
        self._kept = TreeCache(pinned) if pinned else None

    def scenes(self) -> FoundScenes:
        """Return the keys of all scenes.

        Raises:
            StorageError: If the tree cannot be listed, or no scene is where it belongs.
        """
        keys = self._once("scenes", lambda: find_remote_scenes(self.url).keys)
        return FoundScenes(tuple(keys), {})

    def files(self, keys: Sequence[str]) -> dict[str, Files]:
        """Return the files of scenes.

        Raises:
            StorageError: If they cannot be listed.
        """
        by_folder: dict[str, list[str]] = {}
        for key in keys:
            by_folder.setdefault(key.rsplit("/", 2)[0], []).append(key)
        folders: list[str] = []
        for folder, own in by_folder.items():
            folders += [folder] if len(own) >= _FEW else own
        found: dict[str, dict[str, tuple[int, int]]] = {key: {} for key in keys}
        for folder, listed in zip(folders, in_parallel(self._listed, folders), strict=True):
            for path, (size, version) in listed.items():
                key, _, name = f"{folder}/{path}".rpartition("/")
                if key in found and name in FILES:
                    found[key][sys.intern(name)] = size, version
        return {key: dict(sorted(files.items())) for key, files in found.items()}

    def _listed(self, folder: str) -> dict[str, tuple[int, int]]:
        def listed() -> dict[str, tuple[int, int]]:
            files = RemoteObject(joined(self.url, folder)).files()
            return {path: (size, _number(version)) for path, (size, version) in files.items()}

        return {path: (size, number) for path, (size, number) in self._once(folder, listed).items()}

    def _once(self, name: str, ask: Callable[[], Any]) -> Any:
        """Return an answer as JSON holds it; that of a commit is kept."""
        kept = None if self._kept is None else self._kept.document(name)
        if kept is None:
            kept = ask()
            if self._kept is not None:
                self._kept.keep_document(name, kept)
        return kept


def _number(version: str) -> int:
    """Return a number that stands for an ETag or a digest."""
    digits = re.match(r"[0-9a-f]{15}", version)
    return int(digits[0], 16) if digits else zlib.crc32(version.encode())


class RemoteFolder(SceneFolder):
    """A scene's folder behind a URL, whose files are listed already."""

    def __init__(self, root: str, key: str, files: Files, kept: TreeCache) -> None:
        """Name the folder, and where its small files are kept; nothing is read yet."""
        super().__init__(root, key)
        self._files = files
        self._kept = kept
        self._objects: dict[str, RemoteObject] = {}
        self._parts: dict[str, list[tuple[int, bytes]]] = {}

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
        where, number = f"{self._key}/{name}", self._files[name][1]
        kept = self._kept.file(where, size=stop, number=number)
        if kept is None:
            kept = self._objects[name].read(start, stop)
            self._kept.keep_file(where, kept, number=number)
        return kept
