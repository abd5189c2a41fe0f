"""The disparity and visibility kernels beside a plain conversion of the map to float32.

What the conversion costs depends on the memory that it writes into more than on anything else, so
there are three readings, in each of which kernel and conversion write into memory of the same kind.
"""

import math
import mmap
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Final, Literal

import av
import numpy as np

from benchmarks.calls import beside, time_calls
from benchmarks.ways import Pair, in_blocks, sight_of, visible_by_both

CONVERSION: Final = "conversion"
KEPT: Final = 4
"""Maps that the decoding loop holds, as those of a batch."""
FRAMES: Final = 16

_TIGHT: Final[dict[str, Literal["the same", "fresh"]]] = {
    "the same array every time": "the same",
    "memory fresh from the system, shared between processes": "fresh",
}
"""Readings of one frame again and again."""

Depths = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, slots=True)
class Kernel:
    """What writes a map.

    Attributes:
        dtype: Of the map that it writes.
        inputs: What is made of a pair and its stored depths before the clock starts.
        write: What is timed: writes a map of the inputs.
        most: How many conversions it may take, if there is a mark.
    """

    dtype: type
    inputs: Callable[[Pair, Depths], Any]
    write: Callable[[Any, Pair, np.ndarray], Any]
    most: float | None = None


KERNELS: Final = {
    CONVERSION: Kernel(
        np.float32, lambda _, depths: depths[0], lambda units, _, out: np.copyto(out, units)
    ),
    "disparity": Kernel(np.float32, lambda _, depths: depths[0], in_blocks, 1 / 0.7),
    "visibility": Kernel(
        np.bool_,
        lambda pair, depths: sight_of(pair, *depths, dtype=np.float32),
        lambda sight, _, out: np.copyto(out, visible_by_both(sight)),
        12.0,
    ),
}


def measure_kernels(pair: Pair, paths: list[Path], *, rounds: int) -> list[dict[str, Any]]:
    """Return the spreads of every kernel in every reading, with what it may take."""
    depths = next(decoded(paths))
    readings = {
        memory: time_calls(
            {name: _call(kernel, pair, depths, where=where) for name, kernel in KERNELS.items()},
            pixels=depths[0].size,
            rounds=rounds,
        )
        for memory, where in _TIGHT.items()
    }
    readings[f"a new array after each decoded frame, {KEPT} kept"] = _after_decoding(
        pair, paths, rounds=rounds
    )
    found = []
    for memory, times in readings.items():
        spreads = beside(times, base=CONVERSION)
        found += [
            {
                "kernel": name,
                "memory": memory,
                "ns_a_pixel": spreads[name],
                "conversion_ns": spreads[CONVERSION]["median"],
                "most": KERNELS[name].most,
            }
            for name in KERNELS
            if name != CONVERSION
        ]
    return found


def decoded(paths: list[Path]) -> Iterator[Depths]:
    """Yield the stored depths of two cameras, frame by frame."""
    with av.open(str(paths[0])) as left, av.open(str(paths[1])) as right:
        for frames in zip(left.decode(video=0), right.decode(video=0), strict=True):
            one, other = (np.ascontiguousarray(frame.to_ndarray()) for frame in frames)
            yield one, other


def _call(
    kernel: Kernel, pair: Pair, depths: Depths, *, where: Literal["the same", "fresh"]
) -> Callable[[], Any]:
    """Return a call that writes into the same array every time, or into fresh memory."""
    inputs, shape = kernel.inputs(pair, depths), depths[0].shape
    if where == "fresh":
        return lambda: kernel.write(inputs, pair, _fresh(shape, kernel.dtype))
    room = np.empty(shape, kernel.dtype)
    return lambda: kernel.write(inputs, pair, room)


def _fresh(shape: tuple[int, ...], dtype: type) -> np.ndarray:
    """Return an array whose memory the system has yet to give, as that of a worker's batch."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    return np.frombuffer(mmap.mmap(-1, size), dtype).reshape(shape)


def _after_decoding(pair: Pair, paths: list[Path], *, rounds: int) -> dict[str, list[float]]:
    """Return nanoseconds a pixel where every map is written into what the allocator gives.

    Each kernel has a loop of its own; of its frames the median counts.
    """
    times: dict[str, list[float]] = {name: [] for name in KERNELS}
    for _ in range(rounds):
        for name, kernel in KERNELS.items():
            kept: deque[np.ndarray] = deque(maxlen=KEPT)
            spent = []
            for depths in islice(decoded(paths), FRAMES):
                inputs = kernel.inputs(pair, depths)
                begin = time.process_time_ns()
                out = np.empty(depths[0].shape, kernel.dtype)
                kernel.write(inputs, pair, out)
                spent.append((time.process_time_ns() - begin) / out.size)
                kept.append(out)
            times[name].append(float(np.median(spent)))
    return times
