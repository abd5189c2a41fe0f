"""The progress bar of every long command: done, rate and time left, on stderr.

If stderr is not a terminal, as in the log of a batch job, a line is printed every minute.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

Report = Callable[[int, int], None]

_BYTES_IN: Final = {"MB": 1_000_000}
"""Units whose progress is reported in bytes, and the bytes in each."""
_ROOM_FOR_BAR: Final = 60
_LOGGED_EVERY_S: Final = 60


class _DoneColumn(ProgressColumn):
    """How much is done of how much, as far as it is known."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        """Return 3/8 scenes, or nothing before the total is known."""
        if task.total is None:
            return Text("")
        total = f"{task.total:,.0f}"
        return Text(f"{task.completed:>{len(total)},.0f}/{total} {self._unit}", style="cyan")


class _RateColumn(ProgressColumn):
    """Units a second."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        """Return the rate since the start, or nothing before there is one."""
        rate = task.finished_speed or task.speed
        return Text("" if rate is None else f"{rate:,.1f} {self._unit}/s")


@contextmanager
def progress_bar(doing: str, *, unit: str) -> Iterator[Report]:
    """Show a bar while the block runs; yield a function to call with (done, total).

    Args:
        doing: What the command does, such as "packing".
        unit: What is counted. For "MB", pass done and total in bytes.
    """
    divisor = _BYTES_IN.get(unit, 1)
    console = Console(stderr=True)
    columns = (
        TextColumn(doing),
        *([BarColumn()] if console.width >= _ROOM_FOR_BAR else []),
        _DoneColumn(unit),
        _RateColumn(unit),
        TimeRemainingColumn(compact=True, elapsed_when_finished=True),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task(doing, total=None)
        last_line_s = time.monotonic()

        def report(done: int, total: int) -> None:
            nonlocal last_line_s
            bar.update(task, completed=-(-done // divisor), total=-(-total // divisor))
            if not console.is_terminal and time.monotonic() - last_line_s >= _LOGGED_EVERY_S:
                last_line_s = time.monotonic()
                console.print(bar)

        yield report
