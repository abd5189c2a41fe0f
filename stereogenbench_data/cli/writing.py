"""Writing reports: each whole or not at all; errors of the disk name the file."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

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


def write_report(path: Path, text: str) -> None:
    """Write a report as UTF-8 into a new file or over an existing one.

    What UTF-8 cannot encode, such as odd bytes of file names, becomes ``?``.

    Raises:
        OSError: If it cannot be written. An existing file keeps its content, unless it is a
            device or a pipe.
    """
    from stereogenbench_data.sources.files import open_output

    content = text.encode(errors="replace")
    with writing(path), open_output(path) as file:
        file.write(content)
