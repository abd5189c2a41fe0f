"""Drawing tools: colour scales with ticks, pages with captions, and matplotlib's figures."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Bool, Float
from PIL import Image, ImageDraw, ImageFont

from stereogenbench_data.errors import missing_extra
from stereogenbench_data.samples.picture import NOT_MEASURED, Picture, coloured


def figure_class() -> Any:
    """Return matplotlib's `Figure`, which draws without a display.

    Raises:
        ExtraError: If matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_extra("plots", "plots", error) from error
    return Figure


@dataclass(frozen=True, slots=True)
class ColourScale:
    """The range of absolute values that a map's colours cover.

    Attributes:
        low: The smallest value with a colour of its own, above 0 for "log".
        high: The largest such value.
        kind: "linear", from blue to red, for disparity; or "log", from red to blue, for depth: red
            is near in both.
    """

    low: float
    high: float
    kind: Literal["linear", "log"] = "linear"

    def paint(
        self, values: Float[np.ndarray, "h w"], *, measured: Bool[np.ndarray, "h w"]
    ) -> Picture:
        """Return a map in this scale's colours, grey where not measured."""
        places = np.clip(self.place(np.clip(np.abs(values), self.low, self.high)), 0, 1)
        if self.kind == "log":
            places = 1 - places
        return coloured(places, measured=measured, largest=1.0)

    def place(self, value: Any) -> Any:
        """Return the position of values (a number or an array): 0 at the low end, 1 at the high."""
        if self.kind == "log":
            return np.log(value / self.low) / max(math.log(self.high / self.low), 1e-12)
        return (value - self.low) / max(self.high - self.low, 1e-12)

    def ticks(self, most: int) -> list[float]:
        """Return at most ``most`` round numbers within the range, ascending.

        >>> ColourScale(0.0, 87.0).ticks(5)
        [0.0, 20.0, 40.0, 60.0, 80.0]
        >>> ColourScale(1.5, 120.0, "log").ticks(6)
        [2.0, 5.0, 10.0, 20.0, 50.0, 100.0]
        """
        for found in self._tick_sets():
            if len(found) <= most:
                return found
        return []

    def _tick_sets(self) -> Iterator[list[float]]:
        """Yield sets of round numbers, each with fewer than the one before."""
        exponent = math.floor(math.log10(max(self.high - self.low, 1e-12))) - 2
        if self.kind == "log" and self.high > 4 * self.low:
            powers = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
            for factors in ((1, 1.5, 2, 3, 5, 7), (1, 2, 5), (1, 3), (1,)):
                numbers = [factor * 10.0**power for power in powers for factor in factors]
                yield [number for number in numbers if self.low <= number <= self.high]
        for power in range(exponent, exponent + 4):
            for factor in (1, 2, 5):
                step = factor * 10.0**power
                first, last = math.ceil(self.low / step), math.floor(self.high / step)
                yield [round(number * step, 12) for number in range(first, last + 1)]


def scale_of(
    values: Float[np.ndarray, "..."],
    *,
    measured: Bool[np.ndarray, "..."],
    kind: Literal["linear", "log"] = "linear",
) -> ColourScale:
    """Return a scale for the middle 96 % of measured values; a linear one starts at 0 if it can."""
    found = np.abs(values[measured])
    if found.size == 0:
        return ColourScale(1.0 if kind == "log" else 0.0, 2.0, kind)
    low, high = (float(each) for each in np.percentile(found, (2, 98)))
    if kind == "linear" and low < high / 2:
        low = 0.0
    return ColourScale(low, max(high, low * 1.001, low + 1e-6), kind)


Colour = tuple[int, int, int]

PAPER: Final[Colour] = (250, 250, 248)
INK: Final[Colour] = (26, 28, 33)
FAINT: Final[Colour] = (92, 97, 107)
FRAME: Final[Colour] = (205, 207, 212)
GREY: Final[Colour] = NOT_MEASURED

Label = tuple[float, str]
"""A position along a bar, from 0 to 1, and the text there."""


