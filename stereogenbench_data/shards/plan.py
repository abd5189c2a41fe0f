"""The plan of a pack: which scene goes into which shard. It is made before anything is written.

A shard holds whole scenes of one split, subset and family, in the order of their keys. The same
release and target size always give the same plan.
"""

import hashlib
import json
import re
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Final, Literal

from stereogenbench_data.errors import ShardError
from stereogenbench_data.index.left_out import are_few
from stereogenbench_data.index.rows import row_of
from stereogenbench_data.index.table import IncompleteSceneWarning, SceneIndex
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.schema.release import (
    CAMERA_COUNT,
    METADATA_FILES,
    PACKED_DEPTH_NAMES,
    TRAINING_JSON,
    TRAJECTORY_JSON,
    depth_name,
    rgb_name,
)
from stereogenbench_data.shards.tar import BLOCK_BYTES, END_OF_ARCHIVE, padded, require_member
from stereogenbench_data.shards.training import (
    TrainingSettings,
    derived_names,
    expected_bytes,
)

DepthCodec = Literal["released", "blosc2"]
"""How shards store depth: as the released videos, or as blosc2 frames, which decode faster."""

DEFAULT_SHARD_BYTES: Final = 2_000_000_000

SCENE_TEXTS: Final = (*METADATA_FILES, TRAINING_JSON)
"""The metadata files that a scene in shards may have."""

MEMBER_ORDER: Final = (
    *SCENE_TEXTS,
    *(name(camera) for camera in range(CAMERA_COUNT) for name in (rgb_name, depth_name)),
)
"""The order of a scene's files in a shard: metadata first, then camera by camera."""

