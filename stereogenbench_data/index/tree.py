"""The scenes of a tree in the released layout: their folders and files, and what is kept of them.

    ROOT/train/<family>/<map>/<scene>/
    ROOT/eval/<subset>/<family>/<map>/<scene>/

`find_scene_folders` searches a folder of this machine and says where misplaced scenes belong;
`find_remote_scenes` and `placed_folders` list only folders where scenes belong. The Hub lists a
thousand files a request, so `RemoteTree` lists a whole release in some hundred. A `SceneFolder`
reads the files of one scene; behind a URL several at a time, and of large videos both ends alone.

What was found out about trees without an index is kept in the user's cache:

    <cache>/stereogenbench/trees/<digest of the root>/
        presumed-<digest of the listing>.parquet   the rows, as an index file
        scenes/ab/<digest of the scene's files>    the row of a scene that was described
        listing/ab/<digest of the folder>          what a commit of the Hub holds
        files/ab/<digest of path and ETag>         a small file of a scene behind a URL

The listing is the path, size and modification time of every file, so what is kept is used only for
unchanged files. Any number of processes, of several machines too, may read and write: files are
renamed into place, whole or not at all, and a damaged one counts as missing.
"""

import hashlib
import json
import os
import re
import sys
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final, TypeVar

import pyarrow as pa

from stereogenbench_data.errors import (
    SchemaError,
    StorageError,
    describe_os_error,
    explain_os_errors,
)
from stereogenbench_data.index.parquet import (
    IndexHead,
    read_index_file,
    read_seek_tables,
    write_index_file,
)
from stereogenbench_data.index.rows import SCHEMA
from stereogenbench_data.schema.document import MAX_TEXT_BYTES, require_text_size
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.release import (
    BASELINE_JSON,
    COMPLETE_JSON,
    METADATA_FILES,
    PACKED_DEPTH_NAMES,
    TRAINING_JSON,
    TRAJECTORY_JSON,
    VIDEO_FILES,
)
from stereogenbench_data.sources.files import write_atomic
from stereogenbench_data.sources.location import is_remote
from stereogenbench_data.sources.members import read_text_file
from stereogenbench_data.sources.ranged_file import FIRST_BLOCK, MemberFile, RangedFile
from stereogenbench_data.sources.remote import RemoteObject
from stereogenbench_data.sources.retry import RetryPolicy

CACHE_VARIABLE: Final = "STEREOGENBENCH_CACHE"
"""The environment variable that names another folder for the cache, or is "off"."""

_FORMAT: Final = 3
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
        # What another version understood of the same files may differ.
        made_by = ""
        with suppress(PackageNotFoundError):  # of a checkout that is not installed
            made_by = version("stereogenbench-data")
        place = str(root) if root is None or is_remote(root) else os.path.realpath(root)
        what = [_FORMAT, made_by, SCHEMA.names, place, read_as]
        # Below a device nothing can be read or kept.
        base = (root and cache_folder()) or os.devnull
        self._folder = Path(base, "trees", _digest(json.dumps(what)))

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
            write_atomic(place, zlib.compress(content, 1))

    def once(self, kind: str, name: str, find: Callable[[], bytes]) -> bytes:
        """Return what was kept under a kind and a name, or find it now and keep it."""
        found = self.read(kind, name)
        if found is None:
            found = find()
            self.keep(kind, name, found)
        return found

    def _place(self, kind: str, name: str) -> Path:
        digest = _digest(name)
        return self._folder / kind / digest[:2] / digest


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:32]


_NOTHING_KEPT: Final = TreeCache(None)


_T = TypeVar("_T")
_Item = TypeVar("_Item")

Files = Mapping[str, tuple[int, int]]
"""Name of each file of a scene to its size in bytes, and a number that changes with the file."""

FILES: Final = frozenset(
    {*METADATA_FILES, TRAINING_JSON, *VIDEO_FILES, *PACKED_DEPTH_NAMES.values()}
)
"""Files of a release; of others in a scene's folder, JSON files alone may speak of its depth."""


def is_read(name: str) -> bool:
    """Return whether a file of a scene is read: one of a release, or other JSON."""
    return name in FILES or (name.endswith(".json") and name[0] != ".")


