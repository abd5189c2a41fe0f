"""``stereogenbench upload``: packed shards onto the Hub."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from stereogenbench_data.cli.options import JsonOption
from stereogenbench_data.schema.text import counted


def upload(
    shards: Annotated[Path, typer.Argument(help="Folder of shards, as pack made it.")],
    repository: Annotated[str, typer.Argument(help="ORG/NAME of a dataset on the Hub.")],
    *,
    branch: Annotated[str, typer.Option(help="Branch to commit to.")] = "main",
    as_json: JsonOption = False,
) -> None:
    """Upload shards with index, dataset card and Croissant descriptor (extra 'hub').

    The card and the descriptor are written into the folder first. Log in with `hf auth login`.
    A run that was stopped goes on if it is run again.
    """
    from stereogenbench_data.bridges.upload import upload as uploaded

    report = uploaded(shards, repository, branch=branch)
    if as_json:
        typer.echo(json.dumps(asdict(report), indent=2))
        return
    typer.echo(f"{counted(report.files, 'file')}: StereoPairs({report.url!r})")
