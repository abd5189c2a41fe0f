"""Procedural textures that tile, stored with their mip levels in one atlas.

A texture has (u, v) in tiles: (0, 0) is a corner of the tile and (1, 1) the same corner again.
Each is red, green and blue in 0..1 around 0.5, with detail at every scale, so that it is as hard
for a codec as a real surface. Mip levels keep the detail of a texture below the resolution of the
picture, so that two views of a surface agree.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float32, Int32
from torch.nn.functional import grid_sample

SIDE_TEXELS: Final = 512
"""Texels along a tile at the finest mip level."""

_LEVELS: Final = SIDE_TEXELS.bit_length()
_FINEST: Final = np.float32(SIDE_TEXELS.bit_length() - 1)
"""Binary logarithm of the texels along a tile."""
_BORDER: Final = 2
_ROW_TEXELS: Final = SIDE_TEXELS + _BORDER

Tile = Any
"""(side, side, 3) or (side, side, 1), float64."""


def sample_atlas(
    u: Float32[np.ndarray, " n"],
    v: Float32[np.ndarray, " n"],
    *,
    row: Float32[np.ndarray, " n"],
    log_footprint: Float32[np.ndarray, " n"],
) -> Float32[np.ndarray, "3 n"]:
    """Return a texture's colours, interpolated in the tile and between mip levels.

    Args:
        u: Places along the tile's width, in tiles; the texture repeats.
        v: The same along its height.
        row: The textures, by their indices in `TEXTURES`.
        log_footprint: Binary logarithm of the part of a tile that one pixel covers; finer detail is
            averaged.

    Returns:
        Red, green, blue in 0..1.
    """
    level = np.clip(log_footprint + _FINEST, 0, _LEVELS - 1)
    lower = level.astype(np.int32)
    u, v = u - np.floor(u), v - np.floor(v)
    fine = _sample_level(_atlas(), u, v, row=row, level=lower)
    coarse = _sample_level(_atlas(), u, v, row=row, level=np.minimum(lower + 1, _LEVELS - 1))
    coarse -= fine
    coarse *= level - lower
    fine += coarse
    return fine


def sample_tile(
    u: Float32[np.ndarray, " n"],
    v: Float32[np.ndarray, " n"],
    *,
    row: int,
    log_footprint: Float32[np.ndarray, " n"],
) -> Float32[np.ndarray, " n"]:
    """Return a texture's red at the nearest mip level, interpolated in the tile."""
    level = np.clip(log_footprint + np.float32(_FINEST + 0.5), 0, _LEVELS - 1).astype(np.int32)
    u, v = u - np.floor(u), v - np.floor(v)
    red: Float32[np.ndarray, " n"] = _sample_level(_red_atlas(), u, v, row=row, level=level)[0]
    return red


def _sample_level(
    atlas: torch.Tensor,
    u: Float32[np.ndarray, " n"],
    v: Float32[np.ndarray, " n"],
    *,
    row: float | Float32[np.ndarray, " n"],
    level: Int32[np.ndarray, " n"],
) -> Float32[np.ndarray, "c n"]:
    """Interpolate bilinearly at whole mip levels."""
    height, width = atlas.shape[2:]
    starts, sides = _level_places()
    side = sides[level]
    grid = np.empty((1, 1, len(level), 2), np.float32)
    grid[0, 0, :, 0] = (starts[level] + u * side) * np.float32(2 / (width - 1)) - np.float32(1)
    grid[0, 0, :, 1] = (np.float32(row * _ROW_TEXELS + 0.5) + v * side) * np.float32(
        2 / (height - 1)
    ) - np.float32(1)
    colours = grid_sample(atlas, torch.from_numpy(grid), align_corners=True)
    return colours[0, :, 0].numpy()


