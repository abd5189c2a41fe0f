"""Pauses that servers ask for (Retry-After), kept by all processes of a user on this machine.

The pause of a server is an empty file in a folder of the user's own; the file's modification time
is when the pause ends. So there is no content that could be wrong. This assumes that the processes
share that folder and the clock. Where the folder cannot be made, or others may write into it,
pauses hold within this process alone.
"""

import hashlib
import math
import os
import stat
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Final

_FOLDER_NAME: Final = "stereogenbench-pauses"
_LONGEST_S: Final = 3600.0
"""A pause that ends later than this from now is not one: a clock was set."""

_own: Final[dict[str, float]] = {}
"""The ends of pauses that this process knows, by server."""


def begin_pause(server: str, *, wait_s: float) -> float:
    """Let all connections to a server pause; return when the pause ends, in seconds since 1970."""
    # Whole seconds are the same number in memory and as a file's time.
    until_s = max(float(math.ceil(time.time() + wait_s)), pause_end_s(server))
    _own[server] = until_s
    with suppress(OSError):
        _folder().mkdir(mode=0o700)
    if _is_private():
        with suppress(OSError):
            path = _folder() / _name(server)
            with path.open("ab"):
                pass
            os.utime(path, (until_s, until_s))
    return until_s


def pause_end_s(server: str) -> float:
    """Return when the pause of a server ends, in seconds since 1970; 0 if it has none now."""
    now_s = time.time()
    until_s = _own.get(server, 0.0)
    if _is_private():
        with suppress(OSError):
            until_s = max(until_s, (_folder() / _name(server)).lstat().st_mtime)
    return until_s if now_s < until_s <= now_s + _LONGEST_S else 0.0


def _name(server: str) -> str:
    return hashlib.sha256(server.encode()).hexdigest()[:32]


def _folder() -> Path:
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    owner = "" if runtime or not hasattr(os, "getuid") else f"-{os.getuid()}"
    return Path(runtime or tempfile.gettempdir(), f"{_FOLDER_NAME}{owner}")


def _is_private() -> bool:
    """Return whether the folder exists, and only this user may write into it."""
    try:
        status = _folder().lstat()
    except OSError:
        return False
    if not stat.S_ISDIR(status.st_mode):
        return False
    # On Windows, temporary folders are the user's own.
    return not hasattr(os, "getuid") or (
        status.st_uid == os.getuid() and not status.st_mode & 0o077
    )
