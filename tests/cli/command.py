"""The command ``stereogenbench`` as tests call it: in this process, or in one of its own."""

import subprocess
import sys

import typer
from typer.testing import CliRunner

from stereogenbench_data.cli.commands import app

COMMAND = (sys.executable, "-m", "stereogenbench_data")
COMMANDS = typer.main.get_command(app).commands
CALLS = {
    (name, *([inner] if inner else [])): call
    for name, each in COMMANDS.items()
    for inner, call in (getattr(each, "commands", None) or {"": each}).items()
}
"""The commands by the words that call them."""


def invoke(*words, **options):
    """Return the result of the command in this process."""
    return CliRunner().invoke(app, [str(word) for word in words], **options)


def succeed(*words):
    """Return the result of the command, which must end with exit status 0."""
    result = invoke(*words)
    assert result.exit_code == 0, result.output
    return result


def refused(*words):
    """Return what the command says, as one line, that must end with exit status 2."""
    result = invoke(*words, env={"COLUMNS": "300"})
    assert result.exit_code == 2, result.output
    return one_line(result.stderr)


def run(*words, **options):
    """Return the ended process of the command, as a user runs it."""
    given = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | options
    return subprocess.run([*COMMAND, *map(str, words)], check=False, timeout=120, **given)


def one_line(text):
    """Return a text without line breaks and the frame that typer draws around errors."""
    return " ".join(text.replace("│", " ").split())
