"""``stereogenbench pack``, ``verify``, ``unpack``: tar shards of a released tree, and back."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer

from stereogenbench_data.cli.opening import open_index
from stereogenbench_data.cli.options import (
    EngineOption,
    JsonOption,
    RootOption,
    ShardsOptions,
    WorkersOption,
    grouped,
    workers_option,
)
from stereogenbench_data.cli.outcome import FINDINGS, resumable
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.schema.text import counted, plain_line


@resumable()
def pack(  # noqa: PLR0913 - one parameter an option
    root: Annotated[str, typer.Argument(help="Released tree, or its index file.")],
    out: Annotated[Path, typer.Argument(help="Folder for the shards and their index.")],
    *,
    data_root: RootOption = None,
    shard_size: Annotated[
        str,
        typer.Option(
            help="Size not to be exceeded, such as 500MB or 2GiB; a scene is never divided, so one "
            "that is larger has a larger shard to itself."
        ),
    ] = "2GB",
    part: Annotated[
        str,
        typer.Option(help="I/N packs every N-th shard, from the I-th on: one part a machine."),
    ] = "1/1",
    workers: Annotated[int | None, workers_option("Processes that pack")] = None,
    engine: EngineOption = "local",
    depth_codec: Annotated[
        Literal["released", "blosc2"],
        typer.Option(
            help="released: depth as it is; blosc2: packed so that each frame stands alone and "
            "decodes some ten times faster, bit for bit (extra 'blosc2'; its released size counts "
            "for --shard-size)."
        ),
    ] = "released",
    as_json: JsonOption = False,
) -> None:
    """Pack a released tree into WebDataset tars, the same bytes each time.

    Finished shards are kept, so a run that was stopped goes on if it is run again: it looks at
    sizes and times of change and reads metadata again; `stereogenbench verify` reads every byte.
    With --part, run the same command once for each I; whichever is finished last writes the index.
    """
    from stereogenbench_data.engine import engine_of
    from stereogenbench_data.schema.text import counted
    from stereogenbench_data.shards.pack import pack as packed_by
    from stereogenbench_data.shards.plan import parse_size

    target_bytes, wanted = parse_size(shard_size), _part(part)
    index = open_index(root, root=data_root)
    with progress_bar("packing", unit="MB") as progress:
        report = packed_by(
            index,
            out,
            target_bytes=target_bytes,
            depth_codec=depth_codec,
            part=wanted,
            workers=workers,
            engine=engine_of(engine),
            progress=progress,
        )
    if as_json:
        place = None if report.index is None else str(report.index)
        packed = {"packed": list(report.packed), "part": list(report.part)}
        missing = {"missing": list(report.missing), "scenes": len(index)}
        typer.echo(json.dumps({"index": place} | packed | missing, indent=2))
        return
    kept = len(report.part) - len(report.packed)
    were = "was" if kept == 1 else "were"
    typer.echo(
        f"{out}: {counted(len(report.packed), 'shard')} packed, {kept} {were} finished before"
    )
    if report.index is None:
        missing_shards = counted(len(report.missing), "shard")
        typer.echo(
            f"{missing_shards} of the plan yet to be packed, the first is {report.missing[0]}: the "
            f"part that packs the last one writes the index"
        )
    else:
        typer.echo(f"{report.index}: {counted(len(index), 'scene')}")


def _part(text: str) -> tuple[int, int]:
    number, _, count = text.partition("/")
    if not (number.isdecimal() and count.isdecimal()):
        raise typer.BadParameter(
            f"{text!r} is not a part: write I/N, such as 1/4.", param_hint="--part"
        )
    return int(number), int(count)


@grouped
def verify(
    source: ShardsOptions,
    *,
    deep: Annotated[
        bool, typer.Option("--deep", help="Decode every video too, and count its frames.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Report as JSON.")] = False,
    workers: Annotated[int | None, workers_option("Processes that read")] = None,
    engine: EngineOption = "local",
) -> None:
    """Read shards through, and list all that is wrong with them.

    The exit status is 0 if nothing is wrong, 1 if something is, 2 if they cannot be verified.
    """
    from stereogenbench_data.engine import engine_of
    from stereogenbench_data.shards.verify import verify as verified

    mode: Literal["bytes", "decode"] = "decode" if deep else "bytes"
    with progress_bar("verifying", unit="MB") as progress:
        report = verified(
            source.shards,
            root=source.data_root,
            mode=mode,
            workers=workers,
            engine=engine_of(engine),
            progress=progress,
        )
    if as_json:
        typer.echo(json.dumps(asdict(report), indent=2))
    else:
        for problem in report.problems:
            typer.echo(plain_line(str(problem)))
        decoded = f", {counted(report.videos_decoded, 'video')} decoded" if deep else ""
        there = ", ".join(
            (
                counted(report.shards, "shard"),
                counted(report.scenes, "scene"),
                counted(report.members, "member"),
                f"{report.bytes / 1e6:.1f} MB{decoded}",
            )
        )
        typer.echo(f"{report.root}: {there}; {counted(len(report.problems), 'problem')}")
    if report.problems:
        raise typer.Exit(FINDINGS)


@grouped
@resumable()
def unpack(
    source: ShardsOptions,
    out: Annotated[Path, typer.Argument(help="Folder for the scenes.")],
    *,
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Turn shards back into scenes as they were released, each file held against the index.

    Files that were packed as they are come out byte for byte. Depth that blosc2 packed is written
    as FFV1 video again, with the same numbers, times and tags. Nothing is overwritten; scenes that
    are there are kept, so a run that was stopped goes on if it is run again.
    """
    from stereogenbench_data.shards.unpack import unpack as unpacked

    with progress_bar("unpacking", unit="MB") as progress:
        report = unpacked(
            source.shards, out, root=source.data_root, workers=workers, progress=progress
        )
    if as_json:
        summary = {"unpacked": list(report.unpacked), "kept": list(report.kept)}
        typer.echo(json.dumps({"out": str(out)} | summary, indent=2))
        return
    were = "was" if len(report.kept) == 1 else "were"
    typer.echo(
        f"{out}: {counted(len(report.unpacked), 'scene')} unpacked, {len(report.kept)} {were} "
        f"there before"
    )
