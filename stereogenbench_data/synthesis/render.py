"""Pictures and depth of a scene: matte textured surfaces, lit by one sun.

Colours depend on the place on the surface and on the size of a pixel there, but not on the viewing
direction. So a view that is warped into another view by its depth agrees with that view.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from stereogenbench_data.synthesis.ray_casting import (
    FIRST_SHAPE,
    GROUND,
    SKY,
    Rays,
    View,
    first_hits,
    pixel_rays,
)
from stereogenbench_data.synthesis.scene import Material, SceneModel, Shape, entry_depth, surface
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
_LIGHT_TEXELS: Final = 512
_SHADE: Final = 0.35


class SceneState:
    """A scene at one moment: its shapes, its materials and the sunlight on its ground."""

    def __init__(
        self,
        scene: SceneModel,
        *,
        walker: Sequence[Shape],
        static_light: Float64[np.ndarray, "side side"],
    ) -> None:
        self.scene = scene
        self.shapes = [*scene.static_shapes, *walker]
        self.light = static_light.copy()
        for shape in walker:
            cast_shadow(self.light, shape=shape, scene=scene)
        materials = (_SKY_MATERIAL, scene.ground, *(shape.material for shape in self.shapes))
        rows = [(texture_row(each.texture), 1 / each.tile_m, *each.tint) for each in materials]
        self.materials = np.array(rows, np.float32).T.copy()

    def first_hits(self, rays: Rays, *, view: View) -> tuple[Array, Array]:
        """Return the depth in metres of each ray's first hit, and the number of the solid."""
        return first_hits(rays, view=view, shapes=self.shapes, slope=self.scene.slope)


def static_light(scene: SceneModel) -> Float64[np.ndarray, "side side"]:
    """Return the map of sunlight on the ground, with the shadows of things."""
    light = full_light()
    for shape in scene.static_shapes[scene.shell :]:
        cast_shadow(light, shape=shape, scene=scene)
    return light


def render_depth(state: SceneState, *, view: View) -> Float64[np.ndarray, "h w"]:
    """Return depth along the optical axis at pixel centres, in metres; the sky is infinite."""
    return np.concatenate([state.first_hits(rays, view=view)[0] for _, rays in pixel_rays(view)])


def render_frame(
    state: SceneState, *, view: View
) -> tuple[UInt8[np.ndarray, "h w 3"], Float64[np.ndarray, "h w"]]:
    """Return a picture with anti-aliased edges, and its depth as from `render_depth`."""
    width, height = view.size_px
    colour = np.empty((height, width, 3), np.float32)
    light = np.empty((height, width), np.float32)
    depth_m = np.empty((height, width))
    solid = np.empty((height, width), np.int64)
    for rows, rays in pixel_rays(view):
        near_m, met = depth_m[rows], solid[rows] = state.first_hits(rays, view=view)
        strip, lit = _shaded(
            state, view=view, rays=rays.listed(), depth_m=near_m.ravel(), solid=met.ravel()
        )
        colour[rows] = strip.T.reshape(-1, width, 3)
        light[rows] = lit.reshape(-1, width)
    _smooth_edges(colour, edges=_edges(solid, light=light), state=state, view=view)
    return np.rint(colour * 255).astype(np.uint8), depth_m


