"""Writing reports: each whole or not at all; errors of the disk name the file."""

import errno
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import typer

from stereogenbench_data.cli.screen import Part, print_report
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


def print_and_write(
    shown: tuple[str, Iterable[Part]],
    *,
    text: str,
    document: str,
    out: Path | None,
    as_json: bool,
) -> None:
    """Print a report, and write it to a file if one is named.

    Args:
        shown: What a terminal shows: a verdict and tables.
        text: The whole report as text.
        document: The whole report as JSON.
        out: Where it is written, as JSON if the name ends so; None for nowhere.
        as_json: Whether JSON is printed.

    Raises:
        OSError: If the file cannot be written; the report is printed then.
    """
    if as_json:
        typer.echo(document)
    else:
        rest = f"Whole report: {out}" if out else "-o FILE writes the whole report."
        print_report(*shown, whole=text, rest=rest)
    if out is not None:
        write_report(out, document if out.suffix == ".json" else text)
