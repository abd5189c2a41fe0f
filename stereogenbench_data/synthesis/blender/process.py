"""One Blender in a process of its own, and what its end means.

Blender holds one global scene, and a crash of it ends its process. So each map has a process of its
own that answers requests, in turn.
"""

import atexit
import multiprocessing
import os
import signal
import tempfile
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from stereogenbench_data.errors import SynthesisError
from stereogenbench_data.synthesis.blender.assets import Asked

_LOG: Final = "log.txt"
_LOG_LINES: Final = 6
_KEPT: Final = 3


class BlenderProcess:
    """A running Blender, in `process`. Ends with this process, or by `close`."""

    def __init__(self) -> None:
        self._home = tempfile.TemporaryDirectory(prefix="stereogenbench_blender_")
        self.folder = Path(self._home.name)
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, self.folder), daemon=True)
        self.process.start()
        theirs.close()
        atexit.register(self.close)

    def call(self, name: str, asked: Asked, *values: Any, what: str) -> Any:
        """Call a method of the process's `stage.Stage` and return what it returns.

        Args:
            name: The method.
            asked: The assets: the map, which is opened if it is another, and the subject.
            *values: What else the method is given.
            what: What is asked, for messages.

        Raises:
            SynthesisError: If Blender cannot use an asset, or its process ends.
        """
        try:
            self._connection.send((name, asked, values))
            error, answer = self._connection.recv()
        except (EOFError, ConnectionError) as lost:
            raise SynthesisError(f"{what}: {self._last_words()}") from lost
        except BaseException:
            self.close()  # The answer is lost, so the next one would be taken for it.
            raise
        if error is not None:
            raise SynthesisError(error)
        return answer

    def _last_words(self) -> str:
        """Return how the process ended, with the end of its log."""
        self.process.join(10)
        code = self.process.exitcode
        lines = (self.folder / _LOG).read_text(errors="replace").strip().splitlines()
        shown = "; ".join(line.strip() for line in lines[-_LOG_LINES:])
        self.close()
        if code is not None and code < 0:
            how = f"Blender crashed ({signal.Signals(-code).name})"
        else:
            how = f"Blender ended with status {code}"
        return (
            f"{how}. Its last lines: {shown or 'none'}. Run it again, which keeps what is "
            f"finished; if memory is short (SIGKILL), with fewer workers; if the same scene "
            f"crashes again, open its map in Blender."
        )

    def close(self) -> None:
        """End the process and remove its folder."""
        atexit.unregister(self.close)
        self.process.kill()
        self.process.join()
        self._connection.close()
        self._home.cleanup()


_running: dict[str, BlenderProcess] = {}


def blender(place: str) -> BlenderProcess:
    """Return this process's Blender for a map's file; it is started when it is first needed.

    The three that were used last are kept, because proposals go from map to map.
    """
    found = _running.pop(place, None)
    if found is None or not found.process.is_alive():
        found = BlenderProcess()
    _running[place] = found
    for old in list(_running)[:-_KEPT]:
        _running.pop(old).close()
    return found


def _serve(requests: Connection, folder: Path) -> None:
    """Answer requests until the other process closes its end; Blender's own process runs this."""
    log = os.open(folder / _LOG, os.O_WRONLY | os.O_CREAT)
    for stream in (1, 2):
        os.dup2(log, stream)
    # The user's own preferences and add-ons stay out of it.
    for name in ("RESOURCES", "CONFIG", "SCRIPTS", "EXTENSIONS", "DATAFILES"):
        os.environ[f"BLENDER_USER_{name}"] = str(folder / name.lower())
    from stereogenbench_data.synthesis.blender.stage import Stage

    stage = None
    while True:
        try:
            name, asked, values = requests.recv()
        except EOFError:
            os._exit(0)  # Blender's own clean-up takes long and may crash.
        try:
            if stage is None or (stage.root, stage.asset) != asked[:2]:
                stage = None
                stage = Stage(asked.root, asked.map)
            requests.send((None, getattr(stage, name)(asked, *values)))
        except SynthesisError as error:
            requests.send((str(error), None))
