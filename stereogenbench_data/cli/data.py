"""Opening DATA: what is odd about them is told in lines on stderr."""

import warnings
from typing import TYPE_CHECKING

import typer
from rich.console import Console

from stereogenbench_data.schema.text import plain_line

if TYPE_CHECKING:
    from stereogenbench_data.index.table import SceneIndex
    from stereogenbench_data.schema.conventions import Conventions


def open_data(
    data: str, *, root: str | None = None, conventions: "Conventions | None" = None
) -> "SceneIndex":
    """Return the index of some data, with its warnings printed on stderr.

    Args:
        data: What the command was given.
        root: Where an index file's data are, if the user says so.
        conventions: How the data are read.

    Raises:
        StorageError: If the data do not exist, hold no complete scene or too many broken ones, or
            contradict conventions.
    """
    from stereogenbench_data.index.table import (
        AssumptionWarning,
        IncompleteSceneWarning,
        SceneIndex,
        StaleIndexWarning,
    )

    with (
        warnings.catch_warnings(record=True) as warned,
        Console(stderr=True).status("reading scenes"),
    ):
        for kind in (IncompleteSceneWarning, StaleIndexWarning, AssumptionWarning):
            warnings.simplefilter("always", kind)
        index = SceneIndex.open(data, root=root, conventions=conventions, rows="read")
    for warning in warned:
        typer.echo("\n".join(map(plain_line, str(warning.message).split("\n"))), err=True)
    return index


def full_place(data: str) -> str:
    """Return the URL of some data without login and query, or their absolute path."""
    from stereogenbench_data.sources.location import is_remote, local_path, shown

    return shown(data) if is_remote(data) else str(local_path(data).resolve())
