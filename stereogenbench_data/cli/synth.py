"""``stereogenbench synth``: draw scenes in the released layout, without Unreal."""

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from stereogenbench_data.cli.errors import resumable
from stereogenbench_data.cli.options import (
    JsonOption,
    WorkOptions,
    complete_from,
    grouped,
)
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.schema.release import (
    FAMILIES,
    FRAME_COUNT,
    IMAGE_SIZE_PX,
    Split,
    Subset,
)
from stereogenbench_data.schema.text import counted

RotationForm = Literal["rotator", "quaternion_xyzw", "quaternion_wxyz", "matrix"]
"""The same as in `synthesis.request`, which the help does not import."""


@grouped
@resumable()
def synth(  # noqa: PLR0913 - one parameter an option
    out: Annotated[Path, typer.Argument(help="Folder to write train/ or eval/ into.")],
    *,
    family: Annotated[
        str,
        typer.Option(
            help=f"Family of baselines: {', '.join(FAMILIES)}.",
            autocompletion=complete_from(FAMILIES),
        ),
    ] = FAMILIES[0],
    scenes: Annotated[int, typer.Option(help="Number of scenes; they are numbered from 0.")] = 1,
    size: Annotated[int, typer.Option(help="Width and height, even.")] = IMAGE_SIZE_PX,
    frames: Annotated[int, typer.Option(help="Frames, at 15 Hz.")] = FRAME_COUNT,
    seed: Annotated[int, typer.Option(help="Seed of all that is random.")] = 0,
    split: Annotated[Split, typer.Option(help="Pairwise_Uniform is only in train.")] = "train",
    subset: Annotated[Subset, typer.Option(help="Kind of maps; used in eval.")] = "seen_map",
    map_name: Annotated[str, typer.Option("--map", help="Folder of the scenes.")] = "SynthStage",
    focal_mm: Annotated[
        float | None, typer.Option(help="Focal length, mm [random, 18 to 85, for each scene].")
    ] = None,
    depth_unit_m: Annotated[float, typer.Option(help="Metres in a stored unit.")] = 0.001,
    depth_tag: Annotated[
        str, typer.Option(help="Name of the tag that states the unit; '' writes none.")
    ] = "DEPTH_SCALE",
    rotation: Annotated[
        RotationForm, typer.Option(help="How trajectory.json records rotations.")
    ] = "rotator",
    work: WorkOptions,
    as_json: JsonOption = False,
) -> None:
    """Draw scenes with exact depth, poses and intrinsics, in the released layout.

    To continue a stopped run, run it again: it keeps the scenes that the same request wrote. Scene
    i is the same for any number of scenes and workers.
    """
    from stereogenbench_data.synthesis.produce import synthesise
    from stereogenbench_data.synthesis.request import ExportContract, SynthRequest

    request = SynthRequest(
        family=family,
        scenes=scenes,
        size_px=size,
        frames=frames,
        seed=seed,
        split=split,
        subset=subset,
        map_name=map_name,
        focal_mm=focal_mm,
        contract=ExportContract(
            rotation=rotation, depth_unit_m=depth_unit_m, depth_tag=depth_tag or None
        ),
    )
    with progress_bar("drawing", unit="frames") as progress:
        keys = synthesise(out, request, progress=progress, **work.options())
    if as_json:
        typer.echo(json.dumps({"root": str(out), "scenes": keys}, indent=2))
    else:
        folders = sorted({key.rpartition("/")[0] for key in keys})
        typer.echo(f"{out}: {counted(len(keys), 'scene')} in {', '.join(folders)}")
