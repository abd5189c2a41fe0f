"""Files of this machine: atomic writes, locks between processes, copies with a checksum.

An atomic write goes to a temporary file beside the target, which is renamed over the target at the
end. The writer holds a lock on its temporary file. A free lock therefore means that the writer was
killed, and the next writer of that target removes the file; it never touches one that is locked.
"""

import errno
import os
import stat
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import BinaryIO, Final, Literal

from stereogenbench_data.errors import StorageError

_USUAL_WRITERS: Final = 8
"""How many temporary names of a target are searched for files of killed writers."""

_NO_LOCKS: Final = frozenset({errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP})
_LOCK_POLL_S: Final = 0.01


def write_atomic(
    path: Path, content: bytes, *, flush_to: Literal["disk", "system"] = "disk"
) -> None:
    """Write a small file whole or not at all, replacing any file of that name.

    Args:
        path: The file.
        content: Its bytes.
        flush_to: "system" is faster, and a loss of power may leave the file damaged.

    Raises:
        OSError: If it cannot be written; the file that was there stays as it was.
    """
    with open_atomic(path, flush_to=flush_to) as file:
        file.write(content)


@contextmanager
def open_atomic(path: Path, *, flush_to: Literal["disk", "system"] = "disk") -> Iterator[BinaryIO]:
    """Open a file that is written whole or not at all, replacing any file of that name.

    When the block ends without an error, the file is flushed (see `write_atomic`) and renamed into
    place. Files that killed writers of this path left are removed.

    Raises:
        OSError: If it cannot be written; the file that was there stays as it was.
    """
    try:
        temporary, file = _open_temporary(path)
        try:
            yield file
            file.flush()
            if flush_to == "disk":
                os.fsync(file.fileno())
            temporary.replace(path)
        finally:
            # Unless it was renamed, it is removed before it is closed: closing frees its lock, and
            # another writer may take the name.
            if _is_at(temporary, file.fileno()):
                temporary.unlink()
            with suppress(OSError):  # flushing has raised the error of a full disk already
                file.close()
    except OSError as error:
        if str(error.filename).startswith(str(path.with_name(_temporary_name(path, 0)))):
            error.filename = str(path)
        raise


@contextmanager
def open_output(path: Path) -> Iterator[BinaryIO]:
    """Open a file that the user named, as `open_atomic` does; its folder is made.

    Links are followed. Devices and pipes are written to directly.
    """
    if path.exists() and not path.is_file():
        with path.open("wb") as file:
            yield file
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with open_atomic(path.resolve()) as file:
        yield file


def _open_temporary(target: Path) -> tuple[Path, BinaryIO]:
    """Return a new, locked file beside its target, once those of killed writers are removed."""
    for number in range(_USUAL_WRITERS):
        _remove_abandoned(target.with_name(_temporary_name(target, number)))
    numbers = count()
    while True:
        path = target.with_name(_temporary_name(target, next(numbers)))
        with suppress(FileExistsError):
            file: BinaryIO = path.open("xb")
            if _try_lock(file.fileno()) != "taken" and _is_at(path, file.fileno()):
                return path, file
            # Another process took it for a killed writer's, has locked it and removes it.
            file.close()


def _temporary_name(target: Path, number: int) -> str:
    return f".{target.name}.unfinished{number or ''}"


def _remove_abandoned(path: Path) -> None:
    """Remove a temporary file whose writer was killed, if there is one."""
    try:
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
    except OSError as error:
        # A link is not ours: it is removed, and its target stays.
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
    """Hold a lock against other processes and threads; wait until it is free.

    The operating system frees the lock when its process ends, however it ends. The lock's file is
    created if it is missing, and stays.

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
            # A process forked meanwhile has the file open, too: closing would not free the lock.
            unlock_descriptor(file.fileno())


@contextmanager
def try_locked(path: Path) -> Iterator[bool]:
    """Hold a lock as `locked` does, or continue at once without it; yield whether it is held.

    Where the file system has no locks, it counts as held.
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
    """Write each chunk of bytes, and return the crc32 of all of them."""
    crc32 = 0
    for chunk in chunks:
        write(chunk)
        crc32 = zlib.crc32(chunk, crc32)
    return crc32
