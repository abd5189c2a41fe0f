"""How a command ends: what is said of an error, in one or two lines, and the exit status."""

import contextlib
import errno
import os
import sys
import warnings
from types import TracebackType
from typing import Final, TextIO

import typer

from stereogenbench_data.cli.stopping import STOPPED
from stereogenbench_data.errors import StereoGenBenchError, cure_of
from stereogenbench_data.schema.text import plain_line

FINDINGS: Final = 1
"""Exit status where something is wrong with the data."""
NOT_DONE: Final = 2
"""Exit status where the command could not do what it was asked to."""
PIPE_CLOSED: Final = 141
"""Exit status where whoever read the output has closed it, as ``head`` does."""

_CURES: Final = {
    errno.ENOENT: "Check the path.",
    errno.ENOTDIR: "Check the path.",
    errno.EISDIR: "Name a file, not a folder.",
    errno.EADDRINUSE: "Choose another port.",
}


class OutcomeTold:
    """A context in which every error ends the command: it is said on stderr, without a traceback.

    Errors that say themselves what to do (`typer.Exit`, usage errors) pass. What the block printed
    is written out before it ends, so that a closed pipe is noticed here.
    """

    def __enter__(self) -> "OutcomeTold":
        """Say warnings in one line, too."""
        self._formatwarning = warnings.formatwarning
        warnings.formatwarning = _warning_line
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Turn what was raised into a message and an exit status."""
        warnings.formatwarning = self._formatwarning
        error = _unwritten() or error
        if isinstance(error, BrokenPipeError):
            _forget(sys.stdout)
            raise SystemExit(PIPE_CLOSED) from None
        if isinstance(error, KeyboardInterrupt):
            _say("stopped")
            raise SystemExit(STOPPED) from None
        message = "" if error is None else _message(error)
        if message:
            _say(message)
            raise SystemExit(NOT_DONE) from None


def _unwritten() -> OSError | None:
    """Write out what was printed; return why that failed, None where it did not."""
    try:
        if sys.stdout is not None:  # as it is where the shell closed it
            sys.stdout.flush()
    except OSError as error:
        _forget(sys.stdout)
        return error
    return None


def _say(message: str) -> None:
    """Write a line to stderr; where that cannot be, the exit status alone has to tell."""
    try:
        typer.echo("\n".join(map(plain_line, message.split("\n"))), err=True)
    except OSError:
        _forget(sys.stderr)


def _message(error: BaseException) -> str:
    """Return what is said of an error, nothing of one that says itself what is to happen."""
    if isinstance(error, StereoGenBenchError):
        return f"{type(error).__name__}: {error}"
    if isinstance(error, OSError) and error.errno is not None:
        where = f"{error.filename}: " if error.filename else ""
        cure = cure_of(error, _CURES.get(error.errno, ""))
        return f"{type(error).__name__}: {where}{error.strerror}. {cure}".rstrip()
    if isinstance(error, MemoryError):
        return "MemoryError: memory is short. Use fewer workers or smaller pictures."
    if _is_said_elsewhere(error):
        return ""
    first_line = str(error).strip().partition("\n")[0]
    return (
        f"{type(error).__name__}: {first_line}\n"
        "This was not foreseen: run it again as `stereogenbench --debug ...` to see where it arose."
    )


def _is_said_elsewhere(error: BaseException) -> bool:
    """Return whether the command's framework knows what to do: exits, usage errors."""
    return not isinstance(error, Exception) or isinstance(
        error, (typer.Exit, typer.Abort, EOFError)
    ) or type(error).__module__.startswith(("typer.", "click."))  # fmt: skip


def _forget(stream: TextIO) -> None:
    """Point a stream at nothing, so that what is left of it is not written when Python ends."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _warning_line(
    message: Warning | str, category: type[Warning], *_place: object, **_line: object
) -> str:
    lines = f"{category.__name__}: {message}".split("\n")
    return "\n".join(map(plain_line, lines)) + "\n"
