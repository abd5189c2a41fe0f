"""Shards back into a tree in the released layout: each scene's folder whole, or not there.

What was packed unchanged comes out unchanged, byte for byte. Depth that blosc2 packed becomes an
FFV1 video again, whose pictures, times and tags are compared with what was packed.
"""

import io
import shutil
import zlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final, Literal

from stereogenbench_data.engine import LOCAL, Advance, Engine, Progress, advance_of
from stereogenbench_data.errors import DISK_FULL, MediaError, ShardError, describe_os_error
from stereogenbench_data.index.open import warn_if_stale
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.media.depth_frames import DepthFrames
from stereogenbench_data.media.depth_packing import write_depth_video
from stereogenbench_data.media.video import probe
from stereogenbench_data.schema.records import Member, Scene, ShardFacts
from stereogenbench_data.schema.release import PACKED_DEPTH_NAMES
from stereogenbench_data.sources.files import copy_with_crc32, try_locked
from stereogenbench_data.sources.location import shown
from stereogenbench_data.sources.members import open_local
from stereogenbench_data.sources.ranged_file import MemberFile

_RELEASED_NAMES: Final = {packed: name for name, packed in PACKED_DEPTH_NAMES.items()}
_LOCK: Final = ".unpacking"
_CHUNK_BYTES: Final = 4 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class UnpackReport:
    """What became of the scenes, by key: written just now, or there before and kept."""

    out: Path
    unpacked: tuple[str, ...]
    kept: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _UnpackTask:
    """A scene to be unpacked."""

    root: str
    out: str
    scene: Scene
    shards: dict[str, ShardFacts]

    @property
    def folder(self) -> Path:
        """Where the scene is to lie."""
        return Path(self.out, self.scene.id.key)

    @property
    def unfinished(self) -> Path:
        """Where it lies until it is whole; walks of a tree pass such names over."""
        return self.folder.with_name(f".{self.folder.name}.unpacking")


def unpack(
    data: str | Path,
    out: str | Path,
    *,
    root: str | Path | None = None,
    workers: int | None = None,
    engine: Engine = LOCAL,
    progress: Progress | None = None,
) -> UnpackReport:
    """Turn shards back into a tree in the released layout.

    Scenes that are there already are kept, so that a run that was stopped goes on if it is run
    again. Nothing is overwritten.

    Args:
        data: The folder of the shards, or its index file.
        root: The folder of the shards, by your word, where an index file does not lie in it.
        out: Folder for the tree; made if need be.
        workers: Processes that work at the same time; None is one a core.
        engine: Where they are: `engine.LOCAL`, or an `engine.RayCluster`.
        progress: Called now and then with the bytes of members done, and all there are.

    Raises:
        StorageError: If there is no index of shards, or a worker died.
        ShardError: If a member is not the one that was packed, a scene's folder holds anything
            else, another process unpacks into this folder, or it cannot be written.
        ExtraError: If blosc2 is needed and not installed.
    """
    index = _opened(data, root)
    scenes = [index.scene(row) for row in range(len(index))]
    out = Path(out)
    if out.resolve() == Path(index.root).resolve():
        raise ShardError(f"{out}: holds the shards themselves. Unpack into another folder.")
    tasks = [
        _UnpackTask(
            index.root,
            str(out),
            scene,
            {path: index.shards[path] for path in {each.path for each in scene.members.values()}},
        )
        for scene in scenes
    ]
    total = sum(member.size for scene in scenes for member in scene.members.values())
    found: dict[str, str] = {}
    try:
        out.mkdir(parents=True, exist_ok=True)
        with try_locked(out / _LOCK) as is_ours:
            if not is_ours:
                raise ShardError(
                    f"{out}: another process is unpacking into this folder. Wait for it, or "
                    f"unpack into another."
                )
            try:
                outcomes = engine.map(
                    unpack_scene,
                    tasks,
                    name=lambda task: task.scene.id.key,
                    workers=workers,
                    advance=advance_of(progress, total=total),
                )
                found.update(outcomes)
            finally:
                (out / _LOCK).unlink(missing_ok=True)
    except OSError as error:
        if error.errno is None:
            raise
        raise ShardError(_why_not_written(out, error)) from error
    warn_if_stale(out)
    return UnpackReport(
        out,
        tuple(sorted(key for key, work in found.items() if work == "unpacked")),
        tuple(sorted(key for key, work in found.items() if work == "kept")),
    )


