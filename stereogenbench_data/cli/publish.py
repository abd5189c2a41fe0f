"""``stereogenbench croissant``, ``card``, ``upload``: describe and publish shards."""

import json
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from stereogenbench_data.cli.errors import FINDINGS
from stereogenbench_data.cli.options import DataOptions, JsonOption, RootOption, grouped
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.schema.text import counted

AboutOption = Annotated[
    Path | None,
    typer.Option(
        "--about",
        help="JSON file with authors, licence and provenance, as `croissant --template` asks.",
    ),
]


def croissant(  # noqa: PLR0913 - one parameter an option
    data: Annotated[
        str | None,
        typer.Argument(
            help="Folder of shards, released tree, index file or URL; with --check, a descriptor. "
            "Without it, the public release in folders on the Hub."
        ),
    ] = None,
    *,
    data_root: RootOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Descriptor to write; tables go beside it.")
    ] = None,
    check: Annotated[
        bool,
        typer.Option("--check", help="Check a descriptor against its files; exit 1 on findings."),
    ] = False,
    base_url: Annotated[
        str | None,
        typer.Option(
            help="URL of the folder of shards, pinned to a revision, or of the repository of a "
            "tree [paths relative to the descriptor]."
        ),
    ] = None,
    tables_url: Annotated[
        str | None,
        typer.Option(help="URL of the tables' folder [BASE_URL/NAME, NAME being the file's]."),
    ] = None,
    name: Annotated[
        str | None, typer.Option(help="The dataset's name [as its maker states].")
    ] = None,
    release: Annotated[
        str | None, typer.Option(help="MAJOR.MINOR.PATCH of the data [1.0.0].")
    ] = None,
    published: Annotated[
        datetime | None,
        typer.Option(formats=["%Y-%m-%d"], help="Day of publication [today]."),
    ] = None,
    about: AboutOption = None,
    template: Annotated[
        bool, typer.Option("--template", help="Write the questions that --about answers.")
    ] = False,
    mapping: Annotated[
        list[str] | None,
        typer.Option("--map-file", help="ID=PATH with --check: local copy of a file behind a URL."),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Report as JSON; with --check the findings.")
    ] = False,
) -> None:
    """Write a Croissant 1.1 descriptor with responsible-AI fields, or check one.

    The check covers what `mlcroissant validate` does not: files, checksums, columns, references,
    names and the context.
    """
    if check:
        _check(data, mapping or [], as_json=as_json)
        return
    if out is None:
        raise typer.BadParameter(
            "no file for the descriptor: name it with -o FILE.", param_hint="--out"
        )
    from stereogenbench_data.bridges import dataset_facts
    from stereogenbench_data.bridges.croissant.descriptor import (
        Publication,
        write_descriptor,
        write_node,
    )
    from stereogenbench_data.index.table import SceneIndex

    if template:
        write_node(dataset_facts.template(), out)
        typer.echo(f"{out}: answer the questions, then add --about {out}")
        return
    index = None if data is None else SceneIndex.open(data, root=data_root)
    publication = Publication(
        name=name,
        version=release,
        published=None if published is None else published.date(),
        data_url=None if base_url is None else base_url.rstrip("/"),
        tables_url=None if tables_url is None else tables_url.rstrip("/"),
        about=about,
    )
    descriptor = write_descriptor(index, out, publication=publication)
    files, records = len(descriptor["distribution"]), len(descriptor["recordSet"])
    if as_json:
        summary = {"descriptor": str(out), "distribution": files, "record_sets": records}
        typer.echo(json.dumps(summary, indent=2))
    else:
        typer.echo(f"{out}: {files} files and sets of files, {counted(records, 'record set')}")


def _check(data: str | None, mapping: list[str], *, as_json: bool) -> None:
    if data is None:
        raise typer.BadParameter("no descriptor to check: name its file.", param_hint="DATA")
    from stereogenbench_data.bridges.croissant.check import check_descriptor

    places = {}
    for each in mapping:
        name, equals, path = each.partition("=")
        if not equals:
            raise typer.BadParameter(
                f"{each!r} is not ID=PATH, such as shards.tar=data/shards.tar.",
                param_hint="--map-file",
            )
        places[name] = Path(path)
    problems = check_descriptor(Path(data), mapping=places)
    if as_json:
        typer.echo(json.dumps({"descriptor": data, "problems": problems}, indent=2))
    else:
        for problem in problems:
            typer.echo(problem)
        typer.echo(f"{data}: {counted(len(problems), 'problem')}")
    if problems:
        raise typer.Exit(FINDINGS)


@grouped
def card(
    source: DataOptions,
    *,
    repository: Annotated[str, typer.Option("--repo", help="ORG/NAME on the Hub.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder to write README.md into [stdout].")
    ] = None,
    about: AboutOption = None,
) -> None:
    """Write the dataset card of shards, which the Hub shows and `datasets` reads.

    With --out, the rows that the Hub's viewer shows are written beside it, in `viewer/`.
    """
    from stereogenbench_data.bridges.card import card as card_text
    from stereogenbench_data.bridges.card import write_card
    from stereogenbench_data.index.table import SceneIndex

    index = SceneIndex.open(source.data, root=source.data_root)
    if out is None:
        typer.echo(card_text(index, repository=repository, about=about), nl=False)
        return
    with progress_bar("picturing", unit="scenes") as progress:
        path = write_card(index, out, repository=repository, about=about, progress=progress)
    typer.echo(str(path))


def upload(
    shards: Annotated[Path, typer.Argument(help="Folder of shards, as `pack` wrote it.")],
    repository: Annotated[str, typer.Argument(help="ORG/NAME of a dataset on the Hub.")],
    *,
    branch: Annotated[str, typer.Option(help="Branch to commit to.")] = "main",
    about: AboutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Upload shards with index, dataset card and Croissant descriptor (extra 'hub').

    The card and the descriptor are written into the folder first. Log in with `hf auth login`. To
    continue a stopped run, run it again.
    """
    from stereogenbench_data.bridges.upload import prepare_upload
    from stereogenbench_data.bridges.upload import upload as uploaded

    # The Hub's client has progress bars of its own.
    with progress_bar("picturing", unit="scenes") as progress:
        prepare_upload(shards, repository, about=about, progress=progress)
    report = uploaded(shards, repository, branch=branch, about=about)
    if as_json:
        typer.echo(json.dumps(asdict(report), indent=2))
        return
    typer.echo(f"{counted(report.files, 'file')}: StereoPairs({report.url!r})")
