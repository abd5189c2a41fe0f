"""``stereogenbench croissant``: write a descriptor of some data, or check one."""

import json
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from stereogenbench_data.cli.options import RootOption
from stereogenbench_data.schema.text import counted


def croissant(  # noqa: PLR0913 - one parameter an option
    data: Annotated[
        str | None,
        typer.Argument(
            help="Folder of shards, released tree, index file or URL; with --check, a descriptor. "
            "Left out: the public release in folders, as it stands on the Hub."
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
    name: Annotated[str | None, typer.Option(help="The dataset's name [StereoGenBench].")] = None,
    release: Annotated[
        str | None, typer.Option("--release", help="MAJOR.MINOR.PATCH of the data [1.0.0].")
    ] = None,
    published: Annotated[
        datetime | None,
        typer.Option(formats=["%Y-%m-%d"], help="Day of publication [today]."),
    ] = None,
    mapping: Annotated[
        list[str] | None,
        typer.Option("--map-file", help="ID=PATH with --check: where a file named by URL lies."),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Report as JSON; with --check the findings.")
    ] = False,
) -> None:
    """Write a Croissant 1.1 descriptor with responsible-AI fields, or check one.

    The check reads what `mlcroissant validate` does not: files, checksums, columns, references,
    names and the context.
    """
    if check:
        _check(data, mapping or [], as_json=as_json)
        return
    if out is None:
        raise typer.BadParameter("name the descriptor to write: -o FILE", param_hint="--out")
    from stereogenbench_data.bridges import about
    from stereogenbench_data.bridges.croissant.descriptor import Publication, write_descriptor
    from stereogenbench_data.index.table import SceneIndex

    index = None if data is None else SceneIndex.open(data, root=data_root)
    publication = Publication(
        name=name or about.TITLE,
        version=release or about.VERSION,
        published=None if published is None else published.date(),
        data_url=None if base_url is None else base_url.rstrip("/"),
        tables_url=None if tables_url is None else tables_url.rstrip("/"),
    )
    descriptor = write_descriptor(index, out, publication=publication)
    files, records = len(descriptor["distribution"]), len(descriptor["recordSet"])
    if as_json:
        told = {"descriptor": str(out), "distribution": files, "record_sets": records}
        typer.echo(json.dumps(told, indent=2))
    else:
        typer.echo(f"{out}: {files} files and sets of files, {counted(records, 'record set')}")


def _check(data: str | None, mapping: list[str], *, as_json: bool) -> None:
    if data is None:
        raise typer.BadParameter("name the descriptor to check", param_hint="DATA")
    from stereogenbench_data.bridges.croissant.check import check_descriptor

    places = {}
    for each in mapping:
        name, equals, path = each.partition("=")
        if not equals:
            raise typer.BadParameter(f"{each!r} is not ID=PATH", param_hint="--map-file")
        places[name] = Path(path)
    problems = check_descriptor(Path(data), mapping=places)
    if as_json:
        typer.echo(json.dumps({"descriptor": data, "problems": problems}, indent=2))
    else:
        for problem in problems:
            typer.echo(problem)
        typer.echo(f"{data}: {counted(len(problems), 'problem')}")
    if problems:
        raise typer.Exit(1)
