"""``stereogenbench pack``, ``verify``, ``unpack``: released trees into tar shards, and back."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer

from stereogenbench_data.cli.opening import open_index
from stereogenbench_data.cli.options import (
    JsonOption,
    RootOption,
    ShardsOptions,
    WorkOptions,
    grouped,
)
from stereogenbench_data.cli.outcome import FINDINGS, resumable
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.schema.text import counted, plain_line


@grouped
@resumable()
def pack(  # noqa: PLR0913 - one parameter an option
    root: Annotated[str, typer.Argument(help="Released tree, or its index file.")],
    out: Annotated[Path, typer.Argument(help="Folder for the shards and their index.")],
    *,
    data_root: RootOption = None,
    shard_size: Annotated[
        str,
        typer.Option(
            help="Largest size of a shard, such as 500MB or 2GiB. A scene is never divided: a "
            "larger one has a larger shard to itself."
        ),
    ] = "2GB",
    part: Annotated[
        str,
        typer.Option(help="I/N packs every N-th shard from the I-th on: one part per machine."),
    ] = "1/1",
    work: WorkOptions,
    depth_codec: Annotated[
        Literal["released", "blosc2"],
        typer.Option(
            help="released: depth as it is; blosc2: lossless frames that decode one by one, about "
            "ten times faster (extra 'blosc2'; the released size counts for --shard-size)."
        ),
    ] = "released",
    as_json: JsonOption = False,
) -> None:
    """Pack a released tree into WebDataset tars, with the same bytes each time.

    To continue a stopped run, run it again: it keeps finished shards by their sizes, times of
    change and metadata. `stereogenbench verify` reads every byte. With --part, run the same command
    once for each I; the last one to finish writes the index.
    """
    from stereogenbench_data.shards.pack import pack as packed_by
    from stereogenbench_data.shards.plan import parse_size

    number, _, count = part.partition("/")
    if not (number.isdecimal() and count.isdecimal()):
        raise typer.BadParameter(
            f"{part!r} is not a part: write I/N, such as 1/4.", param_hint="--part"
        )
    target_bytes = parse_size(shard_size)
    index = open_index(root, root=data_root)
    with progress_bar("packing", unit="MB") as progress:
        report = packed_by(
            index,
            out,
            target_bytes=target_bytes,
            depth_codec=depth_codec,
            part=(int(number), int(count)),
            **work.options(),
            progress=progress,
        )
    if as_json:
        document = {
            "index": None if report.index is None else str(report.index),
            "packed": report.packed,
            "part": report.part,
            "missing": report.missing,
            "scenes": len(index),
        }
        typer.echo(json.dumps(document, indent=2))
        return
    kept = len(report.part) - len(report.packed)
    were = "was" if kept == 1 else "were"
    typer.echo(
        f"{out}: {counted(len(report.packed), 'shard')} packed, {kept} {were} finished before"
    )
    if report.index is None:
        typer.echo(
            f"{counted(len(report.missing), 'shard')} of the plan to be packed yet, from "
            f"{report.missing[0]} on: the part that packs the last one writes the index"
        )
    else:
        typer.echo(f"{report.index}: {counted(len(index), 'scene')}")


@grouped
def verify(
    source: ShardsOptions,
    *,
    deep: Annotated[
        bool, typer.Option("--deep", help="Decode every video too, and count its frames.")
    ] = False,
    as_json: JsonOption = False,
    work: WorkOptions,
) -> None:
    """Read every byte of shards, and list what is wrong.

    The exit status is 0 if nothing is wrong, 1 if something is, 2 if they cannot be verified.
    """
    from stereogenbench_data.shards.verify import verify as verified

    with progress_bar("verifying", unit="MB") as progress:
        report = verified(
            source.shards,
            root=source.data_root,
            mode="decode" if deep else "bytes",
            **work.options(),
            progress=progress,
        )
    if as_json:
        typer.echo(json.dumps(asdict(report), indent=2))
    else:
        for problem in report.problems:
            typer.echo(plain_line(str(problem)))
        decoded = f", {counted(report.videos_decoded, 'video')} decoded" if deep else ""
        typer.echo(
            f"{report.root}: {counted(report.shards, 'shard')}, {counted(report.scenes, 'scene')}, "
            f"{counted(report.members, 'member')}, {report.bytes / 1e6:.1f} MB{decoded}; "
            f"{counted(len(report.problems), 'problem')}"
        )
    if report.problems:
        raise typer.Exit(FINDINGS)


@grouped
@resumable()
def unpack(
    source: ShardsOptions,
    out: Annotated[Path, typer.Argument(help="Folder for the scenes.")],
    *,
    work: WorkOptions,
    as_json: JsonOption = False,
) -> None:
    """Turn shards back into released scenes; check each file against the index.

    Files that were packed unchanged come out byte for byte. Depth that blosc2 packed becomes FFV1
    video again, with the same numbers, times and tags. Nothing is overwritten. To continue a
    stopped run, run it again: it keeps the scenes that exist.
    """
    from stereogenbench_data.shards.unpack import unpack as unpacked

    with progress_bar("unpacking", unit="MB") as progress:
        report = unpacked(
            source.shards,
            out,
            root=source.data_root,
            **work.options(),
            progress=progress,
        )
    if as_json:
        typer.echo(json.dumps(asdict(report) | {"out": str(out)}, indent=2))
        return
    were = "was" if len(report.kept) == 1 else "were"
    typer.echo(
        f"{out}: {counted(len(report.unpacked), 'scene')} unpacked, {len(report.kept)} {were} "
        f"there before"
    )
