"""Files that are written whole or not at all, each by one process at a time."""

import errno
import os
import uuid
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from io import FileIO
from pathlib import Path
from typing import Final

from stereogenbench_data.errors import ShardError
from stereogenbench_data.storage.locks import locked

PARTS: Final = ".parts"
"""Beside the shards: notes of what is finished, and locks."""

_NO_LOCKS: Final = frozenset({errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP})


def write_whole(path: Path, content: bytes) -> None:
    """Write a small file, whole or not at all, over the one of that name."""
    unfinished = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        with unfinished.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


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
