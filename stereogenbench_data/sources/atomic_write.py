"""Files that are written whole or not at all, each by one process at a time.

An unfinished file lies beside its place under a name that follows from it, and whoever writes it
holds a lock on it. So what a killed process left is known: its lock is free, and the next to write
that file removes it. A file that a living process writes is never touched.
"""

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from io import FileIO
from itertools import count
from pathlib import Path
from typing import BinaryIO, Final

from stereogenbench_data.errors import ShardError
from stereogenbench_data.sources.locks import locked

PARTS: Final = ".parts"
"""Beside the shards: notes of what is finished, and locks."""

_USUAL_WRITERS: Final = 8
"""How many writers of one file at once leave nothing behind if they are all killed."""

_NO_LOCKS: Final = frozenset({errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP})


def write_whole(path: Path, content: bytes) -> None:
    """Write a small file, whole or not at all, over the one of that name."""
    with writing_whole(path) as file:
        file.write(content)


@contextmanager
def writing_whole(path: Path) -> Iterator[BinaryIO]:
    """Open a file to be written whole or not at all, over the one of that name.

    It lies beside its place until the block ends without an error; then it is synchronised with
    the disk and moved there. What killed writers of this file left is removed.

    Raises:
        OSError: If it cannot be written; then the file that was there is as before.
    """
    try:
        with closing(_Unfinished(path)) as unfinished:
            yield unfinished.file
            unfinished.file.flush()
            os.fsync(unfinished.file.fileno())
            unfinished.place.replace(path)
    except OSError as error:
        if str(error.filename).startswith(str(path.with_name(_unfinished_name(path, 0)))):
            error.filename = str(path)
        raise


@contextmanager
def writing_output(path: Path) -> Iterator[BinaryIO]:
    """Open a file that the user named, as `writing_whole` does.

    A link is followed to what it names, and a device or a pipe is written to as it is.
    """
    if path.exists() and not path.is_file():
        with path.open("wb") as file:
            yield file
        return
    with writing_whole(path.resolve()) as file:
        yield file


class _Unfinished:
    """A new file beside its place, locked while it is open; what is left of it is removed."""

    def __init__(self, path: Path) -> None:
        for number in range(_USUAL_WRITERS):
            _remove_abandoned(path.with_name(_unfinished_name(path, number)))
        for number in count():
            self.place = path.with_name(_unfinished_name(path, number))
            with suppress(FileExistsError):
                self.file: BinaryIO = self.place.open("xb")
                if _lock(self.file.fileno()) != "taken" and _is_at(self.place, self.file.fileno()):
                    break
                # Another process took it for abandoned before it was locked, and removes it.
                self.file.close()

    def close(self) -> None:
        # Removed before it is closed: then its lock is free, and the name another's.
        if _is_at(self.place, self.file.fileno()):
            self.place.unlink()
        with suppress(OSError):  # the error of a full disk was raised when it was flushed
            self.file.close()


def _unfinished_name(path: Path, number: int) -> str:
    return f".{path.name}.unfinished{number or ''}"


def _remove_abandoned(place: Path) -> None:
    """Remove an unfinished file that no process holds locked, if there is one."""
    try:
        handle = os.open(place, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
    except OSError as error:
        # A link is no file of ours; where it leads stays as it is.
        if error.errno == errno.ELOOP:
            place.unlink(missing_ok=True)
        return
    try:
        is_ours = stat.S_ISREG(os.fstat(handle).st_mode)
        if is_ours and _lock(handle) == "held" and _is_at(place, handle):
            place.unlink()
    finally:
        os.close(handle)


def _is_at(place: Path, handle: int) -> bool:
    """Return whether an open file still has a name."""
    try:
        return os.path.samestat(place.lstat(), os.fstat(handle))
    except FileNotFoundError:
        return False


def _lock(handle: int) -> str:
    """Lock an open file if no other process has: "held", "taken", or "unknown" without locks."""
    try:
        import fcntl
    except ImportError:
        return "unknown"
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return "taken"
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        return "unknown"
    return "held"


@contextmanager
def held_alone(lock: Path) -> Iterator[bool]:
    """Hold a lock file if no other process does, and yield whether it is held.

    Where the file system knows no locks it counts as held.
    """
    with ExitStack() as stack:
        try:
            is_ours = stack.enter_context(locked(lock, when_taken="skip"))
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
            is_ours = True
        yield is_ours


@contextmanager
def alone(path: Path) -> Iterator[FileIO]:
    """Open an unfinished file, empty, for this process alone; unless renamed, it is removed.

    The lock is a file in ``.parts``, which stays. Where the file system knows no locks there is
    none; of two processes that write one file at once, one will find it altered or gone.

    Raises:
        ShardError: If another process has it.
    """
    lock = path.parent / PARTS / f"{path.name}.lock"
    lock.parent.mkdir(parents=True, exist_ok=True)
    with held_alone(lock) as is_ours:
        if not is_ours:
            raise ShardError(
                f"{path}: another process is packing this shard. Give each process a part of its "
                f"own (--part I/N), or wait for that one."
            )
        try:
            with FileIO(path, "w+") as file:
                yield file
        finally:
            path.unlink(missing_ok=True)
