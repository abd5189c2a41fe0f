"""Ctrl-C and SIGTERM end a starting command at once, and raise an exception in a running one."""

import os
import signal
from types import FrameType

STOPPED = 130
"""Exit status after Ctrl-C: 128 plus the number of the signal."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def stop_at_once() -> None:
    """Let a signal end this process at once, without a traceback.

    An ignored signal stays ignored, such as Ctrl-C in the background of a shell script.
    """
    for number in _SIGNALS:
        if signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL):
            signal.signal(number, _end)


def stop_by_exception() -> None:
    """Let a signal that `stop_at_once` handles raise KeyboardInterrupt from now on."""
    for number in _SIGNALS:
        if signal.getsignal(number) is _end:
            signal.signal(number, signal.default_int_handler)


def _end(_number: int, _frame: FrameType | None) -> None:
    os.write(2, b"stopped\n")
    os._exit(STOPPED)
