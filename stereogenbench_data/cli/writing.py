"""What commands write: reports whole or not at all, and errors that name the place."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

_OF_WRITING: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)


@contextmanager
def writing(place: Path) -> Iterator[None]:
    """Let an error of the system that only writing brings, and that names no file, name this."""
    try:
        yield
    except OSError as error:
        if error.errno in _OF_WRITING and error.filename is None:
            error.filename = str(place)
        raise


def write_report(path: Path, text: str) -> None:
    """Write a report, in folders that are made if need be; a file of that name is replaced.

    It is UTF-8; bytes of file names that are none become question marks.

    Raises:
        OSError: If it cannot be written; then the file that was there is as before, unless it is
            a device or a pipe.
    """
    from stereogenbench_data.sources.files import open_output

    content = text.encode(errors="replace")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with open_output(path) as file:
            file.write(content)
