"""How commands open DATA: with a progress bar, and with a report of the scenes left out."""

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
    """Return the index of some data, without its broken scenes, which are reported on stderr.

    Args:
        data: What the command was given.
        root: Where an index file's data are, by the user's word.

    Raises:
        StorageError: If the data do not exist, or hold no complete scene.
    """
    from stereogenbench_data.errors import StorageError
    from stereogenbench_data.index.build import walk
    from stereogenbench_data.index.parquet import INDEX_NAME
    from stereogenbench_data.index.table import SceneIndex
    from stereogenbench_data.sources.location import is_remote, local_path

    folder = None if is_remote(data) else local_path(data)
    if folder is None or root is not None or not folder.is_dir():
        return open_index(data, root=root)
    if (folder / INDEX_NAME).is_file():
        return open_index(data, root=root)
    with progress_bar("reading scenes", unit="scenes") as progress:
        report = walk(folder, progress=progress)
    if not report.scenes:
        reasons = [*report.broken.values(), *report.incomplete.values()]
        more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
        raise StorageError(
            f"{folder}: has no complete scene: {reasons[0]}{more}. `stereogenbench index {folder}` "
            f"lists them all."
        )
    _report_left_out(folder, report)
    return SceneIndex.from_report(report)


def open_index(data: str, *, root: str | None = None) -> "SceneIndex":
    """Return the index of some data, with its warnings printed on stderr.

    Args:
        data: What the command was given.
        root: Where an index file's data are, by the user's word.

    Raises:
        StorageError: If the data do not exist, or hold a broken scene.
    """
    from stereogenbench_data.index.open import IncompleteSceneWarning
    from stereogenbench_data.index.stale import StaleIndexWarning
    from stereogenbench_data.index.table import SceneIndex

    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always", IncompleteSceneWarning)
        warnings.simplefilter("always", StaleIndexWarning)
        index = SceneIndex.open(data, root=root)
    for warning in warned:
        typer.echo("\n".join(map(plain_line, str(warning.message).split("\n"))), err=True)
    return index


def _report_left_out(root: Path, report: "TreeReport") -> None:
    reasons = [*report.broken.values(), *report.incomplete.values()]
    if not reasons:
        return
    counts = {"broken": len(report.broken), "incomplete": len(report.incomplete)}
    left_out = " and ".join(f"{count} {name}" for name, count in counts.items() if count)
    found = len(report.scenes) + len(reasons)
    typer.echo(
        plain_line(f"{root}: {left_out} of {counted(found, 'scene')} left out: {reasons[0]}")
        + (f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else "")
        + f" `stereogenbench index {root}` lists them all.",
        err=True,
    )
