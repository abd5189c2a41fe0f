"""``stereogenbench audit``: is this data right? The paper's geometry table for any data."""

import hashlib
import json
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from stereogenbench_data.cli.options import (
    DataOptions,
    EngineOption,
    JsonOption,
    OutOption,
    SceneOptions,
    WorkersOption,
    complete_from,
    grouped,
)
from stereogenbench_data.cli.outcome import FINDINGS, resumable
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.writing import write_report, writing

_ALL = "all"


def _complete_limit(incomplete: str) -> list[str]:
    from stereogenbench_data.audit.audit_records import AuditLimits

    return complete_from(f"{limit.name}=" for limit in fields(AuditLimits))(incomplete)


@grouped
@resumable()
def audit(  # noqa: PLR0913 - one parameter an option
    source: DataOptions,
    *,
    scenes: Annotated[
        int | None, typer.Option("--scenes", min=1, help="Audit so many, drawn at random [all].")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="What they are drawn with.")] = 0,
    frames: Annotated[
        str, typer.Option(help="Frames of each scene, evenly spread; 'all' as the paper did.")
    ] = "5",
    chosen: SceneOptions,
    depth_unit_m: Annotated[
        float | None, typer.Option(help="Metres in a stored unit of depth [as tagged, else 0.1].")
    ] = None,
    depth_kind: Annotated[
        Literal["planar", "ray"], typer.Option(help="Depth along the axis, or along the ray.")
    ] = "planar",
    accept: Annotated[
        list[str] | None,
        typer.Option(
            help="Depth that lost something: 8-bit (to 14-bit), lossy, chroma; may be repeated.",
            autocompletion=complete_from(
                ("8-bit", "9-bit", "10-bit", "12-bit", "14-bit", "lossy", "chroma")
            ),
        ),
    ] = None,
    limit: Annotated[
        list[str] | None,
        typer.Option(
            help="NAME=NUMBER, such as baseline_cm=0.01; may be given again.",
            autocompletion=_complete_limit,
        ),
    ] = None,
    out: OutOption = None,
    journal: Annotated[
        Path | None,
        typer.Option(
            help="Where a stopped audit is kept until it is finished [beside --out, "
            "else ~/.cache/stereogenbench]."
        ),
    ] = None,
    as_json: JsonOption = False,
    workers: WorkersOption = None,
    engine: EngineOption = "local",
) -> None:
    """Measure whether data are right, and list what is not.

    Intrinsics, baselines, poses and depth are held against each other, as in the paper's audit,
    with the paper's figures beside; frames are counted; dark, flat and frozen pictures, invalid
    depth and occluders at the border are looked for. Prints Markdown; --out also writes it to a
    file (as JSON if that ends with .json). An audit that was stopped goes on if it is run again.
    The exit status is 1 if anything is beyond its limit.
    """
    from stereogenbench_data.audit.audit_records import AuditLimits
    from stereogenbench_data.audit.audit_table import audit_markdown
    from stereogenbench_data.audit.geometry_audit import (
        AuditRequest,
        audit_journal,
        open_for_audit,
    )
    from stereogenbench_data.audit.geometry_audit import audit as audited
    from stereogenbench_data.engine import engine_of

    if out is not None and out.is_dir():
        raise typer.BadParameter(
            f"{out} is a folder: name a file, such as {out / 'audit.md'}.", param_hint="--out"
        )
    request = AuditRequest(
        sample=scenes,
        frames=_frames(frames),
        seed=seed,
        depth=_contract(depth_unit_m, depth_kind, accept),
        limits=AuditLimits.parse(limit or []),
    )
    filters, where = chosen.filters(), engine_of(engine)
    with progress_bar("reading the index", unit="scenes") as progress:
        index = open_for_audit(
            source.data,
            root=source.data_root,
            workers=workers,
            engine=where,
            progress=progress,
            **filters,
        )
    notes = journal or _journal(out, source.data, request)
    kept = audit_journal(notes, index, request)
    with writing(notes), kept, progress_bar("auditing", unit="frames") as progress:
        report = audited(
            index,
            request,
            workers=workers,
            engine=where,
            progress=progress,
            journal=kept,
            **filters,
        )
    document, markdown = json.dumps(report.to_json(), indent=1), audit_markdown(report)
    if out is not None:
        write_report(out, document if out.suffix == ".json" else markdown)
    typer.echo(document if as_json else markdown.rstrip())
    kept.delete()
    if report.findings:
        raise typer.Exit(FINDINGS)


def _frames(text: str) -> int:
    if text == _ALL:
        return 0
    if not text.isdecimal() or int(text) < 1:
        raise typer.BadParameter(
            f"{text!r} is neither a number of frames, such as 5, nor 'all'.", param_hint="--frames"
        )
    return int(text)


def _contract(unit_m: float | None, kind: Any, accept: Any) -> Any:
    from stereogenbench_data.schema.records import DepthEncoding

    contract = DepthEncoding(unit_m=unit_m, kind=kind, accept=frozenset(accept or ()))
    return None if contract == DepthEncoding() else contract


def _journal(out: Path | None, data: str, request: Any) -> Path:
    from stereogenbench_data.sources.location import is_remote, shown

    if out is not None:
        return out.with_name(f"{out.name}.journal")
    place = shown(data) if is_remote(data) else str(Path(data).resolve())
    name = hashlib.sha256(
        repr((place, request.frames, request.depth)).encode(errors="replace")
    ).hexdigest()[:16]
    return Path.home() / ".cache" / "stereogenbench" / f"audit-{name}.journal"
