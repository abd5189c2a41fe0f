"""What is asked of every sample, and what may change one on its way."""

from dataclasses import dataclass
from typing import Final, Literal, Protocol, runtime_checkable

import numpy as np

from stereogenbench_data.samples.derive import PAIR_BUILDERS, VIEW_BUILDERS, Builder
from stereogenbench_data.samples.fields import (
    PAIR_FIELDS,
    VIEW_FIELDS,
    Field,
    Stream,
    streams_of,
)
from stereogenbench_data.samples.views import Views
from stereogenbench_data.schema.records import DepthEncoding

Clip = Literal["frame", "clip"]


@runtime_checkable
class Transform(Protocol):
    """What changes pictures and cameras together.

    ``swaps_views`` says whether source and target may change places, so that what one view needs
    must be read of both.
    """

    @property
    def swaps_views(self) -> bool:
        """Whether source and target may change places."""
        ...

    def __call__(self, views: Views, generator: np.random.Generator) -> Views:
        """Return the changed views."""
        ...


@dataclass(frozen=True, slots=True)
class Request:
    """What a dataset asks of every sample.

    Attributes:
        kind: "pairs" (fields of `PAIR_FIELDS`) or "views" (of `VIEW_FIELDS`).
        fields: The fields, in order.
        layout: "single": what each target has stands for itself; "stacked": with an axis of
            targets in front.
        size: (height, width) to which the decoder scales, None for the stored size.
        depth: A depth contract that overrides what the index says, or None.
        transform: What changes the views before fields are derived, or None.
    """

    kind: Literal["pairs", "views"]
    fields: tuple[str, ...]
    layout: Literal["single", "stacked"]
    size: tuple[int, int] | None = None
    depth: DepthEncoding | None = None
    transform: Transform | None = None

    @property
    def known(self) -> dict[str, Field]:
        """The table of fields of this kind of sample."""
        return PAIR_FIELDS if self.kind == "pairs" else VIEW_FIELDS

    @property
    def builders(self) -> dict[str, Builder]:
        """What builds each field that is not text."""
        return PAIR_BUILDERS if self.kind == "pairs" else VIEW_BUILDERS

    @property
    def streams(self) -> frozenset[Stream]:
        """The videos that the fields are made from, whichever way the transform turns."""
        streams = streams_of(self.fields, known=self.known)
        if self.transform is not None and self.transform.swaps_views:
            streams |= {SWAPPED[stream] for stream in streams}
        return streams


SWAPPED: Final[dict[Stream, Stream]] = {
    "source_rgb": "target_rgb",
    "target_rgb": "source_rgb",
    "source_depth": "target_depth",
    "target_depth": "source_depth",
}
