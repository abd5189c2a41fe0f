"""Unpack shards into a tree in the released layout: each scene's folder whole, or absent.

What was packed unchanged comes out unchanged, byte for byte. Depth that blosc2 packed becomes an
FFV1 video again, with the same numbers, times and tags.
"""

import io
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from stereogenbench_data.engine import LOCAL, Advance, Engine, Progress, advance_of
from stereogenbench_data.errors import MediaError, ShardError, explain_os_errors
from stereogenbench_data.jobs import atomic_folder
from stereogenbench_data.media.depth import write_depth_video
from stereogenbench_data.media.depth_frames import DepthFrames
from stereogenbench_data.schema.records import Member, Scene
from stereogenbench_data.schema.release import PACKED_DEPTH_NAMES
from stereogenbench_data.shards.tar import read_chunks
from stereogenbench_data.shards.writer import open_shards
from stereogenbench_data.sources.files import copy_with_crc32, try_locked
from stereogenbench_data.sources.members import open_local
from stereogenbench_data.sources.ranged_file import require_crc32

_RELEASED_NAMES: Final = {packed: name for name, packed in PACKED_DEPTH_NAMES.items()}
_LOCK: Final = ".unpacking"


@dataclass(frozen=True, slots=True)
class UnpackReport:
    """The keys of the scenes that were unpacked now, or were there before and kept."""

    out: Path
    unpacked: tuple[str, ...]
    kept: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _UnpackTask:
    """A scene to unpack."""

    root: str
    out: str
    scene: Scene

    @property
    def folder(self) -> Path:
        """The scene's folder."""
        return Path(self.out, self.scene.id.key)


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

    Existing scenes are kept, so a run that was stopped continues when it is run again. Nothing is
    overwritten.

    Args:
        data: The folder of the shards, or its index file.
        root: The folder of the shards, if the index file is elsewhere.
        out: Folder for the tree; created if it does not exist.
        workers: The number of processes; None is one a core.
        engine: Where they are: `engine.LOCAL`, or an `engine.RayCluster`.
        progress: Called repeatedly with the bytes of members done, and all of them.

    Raises:
        StorageError: If there is no index of shards, or a worker died.
        ShardError: If a member is not the one that was packed, a scene's folder exists and holds
            something else, another process unpacks into this folder, or it cannot be written.
        ExtraError: If blosc2 is needed and not installed.
    """
    index = open_shards(data, root)
    scenes = [index.scene(row) for row in range(len(index))]
    out = Path(out)
    if out.resolve() == Path(index.root).resolve():
        raise ShardError(f"{out}: holds the shards themselves. Unpack into another folder.")
    tasks = [_UnpackTask(index.root, str(out), scene) for scene in scenes]
    total = sum(member.size for scene in scenes for member in scene.members.values())
    cure = "Unpack into another folder."
    with explain_os_errors(f"{out}: cannot be written", cure, kind=ShardError):
        out.mkdir(parents=True, exist_ok=True)
        with try_locked(out / _LOCK) as is_ours:
            if not is_ours:
                raise ShardError(
                    f"{out}: another process is unpacking into this folder. Wait for it, or "
                    f"unpack into another folder."
                )
            try:
                unpacked = engine.map(
                    unpack_scene,
                    tasks,
                    name=lambda task: task.scene.id.key,
                    workers=workers,
                    advance=advance_of(progress, total=total),
                )
                now = {*unpacked} - {""}
            finally:
                (out / _LOCK).unlink(missing_ok=True)
    kept = {scene.id.key for scene in scenes} - now
    return UnpackReport(out, tuple(sorted(now)), tuple(sorted(kept)))


def unpack_scene(task: _UnpackTask, after_bytes: Advance) -> str:
    """Unpack one scene, unless it exists; a worker process calls this.

    Returns:
        Its key; "" if it was there.

    Raises:
        ShardError: As `unpack` says.
    """
    scene = task.scene
    if task.folder.exists():
        _require_unpacked(task)
        after_bytes(sum(member.size for member in scene.members.values()))
        return ""
    try:
        with atomic_folder(task.folder) as folder:
            for name, member in sorted(scene.members.items(), key=lambda item: item[1].offset):
                _unpack_file(task, name, member, folder, after_bytes)
    except MediaError as error:
        raise ShardError(str(error)) from error
    return scene.id.key


def _unpack_file(
    task: _UnpackTask, name: str, member: Member, folder: Path, after_bytes: Advance
) -> None:
    where = f"{Path(task.root, member.path)}: {task.scene.id.key}.{name}"
    target = folder / _RELEASED_NAMES.get(name, name)
    opened = open_local(task.root, member)
    with opened.open("rb") if isinstance(opened, Path) else opened as file:
        if name in _RELEASED_NAMES:
            content = file.read()
            require_crc32(zlib.crc32(content), expected=member.crc32, name=where)
            frames = task.scene.frames
            with DepthFrames(io.BytesIO(content), name=where, frames=frames) as depth:
                write_depth_video(depth, target)
            after_bytes(member.size)
            return
        chunks = read_chunks(file, member.size, after_bytes=after_bytes)
        with target.open("xb") as output:
            crc32 = copy_with_crc32(chunks, output.write)
        require_crc32(crc32, expected=member.crc32, name=where)


def _require_unpacked(task: _UnpackTask) -> None:
    """Refuse a scene's folder that does not hold what unpacking would write, by names and sizes."""
    scene, folder = task.scene, task.folder
    there = {path.name: path.stat().st_size for path in folder.iterdir()} if folder.is_dir() else {}
    expected = {
        # The size of a rewritten depth video is not known.
        _RELEASED_NAMES.get(name, name): there.get(_RELEASED_NAMES.get(name, ""), member.size)
        for name, member in scene.members.items()
    }
    odd = sorted({name for name, _ in there.items() ^ expected.items()})
    if odd:
        raise ShardError(
            f"{folder}: already exists, and is not what the shards hold ({', '.join(odd[:3])} "
            f"differ). Move it away, or unpack into another folder."
        )
