"""Locks between processes and threads of one machine, held by the operating system.

A lock is let go when its process ends, however it ends: none is ever left behind.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from stereogenbench_data.errors import StorageError


@contextmanager
def locked(path: Path, *, when_taken: Literal["wait", "skip"] = "wait") -> Iterator[bool]:
    """Hold a lock that a file stands for.

    Args:
        path: The file; it is made where it is missing, and stays.
        when_taken: "wait" until it is free; "skip" goes on without it.

    Yields:
        Whether the lock is held.

    Raises:
        StorageError: If this system has no such locks.
    """
    try:
        import fcntl
    except ImportError:
        raise StorageError(
            f"{path}: a cache needs file locks, which this system lacks: read without one."
        ) from None
    with path.open("ab") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (fcntl.LOCK_NB if when_taken == "skip" else 0))
        except BlockingIOError:
            yield False
            return
        yield True
