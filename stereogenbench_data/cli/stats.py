"""``stereogenbench stats``: the paper's tables for any data, from their index alone."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from stereogenbench_data.cli.options import DataOptions, JsonOption, SceneOptions, grouped
from stereogenbench_data.cli.writing import write_report, writing


@grouped
def stats(
    source: DataOptions,
    *,
    chosen: SceneOptions,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="File to write, .md or .json; or a folder for the page and histograms (extra "
            "'plots').",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Count scenes, maps, baselines and focal lengths.

    The tables are the paper's; its figures stand beside whole splits. It reads only the index.

    Example: `stereogenbench stats shards/ -o stats/`
    """
    from stereogenbench_data.audit.statistics import statistics
    from stereogenbench_data.audit.statistics_report import (
        compared,
        statistics_markdown,
        write_plots,
    )

    index, filters = source.open(), chosen.filters()
    found = statistics(index, **filters)
    lines = compared(found)
    document = found.to_json() | {
        "paper": [asdict(line) | {"agrees": line.agrees} for line in lines]
    }
    text = json.dumps(document, indent=1)
    markdown = statistics_markdown(found, lines)
    if out is not None and not out.suffix:
        with writing(out):
            for path in write_plots(index, out, **filters):
                typer.echo(str(path), err=True)
        out = out / "stats.md"
    if out is not None:
        write_report(out, text if out.suffix == ".json" else markdown)
    typer.echo(text if as_json else markdown.rstrip())
