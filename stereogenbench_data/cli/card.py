"""``stereogenbench card``: the dataset card of packed shards."""

from pathlib import Path
from typing import Annotated

import typer

from stereogenbench_data.cli.options import DataArgument, RootOption


def card(
    data: DataArgument,
    *,
    data_root: RootOption = None,
    repository: Annotated[str, typer.Option("--repo", help="ORG/NAME on the Hub.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder to write README.md into [stdout].")
    ] = None,
) -> None:
    """Write the dataset card of shards: what the Hub shows, and how `datasets` finds the shards."""
    from stereogenbench_data.bridges.card import card as card_text
    from stereogenbench_data.bridges.card import write_card
    from stereogenbench_data.index.table import SceneIndex

    index = SceneIndex.open(data, root=data_root)
    if out is None:
        typer.echo(card_text(index, repository=repository), nl=False)
        return
    typer.echo(f"{write_card(index, out, repository=repository)}")
