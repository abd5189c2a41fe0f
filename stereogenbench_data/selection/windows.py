"""Which frames: windows on a scene's frames, as arithmetic on integers.

A window is the frames of one sample: one frame, or a clip of several.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from stereogenbench_data.errors import SelectionError

FramesSpec = (
    Literal["first", "all"]
    | int
    | Sequence[int]
    | tuple[Literal["every"], int]
    | tuple[Literal["random"], int]
    | tuple[Literal["clips"], int, int, int]
    | tuple[Literal["random clips"], int, int, int]
)


@dataclass(frozen=True, slots=True)
class Chosen:
    """The named frames, one a window."""

    frames: tuple[int, ...]
    is_clip: bool = False

    def count(self, frames: int) -> int:
        """Return the number of named frames, all of which the scene must have."""
        if max(self.frames) >= frames:
            raise SelectionError(
                f"frame {max(self.frames)} is asked for of a scene with {frames} frames, "
                f"0 to {frames - 1}. {_leave_out(max(self.frames) + 1)}"
            )
        return len(self.frames)

    def window(self, number: int, *, frames: int, draw: Sequence[int]) -> tuple[int, ...]:
        """Return one named frame."""
        return (self.frames[number],)


@dataclass(frozen=True, slots=True)
class Every:
    """Every k-th frame from frame 0, one a window."""

    step: int
    is_clip: bool = False

    def count(self, frames: int) -> int:
        """Return the number of k-th frames."""
        return -(-frames // self.step)

    def window(self, number: int, *, frames: int, draw: Sequence[int]) -> tuple[int, ...]:
        """Return one frame."""
        return (number * self.step,)


@dataclass(frozen=True, slots=True)
class Clips:
    """Clips of ``length`` frames, ``stride`` frames apart, a clip starting every ``step`` frames.

    A clip that would reach beyond the last frame is not taken.
    """

    length: int
    stride: int = 1
    step: int = 1
    is_clip: bool = True

    def count(self, frames: int) -> int:
        """Return how many clips fit; a scene in which none fits is refused."""
        span = (self.length - 1) * self.stride + 1
        if span > frames:
            raise SelectionError(
                f"a clip of {self.length} frames with stride {self.stride} spans {span} frames; "
                f"a scene has {frames}. {_leave_out(span)}"
            )
        return (frames - span) // self.step + 1

    def window(self, number: int, *, frames: int, draw: Sequence[int]) -> tuple[int, ...]:
        """Return the frames of one clip."""
        start = number * self.step
        return tuple(range(start, start + self.length * self.stride, self.stride))


@dataclass(frozen=True, slots=True)
class Random:
    """n different windows of each scene, drawn from others anew for every epoch, ascending."""

    n: int
    drawn_from: Every | Clips = Every(1)

    @property
    def is_clip(self) -> bool:
        """Whether they are clips."""
        return self.drawn_from.is_clip

    def count(self, frames: int) -> int:
        """Return n, for which a scene must have enough windows."""
        there = self.drawn_from.count(frames)
        if self.n > there:
            what = f"{there} clips" if self.is_clip else f"{there} frames"
            raise SelectionError(
                f"{self.n} windows a scene are to be drawn at random, more than the {what} of a "
                f"scene: ask for fewer. {_leave_out(frames + self.n - there)}"
            )
        return self.n

    def window(self, number: int, *, frames: int, draw: Sequence[int]) -> tuple[int, ...]:
        """Return one of the windows drawn."""
        generator = np.random.default_rng(np.random.SeedSequence(tuple(draw)))
        there = self.drawn_from.count(frames)
        drawn = int(np.sort(generator.choice(there, size=self.n, replace=False))[number])
        return self.drawn_from.window(drawn, frames=frames, draw=draw)


Windows = Chosen | Every | Random | Clips
"""A rule that gives the windows of a scene with a known number of frames.

