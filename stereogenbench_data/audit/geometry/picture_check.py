"""The paper's checks of rendered pictures: stored depth, light, motion and border occluders."""

import math
from collections.abc import Iterator
from typing import Final

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8, UInt16

from stereogenbench_data.audit.geometry.picture_limits import NEAR_SHARE, border_share, borders
from stereogenbench_data.audit.geometry.records import Figure

_SUBJECT_PERCENT: Final = 20
MOVED_SHARE: Final = 0.01
"""Motion of a picture's middle, as a share of its width, beyond which pictures must change."""
_COVERED: Final = 0.8
_LOOKED_AT_PX: Final = 320
ENOUGH_LEVELS: Final = 64
"""Least count of different numbers whose spacing shows how they were rounded."""
_LUMA: Final = np.array([0.299, 0.587, 0.114], dtype=np.float32)

Luma = Float32[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]
Map = Float64[np.ndarray, "h w"]
Units = UInt16[np.ndarray, "h w"]


def luma_of(picture: UInt8[np.ndarray, "3 h w"]) -> Luma:
    """Return the luma of a picture, from 0 to 255."""
    return np.tensordot(_LUMA, picture.astype(np.float32), axes=1)


def band_passed(luma: Luma) -> Luma:
    """Return grey levels blurred a little, less their mean over 13 x 13 pixels."""
    blurred = mean = luma
    for _ in range(2):
        # Each turn filters down the columns, and transposes.
        size = len(blurred)
        padded = np.pad(blurred, ((2, 2), (0, 0)), mode="edge")
        near, far = padded[1:-3] + padded[3:-1], padded[:-4] + padded[4:]
        blurred = np.ascontiguousarray((padded[2:-2] * 6 + near * 4 + far).T)
        ones = np.pad(mean, ((6, 6), (0, 0)), mode="edge")
        twos = ones[:-1] + ones[1:]
        fours = twos[:-2] + twos[2:]
        eights = fours[:-4] + fours[4:]
        mean = np.ascontiguousarray((eights[:size] + fours[8 : 8 + size] + ones[12:]).T)
    return blurred / np.float32(16**2) - mean / np.float32(13**2)


def reduced_size(height_px: int, width_px: int) -> tuple[int, int]:
    """Return the (height, width) at which light and motion are judged."""
    factor = max(1, math.ceil(max(height_px, width_px) / _LOOKED_AT_PX))
    return max(1, height_px // factor), max(1, width_px // factor)


def light_figures(
    member: str, frame: int, luma: Luma, *, before: tuple[int, Luma] | None
) -> Iterator[Figure]:
    """Yield the mean, the standard deviation and the change of brightness of one picture.

    Args:
        member: Its file.
        frame: Its number.
        luma: The picture.
        before: An earlier frame's number and picture that this one must differ from, if any.
    """
    yield Figure("brightness", member, float(luma.mean()), f"frame {frame}")
    yield Figure("contrast", member, float(luma.std()), f"frame {frame}")
    if before is not None:
        yield Figure("change", member, float(np.abs(luma - before[1]).mean()), f"frame {before[0]}")


def payload_figures(
    member: str, frame: int, units: Units, measured: Mask, *, before: tuple[int, Units] | None
) -> Iterator[Figure]:
    """Yield the share of valid depth in one depth picture, and its change.

    Args:
        member: Its file.
        frame: Its number.
        units: What it stores.
        measured: Where that is depth.
        before: An earlier frame's number and units that this one must differ from, if any.
    """
    yield Figure("valid_depth", member, float(measured.mean()), f"frame {frame}")
    if before is not None and measured.any():
        change = float((units != before[1]).mean())
        yield Figure("depth_change", member, change, f"frame {before[0]}")


def stored_figures(member: str, seen: Bool[np.ndarray, " 65536"]) -> Iterator[Figure]:
    """Yield how many numbers a file stores, and their step, by which numbers were seen in it."""
    numbers = np.flatnonzero(seen)
    if len(numbers):
        yield Figure("depth_levels", member, float(len(numbers)))
    if len(numbers) >= ENOUGH_LEVELS:
        yield Figure("depth_step", member, stored_step(numbers))


def stored_step(numbers: np.ndarray) -> float:
    """Return the step between two or more ascending stored numbers.

    It is the greatest common divisor of their distances. If that is 1 and the numbers are many, it
    is the least distance: numbers of 10 or 12 bits that were stretched to 16 are not evenly spaced.

    >>> stored_step(np.array([100, 300, 400])), stored_step(np.array([7, 8, 20]))
    (100.0, 1.0)
    """
    gaps = np.diff(numbers)
    step = int(np.gcd.reduce(gaps))
    stretched = step == 1 and len(numbers) >= ENOUGH_LEVELS
    return float(gaps.min() if stretched else step)


def subject_m(depths: list[tuple[Map, Mask]]) -> float:
    """Return the approximate distance of what the cameras look at, nan if nothing was measured.

    It is the median over cameras of the 20th percentile of depth in the middle half of the
    picture: nearer than most of the background, and unaffected by what covers a camera or two.
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
    """Return the share of a picture's border that something near covers, and where it is most.

    Near is closer than `NEAR_SHARE` of ``far_m``. A row that is near from end to end is the ground
    unless nearly the whole picture is near.

    Args:
        depth_m: Depth in metres.
        measured: Where it was measured.
        far_m: The distance of the subject, see `subject_m`; by nan nothing is near.

    Returns:
        The share, and "left", "right", "top", "bottom", or "" if it is 0.
    """
    near = measured & (depth_m < NEAR_SHARE * far_m)
    if near.mean() <= _COVERED:
        near &= ~near.all(axis=1, keepdims=True)
    shares = {side: float(each.mean()) for side, each in borders(near).items()}
    share = border_share(near)
    return share, max(shares, key=lambda side: shares[side]) if share else ""
