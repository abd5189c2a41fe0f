"""``stereogenbench download``: copy the part of a release that a selection needs to this disk."""

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from stereogenbench_data.cli.errors import resumable
from stereogenbench_data.cli.options import (
    DataOptions,
    JsonOption,
    SceneOptions,
    ShareOptions,
    grouped,
)
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.schema.text import counted


@grouped
@resumable()
def download(  # noqa: PLR0913 - one parameter an option
    source: DataOptions,
    *,
    dest: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write into.")],
    cameras: Annotated[
        str, typer.Option(help="Numbers of the cameras, such as 0,1.")
    ] = "0,1,2,3,4,5",
    streams: Annotated[
        Literal["both", "rgb", "depth"], typer.Option(help="Which videos.")
    ] = "both",
    chosen: SceneOptions,
    share: ShareOptions,
    workers: Annotated[int, typer.Option(min=1, help="Files to fetch at a time.")] = 8,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the size and fetch nothing.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Fetch only what a selection needs, in the released layout.

    Every file is checked as it arrives. To continue a stopped run, run it again. The folder opens
    with `StereoPairs(DEST)`, for the cameras that were fetched. --max-bytes 10GB takes a share that
    is balanced over families and maps; the same share each time.
    """
    from stereogenbench_data.index.table import SceneIndex
    from stereogenbench_data.selection.filters import filter_scenes
    from stereogenbench_data.shards.download import download as fetched
    from stereogenbench_data.shards.download import download_sizes, plan_download

    parts = [part.strip() for part in cameras.split(",")]
    if not all(part in set("012345") for part in parts):
        raise typer.BadParameter(
            f"{cameras!r}: write numbers from 0 to 5, such as 0,1", param_hint="--cameras"
        )
    numbers = sorted({int(part) for part in parts})
    filters: Any = chosen.filters()
    index = SceneIndex.open(source.data, root=source.data_root, conventions=source.conventions)
    rows = filter_scenes(index, filters).tolist()
    kinds = ("rgb", "depth") if streams == "both" else (streams,)
    if share.is_given:
        sizes = download_sizes(index, rows, cameras=numbers, streams=kinds)
        rows = share.rows(index, [*sizes], [*sizes.values()])
    wanted = plan_download(index, rows, cameras=numbers, streams=kinds)
    size = wanted.size_bytes / 1e6
    scenes, files = counted(len(rows), "scene"), counted(len(wanted.files), "file")
    typer.echo(f"{scenes}, {files}, {size:,.1f} MB", err=True)
    if not dry_run:
        with progress_bar("downloading", unit="MB") as progress:
            fetched(index, wanted, dest, workers=workers, progress=progress)
    if as_json:
        summary = {"scenes": len(rows), "files": len(wanted.files), "bytes": wanted.size_bytes}
        typer.echo(json.dumps(summary | {"dest": None if dry_run else str(dest)}, indent=2))
    elif not dry_run:
        typer.echo(f"{dest}: {scenes}, {size:,.1f} MB")