_UNITS: Final = {"": 1} | {
    unit + binary: (1024 if binary else 1000) ** power
    for power, unit in enumerate("kmgt", 1)
    for binary in ("", "i")
}
_SIZE: Final = re.compile(r"(\d+(?:\.\d+)?) ?([kmgt]?i?)b?", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class PlannedMember:
    """A file of a scene: its name in the shard, and the released file that it is made from.

    ``source`` is relative to the release's root, and empty for files that are to be derived.
    ``size`` is that of the source, which is also the member's unless depth is packed; of derived
    files, about what they will have.
    """

    name: str
    source: str
    size: int


@dataclass(frozen=True, slots=True)
class PlannedShard:
    """A planned shard: its file's name and size in bytes, and its scenes."""

    name: str
    size: int
    scenes: tuple[Scene, ...]

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys of its scenes, in order."""
        return tuple(scene.id.key for scene in self.scenes)


@dataclass(frozen=True, slots=True)
class ShardPlan:
    """All shards of a release.

    Attributes:
        root: The release's folder.
        shards: The shards, in the order of their names.
        settings: What the plan is, as the folder of the shards keeps it in ``plan.json``.
    """

    root: str
    shards: tuple[PlannedShard, ...]
    settings: dict[str, Any]

    @property
    def digest(self) -> str:
        """A sha256 of the target size, of all names and sizes and of what the index says.

        Of training shards, also of their settings and of the source's index. It does not depend on
        the root.
        """
        return str(self.settings["plan"])


def plan_shards(
    index: SceneIndex,
    target_bytes: int = DEFAULT_SHARD_BYTES,
    *,
    depth_codec: DepthCodec = "released",
    training: TrainingSettings | None = None,
    rows: Sequence[int] | None = None,
) -> ShardPlan:
    """Return the plan that packs the scenes of an index, without a few that lack a file.

    Args:
        index: The data; a released folder, unless training shards are made.
        target_bytes: The largest size of a shard.
        depth_codec: How depth is stored; training shards have blosc2's frames.
        training: What training shards hold; None packs released files as they are.
        rows: The scenes to pack; None is all.

    Raises:
        ShardError: If the data are packed already or remote (training shards may be made of such),
            or derived already; no scene is selected, or many lack a file; or the target is below 1.
    """
    _require_released(index, training=training)
    if rows is not None and not len(rows):
        raise ShardError(f"{index.where}: no scene is selected. Check the filters.")
    if target_bytes < 1:
        raise ShardError(f"the size of a shard must be at least 1 byte, got {target_bytes}.")
    scenes = sorted(
        map(index.scene, _whole_rows(index, rows)),
        key=lambda scene: (_group_of(scene), scene.id.key),
    )
    shards: list[PlannedShard] = []
    planned: dict[str, list[PlannedMember]] = {}
    for group, of_group in groupby(scenes, key=_group_of):
        before = len(shards)
        for scene in of_group:
            members = planned_members(scene, depth_codec=depth_codec, training=training)
            planned[scene.id.key] = members
            size = _tar_bytes(members)
            if len(shards) > before and shards[-1].size + size <= target_bytes:
                last = shards.pop()
                shards.append(PlannedShard(last.name, last.size + size, (*last.scenes, scene)))
            else:
                name = f"{group}-{len(shards) - before:06d}.tar"
                shards.append(PlannedShard(name, len(END_OF_ARCHIVE) + size, (scene,)))
    content = [
        [
            shard.name,
            shard.size,
            [[member.name, member.size] for key in shard.keys for member in planned[key]],
            [_facts_of(scene) for scene in shard.scenes],
        ]
        for shard in shards
    ]
    whole: list[Any] = [target_bytes, content]
    settings: dict[str, Any] = {"target_bytes": target_bytes, "shards": len(shards)}
    if depth_codec != "released":
        settings["depth"] = depth_codec
    if training is not None:
        settings["training"] = training.describe()
        whole += [training.describe(), index.digest]
    text = json.dumps(whole, separators=(",", ":"))
    digest = hashlib.sha256(text.encode()).hexdigest()
    return ShardPlan(index.root, tuple(shards), {"plan": digest} | settings)


def _facts_of(scene: Scene) -> dict[str, Any]:
    """Return a scene's row in the index, without the places of its files."""
    row = row_of(scene)
    del row["members"], row["valid_depth_ratio"]
    return row


def packed_bytes(
    scene: Scene, *, depth_codec: DepthCodec = "released", training: TrainingSettings | None = None
) -> int:
    """Return the bytes of a scene in shards, with its share of a tar's own at most.

    Packed depth counts with its released size; of training shards it is an estimate.

    Raises:
        ShardError: If the scene cannot be packed.
    """
    members = planned_members(scene, depth_codec=depth_codec, training=training)
    return len(END_OF_ARCHIVE) + _tar_bytes(members)


def planned_members(
    scene: Scene, *, depth_codec: DepthCodec, training: TrainingSettings | None = None
) -> list[PlannedMember]:
    """Return the files of a scene in a shard, in their order.

    Raises:
        ShardError: If the scene cannot be packed.
    """
    if training is None:
        planned = _released(scene, depth_codec)
    else:
        planned = [
            PlannedMember(f"{scene.id.key}.{name}", "", expected_bytes(scene, name, training))
            for name in derived_names(scene, training)
        ]
    for member in planned:
        require_member(member.name, member.size)
    return planned


def _tar_bytes(members: Iterable[PlannedMember]) -> int:
    return sum(BLOCK_BYTES + padded(member.size) for member in members)


def parse_bytes(text: str) -> int:
    """Return a size in bytes: ``500MB`` is in powers of 1000, ``2GiB`` in powers of 1024.

    Raises:
        ShardError: If the text is not a size, or less than a byte.

    >>> parse_bytes("2GB"), parse_bytes("1.5 GiB"), parse_bytes("4096")
    (2000000000, 1610612736, 4096)
    """
    match = _SIZE.fullmatch(text.strip())
    unit = _UNITS.get(match[2].lower()) if match else None
    size = int(float(match[1]) * unit) if match and unit else 0
    if size < 1:
        raise ShardError(f"{text!r} is not a size: write one such as 500MB, 2GB or 2GiB.")
    return size


def _require_released(index: SceneIndex, *, training: TrainingSettings | None) -> None:
    if index.is_derived:
        raise ShardError(
            f"{index.where}: holds {index.derivation}. Pack the released data instead: what is "
            f"derived twice has both errors."
        )
    if index.shards and training is None:
        raise ShardError(
            f"{index.where}: already holds shards. To pack again, run `stereogenbench unpack`, and "
            f"pass the folder that it made."
        )
    if "://" in index.root and training is None:
        raise ShardError(f"{index.where}: is remote. Download the release, and pass its folder.")


def _whole_rows(index: SceneIndex, rows: Sequence[int] | None) -> list[int]:
    """Return the rows without the few scenes that lack a file, which a warning names.

    Raises:
        ShardError: If no row is left, or more than a few scenes lack a file.
    """
    chosen = list(range(len(index))) if rows is None else list(map(int, rows))
    remarked = {row: index.scene(row) for row in index.remarked("poses").tolist()}
    reasons = {row: scene.remark("poses") for row, scene in remarked.items()
               if TRAJECTORY_JSON not in scene.members}  # fmt: skip
    if {*chosen} <= {*reasons}:
        reasons = {}  # data without poses
    reasons |= {row: index.scene(row).remark("videos") for row in index.remarked("videos").tolist()}
    lacking = [row for row in chosen if row in reasons]
    if not lacking:
        return chosen
    told = (
        f"{index.where}: shards hold whole scenes, and {len(lacking)} of {len(chosen)} "
        f"{'lacks' if len(lacking) == 1 else 'lack'} a file. "
        f"The first: {reasons[lacking[0]].removesuffix('.')}."
    )
    if len(lacking) == len(chosen) or not are_few(len(lacking), of=len(chosen)):
        raise ShardError(
            f"{told} Fetch these scenes again or remove them, and run `stereogenbench index` again."
        )
    names = ", ".join(index.scene(row).id.key for row in lacking[:3])
    warnings.warn(f"{told} Left out: {names}.", IncompleteSceneWarning, stacklevel=5)
    return [row for row in chosen if row not in reasons]


def _group_of(scene: Scene) -> str:
    """Return what the names of the scene's shards begin with."""
    place = scene.id
    subset = [place.subset or "unnamed"] if place.split == "eval" else []
    return "-".join([place.split, *subset, place.family])


def _released(scene: Scene, depth_codec: DepthCodec) -> list[PlannedMember]:
    if not scene.members.keys().isdisjoint(PACKED_DEPTH_NAMES.values()):
        raise ShardError(
            f"{scene.id.key}: its depth is packed by blosc2, but shards are made from released "
            f"videos. Run `stereogenbench unpack` on its shards, and pass the folder that it made."
        )
    packed = {} if depth_codec == "released" else PACKED_DEPTH_NAMES
    return [
        PlannedMember(
            f"{scene.id.key}.{packed.get(name, name)}",
            scene.members[name].path,
            scene.members[name].size,
        )
        for name in MEMBER_ORDER
        if name in scene.members
    ]
