"""Unpack shards into a tree in the released layout, as `download` copies files.

What was packed unchanged comes out unchanged, byte for byte. Depth that blosc2 packed becomes an
FFV1 video again, with the same numbers, times and tags.
"""

from dataclasses import dataclass
from pathlib import Path

from stereogenbench_data.engine import Progress
from stereogenbench_data.errors import ShardError
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.schema.release import RELEASED_NAMES
from stereogenbench_data.shards.download import copy_files, in_the_way, is_whole, size_bytes
from stereogenbench_data.shards.writer import open_shards


@dataclass(frozen=True, slots=True)
class UnpackReport:
    """The keys of the scenes that were unpacked now, or were there before and kept."""

    out: Path
    unpacked: tuple[str, ...]
    kept: tuple[str, ...]


def unpack(
    data: str | Path,
    out: str | Path,
    *,
    root: str | Path | None = None,
    workers: int = 8,
    progress: Progress | None = None,
) -> UnpackReport:
    """Turn shards back into a tree in the released layout.

    Existing files are kept, so a run that was stopped continues when it is run again. Nothing is
    overwritten.

    Args:
        data: The folder of the shards, or its index file.
        root: The folder of the shards, if the index file is elsewhere.
        out: Folder for the tree; created if it does not exist.
        workers: How many files are written at the same time.
        progress: Called repeatedly with the bytes of members done, and all of them.

    Raises:
        StorageError: If there is no index of shards, or a file cannot be written.
        ShardError: If a member is not the one that was packed, or a file exists and is not what the
            shards hold.
        ExtraError: If blosc2 is needed and not installed.
    """
    index = open_shards(data, root)
    scenes = [index.scene(row) for row in range(len(index))]
    out = Path(out)
    if out.resolve() == Path(index.root).resolve():
        raise ShardError(f"{out}: holds the shards themselves. Unpack into another folder.")
    missing: dict[Path, tuple[Scene, str]] = {}
    restored: dict[Path, tuple[Scene, str]] = {}
    for scene in scenes:
        for name, member in scene.members.items():
            path = out / scene.id.key / RELEASED_NAMES.get(name, name)
            if not path.exists():
                missing[path] = scene, name
            elif name in RELEASED_NAMES and path.is_file():
                restored[path] = scene, name
            elif not is_whole(path, member):
                raise in_the_way(path)
    copies, total = missing | restored, size_bytes(*scenes)
    copy_files(index, copies, workers=workers, progress=progress, total=total)
    unpacked = {scene.id.key for scene, _ in missing.values()}
    kept = tuple(scene.id.key for scene in scenes if scene.id.key not in unpacked)
    return UnpackReport(out, tuple(sorted(unpacked)), kept)
