"""The commands of ``stereogenbench`` in the order of use; each imports late what it needs."""

import sys
from collections.abc import Callable
from importlib.metadata import version as package_version
from io import TextIOWrapper
from typing import Annotated, Any, Final

import typer
from typer.core import TyperGroup

from stereogenbench_data.cli.audit import audit
from stereogenbench_data.cli.browse import browse
from stereogenbench_data.cli.conventions import conventions
from stereogenbench_data.cli.doctor import doctor
from stereogenbench_data.cli.download import download
from stereogenbench_data.cli.errors import ErrorsReported
from stereogenbench_data.cli.evaluate import controls, disparity, inputs, score
from stereogenbench_data.cli.export_clips import clips
from stereogenbench_data.cli.export_views import colmap, ply, transforms
from stereogenbench_data.cli.forecast import forecast
from stereogenbench_data.cli.index import index
from stereogenbench_data.cli.options import option
from stereogenbench_data.cli.pack import pack, unpack, verify
from stereogenbench_data.cli.publish import card, croissant
from stereogenbench_data.cli.show import show
from stereogenbench_data.cli.stats import stats
from stereogenbench_data.cli.synth import synth

_COMMANDS: Final[dict[str, tuple[Callable[..., None], ...]]] = {
    "Have scenes": (synth, index, download),
    "Look at them": (show, browse),
    "Pack them": (pack, unpack, verify),
    "Check them": (stats, doctor, audit, conventions, forecast),
}
"""Panel of the help to its commands; the docstring of each ends with a call that works."""

_GROUPS: Final[dict[str, tuple[str, tuple[Callable[..., None], ...]]]] = {
    "export": (
        "Write scenes in the layouts of other projects.",
        (clips, colmap, transforms, ply),
    ),
    "eval": (
        "Score right views by the paper's protocol, or disparity.",
        (inputs, score, controls, disparity),
    ),
    "publish": ("Describe shards for the Hub.", (croissant, card)),
}
"""Groups of commands: what each is for, and its commands."""


class _Commands(TyperGroup):
    """The group of commands, which errors end with a message."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command of the context."""
        with ErrorsReported():
            return super().invoke(ctx)


def _typer(**settings: Any) -> typer.Typer:
    return typer.Typer(
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode="markdown",
        context_settings={"help_option_names": ["-h", "--help"]},
        **settings,
    )


app = _typer(
    name="stereogenbench",
    cls=_Commands,
    help=(
        "Stereo pairs out of StereoGenBench scenes: 6 cameras, 15 pairs, exact disparity.\n\n"
        "New here? Draw two small scenes, look at one, browse them all:\n\n"
        "```\n"
        "stereogenbench synth scenes/ --scenes 2 --size 256 --frames 15\n"
        "stereogenbench show scenes/\n"
        "stereogenbench browse scenes/\n"
        "```\n\n"
        "Then train in Python with `StereoPairs('scenes/')`. DATA is a folder of scenes, a "
        "folder of shards, an index file, or the URL of either."
    ),
    epilog=(
        "Exit status: 0 done and nothing is wrong; 1 something is wrong with the data; 2 it could "
        "not be done; 130 stopped by Ctrl-C or SIGTERM."
    ),
)

for _panel, _functions in _COMMANDS.items():
    for _function in _functions:
        app.command(rich_help_panel=_panel)(_function)
for _name, (_what, _functions) in _GROUPS.items():
    _group = _typer()
    app.add_typer(_group, name=_name, help=_what, rich_help_panel="Take them elsewhere")
    for _function in _functions:
        _group.command()(_function)


def _print_version(value: bool) -> None:
    if value:
        with ErrorsReported():
            typer.echo(f"stereogenbench-data {package_version('stereogenbench-data')}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool,
        option(
            "--version",
            "Show the version and exit.",
            callback=_print_version,
            is_eager=True,
            metavar="",
        ),
    ] = False,
) -> None:
    """Declare the options of all commands."""


def run() -> None:
    """Run the command line; print characters that the terminal's encoding lacks as ``?``."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="replace")
    with ErrorsReported():
        app(prog_name="stereogenbench")
