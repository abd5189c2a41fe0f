"""Samples as pictures to look at: contact sheets, coloured maps, anaglyphs."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

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
_CAPTION_PX: Final = 20
_NARROWEST_PX: Final = 192
_GAP_PX: Final = 4


def coloured(
    values: Float[np.ndarray, "h w"],
    *,
    measured: Bool[np.ndarray, "h w"],
    largest: float,
) -> Picture:
    """Return the absolute values of a map as colours, grey where not measured.

    Colours run from 0 (dark blue) to ``largest`` (red), which also stands for larger values.
    """
    place = np.clip(np.abs(values) / max(largest, 1e-12), 0, 1) * (len(COLOUR_STOPS) - 1)
    stops = np.arange(len(COLOUR_STOPS))
    channels = [np.interp(place, stops, colours) for colours in COLOUR_STOPS.T]
    picture = np.stack(channels, axis=-1).round().astype(np.uint8)
    picture[~measured] = NOT_MEASURED
    return picture


def anaglyph(left: UInt8[np.ndarray, "3 h w"], right: UInt8[np.ndarray, "3 h w"]) -> Picture:
    """Return a picture for red-cyan glasses: red of the left view, green and blue of the right."""
    return np.stack([left[0], right[1], right[2]], axis=-1)


def contact_sheet(samples: Sequence[Sample]) -> Picture:
    """Return one row of captioned tiles for each sample: every picture and map that it has.

    Args:
        samples: Samples of `StereoPairs` in which left, right, disparity, valid, visible, depth,
            warped_right or hole are tiles where present; single pairs, not clips or sweeps.

    Returns:
        (h, w, 3) uint8. Disparity and depth are coloured up to their 98th percentile, which the
        caption says; pictures too narrow for their captions are enlarged by a whole factor.

    Raises:
        FieldError: If the samples have nothing to show, or have a time axis.
    """
    rows = [_row(sample) for sample in samples]
    if not rows or not rows[0]:
        raise FieldError(f"a contact sheet needs one of the fields {', '.join(_TILES)}.")
    width = max(tile.shape[1] for row in rows for _, tile in row) + _GAP_PX
    heights = [_CAPTION_PX + _GAP_PX + max(tile.shape[0] for _, tile in row) for row in rows]
    sheet = Image.new("RGB", (max(map(len, rows)) * width, sum(heights)), (255, 255, 255))
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=13)
    top = 0
    for row, height in zip(rows, heights, strict=True):
        for column, (caption, tile) in enumerate(row):
            sheet.paste(Image.fromarray(tile), (column * width, top + _CAPTION_PX))
            draw.text((column * width + 2, top + 2), caption, fill=(0, 0, 0), font=font)
        top += height
    return np.asarray(sheet)


def write_png(path: Path, picture: Picture) -> None:
    """Write an (h, w, 3) uint8 picture as PNG, whole or not at all.

    Raises:
        OSError: If it cannot be written; then the file that was there is as before.
    """
    with open_output(path) as file:
        Image.fromarray(picture).save(file, format="PNG")


def _row(sample: Sample) -> list[tuple[str, Picture]]:
    """Return a caption and a tile, wide enough for it, of each picture and map."""
    arrays = {name: np.asarray(value) for name, value in sample.items()}
    timed = [name for name in _TILES if name in arrays and arrays[name].ndim != 3]
    if timed:
        raise FieldError(f"{timed[0]} is {arrays[timed[0]].shape}: show one pair of one frame.")
    tiles = []
    for name, make in _TILES.items():
        if name in arrays:
            caption, tile = make(name, arrays)
            factor = math.ceil(_NARROWEST_PX / tile.shape[1])
            tiles.append((caption, tile.repeat(factor, axis=0).repeat(factor, axis=1)))
    return tiles


def _rgb(name: str, sample: dict[str, Any]) -> tuple[str, Picture]:
    caption = name
    if "pair" in sample and name in ("left", "right"):
        caption += f" (cam {sample['pair'][int(name == 'right')]})"
    if "baseline_m" in sample and name == "right":
        caption += f", {float(sample['baseline_m']) * 100:.1f} cm"
    return caption, np.ascontiguousarray(sample[name].transpose(1, 2, 0))


def _scaled(name: str, sample: dict[str, Any], *, unit: str) -> tuple[str, Picture]:
    values = sample[name][0]
    measured = sample["valid"][0] if "valid" in sample else values != 0
    largest = float(np.percentile(np.abs(values[measured]), 98)) if measured.any() else 0.0
    caption = f"{name}, 0 to {largest:.3g} {unit}"
    return caption, coloured(values, measured=measured, largest=largest)


def _yes_no(name: str, sample: dict[str, Any]) -> tuple[str, Picture]:
    yes = sample[name][0]
    return f"{name}, {yes.mean():.0%}", np.repeat(yes[..., None] * np.uint8(255), 3, axis=-1)


_TILES: Final[dict[str, Callable[[str, dict[str, Any]], tuple[str, Picture]]]] = {
    "left": _rgb,
    "right": _rgb,
    "disparity": lambda name, sample: _scaled(name, sample, unit="px"),
    "depth": lambda name, sample: _scaled(name, sample, unit="m"),
    "valid": _yes_no,
    "visible": _yes_no,
    "warped_right": _rgb,
    "hole": _yes_no,
}
