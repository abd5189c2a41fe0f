"""The same shards for other readers: a list for wids, and an index of each shard for DALI.

Source: webdataset 0.2, `wids-shard-index-v1`; NVIDIA DALI, `tools/wds2idx.py`, v1.2.
"""

import json
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from typing import Final

from stereogenbench_data.errors import ShardError, cure_of
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.sources.files import write_atomic

WIDS_NAME: Final = "shards.json"
DALI_FOLDER: Final = "dali"

_Placed = tuple[int, int, str]
"""Offset, size and whole name of a member."""


def companion_files(index: SceneIndex) -> dict[str, bytes]:
    """Return ``shards.json`` for wids and ``dali/<shard>.idx`` for DALI: path to content.

    DALI's format divides by spaces: a shard with a space in a name has no such file.
    """
    placed: dict[str, list[_Placed]] = {name: [] for name in sorted(index.shards)}
    for scene in map(index.scene, range(len(index))):
        for name, member in scene.members.items():
            placed[member.path].append((member.offset, member.size, f"{scene.id.key}.{name}"))
    listed = []
    files = {}
    for shard, members in placed.items():
        scenes = _scenes(sorted(members))
        size = index.shards[shard].size
        listed.append({"url": shard, "nsamples": len(scenes), "filesize": size})
        if not any(" " in name for _, _, name in members):
            path = Path(DALI_FOLDER, shard).with_suffix(".idx").as_posix()
            files[path] = "\n".join([f"v1.2 {len(scenes)}", *scenes, ""]).encode()
    wids = {"__kind__": "wids-shard-index-v1", "wids_version": 1, "shardlist": listed}
    return {WIDS_NAME: json.dumps(wids, indent=2).encode() + b"\n"} | files


def write_companion_files(index: SceneIndex, *, out: Path) -> None:
    """Write the files of `companion_files` beside the shards.

    Raises:
        ShardError: If a file cannot be written.
    """
    try:
        for path, content in companion_files(index).items():
            (out / path).parent.mkdir(exist_ok=True)
            write_atomic(out / path, content)
    except OSError as error:
        raise ShardError(
            f"{error.filename or out}: cannot be written ({error.strerror or error}). "
            + cure_of(error, "Check the disk, then run the same command again.")
        ) from error


def _scenes(members: Iterable[_Placed]) -> list[str]:
    """Return a line for each scene, of ``suffix offset size name`` for each of its files."""
    return [
        " ".join(f"{name.partition('.')[2]} {offset} {size} {name}" for offset, size, name in files)
        for _, files in groupby(members, key=lambda each: each[2].partition(".")[0])
    ]
