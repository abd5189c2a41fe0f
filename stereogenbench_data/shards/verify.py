"""Compare shards with their index: every byte, and on request every frame.

A damaged shard does not stop the others: all problems are listed, each with its cure.
"""

import hashlib
import tarfile
import warnings
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Literal

from stereogenbench_data.engine import LOCAL, Advance, Engine, Progress, advance_of
from stereogenbench_data.errors import MediaError, ShardError, cure_of
from stereogenbench_data.index.row_check import compared_with_files
from stereogenbench_data.index.table import SceneIndex, StaleIndexWarning
from stereogenbench_data.media.depth import (
    ANY_DEPTH,
    open_video,
    read_depth_units,
)
from stereogenbench_data.media.video import VideoReader
from stereogenbench_data.schema.records import Member, Scene, ShardFacts
from stereogenbench_data.schema.text import counted
from stereogenbench_data.shards.tar import read_chunks
from stereogenbench_data.shards.writer import open_shards
from stereogenbench_data.sources.members import MemberSource
from stereogenbench_data.sources.ranged_file import FileSlice

_FETCH_AGAIN: Final = "Fetch the shard again, or pack it again."
_WRONG_INDEX: Final = "Put the index beside the shards that it was packed with."
_FETCH_BOTH: Final = "Fetch the shard and its index again, or pack them again."
_SHOWN: Final = 3


Kind = Literal[
    "missing", "not in the index", "unreadable", "altered", "cut short", "misplaced",
    "contradicts the index", "does not decode",
]  # fmt: skip


@dataclass(frozen=True, slots=True, order=True)
class Problem:
    """What is wrong where, and what to do; a scene or member that does not apply is empty."""

    shard: str
    scene: str
    member: str
    kind: Kind
    found: str
    cure: str

    @property
    def place(self) -> tuple[str, ...]:
        """Where it is: the shard, and in it the scene and the member if it has them."""
        return tuple(part for part in (self.shard, self.scene, self.member) if part)

    def __str__(self) -> str:
        """Return it as one line."""
        return f"{': '.join(self.place)}: {self.found}. {self.cure}".replace("\n", " ")


@dataclass(frozen=True, slots=True)
class _ExpectedShard:
    """What the index says of one shard; members are by their whole name in it."""

    path: Path
    shard: str
    facts: ShardFacts
    scenes: list[Scene] = field(default_factory=list)
    members: dict[str, Member] = field(default_factory=dict)

    def problem(self, name: str, kind: Kind, found: str, cure: str = _FETCH_AGAIN) -> Problem:
        """Return a problem of a member by its whole name, or of the shard for an empty name."""
        scene, _, member = name.partition(".")
        return Problem(self.shard, scene, member, kind, found, cure)


@dataclass(frozen=True, slots=True)
class VerifyReport:
    """What was checked, and what is wrong in the order of shards, scenes and members.

    ``derived`` says what training shards were derived from, and is empty for others.
    """

    root: str
    shards: int
    scenes: int
    members: int
    bytes: int
    videos_decoded: int
    problems: tuple[Problem, ...]
    derived: str = ""


