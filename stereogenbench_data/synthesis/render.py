"""Pictures of a stage: matte, textured, lit by one sun, the same from every camera.

Colours depend on the place on the surface and on the size of a pixel there, not on the direction
of view, so that a view warped into another by depth agrees with it.
"""

from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from stereogenbench_data.synthesis.casting import (
    FIRST_SHAPE,
    GROUND,
    SKY,
    Rays,
    View,
    first_met,
    pixel_rays,
)
from stereogenbench_data.synthesis.shapes import Material, Shape, surface
from stereogenbench_data.synthesis.stage import Stage
from stereogenbench_data.synthesis.sunlight import cast_shadow, full_light, sunlight_at
from stereogenbench_data.synthesis.textures import sample_atlas, texture_row

Array = Any

_SKY_MATERIAL: Final = Material("clouds", 3.0, (1.0, 1.0, 1.0))
_AMBIENT: Final = 0.42
_SKYLIGHT: Final = 0.1
_SUNLIGHT: Final = 0.62
_GRAIN_TILE_M: Final = 0.45
_GRAIN_CONTRAST: Final = 2.0
_BLUR_PX: Final = 0.8
_SLANT_POWER: Final = 0.8
_LEAST_SLANT: Final = np.float32(1e-3)
_FACE_LIGHT: Final = 0.05
_SUBPIXELS: Final = np.array([(-1, -3), (3, -1), (1, 3), (-3, 1)]) / 8
_SUBPIXEL_BATCH: Final = 1 << 15


class Scenery:
    """A stage at one moment: its shapes, its materials and the sunlight on its ground."""

    def __init__(
        self, stage: Stage, *, moment_s: float, still_light: Float64[np.ndarray, "side side"]
    ) -> None:
        walker = stage.walker(moment_s)
        self.stage = stage
        self.shapes = [*stage.fixed, *walker]
        self.light = still_light.copy()
        for shape in walker:
            cast_shadow(self.light, shape=shape, stage=stage)
        self.materials = np.array(
            [
                (texture_row(material.texture), 1 / material.tile_m, *material.tint)
                for material in (
                    _SKY_MATERIAL,
                    stage.ground,
                    *(shape.material for shape in self.shapes),
                )
            ],
            np.float32,
        ).T.copy()

    def first_met(self, rays: Rays, *, view: View) -> tuple[Array, Array]:
        """Return depth in metres and number of the solid that each ray meets first."""
        return first_met(rays, view=view, shapes=self.shapes, slope=self.stage.slope)


def still_light(stage: Stage) -> Float64[np.ndarray, "side side"]:
    """Return the sunlight on the ground past all that does not move."""
    light = full_light()
    for shape in stage.fixed:
        cast_shadow(light, shape=shape, stage=stage)
    return light


def draw_depth(scenery: Scenery, *, view: View) -> Float64[np.ndarray, "h w"]:
    """Return depth along the optical axis at pixel centres, in metres; the sky is infinite."""
    return np.concatenate([scenery.first_met(rays, view=view)[0] for _, rays in pixel_rays(view)])


def draw_frame(
    scenery: Scenery, *, view: View
) -> tuple[UInt8[np.ndarray, "h w 3"], Float64[np.ndarray, "h w"]]:
    """Return a picture with smooth silhouettes, and its depth as `draw_depth` returns it."""
    width, height = view.size_px
    colour = np.empty((height, width, 3), np.float32)
    light = np.empty((height, width), np.float32)
    depth_m = np.empty((height, width))
    solid = np.empty((height, width), np.int64)
    for rows, rays in pixel_rays(view):
        depth_m[rows], solid[rows] = scenery.first_met(rays, view=view)
        strip, lit = _shaded(
            scenery,
            view=view,
            rays=rays.listed(),
            depth_m=depth_m[rows].ravel(),
            solid=solid[rows].ravel(),
        )
        colour[rows] = strip.T.reshape(-1, width, 3)
        light[rows] = lit.reshape(-1, width)
    _smooth_edges(colour, edges=_edges(solid, light=light), scenery=scenery, view=view)
    return np.rint(colour * 255).astype(np.uint8), depth_m


