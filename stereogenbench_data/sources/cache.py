"""A cache of members on a local disk, shared by the processes of a machine.

An item is one member, named by a hash of the dataset's revision, the shard's path and the member's
place, size and checksum. It is written beside its place and renamed, so no reader sees a partial
one; one process fetches it under a lock while others wait. At the limit, the least recently used
items are deleted; a file that a reader has open stays readable. A read-only cache serves what it
holds.

All items have one modification time, and their access time is their last use. Writing into an item
changes the modification time; then its checksum decides whether it is still valid.
"""

import hashlib
import json
import os
import re
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Final

from stereogenbench_data.errors import ShardError, StorageError, explain_os_errors
from stereogenbench_data.schema.records import Member
from stereogenbench_data.sources.files import copy_with_crc32, locked, try_locked, write_atomic
from stereogenbench_data.sources.ranged_file import FileSlice
from stereogenbench_data.sources.remote import RemoteObject

FOLDER_NAME: Final = "stereogenbench-members"
_TAG: Final = "CACHEDIR.TAG"
_TAG_TEXT: Final = (
    b"Signature: 8a477f597d28d172789f06886806bc55\n"
    b"# Members of StereoGenBench shards, kept by stereogenbench-data. The folder may be deleted.\n"
)
_OWN_FILE: Final = re.compile(r"([0-9a-f]{64})\.(member|part)")
_FULL: Final = 0.9
"""The share of the limit to which a full cache is emptied, so it is not emptied for each item."""

_STAMP_NS: Final = 1_000_000_000_000_000_000
"""The modification time of items: even seconds, which every file system can store."""


