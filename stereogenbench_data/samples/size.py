"""The size of pictures: (height, width) in Python, as arrays have it; WIDTHxHEIGHT as text."""

import re
import warnings
from typing import Any, Final

from stereogenbench_data.errors import FieldError

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
        FieldError: If the text is none, or a side is not 1 to 16384 pixels.

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
