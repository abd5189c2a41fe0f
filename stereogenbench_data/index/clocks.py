"""Whether frame n of all videos of a scene is one moment, by the times at which frames are shown.

Frames are matched by number, never by time. So times may only confirm it: from each first frame on,
those of all videos agree by half a step to the next frame. Steps may vary, in all videos alike.
When a video begins does not matter, unless videos have different numbers of frames.
"""

from collections.abc import Iterator, Mapping, Sequence
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
        tick_s: What times are rounded to.
        rate_hz: The rate in its header; 0 where it has none.
    """

    name: str
    begins_s: float
    shown_s: Float64[np.ndarray, " frames"]
    tick_s: float
    rate_hz: float

    def allowed_s(self, other: "_Clock") -> Float64[np.ndarray, " frames"]:
        """Return by how much the times of another video may differ.

        Half a step, on average of those before and behind a frame, or what times are rounded to.
        """
        steps_s = np.diff(self.shown_s)
        around_s = np.concatenate([steps_s[:1], (steps_s[:-1] + steps_s[1:]) / 2, steps_s[-1:]])
        return np.maximum(around_s / 2, self.tick_s + other.tick_s)

    def first_off(self, other: "_Clock") -> int | None:
        """Return the first frame that another video shows at another time; None if none is."""
        frames = min(len(self.shown_s), len(other.shown_s))
        if frames < 2:
            return None
        off_s = np.abs(other.shown_s[:frames] - self.shown_s[:frames])
        is_off = off_s > self.allowed_s(other)[:frames]
        return int(is_off.argmax()) if is_off.any() else None

    def step_s(self) -> tuple[float, float]:
        """Return the mean step between frames, and by how much rounding may have changed it.

        Where the header gives a rate that rounded times do not contradict, it is that of the rate.
        """
        steps = len(self.shown_s) - 1
        mean_s, rounding_s = float(self.shown_s[-1]) / steps, self.tick_s / steps
        if self.rate_hz and abs(1 / self.rate_hz - mean_s) <= rounding_s:
            return 1 / self.rate_hz, 0.0
        return mean_s, rounding_s


def require_one_clock(key: str, videos: Mapping[str, StreamFacts]) -> tuple[Remark, ...]:
    """Refuse videos whose frames of one number are shown at different times.

    Args:
        key: The scene.
        videos: What each video is, by its name. Those whose times are not known are passed over.

    Returns:
        A remark where rates differ by too little to show in so few frames.

    Raises:
        StorageError: If they are; it names the file, the frame and the cure.
    """
    clocks = list(_clocks(videos))
    if not clocks:
        return ()
    usual = max(clocks, key=lambda clock: len(_like(clock, clocks)))
    like = _like(usual, clocks)
    others = f"that of {counted(len(like), 'other video')}, such as {usual.name},"
    odd = [each for each in clocks if each not in like]
    for each in odd[:1]:
        frame = usual.first_off(each) or 0
        more = f" ({', '.join(other.name for other in odd[1:])} likewise)" if odd[1:] else ""
        raise StorageError(
            f"{key}/{each.name}: its frame {frame} is shown {each.shown_s[frame]:.3f} s after its "
            f"first one, and {others} {usual.shown_s[frame]:.3f} s after{more}. So frames of one "
            f"number are not one moment: some were dropped, doubled or added, or it has another "
            f"rate. {_CURE}"
        )
    if len({len(each.shown_s) for each in clocks}) > 1:
        for each in clocks:
            if abs(each.begins_s - usual.begins_s) > usual.allowed_s(each)[0]:
                raise StorageError(
                    f"{key}/{each.name}: its frame 0 is shown at {each.begins_s:.3f} s, and "
                    f"{others} at {usual.begins_s:.3f} s, and they have different numbers of "
                    f"frames. So frames of one number are not one moment: some are missing at an "
                    f"end. {_CURE}"
                )
    return tuple(_of_rates(key, usual, clocks))


def _clocks(videos: Mapping[str, StreamFacts]) -> Iterator[_Clock]:
    for name, facts in videos.items():
        if facts.times is not None:
            tick_s = float(facts.times.tick_s)
            times_s = np.array(facts.times.ticks, dtype=np.float64) * tick_s
            begins_s = float(times_s[0])
            yield _Clock(name, begins_s, times_s - begins_s, tick_s, facts.frame_rate_hz)


def _like(clock: _Clock, clocks: Sequence[_Clock]) -> list[_Clock]:
    return [each for each in clocks if clock.first_off(each) is None]


def _of_rates(key: str, usual: _Clock, clocks: Sequence[_Clock]) -> Iterator[Remark]:
    """Yield a remark about the first video with another rate than most."""
    if min(len(each.shown_s) for each in clocks) < 2:
        return
    usual_s, usual_rounding_s = usual.step_s()
    for each in clocks:
        step_s, rounding_s = each.step_s()
        if abs(step_s - usual_s) > _SAME_RATE * usual_s + rounding_s + usual_rounding_s:
            yield Remark(
                "rate",
                f"{key}/{each.name}: shows {1 / step_s:.6g} frames a second, and {usual.name} "
                f"{1 / usual_s:.6g}",
            )
            return
