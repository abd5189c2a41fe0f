"""Verifying shards against their index: every byte, and with "decode" every picture.

A shard that is wrong does not stop the rest: all that is wrong is gathered, each with its cure.
"""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from stereogenbench_data.engine import LOCAL, Engine
from stereogenbench_data.errors import ShardError, cure_of
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.index.stale import StaleIndexWarning
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.text import counted
from stereogenbench_data.shards.companion_files import foreign_indexes
from stereogenbench_data.shards.verify_decode import (
    Problem,
    decode_scene,
    decode_tasks,
    video_bytes,
)
from stereogenbench_data.shards.verify_shard import (
    FETCH,
    WRONG_INDEX,
    ExpectedShard,
    check_shard,
)
from stereogenbench_data.shards.writer import UNFINISHED
from stereogenbench_data.sources.files import PARTS
from stereogenbench_data.sources.location import shown

Progress = Callable[[int, int], None]

_WRITE_AGAIN: Final = "Fetch it again, or write it anew: run `stereogenbench pack` again."


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


def verify(
    data: str | Path,
    *,
    root: str | Path | None = None,
    mode: Literal["bytes", "decode"] = "bytes",
    workers: int | None = None,
    engine: Engine = LOCAL,
    progress: Progress | None = None,
) -> VerifyReport:
    """Compare shards, and what was packed beside them, with their index.

    The index itself is held against the metadata that the shards hold.

    Args:
        data: The folder of the shards, or its index file.
        root: The folder of the shards, by your word, where an index file does not lie in it.
        mode: "bytes" reads all bytes; "decode" then decodes all frames of all videos, too.
        workers: Processes that work at the same time; None is one a core.
        engine: Where they are: `engine.LOCAL`, or an `engine.RayCluster`.
        progress: Called now and then with the bytes done, and all there are; with "decode" those
            of videos count twice.

    Raises:
        StorageError: If there is no index, it is not one of shards, or a worker died.
    """
    index = _opened(data, root)
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
    for checked in engine.map(
        check_shard, checks, name=lambda each: each.shard, workers=workers, advance=after_bytes
    ):
        problems += checked.problems
        sound |= checked.sound
    tasks = decode_tasks(scenes, index.root, sound)
    for found in engine.map(
        decode_scene,
        tasks,
        name=lambda task: task.scene.id.key,
        workers=workers,
        advance=after_bytes,
    ):
        problems += found
    return VerifyReport(
        root=index.where,
        shards=len(expected),
        scenes=len(index),
        members=sum(len(each.members) for each in expected.values()),
        bytes=sum(each.facts.size for each in expected.values()),
        videos_decoded=sum(len(task.names) for task in tasks),
        problems=tuple(sorted(problems, key=lambda p: (p.shard, p.scene, p.member, p.found))),
    )


def _opened(data: str | Path, root: str | Path | None) -> SceneIndex:
    if "://" in str(data):
        raise ShardError(f"{shown(data)}: is far away. Fetch the shards, and pass their folder.")
    path = Path(data)
    if path.is_dir() and not (path / INDEX_NAME).is_file():
        begun = (path / PARTS).is_dir()
        raise ShardError(
            f"{path}: holds no {INDEX_NAME}. "
            + ("Packing was not finished: run `stereogenbench pack` again." if begun else
               "Point at a folder that `stereogenbench pack` made.")
        )  # fmt: skip
    with warnings.catch_warnings():
        # What does not fit the index is a problem, told with the others.
        warnings.simplefilter("ignore", StaleIndexWarning)
        index = SceneIndex.open(path, root=root)
    if not index.shards:
        raise ShardError(
            f"{path}: is the index of a released folder, not of shards. Pack it with "
            f"`stereogenbench pack`, or point at the shards."
        )
    return index


def _expected_of(index: SceneIndex) -> dict[str, ExpectedShard]:
    expected = {
        name: ExpectedShard(index.root, name, facts) for name, facts in sorted(index.shards.items())
    }
    for scene in map(index.scene, range(len(index))):
        for name, member in scene.members.items():
            if member.path not in expected:
                raise ShardError(
                    f"{index.where}: its index places {scene.id.key}.{name} in {member.path} and "
                    f"knows no such shard. The index was altered: fetch it again."
                )
            expected[member.path].members[f"{scene.id.key}.{name}"] = member
        for path in {member.path for member in scene.members.values()}:
            expected[path].scenes.append(scene)
    return expected


def _folder_problems(index: SceneIndex, expected: dict[str, ExpectedShard]) -> Iterator[Problem]:
    there = {path.name for path in Path(index.root).iterdir()}
    for each in expected.values():
        if not Path(each.root, each.shard).is_file():
            scenes = len({name.partition(".")[0] for name in each.members})
            what = "is no file" if each.shard in there else "is missing"
            yield each.problem("", f"{what}, with {counted(scenes, 'scene')}", FETCH)
    for name in sorted(there - expected.keys()):
        if name.endswith(".tar"):
            yield Problem(name, "", "", "is there, and the index does not know it", WRONG_INDEX)
        elif name.endswith(f".tar{UNFINISHED}"):
            cure = "Run `stereogenbench pack` again, or remove it."
            yield Problem(name, "", "", "is an unfinished shard", cure)
    yield from _companion_problems(index)


def _companion_problems(index: SceneIndex) -> Iterator[Problem]:
    """Yield what is wrong with the files that pack writes for other readers."""
    for name, content in foreign_indexes(index).items():
        try:
            found = Path(index.root, name).read_bytes()
        except FileNotFoundError:
            yield Problem(name, "", "", "is missing, and pack wrote it", _WRITE_AGAIN)
        except OSError as error:
            cure = cure_of(error, _WRITE_AGAIN)
            yield Problem(name, "", "", f"cannot be read ({error.strerror})", cure)
        else:
            if found != content:
                yield Problem(name, "", "", "contradicts the index", _WRITE_AGAIN)