_AT_A_TIME: Final = 24
_READ_WHOLE: Final = 4 * FIRST_BLOCK
"""Videos up to this size are fetched whole when a scene is described, of larger ones both ends."""


def in_parallel(read: Callable[[_Item], _T], items: Iterable[_Item]) -> Iterator[_T]:
    """Yield what is read of each item, in order; several wait for the server at a time."""
    with ThreadPoolExecutor(_AT_A_TIME) as pool:
        yield from pool.map(read, items)


def folder_of(root: str | Path, key: str, *, retry: RetryPolicy | None = None) -> "SceneFolder":
    """Return a scene's folder on this machine or behind a URL; nothing is read yet."""
    if is_remote(root):
        return RemoteFolder(RemoteObject(str(root), retry=retry), key)
    return SceneFolder(root, key)


def stamp_of(files: Files) -> str:
    """Return a digest of a scene's files that changes when one of them does."""
    return hashlib.sha256(repr(sorted(files.items())).encode()).hexdigest()[:32]


class SceneFolder:
    """A scene's folder on this machine.

    Attributes:
        key: The scene's key.
    """

    def __init__(self, root: str | Path, key: str) -> None:
        """Name the folder by the data's root and the scene's key; nothing is read yet."""
        self._root = root
        self.key = key

    def stamps(self) -> dict[str, tuple[int, int]]:
        """Return the size in bytes and the modification time in ns of each file.

        Raises:
            StorageError: If the folder cannot be read.
        """
        folder = Path(self._root, self.key)
        with (
            explain_os_errors(f"{folder}: cannot be read", "Fetch the scene again."),
            os.scandir(folder) as entries,
        ):
            found = {entry.name: entry.stat() for entry in entries if is_read(entry.name)}
        return {name: (found[name].st_size, found[name].st_mtime_ns) for name in sorted(found)}

    def fetch(self, names: Iterable[str]) -> None:
        """Fetch files at a time, if they are behind a URL."""

    def read(self, name: str) -> bytes:
        """Return a metadata file, whole.

        Raises:
            StorageError: If it cannot be read.
            SchemaError: If it is too large for a metadata file.
        """
        where = f"{self.key}/{name}"
        return read_text_file(Path(self._root, where), where=where)

    def video(self, name: str) -> Path | MemberFile:
        """Return a video: its path, or an open file that the caller closes.

        Raises:
            StorageError: If it cannot be read.
        """
        return Path(self._root, self.key, name)


class RemoteFolder(SceneFolder):
    """A scene's folder behind a URL."""

    def __init__(
        self,
        root: RemoteObject,
        key: str,
        files: Files | None = None,
        kept: TreeCache | None = None,
    ) -> None:
        """Name the folder, its files if they are listed already, and where small ones are kept."""
        self.key = key
        self._folder = root.below(key)
        self._listed = files
        self._kept = kept or _NOTHING_KEPT
        self._objects: dict[str, RemoteObject] = {}
        self._parts: dict[str, list[tuple[int, bytes]]] = {}

    @property
    def _files(self) -> Files:
        if self._listed is None:
            self._listed = {
                name: (size, 0)
                for name, (size, _) in sorted(self._folder.listed().items())
                if size is not None and is_read(name)
            }
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
            is_small = self._files.get(name, (0, 0))[0] <= MAX_TEXT_BYTES
            if name in self._files and name not in self._objects and (is_video or is_small):
                size, _ = self._files[name]
                self._objects[name] = self._folder.below(name, expected_size=size)
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
            raise StorageError(f"{self.key}/{name}: is missing.")
        require_text_size(self._files[name][0], where=f"{self.key}/{name}")
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
        version = f"{self.key}/{name} {self._files[name]}"
        return self._kept.once("files", version, lambda: self._objects[name].read(start, stop))


_LAYOUT: Final = "train/<family>/<map>/<scene> or eval/<subset>/<family>/<map>/<scene>"
_SCENE_FILES: Final = frozenset({BASELINE_JSON, TRAJECTORY_JSON, COMPLETE_JSON, *VIDEO_FILES})
_SCENE_DEPTH: Final = {"train": 4, "eval": 5}
"""How many parts a scene's path has, by its split."""
_LISTERS: Final = 16
"""Folders of a server that are listed at a time."""
_FEW: Final = 32
"""Of fewer scenes of a folder each is listed by itself."""
_DEEPEST: Final = 8
"""How many levels below the root are searched."""


