"""Samples as pictures to look at: coloured maps, anaglyphs, and sheets of captioned tiles."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from stereogenbench_data.errors import FieldError
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.sources.files import open_output

Picture = UInt8[np.ndarray, "h w 3"]

COLOUR_STOPS: Final = np.array(
    [(18, 10, 60), (40, 70, 160), (20, 150, 160), (90, 200, 90), (240, 220, 60), (220, 60, 30)],
    dtype=np.float64,
)
"""From far (dark blue) to near (red), each lighter than the one before but for the last."""
NOT_MEASURED: Final = (96, 96, 96)

Colour = tuple[int, int, int]
FRAME: Final[Colour] = (205, 207, 212)
_PAPER: Final[Colour] = (250, 250, 248)
_INK: Final[Colour] = (26, 28, 33)
_FAINT: Final[Colour] = (92, 97, 107)
_MARKS: Final = 4
"""How many places of a colour bar are labelled."""


def anaglyph(left: UInt8[np.ndarray, "3 h w"], right: UInt8[np.ndarray, "3 h w"]) -> Picture:
    """Return a picture for red-cyan glasses: red of the left view, green and blue of the right."""
    return np.stack([left[0], right[1], right[2]], axis=-1)


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

    @classmethod
    def of(
        cls,
        values: Float[np.ndarray, "..."],
        *,
        measured: Bool[np.ndarray, "..."],
        kind: Literal["linear", "log"] = "linear",
    ) -> "ColourScale":
        """Return a scale for the middle 96 % of measured values; linear ones start at 0 if near."""
        found = np.abs(values[measured])
        if found.size == 0:
            return cls(1.0 if kind == "log" else 0.0, 2.0, kind)
        low, high = (float(each) for each in np.percentile(found, (2, 98)))
        if kind == "linear" and low < high / 2:
            low = 0.0
        return cls(low, max(high, low * 1.001, low + 1e-6), kind)

    def paint(
        self, values: Float[np.ndarray, "h w"], *, measured: Bool[np.ndarray, "h w"]
    ) -> Picture:
        """Return a map in this scale's colours, grey where not measured."""
        shown = np.clip(np.abs(values), self.low, self.high)
        places = (shown - self.low) / (self.high - self.low)
        if self.kind == "log":
            places = 1 - np.log(shown / self.low) / math.log(self.high / self.low)
        stops = np.linspace(0, 1, len(COLOUR_STOPS))
        channels = [np.interp(places, stops, colours) for colours in COLOUR_STOPS.T]
        picture = np.stack(channels, axis=-1).round().astype(np.uint8)
        picture[~measured] = NOT_MEASURED
        return picture

    def spread(self, count: int) -> Float[np.ndarray, " count"]:
        """Return values at equal distances along the scale, its ends included."""
        spread = np.geomspace if self.kind == "log" else np.linspace
        return spread(self.low, self.high, count, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Tile:
    """A picture of a sheet, with a caption above and a legend below.

    Attributes:
        caption: One line.
        picture: (h, w, 3) uint8.
        key: Colours and their meanings.
        scale: The scale of a map's colours, drawn as a bar.
        labels: The texts below the bar, a line each, of a value of the scale.
        frame: The colour of the frame; other colours than `FRAME` are drawn thicker.
        shrink: "average" for photographs; "nearest" for maps, whose colours have a meaning.
    """

    caption: str
    picture: Picture
    key: tuple[tuple[Colour, str], ...] = ()
    scale: ColourScale | None = None
    labels: tuple[Callable[[float], str], ...] = ()
    frame: Colour = FRAME
    shrink: Literal["average", "nearest"] = "average"


def pair_tiles(
    sample: Sample, *, fx_px: float, scale: ColourScale | None = None
) -> tuple[Tile, ...]:
    """Return the tiles of a pair: left, right and disparity.

    Args:
        sample: With ``left``, ``right``, ``disparity``, ``valid`` and ``baseline_m``.
        fx_px: The focal length in pixels of the sample's pictures.
        scale: The scale of disparity, None for that of the sample.
    """
    arrays = {name: np.asarray(value) for name, value in sample.items()}
    baseline_m = float(arrays["baseline_m"])
    disparity, valid = arrays["disparity"][0], arrays["valid"][0]
    scale = scale or ColourScale.of(disparity, measured=valid)
    labels = (
        lambda px: f"{px:.3g}",
        lambda px: f"{fx_px * abs(baseline_m) / px:.3g}" if px else "inf",
    )
    painted = scale.paint(disparity, measured=valid)
    caption = "disparity, px (below: m)"
    return (
        Tile("left", channels_last(arrays["left"])),
        Tile(f"right, {baseline_m * 100:.2f} cm", channels_last(arrays["right"])),
        Tile(caption, painted, scale=scale, labels=labels, shrink="nearest"),
    )


def show(sample: Mapping[str, Any], *, width_px: int = 240) -> Image.Image:
    """Return a sample, or the first samples of a batch, as a picture, which notebooks display.

    Pictures are shown as they are; disparity and depth in colours from far (blue) to near (red),
    grey where they are not measured; masks white where they hold. Of batches, clips and several
    views up to six are shown, a row a field.

    Args:
        sample: What a dataset gives, or a loader.
        width_px: The width of each tile.

    Raises:
        FieldError: If it has no picture, map or mask.
    """
    arrays = {name: np.asarray(value) for name, value in sample.items() if _is_map(value)}
    if not arrays:
        raise FieldError(
            "nothing to show: the sample has no picture, map or mask among its fields."
        )
    key = sample.get("__key__")
    title = [key] if isinstance(key, str) else []
    rows = [
        [
            _tile(name, each, _valid(arrays, name, place))
            for place, each in enumerate(array.reshape(-1, *array.shape[-3:])[:_TILES])
        ]
        for name, array in arrays.items()
    ]
    if max(map(len, rows)) == 1:
        rows = [[tile for row in rows for tile in row]]
    rows.sort(key=len, reverse=True)
    return Image.fromarray(draw_sheet(title, rows, width_px=width_px))


_TILES: Final = 6


def _is_map(value: Any) -> bool:
    """Return whether a field is shown: (..., 3, h, w) pictures, (..., 1, h, w) maps and masks."""
    shape = tuple(getattr(value, "shape", ()))
    return len(shape) >= 3 and shape[-3] in (1, 3) and min(shape[-2:]) > 4


def _valid(arrays: Mapping[str, Any], name: str, place: int) -> Any:
    """Return where a map is measured."""
    array = arrays[name]
    own = array.reshape(-1, *array.shape[-3:])[place]
    mask = arrays.get("valid") if name == "disparity" else None
    if mask is not None and mask.shape == array.shape:
        return mask.reshape(-1, *mask.shape[-3:])[place][0]
    return np.isfinite(own[0]) & (own[0] != 0)


def _tile(name: str, array: Any, measured: Any) -> Tile:
    if array.shape[0] == 3 and array.dtype == np.uint8:
        return Tile(name, channels_last(array))
    if array.shape[0] == 3:
        scaled = np.clip(np.nan_to_num(array), 0, 1) * 255
        return Tile(name, channels_last(scaled.round().astype(np.uint8)))
    if array.dtype == bool:
        return Tile(name, np.repeat(array[0][..., None] * np.uint8(255), 3, axis=2))
    kind: Literal["linear", "log"] = "log" if "depth" in name else "linear"
    scale = ColourScale.of(array[0], measured=measured, kind=kind)
    painted = scale.paint(np.where(measured, array[0], scale.low), measured=measured)
    return Tile(
        name, painted, scale=scale, labels=(lambda value: f"{value:.3g}",), shrink="nearest"
    )


def channels_last(picture: UInt8[np.ndarray, "3 h w"]) -> Picture:
    """Return a sample's picture as (h, w, 3)."""
    return np.ascontiguousarray(picture.transpose(1, 2, 0))


def draw_sheet(title: Sequence[str], rows: Sequence[Sequence[Tile]], *, width_px: int) -> Picture:
    """Return a sheet as (h, w, 3) uint8.

    Args:
        title: Lines above the tiles, the first one larger.
        rows: Tiles of one aspect, all rows as long as the first.
        width_px: The width of each tile, from which sizes of text follow.
    """
    gap = min(max(round(width_px / 21), 13), 30)
    line = round(gap * 1.4)
    height, width = rows[0][0].picture.shape[:2]
    height_px = max(1, round(height * width_px / width))
    legend_lines = [
        max(max(len(tile.key), (tile.scale is not None) + len(tile.labels)) for tile in tiles)
        for tiles in rows
    ]
    legends = [lines * line + gap // 2 if lines else 0 for lines in legend_lines]
    head = round(line * 1.6) + line * (len(title) - 1) + gap if title else 0
    inner = len(rows[0]) * (width_px + gap) - gap
    total = 2 * gap + head + sum(line + 4 + height_px + gap + legend for legend in legends)
    sheet = Image.new("RGB", (inner + 2 * gap, total - gap // 2), _PAPER)
    page = _Page(sheet, ImageDraw.Draw(sheet), gap, line)
    for number, text in enumerate(title):
        top = gap + (number > 0) * round(line * 1.6) + max(0, number - 1) * line
        scale, ink = (1.0, _FAINT) if number else (1.3, _INK)
        page.text((gap, top), text, width_px=inner, colour=ink, scale=scale)
    top = gap + head
    for tiles, legend in zip(rows, legends, strict=True):
        for column, tile in enumerate(tiles):
            page.tile((gap + column * (width_px + gap), top), tile, (width_px, height_px))
        top += line + 4 + height_px + gap + legend
    return np.asarray(sheet)


@dataclass(frozen=True, slots=True)
class _Page:
    """A sheet under construction; all distances follow from the height of a line of text."""

    image: Any
    draw: Any
    font_px: int
    line_px: int

    def text(
        self,
        place: tuple[int, int],
        text: str,
        *,
        width_px: int,
        colour: Colour = _INK,
        scale: float = 1.0,
    ) -> None:
        """Write one line from its top left corner, shortened to the width."""
        font = _font(round(self.font_px * scale))
        if font.getlength(text) > width_px:
            while text and font.getlength(f"{text.rstrip()}...") > width_px:
                text = text[:-1]
            text = f"{text.rstrip()}..."
        self.draw.text(place, text, fill=colour, font=font)

    def framed(self, place: tuple[int, int], picture: Picture, colour: Colour) -> None:
        """Put a picture, with a frame around it."""
        left, top = place
        height, width = picture.shape[:2]
        thick = 1 if colour == FRAME else 3
        box = (left - thick, top - thick, left + width + thick - 1, top + height + thick - 1)
        self.draw.rectangle(box, outline=colour, width=thick)
        self.image.paste(Image.fromarray(picture), place)

    def tile(self, place: tuple[int, int], tile: Tile, size: tuple[int, int]) -> None:
        """Put a tile with its caption and its legend."""
        (left, top), (width_px, height_px) = place, size
        self.text(place, tile.caption, width_px=width_px)
        average = tile.shrink == "average" and width_px < tile.picture.shape[1]
        how = Image.Resampling.BOX if average else Image.Resampling.NEAREST
        drawn = np.asarray(Image.fromarray(tile.picture).resize(size, how))
        self.framed((left, top + self.line_px + 4), drawn, tile.frame)
        below = top + self.line_px + 4 + height_px + self.font_px // 2
        side, inset = round(self.font_px * 0.8), self.line_px // 7
        for number, (colour, text) in enumerate(tile.key):
            line_top = below + number * self.line_px
            box = (left, line_top + inset, left + side, line_top + inset + side)
            self.draw.rectangle(box, fill=colour, outline=_FAINT)
            place = (left + round(side * 1.6), line_top)
            self.text(place, text, width_px=width_px - round(side * 1.6))
        if tile.scale is not None:
            bar_px = max(6, round(self.font_px * 0.7))
            strip = np.broadcast_to(tile.scale.spread(width_px), (bar_px, width_px))
            painted = tile.scale.paint(strip, measured=np.ones(strip.shape, dtype=bool))
            self.framed((left, below), painted, FRAME)
            for row, label in enumerate(tile.labels):
                for number, value in enumerate(tile.scale.spread(_MARKS).tolist()):
                    room = width_px - _font(self.font_px).getlength(label(value))
                    at = (left + room * number / (_MARKS - 1), below + bar_px + 4)
                    self.draw.text(
                        (at[0], at[1] + row * self.line_px), label(value), fill=_INK,
                        font=_font(self.font_px),
                    )  # fmt: skip


@cache
def _font(size_px: int) -> Any:
    return ImageFont.load_default(size=size_px)


def write_png(path: Path, picture: Picture) -> None:
    """Write an (h, w, 3) uint8 picture as PNG, whole or not at all.

    Raises:
        OSError: If it cannot be written; then the file that was there is as before.
    """
    with open_output(path) as file:
        Image.fromarray(picture).save(file, format="PNG")