def _edges(
    solid: Int64[np.ndarray, "h w"], *, light: Float32[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Mark pixels beside another solid or another face of the same box."""
    edges = np.zeros(solid.shape, bool)
    for first, second in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        differ = solid[first] != solid[second]
        differ |= np.abs(light[first] - light[second]) > _FACE_LIGHT
        edges[first] |= differ
        edges[second] |= differ
    return edges


def _smooth_edges(
    colour: Float32[np.ndarray, "h w 3"],
    *,
    edges: Bool[np.ndarray, "h w"],
    state: SceneState,
    view: View,
) -> None:
    """Replace marked pixels, in place, by the mean of four rays per pixel."""
    rows, columns = np.nonzero(edges)
    for start in range(0, len(rows), _SUBPIXEL_BATCH):
        v, u = rows[start : start + _SUBPIXEL_BATCH], columns[start : start + _SUBPIXEL_BATCH]
        rays = Rays(
            view.right_of_axis(u + 0.5 + _SUBPIXELS[:, :1]).ravel(),
            view.below_axis(v + 0.5 + _SUBPIXELS[:, 1:]).ravel(),
        )
        depth_m, solid = state.first_hits(rays, view=view)
        drawn, _ = _shaded(state, view=view, rays=rays, depth_m=depth_m, solid=solid)
        colour[v, u] = drawn.reshape(3, len(_SUBPIXELS), -1).mean(axis=1).T


def _shaded(
    state: SceneState, *, view: View, rays: Rays, depth_m: Array, solid: Array
) -> tuple[Float32[np.ndarray, "3 n"], Float32[np.ndarray, " n"]]:
    """Return colours in 0..1, and the light alone, which differs between the faces of a box."""
    place_m = np.empty((2, solid.size), np.float32)
    footprint_m, slant, light = np.empty((3, solid.size), np.float32)
    for number in np.flatnonzero(np.bincount(solid)):
        index = np.flatnonzero(solid == number)
        part = Rays(rays.right[index], rays.below[index])
        reach = 1.0 if number == SKY else depth_m[index]
        if number == SKY:
            met = _on_sky(part, view=view)
        elif number == GROUND:
            met = _on_ground(part, view=view, state=state, depth_m=reach)
        else:
            shape = state.shapes[number - FIRST_SHAPE]
            met = _on_shape(part, view=view, shape=shape, depth_m=reach, sun=state.scene.sun)
        place_m[0, index], place_m[1, index], slant[index], light[index] = met
        footprint_m[index] = reach
    footprint_m *= np.maximum(slant, _LEAST_SLANT) ** np.float32(-_SLANT_POWER)
    footprint_m *= _BLUR_PX / max(view.focal_px)
    return _painted(
        state.materials[:, solid], place_m=place_m, footprint_m=footprint_m, light=light
    ), light


def _painted(
    materials: Float32[np.ndarray, "5 n"],
    *,
    place_m: Float32[np.ndarray, "2 n"],
    footprint_m: Float32[np.ndarray, " n"],
    light: Float32[np.ndarray, " n"],
) -> Float32[np.ndarray, "3 n"]:
    """Return textures times their tint, the light and, except for the sky, a fine grain."""
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
    """Return u, v, facing and light on a layer of clouds that curves down to the horizon."""
    x, y, z = rays.directions(view.axes)
    length = np.sqrt(x * x + y * y + z * z)
    height = np.abs(z) / length + 0.15
    return x / length / height, y / length / height, height**2, 1.06 - 0.25 * height


def _on_ground(
    rays: Rays, *, view: View, state: SceneState, depth_m: Array
) -> tuple[Array, Array, Array, Array]:
    scene = state.scene
    directions = np.stack(rays.directions(view.axes))
    x_m, y_m = view.eye[:2, None] + depth_m * directions[:2]
    normal = np.array([*-scene.slope, 1.0]) / np.sqrt(1 + scene.slope @ scene.slope)
    facing = np.abs(normal @ directions) / np.sqrt((directions * directions).sum(axis=0))
    sunlight = sunlight_at(state.light, x_m=x_m, y_m=y_m, scene=scene)
    return x_m, y_m, facing, _lit(sunward=normal @ scene.sun, upward=normal[2], sunlight=sunlight)


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


def full_light() -> Float64[np.ndarray, "side side"]:
    """Return the map of sunlight on an empty ground; rows are y, columns are x."""
    return np.ones((_LIGHT_TEXELS, _LIGHT_TEXELS))


def cast_shadow(
    light: Float64[np.ndarray, "side side"], *, shape: Shape, scene: SceneModel
) -> None:
    """Darken the map of sunlight, in place, where a shape is between the ground and the sun."""
    corners = shape.corners()
    drop = (corners[:, 2] - corners[:, :2] @ scene.slope) / (
        scene.sun[2] - scene.sun[:2] @ scene.slope
    )
    texels = _texel_of(corners[:, :2] - drop[:, None] * scene.sun[:2], scene=scene)
    low = np.clip(np.floor(texels.min(axis=0)), 0, _LIGHT_TEXELS).astype(int)
    high = np.clip(np.ceil(texels.max(axis=0)) + 1, 0, _LIGHT_TEXELS).astype(int)
    if (high <= low).any():
        return
    x_m = _metres_at(np.arange(low[0], high[0])[None], scene=scene)
    y_m = _metres_at(np.arange(low[1], high[1])[:, None], scene=scene)
    ground = (x_m, y_m, scene.slope[0] * x_m + scene.slope[1] * y_m)
    from_world = shape.axes / shape.half_m[:, None]
    start = -from_world @ shape.centre
    origin = [
        o + (a * ground[0] + b * ground[1] + c * ground[2])
        for o, (a, b, c) in zip(start, from_world, strict=True)
    ]
    blocked = np.isfinite(entry_depth(shape, origin=origin, direction=list(from_world @ scene.sun)))
    light[low[1] : high[1], low[0] : high[0]][blocked] = _SHADE


def sunlight_at(
    light: Float64[np.ndarray, "side side"], *, x_m: Array, y_m: Array, scene: SceneModel
) -> Array:
    """Return the interpolated light at places on the ground; beyond the map, that of its border."""
    place = np.clip(_texel_of(np.stack([x_m, y_m]).T, scene=scene), 0, _LIGHT_TEXELS - 1.001)
    corner = place.astype(int)
    (across, down), (column, row) = (place - corner).T, corner.T
    upper = light[row, column] * (1 - across) + light[row, column + 1] * across
    lower = light[row + 1, column] * (1 - across) + light[row + 1, column + 1] * across
    return upper * (1 - down) + lower * down


def _texel_of(place_m: Array, *, scene: SceneModel) -> Array:
    return (place_m / scene.shadow_range_m + 1) * (_LIGHT_TEXELS / 2) - 0.5


def _metres_at(texel: Array, *, scene: SceneModel) -> Array:
    return ((texel + 0.5) * (2 / _LIGHT_TEXELS) - 1) * scene.shadow_range_m