class Page:
    """A picture under construction.

    Attributes:
        font_px: The size of captions in pixels, to which all distances are relative.
        line_px: The height of a line of captions in pixels.
    """

    def __init__(self, width_px: int, height_px: int, *, font_px: int) -> None:
        """Start with an empty page."""
        self.font_px = font_px
        self.line_px = line_height(font_px)
        self._image = Image.new("RGB", (width_px, height_px), PAPER)
        self._draw = ImageDraw.Draw(self._image)

    def text(
        self,
        place: tuple[int, int],
        text: str,
        *,
        width_px: int,
        colour: Colour = INK,
        scale: float = 1.0,
    ) -> None:
        """Write one line from its top left corner, shortened to the width."""
        font = _font(round(self.font_px * scale))
        self._draw.text(place, fitted(text, font=font, width_px=width_px), fill=colour, font=font)

    def picture(
        self, place: tuple[int, int], picture: Picture, *, frame: Colour = FRAME, frame_px: int = 1
    ) -> None:
        """Put a picture, with a frame around it."""
        left, top = place
        height, width = picture.shape[:2]
        box = (left - frame_px, top - frame_px, left + width + frame_px - 1,
               top + height + frame_px - 1)  # fmt: skip
        self._draw.rectangle(box, outline=frame, width=frame_px)
        self._image.paste(Image.fromarray(picture), place)

    def bar(
        self, place: tuple[int, int], scale: ColourScale, rows: Sequence[Sequence[Label]], *,
        width_px: int,
    ) -> None:  # fmt: skip
        """Draw a colour bar with rows of labels below it; labels without room are left out."""
        left, top = place
        height = max(6, round(self.font_px * 0.7))
        spread = np.geomspace if scale.kind == "log" else np.linspace
        values = spread(scale.low, scale.high, width_px, dtype=np.float64)
        strip = np.broadcast_to(values, (height, width_px))
        self.picture(place, scale.paint(strip, measured=np.ones(strip.shape, dtype=bool)))
        font = _font(self.font_px)
        for number, labels in enumerate(rows):
            line_top = top + height + 4 + number * self.line_px
            free_from = left - 1.0
            for at, text in labels:
                x, length = left + at * (width_px - 1), font.getlength(text)
                begin = min(max(x - length / 2, left), left + width_px - length)
                if begin >= free_from:
                    self._draw.line((x, top + height, x, top + height + 3), fill=INK)
                    self._draw.text((begin, line_top), text, fill=INK, font=font)
                    free_from = begin + length + self.font_px * 0.5

    def swatches(
        self, place: tuple[int, int], entries: Sequence[tuple[Colour, str]], *, width_px: int
    ) -> None:
        """Write one line for each colour and its meaning."""
        left, top = place
        side = round(self.font_px * 0.8)
        for number, (colour, text) in enumerate(entries):
            line_top = top + number * self.line_px
            inset = (self.line_px - side) // 2
            box = (left, line_top + inset, left + side, line_top + inset + side)
            self._draw.rectangle(box, fill=colour, outline=FAINT)
            self.text(
                (left + round(side * 1.6), line_top), text, width_px=width_px - round(side * 1.6)
            )

    def finished(self) -> Picture:
        """Return the page as (h, w, 3) uint8."""
        return np.asarray(self._image)


def line_height(font_px: int) -> int:
    """Return the distance between lines of a font size, in pixels."""
    return round(font_px * 1.4)


def fitted(text: str, *, font: Any, width_px: int) -> str:
    """Return a text no wider than ``width_px``, cut and ended with three dots if need be."""
    if font.getlength(text) <= width_px:
        return text
    while text and font.getlength(f"{text.rstrip()}...") > width_px:
        text = text[:-1]
    return f"{text.rstrip()}..."


def resized(
    picture: Picture, *, width_px: int, shrink: Literal["average", "nearest"] = "average"
) -> Picture:
    """Return a picture at another width, its aspect kept; enlarging repeats pixels.

    Args:
        picture: The picture.
        width_px: The new width.
        shrink: "average" for photographs; "nearest" for maps, whose colours have a meaning.
    """
    height, width = picture.shape[:2]
    size = (width_px, max(1, round(height * width_px / width)))
    average = shrink == "average" and width_px < width
    how = Image.Resampling.BOX if average else Image.Resampling.NEAREST
    return np.asarray(Image.fromarray(picture).resize(size, how))


def scale_rows(scale: ColourScale) -> list[list[Label]]:
    """Return the labels of a bar: one row of round numbers."""
    return [[(float(scale.place(tick)), f"{tick:g}") for tick in scale.ticks(6)]]


def disparity_rows(scale: ColourScale, *, shift_px_m: float) -> list[list[Label]]:
    """Return the labels of a bar of disparity: in pixels, and below that depth in metres.

    Args:
        scale: The scale of disparities in pixels.
        shift_px_m: Focal length in pixels times baseline in metres: disparity times depth.
    """
    metres = [
        (float(scale.place(tick)), f"{abs(shift_px_m) / tick:.3g}" if tick else "inf")
        for tick in scale.ticks(6)
    ]
    return [*scale_rows(scale), metres]


@cache
def _font(size_px: int) -> Any:
    return ImageFont.load_default(size=size_px)
