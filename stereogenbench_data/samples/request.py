"""What a dataset requests of every sample, and the interface of transforms."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol, runtime_checkable

import numpy as np

from stereogenbench_data.errors import FieldError
from stereogenbench_data.samples.fields import (
    PAIR_FIELDS,
    VIEW_FIELDS,
    Field,
    Stream,
    require_fields,
    streams_of,
)
from stereogenbench_data.samples.size import require_size
from stereogenbench_data.samples.views import Views
from stereogenbench_data.schema.records import DepthEncoding

Clip = Literal["frame", "clip"]
Kind = Literal["pairs", "views"]
Layout = Literal["single", "stacked"]


@runtime_checkable
class Transform(Protocol):
    """A function that changes pictures and cameras together.

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

    kind: Kind
    fields: tuple[str, ...]
    layout: Layout
    size: tuple[int, int] | None = None
    depth: DepthEncoding | None = None
    transform: Transform | None = None

    @property
    def known(self) -> dict[str, Field]:
        """The table of fields of this kind of sample."""
        return PAIR_FIELDS if self.kind == "pairs" else VIEW_FIELDS

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


def parse_request(
    kind: Kind,
    layout: Layout,
    *,
    fields: Iterable[str],
    size: Any,
    depth: Any,
    transform: Any,
) -> Request:
    """Return what a user asks of every sample.

    Raises:
        FieldError: If a field does not exist; if the size is not two whole numbers of 1 to 16384;
            if depth is not a `DepthEncoding`; or if the transform cannot be called, lacks
            ``swaps_views``, or swaps the views of samples that are not pairs.
    """
    return Request(
        kind=kind,
        fields=require_fields(fields, known=PAIR_FIELDS if kind == "pairs" else VIEW_FIELDS),
        layout=layout,
        size=None if size is None else require_size(size),
        depth=_require_depth(depth),
        transform=_require_transform(transform, kind=kind),
    )


def _require_depth(depth: Any) -> DepthEncoding | None:
    if depth is not None and not isinstance(depth, DepthEncoding):
        raise FieldError(f"depth must be a DepthEncoding(...), got {depth!r}.")
    return depth


def _require_transform(transform: Any, *, kind: Kind) -> Transform | None:
    if transform is None:
        return None
    says = isinstance(getattr(transform, "swaps_views", None), bool)
    if not says or not callable(transform) or isinstance(transform, type):
        raise FieldError(
            f"a transform is called with (views, generator) and has an attribute swaps_views, True "
            f"or False; got {transform!r}."
        )
    if kind == "views" and transform.swaps_views:
        raise FieldError("SceneViews takes no flip: it swaps the two views of a pair.")
    checked: Transform = transform
    return checked
