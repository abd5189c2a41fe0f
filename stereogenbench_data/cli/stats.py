"""``stereogenbench stats``: the paper's tables for any data, from their index alone."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer

from stereogenbench_data.cli.errors import FINDINGS
from stereogenbench_data.cli.options import (
    DataOptions,
    JsonOption,
    OutOption,
    SceneOptions,
    grouped,
)
from stereogenbench_data.cli.writing import write_report, writing


@grouped
def stats(
    source: DataOptions,
    *,
    chosen: SceneOptions,
    compare: Annotated[
        Literal["auto", "always", "never"],
        typer.Option(help="Show the paper's figures; auto: beside whole splits."),
    ] = "auto",
    plots: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for histograms (extra 'plots')."),
    ] = None,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Count scenes, maps, baselines and focal lengths.

    The tables are the paper's. It reads only the index. With --compare always, the exit status is 1
    if a figure differs from the paper's.
    """
    from stereogenbench_data.audit.paper_numbers import SPLITS
    from stereogenbench_data.audit.statistics import statistics
    from stereogenbench_data.audit.statistics_report import (
        compared,
        release_sized_splits,
        statistics_markdown,
        write_plots,
    )

    index, filters = source.open(), chosen.filters()
    found = statistics(index, **filters)
    splits = {"always": tuple(SPLITS), "never": ()}.get(compare)
    lines = compared(found, splits=release_sized_splits(found) if splits is None else splits)
    document = found.to_json() | {
        "paper": [asdict(line) | {"agrees": line.agrees} for line in lines]
    }
    text = json.dumps(document, indent=1)
    markdown = statistics_markdown(found, lines)
    if out is not None:
        write_report(out, text if out.suffix == ".json" else markdown)
    typer.echo(text if as_json else markdown.rstrip())
    if plots is not None:
        with writing(plots):
            written = write_plots(index, plots, **filters)
        for path in written:
            typer.echo(str(path), err=True)
    if compare == "always" and not all(line.agrees for line in lines):
        raise typer.Exit(FINDINGS)
