"""The progress bar of every long command: done, rate and time left, on stderr."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

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
    """Show a bar while the block runs; it yields what is to be called with (done, total)."""
    columns = (
        TextColumn(doing),
        BarColumn(),
        _DoneColumn(unit),
        _RateColumn(unit),
        TimeRemainingColumn(compact=True, elapsed_when_finished=True),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(doing, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
