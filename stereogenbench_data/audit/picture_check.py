"""The paper's post-render checks: payloads, light, motion, and what hides a picture's border."""

import math
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from jaxtyping import Bool, Float64, UInt8, UInt16

from stereogenbench_data.audit.audit_records import At

NEAR_SHARE: Final = 0.3
"""An occluder is nearer than this share of how far away the subject is, see `subject_m`."""
_SUBJECT_PERCENT: Final = 20
MOVED_SHARE: Final = 0.01
"""Motion of a picture's middle, as a share of its width, from which on pictures must change."""
_COVERED: Final = 0.8
_LOOKED_AT_PX: Final = 320
_STORED_NUMBERS: Final = 1 << 16
ENOUGH_LEVELS: Final = 64
"""Different numbers from which on their spacing says how they were rounded."""
_LUMA: Final = np.array([0.299, 0.587, 0.114], dtype=np.float32)

Mask = Bool[np.ndarray, "h w"]
Map = Float64[np.ndarray, "h w"]


@dataclass(slots=True)
class Least:
    """The least of some figures, and where it was."""

    at: At = field(default_factory=At)

    def take(self, value: float, frame: int) -> None:
        """Take a figure into account."""
        if not self.at.value <= value:
            self.at = At(float(value), frame)


def reduced_size(height_px: int, width_px: int) -> tuple[int, int]:
    """Return (height, width) at which light and motion are judged."""
    factor = max(1, math.ceil(max(height_px, width_px) / _LOOKED_AT_PX))
    return max(1, height_px // factor), max(1, width_px // factor)


class LightCheck:
    """How bright, how rich in contrast and how changing one camera's pictures are."""

    def __init__(self) -> None:
        self.brightness, self.contrast, self.change = Least(), Least(), Least()
        self._last: tuple[int, np.ndarray] | None = None

    def take(self, picture: UInt8[np.ndarray, "3 h w"], frame: int, *, moved: bool) -> None:
        """Take the next picture into account.

        Args:
            picture: The picture.
            frame: Its number.
            moved: Whether the camera has moved since the last one, so that it must differ.
        """
        luma = np.tensordot(_LUMA, picture.astype(np.float32), axes=1)
        dark, bright = np.percentile(luma, (5, 95))
        self.brightness.take(bright, frame)
        self.contrast.take(bright - dark, frame)
        if moved and self._last is not None:
            self.change.take(float(np.abs(luma - self._last[1]).mean()), self._last[0])
        self._last = (frame, luma)


class PayloadCheck:
    """What numbers one camera's depth stores, and whether they change."""

    def __init__(self) -> None:
        self.least_valid = Least()
        self.still_from = -1
        self._shares: list[float] = []
        self._seen = np.zeros(_STORED_NUMBERS, dtype=np.bool_)
        self._last: tuple[int, np.ndarray] | None = None

    def take(
        self, units: UInt16[np.ndarray, "h w"], measured: Mask, frame: int, *, moved: bool
    ) -> None:
        """Take the next depth picture into account: stored numbers, and where they are depths."""
        share = float(measured.mean())
        self._shares.append(share)
        self.least_valid.take(share, frame)
        self._seen[units[measured]] = True
        last = self._last if moved and share and self.still_from < 0 else None
        if last is not None and np.array_equal(units, last[1]):
            self.still_from = last[0]
        self._last = (frame, units)

    @property
    def valid(self) -> float:
        """The mean share of measured pixels."""
        return float(np.mean(self._shares)) if self._shares else math.nan

    @property
    def levels(self) -> int:
        """How many different numbers were met."""
        return int(self._seen.sum())

    @property
    def step_units(self) -> float:
        """The step in which stored numbers are spaced, see `stored_step`."""
        return stored_step(np.flatnonzero(self._seen))


def stored_step(numbers: np.ndarray) -> float:
    """Return the step in which ascending stored numbers are spaced, nan for fewer than two.

    That is the greatest common divisor of their distances; or, where that is 1 and there are
    enough of them, the least distance: numbers of 10 or 12 bits that were stretched to 16 are not
    spaced evenly.

    >>> stored_step(np.array([100, 300, 400])), stored_step(np.array([7, 8, 20]))
    (100.0, 1.0)
    """
    gaps = np.diff(numbers)
    if not len(gaps):
        return math.nan
    step = int(np.gcd.reduce(gaps))
    stretched = step == 1 and len(numbers) >= ENOUGH_LEVELS
    return float(gaps.min() if stretched else step)


def subject_m(depths: list[tuple[Map, Mask]]) -> float:
    """Return about how far away what some cameras look at is, nan where nothing was measured.

    It is the median over cameras of the 20th percentile of depth in the middle half of the
    picture: nearer than most of the background, and not moved by what covers a camera or two.
    """
    nearest = []
    for depth_m, measured in depths:
        height, width = depth_m.shape
        rows, columns = (slice(side // 4, side - side // 4) for side in (height, width))
        there = depth_m[rows, columns][measured[rows, columns]]
        if there.size:
            nearest.append(float(np.percentile(there, _SUBJECT_PERCENT)))
    return float(np.median(nearest)) if nearest else math.nan


def border_occluder(depth_m: Map, measured: Mask, *, far_m: float) -> tuple[float, str]:
    """Return which share of a picture something near hides from a border, and from which.

    Near is what is closer than `NEAR_SHARE` of ``far_m``. Counted are unbroken runs of near pixels
    that begin at the left, right or top border; a row that is near from end to end is the ground
    unless nearly the whole picture is near.

    Args:
        depth_m: Depth in metres.
        measured: Where it was measured.
        far_m: How far away the subject is, see `subject_m`.

    Returns:
        The share, and "left", "right", "top", "all", or "" where it is 0.
    """
    if math.isnan(far_m):
        return 0.0, ""
    step = max(1, math.ceil(max(depth_m.shape) / _LOOKED_AT_PX))
    near = (measured & (depth_m < NEAR_SHARE * far_m))[::step, ::step]
    if near.mean() > _COVERED:
        return float(near.mean()), "all"
    beside = near & ~near.all(axis=1, keepdims=True)
    shares = {
        "left": _runs(beside),
        "right": _runs(beside[:, ::-1]),
        "top": _runs(near.T),
    }
    side = max(shares, key=lambda each: shares[each])
    return (shares[side], side) if shares[side] else (0.0, "")


def _runs(near: Mask) -> float:
    """Return the share of a picture in runs of True that begin at its first column."""
    lengths = np.where(near.all(axis=1), near.shape[1], near.argmin(axis=1))
    return float(lengths.sum() / near.size)
