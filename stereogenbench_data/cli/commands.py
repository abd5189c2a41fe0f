"""The commands of ``stereogenbench`` in the order of use; each imports what it needs late."""

import sys
from contextlib import nullcontext
from importlib.metadata import version as package_version
from io import TextIOWrapper
from typing import Annotated, Any, Final

import typer
from typer.core import TyperGroup

from stereogenbench_data.cli.audit import audit
from stereogenbench_data.cli.bench import bench
from stereogenbench_data.cli.browse import browse
from stereogenbench_data.cli.doctor import doctor
from stereogenbench_data.cli.download import download
from stereogenbench_data.cli.evaluate import controls, evaluate, export_inputs
from stereogenbench_data.cli.export_views import EXPORTS
from stereogenbench_data.cli.index import index
from stereogenbench_data.cli.outcome import ErrorsReported
from stereogenbench_data.cli.pack import pack, unpack, verify
from stereogenbench_data.cli.publish import card, croissant, upload
from stereogenbench_data.cli.show import show
from stereogenbench_data.cli.stats import stats
from stereogenbench_data.cli.stopping import stop_by_exception
from stereogenbench_data.cli.synth import synth

_START: Final = "Have scenes"
_LOOK: Final = "Look at them"
_CHECK: Final = "Check them"
_PACK: Final = "Pack them"
_EXPORT: Final = "Take them elsewhere"
_SCORE: Final = "Score with them"

_DEBUG: Final = "--debug"


class _Commands(TyperGroup):
    """The group of commands: errors are reported in short, or whole with --debug."""

    def invoke(self, ctx: Any) -> Any:
        """Run what was asked for."""
        stop_by_exception()
        if ctx.params.get("debug"):
            return super().invoke(ctx)
        with ErrorsReported():
            return super().invoke(ctx)


app = typer.Typer(
    name="stereogenbench",
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
    help=(
        "Stereo pairs out of StereoGenBench scenes: 6 cameras, 15 pairs, exact disparity.\n\n"
        "New here? Draw two small scenes, look at one, browse them all:\n\n"
        "    stereogenbench synth scenes/ --scenes 2 --size 256 --frames 15\n"
        "    stereogenbench show scenes/\n"
        "    stereogenbench browse scenes/\n\n"
        "Then train in Python with `StereoPairs('scenes/')`. DATA is a folder of scenes, a "
        "folder of shards, an index file, or the URL of either."
    ),
    epilog=(
        "Exit status: 0 done and nothing is wrong; 1 something is wrong with the data; 2 it could "
        "not be done; 130 stopped by Ctrl-C or SIGTERM.\n\n"
        "Shell completion: `stereogenbench --install-completion`. "
        "Help on a command: `stereogenbench COMMAND --help`."
    ),
)


_HELP: Final[Any] = {"context_settings": {"help_option_names": ["-h", "--help"]}}

export = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown")


def _command(function: Any, *, panel: str, example: str) -> None:
    """Register a command, in the panel of the help that it belongs to, with a call that works."""
    app.command(rich_help_panel=panel, epilog=_example(example), **_HELP)(function)


def _example(call: str) -> str:
    return f"Example: `stereogenbench {call}`"


_command(synth, panel=_START, example="synth scenes/ --family Uniform --scenes 4 --size 256")
_command(index, panel=_START, example="index scenes/")
_command(
    download,
    panel=_START,
    example="download hf://datasets/ORG/NAME --split eval --cameras 0,1 --dest data/",
)
_command(show, panel=_LOOK, example="show shards/ scene_000001 --pair 0-5 -o sheet.png")
_command(browse, panel=_LOOK, example="browse shards/")
_command(pack, panel=_PACK, example="pack scenes/ shards/ --shard-size 2GB")
_command(unpack, panel=_PACK, example="unpack shards/ scenes/")
_command(croissant, panel=_PACK, example="croissant shards/ -o croissant/sample.json")
_command(card, panel=_PACK, example="card shards/ --repo ORG/NAME -o shards/")
_command(upload, panel=_PACK, example="upload shards/ ORG/NAME")
app.add_typer(
    export,
    name="export",
    rich_help_panel=_EXPORT,
    epilog=_example(EXPORTS[0][2]),
    help="Write scenes in the layouts of other projects.",
    **_HELP,
)
for _name, _function, _call in EXPORTS:
    export.command(_name, epilog=_example(_call), **_HELP)(_function)
_command(stats, panel=_CHECK, example="stats shards/ --plots plots/")
_command(doctor, panel=_CHECK, example="doctor scenes/ -o doctor.png")
_command(audit, panel=_CHECK, example="audit shards/ --scenes 20 -o audit.md")
_command(verify, panel=_CHECK, example="verify shards/ --deep")
_command(bench, panel=_CHECK, example="bench --only all-frames")
_command(
    export_inputs, panel=_SCORE, example="export-inputs shards/ inputs/ --tier G1 --split eval"
)
_command(evaluate, panel=_SCORE, example="evaluate shards/ predictions/ --tier G1 --split eval")
_command(controls, panel=_SCORE, example="controls shards/ --frames every:20")


def _print_version(value: bool) -> None:
    if value:
        typer.echo(f"stereogenbench-data {package_version('stereogenbench-data')}")
        raise typer.Exit


@app.callback()
def _common(
    debug: Annotated[
        bool,
        typer.Option(_DEBUG, help="Show the whole traceback of an error (may stand anywhere)."),
    ] = False,
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Take the options of all commands; the group itself acts on them."""


def run() -> None:
    """Run the command line; how it ends is in `outcome`.

    What the terminal's encoding lacks is printed as question marks.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="replace")
    arguments = [each for each in sys.argv[1:] if each != _DEBUG]
    if len(arguments) < len(sys.argv) - 1:
        arguments.insert(0, _DEBUG)
    with nullcontext() if _DEBUG in arguments else ErrorsReported():
        app(arguments, prog_name="stereogenbench")