def _edges(
    solid: Int64[np.ndarray, "h w"], *, light: Float32[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Mark pixels beside another solid or another face of the same box."""
    edges = np.zeros(solid.shape, bool)
    for first, second in (
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:-1], np.s_[1:]),
    ):
        differ = solid[first] != solid[second]
        differ |= np.abs(light[first] - light[second]) > _FACE_LIGHT
        edges[first] |= differ
        edges[second] |= differ
    return edges


def _smooth_edges(
    colour: Float32[np.ndarray, "h w 3"],
    *,
    edges: Bool[np.ndarray, "h w"],
    scenery: Scenery,
    view: View,
) -> None:
    """Replace marked pixels, in place, by the mean of four rays through each."""
    rows, columns = np.nonzero(edges)
    for start in range(0, len(rows), _SUBPIXEL_BATCH):
        v, u = rows[start : start + _SUBPIXEL_BATCH], columns[start : start + _SUBPIXEL_BATCH]
        rays = Rays(
            view.right_of_axis(u + 0.5 + _SUBPIXELS[:, :1]).ravel(),
            view.below_axis(v + 0.5 + _SUBPIXELS[:, 1:]).ravel(),
        )
        depth_m, solid = scenery.first_met(rays, view=view)
        drawn, _ = _shaded(scenery, view=view, rays=rays, depth_m=depth_m, solid=solid)
        colour[v, u] = drawn.reshape(3, len(_SUBPIXELS), -1).mean(axis=1).T


def _shaded(
    scenery: Scenery, *, view: View, rays: Rays, depth_m: Array, solid: Array
) -> tuple[Float32[np.ndarray, "3 n"], Float32[np.ndarray, " n"]]:
    """Return colours in 0..1, and the light alone, which tells the faces of a box apart."""
    place_m = np.empty((2, solid.size), np.float32)
    footprint_m, slant, light = np.empty((3, solid.size), np.float32)
    for number in np.flatnonzero(np.bincount(solid)):
        index = np.flatnonzero(solid == number)
        part = Rays(rays.right[index], rays.below[index])
        if number == SKY:
            u_m, v_m, facing, lit = _on_sky(part, view=view)
            reach = 1.0
        else:
            reach = depth_m[index]
            if number == GROUND:
                u_m, v_m, facing, lit = _on_ground(part, view=view, scenery=scenery, depth_m=reach)
            else:
                shape = scenery.shapes[number - FIRST_SHAPE]
                u_m, v_m, facing, lit = _on_shape(
                    part, view=view, shape=shape, depth_m=reach, sun=scenery.stage.sun
                )
        place_m[0, index], place_m[1, index], light[index] = u_m, v_m, lit
        footprint_m[index], slant[index] = reach, facing
    footprint_m *= np.maximum(slant, _LEAST_SLANT) ** np.float32(-_SLANT_POWER)
    footprint_m *= _BLUR_PX / max(view.focal_px)
    return _painted(
        scenery.materials[:, solid], place_m=place_m, footprint_m=footprint_m, light=light
    ), light


def _painted(
    materials: Float32[np.ndarray, "5 n"],
    *,
    place_m: Float32[np.ndarray, "2 n"],
    footprint_m: Float32[np.ndarray, " n"],
    light: Float32[np.ndarray, " n"],
) -> Float32[np.ndarray, "3 n"]:
    """Multiply a material's texture by its tint, the light and a fine grain (but on the sky)."""
    row, tiles_per_m, *tint = materials
    grain = sample_atlas(
        tiles=place_m / np.float32(_GRAIN_TILE_M),
        rows=np.full_like(row, texture_row("grain")),
        footprint_tiles=footprint_m / np.float32(_GRAIN_TILE_M),
    )[0]
    contrast = np.where(row == texture_row(_SKY_MATERIAL.texture), 0, np.float32(_GRAIN_CONTRAST))
    colour = sample_atlas(
        tiles=place_m * tiles_per_m, rows=row, footprint_tiles=footprint_m * tiles_per_m
    )
    colour *= light * (1 + contrast * (grain - np.float32(0.5)))
    colour *= np.stack(tint)
    return np.clip(colour, 0, 1, out=colour)


def _lit(*, sunward: Array, upward: Array, sunlight: Array) -> Array:
    return _AMBIENT + _SKYLIGHT * upward + _SUNLIGHT * sunlight * np.maximum(sunward, 0)


def _on_sky(rays: Rays, *, view: View) -> tuple[Array, Array, Array, Array]:
    """Return place, facing and light on a ceiling of clouds, bent down to the horizon."""
    x, y, z = rays.directions(view.axes)
    length = np.sqrt(x * x + y * y + z * z)
    height = np.abs(z) / length + 0.15
    return x / length / height, y / length / height, height**2, 1.06 - 0.25 * height


def _on_ground(
    rays: Rays, *, view: View, scenery: Scenery, depth_m: Array
) -> tuple[Array, Array, Array, Array]:
    stage = scenery.stage
    directions = np.stack(rays.directions(view.axes))
    x_m, y_m = view.eye[:2, None] + depth_m * directions[:2]
    normal = np.array([*-stage.slope, 1.0]) / np.sqrt(1 + stage.slope @ stage.slope)
    facing = np.abs(normal @ directions) / np.sqrt((directions * directions).sum(axis=0))
    sunlight = sunlight_at(scenery.light, x_m=x_m, y_m=y_m, stage=stage)
    return x_m, y_m, facing, _lit(sunward=normal @ stage.sun, upward=normal[2], sunlight=sunlight)


def _on_shape(
    rays: Rays, *, view: View, shape: Shape, depth_m: Array, sun: Array
) -> tuple[Array, Array, Array, Array]:
    origin, axes = view.in_unit_solid(shape)
    directions = np.stack(rays.directions(axes))
    met = surface(
        shape, point=origin[:, None] + depth_m * directions, direction=directions, sun=sun
    )
    light = _lit(sunward=met.sunward, upward=met.upward, sunlight=1.0)
    return met.u_m, met.v_m, met.facing, light
