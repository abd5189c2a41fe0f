"""Ctrl-C and SIGTERM: at once while the command is starting, by an exception once it works."""

import os
import signal
from types import FrameType

STOPPED = 130
"""Exit status after Ctrl-C: 128 and the number of the signal."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def stop_at_once() -> None:
    """Let a signal end this process without a traceback, as long as nothing needs tidying up.

    A signal that is ignored, as Ctrl-C is in the background of a shell script, stays ignored.
    """
    for number in _SIGNALS:
        if signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL):
            signal.signal(number, _end)


def stop_by_exception() -> None:
    """Let a signal that `stop_at_once` took raise KeyboardInterrupt from here on."""
    for number in _SIGNALS:
        if signal.getsignal(number) is _end:
            signal.signal(number, signal.default_int_handler)


def _end(_number: int, _frame: FrameType | None) -> None:
    os.write(2, b"stopped\n")
    os._exit(STOPPED)
