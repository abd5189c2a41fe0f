"""The writer: from `Views` to the arrays of a sample, each written once where it will stay."""

from collections.abc import Callable
from typing import Any

import numpy as np

from stereogenbench_data.samples.derive import PairSample, SceneFacts
from stereogenbench_data.samples.fields import Field, Sample
from stereogenbench_data.samples.request import Clip, Request
from stereogenbench_data.samples.views import Views
from stereogenbench_data.selection.plan import Address

Allocate = Callable[[str, tuple[int, ...], Any], Any]
"""Returns the array that a field is written into, of a name, a shape and a dtype."""


def new_array(name: str, shape: tuple[int, ...], dtype: Any) -> Any:
    """Return a new array for a field."""
    del name
    return np.empty(shape, dtype=dtype)


class SampleWriter:
    """Writes the fields of one sample, some frames at a time, into arrays that it allocates once.

    Attributes:
        sample: The fields so far.
    """

    def __init__(
        self, request: Request, address: Address, *, clip: Clip, allocate: Allocate
    ) -> None:
        """Begin a sample.

        Args:
            request: Its fields and their layout.
            address: Its cameras and frames.
            clip: "clip" where the fields have a time axis, else "frame".
            allocate: Returns the array of a field; called once for each.
        """
        self.sample: Sample = {}
        known = request.known
        self._fields = [known[name] for name in request.fields]
        self._kind = request.kind
        self._address = address
        self._is_clip = clip == "clip"
        self._targets: int | None = None
        if request.layout == "stacked":
            self._targets = len(address.targets) + (self._kind == "views")
        self._allocate = allocate

    def pictures(self, frames: slice, *, size: tuple[int, int]) -> dict[int, Any]:
        """Return by camera where to decode pictures that are a field exactly as decoded.

        Args:
            frames: Which frames of the sample.
            size: Height and width of the pictures.
        """
        shape = (len(self._address.frames[frames]), 3, *size)
        found: dict[int, Any] = {}
        for field in self._fields:
            if field.shows is None:
                continue
            source, targets = self._address.source, self._address.targets
            shown = (source,) if field.shows == "source" else self._target_cameras(source, targets)
            for number, camera in enumerate(shown):
                found[camera] = self._part(field, number, frames, shape=shape, dtype="u1")
        return found

    def write(self, views: Views, facts: SceneFacts, frames: slice) -> None:
        """Write every field for some frames of the sample.

        Args:
            views: These frames.
            facts: What is known of their scene.
            frames: Where they lie on the sample's time axis.
        """
        pairs = [
            PairSample(views, facts, target)
            for target in self._target_cameras(views.source, views.targets)
        ]
        for field in self._fields:
            for number, pair in enumerate(pairs if field.per_target else pairs[:1]):
                if field.write is not None:
                    count, height, width = pair.shape
                    shape = (count, 1, height, width)
                    part = self._part(field, number, frames, shape=shape, dtype="f4")
                    field.write(pair, part[:, 0])
                elif field.make is not None:
                    value = field.make(pair)
                    if field.dtype == "str":
                        self.sample[field.name] = value
                        continue
                    part = self._part(field, number, frames, shape=value.shape, dtype=value.dtype)
                    # A picture may have been decoded here.
                    if not np.may_share_memory(value, part):
                        np.copyto(part, value)

    def _target_cameras(self, source: int, targets: tuple[int, ...]) -> tuple[int, ...]:
        """Return the cameras along the axis of targets: of views the first is the source itself."""
        return (source, *targets) if self._kind == "views" else targets

    def _part(
        self, field: Field, number: int, frames: slice, *, shape: tuple[int, ...], dtype: Any
    ) -> Any:
        """Return where a field of one target is written, for some frames.

        Args:
            field: The field, which is allocated if it is not yet.
            number: The place of the target on the axis of targets.
            frames: Which frames of the sample.
            shape: The shape of what is written, with a time axis in front if it is per frame.
            dtype: Its dtype.

        Returns:
            An array of that shape, a view of the whole field.
        """
        is_stacked = field.per_target and self._targets is not None
        if field.name not in self.sample:
            whole = shape[1:] if field.per_frame else shape
            if field.per_frame and self._is_clip:
                whole = (len(self._address.frames), *whole)
            if is_stacked:
                whole = (self._targets or 0, *whole)
            self.sample[field.name] = self._allocate(field.name, whole, np.dtype(dtype))
        own = self.sample[field.name]
        own = own[number, ...] if is_stacked else own
        if not field.per_frame:
            return own
        return own[frames] if self._is_clip else own[None]
