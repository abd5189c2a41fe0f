"""DATA as commands open it: walked with a progress bar, and what is left out is said."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.schema.text import counted, plain_line

if TYPE_CHECKING:
    from stereogenbench_data.index.build import TreeReport
    from stereogenbench_data.index.table import SceneIndex


def open_data(data: str, *, root: str | None = None) -> "SceneIndex":
    """Return the index of some data, without scenes that are broken: stderr is told of these.

    Args:
        data: What the command was given.
        root: Where an index file's data are, by the user's word.

    Raises:
        StorageError: If there is no such data, or no scene of it is whole.
    """
    from stereogenbench_data.errors import StorageError
    from stereogenbench_data.index.build import walk
    from stereogenbench_data.index.table import INDEX_NAME, SceneIndex
    from stereogenbench_data.sources.location import is_remote, local_path

    folder = None if is_remote(data) else local_path(data)
    if folder is None or root is not None or not folder.is_dir():
        return _opened(data, root)
    if (folder / INDEX_NAME).is_file():
        return _opened(data, root)
    with progress_bar("reading scenes", unit="scenes") as progress:
        report = walk(folder, progress=progress)
    if not report.scenes:
        reasons = [*report.broken.values(), *report.incomplete.values()]
        more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
        raise StorageError(
            f"{folder}: no scene is whole: {reasons[0]}{more}. `stereogenbench index {folder}` "
            f"lists them all."
        )
    _tell_left_out(folder, report)
    return SceneIndex.from_report(report)


def _opened(data: str, root: str | None) -> "SceneIndex":
    """Return an index that exists; its warnings are said as a command says things."""
    from stereogenbench_data.index.stale import StaleIndexWarning
    from stereogenbench_data.index.table import IncompleteSceneWarning, SceneIndex

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", IncompleteSceneWarning)
        warnings.simplefilter("always", StaleIndexWarning)
        index = SceneIndex.open(data, root=root)
    for warning in told:
        typer.echo("\n".join(map(plain_line, str(warning.message).split("\n"))), err=True)
    return index


def _tell_left_out(root: Path, report: "TreeReport") -> None:
    reasons = [*report.broken.values(), *report.incomplete.values()]
    if not reasons:
        return
    counts = {"broken": len(report.broken), "incomplete": len(report.incomplete)}
    said = " and ".join(f"{count} {name}" for name, count in counts.items() if count)
    found = len(report.scenes) + len(reasons)
    typer.echo(
        plain_line(f"{root}: {said} of {counted(found, 'scene')} left out: {reasons[0]}")
        + (f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else "")
        + f" `stereogenbench index {root}` lists them all.",
        err=True,
    )
