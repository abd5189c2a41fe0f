"""The scenes of a tree in the released layout, found by the names of its folders.

    ROOT/train/<family>/<map>/<scene>/
    ROOT/eval/<subset>/<family>/<map>/<scene>/

`find_scene_folders` searches a folder of this machine and says where misplaced scenes belong;
`find_remote_scenes` and `PlacedFolders` list only folders where scenes belong. The Hub lists a
thousand files a request, so `RemoteTree` lists a whole release in some hundred, and keeps the
listing of a commit in the user's cache.
"""

import json
import os
import re
import sys
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from stereogenbench_data.errors import SchemaError, StorageError, describe_os_error
from stereogenbench_data.index.folders import FILES, Files, in_parallel
from stereogenbench_data.index.tree_cache import TreeCache
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.release import (
    BASELINE_JSON,
    COMPLETE_JSON,
    TRAJECTORY_JSON,
    VIDEO_FILES,
)
from stereogenbench_data.sources.location import joined, shown
from stereogenbench_data.sources.remote import RemoteObject

_LAYOUT: Final = "train/<family>/<map>/<scene> or eval/<subset>/<family>/<map>/<scene>"
_SCENE_FILES: Final = frozenset({BASELINE_JSON, TRAJECTORY_JSON, COMPLETE_JSON, *VIDEO_FILES})
_SCENE_DEPTH: Final = {"train": 4, "eval": 5}
"""How many parts a scene's path has, by its split."""
_LISTERS: Final = 8
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


def find_remote_scenes(url: str) -> FoundScenes:
    """Return the keys of all scenes behind a URL, sorted; scenes' own folders are not listed.

    Raises:
        StorageError: If it cannot be listed, or no scene is where it belongs.
        SchemaError: If a folder where a scene belongs has a name that no scene can have.
    """

    def folders(path: str) -> list[str]:
        entries = RemoteObject(joined(url, path) if path else url).entries()
        return [name for name, size in entries.items() if size is None and name[0] != "."]

    keys = _keys_below([name for name in folders("") if name in _SCENE_DEPTH], folders)
    if not keys:
        raise StorageError(
            f"{shown(url)}: holds no scene and no index.parquet; looked for folders {_LAYOUT}. "
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


class PlacedFolders:
    """The folders of this machine where scenes belong, finished or not.

    Attributes:
        keys: Their paths below the root.
    """

    def __init__(self, root: Path) -> None:
        """List them; folders that may not be listed are ignored."""
        self._root = root
        self._unlisted: list[str] = []
        self.keys = set(_keys_below(_SCENE_DEPTH, self._folders))

    def may_hold(self, key: str) -> bool:
        """Return whether a scene is below a folder that could not be listed."""
        return any(key.startswith(f"{folder}/") for folder in self._unlisted)

    def _folders(self, path: str) -> list[str]:
        try:
            with os.scandir(self._root / path) as entries:
                return [each.name for each in entries if each.name[0] != "." and each.is_dir()]
        except (FileNotFoundError, NotADirectoryError):
            return []
        except OSError:
            self._unlisted.append(path)
            return []


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
        kept = None if self._kept is None else self._kept.read("listing", name)
        if kept is not None:
            return json.loads(kept)
        found = ask()
        if self._kept is not None:
            self._kept.keep("listing", name, json.dumps(found).encode())
        return found


def _number(version: str) -> int:
    """Return a number that stands for an ETag or a digest."""
    digits = re.match(r"[0-9a-f]{15}", version)
    return int(digits[0], 16) if digits else zlib.crc32(version.encode())
