"""``stereogenbench audit``: are these data right? The paper's geometry table for any data."""

import json
from typing import Annotated, Any

import typer

from stereogenbench_data.cli.errors import FINDINGS
from stereogenbench_data.cli.options import (
    DataOptions,
    JsonOption,
    OutOption,
    SceneOptions,
    WorkOptions,
    grouped,
    option,
)
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.writing import print_and_write

_ALL = "all"


@grouped
def audit(  # noqa: PLR0913 - one parameter an option
    source: DataOptions,
    *,
    scenes: Annotated[int | None, option("Scenes to audit, evenly spread [all].", min=1)] = None,
    per_scene: Annotated[
        str, option("Frames of each scene; all, as in the paper.", metavar="N|all")
    ] = "5",
    chosen: SceneOptions,
    out: OutOption = None,
    as_json: JsonOption = False,
    work: WorkOptions,
) -> None:
    """Measure whether data are right; list what is wrong.

    The audit compares intrinsics, baselines, poses and depth with each other, as the paper's audit
    does, and shows the paper's figures beside. It counts frames and looks for dark, flat and
    frozen pictures, invalid depth and occluders at the border. It prints Markdown; --out also
    writes it to a file (as JSON if the name ends with .json). To continue a stopped audit, run it
    again. The exit status is 1 if anything exceeds its limit.

    Example: `stereogenbench audit shards/ --scenes 20 -o audit.md`
    """
    from stereogenbench_data.audit.geometry import audit as geometry_audit
    from stereogenbench_data.audit.geometry.table import audit_markdown, screen

    if out is not None and out.is_dir():
        raise typer.BadParameter(
            f"{out} is a folder: name a file, such as {out / 'audit.md'}.", param_hint="--out"
        )
    if per_scene != _ALL and not (per_scene.isdecimal() and int(per_scene) > 0):
        raise typer.BadParameter(
            f"{per_scene!r} is neither a number of frames, such as 5, nor 'all'.",
            param_hint="--per-scene",
        )
    frames = 0 if per_scene == _ALL else int(per_scene)
    options: Any = chosen.filters() | work.options()
    with progress_bar("reading the index", unit="scenes") as progress:
        index = geometry_audit.open_for_audit(
            source.data,
            root=source.data_root,
            progress=progress,
            conventions=source.stated(),
            **options,
        )
    with progress_bar("auditing", unit="frames") as progress:
        report = geometry_audit.audit(
            index, sample=scenes, frames=frames, progress=progress, **options
        )
    document, text = json.dumps(report.to_json(), indent=1), audit_markdown(report)
    print_and_write(screen(report), text=text, document=document, out=out, as_json=as_json)
    if report.findings:
        raise typer.Exit(FINDINGS)
