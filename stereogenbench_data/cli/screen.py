"""What a long report shows on a terminal: a verdict, what matters most, and where the rest is.

Through a pipe the whole report is printed.
"""

import io
import sys
from collections.abc import Iterable, Sequence
from typing import Final

import typer
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from stereogenbench_data.schema.text import plain_line

LINES: Final = 30
COLUMNS: Final = 100
"""The most that is shown of a report."""


Part = tuple[str, Sequence[Sequence[str]]]
"""A table of a report: its title, and its cells, the first row its head."""


def print_report(verdict: str, parts: Iterable[Part], *, whole: str, rest: str) -> None:
    """Print a report: on a terminal its verdict and as much of its tables as a screen holds.

    Args:
        verdict: What comes first.
        parts: Its tables, the most important first.
        whole: The whole report.
        rest: The last line on a terminal: where the whole report is, or how it is written.
    """
    if not sys.stdout.isatty():
        typer.echo(whole.rstrip())
        return
    width = min(COLUMNS, Console().width)
    lines = _lines(_text(verdict), width)
    for part in parts:
        lines += _fitting(part, width=width, room=LINES - len(lines) - 1)
    typer.echo("\n".join([*lines, rest]))  # a path is not broken into lines


def _fitting(part: Part, *, width: int, room: int) -> list[str]:
    """Return as many rows of a table as there is room for, and how many are left out."""
    title, (head, *rows) = part
    for count in range(min(len(rows), room), 0, -1):
        left_out = f"... and {len(rows) - count} more" if count < len(rows) else ""
        shown = Table(box=box.SIMPLE_HEAD, pad_edge=False, title=title, title_justify="left")
        for number, name in enumerate(head):
            shown.add_column(_text(name), justify="left" if number == 0 else "default")
        for row in rows[:count]:
            shown.add_row(*map(_text, row))
        lines = ["", *_lines(shown, width), *([left_out] if left_out else [])]
        if len(lines) <= room:
            return lines
    return []


def _text(words: str) -> Text:
    """Return words as they are, without markup or control characters."""
    return Text(plain_line(words))


def _lines(shown: Table | Text, width: int) -> list[str]:
    """Return what rich draws, without the spaces at the ends of lines and empty lines around."""
    console = Console(file=io.StringIO(), width=width)
    with console.capture() as captured:
        console.print(shown)
    lines = [line.rstrip() for line in captured.get().split("\n")]
    return "\n".join(lines).strip("\n").split("\n")
