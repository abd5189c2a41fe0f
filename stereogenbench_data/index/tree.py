"""The scenes of a tree in the released layout: their folders and files.

    ROOT/train/<family>/<map>/<scene>/
    ROOT/eval/<subset>/<family>/<map>/<scene>/

`find_scene_folders` lists folders down to where scenes belong, here or behind a URL, and says where
misplaced ones should be; one that is too deep is told when the files of the folder above it are
listed. The Hub lists a thousand files a request, so `RemoteTree` lists a release in some hundred. A
`SceneFolder` reads one scene's files; behind a URL several at a time, and of large videos both
ends alone.
"""

import hashlib
import io
import json
import os
import re
import sys
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TypeVar

from stereogenbench_data.errors import (
    SchemaError,
    StereoGenBenchError,
    StorageError,
    explain_os_errors,
)
from stereogenbench_data.index.tree_cache import NOTHING_KEPT, TreeCache
from stereogenbench_data.media.container import BinaryFile
from stereogenbench_data.media.heads import END_BYTES
from stereogenbench_data.schema.document import (
    MAX_TEXT_BYTES,
    parse_document,
    require_text_size,
)
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.release import (
    BASELINE_JSON,
    COMPLETE_JSON,
    METADATA_FILES,
    PACKED_DEPTH_NAMES,
    TRAINING_JSON,
    TRAJECTORY_JSON,
    VIDEO_FILES,
)
from stereogenbench_data.schema.text import counted
from stereogenbench_data.sources.location import is_remote
from stereogenbench_data.sources.members import read_text_file
from stereogenbench_data.sources.ranged_file import RangedFile
from stereogenbench_data.sources.remote import RemoteObject

_T = TypeVar("_T")
_Item = TypeVar("_Item")

Files = Mapping[str, tuple[int, int]]
"""Name of each file of a scene to its size in bytes, and a number that changes with the file."""

FILES: Final = frozenset(
    {*METADATA_FILES, TRAINING_JSON, *VIDEO_FILES, *PACKED_DEPTH_NAMES.values()}
)
"""Files of a release; of others in a scene's folder, JSON files alone may speak of its depth."""


def is_read(name: str) -> bool:
    """Return whether a file of a scene is read: one of a release, or other JSON."""
    return name in FILES or (name.endswith(".json") and name[0] != ".")


_AT_A_TIME: Final = 24
_READ_WHOLE: Final = 2 * END_BYTES
"""Videos up to this size are fetched whole when a scene is described, of larger ones both ends."""


def in_parallel(read: Callable[[_Item], _T], items: Iterable[_Item]) -> Iterator[_T]:
    """Yield what is read of each item, in order; several wait for the server at a time."""
    with ThreadPoolExecutor(_AT_A_TIME) as pool:
        yield from pool.map(read, items)


def folder_of(root: str | Path, key: str) -> "SceneFolder":
    """Return a scene's folder on this machine or behind a URL; nothing is read yet."""
    if is_remote(root):
        return RemoteFolder(RemoteObject(str(root)), key)
    return SceneFolder(root, key)


def stamp_of(files: Files) -> str:
    """Return a digest of a scene's files that changes when one of them does."""
    return hashlib.sha256(repr(sorted(files.items())).encode()).hexdigest()[:32]


