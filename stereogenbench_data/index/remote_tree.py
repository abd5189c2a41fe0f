"""Which scenes a tree in the released layout holds behind a URL, such as one of the Hub."""

from typing import Final

from stereogenbench_data.errors import StorageError
from stereogenbench_data.index.release_tree import LAYOUT, SceneFolders
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.sources.location import joined, shown
from stereogenbench_data.sources.remote import RemoteObject

_LEVELS: Final = {"train": 3, "eval": 4}
"""Levels of folders from the split down to the scenes."""


def find_remote_scenes(url: str) -> SceneFolders:
    """Return the keys of all scenes behind a URL, sorted; nothing of a scene's is looked at.

    Raises:
        StorageError: If it cannot be listed, or holds no scene where one should be.
        SchemaError: If a folder where a scene should be has a name that no scene can have.
    """
    splits = [name for name in _folders(url, "") if name in _LEVELS]
    keys: list[str] = []
    for split in splits:
        below = [split]
        for _ in range(_LEVELS[split]):
            below = [f"{path}/{name}" for path in below for name in _folders(url, path)]
        keys += below
    if not keys:
        raise StorageError(
            f"{shown(url)}: holds no scene and no index.parquet; looked for folders {LAYOUT}. "
            "Point at the folder that holds train/ or eval/, or at one of shards."
        )
    return SceneFolders(tuple(sorted(parse_scene_key(key).key for key in keys)), {})


def _folders(url: str, path: str) -> list[str]:
    entries = RemoteObject(joined(url, path) if path else url).entries()
    return [name for name, size in entries.items() if size is None and not name.startswith(".")]
