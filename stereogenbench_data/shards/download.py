"""Download a part of a release: only the files that a selection needs, each one checked.

Files are laid out as they were released, whether they come from shards or not. The index beside
them lists only what is there. Whole files are kept, so a run that was stopped continues.
"""

import shutil
import zlib
from collections.abc import Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event
from typing import Final

from stereogenbench_data.engine import Progress, advance_of
from stereogenbench_data.errors import StorageError, explain_os_errors
from stereogenbench_data.index.parquet import INDEX_NAME
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.records import Member, Scene
from stereogenbench_data.shards.plan import SCENE_TEXTS
from stereogenbench_data.shards.tar import read_chunks
from stereogenbench_data.sources.files import copy_with_crc32, open_atomic
from stereogenbench_data.sources.location import is_remote, joined, local_path
from stereogenbench_data.sources.members import open_local, require_own_files
from stereogenbench_data.sources.ranged_file import require_crc32
from stereogenbench_data.sources.remote import RemoteObject

_SPARE_BYTES: Final = 16 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class Download:
    """What to download: scenes, each with only the members that are wanted."""

    scenes: tuple[Scene, ...]

    @property
    def files(self) -> dict[str, Member]:
        """The files: the path that each will have, KEY/NAME, to where it is now."""
        return {
            f"{scene.id.key}/{name}": member
            for scene in self.scenes
            for name, member in scene.members.items()
        }

    @property
    def size_bytes(self) -> int:
        """The size of all files."""
        return sum(member.size for member in self.files.values())


def plan_download(
    index: SceneIndex, rows: Sequence[int], *, cameras: Sequence[int], streams: Sequence[str]
) -> Download:
    """Return what to download.

    Args:
        index: The index of the data.
        rows: The rows of the scenes.
        cameras: Numbers of the cameras whose videos are wanted.
        streams: "rgb", "depth" or both.

    Raises:
        StorageError: If the index lacks a wanted file.
    """
    return Download(
        tuple(
            replace(scene, members=_wanted_members(scene, cameras=cameras, streams=streams))
            for scene in (index.scene(int(row)) for row in rows)
        )
    )


def _wanted_members(
    scene: Scene, *, cameras: Sequence[int], streams: Sequence[str]
) -> dict[str, Member]:
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
    return {name: scene.members[name] for name in names}


def download_sizes(
    index: SceneIndex, rows: Sequence[int], *, cameras: Sequence[int], streams: Sequence[str]
) -> dict[int, int]:
    """Return the rows of scenes that have all wanted files, with the bytes of these.

    Raises:
        StorageError: If no scene has them.
    """
    sizes: dict[int, int] = {}
    lacking: StorageError | None = None
    for row in rows:
        scene = index.indexed_scene(int(row))
        try:
            members = _wanted_members(scene, cameras=cameras, streams=streams)
        except StorageError as error:
            lacking = error
            continue
        sizes[int(row)] = sum(member.size for member in members.values())
    if lacking is not None and not sizes:
        raise lacking
    return sizes


def download(
    index: SceneIndex,
    wanted: Download,
    dest: str | Path,
    *,
    workers: int = 8,
    progress: Progress | None = None,
) -> SceneIndex:
    """Download files into a folder, and write an index of them there.

    Args:
        index: The index of the data.
        wanted: What to download, from `plan_download`.
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
        require_own_files(index.root, sorted({member.path for member in wanted.files.values()}))
    scenes = _scenes_before(dest)
    _fetch_missing(index, wanted, dest, workers=workers, progress=progress)
    for scene in wanted.scenes:
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
        if all(_is_whole(dest / member.path, member) for member in scene.members.values())
    }


def _texts(members: Mapping[str, Member]) -> dict[str, tuple[int, int | None]]:
    """Return size and checksum of a scene's metadata, which differ in another revision."""
    return {name: (each.size, each.crc32) for name, each in members.items() if name in SCENE_TEXTS}


def _fetch_missing(
    index: SceneIndex, wanted: Download, dest: Path, *, workers: int, progress: Progress | None
) -> None:
    files = {dest / path: member for path, member in wanted.files.items()}
    missing = {place: member for place, member in files.items() if not _is_whole(place, member)}
    needed = sum(member.size for member in missing.values())
    _require_room(dest, needed)
    total = wanted.size_bytes
    advance = advance_of(progress, done=total - needed, total=total)
    advance(0)
    stop = Event()
    with ThreadPoolExecutor(max_workers=max(1, workers)) as pool:
        futures = {
            pool.submit(_fetch, index, member, place, stop): member.size
            for place, member in missing.items()
        }
        try:
            for future in as_completed(futures):
                future.result()
                advance(futures[future])
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


def _is_whole(path: Path, member: Member) -> bool:
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


def _fetch(index: SceneIndex, member: Member, place: Path, stop: Event) -> None:
    def write(chunk: bytes) -> None:
        if stop.is_set():
            raise StorageError(f"{place}: is not fetched any further.")
        file.write(chunk)

    with _named_errors(place):
        place.parent.mkdir(parents=True, exist_ok=True)
        with open_atomic(place) as file, closing(_chunks(index, member)) as chunks:
            crc32 = copy_with_crc32(chunks, write)
            require_crc32(crc32, expected=member.crc32, name=str(place))


def _chunks(index: SceneIndex, member: Member) -> Generator[bytes, None, None]:
    if is_remote(index.root):
        remote = RemoteObject(joined(index.root, member.path), retry=index.retry)
        yield from remote.chunks(member.offset, member.offset + member.size)
        return
    opened = open_local(index.root, member, shard=index.shards.get(member.path))
    with opened.open("rb") if isinstance(opened, Path) else opened as file:
        yield from read_chunks(file, member.size)
