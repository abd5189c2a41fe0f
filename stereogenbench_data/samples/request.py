"""What a dataset asks of every sample, and the interface of transforms.

The size of pictures is (height, width) in Python, as arrays have it, and WIDTHxHEIGHT as text.
"""

import re
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol, runtime_checkable

import numpy as np

from stereogenbench_data.errors import FieldError
from stereogenbench_data.samples.fields import PAIR_FIELDS, VIEW_FIELDS, Field, Stream
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


LARGEST_SIDE_PX: Final = 16384

_LARGE_STRETCH: Final = 1.5
_TEXT: Final = re.compile(r"(\d+)x(\d+)", re.ASCII | re.IGNORECASE)


class SwappedSizeWarning(UserWarning):
    """A size looks like (width, height), but (height, width) is expected."""


class EnlargedSizeWarning(UserWarning):
    """A size is larger than training shards store: pictures are enlarged, not sharpened."""


def parse_size(text: str) -> tuple[int, int]:
    """Return the (height, width) in pixels of a text WIDTHxHEIGHT.

    Raises:
        FieldError: If the text is not a size, or a side is not 1 to 16384 pixels.

    >>> parse_size("832x480")
    (480, 832)
    """
    match = _TEXT.fullmatch(text.strip())
    sides = (int(match[2]), int(match[1])) if match else (0, 0)
    if not all(0 < side <= LARGEST_SIDE_PX for side in sides):
        raise FieldError(
            f"size must be WIDTHxHEIGHT of 1 to {LARGEST_SIDE_PX} pixels, such as 832x480, got "
            f"{text!r}."
        )
    return sides


def require_size(size: Any) -> tuple[int, int]:
    """Return a (height, width) in pixels.

    Args:
        size: (height, width), or a text WIDTHxHEIGHT.

    Raises:
        FieldError: If it is not two whole numbers of 1 to 16384, nor such a text.
    """
    if isinstance(size, str):
        return parse_size(size)
    try:
        height, width = (int(side) for side in size)
        whole = (height, width) == tuple(size)
    except (TypeError, ValueError):
        whole = False
    if not whole or not (0 < height <= LARGEST_SIDE_PX and 0 < width <= LARGEST_SIDE_PX):
        raise FieldError(
            f"size must be (height, width) of 1 to {LARGEST_SIDE_PX} pixels, or a text "
            f"'WIDTHxHEIGHT', got {size!r}."
        )
    return height, width


def warn_if_swapped(size: tuple[int, int], *, stored: tuple[int, int]) -> None:
    """Warn if a size turns wide pictures into high ones, or high into wide, by stretching them.

    Args:
        size: The requested (height, width) in pixels.
        stored: (height, width) in pixels of the stored pictures.

    A square picture counts as wide: the usual sizes are.
    """
    aspect, stored_aspect = size[1] / size[0], stored[1] / stored[0]
    stretch = max(aspect / stored_aspect, stored_aspect / aspect)
    is_turned = aspect < 1 <= stored_aspect or stored_aspect < 1 < aspect
    if is_turned and stretch >= _LARGE_STRETCH:
        warnings.warn(
            f"size {size!r} is (height, width), {size[1]} wide and {size[0]} high: the stored "
            f"pictures, {stored[1]} wide and {stored[0]} high, are stretched by {stretch:.2g}. "
            f"Did you mean size=({size[1]}, {size[0]}), on the command line "
            f"--size {size[0]}x{size[1]}?",
            SwappedSizeWarning,
            stacklevel=2,
        )