class SceneFolder:
    """A scene's folder on this machine.

    Attributes:
        key: The scene's key.
    """

    def __init__(self, root: str | Path, key: str) -> None:
        """Name the folder by the data's root and the scene's key; nothing is read yet."""
        self._root = root
        self.key = key

    def stamps(self) -> dict[str, tuple[int, int]]:
        """Return the size in bytes of each file, and a number that changes with it.

        Raises:
            StorageError: If the folder cannot be read, or scenes are below it.
        """
        folder = f"{self._root}/{self.key}"
        with (
            explain_os_errors(f"{folder}: cannot be read", "Fetch the scene again."),
            os.scandir(folder) as entries,
        ):
            found = {entry.name: _stamp_of(entry) for entry in entries if is_read(entry.name)}
        files = () if found else Path(folder).rglob("*")
        if deeper := sorted({each.parent for each in files if each.name in _SCENE_FILES}):
            first = deeper[0].relative_to(self._root).as_posix()
            others = f" ({counted(len(deeper) - 1, 'other')} likewise.)" if deeper[1:] else ""
            raise StorageError(f"{refusal(str(self._root), first)}{others}")
        return dict(sorted(found.items()))

    def times(self) -> tuple[object, ...]:
        """Return numbers that change with the names of the files, and with ``baseline.json``."""
        folder = f"{self._root}/{self.key}"
        paths = folder, f"{folder}/{BASELINE_JSON}"
        with suppress(OSError):
            return tuple(_stamp(os.stat(path)) for path in paths)  # noqa: PTH116 - Paths cost more
        return ()

    def hollow(self, files: Files) -> dict[str, str]:
        """Return the files that cannot hold what they should, as their listing shows, and why.

        Args:
            files: Of the scene, as `stamps` returns them.
        """
        small = {
            name for name, (size, _) in files.items() if size < _LEAST_BYTES and name in _LARGE
        }
        # Of one that was cut short, the end tells.
        looked_at = sorted(small | ({TRAJECTORY_JSON} & files.keys()))
        reasons = {name: self._why_hollow(name, files[name][0]) for name in looked_at}
        return {name: f"{self.key}/{name}: {why}" for name, why in reasons.items() if why}

    def _why_hollow(self, name: str, size: int) -> str:
        path = Path(self._root, self.key, name)
        if size == 0:
            is_there = path.exists()
            return "is empty: fetch it again" if is_there else "is a link to a file that is missing"
        try:
            with path.open("rb", buffering=0) as file:
                is_pointer = size < _LEAST_BYTES and file.read(len(_POINTER)) == _POINTER
                file.seek(-min(size, _END_OF_JSON), os.SEEK_END)
                _, is_indented, line = file.read().rstrip().rpartition(b"\n")
        except OSError as error:
            return f"cannot be read ({error.strerror})"
        if is_pointer:
            return "is a Git LFS pointer and not the file: run `git lfs pull`"
        is_cut = name == TRAJECTORY_JSON and not line.endswith((b"}", b"]"))
        if name == TRAJECTORY_JSON and is_indented and line[:1].isspace():  # an inner bracket
            try:
                parse_document(self.read(name), where=name)
            except StereoGenBenchError:
                is_cut = True
        return "is cut short: fetch it again" if is_cut else ""

    def fetch(self, names: Iterable[str]) -> None:
        """Fetch files at a time, if they are behind a URL."""

    def read(self, name: str) -> bytes:
        """Return a metadata file, whole.

        Raises:
            StorageError: If it cannot be read.
            SchemaError: If it is too large for a metadata file.
        """
        where = f"{self.key}/{name}"
        return read_text_file(Path(self._root, where), where=where)

    def video(self, name: str) -> Path | BinaryFile:
        """Return a video: its path, or an open file that the caller closes.

        Raises:
            StorageError: If it cannot be read.
        """
        return Path(self._root, self.key, name)


_LEAST_BYTES: Final = 1024
"""No video is smaller, and every Git LFS pointer is."""
_POINTER: Final = b"version https://git-lfs"
_END_OF_JSON: Final = 64
_VIDEOS: Final = frozenset({*VIDEO_FILES, *PACKED_DEPTH_NAMES.values()})
_LARGE: Final = _VIDEOS | {BASELINE_JSON, TRAJECTORY_JSON}


def _stamp_of(entry: "os.DirEntry[str]") -> tuple[int, int]:
    """Return the size of a file and a number that changes with it; a dangling link has no bytes."""
    try:
        return _stamp(entry.stat())
    except OSError:
        if not entry.is_symlink():
            raise
        return 0, 0


def _stamp(status: os.stat_result) -> tuple[int, int]:
    # Times of modification can be set, as `tar` does; those of change cannot, but on Windows.
    return status.st_size, status.st_mtime_ns + status.st_ctime_ns


