"""One Blender in a process of its own, and what its end means.

Blender holds one global scene, ends its process when it crashes, and needs its own versions of
Python and NumPy. So it runs as a program (`worker.py`) in a Python that has bpy, and answers over
pipes.
"""

import atexit
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

import numpy as np

from stereogenbench_data.errors import ExtraError, SynthesisError
from stereogenbench_data.synthesis.blender.worker import read_message, write_message

_WORKER: Final = Path(__file__).with_name("worker.py")
_VERSION: Final = [5, 0]
_CURE: Final = (
    "bpy 5.0 has wheels for Python 3.11 only, and asks for a NumPy below 2. Make an environment of "
    "its own, `python3.11 -m venv blender && blender/bin/pip install 'bpy==5.0.*'`, and name its "
    "Python by --blender-python blender/bin/python; or, under Python 3.11, add it to this one by "
    "`pip install --no-deps 'bpy==5.0.*'`."
)
_LOG_LINES: Final = 6


class BlenderProcess:
    """A running Blender. Ends with this process, or by `close`."""

    def __init__(self, python: str) -> None:
        self._home = tempfile.TemporaryDirectory(prefix="stereogenbench_blender_")
        self.folder = Path(self._home.name)
        self._log = (self.folder / "log.txt").open("w+b")
        # The user's own preferences and add-ons stay out of it.
        places = {
            f"BLENDER_USER_{name}": str(self.folder / name.lower())
            for name in ("RESOURCES", "CONFIG", "SCRIPTS", "EXTENSIONS", "DATAFILES")
        }
        try:
            self._process = subprocess.Popen(
                [python, "-P", str(_WORKER)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._log,
                env=os.environ | places,
            )
        except OSError as error:
            self._log.close()
            self._home.cleanup()
            raise ExtraError(
                f"{python}: this Python cannot be started ({error}). {_CURE}"
            ) from error
        atexit.register(self.close)
        version = self._version(python)
        if version["number"] != _VERSION:
            self.close()
            raise ExtraError(
                f"{python}: it has Blender {version['version']}, and 5.0 is needed. {_CURE}"
            )

    @property
    def pid(self) -> int:
        """The number of the process."""
        return self._process.pid

    def _version(self, python: str) -> dict[str, Any]:
        try:
            return self.call({"call": "version"}, what="this Python cannot start Blender")[0]
        except SynthesisError as error:
            self.close()
            raise ExtraError(f"{python}: {error} {_CURE}") from error

    def call(
        self, request: dict[str, Any], arrays: Sequence[np.ndarray] = (), *, what: str
    ) -> tuple[dict[str, Any], list[np.ndarray]]:
        """Send a request and return its answer.

        Args:
            request: Plain values.
            arrays: float64 or uint8.
            what: What is asked, for messages.

        Raises:
            SynthesisError: If Blender cannot use an asset, or its process ends.
        """
        try:
            write_message(cast(BinaryIO, self._process.stdin), request, arrays)
            answer, found = read_message(cast(BinaryIO, self._process.stdout))
        except (EOFError, BrokenPipeError) as error:
            raise SynthesisError(f"{what}: {self._last_words()}") from error
        except BaseException:
            self.close()  # The answer is lost, so the next one would be taken for it.
            raise
        if "error" in answer:
            raise SynthesisError(answer["error"])
        return answer, found

    def _last_words(self) -> str:
        """Return how the process ended, with the end of its log."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(10)
        code = self._process.poll()
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").strip().splitlines()
        shown = "; ".join(line.strip() for line in lines[-_LOG_LINES:])
        self.close()
        if code is not None and code < 0:
            name = signal.Signals(-code).name
            how = f"Blender crashed ({name})"
            cure = (
                "Run it again, which keeps what is finished; if memory is short (SIGKILL), with "
                "fewer workers; if the same scene crashes again, open its map in Blender."
            )
        else:
            how, cure = (
                f"Blender ended with status {code}",
                "Run it again; finished scenes are kept.",
            )
        return f"{how}. Its last lines: {shown or 'none'}. {cure}"

    @property
    def is_running(self) -> bool:
        """Whether the process still lives."""
        return self._process.poll() is None

    def close(self) -> None:
        """End the process and remove its folder."""
        atexit.unregister(self.close)
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        self._log.close()
        self._home.cleanup()


_KEPT: Final = 3
_running: dict[tuple[str, str, int], BlenderProcess] = {}


def blender(python: str = "", *, place: str = "") -> BlenderProcess:
    """Return this process's Blender for a map; it is started when it is first needed.

    The three that were used last are kept, because proposals go from map to map.

    Args:
        python: The Python that has bpy; "" for this one.
        place: The map's file; "" for a Blender that waits for its first map.

    Raises:
        ExtraError: If there is no such Blender.
    """
    key = (python or sys.executable, place, os.getpid())
    found = _running.pop(key, None) or _running.pop((key[0], "", key[2]), None)
    if found is None or not found.is_running:
        found = BlenderProcess(key[0])
    _running[key] = found
    for old in [each for each in _running if each[2] == os.getpid()][:-_KEPT]:
        _running.pop(old).close()
    return found
