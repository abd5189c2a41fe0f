"""The commands of ``stereogenbench`` in the order of use; each imports late what it needs."""

import sys
from collections.abc import Callable
from contextlib import nullcontext
from importlib.metadata import version as package_version
from io import TextIOWrapper
from typing import Annotated, Any, Final

import typer

from stereogenbench_data.cli import export_clips, export_views
from stereogenbench_data.cli.audit import audit
from stereogenbench_data.cli.browse import browse
from stereogenbench_data.cli.conventions import conventions
from stereogenbench_data.cli.doctor import doctor
from stereogenbench_data.cli.download import download
from stereogenbench_data.cli.errors import ErrorsReported
from stereogenbench_data.cli.evaluate import controls, inputs, score
from stereogenbench_data.cli.forecast import forecast
from stereogenbench_data.cli.help import HelpedCommand, HelpedGroup
from stereogenbench_data.cli.index import index
from stereogenbench_data.cli.pack import pack, unpack, verify
from stereogenbench_data.cli.publish import card, croissant, upload
from stereogenbench_data.cli.show import show
from stereogenbench_data.cli.signals import stop_by_exception
from stereogenbench_data.cli.stats import stats
from stereogenbench_data.cli.synth import synth

_COMMANDS: Final[dict[str, dict[Callable[..., None], str]]] = {
    "Have scenes": {
        synth: "synth scenes/ --family Uniform --scenes 4 --size 256",
        index: "index scenes/",
        download: "download hf://datasets/ORG/NAME --split eval --cameras 0,1 --dest data/",
    },
    "Look at them": {
        show: "show shards/ scene_000001 --pair 0-5 -o sheet.png",
        browse: "browse shards/",
    },
    "Pack them": {
        pack: "pack scenes/ packed/ --shard-size 2GB",
        unpack: "unpack shards/ scenes/",
    },
    "Check them": {
        stats: "stats shards/ --plots plots/",
        conventions: "conventions scenes/ -o conventions.toml",
        doctor: "doctor scenes/ -o doctor.png",
        audit: "audit shards/ --scenes 20 -o audit.md",
        verify: "verify shards/ --deep",
        forecast: "forecast shards/ --samples-s 100 --delay-ms 60",
    },
}
"""Panel of the help to its commands, each with a call that works."""

_EVALUATE: Final = (
    ("inputs", inputs, "eval inputs shards/ inputs/ --tier G1 --split eval"),
    ("score", score, "eval score shards/ predictions/ --tier G1 --split eval"),
    ("controls", controls, "eval controls shards/ --frames every:20"),
)
_PUBLISH: Final = (
    ("croissant", croissant, "publish croissant shards/ -o croissant/sample.json"),
    ("card", card, "publish card packed/ ORG/NAME -o packed/"),
    ("upload", upload, "publish upload packed/ ORG/NAME"),
)
_GROUPS: Final[dict[str, tuple[str, tuple[tuple[str, Callable[..., None], str], ...]]]] = {
    "export": (
        "Write scenes in the layouts of other projects.",
        (*export_clips.EXPORTS, *export_views.EXPORTS),
    ),
    "eval": ("Score a method by the paper's protocol.", _EVALUATE),
    "publish": ("Describe shards and put them on the Hub.", _PUBLISH),
}
"""Groups of commands: what they do, and the name, function and example of each command."""

_DEBUG: Final = "--debug"
_HELP_OPTIONS: Final = {"help_option_names": ["-h", "--help"]}


class _Commands(HelpedGroup):
    """The group of commands. Errors end it with a message, with --debug in a traceback."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command of the context."""
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
    context_settings=_HELP_OPTIONS,
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
        "Help on a command: `stereogenbench COMMAND --help`. Completion by Tab: "
        "`stereogenbench --install-completion` (or `--show-completion`). Exit status: 0 done and "
        "nothing is wrong; 1 something is wrong with the data; 2 it could not be done; 130 stopped "
        "by Ctrl-C or SIGTERM."
    ),
)


for _panel, _examples in _COMMANDS.items():
    for _function, _example in _examples.items():
        app.command(
            cls=HelpedCommand,
            rich_help_panel=_panel,
            epilog=f"Example: `stereogenbench {_example}`",
            context_settings=_HELP_OPTIONS,
        )(_function)

for _group, (_help, _inner) in _GROUPS.items():
    _typer = typer.Typer(cls=HelpedGroup, no_args_is_help=True)
    app.add_typer(
        _typer,
        name=_group,
        rich_help_panel="Take them elsewhere",
        epilog=f"Example: `stereogenbench {_inner[0][2]}`",
        help=_help,
        context_settings=_HELP_OPTIONS,
    )
    for _name, _function, _example in _inner:
        _typer.command(
            _name,
            cls=HelpedCommand,
            epilog=f"Example: `stereogenbench {_example}`",
            context_settings=_HELP_OPTIONS,
        )(_function)


def _print_version(value: bool) -> None:
    if value:
        typer.echo(f"stereogenbench-data {package_version('stereogenbench-data')}")
        raise typer.Exit


@app.callback()
def _common(
    debug: Annotated[
        bool,
        typer.Option(_DEBUG, help="Show the traceback of an error (may stand anywhere)."),
    ] = False,
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Declare the options of all commands; `_Commands` acts on them."""


def run() -> None:
    """Run the command line; print characters that the terminal's encoding lacks as ``?``."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="replace")
    arguments = [each for each in sys.argv[1:] if each != _DEBUG]
    if len(arguments) < len(sys.argv) - 1:
        arguments.insert(0, _DEBUG)
    with nullcontext() if _DEBUG in arguments else ErrorsReported():
        app(arguments, prog_name="stereogenbench")
