"""How much sun reaches the ground: a map over the stage, shadows of shapes cut out of it."""

from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.synthesis.shapes import Shape, entry
from stereogenbench_data.synthesis.stage import Stage

Array = Any

_SIDE_TEXELS: Final = 512
_SHADE: Final = 0.35


def full_light() -> Float64[np.ndarray, "side side"]:
    """Return the map of a ground that nothing stands on; rows are y, columns are x."""
    return np.ones((_SIDE_TEXELS, _SIDE_TEXELS))


def cast_shadow(light: Float64[np.ndarray, "side side"], *, shape: Shape, stage: Stage) -> None:
    """Darken the map, in place, where a shape stands between the ground and the sun."""
    corners = shape.corners()
    drop = (corners[:, 2] - corners[:, :2] @ stage.slope) / (
        stage.sun[2] - stage.sun[:2] @ stage.slope
    )
    texels = _texel_of(corners[:, :2] - drop[:, None] * stage.sun[:2], stage=stage)
    low = np.clip(np.floor(texels.min(axis=0)), 0, _SIDE_TEXELS).astype(int)
    high = np.clip(np.ceil(texels.max(axis=0)) + 1, 0, _SIDE_TEXELS).astype(int)
    if (high <= low).any():
        return
    x_m = _metres_at(np.arange(low[0], high[0])[None], stage=stage)
    y_m = _metres_at(np.arange(low[1], high[1])[:, None], stage=stage)
    ground = (x_m, y_m, stage.slope[0] * x_m + stage.slope[1] * y_m)
    from_world = shape.axes / shape.half_m[:, None]
    start = -from_world @ shape.centre
    origin = [
        o + (a * ground[0] + b * ground[1] + c * ground[2])
        for o, (a, b, c) in zip(start, from_world, strict=True)
    ]
    blocked = np.isfinite(entry(shape, origin=origin, direction=list(from_world @ stage.sun)))
    light[low[1] : high[1], low[0] : high[0]][blocked] = _SHADE


def sunlight_at(
    light: Float64[np.ndarray, "side side"], *, x_m: Array, y_m: Array, stage: Stage
) -> Array:
    """Return the light at places on the ground, interpolated; beyond the map its rim goes on."""
    place = np.clip(_texel_of(np.stack([x_m, y_m]).T, stage=stage), 0, _SIDE_TEXELS - 1.001)
    corner = place.astype(int)
    (across, down), (column, row) = (place - corner).T, corner.T
    upper = light[row, column] * (1 - across) + light[row, column + 1] * across
    lower = light[row + 1, column] * (1 - across) + light[row + 1, column + 1] * across
    return upper * (1 - down) + lower * down


def _texel_of(place_m: Array, *, stage: Stage) -> Array:
    return (place_m / stage.reach_m + 1) * (_SIDE_TEXELS / 2) - 0.5


def _metres_at(texel: Array, *, stage: Stage) -> Array:
    return ((texel + 0.5) * (2 / _SIDE_TEXELS) - 1) * stage.reach_m