def _opened(data: str | Path, root: str | Path | None) -> SceneIndex:
    if "://" in str(data):
        raise ShardError(f"{shown(data)}: is far away. Fetch the shards, and pass their folder.")
    index = SceneIndex.open(data, root=root)
    if not index.shards:
        raise ShardError(f"{data}: is a released tree already, and no folder of shards.")
    return index


def _why_not_written(out: Path, error: OSError) -> str:
    if error.errno in DISK_FULL:
        return f"{out}: the disk is full. Make room, then run the same command again to go on."
    what = f"{error.filename or out}: cannot be written"
    return describe_os_error(what, error, "Unpack into another folder.")


def unpack_scene(
    task: _UnpackTask, after_bytes: Advance
) -> tuple[str, Literal["unpacked", "kept"]]:
    """Unpack one scene, unless it is there; a worker process calls this.

    Raises:
        ShardError: As `unpack` says.
    """
    scene = task.scene
    if task.folder.exists():
        _require_unpacked(task)
        after_bytes(sum(member.size for member in scene.members.values()))
        return scene.id.key, "kept"
    shutil.rmtree(task.unfinished, ignore_errors=True)
    task.unfinished.mkdir(parents=True)
    try:
        for name, member in sorted(scene.members.items(), key=lambda item: item[1].offset):
            where = f"{Path(task.root, member.path)}: {scene.id.key}.{name}"
            target = task.unfinished / _RELEASED_NAMES.get(name, name)
            with _member_of(task, member) as file:
                if name in _RELEASED_NAMES:
                    _write_video(file, member, target, frames=scene.frames, where=where)
                    after_bytes(member.size)
                else:
                    _copy(file, member, target, where=where, after_bytes=after_bytes)
        task.unfinished.rename(task.folder)
    finally:
        shutil.rmtree(task.unfinished, ignore_errors=True)
    return scene.id.key, "unpacked"


def _member_of(task: _UnpackTask, member: Member) -> MemberFile:
    opened = open_local(task.root, member, shard=task.shards[member.path])
    if isinstance(opened, Path):
        raise ShardError(f"{opened}: is no member of a shard. Use a folder of shards.")
    return opened


def _copy(
    file: MemberFile, member: Member, target: Path, *, where: str, after_bytes: Advance
) -> None:
    with target.open("xb") as output:

        def write(chunk: bytes) -> None:
            output.write(chunk)
            after_bytes(len(chunk))

        crc32 = copy_with_crc32(iter(partial(file.read, _CHUNK_BYTES), b""), write)
    _require_crc32(crc32, member, where=where)


def _write_video(
    file: MemberFile, member: Member, target: Path, *, frames: int, where: str
) -> None:
    content = file.read()
    _require_crc32(zlib.crc32(content), member, where=where)
    try:
        with DepthFrames(io.BytesIO(content), name=where, frames=frames) as packed:
            write_depth_video(packed, target)
    except MediaError as error:
        raise ShardError(str(error)) from error


def _require_crc32(crc32: int, member: Member, *, where: str) -> None:
    if member.crc32 not in (None, crc32):
        raise ShardError(
            f"{where}: has crc32 {crc32:08x}, and the index says {member.crc32:08x}. The shard was "
            f"damaged or replaced: fetch it again."
        )


def _require_unpacked(task: _UnpackTask) -> None:
    """Refuse a scene's folder that does not hold what unpacking would write, as far as sizes tell.

    Of a depth video that was written anew, the header tells.
    """
    scene, folder = task.scene, task.folder
    expected = {_RELEASED_NAMES.get(name, name): name for name in scene.members}
    there = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
    odd = sorted(there ^ expected.keys())
    for name in sorted(there & expected.keys()):
        packed = expected[name]
        if packed == name:
            is_same = (folder / name).stat().st_size == scene.members[name].size
        else:
            is_same = _has_frames(folder / name, scene)
        odd += [] if is_same else [name]
    if odd:
        raise ShardError(
            f"{folder}: is there, and is not what the shards hold ({', '.join(odd[:3])} differ). "
            f"Move it away, or unpack into another folder."
        )


def _has_frames(path: Path, scene: Scene) -> bool:
    try:
        facts = probe(path, name=str(path))
    except MediaError:
        return False
    size = (scene.rig.image_width_px, scene.rig.image_height_px)
    return (facts.frames, facts.width_px, facts.height_px) == (scene.frames, *size)
