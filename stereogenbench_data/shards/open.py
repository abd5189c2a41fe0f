"""The index of shards on this machine: opened, or refused with what to do."""

from pathlib import Path

from stereogenbench_data.errors import ShardError
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.shards.writer import PARTS
from stereogenbench_data.sources.location import shown


def open_shards(data: str | Path, root: str | Path | None) -> SceneIndex:
    """Return the index of shards on this machine.

    Args:
        data: The folder of the shards, or its index file.
        root: The folder of the shards, if the index file is elsewhere.

    Raises:
        StorageError: If there is no index of shards, or it cannot be opened.
    """
    if "://" in str(data):
        raise ShardError(f"{shown(data)}: is remote. Download the shards, and pass their folder.")
    path = Path(data)
    if path.is_dir() and not (path / INDEX_NAME).is_file():
        cure = "Pass a folder that `stereogenbench pack` made."
        if (path / PARTS).is_dir():
            cure = "Packing was not finished: run `stereogenbench pack` again."
        raise ShardError(f"{path}: holds no {INDEX_NAME}. {cure}")
    index = SceneIndex.open(path, root=root)
    if not index.shards:
        raise ShardError(
            f"{path}: is the index of a released folder, not of shards. Pack it with "
            f"`stereogenbench pack`, or pass a folder of shards."
        )
    return index