def verify(
    data: str | Path,
    *,
    root: str | Path | None = None,
    mode: Literal["bytes", "decode"] = "bytes",
    workers: int | None = None,
    engine: Engine = LOCAL,
    progress: Progress | None = None,
) -> VerifyReport:
    """Compare shards, and the files that were packed beside them, with their index.

    The index itself is compared with the metadata in the shards.

    Args:
        data: The folder of the shards, or its index file.
        root: The folder of the shards, if the index file is elsewhere.
        mode: "bytes" reads all bytes; "decode" then also decodes all frames of all videos.
        workers: The number of processes; None is one a core.
        engine: Where they run: `engine.LOCAL`, or an `engine.RayCluster`.
        progress: Called repeatedly with the bytes done, and all of them; with "decode" those of
            videos count twice.

    Raises:
        StorageError: If there is no index of shards, or a worker died.
    """
    with warnings.catch_warnings():
        # A stale index is a problem, reported with the others.
        warnings.simplefilter("ignore", StaleIndexWarning)
        index = open_shards(data, root)
    expected = _expected_of(index)
    problems = list(_folder_problems(index, expected))
    checks = [each for each in expected.values() if each.path.is_file()]
    scenes = [index.scene(row) for row in range(len(index))] if mode == "decode" else []
    video_bytes = sum(scene.members[name].size for scene in scenes for name in scene.held_videos)
    total = sum(each.facts.size for each in checks) + video_bytes
    advance = advance_of(progress, total=total)
    sound: set[str] = set()
    for wrong, right in engine.map(
        _check_shard, checks, name=lambda each: each.shard, workers=workers, advance=advance
    ):
        problems += wrong
        sound |= right
    works = [
        (
            index.root,
            scene,
            [name for name in scene.held_videos if f"{scene.id.key}.{name}" in sound],
        )
        for scene in scenes
    ]
    for found in engine.map(
        _decode, works, name=lambda work: work[1].id.key, workers=workers, advance=advance
    ):
        problems += found
    return VerifyReport(
        root=index.where,
        shards=len(expected),
        scenes=len(index),
        members=sum(len(each.members) for each in expected.values()),
        bytes=sum(each.facts.size for each in expected.values()),
        videos_decoded=sum(len(names) for _, _, names in works),
        problems=tuple(sorted(problems)),
        derived=index.derivation if index.is_derived else "",
    )


def _expected_of(index: SceneIndex) -> dict[str, _ExpectedShard]:
    expected = {
        name: _ExpectedShard(Path(index.root, name), name, facts)
        for name, facts in sorted(index.shards.items())
    }
    for scene in map(index.scene, range(len(index))):
        for name, member in scene.members.items():
            if member.path not in expected:
                raise ShardError(
                    f"{index.where}: its index places {scene.id.key}.{name} in {member.path}, but "
                    f"does not list this shard. The index was altered: fetch it again."
                )
            expected[member.path].members[f"{scene.id.key}.{name}"] = member
        for path in {member.path for member in scene.members.values()}:
            expected[path].scenes.append(scene)
    return expected


def _folder_problems(index: SceneIndex, expected: dict[str, _ExpectedShard]) -> Iterator[Problem]:
    """Yield files that are missing, unknown, or differ from what the index says."""
    there = {path.name for path in Path(index.root).iterdir()}
    for each in expected.values():
        if not each.path.is_file():
            scenes = counted(len(each.scenes), "scene")
            what = "is not a file" if each.shard in there else "is missing"
            yield each.problem("", "missing", f"{what}, with {scenes}")
    for name in sorted(there - expected.keys()):
        if name.endswith(".tar"):
            yield Problem(name, "", "", "not in the index", "is not in the index", _WRONG_INDEX)


# One shard: every byte, what lies where, and its metadata.


def _check_shard(expected: _ExpectedShard, after_bytes: Advance) -> tuple[list[Problem], set[str]]:
    """Return what is wrong with a shard, and its sound members; a worker process calls this."""
    facts, sha256 = expected.facts, hashlib.sha256()
    problems, sound = list[Problem](), {*expected.members}
    try:
        with expected.path.open("rb", buffering=0) as file:
            size = expected.path.stat().st_size
            for chunk in read_chunks(file, size, after_bytes=after_bytes):
                sha256.update(chunk)
        found = sha256.hexdigest()
        is_checked = all(each.crc32 is not None for each in expected.members.values())
        if (size, found, is_checked) != (facts.size, facts.sha256, True):
            problems, sound = _check_members(expected, size)
        if not problems and size == facts.size:
            problems += _check_places(expected)
        misindexed = [*_misindexed(expected, sound)]
    except OSError as error:
        reason = f"cannot be read ({error.strerror or error})"
        return [expected.problem("", "unreadable", reason, cure_of(error, _FETCH_AGAIN))], set()
    if size != facts.size:
        what = "it is cut short" if size < facts.size else "something was added"
        text = f"has {size} bytes, and the index says {facts.size}: {what}"
        kind: Kind = "cut short" if size < facts.size else "altered"
        problems.append(expected.problem("", kind, text))
    elif not problems and found != facts.sha256:
        text = f"has sha256 {found[:16]}..., and the index says {facts.sha256[:16]}..., though"
        problems.append(expected.problem("", "altered", f"{text} its files are sound"))
    return problems + misindexed, sound


