"""``stereogenbench synth``: generate scenes in the released layout, without Unreal."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stereogenbench_data.cli.options import (
    OutArgument,
    PartOption,
    WorkOptions,
    grouped,
    option,
    size_of,
)
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.schema.release import FAMILIES, FRAME_COUNT, IMAGE_SIZE_PX, Split, Subset
from stereogenbench_data.schema.text import counted

if TYPE_CHECKING:
    from stereogenbench_data.synthesis.renderer import Renderer


@grouped
def synth(  # noqa: PLR0913 - one parameter an option
    out: OutArgument,
    *,
    family: Annotated[str, option(f"Family of baselines: {', '.join(FAMILIES)}.")] = FAMILIES[0],
    scenes: Annotated[int, option("Number of scenes; they are numbered from 0.")] = 1,
    size: Annotated[
        Any, option("Width x height, both even; N is NxN.", parser=size_of, metavar="WxH")
    ] = str(IMAGE_SIZE_PX),
    frames: Annotated[int, option("Frames, at 15 Hz.")] = FRAME_COUNT,
    seed: Annotated[int, option("Seed of all that is random.")] = 0,
    split: Annotated[Split, option("Pairwise_Uniform is only in train.")] = "train",
    subset: Annotated[Subset, option("Kind of maps; used in eval.")] = "seen_map",
    map_name: Annotated[
        list[str] | None,
        option(
            "--map",
            "Map, and folder of the scenes; given again, or 'all', each proposal draws one "
            "[SynthStage; all of the assets].",
        ),
    ] = None,
    focal_mm: Annotated[
        float | None, option("Focal length, mm [random, 18 to 85, for each scene].")
    ] = None,
    depth_unit_m: Annotated[float, option("Metres in a stored unit.")] = 0.001,
    assets: Annotated[
        Path | None,
        option("assets.toml of your own maps and characters, for Blender [the built-in maps]."),
    ] = None,
    part: PartOption = "1/1",
    work: WorkOptions,
) -> None:
    """Generate scenes with exact depth, poses and intrinsics, in the released layout.

    Proposals of subject, lens, rig and path are examined until one passes the filters; that one is
    rendered and checked. To continue a stopped run, run it again: it keeps the scenes of the same
    request. Scene i is the same for any number of scenes, workers and parts.

    Example: `stereogenbench synth scenes/ --family Uniform --scenes 4 --size 256`
    """
    from stereogenbench_data.synthesis.produce import synthesise
    from stereogenbench_data.synthesis.render import RAY_CASTING
    from stereogenbench_data.synthesis.request import ExportContract, SynthRequest

    if map_name is not None and "all" in map_name and len(map_name) > 1:
        raise typer.BadParameter(
            "'all' is all maps: give it alone, or name maps without it.", param_hint="--map"
        )
    chosen: Renderer = RAY_CASTING
    if assets is not None:
        from stereogenbench_data.synthesis.blender.renderer import BlenderRenderer

        chosen = BlenderRenderer.from_file(assets)
    everywhere = map_name == ["all"] or (map_name is None and assets is not None)
    request = SynthRequest(
        family=family,
        scenes=scenes,
        size_px=size[1],
        height_px=size[0],
        frames=frames,
        seed=seed,
        split=split,
        subset=subset,
        map_name=chosen.maps if everywhere else tuple(map_name or ["SynthStage"]),
        focal_mm=focal_mm,
        contract=ExportContract(depth_unit_m=depth_unit_m),
    )
    how = work.options()
    with progress_bar("drawing", unit="frames") as progress:
        keys = synthesise(out, request, renderer=chosen, part=part, progress=progress, **how)
    folders = sorted({key.rpartition("/")[0] for key in keys})
    none = f" (part {part[0]}/{part[1]} of {scenes} has none)"
    where = f" in {', '.join(folders)}" if folders else none
    typer.echo(f"{out}: {counted(len(keys), 'scene')}{where}")
