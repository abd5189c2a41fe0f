"""How calls are timed beside each other: by processor time, one after another in every round."""

import time
from collections.abc import Callable, Mapping
from typing import Any, Final

from benchmarks.results import Spread

SHORTEST_S: Final = 0.02
"""A call is repeated until this much processor time has gone."""


def time_calls(
    calls: Mapping[str, Callable[[], Any]], *, pixels: int, rounds: int
) -> dict[str, list[float]]:
    """Return nanoseconds a pixel of each call in every round, after one round that warms up.

    Calls alternate, and their order turns about from round to round.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    for number in range(rounds + 1):
        for name in list(calls)[:: 1 if number % 2 else -1]:
            begin, done = time.process_time(), 0
            while done < 2 or time.process_time() - begin < SHORTEST_S:
                calls[name]()
                done += 1
            if number:
                times[name].append((time.process_time() - begin) / done / pixels * 1e9)
    return times


def beside(times: Mapping[str, list[float]], *, base: str) -> dict[str, dict[str, float]]:
    """Return the spread of every call's times, and of their ratio to one call's of the same round.

    The base is a conversion of the map, so ratios are called conversions.
    """
    found = {}
    for name, values in times.items():
        spread = Spread.of(values)
        ratio = Spread.of(value / plain for value, plain in zip(values, times[base], strict=True))
        found[name] = {
            "median": spread.median, "low": spread.low, "high": spread.high,
            "conversions": ratio.median, "conversions_low": ratio.low,
            "conversions_high": ratio.high,
        }  # fmt: skip
    return found
