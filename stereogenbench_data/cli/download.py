"""``stereogenbench download``: the part of a release that a selection needs, onto this disk."""

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from stereogenbench_data.cli.options import (
    DataOptions,
    JsonOption,
    SceneOptions,
    grouped,
)
from stereogenbench_data.cli.outcome import resumable
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.schema.text import counted


@grouped
@resumable()
def download(  # noqa: PLR0913 - one parameter an option
    source: DataOptions,
    *,
    dest: Annotated[Path, typer.Option("--dest", help="Folder to write into.")],
    cameras: Annotated[
        str, typer.Option(help="Numbers of the cameras wanted, such as 0,1.")
    ] = "0,1,2,3,4,5",
    streams: Annotated[
        Literal["both", "rgb", "depth"], typer.Option(help="Which videos.")
    ] = "both",
    chosen: SceneOptions,
    workers: Annotated[int, typer.Option(min=1, help="Files fetched at a time.")] = 8,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say how much it would be, and fetch nothing.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Fetch only what a selection needs, laid out as it was released.

    Every file is checked as it comes; a run that was stopped goes on if it is run again. The folder
    then opens with `StereoPairs(DEST)`, for the cameras that were fetched.
    """
    from stereogenbench_data.index.table import SceneIndex
    from stereogenbench_data.selection.filters import filter_scenes
    from stereogenbench_data.shards.download import download as fetched
    from stereogenbench_data.shards.download import plan_download

    numbers = _cameras(cameras)
    filters: Any = chosen.filters()
    index = SceneIndex.open(source.data, root=source.data_root)
    rows = filter_scenes(index, filters)
    kinds = ("rgb", "depth") if streams == "both" else (streams,)
    wanted = plan_download(index, rows.tolist(), cameras=numbers, streams=kinds)
    size = wanted.size_bytes / 1e6
    scenes, files = counted(len(rows), "scene"), counted(len(wanted.files), "file")
    typer.echo(f"{scenes}, {files}, {size:,.1f} MB", err=True)
    if not dry_run:
        with progress_bar("downloading", unit="MB") as progress:
            fetched(index, wanted, dest, workers=workers, progress=progress)
    summary = {"scenes": len(rows), "files": len(wanted.files), "bytes": wanted.size_bytes}
    if as_json:
        typer.echo(json.dumps(summary | {"dest": None if dry_run else str(dest)}, indent=2))
    elif not dry_run:
        typer.echo(f"{dest}: {scenes}, {size:,.1f} MB")


def _cameras(text: str) -> list[int]:
    parts = [part.strip() for part in text.split(",")]
    if not all(part in set("012345") for part in parts):
        raise typer.BadParameter(
            f"{text!r}: write numbers from 0 to 5, such as 0,1", param_hint="--cameras"
        )
    return sorted({int(part) for part in parts})
