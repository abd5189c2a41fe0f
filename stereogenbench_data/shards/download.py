"""Copy scenes into a folder in the released layout: only the files that are wanted, each checked.

A file gets its name once it is whole, so a run that was stopped continues. The marks of complete
scenes come last. The index beside downloaded files lists only what is there; `unpack` copies all
scenes of shards in the same way.
"""

import io
import shutil
import zlib
from collections.abc import Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager, closing, suppress
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import BinaryIO, Final

import numpy as np

from stereogenbench_data.engine import Progress, advance_of
from stereogenbench_data.errors import MediaError, ShardError, StorageError, explain_os_errors
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.media.depth import (
    ANY_DEPTH,
    open_video,
    read_depth_units,
    write_depth_video,
)
from stereogenbench_data.media.depth_frames import DepthFrames
from stereogenbench_data.schema.records import Member, Scene
from stereogenbench_data.schema.release import COMPLETE_JSON
from stereogenbench_data.shards.plan import SCENE_TEXTS
from stereogenbench_data.shards.tar import read_chunks
from stereogenbench_data.sources.files import copy_with_crc32, open_atomic
from stereogenbench_data.sources.location import is_remote, joined, local_path
from stereogenbench_data.sources.members import MemberSource, open_local, require_own_files
from stereogenbench_data.sources.ranged_file import require_crc32
from stereogenbench_data.sources.remote import RemoteObject

_SPARE_BYTES: Final = 16 * 1024 * 1024

Copies = Mapping[Path, tuple[Scene, str]]
"""The path of each copy to the scene of the file and the file's name there."""


def wanted_files(scene: Scene, *, cameras: Sequence[int], streams: Sequence[str]) -> Scene:
    """Return a scene with only the files that are wanted.

    Args:
        scene: The scene, as the index of the data has it.
        cameras: Numbers of the cameras whose videos are wanted.
        streams: "rgb", "depth" or both.

    Raises:
        StorageError: If the index lacks a wanted file.
    """
    stems = [f"cam_{camera:02d}_{stream}" for camera in cameras for stream in streams]
    videos = {name.partition(".")[0]: name for name in scene.members}
    missing = [stem for stem in stems if stem not in videos]
    if missing:
        raise StorageError(
            f"{scene.id.key}: the index has no {', '.join(missing)}: it is of a partial "
            f"download. Download from the whole release."
        )
    names = [name for name in SCENE_TEXTS if name in scene.members]
    names += [videos[stem] for stem in stems]
    return replace(scene, members={name: scene.members[name] for name in names})


def size_bytes(*scenes: Scene) -> int:
    """Return the size of all files of some scenes."""
    return sum(member.size for scene in scenes for member in scene.members.values())


def download(
    index: SceneIndex,
    wanted: Sequence[Scene],
    dest: str | Path,
    *,
    workers: int = 8,
    progress: Progress | None = None,
) -> SceneIndex:
    """Download files into a folder, and write an index of them there.

    Args:
        index: The index of the data.
        wanted: Scenes, each with only the files to download (`wanted_files`).
        dest: The folder; created if it does not exist.
        workers: How many files are fetched at the same time.
        progress: Called repeatedly with the bytes done, and all of them.

    Returns:
        The index of all scenes in the folder, those of earlier downloads included.

    Raises:
        StorageError: If a file cannot be fetched or stored, its checksum differs, the disk is too
            small, or the folder has an index that cannot be read.
    """
    dest = local_path(dest)
    if not is_remote(index.root):
        if dest == local_path(index.root):
            raise StorageError(f"{dest}: is the folder of the data. Choose another folder.")
        paths = {member.path for scene in wanted for member in scene.members.values()}
        require_own_files(index.root, sorted(paths))
    scenes = _scenes_before(dest)
    missing = {
        path: (scene, name)
        for scene in wanted
        for name, member in scene.members.items()
        if not is_whole(path := dest / scene.id.key / name, member)
    }
    _require_room(dest, sum(scene.members[name].size for scene, name in missing.values()))
    copy_files(index, missing, workers=workers, progress=progress, total=size_bytes(*wanted))
    for scene in wanted:
        members = {
            name: replace(member, path=f"{scene.id.key}/{name}", offset=0)
            for name, member in scene.members.items()
        }
        before = scenes.get(scene.id.key, scene).members
        if _texts(before) == _texts(members):
            members = {**before, **members}
        scenes[scene.id.key] = replace(scene, members=members)
    here = SceneIndex.from_scenes(scenes.values(), dest)
    here.write(dest / INDEX_NAME)
    return here


def _scenes_before(dest: Path) -> dict[str, Scene]:
    """Return what an earlier download left whole in the folder, by key."""
    if not (dest / INDEX_NAME).exists():
        return {}
    index = SceneIndex.open(dest)
    if index.shards or is_remote(index.root) or local_path(index.root) != dest:
        raise StorageError(
            f"{dest}: has the index of other data, and the download would replace it. Choose "
            f"another folder."
        )
    return {
        scene.id.key: scene
        for scene in map(index.scene, range(len(index)))
        if all(is_whole(dest / member.path, member) for member in scene.members.values())
    }


