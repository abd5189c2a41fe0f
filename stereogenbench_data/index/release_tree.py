"""Which scenes a folder in the released layout holds, and where misplaced ones should be.

Nothing below a scene's folder is looked at, no folder is entered twice on one way down, and the
search ends a few levels below the root.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from stereogenbench_data.errors import SchemaError, StorageError, cure_of
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.release import (
    BASELINE_JSON,
    COMPLETE_JSON,
    TRAJECTORY_JSON,
    VIDEO_FILES,
)

LAYOUT: Final = "train/<family>/<map>/<scene> or eval/<subset>/<family>/<map>/<scene>"
_SCENE_FILES: Final = frozenset({BASELINE_JSON, TRAJECTORY_JSON, COMPLETE_JSON, *VIDEO_FILES})
_DEPTH_BELOW: Final = {"train": 4, "eval": 5}
_DEEPEST: Final = 8
_SEARCHABLE: Final = "Check the disk, then run it again."


@dataclass(frozen=True, slots=True)
class SceneFolders:
    """What a search found: the keys of scenes, and why other folders are none (path to cure)."""

    keys: tuple[str, ...]
    refused: dict[str, str]


def find_scene_folders(root: str | Path) -> SceneFolders:
    """Return the scenes below a root, sorted by key, and the folders that hold misplaced ones.

    A folder is a scene if it holds one of a scene's files, or if it stands where a scene should
    and has no folder in it. Folders whose names start with a dot are passed over.

    Raises:
        StorageError: If the root is no readable folder, or no scene is where it should be.
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
    for folder, complaint in _search(root):
        key = folder.relative_to(root).as_posix()
        if complaint:
            refused[key] = complaint
            continue
        try:
            keys.append(parse_scene_key(key).key)
        except SchemaError as error:
            refused[key] = f"{error}{_where_to_point(folder, root=root)}"
    if not keys:
        raise StorageError(_nothing_found(root, refused))
    return SceneFolders(tuple(sorted(keys)), dict(sorted(refused.items())))


def _search(root: Path) -> Iterator[tuple[Path, str]]:
    """Yield every scene's folder, and with a complaint each folder that cannot be searched."""
    waiting: list[tuple[Path, tuple[str, ...], frozenset[tuple[int, int]]]] = [
        (root, (), frozenset())
    ]
    while waiting:
        folder, parts, above = waiting.pop()
        is_place_of_scene = bool(parts) and _DEPTH_BELOW.get(parts[0]) == len(parts)
        try:
            status = folder.stat()
            identity = (status.st_dev, status.st_ino)
            if identity in above:
                yield folder, "is a link to a folder above itself. Remove the link."
                continue
            with os.scandir(folder) as entries:
                listed = list(entries)
            files = {entry.name for entry in listed}
            folders = [e.name for e in listed if not e.name.startswith(".") and _is_folder(e)]
        except OSError as error:
            yield folder, f"cannot be searched ({error.strerror}). {cure_of(error, _SEARCHABLE)}"
            continue
        if files & _SCENE_FILES or (is_place_of_scene and not folders):
            yield folder, ""
        elif len(parts) < _DEEPEST:
            below = above | {identity}
            waiting += [(folder / name, (*parts, name), below) for name in folders]


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:
        return True


def root_of(folder: Path) -> Path | None:
    """Return the root below which a folder would be a scene of the release, None if none is."""
    parts = Path(os.path.abspath(folder)).parts  # noqa: PTH100 (resolve would follow links)
    for name, depth in _DEPTH_BELOW.items():
        if len(parts) > depth and parts[-depth] == name:
            return Path(*parts[:-depth])
    return None


def _where_to_point(folder: Path, *, root: Path) -> str:
    other = root_of(folder)
    if other == Path(os.path.abspath(root)):  # noqa: PTH100 (resolve would follow links)
        return " Rename the folder."
    return f" Move it, or point at {other} instead." if other else " Move it to such a path."


def _nothing_found(root: Path, refused: dict[str, str]) -> str:
    here = Path(os.path.abspath(root))  # noqa: PTH100 (resolve would follow links)
    roots = {root_of(root / path) for path in refused}
    suggested = {str(found) for found in roots if found not in (None, here)}
    looked = f"{root}: holds no scene; looked for folders {LAYOUT}"
    if suggested:
        return f"{looked}. Point at {' or '.join(sorted(suggested)[:3])} instead."
    if refused:
        first = next(iter(sorted(refused.items())))
        return f"{looked}, and found {len(refused)} elsewhere, such as {first[0]}: {first[1]}"
    there = sorted(path.name for path in root.iterdir())[:8]
    return f"{looked}, and found {', '.join(there) or 'nothing'} in it. Point at another folder."