``is_clip`` says whether a sample has a time axis, ``count(frames)`` how many windows a scene of so
many frames has, and ``window(number, frames=, draw=)`` the frames of one; ``draw`` seeds what is
drawn at random.
"""


def run_starts(
    windows: Windows, *, frames: int, key_frames: Sequence[int], least: int
) -> tuple[int, ...]:
    """Return the windows with which runs begin: groups of windows that decode by themselves.

    A run holds the windows whose first frames lie between two key frames, with ``least`` frames or
    more from the one to the other. Windows drawn at random, of which only the number is known
    before, are dealt evenly to as many runs.
    """
    count = windows.count(frames)
    cuts = [0]
    for key in key_frames:
        if key - cuts[-1] >= least and frames - key >= least:
            cuts.append(key)
    if isinstance(windows, Random):
        runs = min(count, len(cuts))
        return tuple(count * number // runs for number in range(runs))
    first = [windows.window(number, frames=frames, draw=(0,))[0] for number in range(count)]
    run = np.searchsorted(cuts, first, side="right")
    return tuple(np.flatnonzero(np.diff(run, prepend=-1)).tolist())


def key_distance(windows: Windows, *, key_frames: Sequence[int]) -> int:
    """Return how many windows lie between those that are key frames, 1 if that is not regular."""
    apart = np.unique(np.diff(key_frames))
    if isinstance(windows, Every) and len(apart) == 1 and apart[0] % windows.step == 0:
        return int(apart[0]) // windows.step
    return 1


def _leave_out(min_frames: int) -> str:
    return f"To leave shorter scenes out, give min_frames={min_frames}."


def parse_frames(spec: Any) -> Windows:
    """Return the windows that a user's ``frames=`` asks for.

    Args:
        spec: "first", "all", a frame number, a sequence of them, ("every", k), ("random", n),
            ("clips", length), ("clips", length, stride) or ("clips", length, stride, step);
            stride is 1 and step is the clip's span where left out, so that clips do not overlap.
            ("random clips", n, length) or ("random clips", n, length, stride): n clips that start
            anywhere. Or any `Windows`.

    Raises:
        SelectionError: If it is none of these, or a number in it is out of range.
    """
    if isinstance(spec, Windows):
        return spec
    if isinstance(spec, str):
        named: dict[str, Windows] = {"first": Chosen((0,)), "all": Every(1)}
        if spec in named:
            return named[spec]
    elif isinstance(spec, int | np.integer):
        return Chosen((_whole(spec, least=0),))
    elif isinstance(spec, Sequence) and len(spec) > 0 and isinstance(spec[0], str):
        found = _of_kind(spec[0], [_whole(number, least=1) for number in spec[1:]])
        if found is not None:
            return found
    elif isinstance(spec, Sequence | np.ndarray) and len(spec) > 0:
        frames = tuple(_whole(number, least=0) for number in spec)
        if len(set(frames)) < len(frames):
            raise SelectionError(f"frames={spec!r} names a frame twice.")
        return Chosen(tuple(sorted(frames)))
    raise SelectionError(
        f"frames={spec!r} is not understood; use 'first', 'all', a frame number, a list of them, "
        "('every', k), ('random', n), ('clips', length, stride, step) or ('random clips', n, "
        "length, stride)."
    )


def _of_kind(kind: str, numbers: list[int]) -> Windows | None:
    match kind, numbers:
        case "every", [step]:
            return Every(step)
        case "random", [n]:
            return Random(n)
        case "clips", [length, *more] if len(more) <= 2:
            stride = more[0] if more else 1
            return Clips(length, stride, more[1] if len(more) == 2 else (length - 1) * stride + 1)
        case "random clips", [n, length, *more] if len(more) <= 1:
            return Random(n, Clips(length, more[0] if more else 1))
    return None


def _whole(number: Any, *, least: int) -> int:
    if isinstance(number, bool) or not isinstance(number, int | np.integer) or number < least:
        raise SelectionError(f"frames must be whole numbers of at least {least}, got {number!r}.")
    return int(number)