def _texts(members: Mapping[str, Member]) -> dict[str, tuple[int, int | None]]:
    """Return size and checksum of a scene's metadata, which differ in another revision."""
    return {name: (each.size, each.crc32) for name, each in members.items() if name in SCENE_TEXTS}


def copy_files(
    index: SceneIndex, missing: Copies, *, workers: int, progress: Progress | None, total: int
) -> None:
    """Copy files of an index's scenes, each whole or not at all, on several threads.

    Args:
        index: The index of the data.
        missing: What to copy. Packed depth whose copy has the released name becomes a video again;
            if that is there, it is compared.
        workers: How many files are copied at the same time.
        progress: Called repeatedly with the bytes done, and all of them.
        total: How many bytes there are with the copies that are there already.

    Raises:
        StorageError: If a file cannot be read or written, or its checksum differs; `ShardError` if
            a depth video is there, and holds something else.
        ExtraError: If blosc2 is needed and not installed.
    """
    sizes = {path: scene.members[name].size for path, (scene, name) in missing.items()}
    advance = advance_of(progress, done=total - sum(sizes.values()), total=total)
    advance(0)
    source, stop = MemberSource(index.root, shards=index.shards), Event()
    with ThreadPoolExecutor(max_workers=max(1, workers)) as pool:
        try:
            for are_marks in (False, True):
                futures = {
                    pool.submit(_copy, index, source, path, of, stop): path
                    for path, of in missing.items()
                    if (path.name == COMPLETE_JSON) == are_marks
                }
                for future in as_completed(futures):
                    future.result()
                    advance(sizes[futures[future]])
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


def is_whole(path: Path, member: Member) -> bool:
    """Return whether a file was fetched before; files get their name only once they are checked.

    Metadata files of another revision may have the same size, so their bytes are compared.
    """
    if not path.is_file() or path.stat().st_size != member.size:
        return False
    if member.crc32 is None or path.name not in SCENE_TEXTS:
        return True
    return zlib.crc32(path.read_bytes()) == member.crc32


def _require_room(dest: Path, needed: int) -> None:
    with _named_errors(dest):
        dest.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(dest).free
    if needed + _SPARE_BYTES > free:
        raise StorageError(
            f"{dest}: needs {needed} bytes, and the disk has {free} left. Choose fewer scenes or "
            f"cameras, or another disk."
        )


def _named_errors(place: Path) -> AbstractContextManager[None]:
    return explain_os_errors(f"{place}: cannot be written", "Choose another folder.")


def _copy(
    index: SceneIndex, source: MemberSource, path: Path, of: tuple[Scene, str], stop: Event
) -> None:
    scene, name = of
    member, where = scene.members[name], f"{source.url(*of)}: {scene.id.key}.{name}"
    packed = io.BytesIO()

    def copied_to(file: BinaryIO) -> None:
        def write(chunk: bytes) -> None:
            if stop.is_set():
                raise StorageError(f"{path}: is not copied any further.")
            file.write(chunk)

        with closing(_chunks(index, member)) as chunks:
            crc32 = copy_with_crc32(chunks, write)
        require_crc32(crc32, expected=member.crc32, name=where)

    with _named_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.name == name:
            with open_atomic(path) as file:
                copied_to(file)
            return
        copied_to(packed)
        with DepthFrames(packed, name=where, frames=scene.frames) as depth:
            if path.exists():
                _require_restored(path, depth, frames=scene.frames)
                return
            with open_atomic(path) as file:
                write_depth_video(depth, Path(file.name))


def _require_restored(path: Path, packed: DepthFrames, *, frames: int) -> None:
    """Refuse a depth video that does not hold the numbers of packed depth."""
    is_same = False
    with suppress(MediaError, StorageError), open_video(path, name=str(path), frames=frames) as own:
        is_same = all(
            np.array_equal(
                read_depth_units(own, frame, encoding=ANY_DEPTH),
                read_depth_units(packed, frame, encoding=ANY_DEPTH),
            )
            for frame in range(frames)
        )
    if not is_same:
        raise in_the_way(path)


def in_the_way(path: Path) -> ShardError:
    """Return the error of a file that exists and is another one."""
    return ShardError(
        f"{path}: already exists, and is not what the shards hold. Move it away, or unpack into "
        f"another folder."
    )


def _chunks(index: SceneIndex, member: Member) -> Generator[bytes, None, None]:
    if is_remote(index.root):
        remote = RemoteObject(joined(index.root, member.path), retry=index.retry)
        yield from remote.chunks(member.offset, member.offset + member.size)
        return
    opened = open_local(index.root, member, shard=index.shards.get(member.path))
    with opened.open("rb") if isinstance(opened, Path) else opened as file:
        yield from read_chunks(file, member.size)
