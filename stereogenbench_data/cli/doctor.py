"""``stereogenbench doctor``: find the depth encoding from the pictures."""

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
    beside the others. The declared contract is that of the files and of --conventions FILE. It
    prints text; --out also writes it to a file (as JSON if the name ends with .json). The exit
    status is 0 if the declared contract fits or the pictures cannot tell, 1 if another one is
    clearly better or a camera does not fit, 2 if the command failed.

    Example: `stereogenbench doctor scenes/ -o doctor.txt`
    """
    from stereogenbench_data.audit.contract.doctor import diagnose
    from stereogenbench_data.audit.contract.report import doctor_json, doctor_lines, screen

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
    document, text = json.dumps(doctor_json(report), indent=2), "\n".join(doctor_lines(report))
    print_and_write(screen(report), text=text, document=document, out=out, as_json=as_json)
    if report.is_wrong:
        raise typer.Exit(FINDINGS)
