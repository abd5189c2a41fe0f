"""``stereogenbench pack``: a released tree into tar shards with one index."""

import json
import warnings
from pathlib import Path
from typing import Annotated, Literal

import typer

from stereogenbench_data.cli.options import JsonOption, RootOption
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.stopping import STOPPED

_MEGABYTE = 1_000_000


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
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes that pack [one a core].")
    ] = None,
    engine: Annotated[
        Literal["local", "ray"],
        typer.Option(help="local: processes here; ray: tasks of a Ray cluster (extra 'ray')."),
    ] = "local",
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
    from stereogenbench_data.index.stale import StaleIndexWarning
    from stereogenbench_data.index.table import IncompleteSceneWarning, SceneIndex
    from stereogenbench_data.schema.text import counted, plain_line
    from stereogenbench_data.shards.pack import pack as pack_locally
    from stereogenbench_data.shards.plan import parse_size
    from stereogenbench_data.shards.ray_pack import pack_on_ray

    target_bytes, wanted = parse_size(shard_size), _part(part)
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", IncompleteSceneWarning)
            warnings.simplefilter("always", StaleIndexWarning)
            index = SceneIndex.open(root, root=data_root)
        for warning in told:
            typer.echo("\n".join(map(plain_line, str(warning.message).split("\n"))), err=True)
        with progress_bar("packing", unit="MB") as bar:

            def progress(done: int, total: int) -> None:
                bar(-(-done // _MEGABYTE), -(-total // _MEGABYTE))

            if engine == "ray":
                report = pack_on_ray(
                    index,
                    out,
                    target_bytes=target_bytes,
                    depth_codec=depth_codec,
                    part=wanted,
                    progress=progress,
                )
            else:
                report = pack_locally(
                    index,
                    out,
                    target_bytes=target_bytes,
                    depth_codec=depth_codec,
                    part=wanted,
                    workers=workers,
                    progress=progress,
                )
    except KeyboardInterrupt:
        typer.echo("stopped; run the same command again to go on from here", err=True)
        raise typer.Exit(STOPPED) from None
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
            f"{text!r} is no part: write I/N, such as 1/4", param_hint="--part"
        )
    return int(number), int(count)
