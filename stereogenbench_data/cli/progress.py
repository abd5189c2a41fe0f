"""The progress bar of long commands on stderr: count and time left.

If stderr is not a terminal, as in the log of a batch job, a line is printed every minute.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

Report = Callable[[int, int], None]


@contextmanager
def progress_bar(doing: str, *, unit: str, log_every_s: float = 60) -> Iterator[Report]:
    """Show a bar while the block runs; yield a function that takes (done, total).

    A bar that has counted nothing when the block ends is taken away, as that of a command that
    fails at once.

    Args:
        doing: What the command does, such as "packing".
        unit: What is counted. For "MB", pass done and total in bytes.
        log_every_s: Seconds between two lines where stderr is not a terminal.
    """
    divisor = 1_000_000 if unit == "MB" else 1
    console = Console(stderr=True)
    bar = Progress(
        TextColumn(doing),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(unit),
        TimeRemainingColumn(compact=True, elapsed_when_finished=True),
        console=console,
    )
    task = bar.add_task(doing, total=None)
    last_line_s = time.monotonic()
    if console.is_terminal:
        bar.start()

    def report(done: int, total: int) -> None:
        nonlocal last_line_s
        if done and not bar.live.is_started:
            bar.start()
        bar.update(task, completed=-(-done // divisor), total=-(-total // divisor))
        if not console.is_terminal and time.monotonic() - last_line_s >= log_every_s:
            last_line_s = time.monotonic()
            console.print(bar)

    try:
        yield report
    finally:
        if bar.live.is_started:
            bar.live.transient = not bar.tasks[task].completed
            bar.stop()
