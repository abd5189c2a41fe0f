"""``stereogenbench pack``: a released tree into tar shards with one index."""

import warnings
from pathlib import Path
from typing import Annotated, Literal

import typer

from stereogenbench_data.cli.progress import progress_bar

_MEGABYTE = 1_000_000


def pack(
    root: Annotated[Path, typer.Argument(help="Released tree, or its index file.")],
    out: Annotated[Path, typer.Argument(help="Folder for the shards and their index.")],
    *,
    shard_size: Annotated[
        str, typer.Option(help="Size not to be exceeded, such as 500MB or 2GiB.")
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
) -> None:
    """Pack a released tree into WebDataset tars, the same bytes each time.

    Finished shards are kept, so a run that was stopped goes on if it is run again. With --part,
    run the same command once for each I; whichever is finished last writes the index.
    """
    from stereogenbench_data.storage.index import IncompleteSceneWarning, SceneIndex
    from stereogenbench_data.storage.pack import pack as pack_locally
    from stereogenbench_data.storage.ray_pack import pack_on_ray
    from stereogenbench_data.storage.shard_plan import parse_size

    target_bytes, wanted = parse_size(shard_size), _part(part)
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", IncompleteSceneWarning)
            index = SceneIndex.open(root)
        for warning in told:
            typer.echo(str(warning.message), err=True)
        with progress_bar("packing", unit="MB") as bar:

            def progress(done: int, total: int) -> None:
                bar(-(-done // _MEGABYTE), -(-total // _MEGABYTE))

            if engine == "ray":
                report = pack_on_ray(
                    index, out, target_bytes=target_bytes, part=wanted, progress=progress
                )
            else:
                report = pack_locally(
                    index,
                    out,
                    target_bytes=target_bytes,
                    part=wanted,
                    workers=workers,
                    progress=progress,
                )
    except KeyboardInterrupt:
        typer.echo("stopped; run the same command again to go on from here", err=True)
        raise typer.Exit(130) from None
    kept = len(report.part) - len(report.packed)
    typer.echo(f"{out}: {len(report.packed)} shards packed, {kept} were finished before")
    if report.index is None:
        typer.echo(
            f"{len(report.missing)} shards of the plan are missing, the first is "
            f"{report.missing[0]}: the part that packs the last one writes the index"
        )
    else:
        typer.echo(f"{report.index}: {len(index)} scenes")


def _part(text: str) -> tuple[int, int]:
    number, _, count = text.partition("/")
    if not (number.isdecimal() and count.isdecimal()):
        raise typer.BadParameter(
            f"{text!r} is no part: write I/N, such as 1/4", param_hint="--part"
        )
    return int(number), int(count)
