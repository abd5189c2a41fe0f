"""Differences in dB: how sure they are in one scene and over several, when they are believed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

LEAST_DB: Final = 0.15
"""A smaller mean difference is not believed, however sure: interpolation and codecs make such."""
LEAST_DB_ELSEWHERE: Final = 0.4
"""The same between contracts that take depth from other places (lag, order, flip) or another form:
where disparity is of few pixels, interpolation alone makes 0.3 dB between neighbouring lags."""
LEAST_ERRORS: Final = 3.0
_NORMAL_975: Final = 1.96
_T_975: Final = (
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160,
    2.145, 2.131, 2.120, 2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056,
    2.052, 2.048, 2.045,
)  # fmt: skip
"""The 97.5 % point of Student's t for 1 to 29 degrees of freedom; 1.96 + 2.5 / n beyond."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """By how many dB one contract is better than another in one scene, and its standard error.

    ``by_shape`` is whether it is the better one by the shape of disparity over the picture, which
    then decides; None where that does not tell. ``shape`` is the power of the ray's length and half
    its 95 % interval. Less than ``least_db`` is not believed. ``error_db`` is the smaller of two
    estimates, by which contracts are searched; ``wide_db`` the larger, by which intervals are told.
    """

    mean_db: float
    error_db: float
    by_shape: bool | None = None
    least_db: float = LEAST_DB
    wide_db: float | None = None
    shape: tuple[float, float] | None = None

    def is_clear(self, *, least_db: float | None = None, errors: float = LEAST_ERRORS) -> bool:
        """Tell whether the difference is large and sure enough to be believed."""
        if self.by_shape is not None:
            return self.by_shape
        least = self.least_db if least_db is None else least_db
        return self.mean_db >= max(least, errors * self.error_db)


@dataclass(frozen=True, slots=True)
class Gain:
    """A mean difference in dB with its 95 % confidence interval.

    Attributes:
        mean_db: The mean; nan where there is nothing to compare.
        low_db: Lower end.
        high_db: Upper end.
        over: What the interval is over: scenes or, where one alone tells, parts of its pictures.
        count: How many scenes tell.
        is_clear: Whether the difference may be believed.
        by_shape: Whether that is so by the shape of disparity, however few dB it makes.
        shape: The power of the ray's length, and half its 95 % interval; None where not told.
        margin_db: What the interval must keep away by, to confirm.
    """

    mean_db: float
    low_db: float
    high_db: float
    over: Literal["scenes", "parts of the pictures"]
    count: int
    is_clear: bool
    by_shape: bool = False
    shape: tuple[float, float] | None = None
    margin_db: float = LEAST_DB

    @property
    def is_excluded(self) -> bool:
        """Whether the other answer is kept away: the whole interval is beyond the margin."""
        return self.by_shape or self.low_db >= self.margin_db


def t_975(freedom: int) -> float:
    """Return the 97.5 % point of Student's t distribution."""
    return _T_975[freedom - 1] if freedom <= len(_T_975) else _NORMAL_975 + 2.5 / freedom


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the mean of two values or more, and the ends of its 95 % interval by Student's t."""
    array = np.asarray(values, dtype=np.float64)
    mean = float(array.mean())
    half = t_975(len(array) - 1) * float(array.std(ddof=1)) / math.sqrt(len(array))
    return mean, mean - half, mean + half


def pooled(scenes: Sequence[Evidence]) -> Gain:
    """Return the mean over scenes.

    It is clear if the interval over scenes leaves no doubt, or if it is clear in some scene and
    its opposite in none: what one scene rules out is ruled out for all with the same contract,
    however little the others tell (of a lag where nothing moves).
    """
    told = [scene for scene in scenes if math.isfinite(scene.mean_db)]
    by_shape = any(scene.by_shape for scene in told)
    if len(told) <= 1:
        scene = told[0] if told else Evidence(math.nan, math.inf)
        half = _NORMAL_975 * (scene.error_db if scene.wide_db is None else scene.wide_db)
        ends = (scene.mean_db - half, scene.mean_db + half)
        return Gain(
            scene.mean_db, *ends, "parts of the pictures", len(told), scene.is_clear(),
            by_shape, scene.shape, scene.least_db,
        )  # fmt: skip
    mean, low, high = interval([scene.mean_db for scene in told])
    against = (replace(scene, mean_db=-scene.mean_db) for scene in told if scene.by_shape is None)
    opposed = any(scene.is_clear() for scene in against)
    clear = (mean >= max(scene.least_db for scene in told) and low > 0) or (
        not opposed and any(scene.is_clear() for scene in told)
    )
    least_db = max(scene.least_db for scene in told)
    return Gain(mean, low, high, "scenes", len(told), clear, by_shape, margin_db=least_db)
