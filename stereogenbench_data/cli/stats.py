"""``stereogenbench stats``: the paper's tables for any data, from their index alone."""

import json
from dataclasses import asdict
from typing import Any

from stereogenbench_data.cli.options import (
    JsonOption,
    OutOption,
    SceneOptions,
    SourceOptions,
    grouped,
)
from stereogenbench_data.cli.writing import print_and_write


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
    document = asdict(found) | {"paper": [asdict(line) | {"agrees": line.agrees} for line in lines]}
    print_and_write(
        screen(found, lines),
        text=statistics_markdown(found, lines),
        document=json.dumps(document, indent=1),
        out=out,
        as_json=as_json,
    )
