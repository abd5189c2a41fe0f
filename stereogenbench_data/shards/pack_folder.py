"""The folder that shards are packed into: which plan it is for, and that nothing else is in it."""

import json
from pathlib import Path
from typing import Final

from stereogenbench_data.errors import ShardError
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.shards.plan import ShardPlan
from stereogenbench_data.shards.tar import read_members
from stereogenbench_data.shards.writer import UNFINISHED
from stereogenbench_data.sources.files import PARTS, write_atomic

_PLAN_NOTE: Final = "plan.json"


def take_folder(plan: ShardPlan, out: Path) -> None:
    """Note the plan in the folder, or find it noted there; before anything is written, refuse.

    Raises:
        ShardError: If the folder lies in the release, or holds what other plans left.
        OSError: If it cannot be written to.
    """
    note = out / PARTS / _PLAN_NOTE
    told = {
        "plan": plan.digest,
        "target_bytes": plan.target_bytes,
        "shards": len(plan.shards),
    } | ({} if plan.depth_codec == "released" else {"depth": plan.depth_codec})
    _require_beside_release(plan, out)
    if not note.exists():
        _require_own_shards(plan, out)
        note.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(note, json.dumps(told).encode())
    try:
        found = json.loads(note.read_bytes())
    except ValueError:
        found = None
    if found != told:
        raise ShardError(
            f"{note}: this folder was begun with another plan ({_brief(found)}, and this one is "
            f"{_brief(told)}): the release, the size of the shards or the depth codec was "
            f"another. Pack into an empty folder, or remove what is in {out}."
        )
    _require_no_others(plan, out)


def _brief(told: object) -> str:
    if not isinstance(told, dict):
        return "unreadable"
    plan, size = str(told.get("plan"))[:12], told.get("target_bytes")
    depth = told.get("depth", "released")
    return f"{told.get('shards')} shards of {size} bytes, depth {depth}, {plan}"


def _require_beside_release(plan: ShardPlan, out: Path) -> None:
    root, place = Path(plan.root).resolve(), out.resolve()
    if place == root:
        raise ShardError(f"{out}: is the release itself. Pack into another folder.")
    for split in ("train", "eval"):
        if any(place.is_relative_to(each) for each in (root / split, (root / split).resolve())):
            raise ShardError(
                f"{out}: lies in {plan.root}/{split}, among the scenes of the release. "
                f"Pack into a folder outside it."
            )


def _require_own_shards(plan: ShardPlan, out: Path) -> None:
    """Refuse a folder without the plan's note that holds anything else than the plan's shards.

    Shards that hold the plan's files by name may be finished ones whose notes were removed: they
    are compared byte for byte when their turn comes.
    """
    _require_no_others(plan, out)
    ours = [shard for shard in plan.shards if (out / shard.name).exists()]
    for shard in ours:
        path = out / shard.name
        try:
            with path.open("rb") as file:
                found = read_members(file, path.stat().st_size, where=str(path))
            is_ours = [each.name for each in found] == [each.name for each in shard.members]
        except ShardError:
            is_ours = False
        if not is_ours:
            raise _not_ours(path)
    if not ours and (out / INDEX_NAME).exists():
        raise _not_ours(out / INDEX_NAME)


def _not_ours(path: Path) -> ShardError:
    return ShardError(
        f"{path}: is there, and was not packed here by this plan. Move it away, or pack into an "
        f"empty folder."
    )


def _require_no_others(plan: ShardPlan, out: Path) -> None:
    """Refuse a folder with a shard that is none of the plan's."""
    known = {shard.name for shard in plan.shards}
    for path in sorted(out.iterdir()) if out.exists() else []:
        name = path.name.removesuffix(UNFINISHED)
        if name.endswith(".tar") and name not in known:
            raise ShardError(
                f"{path}: is there, and is no shard of this plan. Move it away, or pack into an "
                f"empty folder."
            )
