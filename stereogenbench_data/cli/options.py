"""Options that several commands share: which scenes, JSON output, worker processes."""

from pathlib import Path
from typing import Annotated, Any

import typer

DataArgument = Annotated[
    str, typer.Argument(help="Released tree, folder of shards, index file, or the URL of either.")
]
SplitOption = Annotated[str | None, typer.Option("--split", help="train or eval.")]
SubsetOption = Annotated[
    str | None, typer.Option("--subset", help="seen_map or unseen_map (of eval scenes).")
]
FamilyOption = Annotated[
    list[str] | None, typer.Option("--family", help="Baseline family; may be given again.")
]
MapOption = Annotated[list[str] | None, typer.Option("--map", help="Map; may be given again.")]
SceneOption = Annotated[
    list[str] | None, typer.Option("--scene", help="Key of a scene; may be given again.")
]
FocalOption = Annotated[
    tuple[float, float] | None,
    typer.Option("--focal-mm", help="Shortest and longest focal length, in mm."),
]
CaptionOption = Annotated[
    str | None, typer.Option("--caption", help="Words that must all be in the description.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Report as JSON on stdout.")]
WorkersOption = Annotated[int | None, typer.Option(min=1, help="Processes [one a core].")]
OutOption = Annotated[Path | None, typer.Option("--out", "-o", help="File to write.")]


def scene_filters(**options: Any) -> dict[str, Any]:
    """Return the filters that were given, by their names in `SceneFilters`, to pass as keywords.

    Args:
        **options: split, subset, family, map, scenes, focal_mm, caption as the options give them;
            what is None or empty is left out.
    """
    return {name: value for name, value in options.items() if value not in (None, [], ())}
