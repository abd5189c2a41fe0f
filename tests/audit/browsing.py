"""What the tests of the browser share: its server, and the Python lines that it shows."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stereogenbench_data import SceneIndex
from stereogenbench_data.audit.browser.catalogue import Catalogue
from stereogenbench_data.audit.browser.server import PageServer
from stereogenbench_data.audit.pictures import SceneReader


@contextmanager
def serving(index: SceneIndex, data: Path) -> Iterator[PageServer]:
    """Serve the page of an index in a thread."""
    with PageServer(Catalogue(index, shown_data=str(data)), SceneReader(index)) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def run(line: str) -> dict:
    """Run a line of the page as it is, as a user does who copies it; return its names."""
    names: dict = {}
    exec(line, names)
    return names