def _check_members(expected: _ExpectedShard, size: int) -> tuple[list[Problem], set[str]]:
    """Return which files of a shard of some bytes are not what was packed, and the sound ones."""
    problems, sound, lost = list[Problem](), set[str](), defaultdict(list)
    for name, member in expected.members.items():
        if member.offset + member.size > size:
            scene, _, file_name = name.partition(".")
            lost[scene].append(file_name)
            continue
        with FileSlice(expected.path, member) as file:
            crc32 = file.crc32()
        if crc32 == member.crc32:
            sound.add(name)
            continue
        indexed = "has none" if member.crc32 is None else f"says {member.crc32:08x}"
        text = f"its bytes have crc32 {crc32:08x}, and the index {indexed}"
        problems.append(expected.problem(name, "altered", text))
    for scene, names in lost.items():
        text = f"{len(names)} of its files are not whole ({_few(sorted(names))})"
        problems.append(expected.problem(scene, "cut short", text))
    return problems, sound


def _check_places(expected: _ExpectedShard) -> Iterator[Problem]:
    """Yield the first file that the tar itself, which other readers go by, places otherwise."""
    listed = {}
    with suppress(tarfile.TarError), tarfile.open(expected.path, "r:") as tar:
        listed = {each.name: (each.offset_data, each.size) for each in tar}
    indexed = {name: (each.offset, each.size) for name, each in expected.members.items()}
    differing = listed.items() ^ indexed.items()
    for name, _ in sorted(differing, key=lambda item: item[1])[:1]:
        text = "its header in the tar is damaged, or the index does not name it"
        yield expected.problem(name, "misplaced", text)


def _misindexed(expected: _ExpectedShard, sound: set[str]) -> Iterator[Problem]:
    """Yield where the index contradicts files in the shard, of scenes whose files are sound."""
    source = MemberSource(expected.path.parent, shards={}, check="opened")
    for scene in expected.scenes:
        if sound.issuperset(f"{scene.id.key}.{name}" for name in scene.members):
            _, differences = compared_with_files(scene, source)
            for name, difference in differences:
                yield expected.problem(
                    f"{scene.id.key}.{name}", "contradicts the index", difference, _FETCH_BOTH
                )


def _few(names: list[str]) -> str:
    return ", ".join([*names[:_SHOWN], "..."] if len(names) > _SHOWN else names)


# One scene: every frame.


def _decode(work: tuple[str, Scene, list[str]], after_bytes: Advance) -> list[Problem]:
    """Return what is wrong with the named videos of a scene; a worker process calls this."""
    root, scene, names = work
    problems = []
    for name in names:
        member = scene.members[name]
        try:
            with (
                FileSlice(Path(root, member.path), member) as file,
                open_video(file, name=name, frames=scene.frames) as video,
            ):
                for index in range(scene.frames):
                    if isinstance(video, VideoReader) and name.endswith("_rgb.mp4"):
                        video.colour_frame(index)
                    else:
                        read_depth_units(video, index, encoding=ANY_DEPTH)
        except (MediaError, OSError) as error:
            reason = str(error).removeprefix(f"{name}: ").rstrip(".")
            cure = "Pack the scene again from an undamaged video."
            if isinstance(error, OSError):
                cure = cure_of(error, cure)
            problems.append(
                Problem(member.path, scene.id.key, name, "does not decode", reason, cure)
            )
        after_bytes(member.size)
    return problems
