"""Pack a release into shards: the plan, the shards of one part, and the index once all are there.

Any number of processes on any number of machines may pack parts of one plan into one folder. They
share nothing but the plan, which is a function of the release and the target size.
"""

import json
import os
import shutil
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from stereogenbench_data.engine import LOCAL, Advance, Engine, Progress, advance_of, no_advance
from stereogenbench_data.errors import ShardError, explain_os_errors
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.jobs import read_json
from stereogenbench_data.media.depth_frames import blosc2_module
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.shards.plan import DEFAULT_SHARD_BYTES, DepthCodec, ShardPlan, plan_shards
from stereogenbench_data.shards.training import Derivation, TrainingSettings
from stereogenbench_data.shards.writer import (
    PARTS,
    ShardTask,
    derive_task,
    find_packed,
    not_of_plan,
    pack_task,
)
from stereogenbench_data.sources.files import write_atomic
from stereogenbench_data.sources.location import is_remote
from stereogenbench_data.sources.members import require_own_files

_PLAN_FILE: Final = "plan.json"


@dataclass(frozen=True, slots=True)
class PackReport:
    """What a run of packing did.

    Attributes:
        part: Names of the shards of this part, all of which are finished.
        packed: Names of those that this run packed, not an earlier or a concurrent one.
        missing: Names of the plan's shards that other parts have not finished yet.
        index: The index file; None while shards are missing.
        scenes: How many scenes the plan has.
    """

    part: tuple[str, ...]
    packed: tuple[str, ...]
    missing: tuple[str, ...]
    index: Path | None
    scenes: int


def pack(  # noqa: PLR0913 - each is an option of the command
    data: SceneIndex | str | Path,
    out: str | Path,
    *,
    target_bytes: int = DEFAULT_SHARD_BYTES,
    depth_codec: DepthCodec = "released",
    training: TrainingSettings | None = None,
    rows: Sequence[int] | None = None,
    part: tuple[int, int] = (1, 1),
    workers: int | None = None,
    engine: Engine = LOCAL,
    progress: Progress | None = None,
) -> PackReport:
    """Pack a release into tar shards, or one part of it.

    Finished shards are kept, so a run that was stopped continues when it is run again. The same
    release and target size give the same bytes, for any number of parts and workers.

    Args:
        data: The release: its folder or index.
        out: Folder for the shards; created if it does not exist.
        target_bytes: The largest size of a shard, unless one scene alone exceeds it; packed depth
            counts with its released size.
        depth_codec: "released" keeps depth as it is. "blosc2" packs it losslessly, so that each
            frame decodes by itself and faster (extra ``blosc2``).
        training: Derive training shards with these settings (extra ``blosc2``) instead; the data
            may then be shards or a URL, too.
        rows: The rows of the scenes to pack; None is all.
        part: (I, N): pack every N-th shard, starting at the I-th; I is 1 to N.
        workers: The number of processes; None is one a core.
        engine: Where they run: `engine.LOCAL`, or an `engine.RayCluster` whose nodes all find the
            release and the folder at the same paths.
        progress: Called repeatedly with the bytes of this part that are packed, and all of them.

    Returns:
        What was packed. The part that finishes last writes the index.

    Raises:
        StorageError: If the release cannot be read or many scenes of it are broken, or a worker
            died.
        ShardError: If a shard cannot be packed; or the folder is in the release, or holds another
            plan, other shards, or shards that were packed from other files.
    """
    number, count = part
    if not 1 <= number <= count:
        raise ShardError(f"part {number}/{count}: a part is I/N with I from 1 to N, such as 1/4.")
    index = data if isinstance(data, SceneIndex) else SceneIndex.open(data, rows="read")
    if depth_codec == "blosc2" or training is not None:
        blosc2_module()
    plan = plan_shards(index, target_bytes, depth_codec=depth_codec, training=training, rows=rows)
    out = Path(out)
    what, cure = f"{out}: cannot be written to", "Pack into another folder."
    with explain_os_errors(what, cure, kind=ShardError):
        _claim(plan, out)
    plan_tasks = [
        ShardTask(
            shard,
            plan.root,
            str(out),
            plan.digest,
            depth_codec,
            None if training is None else Derivation.of_index(index, training, shard.scenes),
        )
        for shard in plan.shards
    ]
    part_tasks = plan_tasks[number - 1 :: count]
    tasks = [task for task in part_tasks if find_packed(task) is None]
    total = sum(task.source_bytes for task in part_tasks)
    left = sum(task.source_bytes for task in tasks)
    advance = advance_of(progress, done=total - left, total=total)
    advance(0)
    if training is not None and len(tasks) < (workers or os.cpu_count() or 1):
        # Fewer shards than processes: these share the scenes, and the shards are packed after.
        _derive(tasks, engine, workers, advance)
        advance = no_advance  # all was counted
    packed = set(
        engine.map(
            pack_task, tasks, name=lambda task: str(task.target), workers=workers, advance=advance
        )
    )
    missing = _finish(plan_tasks, out)
    names = [task.shard.name for task in part_tasks]
    return PackReport(
        part=tuple(names),
        packed=tuple(name for name in names if name in packed),
        missing=missing,
        index=None if missing else out / INDEX_NAME,
        scenes=sum(len(task.shard.scenes) for task in plan_tasks),
    )


