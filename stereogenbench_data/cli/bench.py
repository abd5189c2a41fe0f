"""``stereogenbench bench``: run the benchmark of a checkout."""

import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from stereogenbench_data.cli.signals import STOPPED
from stereogenbench_data.errors import StorageError


def bench(  # noqa: PLR0913 - one parameter an option
    *,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Only all-frames, accuracy or another. May be repeated."),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="One round of the main races.")] = False,
    rounds: Annotated[int, typer.Option(min=1, help="Rounds of every race.")] = 5,
    workers: Annotated[
        str | None, typer.Option(metavar="N,N", help="Worker processes, such as 2,0,1,4.")
    ] = None,
    whole: Annotated[
        bool, typer.Option("--whole", help="Race over all frames instead of a window.")
    ] = False,
    batches: Annotated[int, typer.Option(min=2, help="Batches of the memory run.")] = 2000,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep rounds and sections that exist.")
    ] = False,
    draw: Annotated[bool, typer.Option("--draw", help="Only draw and pack the data.")] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Only compare the contestants' samples.")
    ] = False,
    tables: Annotated[
        bool, typer.Option("--tables", help="Only write tables and plots again.")
    ] = False,
    data: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the data [build/bench].")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Of the results [docs/performance].")
    ] = None,
) -> None:
    """Race this package against other loaders; needs a checkout.

    The contestants are a bare decoding loop and other packages. The first run draws four scenes (20
    minutes of processor time) and keeps them. Results are written after every round.
    """
    beside = Path(__file__).resolve().parents[2]
    places = [beside, Path.cwd()]
    checkouts = [each for each in places if (each / "benchmarks" / "ffmpeg_links.py").is_file()]
    if not checkouts:
        raise StorageError(
            f"benchmarks/: is neither in {beside} nor in {Path.cwd()}. An installed package comes "
            f"without the benchmark: run the command in a checkout."
        )
    flags = {
        "--quick": quick, "--whole": whole, "--resume": resume, "--draw": draw,
        "--check": check, "--tables": tables,
    }  # fmt: skip
    values = {
        "--workers": workers, "--data": data and data.resolve(), "--out": out and out.resolve(),
        "--rounds": rounds, "--batches": batches,
    }  # fmt: skip
    command = [sys.executable, "-m", "benchmarks"]
    command += [word for name in only or () for word in ("--only", name)]
    command += [flag for flag, given in flags.items() if given]
    for name, value in values.items():
        command += [] if value is None else [name, str(value)]
    try:
        done = subprocess.run(command, cwd=checkouts[0], check=False)
    except KeyboardInterrupt:
        raise typer.Exit(STOPPED) from None
    raise typer.Exit(done.returncode)
