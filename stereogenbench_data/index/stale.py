"""Whether a folder still holds the scenes or shards that its index names: told by names alone.

Times of change say nothing after a copy, a clone or an unpacked archive; the names of folders do.
Listing them costs one look at each map's folder, not one at each scene's files: 7 ms for 8,493
scenes.
"""

import os
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.release import COMPLETE_JSON, VIDEO_FILES
from stereogenbench_data.schema.text import counted

_LEVELS: Final = {"train": 3, "eval": 4}
"""Levels of folders from the split down to the scenes."""
_SHOWN: Final = 3
_MOST: Final = 1000
"""New scenes that are counted at most: of each its own folder is looked into."""


class StaleIndexWarning(UserWarning):
    """A folder holds scenes or shards that its index does not know, or lacks some of it."""


@dataclass(frozen=True, slots=True)
class Indexed:
    """What an index says is in its folder.

    Attributes:
        keys: The scenes that it holds.
        passed_over: Scenes, or other paths, that were there and were left out.
        unfinished: Those of them that were not finished.
        shards: The paths of its shards; empty for scenes in folders.
        is_part: Whether it was made of a part of the folder on purpose: then what it leaves out
            is not told.
    """

    keys: Collection[str]
    passed_over: Collection[str]
    unfinished: Collection[str]
    shards: Collection[str]
    is_part: bool


def stale_message(root: Path, indexed: Indexed, *, index_file: Path) -> str:
    """Return what an index misses or no longer finds in its folder, and the cure; else nothing.

    A folder of the tree that may not be listed is passed over: what is in it is not known. An index
    that lies alone, without any of its data, is not told to be old.
    """
    keys, listed = set(indexed.keys), _ListedTree(root)
    found = []
    if not indexed.is_part:
        new = sorted(listed.keys - keys - (set(indexed.passed_over) - set(indexed.unfinished)))
        finished = [key for key in new[:_MOST] if _is_finished(root, key)]
        if finished:
            found.append(_told(finished, "scene", "not in the index", is_more=len(new) > _MOST))
    if indexed.shards:
        shards, there = set(indexed.shards), set(_tars(root, indexed.shards))
        if new_shards := sorted(there - shards):
            found.append(_told(new_shards, "shard", "not in the index"))
        gone = sorted(path for path in shards - there if not (root / path).exists())
        if 0 < len(gone) < len(shards):
            found.append(_told(gone, "shard", "of the index, and not there"))
        cure = (
            "Fetch the index that belongs to these shards, move away what is not of it, or pack "
            "all scenes into an empty folder."
        )
    else:
        gone = sorted(key for key in keys - listed.keys if not listed.may_hold(key))
        if 0 < len(gone) < len(keys):
            found.append(_told(gone, "scene", "of the index, and not there"))
        place = "" if index_file.parent == root else f" --out {index_file}"
        cure = f"Run `stereogenbench index {root}{place}`."
        if indexed.is_part:
            cure = "It is of a part of the folder: make it again."
    if not found:
        return ""
    return f"{index_file}: is older than the folder {root}: {'; '.join(found)}. {cure}"


def _told(names: list[str], what: str, why: str, *, is_more: bool = False) -> str:
    shown = ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")
    number = counted(len(names), what)
    return f"{f'at least {number}' if is_more else number} {why} ({shown})"


def scenes_listed(root: Path) -> set[str]:
    """Return the keys of all folders that stand where scenes should, finished or not."""
    return _ListedTree(root).keys


class _ListedTree:
    """The names of all folders where scenes should be, and which folders could not be listed."""

    def __init__(self, root: Path) -> None:
        self._unlisted: list[str] = []
        self.keys: set[str] = set()
        for split, levels in _LEVELS.items():
            folders = [split]
            for level in range(levels):
                folders = [
                    f"{folder}/{name}"
                    for folder in folders
                    for name in self._names(root / folder, folder, is_last=level == levels - 1)
                ]
            self.keys.update(folders)

    def may_hold(self, key: str) -> bool:
        """Return whether a scene lies below a folder that could not be listed."""
        return any(key.startswith(f"{folder}/") for folder in self._unlisted)

    def _names(self, place: Path, folder: str, *, is_last: bool) -> list[str]:
        try:
            with os.scandir(place) as entries:
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


def _is_finished(root: Path, key: str) -> bool:
    """Return whether a folder is a scene that an index would hold, as far as names tell."""
    try:
        parse_scene_key(key)
        names = {path.name for path in (root / key).iterdir()}
    except (SchemaError, OSError):
        return False
    return COMPLETE_JSON in names and not names.isdisjoint(VIDEO_FILES)


def _tars(root: Path, shards: Collection[str]) -> Iterator[str]:
    """Yield the paths of all tars in the folders that hold shards."""
    for folder in {"", *(path.rpartition("/")[0] for path in shards)}:
        try:
            names = [path.name for path in (root / folder).iterdir()]
        except OSError:
            continue
        yield from (
            f"{folder}/{name}" if folder else name
            for name in names
            if name.endswith(".tar") and not name.startswith(".")
        )