@cache
def _level_places() -> tuple[Float32[np.ndarray, " l"], Float32[np.ndarray, " l"]]:
    """Return where each level starts in a row, and how many texels it is wide.

    Level l starts at 2 side (1 - 2^-l) + 2 l.
    """
    level = np.arange(_LEVELS)
    sides = SIDE_TEXELS / 2.0**level
    starts = 2 * (SIDE_TEXELS - sides) + _BORDER * level + 0.5
    return starts.astype(np.float32), sides.astype(np.float32)


@cache
def _red_atlas() -> torch.Tensor:
    return _atlas()[:, :1].contiguous()


@cache
def _atlas() -> torch.Tensor:
    """Return all textures with their mip levels side by side, each with a border that wraps."""
    rows = []
    for seed, draw in enumerate(TEXTURES.values()):
        tile = np.clip(draw(np.random.default_rng(seed)), 0, 1)
        levels = []
        for _ in range(_LEVELS):
            padded = np.pad(tile, ((1, 1), (1, 1), (0, 0)), mode="wrap")
            spare = _ROW_TEXELS - len(padded)
            levels.append(np.pad(padded, ((0, spare), (0, 0), (0, 0))))
            tile = _halved(_halved(tile, axis=0), axis=1)
        rows.append(np.concatenate(levels, axis=1))
    stacked = np.concatenate(rows, axis=0, dtype=np.float32)
    return torch.from_numpy(stacked.transpose(2, 0, 1)[None].copy())


def _halved(tile: Tile, *, axis: int) -> Tile:
    """Halve a side with the filter (1, 3, 3, 1) / 8, which wraps at the tile's edge."""
    if tile.shape[axis] == 1:
        return tile
    wide = np.roll(tile, 1, axis) + 3 * tile + 3 * np.roll(tile, -1, axis) + np.roll(tile, -2, axis)
    return np.take(wide, range(0, tile.shape[axis], 2), axis) / 8


def _noise(rng: np.random.Generator, *, slope: float, low: float = 1.0) -> Tile:
    """Return noise with amplitude frequency^-slope above ``low`` cycles per tile; sd 1, mean 0."""
    frequency = np.hypot(*np.meshgrid(*[np.fft.fftfreq(SIDE_TEXELS, 1 / SIDE_TEXELS)] * 2))
    amplitude = np.where(frequency >= low, np.maximum(frequency, 1.0) ** -slope, 0.0)
    white = rng.standard_normal((SIDE_TEXELS, SIDE_TEXELS))
    noise = np.fft.ifft2(np.fft.fft2(white) * amplitude).real
    return (noise / noise.std())[..., None]


def _colour_noise(rng: np.random.Generator, *, slope: float, spread: float) -> Tile:
    """Return noise in lightness, with about a third as much in each colour channel."""
    channels = [_noise(rng, slope=slope) for _ in range(3)]
    return spread * (_noise(rng, slope=slope) + 0.35 * np.concatenate(channels, axis=2))


def _cells(rng: np.random.Generator, *, count: int) -> tuple[Tile, Tile]:
    """Return random cells of a tile: each texel's tone, and 1 inside cells, 0 on their borders."""
    sites = rng.uniform(0.1, 0.9, (count, count, 2))
    tones = rng.uniform(-1, 1, (count, count, 1)) + rng.uniform(-0.3, 0.3, (count, count, 3))
    place = (np.arange(SIDE_TEXELS) + 0.5) * count / SIDE_TEXELS
    column, row = np.meshgrid(place, place)
    first = np.full(column.shape, np.inf)
    second = first.copy()
    tone = np.zeros((*column.shape, 3))
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            i, j = row.astype(int) + down, column.astype(int) + right
            site = sites[i % count, j % count]
            distance = np.hypot(i + site[..., 0] - row, j + site[..., 1] - column)
            nearer = distance < first
            second = np.where(nearer, first, np.minimum(second, distance))
            first = np.where(nearer, distance, first)
            tone = np.where(nearer[..., None], tones[i % count, j % count], tone)
    return tone, np.clip((second - first) * 8, 0, 1)[..., None]


