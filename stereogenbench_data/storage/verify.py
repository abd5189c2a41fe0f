"""Verifying shards against their index: every byte, and with "decode" every picture.

A shard that is wrong does not stop the rest: all that is wrong is gathered, each with its cure.
"""

import io
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

from stereogenbench_data.errors import ShardError
from stereogenbench_data.schema.records import Member, ShardFacts
from stereogenbench_data.storage.index import INDEX_NAME, SceneIndex
from stereogenbench_data.storage.pool import AfterBytes, run_tasks
from stereogenbench_data.storage.shard_writer import UNFINISHED
from stereogenbench_data.storage.tar import TarMember, read_checksums, read_members
from stereogenbench_data.storage.unfinished import PARTS
from stereogenbench_data.storage.verify_decode import (
    Problem,
    decode_scene,
    decode_tasks,
    video_bytes,
)

Progress = Callable[[int, int], None]

_FETCH: Final = "Fetch the shard again, or pack it again."
_WRONG_INDEX: Final = "Put the index beside the shards that it was packed with."
_SHOWN: Final = 3


@dataclass(frozen=True, slots=True)
class VerifyReport:
    """What was looked at and what is wrong, in the order of shards, scenes and members."""

    root: str
    shards: int
    scenes: int
    members: int
    bytes: int
    videos_decoded: int
    problems: tuple[Problem, ...]


@dataclass(frozen=True, slots=True)
class _Expected:
    """What the index says of one shard: facts, and members by their whole name."""

    root: str
    shard: str
    facts: ShardFacts
    members: dict[str, Member] = field(default_factory=dict)

    def problem(self, name: str, found: str, cure: str = _FETCH) -> Problem:
        """Return a problem of the member of that name, or of the shard for an empty one."""
        scene, _, member = name.partition(".")
        return Problem(self.shard, scene, member, found, cure)


def verify(
    data: str | Path,
    *,
    mode: Literal["bytes", "decode"] = "bytes",
    workers: int | None = None,
    progress: Progress | None = None,
) -> VerifyReport:
    """Compare shards with their index.

    Args:
        data: The folder of the shards, or its index file.
        mode: "bytes" reads all bytes; "decode" then decodes all frames of all videos, too.
        workers: Processes that work at the same time; None is one a core.
        progress: Called now and then with the bytes done, and all there are; with "decode" those
            of videos count twice.

    Raises:
        StorageError: If there is no index, it is not one of shards, or a worker died.
    """
    index = _opened(data)
    expected = _expected_of(index)
    problems = list(_folder_problems(index, expected))
    checks = [each for each in expected.values() if Path(each.root, each.shard).is_file()]
    scenes = [index.scene(row) for row in range(len(index))] if mode == "decode" else []
    total = sum(each.facts.size for each in checks) + sum(map(video_bytes, scenes))
    done = 0

    def after_bytes(count: int) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress(min(done, total), total)

    sound: set[str] = set()
    for checked in run_tasks(_check_shard, checks, workers=workers, after_bytes=after_bytes):
        problems += checked.problems
        sound |= checked.sound
    tasks = decode_tasks(scenes, index.root, sound)
    for found in run_tasks(decode_scene, tasks, workers=workers, after_bytes=after_bytes):
        problems += found
    return VerifyReport(
        root=index.root,
        shards=len(expected),
        scenes=len(index),
        members=sum(len(each.members) for each in expected.values()),
        bytes=sum(each.facts.size for each in expected.values()),
        videos_decoded=sum(len(task.names) for task in tasks),
        problems=tuple(sorted(problems, key=lambda p: (p.shard, p.scene, p.member, p.found))),
    )


def _opened(data: str | Path) -> SceneIndex:
    if "://" in str(data):
        raise ShardError(f"{data}: is far away. Fetch the shards, and pass their folder.")
    path = Path(data)
    if path.is_dir() and not (path / INDEX_NAME).is_file():
        begun = (path / PARTS).is_dir()
        raise ShardError(
            f"{path}: holds no {INDEX_NAME}. "
            + ("Packing was not finished: run `stereogenbench pack` again." if begun else
               "Point at a folder that `stereogenbench pack` made.")
        )  # fmt: skip
    index = SceneIndex.open(path)
    if not index.shards:
        raise ShardError(
            f"{path}: is the index of a released folder, not of shards. Pack it with "
            f"`stereogenbench pack`, or point at the shards."
        )
    return index