@dataclass(frozen=True, slots=True)
class FoundScenes:
    """The keys of scenes, and for other folders path to reason and cure.

    ``is_marked`` is whether a scene is known to have its completion mark; a URL does not tell it.
    """

    keys: tuple[str, ...]
    refused: dict[str, str]
    is_marked: bool = False


def find_scene_folders(root: str | Path) -> FoundScenes:
    """Return the scenes below a root, sorted by key, and the folders that hold misplaced ones.

    A folder is a scene if it holds one of a scene's files, or if it is where a scene belongs and
    has no subfolder. Folders whose names start with a dot are ignored. A scene's folder is not
    searched further, and a link to a folder above itself is not followed.

    Raises:
        StorageError: If the root is not a readable folder, or no scene is where it belongs.
    """
    root = Path(root)
    if not root.is_dir():
        found = "is a file" if root.exists() else "does not exist"
        raise StorageError(
            f"{root}: {found}; expected a folder that holds train/ or eval/ of the release, "
            f"or an index.parquet."
        )
    keys: list[str] = []
    refused: dict[str, str] = {}
    is_marked = False
    for folder, complaint, names in _search(root):
        key = folder.relative_to(root).as_posix()
        if complaint:
            refused[key] = complaint
            continue
        try:
            keys.append(parse_scene_key(key).key)
            is_marked = is_marked or COMPLETE_JSON in names
        except SchemaError as error:
            refused[key] = f"{error}{_where_to_point(folder, root=root)}"
    if not keys:
        raise StorageError(_nothing_found(root, refused))
    return FoundScenes(tuple(sorted(keys)), dict(sorted(refused.items())), is_marked)


def _search(root: Path) -> Iterator[tuple[Path, str, set[str]]]:
    """Yield each scene's folder and its files, and each folder that cannot be searched and why."""
    waiting: list[tuple[Path, tuple[str, ...], frozenset[tuple[int, int]]]] = [
        (root, (), frozenset())
    ]
    while waiting:
        folder, parts, above = waiting.pop()
        is_place_of_scene = bool(parts) and _SCENE_DEPTH.get(parts[0]) == len(parts)
        try:
            status = folder.stat()
            identity = (status.st_dev, status.st_ino)
            if identity in above:
                yield folder, "is a link to a folder above itself. Remove the link.", set()
                continue
            with os.scandir(folder) as entries:
                listed = list(entries)
            files = {entry.name for entry in listed}
            folders = [e.name for e in listed if not e.name.startswith(".") and _is_folder(e)]
        except OSError as error:
            cure = "Check the disk, then run it again."
            yield folder, describe_os_error("cannot be searched", error, cure), set()
            continue
        if files & _SCENE_FILES or (is_place_of_scene and not folders):
            yield folder, "", files
        elif len(parts) < _DEEPEST:
            below = above | {identity}
            waiting += [(folder / name, (*parts, name), below) for name in folders]


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:
        return True


def release_root_of(folder: Path) -> Path | None:
    """Return the root below which a folder would be a scene of the release, None if none is."""
    parts = _absolute(folder).parts
    for name, depth in _SCENE_DEPTH.items():
        if len(parts) > depth and parts[-depth] == name:
            return Path(*parts[:-depth])
    return None


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))  # noqa: PTH100 (resolve would follow links)


def _where_to_point(folder: Path, *, root: Path) -> str:
    other = release_root_of(folder)
    if other == _absolute(root):
        return ""  # the folder's name is wrong, and the error says so
    return f" Move it, or point at {other} instead." if other else " Move it to such a path."


