"""``stereogenbench index``: walk a released tree once, and keep what training asks of it."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import Console

from stereogenbench_data.cli.options import (
    EngineOption,
    FamilyOption,
    JsonOption,
    MapOption,
    SplitOption,
    workers_option,
)
from stereogenbench_data.cli.outcome import FINDINGS, resumable
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.writing import writing
from stereogenbench_data.schema.text import counted, plain_line

if TYPE_CHECKING:
    from stereogenbench_data.schema.records import SceneId

_INDEX_NAME = "index.parquet"


@resumable()
def index(  # noqa: PLR0913 - one parameter an option
    root: Annotated[
        str, typer.Argument(help="Folder that holds train/ and eval/, or its URL (hf://, s3://).")
    ],
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help=f"Index file to write [ROOT/{_INDEX_NAME}; for a URL here]."
        ),
    ] = None,
    workers: Annotated[int | None, workers_option("Processes that read scenes")] = None,
    engine: EngineOption = "local",
    valid_depth: Annotated[
        bool,
        typer.Option(
            "--valid-depth",
            help="Decode a few depth pictures of each scene, to be able to select by the share "
            "of measured pixels.",
        ),
    ] = False,
    split: SplitOption = None,
    family: FamilyOption = None,
    map_name: MapOption = None,
    as_json: JsonOption = False,
) -> None:
    """Index a released tree, so that it opens at once.

    The walk goes on where it stopped if it is run again after an interruption. Incomplete scenes
    are listed and left out. Broken ones too, and then the exit status is 1. With --split,
    --family or --map only such scenes are read.
    """
    from stereogenbench_data.engine import engine_of
    from stereogenbench_data.index.build import scene_journal, walk
    from stereogenbench_data.index.parquet import recorded_root
    from stereogenbench_data.index.table import SceneIndex
    from stereogenbench_data.sources.location import is_remote, local_path, shown

    console = Console(stderr=True)
    place = "." if is_remote(root) else root
    target = Path(place, _INDEX_NAME) if out is None else out
    mode: Literal["skip", "sample"] = "sample" if valid_depth else "skip"
    wanted = _passing(split, family or [], map_name or [])
    if wanted is not None and out is None:
        raise typer.BadParameter(
            "the index of a part needs a file of its own: name it with --out FILE.",
            param_hint="--out",
        )
    if target.is_dir():
        raise typer.BadParameter(
            f"{target} is a folder: name a file, such as {target / _INDEX_NAME}.",
            param_hint="--out",
        )
    if target.exists() and not target.is_file():
        raise typer.BadParameter(
            f"{target} is not a regular file, and an index would replace it.", param_hint="--out"
        )
    recorded_root(root, beside=target.parent)  # before hours of work, whether it may be written
    done_before = target.with_name(f"{target.name}.journal")
    with (
        writing(done_before),
        scene_journal(done_before, walk=f"{_whole(root)} valid_depth={mode}") as journal,
        progress_bar("indexing", unit="scenes") as progress,
    ):
        report = walk(
            root,
            workers=workers,
            engine=engine_of(engine),
            progress=progress,
            journal=journal,
            valid_depth=mode,
            wanted=wanted,
        )
        if report.scenes:
            SceneIndex.from_report(report).write(target)
            journal.delete()
    if as_json:
        found = {"scenes": len(report.scenes), "incomplete": dict(report.incomplete)}
        found |= {"broken": dict(report.broken), "notes": list(report.notes)}
        written = {"index": str(target) if report.scenes else None}
        typer.echo(json.dumps(written | found, indent=2))
        raise typer.Exit(FINDINGS if report.broken or not report.scenes else 0)
    _list(console, "incomplete, left out", report.incomplete)
    _list(console, "broken, left out", report.broken)
    _list(console, "to know", {note: note for note in report.notes})
    if not report.scenes:
        console.print(
            f"{plain_line(shown(root))}: no scene is whole, so there is nothing to index",
            markup=False,
        )
        raise typer.Exit(FINDINGS)
    typer.echo(f"{target}: {counted(len(report.scenes), 'scene')}")
    if not is_remote(root) and target.parent.resolve() != local_path(root).resolve():
        console.print(
            f"its data are not beside it: open it as SceneIndex.open({str(target)!r}, "
            f"root={_whole(root)!r}), or with --root {_whole(root)}",
            markup=False, highlight=False, soft_wrap=True,
        )  # fmt: skip
    if report.broken:
        raise typer.Exit(FINDINGS)


def _whole(root: str) -> str:
    from stereogenbench_data.sources.location import is_remote, local_path, shown

    return shown(root) if is_remote(root) else str(local_path(root).resolve())


def _passing(
    split: str | None, families: list[str], maps: list[str]
) -> "Callable[[SceneId], bool] | None":
    """Return whether a scene is asked for, by what its path says."""
    if not (split or families or maps):
        return None
    return lambda scene: (
        (not split or scene.split == split)
        and (not families or scene.family in families)
        and (not maps or scene.map_name in maps)
    )


def _list(console: Console, title: str, reasons: Mapping[str, str]) -> None:
    if reasons:
        console.print(f"{len(reasons)} {title}:", style="bold", highlight=False)
    for key, reason in reasons.items():
        text = reason if key in reason else f"{key}: {reason}"
        console.print(f"  {plain_line(text)}", markup=False, highlight=False, soft_wrap=True)