def _blocks(
    rng: np.random.Generator, *, rows: int, columns: int, joint: float
) -> tuple[Tile, Tile]:
    """Return rows of bricks or boards: each texel's tone, and 1 inside them, 0 in the joints."""
    place = (np.arange(SIDE_TEXELS) + 0.5) / SIDE_TEXELS
    across, down = np.meshgrid(place * columns, place * rows)
    course = down.astype(int)
    across = across + rng.uniform(0, 1, rows)[course]
    tones = rng.uniform(-1, 1, (rows, columns, 1)) + rng.uniform(-0.3, 0.3, (rows, columns, 3))
    edge_across = np.minimum(across % 1, 1 - across % 1) * rows / columns
    edge_down = np.minimum(down % 1, 1 - down % 1)
    inside = np.clip(np.minimum(edge_across, edge_down) / joint - 0.5, 0, 1)
    return tones[course, across.astype(int) % columns], inside[..., None]


def _clouds(rng: np.random.Generator) -> Tile:
    cover = np.clip(0.35 + 0.35 * _noise(rng, slope=1.9), 0, 1)
    return (1 - cover) * np.array([0.36, 0.55, 0.86]) + cover * np.array([0.95, 0.96, 0.98])


def _grain(rng: np.random.Generator) -> Tile:
    return 0.5 + 0.13 * np.repeat(_noise(rng, slope=0.75, low=6.0), 3, axis=2)


def _plaster(rng: np.random.Generator) -> Tile:
    return 0.55 + _colour_noise(rng, slope=1.15, spread=0.12)


def _soil(rng: np.random.Generator) -> Tile:
    tone, inside = _cells(rng, count=40)
    return 0.45 + 0.16 * tone * inside + _colour_noise(rng, slope=1.1, spread=0.11)


def _mosaic(rng: np.random.Generator) -> Tile:
    tone, inside = _cells(rng, count=12)
    return 0.3 + inside * (0.25 + 0.22 * tone) + _colour_noise(rng, slope=1.0, spread=0.05)


def _bricks(rng: np.random.Generator) -> Tile:
    tone, inside = _blocks(rng, rows=16, columns=6, joint=0.09)
    return 0.32 + inside * (0.2 + 0.13 * tone) + _colour_noise(rng, slope=1.0, spread=0.07)


def _boards(rng: np.random.Generator) -> Tile:
    tone, inside = _blocks(rng, rows=8, columns=2, joint=0.03)
    streaks = np.repeat(_noise(rng, slope=1.0)[:, ::8].repeat(8, axis=1), 3, axis=2)
    boards = inside * (0.28 + 0.12 * tone + 0.05 * streaks)
    return 0.25 + boards + _colour_noise(rng, slope=1.0, spread=0.04)


def _weave(rng: np.random.Generator) -> Tile:
    place = (np.arange(SIDE_TEXELS) + 0.5) / SIDE_TEXELS
    across, down = np.meshgrid(place, place)
    stripes = np.sign(np.sin(2 * np.pi * 5 * across)) + np.sign(np.sin(2 * np.pi * 4 * down))
    threads = np.sin(2 * np.pi * 64 * across) * np.sin(2 * np.pi * 64 * down)
    bands = np.stack([stripes, 0.6 * stripes, 0.3 * threads], axis=2)
    return (
        0.5 + 0.1 * bands + 0.06 * threads[..., None] + _colour_noise(rng, slope=0.9, spread=0.06)
    )


TEXTURES: Final[dict[str, Callable[[np.random.Generator], Tile]]] = {
    "clouds": _clouds,
    "grain": _grain,
    "plaster": _plaster,
    "soil": _soil,
    "mosaic": _mosaic,
    "bricks": _bricks,
    "boards": _boards,
    "weave": _weave,
}
"""The textures by name, in the order of the atlas. The others are multiplied by "grain"."""


def texture_row(name: str) -> int:
    """Return the index of a texture in the atlas."""
    return list(TEXTURES).index(name)
