"""``stereogenbench verify``: every byte of the shards against their index."""

import json
from dataclasses import asdict
from typing import Annotated, Literal

import typer

from stereogenbench_data.cli.options import RootOption
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.stopping import STOPPED

_MEGABYTE = 1_000_000


def verify(
    shards: Annotated[str, typer.Argument(help="Folder of shards, or its index file.")],
    *,
    data_root: RootOption = None,
    deep: Annotated[
        bool, typer.Option("--deep", help="Decode every video too, and count its frames.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes that read [one a core].")
    ] = None,
) -> None:
    """Read shards through, and list all that is wrong with them.

    The exit status is 0 if nothing is wrong, 1 if something is, 2 if they cannot be verified.
    """
    from stereogenbench_data.schema.text import counted, plain_line
    from stereogenbench_data.shards.verify import verify as verified

    mode: Literal["bytes", "decode"] = "decode" if deep else "bytes"
    try:
        with progress_bar("verifying", unit="MB") as bar:

            def progress(done: int, total: int) -> None:
                bar(-(-done // _MEGABYTE), -(-total // _MEGABYTE))

            report = verified(shards, root=data_root, mode=mode, workers=workers, progress=progress)
    except KeyboardInterrupt:
        typer.echo("stopped", err=True)
        raise typer.Exit(STOPPED) from None
    if as_json:
        typer.echo(json.dumps(asdict(report), indent=2))
    else:
        for problem in report.problems:
            typer.echo(plain_line(str(problem)))
        decoded = f", {counted(report.videos_decoded, 'video')} decoded" if deep else ""
        there = ", ".join(
            (
                counted(report.shards, "shard"),
                counted(report.scenes, "scene"),
                counted(report.members, "member"),
                f"{report.bytes / _MEGABYTE:.1f} MB{decoded}",
            )
        )
        typer.echo(f"{report.root}: {there}; {counted(len(report.problems), 'problem')}")
    if report.problems:
        raise typer.Exit(1)