class ShardCache:
    """Keeps the members of remote shards that were read once.

    Any number of processes may use one folder, each with its own `ShardCache`; the smallest limit
    applies. Members that others are fetching may exceed it for that time. Only files that a cache
    wrote are deleted.
    """

    def __init__(self, folder: str | Path, *, limit_bytes: int) -> None:
        """Use a folder, in which the cache creates its own.

        Args:
            folder: Where to keep members; created if it is missing.
            limit_bytes: The most bytes of all members together.

        Raises:
            StorageError: If the folder has no name or cannot be made, or the limit is not a whole
                number above 0.
        """
        if not str(folder):
            raise StorageError("a cache needs a folder, got '': name one, such as 'cache/'.")
        if type(limit_bytes) is not int or limit_bytes < 1:
            raise StorageError(
                f"{folder}: a cache needs a limit in whole bytes above 0, got {limit_bytes!r}: "
                f"give a number, such as limit_bytes=50_000_000_000."
            )
        self.folder = Path(folder, FOLDER_NAME)
        self.limit_bytes = limit_bytes
        self._items = self.folder / "items"
        self._locks = self.folder / "locks"
        self._ledger = self._locks / "size"  # holds how many bytes all have; empty: count them
        with _named_errors(self.folder):
            self._items.mkdir(parents=True, exist_ok=True)
            self._locks.mkdir(exist_ok=True)
            if not (self.folder / _TAG).exists():
                write_atomic(self.folder / _TAG, _TAG_TEXT)

    def __repr__(self) -> str:
        """Return the folder and the limit."""
        return f"ShardCache({str(self.folder.parent)!r}, limit_bytes={self.limit_bytes})"

    def open(self, member: Member, *, remote: RemoteObject, revision: str) -> FileSlice:
        """Return a member, fetched if it is not stored; the caller closes it.

        Args:
            member: What to open.
            remote: The shard or file that holds it.
            revision: What distinguishes the dataset from its other versions.

        Raises:
            ShardError: If the fetched bytes have another checksum than the member, twice.
            StorageError: If it cannot be fetched or stored, or the limit is below its size.
        """
        key = _key(member, where=remote.where, revision=revision)
        with _named_errors(self.folder):
            found = self._find(key, member)
            if found is not None:
                return found
            if member.size > self.limit_bytes:
                raise StorageError(
                    f"{self.folder}: its limit of {self.limit_bytes} bytes is below the "
                    f"{member.size} bytes of a member of {remote.where}. Give the cache a larger "
                    f"limit."
                )
            with locked(self._locks / key[:2]):
                # Another process may have fetched it meanwhile.
                return self._find(key, member) or self._fill(key, member, remote=remote)

    def holds(self, member: Member, *, where: str, revision: str) -> bool:
        """Return whether a member seems to be stored; `open` compares it."""
        return self._place(_key(member, where=where, revision=revision)).is_file()

    def drop_damaged(self, member: Member, *, where: str, revision: str) -> bool:
        """Drop a member if its bytes have changed since they were stored; return whether so."""
        key = _key(member, where=where, revision=revision)
        if member.crc32 is None or not os.access(self._items, os.W_OK):
            return False
        with _named_errors(self.folder), locked(self._locks / key[:2]):
            place = self._place(key)
            if not place.is_file():
                return False
            with FileSlice(place, Member(key, 0, place.stat().st_size)) as file:
                if file.crc32() == member.crc32:
                    return False
            self._drop(place)
            return True

    def used_bytes(self) -> int:
        """Return the bytes of all members stored."""
        return sum(size for _, size, _ in self._own_files())

    def _find(self, key: str, member: Member) -> FileSlice | None:
        """Return an item that is stored and unchanged; it counts as used now."""
        place = self._place(key)
        try:
            found = FileSlice(place, Member(key, 0, member.size))
        except FileNotFoundError:
            return None
        status = found.status()
        if status.st_size == member.size and (
            status.st_mtime_ns == _STAMP_NS or found.crc32() == member.crc32
        ):
            _mark_used(place)
            return found
        found.close()
        return None

    def _fill(self, key: str, member: Member, *, remote: RemoteObject) -> FileSlice:
        """Fetch a member, store it and open it; after a wrong checksum it is fetched once more."""
        part = self._items / f"{key}.part"
        self._drop(self._place(key))
        self._make_room(member.size, part=part)
        try:
            for _ in range(2):
                with part.open("r+b") as file:
                    chunks = remote.chunks(member.offset, member.offset + member.size)
                    crc32 = copy_with_crc32(chunks, file.write)
                    file.flush()
                    os.fsync(file.fileno())
                if member.crc32 in (None, crc32):
                    break
            else:
                raise ShardError(
                    f"{remote.where}: the {member.size} bytes from {member.offset} on have crc32 "
                    f"{crc32:08x}, and the index says {member.crc32:08x}, twice. The shard was "
                    f"damaged or replaced: use the index that was made with it."
                )
            _mark_used(part)
            # Opened before others can see it, as they may evict it at once.
            found = FileSlice(part, Member(key, 0, member.size))
            with locked(self._ledger):
                # Whoever counts must find it under one name.
                part.replace(self._place(key))
            return found
        finally:
            self._drop(part)

    def _make_room(self, size: int, *, part: Path) -> None:
        """Reserve room for an item, and evict others if needed.

        Its part gets its full size at once, so other processes count it.
        """
        with locked(self._ledger):
            recorded = self._ledger.read_bytes()
            used = int(recorded) if recorded.isdigit() else self.used_bytes()
            if used + size > self.limit_bytes:
                used = self._evict(down_to=max(0, int(_FULL * self.limit_bytes) - size))
            self._ledger.write_text(str(used + size))
            part.touch()
            os.truncate(part, size)

    def _drop(self, path: Path) -> None:
        """Delete an item or a part if it exists; then all are counted anew."""
        if path.exists():
            with locked(self._ledger):
                path.unlink(missing_ok=True)
                self._ledger.write_bytes(b"")

    def _evict(self, *, down_to: int) -> int:
        """Delete the least recently used items; return how many bytes are left."""
        files = sorted(self._own_files())
        used = sum(size for _, size, _ in files)
        for _, size, path in files:
            if used <= down_to:
                break
            if path.suffix == ".member":
                path.unlink(missing_ok=True)
                used -= size
                continue
            # A part whose lock is taken is being written.
            with try_locked(self._locks / path.name[:2]) as is_held:
                if is_held:
                    path.unlink(missing_ok=True)
                    used -= size
        return used

    def _own_files(self) -> Iterator[tuple[int, int, Path]]:
        """Yield time of last use, size and path of every file that a cache wrote."""
        with os.scandir(self._items) as entries:
            for entry in entries:
                if _OWN_FILE.fullmatch(entry.name):
                    try:
                        status = entry.stat(follow_symlinks=False)
                    except FileNotFoundError:
                        continue
                    yield status.st_atime_ns, status.st_size, Path(entry.path)

    def _place(self, key: str) -> Path:
        return self._items / f"{key}.member"


def _mark_used(path: Path) -> None:
    """Set an item's last use, and the modification time of an item that nobody wrote into.

    Neither can be set of another user's item, or on a read-only disk: its last use stays unknown.
    """
    with suppress(OSError):
        os.utime(path, ns=(time.time_ns(), _STAMP_NS))


def _key(member: Member, *, where: str, revision: str) -> str:
    """Return an item's name: equal only for equal bytes.

    Without a known checksum, the address is part of it.
    """
    where = where if member.crc32 is None else ""
    parts = [revision, where, member.path, member.offset, member.size, member.crc32]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _named_errors(folder: Path) -> AbstractContextManager[None]:
    """Raise errors of the disk as errors that name the cache."""
    cure = "Choose another folder for the cache."
    return explain_os_errors(f"{folder}: the cache cannot be read or written", cure)
