"""Files beside the shards for other readers: a list for wids, an index of each shard for DALI.

wids was part of webdataset before 1.0; later releases do not read the list.

Source: webdataset 0.2, `wids-shard-index-v1`; NVIDIA DALI, `tools/wds2idx.py`, v1.2.
"""

import json
from itertools import groupby
from pathlib import Path
from typing import Any, Final

from stereogenbench_data.errors import ShardError, describe_os_error
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.sources.files import write_atomic

_WIDS_NAME: Final = "shards.json"
_DALI_FOLDER: Final = "dali"


def companion_files(index: SceneIndex) -> dict[str, bytes]:
    """Return the content of ``shards.json`` for wids and ``dali/<shard>.idx`` for DALI, by path.

    DALI's format separates by spaces, so a shard with a space in a name has no such file.
    """
    places: dict[str, list[tuple[int, int, str]]] = {name: [] for name in sorted(index.shards)}
    for scene in map(index.scene, range(len(index))):
        for name, member in scene.members.items():
            places[member.path].append((member.offset, member.size, f"{scene.id.key}.{name}"))
    listed = []
    files = {}
    for shard, members in places.items():
        lines = [
            " ".join(
                f"{name.partition('.')[2]} {offset} {size} {name}" for offset, size, name in scene
            )
            for _, scene in groupby(sorted(members), key=lambda each: each[2].partition(".")[0])
        ]
        size = index.shards[shard].size
        listed.append({"url": shard, "nsamples": len(lines), "filesize": size})
        if not any(" " in name for _, _, name in members):
            path = Path(_DALI_FOLDER, shard).with_suffix(".idx").as_posix()
            files[path] = "\n".join([f"v1.2 {len(lines)}", *lines, ""]).encode()
    wids: dict[str, Any] = {
        "__kind__": "wids-shard-index-v1",
        "wids_version": 1,
        "shardlist": listed,
    }
    if index.is_derived:
        wids["derived"] = derivation_facts(index)
    return {_WIDS_NAME: json.dumps(wids, indent=2).encode() + b"\n"} | files


def derivation_facts(index: SceneIndex) -> dict[str, Any]:
    """Return from what, how and with what error training shards were derived, as JSON.

    Several values of a fact, as of scenes that were derived with several settings, are a list.
    """
    scenes = [index.scene(row) for row in range(len(index))]
    known = [(scene.rig, scene.training) for scene in scenes if scene.training is not None]
    facts: dict[str, Any] = {}
    for name, values in (
        ("size", {f"{rig.image_width_px}x{rig.image_height_px}" for rig, _ in known}),
        ("quality", {training.quality for _, training in known}),
        ("codec", {training.codec for _, training in known}),
        ("settings", {training.settings for _, training in known}),
        ("source_digest", {training.source_digest for _, training in known}),
    ):
        found = sorted(values)
        found = [json.loads(each) for each in found] if name == "settings" else found
        facts[name] = found[0] if len(found) == 1 else found
    mean_db = [each for _, training in known for each in training.psnr_db if each == each]
    worst_db = [each for _, training in known for each in training.worst_psnr_db if each == each]
    facts["psnr_db"] = {
        "mean": round(sum(mean_db) / max(len(mean_db), 1), 3),
        "worst_frame": min(worst_db, default=0.0),
    }
    return facts


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
        what = f"{error.filename or out}: cannot be written"
        cure = "Check the disk, then run the same command again."
        raise ShardError(describe_os_error(what, error, cure)) from error
