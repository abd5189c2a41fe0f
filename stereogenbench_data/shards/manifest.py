"""The manifest of a finished shard, ``OUT/.parts/<shard>.json``, written just before its rename.

A shard with a manifest that still fits it is finished: a later run keeps it.
"""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from stereogenbench_data.index.rows import row_of
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.shards.plan import PlannedMember, PlannedShard
from stereogenbench_data.sources.files import write_atomic

PARTS: Final = ".parts"
"""Folder beside the shards that holds their manifests and locks."""


@dataclass(frozen=True, slots=True)
class ShardTask:
    """A shard to be packed, with all that another process needs for it."""

    shard: PlannedShard
    root: str
    out: str
    plan_digest: str

    @property
    def target(self) -> Path:
        """Where the shard is to lie."""
        return Path(self.out, self.shard.name)

    @property
    def manifest(self) -> Path:
        """Where its manifest is written."""
        return self.target.parent / PARTS / f"{self.target.stem}.json"


@dataclass(frozen=True, slots=True)
class PackedShard:
    """A finished shard; places and checksums are of its planned members, in their order."""

    name: str
    size: int
    sha256: str
    offsets: tuple[int, ...]
    sizes: tuple[int, ...]
    crc32s: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class SourceStamp:
    """A source as it was when it was packed: size, time of change, and crc32 of all its bytes."""

    size: int
    modified_ns: int
    crc32: int


@dataclass(frozen=True, slots=True)
class ShardManifest:
    """A finished shard: its places and checksums, when it was written, and what it was made from.

    Attributes:
        packed: The shard.
        modified_ns: When its file was written, by the file system.
        sources: The files that its planned members were made from, in their order.
        rows: Scene's key to the digest of its row of the index.
    """

    packed: PackedShard
    modified_ns: int
    sources: tuple[SourceStamp, ...]
    rows: dict[str, str]

    def members(self, task: ShardTask) -> Iterator[tuple[PlannedMember, SourceStamp, int]]:
        """Yield each planned member with its source and with its place in the shard."""
        yield from zip(task.shard.members, self.sources, self.packed.offsets, strict=True)


def row_digest(scene: Scene) -> str:
    """Return a digest of what an index says of a scene, but for where its files lie."""
    row = row_of(scene)
    del row["members"], row["valid_depth_ratio"]
    return hashlib.sha256(json.dumps(row, sort_keys=True).encode()).hexdigest()


def read_manifest(task: ShardTask) -> ShardManifest | None:
    """Return the manifest that this plan wrote of a shard, None if none can be used."""
    try:
        found = json.loads(task.manifest.read_bytes())
        manifest = ShardManifest(
            PackedShard(
                found["name"], found["size"], found["sha256"], tuple(found["offsets"]),
                tuple(found["sizes"]), tuple(found["crc32s"]),
            ),
            found["modified_ns"],
            tuple(SourceStamp(*seen) for seen in found["sources"]),
            dict(found["rows"]),
        )  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError):
        return None
    is_ours = found.get("plan") == task.plan_digest and manifest.packed.name == task.shard.name
    packed = manifest.packed
    listed = (packed.offsets, packed.sizes, packed.crc32s, manifest.sources)
    counts = set(map(len, listed))
    return manifest if is_ours and counts == {len(task.shard.members)} else None


def write_manifest(task: ShardTask, manifest: ShardManifest) -> None:
    """Write the manifest of a finished shard, whole or not at all.

    Raises:
        OSError: If the manifest cannot be written.
    """
    content = asdict(manifest.packed) | {
        "plan": task.plan_digest,
        "modified_ns": manifest.modified_ns,
        "members": [member.name for member in task.shard.members],
        "sources": [[seen.size, seen.modified_ns, seen.crc32] for seen in manifest.sources],
        "rows": manifest.rows,
    }
    write_atomic(task.manifest, json.dumps(content).encode())


def find_packed(task: ShardTask) -> PackedShard | None:
    """Return a shard that this plan has packed before, None if it is to be packed or looked at.

    A shard whose size or time of change is not that of its manifest may be another.
    """
    manifest = read_manifest(task)
    try:
        status = task.target.stat()
    except OSError:
        return None
    if manifest is None or (manifest.packed.size, manifest.modified_ns) != (
        status.st_size,
        status.st_mtime_ns,
    ):
        return None
    return manifest.packed
