"""Opening DATA: a progress bar while a tree is read, and a report of the scenes left out."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.schema.text import counted, plain_line

if TYPE_CHECKING:
    from stereogenbench_data.index.table import SceneIndex


def open_data(
    data: str, *, root: str | None = None, conventions: Path | None = None
) -> "SceneIndex":
    """Return the index of some data, without its broken scenes, which are reported on stderr.

    Args:
        data: What the command was given.
        root: Where an index file's data are, if the user says so.
        conventions: The file that says how the data are read.

    Raises:
        StorageError: If the data do not exist, hold no complete scene, or contradict conventions.
    """
    from stereogenbench_data.errors import StorageError
    from stereogenbench_data.index.assumptions import assumptions
    from stereogenbench_data.index.build import walk
    from stereogenbench_data.index.parquet import INDEX_NAME
    from stereogenbench_data.index.table import SceneIndex
    from stereogenbench_data.schema.conventions import Conventions
    from stereogenbench_data.sources.location import is_remote, local_path

    folder = local_path(data)
    is_tree = not is_remote(data) and folder.is_dir() and not (folder / INDEX_NAME).is_file()
    if root is not None or not is_tree:
        return open_index(data, root=root, conventions=conventions)
    stated = None if conventions is None else Conventions.read(conventions)
    with progress_bar("reading scenes", unit="scenes") as progress:
        report = walk(folder, progress=progress, conventions=stated)
    assumed = assumptions(report.scenes, where=str(folder))
    if assumed:
        typer.echo(plain_line(assumed), err=True)
    reasons = [*report.broken.values(), *report.incomplete.values()]
    if not reasons:
        return SceneIndex.from_report(report)
    more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
    if not report.scenes:
        raise StorageError(
            f"{folder}: has no complete scene: {reasons[0].rstrip('.')}{more}. "
            f"`stereogenbench index {folder}` lists them all."
        )
    counts = {"broken": len(report.broken), "incomplete": len(report.incomplete)}
    left_out = " and ".join(f"{count} {name}" for name, count in counts.items() if count)
    found = counted(len(report.scenes) + len(reasons), "scene")
    reason = plain_line(f"{folder}: {left_out} of {found} left out: {reasons[0]}")
    typer.echo(f"{reason}{more} `stereogenbench index {folder}` lists them all.", err=True)
    return SceneIndex.from_report(report)


def open_index(
    data: str, *, root: str | None = None, conventions: Path | None = None
) -> "SceneIndex":
    """Return the index of some data, with its warnings printed on stderr.

    Args:
        data: What the command was given.
        root: Where an index file's data are, if the user says so.
        conventions: The file that says how the data are read.

    Raises:
        StorageError: If the data do not exist, hold a broken scene, or contradict conventions.
    """
    from stereogenbench_data.index.assumptions import AssumptionWarning
    from stereogenbench_data.index.open import IncompleteSceneWarning
    from stereogenbench_data.index.stale import StaleIndexWarning
    from stereogenbench_data.index.table import SceneIndex

    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always", IncompleteSceneWarning)
        warnings.simplefilter("always", StaleIndexWarning)
        warnings.simplefilter("always", AssumptionWarning)
        index = SceneIndex.open(data, root=root, conventions=conventions, rows="read")
    for warning in warned:
        typer.echo("\n".join(map(plain_line, str(warning.message).split("\n"))), err=True)
    return index


def full_place(data: str) -> str:
    """Return the URL of some data without login and query, or their absolute path."""
    from stereogenbench_data.sources.location import is_remote, local_path, shown

    return shown(data) if is_remote(data) else str(local_path(data).resolve())
