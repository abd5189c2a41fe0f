"""``stereogenbench stats``: the paper's tables for any data, from their index alone."""

import json
from dataclasses import asdict
from typing import Any

import typer

from stereogenbench_data.cli.options import (
    JsonOption,
    OutOption,
    SceneOptions,
    SourceOptions,
    grouped,
)
from stereogenbench_data.cli.screen import print_report
from stereogenbench_data.cli.writing import write_report


@grouped
def stats(
    source: SourceOptions,
    *,
    chosen: SceneOptions,
    out: OutOption = None,
    as_json: JsonOption = False,
) -> None:
    """Count scenes, maps, baselines and focal lengths.

    The tables are the paper's; its figures stand beside whole splits. It reads only the index.

    Example: `stereogenbench stats shards/ -o stats.md`
    """
    from stereogenbench_data.audit.statistics import (
        compared,
        screen,
        statistics,
        statistics_markdown,
    )

    filters: Any = chosen.filters()
    found = statistics(source.open(), **filters)
    lines = compared(found)
    document = found.to_json() | {"paper": [asdict(line) for line in lines]}
    text = json.dumps(document, indent=1)
    markdown = statistics_markdown(found, lines)
    if as_json:
        typer.echo(text)
    else:
        rest = f"Whole report: {out}" if out else "-o FILE.md writes the whole report."
        print_report(*screen(found, lines), whole=markdown, rest=rest)
    if out is not None:
        write_report(out, text if out.suffix == ".json" else markdown)
