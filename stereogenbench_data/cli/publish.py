"""``stereogenbench publish croissant``, ``card``: describe shards for those who upload them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stereogenbench_data.cli.options import ShardsArgument, flag, grouped, option
from stereogenbench_data.schema.text import counted

if TYPE_CHECKING:
    from stereogenbench_data.bridges.dataset_facts import About

AboutOption = Annotated[
    str | None,
    option(
        "--about",
        "Name, version, licence, provenance: answers to `publish croissant --template`, or "
        "release for the paper's scenes.",
        metavar="FILE|release",
    ),
]


def _stated(about: str | None) -> "About | None":
    return "release" if about == "release" else None if about is None else Path(about)


RepositoryArgument = Annotated[
    str, typer.Argument(metavar="ORG/NAME", help="Dataset repository on the Hub.")
]


def croissant(
    data: Annotated[
        str | None,
        typer.Argument(help="Folder of shards, their index file, or a URL [the public release]."),
    ] = None,
    *,
    out: Annotated[
        Path | None, option("--out", "-o", "Descriptor to write, with tables beside.")
    ] = None,
    base_url: Annotated[
        str | None, option("URL of the data, pinned to a revision [paths from the descriptor].")
    ] = None,
    about: AboutOption = None,
    template: Annotated[
        bool, flag("--template", "Write the questions that --about answers.")
    ] = False,
) -> None:
    """Write a Croissant 1.1 descriptor, with the properties on responsible use.

    `mlcroissant validate --jsonld FILE` checks one.

    Example: `stereogenbench publish croissant shards/ -o croissant/sample.json`
    """
    if out is None:
        raise typer.BadParameter(
            "no file for the descriptor: name it with -o FILE.", param_hint="--out"
        )
    from stereogenbench_data.bridges import dataset_facts
    from stereogenbench_data.bridges.croissant.descriptor import write_descriptor, write_node
    from stereogenbench_data.index.table import SceneIndex

    if template:
        write_node(dataset_facts.template(), out)
        typer.echo(f"{out}: answer the questions, then add --about {out}")
        return
    index = None if data is None else SceneIndex.open(data, rows="read")
    data_url = None if base_url is None else base_url.rstrip("/")
    descriptor = write_descriptor(index, out, about=_stated(about), data_url=data_url)
    files, records = len(descriptor["distribution"]), len(descriptor["recordSet"])
    typer.echo(f"{out}: {files} files and sets of files, {counted(records, 'record set')}")


@grouped
def card(
    shards: ShardsArgument,
    repository: RepositoryArgument,
    *,
    out: Annotated[
        Path | None, option("--out", "-o", "Folder for README.md [stdout].", metavar="DIR")
    ] = None,
    about: AboutOption = None,
) -> None:
    """Write the dataset card of shards.

    The Hub shows it, and `datasets` reads its configurations. With --out, shards that lead out of
    their folder by a link are refused. Upload with the Hub's own
    `hf upload ORG/NAME packed/ --repo-type dataset`.

    Example: `stereogenbench publish card packed/ ORG/NAME -o packed/`
    """
    from stereogenbench_data.bridges.card import card as card_text
    from stereogenbench_data.bridges.card import write_card
    from stereogenbench_data.index.table import SceneIndex

    index = SceneIndex.open(shards)
    if out is None:
        typer.echo(card_text(index, repository=repository, about=_stated(about)), nl=False)
        return
    typer.echo(str(write_card(index, out, repository=repository, about=_stated(about))))
