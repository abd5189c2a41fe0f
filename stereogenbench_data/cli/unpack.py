"""``stereogenbench unpack``: shards back into a tree in the released layout."""

import json
from pathlib import Path
from typing import Annotated

import typer

from stereogenbench_data.cli.options import JsonOption, RootOption, WorkersOption
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.stopping import STOPPED

_MEGABYTE = 1_000_000


def unpack(
    shards: Annotated[str, typer.Argument(help="Folder of shards, or its index file.")],
    out: Annotated[Path, typer.Argument(help="Folder for the scenes.")],
    *,
    data_root: RootOption = None,
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Turn shards back into scenes as they were released, each file held against the index.

    Files that were packed as they are come out byte for byte. Depth that blosc2 packed is written
    as FFV1 video again, with the same numbers, times and tags. Nothing is overwritten; scenes that
    are there are kept, so a run that was stopped goes on if it is run again.
    """
    from stereogenbench_data.schema.text import counted
    from stereogenbench_data.shards.unpack import unpack as unpacked

    try:
        with progress_bar("unpacking", unit="MB") as bar:

            def progress(done: int, total: int) -> None:
                bar(-(-done // _MEGABYTE), -(-total // _MEGABYTE))

            report = unpacked(shards, out, root=data_root, workers=workers, progress=progress)
    except KeyboardInterrupt:
        typer.echo("stopped; run the same command again to go on from here", err=True)
        raise typer.Exit(STOPPED) from None
    if as_json:
        told = {"unpacked": list(report.unpacked), "kept": list(report.kept)}
        typer.echo(json.dumps({"out": str(out)} | told, indent=2))
        return
    were = "was" if len(report.kept) == 1 else "were"
    typer.echo(
        f"{out}: {counted(len(report.unpacked), 'scene')} unpacked, {len(report.kept)} {were} "
        f"there before"
    )
