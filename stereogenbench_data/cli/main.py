"""The command ``stereogenbench``: errors become one line with the cure, commands import late."""

import sys
from dataclasses import dataclass
from importlib.metadata import version as package_version
from typing import Annotated

import typer

from stereogenbench_data.cli.index import index
from stereogenbench_data.cli.pack import pack
from stereogenbench_data.cli.synth import synth
from stereogenbench_data.cli.verify import verify
from stereogenbench_data.errors import StereoGenBenchError

EXIT_ERROR = 2


@dataclass(slots=True)
class _Settings:
    debug: bool = False


_settings = _Settings()
app = typer.Typer(
    name="stereogenbench",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help=(
        "Stereo pairs out of StereoGenBench scenes.\n\n"
        "New here? Draw some scenes with `stereogenbench synth scenes/`, index them with "
        "`stereogenbench index scenes/ -o scenes/index.parquet`, then point "
        "`StereoPairs('scenes/')` at them in Python."
    ),
)
app.command()(synth)
app.command()(index)
app.command()(pack)
app.command()(verify)


def _print_version(value: bool) -> None:
    if value:
        typer.echo(f"stereogenbench-data {package_version('stereogenbench-data')}")
        raise typer.Exit


@app.callback()
def _common(
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the whole traceback of an error.")
    ] = False,
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    _settings.debug = debug


def main() -> None:
    """Run the command line; an error of ours is said on stderr and ends with exit code 2."""
    try:
        app()
    except StereoGenBenchError as error:
        if _settings.debug:
            raise
        typer.echo(f"{type(error).__name__}: {error}", err=True)
        sys.exit(EXIT_ERROR)


if __name__ == "__main__":
    main()