class WholeFiles(SceneFolder):
    """A scene's folder on this machine of which each file is read through, once."""

    def __init__(self, root: str | Path, key: str) -> None:
        """Name the folder by the data's root and the scene's key; nothing is read yet."""
        super().__init__(root, key)
        self._crc32s: dict[str, int] = {}

    def read(self, name: str) -> bytes:
        """Return a metadata file, whole, as `SceneFolder.read` does."""
        content = super().read(name)
        self._crc32s[name] = zlib.crc32(content)
        return content

    def video(self, name: str) -> io.BytesIO:
        """Return a video, whole in memory.

        Raises:
            StorageError: If it cannot be read.
        """
        path = Path(self._root, self.key, name)
        with explain_os_errors(f"{path}: cannot be read", "Fetch it again."):
            content = path.read_bytes()
        self._crc32s[name] = zlib.crc32(content)
        return io.BytesIO(content)

    def crc32(self, name: str) -> int:
        """Return the crc32 of a file.

        Raises:
            StorageError: If it cannot be read.
        """
        if name not in self._crc32s:
            self.video(name).close()
        return self._crc32s[name]


class RemoteFolder(SceneFolder):
    """A scene's folder behind a URL."""

    def __init__(
        self,
        root: RemoteObject,
        key: str,
        files: Files | None = None,
        kept: TreeCache | None = None,
    ) -> None:
        """Name the folder, its files if they are listed already, and where small ones are kept."""
        self.key = key
        self._folder = root.below(key)
        self._listed = files
        self._kept = kept or NOTHING_KEPT
        self._objects: dict[str, RemoteObject] = {}
        self._parts: dict[str, list[tuple[int, bytes]]] = {}

    @property
    def _files(self) -> Files:
        if self._listed is None:
            self._listed = {
                name: (size, 0)
                for name, (size, _) in sorted(self._folder.listed().items())
                if size is not None and is_read(name)
            }
        return self._listed

    def stamps(self) -> dict[str, tuple[int, int]]:
        """Return the size in bytes of each file, and a number that changes with it."""
        return dict(self._files)

    def _why_hollow(self, name: str, size: int) -> str:
        if size == 0:
            return "is empty: upload it again"
        is_pointer = name in _VIDEOS
        return f"has {size} bytes, as a Git LFS pointer: upload the file" if is_pointer else ""

    def fetch(self, names: Iterable[str]) -> None:
        """Fetch small files, and both ends of videos, at a time.

        Raises:
            StorageError: If one cannot be read.
        """
        parts: list[tuple[str, int, int]] = []
        for name in names:
            is_video = name.startswith("cam_")
            is_small = self._files.get(name, (0, 0))[0] <= MAX_TEXT_BYTES
            if name in self._files and name not in self._objects and (is_video or is_small):
                size, _ = self._files[name]
                self._objects[name] = self._folder.below(name, expected_size=size)
                if is_video and size > _READ_WHOLE:
                    parts += (name, 0, END_BYTES), (name, size - END_BYTES, size)
                else:
                    parts.append((name, 0, size))
        for part, data in zip(parts, in_parallel(self._part, parts), strict=True):
            self._parts.setdefault(part[0], []).append((part[1], data))

    def read(self, name: str) -> bytes:
        """Return a metadata file, whole.

        Raises:
            StorageError: If it cannot be read.
            SchemaError: If it is too large for a metadata file.
        """
        if name not in self._files:
            raise StorageError(f"{self.key}/{name}: is missing.")
        require_text_size(self._files[name][0], where=f"{self.key}/{name}")
        self.fetch([name])
        return self._parts[name][0][1]

    def video(self, name: str) -> RangedFile:
        """Return a video, an open file that the caller closes.

        Raises:
            StorageError: If it cannot be read.
        """
        self.fetch([name])
        size, _ = self._files[name]
        video = RangedFile(self._objects[name].read, size=size)
        video.is_far = size > _READ_WHOLE
        for start, data in self._parts[name]:
            video.keep(start, data)
        return video

    def _part(self, part: tuple[str, int, int]) -> bytes:
        name, start, stop = part
        if name.startswith("cam_"):
            return self._objects[name].read(start, stop)
        version = f"{self.key}/{name} {self._files[name]}"
        return self._kept.once("files", version, lambda: self._objects[name].read(start, stop))


