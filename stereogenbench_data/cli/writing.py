"""Writing reports: each whole or not at all; errors of the disk name the file."""

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Literal

from stereogenbench_data.errors import DISK_FULL

_OF_WRITING: Final = DISK_FULL | {errno.EFBIG, errno.EROFS}


@contextmanager
def writing(place: Path) -> Iterator[None]:
    """Name the file in an error of writing that names none, such as that of a full disk."""
    try:
        yield
    except OSError as error:
        if error.errno in _OF_WRITING and error.filename is None:
            error.filename = str(place)
        raise


def require_writable(path: Path, kind: Literal["file", "folder"]) -> None:
    """Refuse, before long work begins, a place that cannot be written to at its end.

    A nameless file is made in the nearest folder that exists; nothing stays.

    Raises:
        OSError: If no file can be made there; it names the path.
    """
    try:
        if kind == "file" and path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        if kind == "file" and path.exists() and not path.is_file():
            return  # A device or a pipe.
        folder = path.resolve().parent if kind == "file" else path.resolve()
        while not folder.exists():
            folder = folder.parent
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        error.filename = str(path)
        raise


def write_report(path: Path, text: str) -> None:
    """Write a report as UTF-8 into a new file or over an existing one; create its folder.

    What UTF-8 cannot encode, such as odd bytes of file names, becomes ``?``.

    Raises:
        OSError: If it cannot be written. An existing file keeps its content, unless it is a
            device or a pipe.
    """
    from stereogenbench_data.sources.files import open_output

    content = text.encode(errors="replace")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with open_output(path) as file:
            file.write(content)
