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
from stereogenbench_data.synthesis.request import Check, ExportContract, RotationForm, SynthRequest

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
    depth_tag: Annotated[
        str, typer.Option(help="Name of the tag that states the unit; '' writes none.")
    ] = "DEPTH_SCALE",
    rotation: Annotated[
        RotationForm, typer.Option(help="How trajectory.json records rotations.")
    ] = "rotator",
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
        typer.Option(help="File for a report on all proposals of OUT so far: .md or .json."),
    ] = None,
    contact_sheets: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for a picture of each scene, to look through."),
    ] = None,
    holdout: Annotated[
        Path | None,
        typer.Option(help="File of scene paths, one a line: move them to OUT/.holdout, and end."),
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
    from stereogenbench_data.synthesis.review import hold_out, write_sheets

    _require_options_agree(
        plan_only=plan_only, report=report, contact_sheets=contact_sheets, holdout=holdout
    )
    if holdout is not None:
        moved = hold_out(out, _listed(holdout))
        _print(
            {"root": str(out), "held_out": moved},
            f"{out}: {counted(len(moved), 'scene')} moved to {out / '.holdout'}",
            as_json=as_json,
        )
        return
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
        contract=ExportContract(
            rotation=rotation, depth_unit_m=depth_unit_m, depth_tag=depth_tag or None
        ),
        check=check,
    )
    how: Any = {"renderer": chosen, "part": part, **work.options()}
    with progress_bar("proposing", unit="scenes") as progress:
        decisions = plan_scenes(out, request, progress=progress, **how)
    keys: list[str] = []
    if not plan_only:
        with progress_bar("drawing", unit="frames") as progress:
            keys = synthesise(out, request, progress=progress, **how)
    if contact_sheets is not None and keys:
        with progress_bar("contact sheets", unit="scenes") as progress:
            write_sheets(
                out,
                keys,
                folder=contact_sheets,
                unit_m=depth_unit_m,
                progress=progress,
                **work.options(),
            )
    if report is not None:
        found = report_of(all_decisions(out))
        is_json = report.suffix == ".json"
        write_report(report, json.dumps(found, indent=2) if is_json else report_markdown(found))
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


def _require_options_agree(
    *, plan_only: bool, report: Path | None, contact_sheets: Path | None, holdout: Path | None
) -> None:
    """Refuse options of which one would silently do nothing, and files that cannot be written."""
    if report is not None and report.suffix not in (".md", ".json"):
        raise typer.BadParameter(f"{report} must end in .md or .json.", param_hint="--report")
    if holdout is not None and (plan_only or report or contact_sheets):
        raise typer.BadParameter(
            "it only moves scenes: leave out --plan-only, --report and --contact-sheets.",
            param_hint="--holdout",
        )
    if plan_only and contact_sheets is not None:
        raise typer.BadParameter(
            "--plan-only renders no scenes to show: leave one of the two out.",
            param_hint="--contact-sheets",
        )
    if report is not None:
        require_writable(report, "file")
    if contact_sheets is not None:
        require_writable(contact_sheets, "folder")


def _listed(path: Path) -> list[str]:
    try:
        return [word.rstrip("/") for word in path.read_text(encoding="utf-8-sig").split()]
    except UnicodeDecodeError as error:
        raise typer.BadParameter(
            f"{path} is not text. List paths of scenes, one a line.", param_hint="--holdout"
        ) from error


def _print(document: Any, text: str, *, as_json: bool) -> None:
    typer.echo(json.dumps(document, indent=2) if as_json else text)
