"""How a command ends: an error is reported in one or two lines, with an exit status."""

import errno
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import TracebackType
from typing import Final, TextIO

import typer

from stereogenbench_data.cli.stopping import STOPPED
from stereogenbench_data.errors import StereoGenBenchError, cure_of
from stereogenbench_data.schema.text import plain_line

FINDINGS: Final = 1
"""Exit status if something is wrong with the data."""
NOT_DONE: Final = 2
"""Exit status if the command failed."""
PIPE_CLOSED: Final = 141
"""Exit status if the reader closed the output, as ``head`` does."""

_CURES: Final = {
    errno.ENOENT: "Check the path.",
    errno.ENOTDIR: "Check the path.",
    errno.EISDIR: "Name a file, not a folder.",
    errno.EADDRINUSE: "Choose another port.",
}


@contextmanager
def resumable() -> Iterator[None]:
    """Report on Ctrl-C that the command resumes if it is run again. Decorates its function."""
    try:
        yield
    except KeyboardInterrupt:
        typer.echo("stopped; run the same command again to go on from here", err=True)
        raise typer.Exit(STOPPED) from None


class ErrorsReported:
    """A context in which every error ends the command with a message instead of a traceback.

    Exits and usage errors pass: the command line's framework reports them. The context flushes
    stdout before it ends, so that it notices a closed pipe.
    """

    def __enter__(self) -> "ErrorsReported":
        """Print warnings in one line, too."""
        self._formatwarning = warnings.formatwarning
        warnings.formatwarning = _warning_line
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Turn an exception into a message and an exit status."""
        warnings.formatwarning = self._formatwarning
        error = _flush_error() or error
        if isinstance(error, BrokenPipeError):
            _discard(sys.stdout)
            raise SystemExit(PIPE_CLOSED) from None
        if isinstance(error, KeyboardInterrupt):
            _print_error("stopped")
            raise SystemExit(STOPPED) from None
        message = "" if error is None else _message(error)
        if message:
            _print_error(message)
            raise SystemExit(NOT_DONE) from None


def _flush_error() -> OSError | None:
    """Flush stdout; return the error if that fails, else None."""
    try:
        if sys.stdout is not None:  # as it is where the shell closed it
            sys.stdout.flush()
    except OSError as error:
        _discard(sys.stdout)
        return error
    return None


def _print_error(message: str) -> None:
    """Print a message on stderr; if that fails, only the exit status is left."""
    try:
        typer.echo("\n".join(map(plain_line, message.split("\n"))), err=True)
    except OSError:
        _discard(sys.stderr)


def _message(error: BaseException) -> str:
    """Return the message for an error; empty if the framework reports it."""
    if isinstance(error, StereoGenBenchError):
        return f"{type(error).__name__}: {error}"
    if isinstance(error, OSError) and error.errno is not None:
        where = f"{error.filename}: " if error.filename else ""
        cure = cure_of(error, _CURES.get(error.errno, ""))
        return f"{type(error).__name__}: {where}{error.strerror}. {cure}".rstrip()
    if isinstance(error, MemoryError):
        return "MemoryError: memory is short. Use fewer workers or smaller pictures."
    if _is_reported_elsewhere(error):
        return ""
    first_line = str(error).strip().partition("\n")[0]
    return (
        f"{type(error).__name__}: {first_line}\n"
        "This was not foreseen: run it again as `stereogenbench --debug ...` to see where it arose."
    )


def _is_reported_elsewhere(error: BaseException) -> bool:
    """Return whether the framework reports an error: exits, usage errors."""
    return not isinstance(error, Exception) or isinstance(
        error, (typer.Exit, typer.Abort, EOFError)
    ) or type(error).__module__.startswith(("typer.", "click."))  # fmt: skip


def _discard(stream: TextIO) -> None:
    """Point a stream at the null device, so that Python does not flush it again when it ends."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _warning_line(
    message: Warning | str, category: type[Warning], *_place: object, **_line: object
) -> str:
    lines = f"{category.__name__}: {message}".split("\n")
    return "\n".join(map(plain_line, lines)) + "\n"
