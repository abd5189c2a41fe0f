"""The same shards for other readers: a list for wids, and an index of each shard for DALI.

Source: webdataset 0.2, `wids-shard-index-v1`; NVIDIA DALI, `tools/wds2idx.py`, v1.2.
"""

import json
from collections.abc import Mapping
from itertools import groupby
from pathlib import Path
from typing import Final

from stereogenbench_data.errors import ShardError
from stereogenbench_data.storage.shard_plan import PlannedShard, ShardPlan
from stereogenbench_data.storage.shard_writer import PackedShard
from stereogenbench_data.storage.unfinished import write_whole

WIDS_NAME: Final = "shards.json"
DALI_FOLDER: Final = "dali"


def write_foreign_indexes(plan: ShardPlan, shards: Mapping[str, PackedShard], *, out: Path) -> None:
    """Write ``shards.json`` for wids and ``dali/<shard>.idx`` for DALI.

    DALI's format divides by spaces: a shard with a space in a name has no such file.

    Raises:
        ShardError: If a file cannot be written.
    """
    listed = [
        {"url": shard.name, "nsamples": len(shard.keys), "filesize": shards[shard.name].size}
        for shard in plan.shards
    ]
    wids = {"__kind__": "wids-shard-index-v1", "wids_version": 1, "shardlist": listed}
    try:
        write_whole(out / WIDS_NAME, json.dumps(wids, indent=2).encode() + b"\n")
        (out / DALI_FOLDER).mkdir(exist_ok=True)
        for shard in plan.shards:
            text = _dali_index(shard, shards[shard.name])
            if not any(" " in key for key in shard.keys):
                write_whole((out / DALI_FOLDER / shard.name).with_suffix(".idx"), text.encode())
    except OSError as error:
        raise ShardError(
            f"{error.filename or out}: cannot be written ({error.strerror or error}). Make room or "
            f"give write permission, then run the same command again."
        ) from error


def _dali_index(shard: PlannedShard, packed: PackedShard) -> str:
    """Return a line for each scene, of ``suffix offset size name`` for each of its files."""
    placed = zip(shard.members, packed.offsets, strict=True)
    scenes = [
        " ".join(
            f"{member.name.partition('.')[2]} {offset} {member.size} {member.name}"
            for member, offset in files
        )
        for _, files in groupby(placed, key=lambda place: place[0].name.partition(".")[0])
    ]
    return "\n".join([f"v1.2 {len(scenes)}", *scenes]) + "\n"
