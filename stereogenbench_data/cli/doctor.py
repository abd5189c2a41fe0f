"""``stereogenbench doctor``: find the depth contract from the pictures."""

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
from stereogenbench_data.cli.writing import writing


@grouped
def doctor(  # noqa: PLR0913 - one parameter an option
    source: DataOptions,
    *,
    scenes: Annotated[int, option("Scenes to look at.", min=1)] = 6,
    per_scene: Annotated[int, option("Frames of each scene.", min=1)] = 4,
    chosen: SceneOptions,
    out: OutOption = None,
    as_json: JsonOption = False,
    work: WorkOptions,
) -> None:
    """Find from the pictures how stored depth becomes metres.

    The doctor compares what the cameras of a scene see with what depth predicts: planar or ray,
    inverse, frame lag, camera order, flips, unit / (focal length x baseline), and each camera
    beside the others. The declared contract is that of the files and of --conventions FILE. -o
    writes a picture. The exit status is 0 if the declared contract
    fits or the pictures cannot tell, 1 if another one is clearly better or a camera does not fit,
    2 if the command failed.

    Example: `stereogenbench doctor scenes/ -o doctor.png`
    """
    from stereogenbench_data.audit.contract.doctor import diagnose
    from stereogenbench_data.audit.contract.report import doctor_json, doctor_lines, draw_report

    if out is not None and out.suffix.lower() != ".png":
        raise typer.BadParameter(f"{out}: name a picture, *.png.", param_hint="--out")
    filters: Any = chosen.filters()
    index = source.open()
    with progress_bar("examining", unit="scenes") as progress:
        report = diagnose(
            index,
            scenes=scenes,
            frames=per_scene,
            **work.options(),
            progress=progress,
            filters=filters,
        )
    document = json.dumps(doctor_json(report), indent=2) if as_json else None
    typer.echo(document or "\n".join(doctor_lines(report)))
    if out is not None:
        with writing(out):
            draw_report(out, report, index)
        typer.echo(f"\npicture: {out}", err=as_json)
    if report.is_wrong:
        raise typer.Exit(FINDINGS)
