"""``stereogenbench index``: walk a released tree once, and keep what training asks of it."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from stereogenbench_data.errors import StereoGenBenchError
from stereogenbench_data.storage.index import INDEX_NAME, SceneIndex
from stereogenbench_data.storage.journal import Journal
from stereogenbench_data.storage.scene_folder import ValidDepth
from stereogenbench_data.storage.walk import TreeReport, walk


class _RateColumn(ProgressColumn):
    """Scenes a second."""

    def render(self, task: Task) -> Text:
        """Return the rate since the start."""
        rate = task.finished_speed or task.speed
        return Text("? scenes/s" if rate is None else f"{rate:.1f} scenes/s")


def index(
    root: Annotated[Path, typer.Argument(help="Folder that holds train/ and eval/.")],
    *,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help=f"Index file to write [ROOT/{INDEX_NAME}]."),
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
    console = Console(stderr=True)
    target = root / INDEX_NAME if out is None else out
    mode: ValidDepth = "sample" if valid_depth else "skip"
    try:
        report = _indexed(root, target=target, workers=workers, valid_depth=mode, console=console)
    except StereoGenBenchError as error:
        console.print(f"error: {error}", style="red", markup=False, highlight=False)
        raise typer.Exit(1) from error
    except KeyboardInterrupt:
        console.print("stopped; run the same command again to go on from here")
        raise typer.Exit(130) from None
    _list(console, report)
    typer.echo(f"{target}: {len(report.scenes)} scenes")
    if report.broken:
        raise typer.Exit(1)


def _indexed(
    root: Path, *, target: Path, workers: int | None, valid_depth: ValidDepth, console: Console
) -> TreeReport:
    columns = (
        TextColumn("indexing"),
        BarColumn(),
        MofNCompleteColumn(),
        _RateColumn(),
        TimeRemainingColumn(),
    )
    notes = target.with_name(f"{target.name}.journal")
    with (
        Journal(notes, walk=f"{root.resolve()} valid_depth={valid_depth}") as journal,
        Progress(*columns, console=console) as bar,
    ):
        task = bar.add_task("indexing", total=None)
        report = walk(
            root,
            workers=workers,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
            journal=journal,
            valid_depth=valid_depth,
        )
        SceneIndex.from_report(report).write(target)
        journal.delete()
    return report


def _list(console: Console, report: TreeReport) -> None:
    for title, scenes in (("incomplete", report.incomplete), ("broken", report.broken)):
        if scenes:
            console.print(f"\n{len(scenes)} {title}, left out:", style="bold")
        for key, reason in scenes.items():
            text = reason if key in reason else f"{key}: {reason}"
            console.print(f"  {text}", markup=False, highlight=False, soft_wrap=True)
    for note in report.notes:
        console.print(f"note: {note}", markup=False, highlight=False, soft_wrap=True)
