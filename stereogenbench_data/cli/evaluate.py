"""``stereogenbench evaluate``: score right views that a method wrote, as the paper does."""

import json
from pathlib import Path
from typing import Annotated

import typer

from stereogenbench_data.cli.evaluation_options import (
    OFFLINE,
    PAPER_SIZE,
    BaselineOption,
    ByOption,
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
    TierOption,
    WeightsOption,
    parse_by,
    parse_frames_option,
    parse_pairs,
    protocol_of,
)
from stereogenbench_data.cli.opening import open_data
from stereogenbench_data.cli.options import (
    CaptionOption,
    DataArgument,
    DepthUnitOption,
    EngineOption,
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
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.stopping import STOPPED


def evaluate(  # noqa: PLR0913 - one parameter an option
    data: DataArgument,
    predictions: Annotated[
        Path, typer.Argument(help="Folder of right views: ITEM/000.png ... or ITEM.mp4.")
    ],
    *,
    data_root: RootOption = None,
    tier: TierOption,
    name: Annotated[
        str | None, typer.Option("--name", help="What tables call the method [the folder's name].")
    ] = None,
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
    metrics: MetricsOption = OFFLINE,
    keypoint_matcher: KeypointsOption = "sift",
    stereo_matcher: StereoOption = "sgbm",
    fit: FitOption = "filtered",
    depth_unit_m: DepthUnitOption = None,
    weights: WeightsOption = None,
    checkout: CheckoutOption = None,
    device: DeviceOption = "cpu",
    by: ByOption = None,
    allow_missing: Annotated[
        int,
        typer.Option(min=0, help="Pairs whose right view may be missing or unusable; counted."),
    ] = 0,
    out: ReportOption = None,
    plots: PlotsOption = True,
    as_json: JsonOption = False,
    workers: WorkersOption = None,
    engine: EngineOption = "local",
) -> None:
    """Score a method's right views by the paper's protocol, beside the paper's own rows.

    Write the inputs of a tier with `stereogenbench export-inputs`; PREDICTIONS holds, for each
    item, a folder of PNGs or a video of the same name. The report (Markdown, LaTeX, CSV, JSON,
    plots) goes to --out [evaluation/NAME-TIER], and so do partial results: a stopped run goes on
    if it is run again.
    """
    from stereogenbench_data.engine import engine_of
    from stereogenbench_data.evaluation.evaluate import evaluate as evaluated
    from stereogenbench_data.evaluation.report import document, page, write_report
    from stereogenbench_data.evaluation.tables import tables_of

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
    strata = parse_by(by)
    called = name or predictions.resolve().name
    folder = out or Path("evaluation") / f"{called}-{tier}"
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
            scores = evaluated(
                index,
                predictions,
                tier=tier,
                name=called,
                protocol=protocol,
                out=folder / "partial",
                workers=workers,
                engine=engine_of(engine, device=device),
                allow_missing=allow_missing,
                progress=progress,
                pairs=parse_pairs(pairs),
                frames=parse_frames_option(frames),
                **options,
            )
    except KeyboardInterrupt:
        typer.echo("stopped; run the same command again to go on from here", err=True)
        raise typer.Exit(STOPPED) from None
    tables = tables_of([scores], by=strata)
    files = write_report(folder, [scores], tables, plots="write" if plots else "skip")
    if as_json:
        typer.echo(json.dumps(document([scores], tables), allow_nan=False))
    else:
        typer.echo(page([scores], tables).rstrip())
    typer.echo(f"{folder}: {', '.join(str(path.relative_to(folder)) for path in files)}", err=True)
