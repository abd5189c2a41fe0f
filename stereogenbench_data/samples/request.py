"""What a dataset asks of every sample, and the interface of transforms."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol, runtime_checkable

import numpy as np

from stereogenbench_data.errors import FieldError
from stereogenbench_data.samples.fields import PAIR_FIELDS, VIEW_FIELDS, Field, Stream
from stereogenbench_data.samples.size import require_size
from stereogenbench_data.samples.views import Views
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.selection.options import did_you_mean

Clip = Literal["frame", "clip"]
Kind = Literal["pairs", "views"]
Layout = Literal["single", "stacked"]


@runtime_checkable
class Transform(Protocol):
    """A function that changes pictures and cameras together."""

    @property
    def swaps_views(self) -> bool:
        """Whether source and target may change places: what one needs is then read of both."""

    def __call__(self, views: Views, generator: np.random.Generator) -> Views:
        """Return the changed views."""


@dataclass(frozen=True, slots=True)
class Request:
    """What a dataset asks of every sample.

    Attributes:
        kind: "pairs" (fields of `PAIR_FIELDS`) or "views" (of `VIEW_FIELDS`).
        fields: The fields, in order.
        layout: "single": of one target; "stacked": with an axis of targets in front.
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
        """The videos that the fields are made from, before or after a swap of the views."""
        none: frozenset[Stream] = frozenset()
        streams = none.union(*(self.known[name].streams for name in self.fields))
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
    options: Mapping[str, Any],
) -> Request:
    """Return what a user asks of every sample; of the options, size, depth and transform.

    Raises:
        FieldError: If a field does not exist, is named twice, or none is named; if the size is not
            two whole numbers of 1 to 16384; if depth is not a `DepthEncoding`; or if the transform
            cannot be called, lacks ``swaps_views``, or swaps the views of samples that are not
            pairs.
    """
    known = PAIR_FIELDS if kind == "pairs" else VIEW_FIELDS
    names = (fields,) if isinstance(fields, str) else tuple(fields)
    unknown = [name for name in names if name not in known]
    if unknown:
        hint = did_you_mean(str(unknown[0]), known)
        raise FieldError(
            f"there is no field {unknown[0]!r}{hint} The fields are {', '.join(known)}."
        )
    if not names or len(set(names)) < len(names):
        raise FieldError(f"fields must be at least one and each only once, got {names!r}.")
    size, depth, transform = (options.get(name) for name in ("size", "depth", "transform"))
    if size is not None:
        size = require_size(size)
    if depth is not None and not isinstance(depth, DepthEncoding):
        raise FieldError(f"depth must be a DepthEncoding(...), got {depth!r}.")
    if transform is not None:
        _require_transform(transform, kind=kind)
    return Request(kind, names, layout, size, depth, transform)


def _require_transform(transform: Any, *, kind: Kind) -> None:
    says = isinstance(getattr(transform, "swaps_views", None), bool)
    if not says or not callable(transform) or isinstance(transform, type):
        raise FieldError(
            f"a transform is called with (views, generator) and has an attribute swaps_views, True "
            f"or False; got {transform!r}."
        )
    if kind == "views" and transform.swaps_views:
        raise FieldError(
            f"SceneViews takes no transform that swaps the two views of a pair, got "
            f"{transform!r}: leave it out."
        )
