"""Writing files of this machine: whole or not at all, one process at a time, with their checksum.

An atomic write goes to a temporary file beside the target, which is renamed over the target at the
end. The writer holds a lock on its temporary file. A free lock therefore means that the writer was
killed, and the next writer of that target removes the file; it never touches one that is locked.
"""

import errno
import os
import stat
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import BinaryIO, Final, Literal

from stereogenbench_data.errors import StorageError

_USUAL_WRITERS: Final = 8
"""Temporary file names of one target that are searched for files of killed writers."""

_NO_LOCKS: Final = frozenset({errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP})
_LOCK_POLL_S: Final = 0.01


def write_atomic(path: Path, content: bytes) -> None:
    """Write a small file whole or not at all, replacing any file of that name.

    Raises:
        OSError: If it cannot be written; the file that was there stays as it was.
    """
    with open_atomic(path) as file:
        file.write(content)


@contextmanager
def open_atomic(path: Path) -> Iterator[BinaryIO]:
    """Open a file that is written whole or not at all, replacing any file of that name.

    When the block ends without an error, the file is synchronised with the disk and renamed into
    place. Files that killed writers of this path left are removed.

    Raises:
        OSError: If it cannot be written; the file that was there stays as it was.
    """
    try:
        with closing(_TemporaryFile(path)) as temporary:
            yield temporary.file
            temporary.file.flush()
            os.fsync(temporary.file.fileno())
            temporary.path.replace(path)
    except OSError as error:
        if str(error.filename).startswith(str(path.with_name(_temporary_name(path, 0)))):
            error.filename = str(path)
        raise


@contextmanager
def open_output(path: Path) -> Iterator[BinaryIO]:
    """Open a file that the user named, as `open_atomic` does.

    Links are followed. Devices and pipes are written to directly.
    """
    if path.exists() and not path.is_file():
        with path.open("wb") as file:
            yield file
        return
    with open_atomic(path.resolve()) as file:
        yield file


class _TemporaryFile:
    """A new file beside its target, locked while it is open, and removed unless it was renamed."""

    def __init__(self, target: Path) -> None:
        for number in range(_USUAL_WRITERS):
            _remove_abandoned(target.with_name(_temporary_name(target, number)))
        for number in count():
            self.path = target.with_name(_temporary_name(target, number))
            with suppress(FileExistsError):
                self.file: BinaryIO = self.path.open("xb")
                handle = self.file.fileno()
                if _try_lock(handle) != "taken" and _is_at(self.path, handle):
                    break
                # Another process locked it first, as the file of a killed writer, and removes it.
                self.file.close()

    def close(self) -> None:
        # It is removed before it is closed: closing frees its lock, and others may take the name.
        if _is_at(self.path, self.file.fileno()):
            self.path.unlink()
        with suppress(OSError):  # flushing has raised the error of a full disk already
            self.file.close()


def _temporary_name(target: Path, number: int) -> str:
    return f".{target.name}.unfinished{number or ''}"


def _remove_abandoned(path: Path) -> None:
    """Remove a temporary file whose writer was killed, if there is one."""
    try:
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
    except OSError as error:
        # A link is not ours; it is removed, and its target stays as it is.
        if error.errno == errno.ELOOP:
            path.unlink(missing_ok=True)
        return
    try:
        is_ours = stat.S_ISREG(os.fstat(handle).st_mode)
        if is_ours and _try_lock(handle) == "held" and _is_at(path, handle):
            path.unlink()
    finally:
        os.close(handle)


def _is_at(path: Path, handle: int) -> bool:
    """Return whether an open file still has this name."""
    try:
        return os.path.samestat(path.lstat(), os.fstat(handle))
    except FileNotFoundError:
        return False


def _try_lock(handle: int) -> Literal["held", "taken", "unsupported"]:
    """Lock an open file unless another process or thread has it open and locked."""
    from filelock import lock_descriptor

    try:
        return "held" if lock_descriptor(handle, blocking=False) else "taken"
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        return "unsupported"


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold a lock between processes and threads; wait until it is free.

    The operating system frees the lock when its process ends, however it ends.

    Args:
        path: The lock's file. It is made where it is missing, and stays.

    Raises:
        StorageError: If the file system has no locks.
    """
    from filelock import lock_descriptor, unlock_descriptor

    with path.open("ab") as file:
        try:
            lock_descriptor(file.fileno(), poll_interval=_LOCK_POLL_S)
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
            raise StorageError(
                f"{path}: a cache needs file locks, and this file system has none "
                f"({error.strerror}). Choose another folder for the cache, or read without one."
            ) from error
        try:
            yield
        finally:
            # A process that was forked meanwhile has the file open, too: closing would not do.
            unlock_descriptor(file.fileno())


@contextmanager
def try_locked(path: Path) -> Iterator[bool]:
    """Hold a lock as `locked` does, or go on at once without it; yield whether it is held.

    Where the file system has no locks it counts as held.
    """
    from filelock import unlock_descriptor

    with path.open("ab") as file:
        state = _try_lock(file.fileno())
        try:
            yield state != "taken"
        finally:
            if state == "held":
                unlock_descriptor(file.fileno())


def copy_with_crc32(chunks: Iterable[bytes], write: Callable[[bytes], object]) -> int:
    """Pass each chunk of bytes on, and return the crc32 of all of them."""
    crc32 = 0
    for chunk in chunks:
        write(chunk)
        crc32 = zlib.crc32(chunk, crc32)
    return crc32
