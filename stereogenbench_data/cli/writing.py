"""How commands write: a report whole or not at all, and errors that name the file."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

_OF_WRITING: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)


@contextmanager
def writing(place: Path) -> Iterator[None]:
    """Add the file's name to errors of the disk that lack one, such as a full disk."""
    try:
        yield
    except OSError as error:
        if error.errno in _OF_WRITING and error.filename is None:
            error.filename = str(place)
        raise


def write_report(path: Path, text: str) -> None:
    """Write a report as UTF-8; make its folders, and replace a file of that name.

    Bytes of file names that are not UTF-8 become question marks.

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