def _derive(
    tasks: Sequence[ShardTask], engine: Engine, workers: int | None, advance: Advance
) -> None:
    """Derive the scenes of training shards, each by a process of its own."""
    scenes = [(task, scene) for task in tasks for scene in task.shard.scenes]
    derived = engine.map(
        derive_task,
        scenes,
        name=lambda work: f"{work[0].target}: {work[1].id.key}",
        workers=workers,
        advance=advance,
    )
    deque(derived, maxlen=0)


def _finish(tasks: Sequence[ShardTask], out: Path) -> tuple[str, ...]:
    """Write the index if all shards of a plan are there; return the names of those that are not."""
    found = {task.shard.name: find_packed(task) for task in tasks}
    shards = {name: index for name, index in found.items() if index is not None}
    if len(shards) == len(found):
        for task in tasks:
            shutil.rmtree(task.derived, ignore_errors=True)  # of a run killed after its last shard
        _write_index(shards, out)
    return tuple(name for name in found if name not in shards)


def _write_index(shards: Mapping[str, SceneIndex], out: Path) -> None:
    """Write the index of all shards, given those of each.

    Raises:
        StorageError: If it cannot be written.
    """
    scenes: list[Scene] = []
    for shard in shards.values():
        shard.load_seek_tables()
        scenes += (
            replace(shard.scene(row), seek_tables=shard.seek_tables(row))
            for row in range(len(shard))
        )
    facts = {name: index.shards[name] for name, index in shards.items()}
    SceneIndex.from_scenes(scenes, out, shards=facts).write(out / INDEX_NAME)


# The folder of the shards: which plan it is for, and that it holds nothing else.


def _claim(plan: ShardPlan, out: Path) -> None:
    """Write the plan into the folder, unless it was; refuse before anything is written.

    Raises:
        StorageError: If a file of the release leads out of it.
        ShardError: If the folder is in the release, or holds files of other plans.
        OSError: If it cannot be written to.
    """
    place = out / PARTS / _PLAN_FILE
    if not is_remote(plan.root):
        packed_scenes = (scene for shard in plan.shards for scene in shard.scenes)
        sources = {file.path for scene in packed_scenes for file in scene.members.values()}
        require_own_files(plan.root, sorted(sources))
        root, there = Path(plan.root).resolve(), out.resolve()
        if there == root or any(there.is_relative_to(root / split) for split in ("train", "eval")):
            raise ShardError(
                f"{out}: is the release itself, or among the scenes of the release. Pack into a "
                f"folder outside its train/ and eval/."
            )
    is_claimed = place.exists()
    found = read_json(place, cure="Pack into another folder.") if is_claimed else plan.settings
    if found != plan.settings:
        differing = [
            name for name in plan.settings | found if found.get(name) != plan.settings.get(name)
        ]
        raise ShardError(
            f"{place}: this folder is for another plan ({', '.join(differing)} differ): of other "
            f"scenes or cameras, of files that have changed since, or with other options. Pack "
            f"into an empty folder, or remove what is in {out}."
        )
    known = {shard.name for shard in plan.shards} if is_claimed else set()
    for path in sorted(out.iterdir()) if out.exists() else []:
        is_index = path.name == INDEX_NAME and not is_claimed
        if is_index or (path.suffix == ".tar" and path.name not in known):
            raise not_of_plan(path)
    if not is_claimed:
        place.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(place, json.dumps(plan.settings).encode())