_LAYOUT: Final = "train/<family>/<map>/<scene> or eval/<subset>/<family>/<map>/<scene>"
_SCENE_FILES: Final = frozenset({BASELINE_JSON, TRAJECTORY_JSON, COMPLETE_JSON, *VIDEO_FILES})
SPLITS: Final = {"train": 4, "eval": 5}
"""How many parts a scene's path has, by its split."""
_FEW: Final = 32
"""Of fewer scenes of a folder each is listed by itself."""
_DEEPEST: Final = 8
"""How many levels below the root are searched."""


def find_scene_folders(root: Path | RemoteObject) -> tuple[list[str], dict[str, str]]:
    """Return the keys of the scenes below a root, sorted, and the folders of misplaced ones.

    Returns:
        The keys, and other folders: path to what is wrong with it, and the cure.

    Raises:
        StorageError: If the root is not a folder that can be listed, or no scene is where it
            belongs.
    """
    if isinstance(root, Path) and not root.exists():
        raise StorageError(f"{root}: does not exist; expected a folder that holds train/ or eval/.")
    where = root.where if isinstance(root, RemoteObject) else os.path.abspath(root)  # noqa: PTH100
    places, others = search(root, SPLITS if isinstance(root, RemoteObject) else ())
    refused = {path: why or refusal(where, path) for path, why in others.items()}
    refused |= {path: why for path in places if (why := refusal(where, path))}
    keys = sorted({*places} - refused.keys())
    if not keys:
        looked = f"{where}: holds no scene; looked for folders {_LAYOUT}"
        roots = {_release_root_of(f"{where}/{path}") for path in refused} - {"", where}
        if roots:
            raise StorageError(f"{looked}. Point at {' or '.join(sorted(roots)[:3])} instead.")
        if refused:
            path = min(refused)
            told = f"{len(refused)} elsewhere, such as {path}: {refused[path]}"
        else:
            names = ", ".join(sorted(_names(root, ""))[:8]) or "nothing"
            told = f"{names}. Point at what holds train/ or eval/."
        raise StorageError(f"{looked}, and found {told}")
    return keys, dict(sorted(refused.items()))


def search(
    root: Path | RemoteObject, only: Collection[str] = ()
) -> tuple[list[str], dict[str, str]]:
    """Return the paths where scenes belong, and other folders that hold files of scenes.

    Folders are listed level by level, several at a time; where a scene belongs, nothing is listed.
    Names that start with a dot are ignored.

    Args:
        root: The root.
        only: The folders in it to search; () is all.

    Returns:
        The paths, and others: path to why it cannot be listed, "" where files of a scene are.

    Raises:
        StorageError: If the root, or a folder behind a URL, cannot be listed.
    """
    places: list[str] = []
    odd: dict[str, str] = {}

    def below(path: str) -> list[str]:
        try:
            names = _names(root, path)
        except StorageError as error:
            if isinstance(root, RemoteObject) or not path:
                raise
            odd[path] = str(error)
            return []
        if not _SCENE_FILES.isdisjoint(names):
            odd[path or "."] = ""
            return []
        return [
            f"{path}/{name}".removeprefix("/")
            for name, is_folder in names.items()
            if is_folder and name[0] != "." and (path or not only or name in only)
        ]

    paths = [""]
    for depth in range(1, _DEEPEST + 2):
        found = [path for listed in in_parallel(below, paths) for path in listed]
        paths = []
        for path in found:
            is_place = SPLITS.get(path.partition("/")[0]) == depth
            (places if is_place else paths).append(path)
    return places, odd


