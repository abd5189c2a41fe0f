"""Whether frame n of all videos of a scene is one moment, by the times at which frames are shown.

Frames are matched by number, never by time. So times may only confirm it: from each first frame on,
those of all videos agree by half a step to the next frame. Steps may vary, in all videos alike.
When a video begins does not matter, unless videos have different numbers of frames.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.errors import StorageError
from stereogenbench_data.media.container import StreamFacts
from stereogenbench_data.schema.records import Remark
from stereogenbench_data.schema.text import counted

_SAME_RATE: Final = 0.0005
"""By what share two rates may differ: half of what 29.97 and 30 Hz do."""
_CURE: Final = "Encode it again from all of its frames, fetch the scene again, or leave it out."


@dataclass(frozen=True, slots=True, eq=False)
class _Clock:
    """When the frames of a video are shown.

    Attributes:
        name: The video.
        begins_s: When its first frame is shown.
        shown_s: When each frame is shown, after the first one.
        half_steps_s: Half the steps around each frame, on average of those before and behind it.
        tick_s: What times are rounded to.
        rate_hz: The rate in its header; 0 where it has none.
    """

    name: str
    begins_s: float
    shown_s: Float64[np.ndarray, " frames"]
    half_steps_s: Float64[np.ndarray, " frames"]
    tick_s: float
    rate_hz: float

    def first_off(self, other: "_Clock") -> int | None:
        """Return the first frame that another video shows at another time; None if none is."""
        frames = min(len(self.shown_s), len(other.shown_s))
        own, its = ((each.shown_s[:frames], each.half_steps_s[:frames]) for each in (self, other))
        allowed_s = np.maximum(np.minimum(own[1], its[1]), self.tick_s + other.tick_s)
        is_off = np.abs(own[0] - its[0]) > allowed_s
        return int(is_off.argmax()) if is_off.any() else None

    def begins_with(self, other: "_Clock") -> bool:
        """Return whether another video begins at the same time."""
        allowed_s = max(self.half_steps_s[0], self.tick_s + other.tick_s)
        return bool(abs(other.begins_s - self.begins_s) <= allowed_s)

    def step_s(self) -> tuple[float, float] | None:
        """Return the step between frames, and by how much rounding may have changed it.

        Where the header gives a rate that rounded times do not contradict, it is that of the rate.
        None where steps vary.
        """
        steps = len(self.shown_s) - 1
        mean_s, rounding_s = float(self.shown_s[-1]) / steps, self.tick_s / steps
        if np.abs(self.shown_s - np.arange(steps + 1) * mean_s).max() > self.tick_s:
            return None
        if self.rate_hz and abs(1 / self.rate_hz - mean_s) <= rounding_s:
            return 1 / self.rate_hz, 0.0
        return mean_s, rounding_s


def require_one_clock(key: str, videos: Mapping[str, StreamFacts]) -> tuple[Remark, ...]:
    """Refuse videos whose frames of one number are shown at different times.

    Args:
        key: The scene.
        videos: What each video is, by its name. Those whose times are not known are passed over,
            and those of a single frame.

    Returns:
        A remark where rates differ by too little to show in so few frames.

    Raises:
        StorageError: If they are; it names the file, the frame and the cure.
    """
    clocks = [clock for clock in _clocks(videos) if len(clock.shown_s) > 1]
    if not clocks:
        return ()
    usual, odd = _parted(clocks, lambda a, b: a.first_off(b) is None)
    if odd:
        name, frame = odd[0].name, usual.first_off(odd[0]) or 0
        more = f" ({', '.join(each.name for each in odd[1:])} likewise)" if odd[1:] else ""
        raise StorageError(
            f"{key}/{name}: its frame {frame} is shown {odd[0].shown_s[frame]:.3f} s after its "
            f"first one, and that of {counted(len(clocks) - len(odd), 'other video')}, such as "
            f"{usual.name}, {usual.shown_s[frame]:.3f} s after{more}. So frames of one number are "
            f"not one moment: some were dropped, doubled or added, or it has another rate. {_CURE}"
        )
    if len({len(each.shown_s) for each in clocks}) > 1:
        _require_one_begin(key, clocks)
    return tuple(_of_rates(key, usual, clocks))


def _require_one_begin(key: str, clocks: Sequence[_Clock]) -> None:
    """Refuse videos of different lengths of which one begins later."""
    usual, odd = _parted(clocks, _Clock.begins_with)
    if odd:
        more = f" ({', '.join(each.name for each in odd[1:])} likewise)" if odd[1:] else ""
        raise StorageError(
            f"{key}/{odd[0].name}: its frame 0 is shown at {odd[0].begins_s:.3f} s, and that of "
            f"{counted(len(clocks) - len(odd), 'other video')}, such as {usual.name}, at "
            f"{usual.begins_s:.3f} s{more}, and not all have the same number of frames. So frames "
            f"of one number are not one moment: some are missing at an end. {_CURE}"
        )


def _parted(
    clocks: Sequence[_Clock], are_alike: Callable[[_Clock, _Clock], bool]
) -> tuple[_Clock, list[_Clock]]:
    """Return the first clock that is like most others, and those that are not like it."""
    usual = max(clocks, key=lambda clock: sum(are_alike(clock, each) for each in clocks))
    return usual, [each for each in clocks if not are_alike(usual, each)]


def _clocks(videos: Mapping[str, StreamFacts]) -> Iterator[_Clock]:
    for name, facts in videos.items():
        if facts.times is not None:
            tick_s = float(facts.times.tick_s)
            times_s = np.array(facts.times.ticks, dtype=np.float64) * tick_s
            begins_s, steps_s = float(times_s[0]), np.diff(times_s)
            around_s = [steps_s[:1], (steps_s[:-1] + steps_s[1:]) / 2, steps_s[-1:]]
            halves_s = np.concatenate(around_s) / 2
            yield _Clock(name, begins_s, times_s - begins_s, halves_s, tick_s, facts.frame_rate_hz)


def _of_rates(key: str, usual: _Clock, clocks: Sequence[_Clock]) -> Iterator[Remark]:
    """Yield a remark about the first video with another rate than most."""
    usual_step = usual.step_s()
    for each in clocks:
        step = each.step_s()
        if usual_step is None or step is None:
            continue
        if abs(step[0] - usual_step[0]) > _SAME_RATE * usual_step[0] + step[1] + usual_step[1]:
            yield Remark(
                "rate",
                f"{key}/{each.name}: shows {1 / step[0]:.6g} frames a second, and {usual.name} "
                f"{1 / usual_step[0]:.6g}",
            )
            return
