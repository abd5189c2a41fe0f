"""What is noted of a finished shard in ``OUT/.parts/<shard>.json``, just before it gets its name.

A shard that has its note and is as it was then is finished: a later run keeps it.
"""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from stereogenbench_data.index.rows import row_of
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.shards.plan import PlannedMember, PlannedShard
from stereogenbench_data.sources.files import PARTS, write_atomic


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
    def note(self) -> Path:
        """Where it is noted that it is finished."""
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
class SeenFile:
    """A source as it was when it was packed: size, time of change, and crc32 of all its bytes."""

    size: int
    modified_ns: int
    crc32: int


@dataclass(frozen=True, slots=True)
class ShardNote:
    """What is noted: the shard, when it was last written, and what it was made from.

    Attributes:
        packed: The shard.
        modified_ns: When its file was written, by the file system.
        sources: The files that its planned members were made from, in their order.
        rows: Scene's key to the digest of its row of the index.
    """

    packed: PackedShard
    modified_ns: int
    sources: tuple[SeenFile, ...]
    rows: dict[str, str]

    def members(self, task: ShardTask) -> Iterator[tuple[PlannedMember, SeenFile, int]]:
        """Yield each planned member with its source and with its place in the shard."""
        yield from zip(task.shard.members, self.sources, self.packed.offsets, strict=True)


def row_digest(scene: Scene) -> str:
    """Return a digest of what an index says of a scene, but for where its files lie."""
    row = row_of(scene)
    del row["members"], row["valid_depth_ratio"]
    return hashlib.sha256(json.dumps(row, sort_keys=True).encode()).hexdigest()


def read_note(task: ShardTask) -> ShardNote | None:
    """Return what a run of this plan noted of a shard, None if nothing that can be used."""
    try:
        noted = json.loads(task.note.read_bytes())
        note = ShardNote(
            PackedShard(
                noted["name"], noted["size"], noted["sha256"], tuple(noted["offsets"]),
                tuple(noted["sizes"]), tuple(noted["crc32s"]),
            ),
            noted["modified_ns"],
            tuple(SeenFile(*seen) for seen in noted["sources"]),
            dict(noted["rows"]),
        )  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError):
        return None
    is_ours = noted.get("plan") == task.plan_digest and note.packed.name == task.shard.name
    packed = note.packed
    listed = (packed.offsets, packed.sizes, packed.crc32s, note.sources)
    counts = set(map(len, listed))
    return note if is_ours and counts == {len(task.shard.members)} else None


def write_note(task: ShardTask, note: ShardNote) -> None:
    """Note a finished shard, whole or not at all.

    Raises:
        OSError: If the note cannot be written.
    """
    told = asdict(note.packed) | {
        "plan": task.plan_digest,
        "modified_ns": note.modified_ns,
        "members": [member.name for member in task.shard.members],
        "sources": [[seen.size, seen.modified_ns, seen.crc32] for seen in note.sources],
        "rows": note.rows,
    }
    write_atomic(task.note, json.dumps(told).encode())


def find_packed(task: ShardTask) -> PackedShard | None:
    """Return a shard that this plan has packed before, None if it is to be packed or looked at.

    A shard whose size or time of change is not the noted one may be another.
    """
    note = read_note(task)
    try:
        status = task.target.stat()
    except OSError:
        return None
    if note is None or (note.packed.size, note.modified_ns) != (status.st_size, status.st_mtime_ns):
        return None
    return note.packed
