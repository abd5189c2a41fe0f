"""A part of a release onto this disk: only the files that a selection needs, each one checked.

Files are laid out as they were released, whatever they came from, with an index beside them that
names those that are there. A run that was stopped goes on: files that are whole are kept.
"""

import shutil
import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event
from typing import Final

from stereogenbench_data.engine import Progress
from stereogenbench_data.errors import StorageError, describe_os_error
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.index.tree import ListedTree
from stereogenbench_data.schema.records import Member, Scene
from stereogenbench_data.schema.release import METADATA_FILES
from stereogenbench_data.sources.files import copy_with_crc32, open_atomic
from stereogenbench_data.sources.location import is_remote, joined, local_path
from stereogenbench_data.sources.members import open_local, require_own_files
from stereogenbench_data.sources.remote import RemoteObject

_CHUNK: Final = 1024 * 1024
_SPARE_BYTES: Final = 16 * 1024 * 1024


class _Cancelled(Exception):
    """Another file failed, so this one is not fetched to its end."""


@dataclass(frozen=True, slots=True)
class WantedFile:
    """One file of a scene: its key, its name, and where it lies now."""

    key: str
    name: str
    member: Member


@dataclass(frozen=True, slots=True)
class Download:
    """What is to be fetched.

    Attributes:
        scenes: The scenes, each with just the members that are wanted.
        files: All their files.
    """

    scenes: tuple[Scene, ...]
    files: tuple[WantedFile, ...]

    @property
    def size_bytes(self) -> int:
        """The bytes of all files."""
        return sum(wanted.member.size for wanted in self.files)


def plan_download(
    index: SceneIndex, rows: Sequence[int], *, cameras: Sequence[int], streams: Sequence[str]
) -> Download:
    """Return what must be fetched for some scenes.

    Args:
        index: Of the data.
        rows: The scenes, by row.
        cameras: Numbers of the cameras whose videos are wanted.
        streams: "rgb", "depth" or both.

    Raises:
        StorageError: If the index itself lacks a wanted file.
    """
    scenes = []
    for row in rows:
        scene = index.scene(int(row))
        stems = [f"cam_{camera:02d}_{stream}" for camera in cameras for stream in streams]
        videos = {name.partition(".")[0]: name for name in scene.members}
        missing = [stem for stem in stems if stem not in videos]
        if missing:
            raise StorageError(
                f"{scene.id.key}: the index has no {', '.join(missing)}: it is of a part. Download "
                "from the whole."
            )
        names = [name for name in METADATA_FILES if name in scene.members]
        names += [videos[stem] for stem in stems]
        scenes.append(replace(scene, members={name: scene.members[name] for name in names}))
    files = [
        WantedFile(scene.id.key, name, member)
        for scene in scenes
        for name, member in scene.members.items()
    ]
    return Download(tuple(scenes), tuple(files))


def download(
    index: SceneIndex,
    wanted: Download,
    dest: str | Path,
    *,
    workers: int = 8,
    progress: Progress | None = None,
) -> SceneIndex:
    """Fetch files into a folder, and write an index of them there.

    Args:
        index: Of the data, for where they lie.
        wanted: What to fetch, of `plan_download`.
        dest: The folder; made if it is not there.
        workers: How many files are fetched at a time.
        progress: Called with the bytes done and those of all.

    Returns:
        The index of what is there now. Scenes of an earlier download into the same folder that are
        not wanted now stay on the disk but not in the index.

    Raises:
        StorageError: If a file cannot be fetched or stored, has not its checksum, or the disk has
            no room.
    """
    dest = local_path(dest)
    if not is_remote(index.root) and dest == local_path(index.root):
        raise StorageError(f"{dest}: is where the data are. Name another folder.")
    if not is_remote(index.root):
        require_own_files(index.root, sorted({each.member.path for each in wanted.files}))
    missing = [each for each in wanted.files if not _is_whole(each, dest)]
    needed = sum(each.member.size for each in missing)
    done = wanted.size_bytes - needed
    _require_room(dest, needed)
    if progress is not None:
        progress(done, wanted.size_bytes)
    stop = Event()
    with ThreadPoolExecutor(max_workers=max(1, workers)) as pool:
        futures = {pool.submit(_fetch, index, each, dest, stop): each for each in missing}
        waiting = set(futures)
        try:
            while waiting:
                finished, waiting = wait(waiting, timeout=0.5, return_when=FIRST_EXCEPTION)
                for future in finished:
                    future.result()
                    done += futures[future].member.size
                if progress is not None:
                    progress(done, wanted.size_bytes)
        finally:
            stop.set()
            pool.shutdown(wait=True, cancel_futures=True)
    scenes = [
        replace(
            scene,
            members={
                name: replace(member, path=f"{scene.id.key}/{name}", offset=0)
                for name, member in scene.members.items()
            },
        )
        for scene in wanted.scenes
    ]
    here = SceneIndex.from_scenes(scenes, dest)
    here.passed_over = tuple(sorted(ListedTree(dest).keys - {scene.id.key for scene in scenes}))
    here.write(dest / INDEX_NAME)
    return here


def _is_whole(wanted: WantedFile, dest: Path) -> bool:
    """Return whether a file was fetched before: it is moved into place only once it is checked.

    Metadata files of another revision may have the same size, so they are compared whole.
    """
    path, member = dest / wanted.key / wanted.name, wanted.member
    if not path.is_file() or path.stat().st_size != member.size:
        return False
    if member.crc32 is None or wanted.name not in METADATA_FILES:
        return True
    return zlib.crc32(path.read_bytes()) == member.crc32


def _require_room(dest: Path, needed: int) -> None:
    try:
        dest.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(dest).free
    except OSError as error:
        raise StorageError(_why_not_written(dest, error)) from error
    if needed + _SPARE_BYTES > free:
        raise StorageError(
            f"{dest}: {needed} bytes are to come, and the disk has room for {free}. Take fewer "
            "scenes or cameras, or another disk."
        )


def _why_not_written(place: Path, error: OSError) -> str:
    return describe_os_error(f"{place}: cannot be written", error, "Choose another folder.")


def _fetch(index: SceneIndex, wanted: WantedFile, dest: Path, stop: Event) -> None:
    place = dest / wanted.key / wanted.name
    member = wanted.member
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        with open_atomic(place) as file:
            crc32 = copy_with_crc32(_until(stop, _chunks(index, member)), file.write)
            if member.crc32 not in (None, crc32):
                raise StorageError(
                    f"{wanted.key}/{wanted.name}: came with crc32 {crc32:08x}, and the index says "
                    f"{member.crc32:08x}. The source is damaged, or not the one that was indexed."
                )
    except _Cancelled:
        return
    except OSError as error:
        if isinstance(error, StorageError):
            raise
        raise StorageError(_why_not_written(place, error)) from error


def _until(stop: Event, chunks: Iterator[bytes]) -> Iterator[bytes]:
    for data in chunks:
        if stop.is_set():
            raise _Cancelled
        yield data


def _chunks(index: SceneIndex, member: Member) -> Iterator[bytes]:
    if is_remote(index.root):
        remote = RemoteObject(joined(index.root, member.path), retry=index.retry)
        yield from remote.chunks(member.offset, member.offset + member.size)
        return
    opened = open_local(index.root, member, shard=index.shards.get(member.path))
    with opened.open("rb") if isinstance(opened, Path) else opened as file:
        while data := file.read(_CHUNK):
            yield data
