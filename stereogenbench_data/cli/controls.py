"""``stereogenbench controls``: what the metrics say of right views that are known in kind."""

import json
from pathlib import Path
from typing import Annotated

import typer

from stereogenbench_data.cli.evaluation_options import (
    OFFLINE,
    PAPER_SIZE,
    BaselineOption,
    CheckoutOption,
    DeviceOption,
    FitOption,
    FramesOption,
    KeypointsOption,
    MetricsOption,
    PairsOption,
    PlotsOption,
    ReportOption,
    SizeOption,
    StereoOption,
    WeightsOption,
    parse_frames_option,
    parse_pairs,
    protocol_of,
)
from stereogenbench_data.cli.opening import open_data
from stereogenbench_data.cli.options import (
    CaptionOption,
    DataArgument,
    DepthUnitOption,
    FamilyOption,
    FocalOption,
    JsonOption,
    MapOption,
    RootOption,
    SceneOption,
    SplitOption,
    SubsetOption,
    WorkersOption,
    scene_filters,
)
from stereogenbench_data.cli.outcome import FINDINGS
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.stopping import STOPPED


def controls(  # noqa: PLR0913 - one parameter an option
    data: DataArgument,
    *,
    data_root: RootOption = None,
    seed: Annotated[
        int, typer.Option(min=0, help="Decides whose right view stands in for whose.")
    ] = 0,
    split: SplitOption = "eval",
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
    metrics: MetricsOption = OFFLINE,
    keypoint_matcher: KeypointsOption = "sift",
    stereo_matcher: StereoOption = "sgbm",
    fit: FitOption = "filtered",
    depth_unit_m: DepthUnitOption = None,
    weights: WeightsOption = None,
    checkout: CheckoutOption = None,
    device: DeviceOption = "cpu",
    out: ReportOption = None,
    plots: PlotsOption = False,
    as_json: JsonOption = False,
    workers: WorkersOption = None,
) -> None:
    """Score the calibration controls: what a perfect, a copied, a wrong and a random view get.

    The rendered target, the left view, the same scene from the next camera (02 for 01), and the
    right view of another scene. Prints the paper's own controls beside them, and whether the
    relations between them hold; the exit status is 1 if one does not. The report goes to --out
    [evaluation/controls], and a stopped run goes on if it is run again.
    """
    from stereogenbench_data.evaluation.controls import relations, score_controls
    from stereogenbench_data.evaluation.report import document, page, write_report
    from stereogenbench_data.evaluation.tables import branch_table, control_table, explaining_table

    protocol = protocol_of(
        metrics=metrics,
        size=size,
        keypoint_matcher=keypoint_matcher,
        stereo_matcher=stereo_matcher,
        fit=fit,
        depth_unit_m=depth_unit_m,
        weights=weights,
        checkout=checkout,
        device=device,
    )
    folder = out or Path("evaluation") / "controls"
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
        with progress_bar("scoring", unit="frames") as progress:
            results = score_controls(
                index,
                protocol=protocol,
                seed=seed,
                out=folder / "partial",
                workers=workers,
                progress=progress,
                pairs=parse_pairs(pairs),
                frames=parse_frames_option(frames),
                **options,
            )
    except KeyboardInterrupt:
        typer.echo("stopped; run the same command again to go on from here", err=True)
        raise typer.Exit(STOPPED) from None
    tables = [control_table(results), branch_table(results), explaining_table(results)]
    found = relations(results)
    files = write_report(folder, results, tables, found=found, plots="write" if plots else "skip")
    if as_json:
        typer.echo(json.dumps(document(results, tables, found=found), allow_nan=False))
    else:
        typer.echo(page(results, tables, found=found).rstrip())
    typer.echo(f"{folder}: {', '.join(str(path.relative_to(folder)) for path in files)}", err=True)
    if any(each.holds is False for each in found):
        raise typer.Exit(FINDINGS)
