"""Maps presentation times to frame numbers, counted in the order of presentation.

`SteadyClock` needs only the header and holds for a constant frame rate; `TableClock` knows the
time of every frame. Times are integers in ticks of the stream's time base.
"""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import Final

import av
from av.container import InputContainer

from stereogenbench_data.errors import MediaError
from stereogenbench_data.media.container import exact, frames_by_duration, stream_codec


@dataclass(frozen=True, slots=True)
class SteadyClock:
    """Frames at one rate: frame i is shown at start + i * step ticks, give or take a rounding."""

    start: int
    step: Fraction

    # A time may be off by a tick, or by a quarter of a step where that is less. It is computed in
    # integers, as every packet asks.

    def index(self, pts: int) -> int | None:
        """Return the frame that is shown at a time, None where the time fits no frame."""
        step, parts = self.step.numerator, self.step.denominator
        since_start = (pts - self.start) * parts
        index = (2 * since_start + step) // (2 * step)
        off = abs(since_start - index * step)
        return index if 4 * off <= min(4 * parts, step) else None

    def latest(self, index: int) -> int:
        """Return the greatest time that counts as a frame's."""
        step, parts = self.step.numerator, self.step.denominator
        return self.start + (4 * index * step + min(4 * parts, step)) // (4 * parts)


@dataclass(frozen=True, slots=True)
class TableClock:
    """Frames at any times, in ascending order."""

    times: Sequence[int]

    def index(self, pts: int) -> int | None:
        """Return the frame that is shown at a time, None where no frame is."""
        index = bisect_left(self.times, pts)
        return index if index < len(self.times) and self.times[index] == pts else None

    def latest(self, index: int) -> int:
        """Return a frame's time."""
        return self.times[index]


Clock = SteadyClock | TableClock


MOST_EXTRA_FRAMES: Final = 2
"""How many frames a video may have beyond those that its scene uses."""


def steady_clock(container: InputContainer, *, frames: int) -> SteadyClock | None:
    """Return the clock that the header describes, None if it contradicts itself or ``frames``.

    An MP4 header lists all samples: their number and decoding times must be those of ``frames``
    frames at one rate, or of a few more. A Matroska header gives only the duration.
    """
    stream = container.streams.video[0]
    rate, time_base = exact(stream.average_rate), exact(stream.time_base)
    if stream.start_time is None or rate is None or time_base is None:
        return None
    step = 1 / (rate * time_base)
    if stream.frames == 0:
        agrees = 0 <= (frames_by_duration(container) or 0) - frames <= MOST_EXTRA_FRAMES
    else:
        entries = list(stream.index_entries)
        agrees = (
            0 <= stream.frames - frames <= MOST_EXTRA_FRAMES
            and stream.frames == len(entries)
            and not any(entry.is_discard for entry in entries)
            and all(abs(b.timestamp - a.timestamp - step) <= 1 for a, b in pairwise(entries))
        )
    return SteadyClock(stream.start_time, step) if agrees else None


def table_clock(
    container: InputContainer, *, name: str, steady: SteadyClock | None = None
) -> TableClock:
    """Return the times of all frames, read by going through all packets from where they stand.

    Frames of an intra-only codec are counted in the order of the file, with which their times
    must agree; and with the rate, if the header gives one.

    Args:
        container: An open file.
        name: What messages call it.
        steady: The clock that the header describes, if it describes one.

    Raises:
        MediaError: If a packet is cut short or carries another packet's time, or one that
            contradicts the order of the file.
    """
    times: list[int] = []

    def cut_short(why: str) -> MediaError:
        return MediaError(
            f"{name}: cannot be read past its frame number {len(times)} as stored ({why}): fetch "
            f"it again."
        )

    try:
        for packet in container.demux(container.streams.video[0]):
            if packet.is_corrupt:
                raise cut_short("its packet is cut short")
            # Without a time no frame can be found: there is one too few, then.
            if packet.size and packet.pts is not None and not packet.is_discard:
                times.append(packet.pts)
    except av.FFmpegError as error:
        raise cut_short(error.strerror) from error
    if stream_codec(container).is_intra_only:
        require_file_order(times, steady, name=name)
    times.sort()
    twice = next((a for a, b in pairwise(times) if a == b), None)
    if twice is not None:
        raise MediaError(
            f"{name}: two frames are shown at the same time ({twice} ticks), so their order is "
            f"not defined: write it again with one time for each frame."
        )
    return TableClock(times)


def require_file_order(times: Sequence[int], steady: SteadyClock | None, *, name: str) -> None:
    """Refuse times that do not ascend as frames are stored, or are not those of the rate.

    Raises:
        MediaError: Naming the first such frame.
    """
    for number, pts in enumerate(times):
        is_after = number == 0 or pts > times[number - 1]
        if not is_after or (steady is not None and steady.index(pts) != number):
            raise MediaError(
                f"{name}: its frame number {number} as stored is shown at {pts} ticks, and its "
                f"codec stores frames in the order in which they are shown, at the rate in the "
                f"header. A time was altered: compare the file with its checksum, or fetch it "
                f"again."
            )
