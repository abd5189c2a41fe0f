"""Which numbers a colour means: the range that a map is coloured in, and its ticks."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from stereogenbench_data.samples.picture import Picture, coloured


@dataclass(frozen=True, slots=True)
class ColourScale:
    """A range of sizes (of -3 px the size is 3), and what its ends look like.

    Attributes:
        low: The smallest value that has a colour of its own, above 0 for "log".
        high: The largest.
        kind: "linear", from blue to red; or "log", from red to blue: what is near is red, in maps
            of disparity as of depth.
    """

    low: float
    high: float
    kind: Literal["linear", "log"] = "linear"

    def paint(
        self, values: Float[np.ndarray, "h w"], *, measured: Bool[np.ndarray, "h w"]
    ) -> Picture:
        """Return a map in this scale's colours, grey where not measured."""
        places = np.clip(self.place(np.clip(np.abs(values), self.low, self.high)), 0, 1)
        if self.kind == "log":
            places = 1 - places
        return coloured(places, measured=measured, largest=1.0)

    def place(self, value: Any) -> Any:
        """Return where a value, or each of an array, lies: 0 at the low end, 1 at the high one."""
        if self.kind == "log":
            return np.log(value / self.low) / max(math.log(self.high / self.low), 1e-12)
        return (value - self.low) / max(self.high - self.low, 1e-12)

    def ticks(self, most: int) -> list[float]:
        """Return at most so many round numbers within the range, ascending.

        >>> ColourScale(0.0, 87.0).ticks(5)
        [0.0, 20.0, 40.0, 60.0, 80.0]
        >>> ColourScale(1.5, 120.0, "log").ticks(6)
        [2.0, 5.0, 10.0, 20.0, 50.0, 100.0]
        """
        for found in self._tick_sets():
            if len(found) <= most:
                return found
        return []

    def _tick_sets(self) -> Iterator[list[float]]:
        """Yield sets of round numbers, each with fewer than the one before."""
        exponent = math.floor(math.log10(max(self.high - self.low, 1e-12))) - 2
        if self.kind == "log" and self.high > 4 * self.low:
            powers = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
            for factors in ((1, 1.5, 2, 3, 5, 7), (1, 2, 5), (1, 3), (1,)):
                numbers = [factor * 10.0**power for power in powers for factor in factors]
                yield [number for number in numbers if self.low <= number <= self.high]
        for power in range(exponent, exponent + 4):
            for factor in (1, 2, 5):
                step = factor * 10.0**power
                first, last = math.ceil(self.low / step), math.floor(self.high / step)
                yield [round(number * step, 12) for number in range(first, last + 1)]


def scale_of(
    values: Float[np.ndarray, "..."],
    *,
    measured: Bool[np.ndarray, "..."],
    kind: Literal["linear", "log"] = "linear",
) -> ColourScale:
    """Return a scale for the middle 96 % of measured values; a linear one begins at 0 if it can."""
    found = np.abs(values[measured])
    if found.size == 0:
        return ColourScale(1.0 if kind == "log" else 0.0, 2.0, kind)
    low, high = (float(each) for each in np.percentile(found, (2, 98)))
    if kind == "linear" and low < high / 2:
        low = 0.0
    return ColourScale(low, max(high, low * 1.001, low + 1e-6), kind)
