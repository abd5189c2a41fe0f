"""``stereogenbench synth``: generate scenes in the released layout, without Unreal."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stereogenbench_data.cli.options import (
    JsonOption,
    OutArgument,
    PartOption,
    WorkOptions,
    complete_from,
    flag,
    grouped,
)
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.writing import require_writable, write_report
from stereogenbench_data.schema.release import (
    FAMILIES,
    FRAME_COUNT,
    IMAGE_SIZE_PX,
    Split,
    Subset,
)
from stereogenbench_data.schema.text import counted
from stereogenbench_data.synthesis.request import Check, ExportContract, SynthRequest

if TYPE_CHECKING:
    from stereogenbench_data.synthesis.renderer import Renderer

_ALL: str = "all"


@grouped
def synth(  # noqa: PLR0913 - one parameter an option
    out: OutArgument,
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
    map_name: Annotated[
        list[str] | None,
        typer.Option(
            "--map",
            help="Map, and folder of the scenes; given again, or 'all', each proposal draws one "
            "[SynthStage; all of the assets].",
        ),
    ] = None,
    focal_mm: Annotated[
        float | None, typer.Option(help="Focal length, mm [random, 18 to 85, for each scene].")
    ] = None,
    depth_unit_m: Annotated[float, typer.Option(help="Metres in a stored unit.")] = 0.001,
    assets: Annotated[
        Path | None,
        typer.Option(
            help="assets.toml of your own maps and characters, for Blender [the built-in maps]."
        ),
    ] = None,
    part: PartOption = "1/1",
    check: Annotated[
        Check,
        typer.Option(help="What rendered scenes must pass; audit: also the audit and the doctor."),
    ] = "pictures",
    plan_only: Annotated[bool, flag("--plan-only", "Propose and filter, render nothing.")] = False,
    report: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="DIR",
            help="Folder for a report on all proposals so far, and a picture of each scene.",
        ),
    ] = None,
    work: WorkOptions,
    as_json: JsonOption = False,
) -> None:
    """Generate scenes with exact depth, poses and intrinsics, in the released layout.

    Proposals of subject, lens, rig and path are examined until one passes the filters; that one is
    rendered and checked. To continue a stopped run, run it again: it keeps the scenes and decisions
    of the same request. Scene i is the same for any number of scenes, workers and parts.

    Example: `stereogenbench synth scenes/ --family Uniform --scenes 4 --size 256`
    """
    from stereogenbench_data.synthesis.decisions import (
        all_decisions,
        report_markdown,
        report_of,
    )
    from stereogenbench_data.synthesis.produce import plan_scenes, synthesise
    from stereogenbench_data.synthesis.render import RAY_CASTING
    from stereogenbench_data.synthesis.review import write_sheets

    if report is not None:
        require_writable(report, "folder")
    if map_name is not None and _ALL in map_name and len(map_name) > 1:
        raise typer.BadParameter(
            f"'{_ALL}' is all maps: give it alone, or name maps without it.", param_hint="--map"
        )
    chosen: Renderer = RAY_CASTING
    if assets is not None:
        from stereogenbench_data.synthesis.blender.renderer import BlenderRenderer

        chosen = BlenderRenderer.from_file(assets)
    everywhere = map_name == [_ALL] or (map_name is None and assets is not None)
    request = SynthRequest(
        family=family,
        scenes=scenes,
        size_px=size,
        frames=frames,
        seed=seed,
        split=split,
        subset=subset,
        map_name=chosen.maps if everywhere else tuple(map_name or ["SynthStage"]),
        focal_mm=focal_mm,
        contract=ExportContract(depth_unit_m=depth_unit_m),
        check=check,
    )
    how: Any = {"renderer": chosen, "part": part, **work.options()}
    with progress_bar("proposing", unit="scenes") as progress:
        decisions = plan_scenes(out, request, progress=progress, **how)
    keys: list[str] = []
    if not plan_only:
        with progress_bar("drawing", unit="frames") as progress:
            keys = synthesise(out, request, progress=progress, **how)
    if report is not None:
        found = report_of(all_decisions(out))
        write_report(report / "report.json", json.dumps(found, indent=2))
        write_report(report / "report.md", report_markdown(found))
    if report is not None and keys:
        with progress_bar("pictures", unit="scenes") as progress:
            write_sheets(
                out,
                keys,
                folder=report,
                unit_m=depth_unit_m,
                progress=progress,
                **work.options(),
            )
    if plan_only:
        shown = report_of([(request.family, decisions)])
        _print(shown, report_markdown(shown).rstrip(), as_json=as_json)
        return
    folders = sorted({key.rpartition("/")[0] for key in keys})
    where = (
        f" in {', '.join(folders)}"
        if folders
        else f" (part {part[0]}/{part[1]} of {scenes} has none, or all are held out)"
    )
    _print(
        {"root": str(out), "scenes": keys},
        f"{out}: {counted(len(keys), 'scene')}{where}",
        as_json=as_json,
    )


def _print(document: Any, text: str, *, as_json: bool) -> None:
    typer.echo(json.dumps(document, indent=2) if as_json else text)