def _expected_of(index: SceneIndex) -> dict[str, _Expected]:
    expected = {
        name: _Expected(index.root, name, facts) for name, facts in sorted(index.shards.items())
    }
    for scene in map(index.scene, range(len(index))):
        for name, member in scene.members.items():
            if member.path not in expected:
                raise ShardError(
                    f"{index.root}: its index places {scene.id.key}.{name} in {member.path} and "
                    f"knows no such shard. The index was altered: fetch it again."
                )
            expected[member.path].members[f"{scene.id.key}.{name}"] = member
    return expected


def _folder_problems(index: SceneIndex, expected: dict[str, _Expected]) -> Iterator[Problem]:
    there = {path.name for path in Path(index.root).iterdir()}
    for each in expected.values():
        if not Path(each.root, each.shard).is_file():
            scenes = len({name.partition(".")[0] for name in each.members})
            what = "is no file" if each.shard in there else "is missing"
            yield each.problem("", f"{what}, with {scenes} scenes", _FETCH)
    for name in sorted(there - expected.keys()):
        if name.endswith(".tar"):
            yield Problem(name, "", "", "is there, and the index does not know it", _WRONG_INDEX)
        elif name.endswith(f".tar{UNFINISHED}"):
            cure = "Run `stereogenbench pack` again, or remove it."
            yield Problem(name, "", "", "is an unfinished shard", cure)


@dataclass(slots=True)
class _Checked:
    """What was found out about a shard; ``sound`` names the members that are as they were."""

    problems: list[Problem] = field(default_factory=list)
    sound: set[str] = field(default_factory=set)


def _check_shard(expected: _Expected, after_bytes: AfterBytes) -> _Checked:
    path = Path(expected.root, expected.shard)
    try:
        with path.open("rb", buffering=0) as file:
            return _checked(expected, file, path.stat().st_size, after_bytes)
    except OSError as error:
        return _Checked([expected.problem("", f"cannot be read ({error.strerror or error})")])


def _checked(expected: _Expected, file: io.FileIO, size: int, after_bytes: AfterBytes) -> _Checked:
    checked = _Checked()
    try:
        found = {each.name: each for each in read_members(file, size, where=expected.shard)}
    except ShardError as error:
        told = str(error).removeprefix(f"{expected.shard}: ").removesuffix(f" {_FETCH}")
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
    facts = expected.facts
    if not checked.problems and (size, checksums.sha256) != (facts.size, facts.sha256):
        told = (
            f"all members are whole, and yet the file has {size} bytes with sha256 "
            f"{checksums.sha256[:16]}..., and by the index {facts.size} with {facts.sha256[:16]}..."
        )
        checked.problems.append(expected.problem("", told))
    return checked


def _cut_off(expected: _Expected, size: int) -> Iterator[Problem]:
    """Yield a problem for each scene of which members lie beyond the end of the file."""
    of_scene = defaultdict(list)
    for name, member in expected.members.items():
        if member.offset + member.size > size:
            of_scene[name.partition(".")[0]].append(name.partition(".")[2])
    for scene, names in of_scene.items():
        yield expected.problem(scene, f"{len(names)} of its files are cut off ({_few(names)})")


def _few(names: list[str]) -> str:
    return ", ".join([*names[:_SHOWN], "..."] if len(names) > _SHOWN else names)


def _differing(expected: _Expected, found: dict[str, TarMember]) -> Iterator[Problem]:
    """Yield what differs between the members that are there and those of the index."""
    scenes, told = (
        {name.partition(".")[0] for name in names} for names in (found, expected.members)
    )
    if scenes != told:
        text = (
            f"holds other scenes than the index says: {len(scenes - told)} unknown, "
            f"{len(told - scenes)} not there ({_few(sorted(scenes ^ told))}); shard and index are "
            f"of different packs"
        )
        yield expected.problem("", text, _WRONG_INDEX)
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
