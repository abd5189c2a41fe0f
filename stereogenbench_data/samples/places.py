"""Where a sample's fields are written: each once, into an array of its own or of its batch."""

from collections.abc import Callable
from typing import Any

import numpy as np

from stereogenbench_data.samples.fields import Field

Room = Callable[[str, tuple[int, ...], Any], Any]
"""What gives the array that a field is written into, of a name, a shape and a dtype."""


def fresh_room(name: str, shape: tuple[int, ...], dtype: Any) -> Any:
    """Return a new array for a field."""
    del name
    return np.empty(shape, dtype=dtype)


class Places:
    """The fields of one sample while it is made, frame by frame and target by target.

    Attributes:
        sample: The fields so far.
        frames: How many frames the sample has.
        at: The frames that are being written.
    """

    def __init__(self, known: dict[str, Field], room: Room, *, frames: int) -> None:
        """Begin a sample of so many frames, of the fields of a table."""
        self.sample: dict[str, Any] = {}
        self.frames = frames
        self.at = slice(0, frames)
        self.is_clip = False
        self.targets: int | None = None
        self._known = known
        self._room = room

    def of(self, name: str, number: int, *, shape: tuple[int, ...], dtype: Any) -> Any:
        """Return where a field of one target is written, now.

        Args:
            name: The field.
            number: The place of the target on the axis of targets.
            shape: What is written: of a field with one value a frame, with a time axis in front.
            dtype: Its dtype.

        Returns:
            An array of that shape, a view of the whole field.
        """
        field = self._known[name]
        is_stacked = field.per_target and self.targets is not None
        if name not in self.sample:
            whole = shape[1:] if field.per_frame else shape
            whole = (self.frames, *whole) if field.per_frame and self.is_clip else whole
            whole = (self.targets or 0, *whole) if is_stacked else whole
            self.sample[name] = self._room(name, whole, np.dtype(dtype))
        own = self.sample[name]
        own = own[number, ...] if is_stacked else own
        if not field.per_frame:
            return own
        return own[self.at] if self.is_clip else own[None]