def _names(root: Path | RemoteObject, path: str) -> dict[str, bool]:
    """Return the names in a folder, and whether each is a folder.

    Raises:
        StorageError: If it cannot be listed.
    """
    if isinstance(root, RemoteObject):
        listed = (root.below(path) if path else root).listed()
        return {name: size is None for name, (size, _) in listed.items()}
    folder = root / path
    with explain_os_errors(f"{folder}: cannot be searched", "Check that it is a readable folder."):
        above = folder.parents[: len(Path(path).parts)] if folder.is_symlink() else ()
        if any(map(folder.samefile, above)):
            raise StorageError(f"{folder}: is a link to a folder above itself. Remove the link.")
        with os.scandir(folder) as there:
            return {each.name: each.is_dir(follow_symlinks=False) or Path(each).is_dir()
                    for each in there}  # fmt: skip


def refusal(root: str, path: str) -> str:
    """Return why a folder cannot be a scene of the release, and the cure; "" if it can."""
    try:
        parse_scene_key(path)
    except SchemaError as error:
        other = _release_root_of(f"{root}/{path}")
        if other == root:
            return str(error)  # the folder's name is wrong, and the error says so
        cure = f"Move it, or point at {other} instead." if other else "Move it to such a path."
        return f"{error} {cure}"
    return ""


def _release_root_of(place: str) -> str:
    """Return the root below which a folder would be a scene of the release; "" if none is."""
    parts = place.removesuffix("/.").split("/")
    for name, depth in SPLITS.items():
        if len(parts) > depth and parts[-depth] == name:
            return "/".join(parts[:-depth])
    return ""


class RemoteTree:
    """The listings of a tree behind a URL.

    Attributes:
        root: The tree.
    """

    def __init__(self, root: RemoteObject) -> None:
        """Ask for the commit of a tree of the Hub; nothing else is requested yet.

        Raises:
            StorageError: If the server cannot be asked.
        """
        self.root = root
        pinned = root.pinned()
        self._kept = TreeCache(pinned) if pinned else NOTHING_KEPT

    def scenes(self) -> tuple[list[str], dict[str, str]]:
        """Return what `find_scene_folders` finds.

        Raises:
            StorageError: If the tree cannot be listed, or no scene is where it belongs.
        """
        keys, refused = self._cached_or_built("scenes", lambda: find_scene_folders(self.root))
        return keys, refused

    def files(self, keys: Sequence[str]) -> tuple[dict[str, Files], dict[str, str]]:
        """Return the files of scenes, and scenes beside or below them whose place is wrong.

        Returns:
            Key to files, and path to what is wrong with it.

        Raises:
            StorageError: If they cannot be listed.
        """
        by_folder: dict[str, list[str]] = {}
        for key in keys:
            by_folder.setdefault(key.rsplit("/", 2)[0], []).append(key)
        folders: list[str] = []
        for folder, own in by_folder.items():
            folders += [folder] if len(own) >= _FEW else own
        found: dict[str, dict[str, tuple[int, int]]] = {key: {} for key in keys}
        others: set[str] = set()
        for folder, listed in zip(folders, in_parallel(self._listed, folders), strict=True):
            for path, (size, stamp) in listed.items():
                key, _, name = f"{folder}/{path}".rpartition("/")
                if key in found and is_read(name):
                    found[key][sys.intern(name)] = size, stamp
                elif key not in found and name in _SCENE_FILES:
                    others.add(key)
        refused = {key: why for key in others if (why := refusal(self.root.where, key))}
        return {key: dict(sorted(files.items())) for key, files in found.items()}, refused

    def _listed(self, folder: str) -> Mapping[str, Sequence[int]]:
        def listed() -> dict[str, tuple[int, int]]:
            return {
                path: (size, _number(version))
                for path, (size, version) in self.root.below(folder).listed("all levels").items()
                if size is not None
            }

        found: Mapping[str, Sequence[int]] = self._cached_or_built(folder, listed)
        return found

    def _cached_or_built(self, name: str, ask: Callable[[], Any]) -> Any:
        """Return an answer as JSON holds it; that of a commit is kept."""
        return json.loads(self._kept.once("listing", name, lambda: json.dumps(ask()).encode()))


def _number(version: str) -> int:
    """Return a number that stands for an ETag or a digest."""
    digits = re.match(r"[0-9a-f]{15}", version)
    return int(digits[0], 16) if digits else zlib.crc32(version.encode())
