"""How a command ends: with an exit status, and one line about an error that was expected."""

import errno
import os
import sys
import traceback
import warnings
from contextlib import suppress
from types import TracebackType
from typing import Final, TextIO

import typer

from stereogenbench_data.errors import DISK_FULL, StereoGenBenchError, describe_os_error
from stereogenbench_data.schema.text import plain_line

FINDINGS: Final = 1
"""Exit status if something is wrong with the data."""
NOT_DONE: Final = 2
"""Exit status if the command failed."""
STOPPED: Final = 130
"""Exit status after Ctrl-C: 128 plus the number of the signal."""
PIPE_CLOSED: Final = 141
"""Exit status if the reader closed the output, as ``head`` does."""

_CURES: Final = {
    errno.ENOENT: "Check the path.",
    errno.ENOTDIR: "Check the path.",
    errno.EISDIR: "Name a file, not a folder.",
    errno.EADDRINUSE: "Choose another port.",
}
"""Cures of errors that are not in the table of `errors`, for a path or a port that was named."""


class ErrorsReported:
    """A context in which every error ends the command with a message and an exit status.

    Exits and usage errors pass: typer reports them. The context flushes stdout before it ends, so
    that it notices a closed pipe.
    """

    def __enter__(self) -> "ErrorsReported":
        """Print each warning in one line."""
        self._formatwarning = warnings.formatwarning
        warnings.formatwarning = lambda message, category, *_, **__: (
            _plain_lines(f"{category.__name__}: {message}") + "\n"
        )
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
        by_typer = isinstance(error, typer.Exit | typer.Abort | SystemExit | EOFError)
        if error is None or by_typer or type(error).__module__.startswith(("typer.", "click.")):
            return
        if isinstance(error, BrokenPipeError):
            _discard(sys.stdout)
            raise SystemExit(PIPE_CLOSED) from None
        try:
            typer.echo(_message(error), err=True)
        except OSError:  # Only the exit status is left.
            _discard(sys.stderr)
        raise SystemExit(STOPPED if isinstance(error, KeyboardInterrupt) else NOT_DONE) from None


def _message(error: BaseException) -> str:
    """Return the lines about an error; of one that nobody expected, its traceback."""
    if isinstance(error, KeyboardInterrupt):
        return "stopped; run the same command again to go on"
    if isinstance(error, StereoGenBenchError):
        return _plain_lines(f"{type(error).__name__}: {error}")
    if isinstance(error, OSError) and error.errno is not None:
        kind = "StorageError" if type(error) is OSError else type(error).__name__
        is_output = not error.filename and error.errno in DISK_FULL
        where = error.filename or ("the output cannot be written" if is_output else "")
        what = f"{kind}: {where}" if where else kind
        return _plain_lines(describe_os_error(what, error, _CURES.get(error.errno, "")))
    if isinstance(error, MemoryError):
        return "MemoryError: memory is short. Use fewer workers or smaller pictures."
    return "".join(traceback.format_exception(error)).rstrip()


def _flush_error() -> OSError | None:
    """Flush stdout; return the error if that fails, else None."""
    try:
        if sys.stdout is not None:  # It is None if the shell closed it.
            sys.stdout.flush()
    except OSError as error:
        _discard(sys.stdout)
        return error
    return None


def _plain_lines(text: str) -> str:
    return "\n".join(map(plain_line, text.split("\n")))


def _discard(stream: TextIO) -> None:
    """Point a stream at the null device, so that Python does not flush it again when it ends."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
