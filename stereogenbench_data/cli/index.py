"""``stereogenbench index``: walk a released tree once, so that it opens at once afterwards."""

import json
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryFile
from typing import Annotated, Any

import typer

from stereogenbench_data.cli.data import full_place
from stereogenbench_data.cli.errors import FINDINGS
from stereogenbench_data.cli.options import (
    ConventionsOption,
    JsonOption,
    RootArgument,
    SceneOptions,
    WorkOptions,
    flag,
    grouped,
    option,
)
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.screen import print_report
from stereogenbench_data.errors import explain_os_errors
from stereogenbench_data.schema.text import counted, plain_line

_INDEX_NAME = "index.parquet"
_LEFT_OUT = ("incomplete", "broken", "odd", "notes")
"""What a walk reports besides its scenes."""


@grouped
def index(  # noqa: PLR0913 - one parameter an option
    root: RootArgument,
    *,
    out: Annotated[
        Path | None,
        option("--out", "-o", f"Index file to write [ROOT/{_INDEX_NAME}; for a URL here]."),
    ] = None,
    work: WorkOptions,
    valid_depth: Annotated[
        bool, flag("--valid-depth", "Measure the share of valid depth, to select by it.")
    ] = False,
    checksums: Annotated[
        bool, flag("--checksums", "Read all files through, so that damage is seen later.")
    ] = False,
    chosen: SceneOptions,
    conventions: ConventionsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Index a released tree, so that it opens at once.

    After an interruption, run the same command again to continue. Incomplete and broken scenes are
    listed and left out, odd ones listed; the exit status is 1 if a scene is broken. --split and
    --where family=NAME or map=NAME restrict which scenes are read.

    Example: `stereogenbench index scenes/`
    """
    from stereogenbench_data.index.build import FORMAT_CURE, ManyReadsWarning, walk
    from stereogenbench_data.index.parquet import recorded_root
    from stereogenbench_data.index.table import SceneIndex
    from stereogenbench_data.schema.conventions import Conventions
    from stereogenbench_data.sources.location import is_remote, local_path, shown

    target = out or Path("." if is_remote(root) else root, _INDEX_NAME)
    wanted = chosen.by_path()
    if wanted is not None and out is None:
        raise typer.BadParameter(
            "the index of a part needs its own file: name it with --out FILE.", param_hint="--out"
        )
    if target.exists() and not target.is_file():
        raise typer.BadParameter(
            f"{target} is not a regular file: name one, such as {target / _INDEX_NAME}.",
            param_hint="--out",
        )
    # A root or a folder that cannot be used is refused before hours of work.
    recorded_root(root, beside=target.parent)
    there = next(folder for folder in target.absolute().parents if folder.is_dir())
    cure = "Choose another place with --out."
    with explain_os_errors(f"{target}: the index cannot be written", cure):
        TemporaryFile(dir=there).close()
    stated = None if conventions is None else Conventions.read(conventions)
    with warnings.catch_warnings(), progress_bar("indexing", unit="scenes") as progress:
        warnings.simplefilter("always", ManyReadsWarning)
        warnings.showwarning = lambda told, *_: _tell(str(told))
        report = walk(
            root,
            **work.options(),
            progress=progress,
            valid_depth="sample" if valid_depth else "skip",
            checksums="all" if checksums else "none",
            wanted=wanted,
            conventions=stated,
        )
        if report.scenes:
            SceneIndex.from_report(report).write(target)
    status = FINDINGS if report.broken or not report.scenes else 0
    if as_json:
        document: dict[str, Any] = {"index": str(target) if report.scenes else None}
        document["scenes"] = len(report.scenes)
        document |= {name: getattr(report, name) for name in _LEFT_OUT}
        typer.echo(json.dumps(document, indent=2))
        raise typer.Exit(status)
    made = (
        f"{target}: {counted(len(report.scenes), 'scene')}" if report.scenes
        else f"{shown(root)}: no scene is complete, so there is nothing to index"
    )  # fmt: skip
    lists = [
        (title, lines)
        for title, lines in (
            (f"{len(report.broken)} broken, left out", _reasons(report.broken)),
            (f"{len(report.incomplete)} incomplete, left out", _reasons(report.incomplete)),
            (f"{len(report.odd)} odd, left out where that is needed", _reasons(report.odd)),
            (counted(len(report.notes), "note"), list(report.notes)),
        )
        if lines
    ]
    if not (sys.stdout.isatty() and sys.stderr.isatty()):
        for title, lines in lists:
            _tell(f"{title}:", *(f"  {line}" for line in lines))
    if lists and sys.stdout.isatty():
        verdict = "; ".join([made, *(title for title, _ in lists)])
        tables = [("", [(title,), *([line] for line in lines)]) for title, lines in lists]
        print_report(verdict, tables, whole="", rest="--json prints all that was left out.")
    else:
        typer.echo(plain_line(made), err=not report.scenes)
    if report.broken and not report.scenes:
        _tell(FORMAT_CURE.format(root=shown(root)))
    is_apart = is_remote(root) or target.parent.resolve() != local_path(root).resolve()
    if report.scenes and is_apart:
        _tell(
            f"its data are not beside it: open it as SceneIndex.open({str(target)!r}, "
            f"root={full_place(root)!r}), or with --root {full_place(root)}"
        )
    raise typer.Exit(status)


def _reasons(scenes: Mapping[str, str]) -> list[str]:
    """Return lines that say why scenes were left out: each reason once, with all its scenes."""
    from stereogenbench_data.index.left_out import by_reason

    lines: list[str] = []
    for keys in by_reason(scenes):
        reason = scenes[keys[0]]
        lines += (reason if keys[0] in reason else f"{keys[0]}: {reason}").splitlines()
        lines += [f"likewise {key}" for key in keys[1:]]
    return lines


def _tell(*lines: str) -> None:
    typer.echo("\n".join(map(plain_line, lines)), err=True)
