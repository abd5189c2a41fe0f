"""The scenes of a tree in the released layout, found by the names of its folders.

    ROOT/train/<family>/<map>/<scene>/
    ROOT/eval/<subset>/<family>/<map>/<scene>/

`find_scene_folders` searches a folder of this machine and says where misplaced scenes belong;
`find_remote_scenes` and `ListedTree` list only folders where scenes belong.
"""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from stereogenbench_data.errors import SchemaError, StorageError, describe_os_error
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
        found = [name for name, size in entries.items() if size is None and name[0] != "."]
        return [f"{path}/{name}" if path else name for name in found]

    keys: list[str] = []
    with ThreadPoolExecutor(_LISTERS) as pool:
        paths = [name for name in folders("") if name in _SCENE_DEPTH]
        while paths:
            below = [path for listed in pool.map(folders, paths) for path in listed]
            depths = [(path, _SCENE_DEPTH[path.partition("/")[0]]) for path in below]
            keys += [path for path, depth in depths if path.count("/") + 1 == depth]
            paths = [path for path, depth in depths if path.count("/") + 1 < depth]
    if not keys:
        raise StorageError(
            f"{shown(url)}: holds no scene and no index.parquet; looked for folders {_LAYOUT}. "
            "Point at the folder that holds train/ or eval/, or at one of shards."
        )
    return FoundScenes(tuple(sorted(parse_scene_key(key).key for key in keys)), {})


class ListedTree:
    """The folders of this machine where scenes belong, finished or not.

    Attributes:
        keys: Their paths below the root.
    """

    def __init__(self, root: Path) -> None:
        """List them; folders that may not be listed are ignored."""
        self._root = root
        self._unlisted: list[str] = []
        self.keys = {key for split in _SCENE_DEPTH for key in _keys_of(split, self._names)}

    def may_hold(self, key: str) -> bool:
        """Return whether a scene is below a folder that could not be listed."""
        return any(key.startswith(f"{folder}/") for folder in self._unlisted)

    def _names(self, folder: str, is_last: bool) -> list[str]:  # noqa: FBT001 - as `_keys_of` calls
        try:
            with os.scandir(self._root / folder) as entries:
                return [
                    entry.name
                    for entry in entries
                    if not entry.name.startswith(".") and (is_last or entry.is_dir())
                ]
        except (FileNotFoundError, NotADirectoryError):
            return []
        except OSError:
            self._unlisted.append(folder)
            return []


def _keys_of(split: str, names: Callable[[str, bool], list[str]]) -> list[str]:
    """Return the paths of a split's scenes, listed level by level.

    Args:
        split: "train" or "eval".
        names: Called with a path, and whether its folders are scenes; returns their names.
    """
    paths = [split]
    for level in range(2, _SCENE_DEPTH[split] + 1):
        is_last = level == _SCENE_DEPTH[split]
        paths = [f"{path}/{name}" for path in paths for name in names(path, is_last)]
    return paths
