"""One Blender in a process of its own, and what its end means.

Blender holds one global scene, and a crash of it ends its process. So each map has a process of its
own, `worker.py`, that answers over pipes.
"""

import atexit
import contextlib
import os
import pickle
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

import numpy as np

from stereogenbench_data.errors import SynthesisError

_WORKER: Final = Path(__file__).with_name("worker.py")
_LOG_LINES: Final = 6


class BlenderProcess:
    """A running Blender. Ends with this process, or by `close`."""

    def __init__(self) -> None:
        self._home = tempfile.TemporaryDirectory(prefix="stereogenbench_blender_")
        self.folder = Path(self._home.name)
        self._log = (self.folder / "log.txt").open("w+b")
        # The user's own preferences and add-ons stay out of it.
        places = {
            f"BLENDER_USER_{name}": str(self.folder / name.lower())
            for name in ("RESOURCES", "CONFIG", "SCRIPTS", "EXTENSIONS", "DATAFILES")
        }
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(_WORKER)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            env=os.environ | places,
        )
        atexit.register(self.close)

    @property
    def pid(self) -> int:
        """The number of the process."""
        return self._process.pid

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
            requests = cast(BinaryIO, self._process.stdin)
            pickle.dump((request, arrays), requests, protocol=5)
            requests.flush()
            answer, found = pickle.load(cast(BinaryIO, self._process.stdout))
        except (EOFError, BrokenPipeError, pickle.UnpicklingError) as error:
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
_running: dict[tuple[int, str], BlenderProcess] = {}


def blender(place: str) -> BlenderProcess:
    """Return this process's Blender for a map's file; it is started when it is first needed.

    The three that were used last are kept, because proposals go from map to map.
    """
    found = _running.pop((os.getpid(), place), None)
    if found is None or not found.is_running:
        found = BlenderProcess()
    _running[os.getpid(), place] = found
    for old in [each for each in _running if each[0] == os.getpid()][:-_KEPT]:
        _running.pop(old).close()
    return found
