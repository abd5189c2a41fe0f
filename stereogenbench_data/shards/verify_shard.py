"""Verifying one shard: its structure, every byte, and its metadata against their index."""

import io
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from stereogenbench_data.engine import Advance
from stereogenbench_data.errors import ShardError, cure_of
from stereogenbench_data.index.scene_folder import metadata_differences
from stereogenbench_data.schema.records import Member, Scene, ShardFacts
from stereogenbench_data.schema.release import METADATA_FILES
from stereogenbench_data.schema.text import counted
from stereogenbench_data.shards.tar import TarMember, read_checksums, read_members
from stereogenbench_data.shards.verify_decode import Problem

FETCH: Final = "Fetch the shard again, or pack it again."
WRONG_INDEX: Final = "Put the index beside the shards that it was packed with."
_FETCH_BOTH: Final = "Fetch the shard and its index again, or pack them again."
_SHOWN: Final = 3


@dataclass(frozen=True, slots=True)
class ExpectedShard:
    """What the index says of one shard: facts, scenes, and members by their whole name."""

    root: str
    shard: str
    facts: ShardFacts
    scenes: list[Scene] = field(default_factory=list)
    members: dict[str, Member] = field(default_factory=dict)

    def problem(self, name: str, found: str, cure: str = FETCH) -> Problem:
        """Return a problem of the member of that name, or of the shard for an empty one."""
        scene, _, member = name.partition(".")
        return Problem(self.shard, scene, member, found, cure)


@dataclass(slots=True)
class CheckedShard:
    """What was found out about a shard; ``sound`` names the members that are as they were."""

    problems: list[Problem] = field(default_factory=list)
    sound: set[str] = field(default_factory=set)


def check_shard(expected: ExpectedShard, after_bytes: Advance) -> CheckedShard:
    """Read a shard through and return what is wrong with it; a worker process calls this."""
    path = Path(expected.root, expected.shard)
    try:
        with path.open("rb", buffering=0) as file:
            return _checked(expected, file, path.stat().st_size, after_bytes)
    except OSError as error:
        told = f"cannot be read ({error.strerror or error})"
        return CheckedShard([expected.problem("", told, cure_of(error, FETCH))])


def _checked(
    expected: ExpectedShard, file: io.FileIO, size: int, after_bytes: Advance
) -> CheckedShard:
    checked = CheckedShard()
    try:
        found = {each.name: each for each in read_members(file, size, where=expected.shard)}
    except ShardError as error:
        told = str(error).removeprefix(f"{expected.shard}: ").removesuffix(f" {FETCH}")
        checked.problems.append(expected.problem("", told.rstrip(".")))
        checked.problems += _cut_off(expected, size)
        placed = {
            name: each for name, each in expected.members.items() if each.offset + each.size <= size
        }
    else:
        checked.problems += _differing(expected, found)
        placed = {
            name: each
            for name, each in expected.members.items()
            if found.get(name) == TarMember(name, each.offset, each.size)
        }
    parts = _apart(placed)
    checksums = read_checksums(
        file,
        size,
        parts=[(each.offset, each.size) for each in parts.values()],
        after_bytes=after_bytes,
    )
    for (name, member), crc32 in zip(parts.items(), checksums.crc32s, strict=True):
        if crc32 == member.crc32:
            checked.sound.add(name)
            continue
        told = "none is" if member.crc32 is None else f"{member.crc32:08x} is"
        found_crc = f"its bytes have crc32 {crc32:08x}, and by the index {told} right"
        checked.problems.append(expected.problem(name, found_crc))
    checked.problems += _misindexed(expected, file, checked.sound)
    facts = expected.facts
    if not checked.problems and (size, checksums.sha256) != (facts.size, facts.sha256):
        told = (
            f"all members are whole, and yet the file has {size} bytes with sha256 "
            f"{checksums.sha256[:16]}..., and by the index {facts.size} with {facts.sha256[:16]}..."
        )
        checked.problems.append(expected.problem("", told))
    return checked


def _cut_off(expected: ExpectedShard, size: int) -> Iterator[Problem]:
    """Yield a problem for each scene of which members lie beyond the end of the file."""
    of_scene = defaultdict(list)
    for name, member in expected.members.items():
        if member.offset + member.size > size:
            of_scene[name.partition(".")[0]].append(name.partition(".")[2])
    for scene, names in of_scene.items():
        yield expected.problem(scene, f"{len(names)} of its files are cut off ({_few(names)})")


def _misindexed(expected: ExpectedShard, file: io.FileIO, sound: set[str]) -> Iterator[Problem]:
    """Yield where the index tells a scene otherwise than the metadata that lie in the shard."""
    for scene in expected.scenes:
        texts = {}
        for name in METADATA_FILES:
            member = scene.members.get(name)
            if member is not None and f"{scene.id.key}.{name}" in sound:
                file.seek(member.offset)
                texts[name] = file.read(member.size)
        for name, told in metadata_differences(scene, texts):
            yield Problem(expected.shard, scene.id.key, name, told, _FETCH_BOTH)


def _few(names: list[str]) -> str:
    return ", ".join([*names[:_SHOWN], "..."] if len(names) > _SHOWN else names)


def _differing(expected: ExpectedShard, found: dict[str, TarMember]) -> Iterator[Problem]:
    """Yield what differs between the members that are there and those of the index."""
    scenes, told = (
        {name.partition(".")[0] for name in names} for names in (found, expected.members)
    )
    if told < scenes:
        added = sorted(name for name in found if name not in expected.members)
        text = (
            f"holds {counted(len(added), 'member')} that the index does not place in it "
            f"({_few(added)}): something was appended, or the index is of another pack"
        )
        yield expected.problem("", text, _FETCH_BOTH)
        return
    if scenes != told:
        text = (
            f"holds other scenes than the index says: {len(scenes - told)} unknown, "
            f"{len(told - scenes)} not there ({_few(sorted(scenes ^ told))}); shard and index are "
            f"of different packs"
        )
        yield expected.problem("", text, WRONG_INDEX)
        return
    for name in sorted(found.keys() | expected.members.keys()):
        here, member = found.get(name), expected.members.get(name)
        if here is None:
            yield expected.problem(name, "is missing")
        elif member is None:
            yield expected.problem(name, "is there, and the index does not know it")
        elif (here.offset, here.size) != (member.offset, member.size):
            yield expected.problem(
                name,
                f"has {here.size} bytes from byte {here.offset} on, and by the index "
                f"{member.size} from {member.offset} on",
            )


def _apart(members: dict[str, Member]) -> dict[str, Member]:
    """Return members in the order of their bytes, without any that begins inside another.

    Only an altered index has such, and only beside a tar that cannot be read: that is told.
    """
    apart: dict[str, Member] = {}
    end = 0
    for name, member in sorted(members.items(), key=lambda item: item[1].offset):
        if member.offset >= end:
            apart[name] = member
            end = member.offset + member.size
    return apart
