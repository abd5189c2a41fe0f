"""DATA as commands open it: what has to be walked is walked with a progress bar."""

from pathlib import Path
from typing import TYPE_CHECKING

from stereogenbench_data.cli.progress import progress_bar

if TYPE_CHECKING:
    from stereogenbench_data.storage.index import SceneIndex


def open_data(data: str) -> "SceneIndex":
    """Return the index of some data, without scenes that are broken: it names these.

    Raises:
        StorageError: If there is no such data, or no scene of it is whole.
    """
    from stereogenbench_data.errors import StorageError
    from stereogenbench_data.storage.index import INDEX_NAME, SceneIndex
    from stereogenbench_data.storage.walk import walk

    root = Path(data)
    if "://" in data or not root.is_dir() or (root / INDEX_NAME).is_file():
        return SceneIndex.open(data)
    with progress_bar("reading scenes", unit="scenes") as progress:
        report = walk(root, progress=progress)
    if not report.scenes:
        reasons = [*report.broken.values(), *report.incomplete.values()]
        more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
        raise StorageError(
            f"{root}: no scene is whole: {reasons[0]}{more}. `stereogenbench index {root}` lists "
            f"them all."
        )
    return SceneIndex.from_report(report)
