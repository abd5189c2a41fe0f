"""Which scene goes into which shard: decided before a byte is written, the same every time.

A shard holds whole scenes of one split, subset and family, in the order of their keys.
"""

import hashlib
import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby
from typing import Final, Literal

from stereogenbench_data.errors import ShardError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.schema.release import (
    CAMERA_COUNT,
    METADATA_FILES,
    PACKED_DEPTH_NAMES,
    depth_name,
    rgb_name,
)
from stereogenbench_data.shards.tar import BLOCK_BYTES, END_OF_ARCHIVE, member_header, padded

DepthCodec = Literal["released", "blosc2"]
"""How depth lies in shards: in the released videos, or in blosc2's frames, which decode faster."""

DEFAULT_SHARD_BYTES: Final = 2_000_000_000

MEMBER_ORDER: Final = (
    *METADATA_FILES,
    *(name(camera) for camera in range(CAMERA_COUNT) for name in (rgb_name, depth_name)),
)
"""The order of a scene's files in a shard: small texts first, then camera by camera."""

_UNITS: Final = {"": 1, "k": 1000, "m": 1000**2, "g": 1000**3, "t": 1000**4}
_BINARY_UNITS: Final = {"ki": 1024, "mi": 1024**2, "gi": 1024**3, "ti": 1024**4}
_SIZE: Final = re.compile(r"(\d+(?:\.\d+)?) ?([kmgt]?i?)b?", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class PlannedMember:
    """A file of a scene: its name in the shard, and the file below the root that it is made from.

    ``size`` is that of the source; so is the member's, if it is the released file unchanged.
    """

    name: str
    source: str
    size: int
    form: DepthCodec = "released"


@dataclass(frozen=True, slots=True)
class PlannedShard:
    """A shard to be: its file's name and size in bytes, its scenes and their files in order."""

    name: str
    size: int
    scenes: tuple[Scene, ...]
    members: tuple[PlannedMember, ...]

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys of its scenes, in order."""
        return tuple(scene.id.key for scene in self.scenes)

    @property
    def source_bytes(self) -> int:
        """The size of all files that it is made from."""
        return sum(member.size for member in self.members)


@dataclass(frozen=True, slots=True)
class ShardPlan:
    """All shards of a release.

    Attributes:
        root: The folder below which the files lie.
        target_bytes: The size that a shard does not exceed, unless one scene alone does; depth
            that is packed anew counts with its released size.
        digest: sha256 of what goes where: of the target, and of all names and sizes. It does not
            depend on where the files lie.
        depth_codec: How depth lies in the shards.
    """

    root: str
    target_bytes: int
    shards: tuple[PlannedShard, ...]
    digest: str
    depth_codec: DepthCodec = "released"

    @property
    def oversized(self) -> tuple[PlannedShard, ...]:
        """The shards that exceed the target because their one scene does."""
        return tuple(shard for shard in self.shards if shard.size > self.target_bytes)


def plan_shards(
    index: SceneIndex,
    target_bytes: int = DEFAULT_SHARD_BYTES,
    *,
    depth_codec: DepthCodec = "released",
) -> ShardPlan:
    """Return the plan that packs the scenes of an index.

    Raises:
        ShardError: If the data are packed already or far away, scenes were left out of the index
            as broken, the target is no size, or two files would have one name.
    """
    _require_released(index)
    if target_bytes < 1:
        raise ShardError(f"the size of a shard must be at least 1 byte, got {target_bytes}.")
    scenes = sorted((index.scene(row) for row in range(len(index))), key=_group_and_key)
    shards = tuple(
        shard
        for group, members in groupby(scenes, key=_group_of)
        for shard in _filled(group, members, target_bytes=target_bytes, depth_codec=depth_codec)
    )
    _require_distinct(shard.name for shard in shards)
    content = [
        [shard.name, shard.size, [[member.name, member.size] for member in shard.members]]
        for shard in shards
    ]
    content_text = json.dumps([target_bytes, content], separators=(",", ":"))
    digest = hashlib.sha256(content_text.encode()).hexdigest()
    return ShardPlan(index.root, target_bytes, shards, digest, depth_codec)


def parse_size(text: str) -> int:
    """Return a number of bytes: ``500MB`` is in powers of 1000, ``2GiB`` in powers of 1024.

    Raises:
        ShardError: If the text is no size, or less than a byte.

    >>> parse_size("2GB"), parse_size("1.5 GiB"), parse_size("4096")
    (2000000000, 1610612736, 4096)
    """
    match = _SIZE.fullmatch(text.strip())
    unit = (_UNITS | _BINARY_UNITS).get(match[2].lower()) if match else None
    size = int(float(match[1]) * unit) if match and unit else 0
    if size < 1:
        raise ShardError(f"{text!r} is no size of a shard: write one such as 500MB, 2GB or 2GiB.")
    return size


def _require_released(index: SceneIndex) -> None:
    if index.shards:
        raise ShardError(
            f"{index.where}: holds shards already. To pack again, run `stereogenbench unpack`, and "
            f"pass the folder that it made."
        )
    if "://" in index.root:
        raise ShardError(f"{index.where}: is far away. Fetch the release, and pass its folder.")
    if index.broken:
        names = ", ".join(sorted(index.broken)[:3])
        raise ShardError(
            f"{index.where}: its index leaves out {len(index.broken)} broken scenes ({names}). "
            f"Repair or remove them, and run `stereogenbench index` again."
        )


def _group_of(scene: Scene) -> str:
    place = scene.id
    parts = [place.split, place.family]
    if place.split == "eval":
        parts.insert(1, place.subset or "unnamed")
    return "-".join(parts)


def _group_and_key(scene: Scene) -> tuple[str, str]:
    return _group_of(scene), scene.id.key


def _filled(
    group: str, scenes: Iterable[Scene], *, target_bytes: int, depth_codec: DepthCodec
) -> Iterator[PlannedShard]:
    """Yield shards of one group, each as full as the order allows."""
    number = 0
    held: list[Scene] = []
    members: list[PlannedMember] = []
    size = len(END_OF_ARCHIVE)
    for scene in scenes:
        added = _members_of(scene, depth_codec)
        added_bytes = sum(BLOCK_BYTES + padded(member.size) for member in added)
        if held and size + added_bytes > target_bytes:
            yield PlannedShard(f"{group}-{number:06d}.tar", size, tuple(held), tuple(members))
            held, members, size, number = [], [], len(END_OF_ARCHIVE), number + 1
        held.append(scene)
        members += added
        size += added_bytes
    yield PlannedShard(f"{group}-{number:06d}.tar", size, tuple(held), tuple(members))


def _members_of(scene: Scene, depth_codec: DepthCodec) -> list[PlannedMember]:
    unknown = sorted(set(scene.members) - set(MEMBER_ORDER))
    if not scene.members.keys().isdisjoint(PACKED_DEPTH_NAMES.values()):
        raise ShardError(
            f"{scene.id.key}: its depth is packed by blosc2, and shards are packed from released "
            f"videos. Run `stereogenbench unpack` on its shards, and pass the folder that it made."
        )
    if unknown:
        raise ShardError(
            f"{scene.id.key}: its index names {', '.join(unknown)}, which is no file of a scene. "
            f"Run `stereogenbench index` again."
        )
    packed = {} if depth_codec == "released" else PACKED_DEPTH_NAMES
    planned = [
        PlannedMember(
            f"{scene.id.key}.{packed.get(name, name)}",
            scene.members[name].path,
            scene.members[name].size,
            depth_codec if name in packed else "released",
        )
        for name in MEMBER_ORDER
        if name in scene.members
    ]
    for member in planned:
        member_header(member.name, member.size)
    return planned


def _require_distinct(names: Iterable[str]) -> None:
    """Refuse names that one file would have on a disk that ignores case."""
    known: dict[str, str] = {}
    for name in names:
        other = known.setdefault(name.casefold(), name)
        if other != name:
            raise ShardError(
                f"{name} and {other} would be one file where case does not count. Rename one of "
                f"the two families' folders."
            )
