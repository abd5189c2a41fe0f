"""Where a scene's bytes are, and how they are opened: files, members of shards, URLs, the cache."""

import copy
import os
import re
import stat
import zlib
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final, Literal, TypeVar

from stereogenbench_data.errors import ShardError, StorageError, explain_os_errors
from stereogenbench_data.media.container import SeekableFile
from stereogenbench_data.media.seek_table import ReadCursor, SeekTable, parse_tables
from stereogenbench_data.schema.document import require_text_size
from stereogenbench_data.schema.records import Member, Scene, ShardFacts
from stereogenbench_data.schema.text import shortened
from stereogenbench_data.sources.cache import ShardCache
from stereogenbench_data.sources.fetch_ahead import FetchAhead, Wanted
from stereogenbench_data.sources.location import UNSAFE_PATH, is_remote, joined, local_path, shown
from stereogenbench_data.sources.ranged_file import (
    FileSlice,
    RangedFile,
    require_crc32,
)
from stereogenbench_data.sources.remote import RemoteObject
from stereogenbench_data.sources.retry import RetryPolicy, require_expected_size

_Local = TypeVar("_Local", Path | FileSlice, FileSlice)

_KEPT_TABLES: Final = 256
"""Of how many scenes the seek tables are kept."""


class MemberSource:
    """Opens the files of an index's scenes, wherever they lie.

    A file of a released folder is returned as its path, a member of a local shard as an open file
    over its part of the shard. A member behind a URL is fetched in ranges as it is read; with a
    cache it is fetched whole, once.
    """

    def __init__(  # noqa: PLR0913 - what reading depends on
        self,
        root: str | Path,
        *,
        shards: Mapping[str, ShardFacts],
        revision: str = "",
        cache: ShardCache | None = None,
        check: Literal["opened", "metadata"] = "metadata",
        retry: RetryPolicy | None = None,
        ahead: FetchAhead | None = None,
    ) -> None:
        """Prepare to read; nothing is opened yet.

        Args:
            root: The folder or URL that members' paths are relative to.
            shards: What the index knows of each shard, by path.
            revision: The index's digest, by which a cache distinguishes data.
            cache: Where to keep members that come from a URL, or None.
            check: What is compared with its checksum, where the index has one. "opened": each file
                on this machine when this process first opens it, and each member from a URL when
                its last byte arrives. "metadata": metadata files only.
            retry: How reading from a server is retried; None for the defaults.
            ahead: Where `wanted` ranges are fetched ahead; None fetches each when it is read.
        """
        self._root = str(root)
        self._shards = shards
        self._revision = revision
        self._cache = cache
        self._check = check
        self._policy = retry
        self._ahead = ahead
        self._tables: OrderedDict[bytes, dict[str, SeekTable]] = OrderedDict()
        self._sound: set[tuple[str, int]] = set()
        self._objects: dict[str, RemoteObject] = {}

    def open(self, scene: Scene, name: str) -> Path | SeekableFile:
        """Return one of a scene's files: its path, or an open file that is the caller's to close.

        Raises:
            StorageError: If it is missing, unreadable or not the one that was indexed.
        """
        member, name = scene.member(name), scene.held_name(name)
        if not is_remote(self._root):
            local = open_local(self._root, member, shard=self._shards.get(member.path))
            return self._checked(local, scene, name)
        _require_safe(member)
        remote = self._object(member)
        if self._cache is not None:
            if self._ahead is not None:
                self._ahead.read(_cached(member), 0)  # waits, if it is on its way
            stored = self._cache.open(member, remote=remote, revision=self._revision)
            return self._checked(stored, scene, name)
        ahead, offset = self._ahead, member.offset

        def fetch(start: int, stop: int) -> bytes:
            return remote.read(offset + start, offset + stop)

        def fetched(at: int) -> tuple[int, bytes] | None:
            found = None if ahead is None else ahead.read(member.path, offset + at)
            return None if found is None else (found[0] - offset, found[1])

        return RangedFile(
            fetch,
            size=member.size,
            name=self.label(scene, name),
            crc32=member.crc32 if self._check == "opened" else None,
            table=self._table(scene, name),
            ahead=fetched,
        )

    def fetching_by(self, ahead: FetchAhead) -> "MemberSource":
        """Return the same source, for another reader."""
        twin = copy.copy(self)
        twin._ahead = ahead
        return twin

    @property
    def is_cached(self) -> bool:
        """Whether whole files are fetched, and kept on disk."""
        return self._cache is not None

    def position(self, scene: Scene, name: str, *, kept_frames: int) -> ReadCursor | None:
        """Return where a reader of one of a scene's videos stands that is not open.

        None if it is not known which bytes a frame needs, or all of them are fetched.
        """
        if self._cache is not None:
            return None
        table = self._table(scene, scene.held_name(name))
        return None if table is None else ReadCursor(table, kept_frames=kept_frames)

    def wanted(
        self, scene: Scene, name: str, ranges: Iterable[tuple[int, int]] | None = None
    ) -> list[Wanted]:
        """Return what to fetch ahead for ranges of one of a scene's files, or all of it.

        With a cache that is the whole file, which is put there unless the cache has it.
        """
        member = scene.member(name)
        _require_safe(member)
        remote, offset = self._object(member), member.offset
        cache = self._cache
        if cache is not None:

            def fill(start: int, stop: int) -> bytes:
                cache.open(member, remote=remote, revision=self._revision).close()
                return b""

            if cache.holds(member, where=remote.where, revision=self._revision):
                return []
            return [Wanted(_cached(member), 0, 1, fill, member.size)]

        parts = [(0, member.size)] if ranges is None else ranges
        return [Wanted(member.path, offset + a, offset + b, remote.read) for a, b in parts]

    def _table(self, scene: Scene, name: str) -> SeekTable | None:
        """Return the seek table of one of a scene's videos, if there is one that fits it."""
        if scene.seek_tables is None:
            return None
        key = scene.seek_tables
        if key not in self._tables:
            self._tables[key] = {
                each: table
                for each, table in parse_tables(scene.seek_tables).items()
                if each in scene.members and table.fits(file_bytes=scene.members[each].size)
            }
            if len(self._tables) > _KEPT_TABLES:
                self._tables.popitem(last=False)
        return self._tables[key].get(name)

    def _checked(self, file: _Local, scene: Scene, name: str) -> _Local:
        """Return a file after its first checksum comparison, where `check` asks for one."""
        member = scene.members[name]
        place = (member.path, member.offset)
        if self._check == "opened" and member.crc32 is not None and place not in self._sound:
            whole = FileSlice(file, member) if isinstance(file, Path) else file
            try:
                require_crc32(whole.crc32(), expected=member.crc32, name=self.label(scene, name))
            except StorageError:
                whole.close()
                raise
            if isinstance(file, Path):
                whole.close()
            self._sound.add(place)
        return file

    def read(self, scene: Scene, name: str) -> bytes:
        """Return the bytes of one of a scene's metadata files, compared with its checksum.

        Raises:
            StorageError: If it is missing, unreadable or not the one that was indexed.
            SchemaError: If it is too large for a metadata file.
        """
        where, member = self.label(scene, name), scene.members[name]
        require_text_size(member.size, where=where)
        opened = self.open(scene, name)
        if isinstance(opened, Path):
            text = read_text_file(opened, where=where)
        else:
            with opened:
                text = opened.read()
        require_crc32(zlib.crc32(text), expected=member.crc32, name=where)
        return text

    def label(self, scene: Scene, name: str) -> str:
        """Return the place and the name of one of a scene's files, for messages."""
        name = scene.held_name(name)
        place = self._shown(scene.members[name].path)
        return place if place.endswith(name) else f"{place}: {name}"

    def url(self, scene: Scene, name: str) -> str:
        """Return what holds a scene's file: its shard, or the scene's own folder."""
        place = scene.members[name].path
        return self._shown(place if place in self._shards else scene.id.key)

    def drop_damaged(self, scene: Scene, names: Iterable[str]) -> bool:
        """Drop a scene's damaged files from the cache; return whether there were any.

        If so, reading again may help.
        """
        if self._cache is None or not is_remote(self._root):
            return False
        dropped = [
            self._cache.drop_damaged(
                member, where=self._object(member).where, revision=self._revision
            )
            for member in (scene.members[name] for name in names)
        ]
        return any(dropped)

    def _shown(self, path: str) -> str:
        if is_remote(self._root):
            return shown(joined(self._root, path))
        return str(local_path(self._root) / path)

    def _object(self, member: Member) -> RemoteObject:
        """Return the file that holds a member; it is kept, so its size is checked once."""
        if member.path not in self._objects:
            shard = self._shards.get(member.path)
            self._objects[member.path] = RemoteObject(
                joined(self._root, member.path),
                expected_size=member.offset + member.size if shard is None else shard.size,
                retry=self._policy,
            )
        return self._objects[member.path]

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy in another process, which checks sizes for itself."""
        return self.__dict__ | {"_objects": {}, "_tables": OrderedDict()}


def _cached(member: Member) -> tuple[str, int]:
    """Return what stands for a whole member that is put into a cache."""
    return member.path, member.offset


def open_local(
    root: str | Path, member: Member, *, shard: ShardFacts | None = None
) -> Path | FileSlice:
    """Return a member's path where it is a whole file, else an open file over its part.

    Args:
        root: The folder that the member's path is relative to.
        member: What to open.
        shard: What the index knows of the file that holds the member, where that is a shard.

    Raises:
        StorageError: If the file is missing, unreadable or not the one that was indexed.
    """
    _require_safe(member)
    path, end = local_path(root) / member.path, member.offset + member.size
    is_whole = shard is None and member.offset == 0
    again = f"By the index it has {end} bytes or more: fetch it again, or make the index again."
    with explain_os_errors(f"{path}: cannot be read", again, kind=ShardError):
        opened = path if is_whole else FileSlice(path, member)
        found = path.stat().st_size
    expected = shard.size if shard is not None else end if is_whole else max(found, end)
    if found != expected and isinstance(opened, FileSlice):
        opened.close()
    require_expected_size(found, expected=expected, where=str(path))
    return opened


def require_own_files(root: str | Path, paths: Iterable[str]) -> None:
    """Refuse to pass on files of a folder if a link leads out of it.

    Such a link in a stranger's folder could publish any file of this machine. Links to other files
    of the folder are allowed; so are those of the Hub's cache, which keeps the files of a snapshot
    in ``blobs`` beside it. Reading alone follows all links.

    Args:
        root: The folder, on this machine.
        paths: The paths of the files below it.

    Raises:
        StorageError: It names the first such file, where it leads and what to do.
    """
    root = local_path(root)
    real = Path(os.path.realpath(root))
    own = [real] + [
        each.parent.parent / "blobs"  # the Hub's cache, if the folder is one of its snapshots
        for each in (real, *real.parents)
        if each.parent.name == "snapshots" and each.parent.parent.name.startswith("datasets--")
    ]
    for path in paths:
        place = Path(os.path.realpath(root / path))
        if not any(place.is_relative_to(each) for each in own):
            raise StorageError(
                f"{root / path}: leads out of {root} by a link, to {place}, and would be passed on "
                f"with the data. Copy the file into the folder if it may be (`cp -rL` copies what "
                f"links lead to); else remove the link."
            )


def _require_safe(member: Member) -> None:
    if re.search(UNSAFE_PATH, member.path):
        raise StorageError(
            f"{shortened(member.path)!r}: a member's path is relative to the data's root and stays "
            f"inside it. The index was not made by this package: run `stereogenbench index` again."
        )


def read_text_file(path: Path, *, where: str) -> bytes:
    """Return the bytes of a metadata file; its size is checked before it is read.

    Raises:
        StorageError: If the file is missing or unreadable.
        SchemaError: If it is too large for a metadata file.
    """
    with explain_os_errors(f"{where}: cannot be read", "Fetch it again."):
        status = path.stat()
        if stat.S_ISREG(status.st_mode):
            require_text_size(status.st_size, where=where)
            return path.read_bytes()
    raise StorageError(f"{where}: not a file. Put the release's own file in its place.")