def _nothing_found(root: Path, refused: dict[str, str]) -> str:
    roots = {release_root_of(root / path) for path in refused}
    suggested = {str(found) for found in roots if found not in (None, _absolute(root))}
    looked = f"{root}: holds no scene; looked for folders {_LAYOUT}"
    if suggested:
        return f"{looked}. Point at {' or '.join(sorted(suggested)[:3])} instead."
    if refused:
        first = next(iter(sorted(refused.items())))
        return f"{looked}, and found {len(refused)} elsewhere, such as {first[0]}: {first[1]}"
    there = sorted(path.name for path in root.iterdir())[:8]
    return f"{looked}, and found {', '.join(there) or 'nothing'} in it. Point at another folder."


def find_remote_scenes(root: RemoteObject) -> FoundScenes:
    """Return the keys of all scenes behind a URL, sorted; scenes' own folders are not listed.

    Raises:
        StorageError: If it cannot be listed, or no scene is where it belongs.
        SchemaError: If a folder where a scene belongs has a name that no scene can have.
    """

    def folders(path: str) -> list[str]:
        listed = (root.below(path) if path else root).listed()
        return [name for name, (size, _) in listed.items() if size is None and name[0] != "."]

    keys = _keys_below([name for name in folders("") if name in _SCENE_DEPTH], folders)
    if not keys:
        raise StorageError(
            f"{root.where}: holds no scene and no index.parquet; looked for folders {_LAYOUT}. "
            "Point at the folder that holds train/ or eval/, or at one of shards."
        )
    return FoundScenes(tuple(sorted(parse_scene_key(key).key for key in keys)), {})


def _keys_below(splits: Iterable[str], folders: Callable[[str], list[str]]) -> list[str]:
    """Return the paths where scenes belong, listed level by level; several wait at a time.

    Args:
        splits: "train" and "eval", or one of them.
        folders: Called with a path below the root; returns the names of the folders there.
    """
    keys: list[str] = []
    with ThreadPoolExecutor(_LISTERS) as pool:
        for split in splits:
            paths = [split]
            for _ in range(_SCENE_DEPTH[split] - 1):
                listed = zip(paths, pool.map(folders, paths), strict=True)
                paths = [f"{path}/{name}" for path, names in listed for name in names]
            keys += paths
    return keys


def placed_folders(root: Path) -> set[str]:
    """Return the paths where scenes belong below a folder of this machine, finished or not.

    Folders that may not be listed are ignored.
    """

    def folders(path: str) -> list[str]:
        with suppress(OSError), os.scandir(root / path) as entries:
            return [each.name for each in entries if each.name[0] != "." and each.is_dir()]
        return []

    return set(_keys_below(_SCENE_DEPTH, folders))


class RemoteTree:
    """The scenes of a tree behind a URL, and their files."""

    def __init__(self, root: RemoteObject) -> None:
        """Ask for the commit of a tree of the Hub; nothing else is requested yet.

        Raises:
            StorageError: If the server cannot be asked.
        """
        self._root = root
        pinned = root.pinned()
        self._kept = TreeCache(pinned) if pinned else _NOTHING_KEPT

    def scenes(self) -> FoundScenes:
        """Return the keys of all scenes.

        Raises:
            StorageError: If the tree cannot be listed, or no scene is where it belongs.
        """
        keys = self._once("scenes", lambda: find_remote_scenes(self._root).keys)
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
            for path, (size, stamp) in listed.items():
                key, _, name = f"{folder}/{path}".rpartition("/")
                if key in found and is_read(name):
                    found[key][sys.intern(name)] = size, stamp
        return {key: dict(sorted(files.items())) for key, files in found.items()}

    def _listed(self, folder: str) -> dict[str, tuple[int, int]]:
        def listed() -> dict[str, tuple[int, int]]:
            return {
                path: (size, _number(version))
                for path, (size, version) in self._root.below(folder).listed("all levels").items()
                if size is not None
            }

        return {path: (size, number) for path, (size, number) in self._once(folder, listed).items()}

    def _once(self, name: str, ask: Callable[[], Any]) -> Any:
        """Return an answer as JSON holds it; that of a commit is kept."""
        return json.loads(self._kept.once("listing", name, lambda: json.dumps(ask()).encode()))


def _number(version: str) -> int:
    """Return a number that stands for an ETag or a digest."""
    digits = re.match(r"[0-9a-f]{15}", version)
    return int(digits[0], 16) if digits else zlib.crc32(version.encode())
