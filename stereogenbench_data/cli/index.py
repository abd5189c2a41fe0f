"""``stereogenbench index``: walk a released tree once, and keep what training asks of it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console

from stereogenbench_data.cli.progress import progress_bar

_INDEX_NAME = "index.parquet"


def index(
    root: Annotated[Path, typer.Argument(help="Folder that holds train/ and eval/.")],
    *,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help=f"Index file to write [ROOT/{_INDEX_NAME}]."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes that read scenes [one a core].")
    ] = None,
    valid_depth: Annotated[
        bool,
        typer.Option(
            "--valid-depth",
            help="Decode a few depth pictures of each scene, to be able to select by the share "
            "of measured pixels.",
        ),
    ] = False,
) -> None:
    """Index a released tree, so that it opens at once.

    The walk goes on where it stopped if it is run again after an interruption. Incomplete scenes
    are listed and left out. Broken ones too, and then the exit status is 1.
    """
    from stereogenbench_data.storage.index import SceneIndex
    from stereogenbench_data.storage.journal import Journal
    from stereogenbench_data.storage.walk import walk

    console = Console(stderr=True)
    target = root / _INDEX_NAME if out is None else out
    mode: Literal["skip", "sample"] = "sample" if valid_depth else "skip"
    if target.is_dir():
        raise typer.BadParameter(
            f"{target} is a folder: name a file, such as {target / _INDEX_NAME}."
        )
    done_before = target.with_name(f"{target.name}.journal")
    try:
        with (
            Journal(done_before, walk=f"{root.resolve()} valid_depth={mode}") as journal,
            progress_bar("indexing", unit="scenes") as progress,
        ):
            report = walk(
                root, workers=workers, progress=progress, journal=journal, valid_depth=mode
            )
            if report.scenes:
                SceneIndex.from_report(report).write(target)
                journal.delete()
    except KeyboardInterrupt:
        console.print("stopped; run the same command again to go on from here")
        raise typer.Exit(130) from None
    _list(console, "incomplete, left out", report.incomplete)
    _list(console, "broken, left out", report.broken)
    _list(console, "to know", {note: note for note in report.notes})
    if not report.scenes:
        console.print(f"{root}: no scene is whole, so there is nothing to index")
        raise typer.Exit(1)
    typer.echo(f"{target}: {len(report.scenes)} scenes")
    if report.broken:
        raise typer.Exit(1)


def _list(console: Console, title: str, reasons: Mapping[str, str]) -> None:
    if reasons:
        console.print(f"{len(reasons)} {title}:", style="bold", highlight=False)
    for key, reason in reasons.items():
        text = reason if key in reason else f"{key}: {reason}"
        console.print(f"  {text}", markup=False, highlight=False, soft_wrap=True)
