"""Options that several commands share: which scenes, JSON output, worker processes."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from stereogenbench_data.schema.release import FAMILIES, TRAIN_MAPS, UNSEEN_MAPS


def complete_from(values: Iterable[str]) -> Callable[[str], list[str]]:
    """Return what a shell's completion asks: which of the values begin with what was typed."""
    known = sorted(values)
    return lambda incomplete: [
        value for value in known if value.lower().startswith(incomplete.lower())
    ]


def complete_scene(context: typer.Context, incomplete: str) -> list[str]:
    """Return the keys of scenes that begin with what was typed, where DATA has an index."""
    from stereogenbench_data.errors import StereoGenBenchError
    from stereogenbench_data.index.parquet import INDEX_NAME
    from stereogenbench_data.index.table import SceneIndex

    # Before an option without its value yet, the arguments are parsed but not assigned.
    data = Path(str(context.params.get("data") or next(iter(context.args), "")))
    if not (data.is_file() or (data / INDEX_NAME).is_file()):
        return []
    try:
        keys = SceneIndex.open(data).column("key")
    except StereoGenBenchError:
        return []
    return complete_from(map(str, keys))(incomplete)


DataArgument = Annotated[
    str, typer.Argument(help="Released tree, folder of shards, index file, or the URL of either.")
]
RootOption = Annotated[
    str | None,
    typer.Option(
        "--root",
        help="Root of an index file's data, on your word, where they are not beside it and it "
        "names no plain URL.",
    ),
]
SplitOption = Annotated[
    str | None,
    typer.Option("--split", help="train or eval.", autocompletion=complete_from(("train", "eval"))),
]
SubsetOption = Annotated[
    str | None,
    typer.Option(
        "--subset",
        help="seen_map or unseen_map (of eval scenes).",
        autocompletion=complete_from(("seen_map", "unseen_map")),
    ),
]
FamilyOption = Annotated[
    list[str] | None,
    typer.Option(
        "--family",
        help="Baseline family; may be given again.",
        autocompletion=complete_from(FAMILIES),
    ),
]
MapOption = Annotated[
    list[str] | None,
    typer.Option(
        "--map",
        help="Map; may be given again.",
        autocompletion=complete_from(TRAIN_MAPS | UNSEEN_MAPS),
    ),
]
SceneOption = Annotated[
    list[str] | None,
    typer.Option(
        "--scene", help="Key of a scene; may be given again.", autocompletion=complete_scene
    ),
]
FocalOption = Annotated[
    tuple[float, float] | None,
    typer.Option("--focal-mm", help="Shortest and longest focal length, in mm."),
]
CaptionOption = Annotated[
    str | None, typer.Option("--caption", help="Words that must all be in the description.")
]
DepthUnitOption = Annotated[
    float | None,
    typer.Option(
        "--depth-unit-m",
        help="Metres in a stored unit of depth, whatever the files state [their own tag].",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Report as JSON on stdout.")]
WorkersOption = Annotated[int | None, typer.Option(min=1, help="Processes [one a core].")]
EngineOption = Annotated[
    str,
    typer.Option(
        "--engine",
        help="local: processes here; ray: the Ray cluster of RAY_ADDRESS or of this machine "
        "(extra 'ray'); ray://HOST:PORT or HOST:PORT: the one there.",
        autocompletion=complete_from(("local", "ray")),
    ),
]
OutOption = Annotated[Path | None, typer.Option("--out", "-o", help="File to write.")]


def scene_filters(**options: Any) -> dict[str, Any]:
    """Return the filters that were given, by their names in `SceneFilters`, to pass as keywords.

    Args:
        **options: split, subset, family, map, scenes, focal_mm, caption as the options give them;
            what is None or empty is left out.
    """
    return {name: value for name, value in options.items() if value not in (None, [], ())}
