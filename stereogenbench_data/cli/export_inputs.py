"""``stereogenbench export-inputs``: what methods of a tier are given, and nothing more."""

from pathlib import Path
from typing import Annotated

import typer

from stereogenbench_data.cli.evaluation_options import (
    PAPER_SIZE,
    BaselineOption,
    FramesOption,
    PairsOption,
    SizeOption,
    TierOption,
    parse_frames_option,
    parse_pairs,
    parse_size,
)
from stereogenbench_data.cli.opening import open_data
from stereogenbench_data.cli.options import (
    CaptionOption,
    DataArgument,
    DepthUnitOption,
    FamilyOption,
    FocalOption,
    MapOption,
    RootOption,
    SceneOption,
    SplitOption,
    SubsetOption,
    WorkersOption,
    scene_filters,
)
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.stopping import STOPPED
from stereogenbench_data.schema.text import counted


def export_inputs(  # noqa: PLR0913 - one parameter an option
    data: DataArgument,
    out: Annotated[Path, typer.Argument(help="Folder to write into.")],
    *,
    data_root: RootOption = None,
    tier: TierOption,
    split: SplitOption = None,
    subset: SubsetOption = None,
    family: FamilyOption = None,
    map_name: MapOption = None,
    scene: SceneOption = None,
    focal_mm: FocalOption = None,
    caption: CaptionOption = None,
    pairs: PairsOption = "primary",
    frames: FramesOption = "all",
    baseline_cm: BaselineOption = None,
    size: SizeOption = PAPER_SIZE,
    depth_unit_m: DepthUnitOption = None,
    workers: WorkersOption = None,
) -> None:
    """Write the inputs of a tier: left views as PNG; G0 adds geometry, G1 the camera.

    One folder an item, a pair of a scene, with a name that tells neither. Write what the method
    makes of it as PREDICTIONS/ITEM/000.png ... or PREDICTIONS/ITEM.mp4, then run `stereogenbench
    evaluate` with the same selection. A stopped run goes on if it is run again.
    """
    from stereogenbench_data.evaluation.inputs import export_inputs as exported
    from stereogenbench_data.schema.records import DepthEncoding

    options = scene_filters(
        split=split,
        subset=subset,
        family=family,
        map=map_name,
        scenes=scene,
        focal_mm=focal_mm,
        caption=caption,
        baseline_cm=baseline_cm,
    )
    index = open_data(data, root=data_root)
    try:
        with progress_bar("writing", unit="frames") as progress:
            items = exported(
                index,
                out,
                tier=tier,
                size=parse_size(size),
                depth=None if depth_unit_m is None else DepthEncoding(unit_m=depth_unit_m),
                workers=workers,
                progress=progress,
                pairs=parse_pairs(pairs),
                frames=parse_frames_option(frames),
                **options,
            )
    except KeyboardInterrupt:
        typer.echo("stopped; run the same command again to go on from here", err=True)
        raise typer.Exit(STOPPED) from None
    typer.echo(f"{out}: {counted(len(items), 'item')} of tier {tier}")
