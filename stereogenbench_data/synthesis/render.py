"""The built-in renderer: matte textured surfaces, lit by one sun.

Colours depend on the place on the surface and on the size of a pixel there, but not on the viewing
direction. So a view that is warped into another view by its depth agrees with that view.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int32, Int64, UInt8
from torch.nn.functional import grid_sample

from stereogenbench_data.synthesis.maps import ANIMATIONS, CHARACTERS, MAPS, open_map
from stereogenbench_data.synthesis.proposal import Proposal
from stereogenbench_data.synthesis.ray_casting import (
    GROUND,
    SKY,
    face_id,
    first_hits,
    hits_of_list,
    in_unit_solid,
    shape_of,
)
from stereogenbench_data.synthesis.renderer import RenderedView, Renderer, ScenePlan, View
from stereogenbench_data.synthesis.request import SENSOR_MM
from stereogenbench_data.synthesis.scene import Material, RayWorld, Shape, entry_depth
from stereogenbench_data.synthesis.textures import sample_atlas, sample_tile, texture_row

Array = Any

_SKY_MATERIAL: Final = Material("clouds", 3.0, (1.0, 1.0, 1.0))
_AMBIENT: Final = 0.42
_SKYLIGHT: Final = 0.1
_SUNLIGHT: Final = 0.62
_GRAIN_TILE_M: Final = 0.45
_GRAIN_CONTRAST: Final = 2.0
_BLUR_PX: Final = 0.8
_SLANT_POWER: Final = 0.8
_LEAST_SLANT: Final = 1e-3
_SUBPIXELS: Final = np.array([(-1, -3), (3, -1), (1, 3), (-3, 1)]) / 8
_STRIP_PX: Final = 1 << 17
_LIGHT_TEXELS: Final = 512
_SHADE: Final = 0.35


class SceneState:
    """A scene at one moment: its shapes, its materials and the sunlight on its ground."""

    def __init__(
        self,
        scene: RayWorld,
        *,
        walker: Sequence[Shape],
        static_light: Float64[np.ndarray, "side side"],
    ) -> None:
        self.scene = scene
        self.shapes = [*scene.static_shapes, *walker]
        self.light = static_light.copy()
        for shape in walker:
            cast_shadow(self.light, shape=shape, scene=scene)
        self.light_map = torch.from_numpy(self.light.astype(np.float32))[None, None]


def static_light(scene: RayWorld) -> Float64[np.ndarray, "side side"]:
    """Return the map of sunlight on the ground, with the shadows of things; rows y, columns x."""
    light = np.ones((_LIGHT_TEXELS, _LIGHT_TEXELS))
    for shape in scene.static_shapes[scene.shell :]:
        cast_shadow(light, shape=shape, scene=scene)
    return light


def _depth_m(inverse: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
    with np.errstate(divide="ignore"):
        depth_m: Float64[np.ndarray, "*n"] = 1 / inverse
    return depth_m


def render_frame(
    state: SceneState, *, view: View
) -> tuple[UInt8[np.ndarray, "h w 3"], Float64[np.ndarray, "h w"]]:
    """Return a picture with anti-aliased edges, and depth along the optical axis at pixel centres.

    Depth is in metres; the sky is infinite.
    """
    width, height = view.size_px
    inverse, faces = first_hits(view, shapes=state.shapes, slope=state.scene.slope)
    depth_m = _depth_m(inverse)
    right = view.right_of_axis(np.arange(width, dtype=np.float32) + np.float32(0.5))
    below = view.below_axis(np.arange(height, dtype=np.float32) + np.float32(0.5))
    picture = np.empty((height, width, 3), np.uint8)
    step = max(1, _STRIP_PX // width)
    for top in range(0, height, step):
        rows = slice(top, min(top + step, height))
        shape = (rows.stop - top, width)
        colours = _shaded(
            state,
            view=view,
            right=np.broadcast_to(right, shape).ravel(),
            below=np.broadcast_to(below[rows, None], shape).ravel(),
            depth_m=depth_m[rows].ravel().astype(np.float32),
            faces=faces[rows].ravel(),
        )
        picture[rows] = colours.reshape(*shape, 3)
    _smooth_edges(picture, faces=faces, state=state, view=view)
    return picture, depth_m


def _smooth_edges(
    picture: UInt8[np.ndarray, "h w 3"],
    *,
    faces: Int32[np.ndarray, "h w"],
    state: SceneState,
    view: View,
) -> None:
    """Replace pixels beside another face, in place, by the mean of four rays per pixel.

    A ray is tested against the shapes that the pixel and its four neighbours see.
    """
    edges = np.zeros(faces.shape, bool)
    for first, second in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        differ = faces[first] != faces[second]
        edges[first] |= differ
        edges[second] |= differ
    rows, columns = np.nonzero(edges)
    height, width = faces.shape
    step = _STRIP_PX // len(_SUBPIXELS)
    for start in range(0, len(rows), step):
        v, u = rows[start : start + step], columns[start : start + step]
        near = np.stack(
            [
                faces[v, u],
                faces[v, np.maximum(u - 1, 0)],
                faces[v, np.minimum(u + 1, width - 1)],
                faces[np.maximum(v - 1, 0), u],
                faces[np.minimum(v + 1, height - 1), u],
            ]
        )
        shapes = np.where(near >= face_id(0), shape_of(near), -1)
        offsets = len(v) * np.arange(len(_SUBPIXELS))[:, None]
        among = [
            (int(number), (offsets + np.flatnonzero((shapes == number).any(axis=0))).ravel())
            for number in np.flatnonzero(np.bincount(shapes.ravel() + 1)[1:])
        ]
        right = view.right_of_axis(u + 0.5 + _SUBPIXELS[:, :1]).ravel()
        below = view.below_axis(v + 0.5 + _SUBPIXELS[:, 1:]).ravel()
        inverse, met = hits_of_list(
            view,
            right=right,
            below=below,
            shapes=state.shapes,
            slope=state.scene.slope,
            among=among,
        )
        colours = _shaded(
            state,
            view=view,
            right=right.astype(np.float32),
            below=below.astype(np.float32),
            depth_m=_depth_m(inverse).astype(np.float32),
            faces=met,
        )
        rays = colours.reshape(len(_SUBPIXELS), len(v), 3)
        picture[v, u] = (rays.sum(axis=0, dtype=np.uint16) + len(rays) // 2) // len(rays)


class _Lit(NamedTuple):
    """Where rays meet one surface: the place on its texture, how they slant, and its light."""

    u_m: Array
    v_m: Array
    slant: Array
    light: Array


def _shaded(
    state: SceneState,
    *,
    view: View,
    right: Float32[np.ndarray, " n"],
    below: Float32[np.ndarray, " n"],
    depth_m: Float32[np.ndarray, " n"],
    faces: Int32[np.ndarray, " n"],
) -> UInt8[np.ndarray, "n 3"]:
    """Return the colours of what rays meet."""
    # Neighbours on one surface are lit together, and then all are painted at once.
    order = np.argsort(faces.astype(np.int16), kind="stable")
    sorted_faces = faces[order]
    starts = np.append(0, np.flatnonzero(np.diff(sorted_faces)) + 1)[: len(order)]
    counts = np.diff(starts, append=len(order))
    right, below, depth_m = right[order], below[order], depth_m[order]
    depth_m[sorted_faces == SKY] = 1
    all_rays = _Rays(right, below, depth_m, np.sqrt(1 + right * right + below * below))
    lit = _Lit(*np.empty((4, len(order)), np.float32))
    materials = []
    for start, count in zip(starts.tolist(), counts.tolist(), strict=True):
        part = slice(start, start + count)
        rays = _Rays(*(each[part] for each in all_rays))
        material, found = _met(rays, state=state, view=view, face=int(sorted_faces[start]))
        materials.append(material)
        for whole, values in zip(lit, found, strict=True):
            whole[part] = values
    painted = _painted(materials, counts, lit, depth_m, focal_px=max(view.focal_px))
    painted *= 255
    painted += np.float32(0.5)
    # One number of 32 bits a pixel goes back to its place faster than three of 8.
    colours = np.empty(len(order), np.uint32)
    colours.view(np.uint8).reshape(-1, 4)[:, :3] = painted.T
    result = np.empty_like(colours)
    result[order] = colours
    return result.view(np.uint8).reshape(-1, 4)[:, :3]


class _Rays(NamedTuple):
    """Rays by their places at depth 1, with the depth of their hits and their length at depth 1."""

    right: Array
    below: Array
    depth_m: Array
    length: Array

    def along(self, coefficients: Array) -> Array:
        """Return a quantity that is affine in the rays' places, by its three coefficients."""
        ahead, right, below = coefficients.astype(np.float32)
        return ahead + right * self.right + below * self.below


def _painted(
    materials: Sequence[Material],
    counts: Int64[np.ndarray, " m"],
    lit: _Lit,
    depth_m: Float32[np.ndarray, " n"],
    *,
    focal_px: float,
) -> Float32[np.ndarray, "3 n"]:
    """Return textures times their tints, the light and, except for the sky, a fine grain.

    The first ``counts[0]`` rays meet the first material, and so on.
    """
    # The mip level is the binary logarithm of the texels that one pixel covers.
    log_depth = torch.from_numpy(depth_m * np.float32(_BLUR_PX / focal_px)).log2_()
    slant = torch.from_numpy(np.maximum(lit.slant, np.float32(_LEAST_SLANT)))
    log_footprint: Array = (log_depth - slant.log2_() * _SLANT_POWER).numpy()
    per_m = np.array([1 / material.tile_m for material in materials], np.float32)
    rows = np.array([texture_row(material.texture) for material in materials], np.float32)
    tints = np.array([material.tint for material in materials], np.float32).reshape(-1, 3)
    tiles = np.repeat(per_m, counts)
    colour = sample_atlas(
        lit.u_m * tiles,
        lit.v_m * tiles,
        row=np.repeat(rows, counts),
        log_footprint=log_footprint + np.repeat(np.log2(per_m), counts),
    )
    per_grain = np.float32(1 / _GRAIN_TILE_M)
    grain = sample_tile(
        lit.u_m * per_grain,
        lit.v_m * per_grain,
        row=texture_row("grain"),
        log_footprint=log_footprint + np.float32(np.log2(per_grain)),
    )
    grain *= np.float32(_GRAIN_CONTRAST)
    grain += np.float32(1 - 0.5 * _GRAIN_CONTRAST)
    grain[np.repeat([material is _SKY_MATERIAL for material in materials], counts)] = 1
    colour *= lit.light * grain
    colour *= np.repeat(tints.T, counts, axis=1)
    return np.clip(colour, 0, 1, out=colour)


def _met(rays: _Rays, *, state: SceneState, view: View, face: int) -> tuple[Material, _Lit]:
    """Return the material of a face, and how rays meet it."""
    if face == SKY:
        return _SKY_MATERIAL, _on_sky(rays, view=view)
    if face == GROUND:
        return state.scene.ground, _on_ground(rays, view=view, state=state)
    shape = state.shapes[int(shape_of(np.int64(face)))]
    on = _on_face if shape.kind == "box" else _on_ball
    return shape.material, on(rays, view, shape, face, state.scene.sun)


def _light(*, sunward: Array, upward: Array, sunlight: Array) -> Array:
    return _AMBIENT + _SKYLIGHT * upward + _SUNLIGHT * sunlight * np.maximum(sunward, 0)


def _on_sky(rays: _Rays, *, view: View) -> _Lit:
    """Return places on a layer of clouds that curves down to the horizon."""
    x, y, z = (rays.along(row) / rays.length for row in view.ray)
    height = np.abs(z) + np.float32(0.15)
    return _Lit(x / height, y / height, height**2, np.float32(1.06) - np.float32(0.25) * height)


def _on_ground(rays: _Rays, *, view: View, state: SceneState) -> _Lit:
    scene = state.scene
    x_m, y_m = (
        np.float32(eye) + rays.depth_m * rays.along(row)
        for eye, row in zip(view.eye[:2], view.ray[:2], strict=True)
    )
    normal = np.array([*-scene.slope, 1.0]) / np.sqrt(1 + scene.slope @ scene.slope)
    sunlight = _sunlight_at(state.light_map, x_m=x_m, y_m=y_m, scene=scene)
    return _Lit(
        x_m,
        y_m,
        np.abs(rays.along(normal @ view.ray)) / rays.length,
        _light(
            sunward=np.float32(normal @ scene.sun), upward=np.float32(normal[2]), sunlight=sunlight
        ),
    )


def _on_face(rays: _Rays, view: View, shape: Shape, face: int, sun: Array) -> _Lit:
    """Return places on a face of a box; its texture lies in its plane."""
    axis, up = divmod((face - face_id(0)) % 6, 2)
    normal = shape.axes[axis] * (1.0 if up else -1.0)
    across, along = (1, 2) if axis == 0 else (0, 2) if axis == 1 else (0, 1)
    shift = 7.3 * shape.centre.sum()
    u_m, v_m = (
        np.float32(shape.axes[other] @ (view.eye - shape.centre) + offset)
        + rays.depth_m * rays.along(shape.axes[other] @ view.ray)
        for other, offset in ((across, shift + 0.37 * axis), (along, shift))
    )
    light = _light(sunward=normal @ sun, upward=normal[2], sunlight=1.0)
    return _Lit(u_m, v_m, np.abs(rays.along(normal @ view.ray)) / rays.length, np.float32(light))


def _on_ball(rays: _Rays, view: View, shape: Shape, face: int, sun: Array) -> _Lit:
    """Return places on an ellipsoid, textured like a box, along the axes across its normal."""
    eye, ray = in_unit_solid(view, shape)
    directions = np.stack([rays.along(row) for row in ray])
    point = eye.astype(np.float32)[:, None] + rays.depth_m * directions
    half_m = shape.half_m.astype(np.float32)[:, None]
    gradient = point / half_m
    side = np.abs(gradient).argmax(axis=0)
    normal = gradient / np.sqrt((gradient * gradient).sum(axis=0))
    place_m = point * half_m + np.float32(7.3 * shape.centre.sum())
    return _Lit(
        np.where(side == 0, place_m[1], place_m[0]) + np.float32(0.37) * side.astype(np.float32),
        np.where(side == 2, place_m[1], place_m[2]),
        np.abs((normal * (directions * half_m)).sum(axis=0)) / rays.length,
        _light(
            sunward=(shape.axes @ sun).astype(np.float32) @ normal,
            upward=shape.axes[:, 2].astype(np.float32) @ normal,
            sunlight=np.float32(1),
        ),
    )


def _sunlight_at(
    light: torch.Tensor, *, x_m: Array, y_m: Array, scene: RayWorld
) -> Float32[np.ndarray, " n"]:
    """Return the interpolated light at places on the ground; beyond the map, that of its border."""
    grid = torch.from_numpy(np.stack([x_m, y_m], axis=-1) / np.float32(scene.shadow_range_m))
    found = grid_sample(light, grid[None, None], padding_mode="border", align_corners=False)
    return found[0, 0, 0].numpy()


def cast_shadow(light: Float64[np.ndarray, "side side"], *, shape: Shape, scene: RayWorld) -> None:
    """Darken the map of sunlight, in place, where a shape is between the ground and the sun."""
    corners = shape.corners()
    drop = (corners[:, 2] - corners[:, :2] @ scene.slope) / (
        scene.sun[2] - scene.sun[:2] @ scene.slope
    )
    place_m = corners[:, :2] - drop[:, None] * scene.sun[:2]
    texels = (place_m / scene.shadow_range_m + 1) * (_LIGHT_TEXELS / 2) - 0.5
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


def _metres_at(texel: Array, *, scene: RayWorld) -> Array:
    return ((texel + 0.5) * (2 / _LIGHT_TEXELS) - 1) * scene.shadow_range_m


@lru_cache(maxsize=1)
def _lit_map(proposal: Proposal) -> tuple[RayWorld, Float64[np.ndarray, "side side"]]:
    """Return the map of a proposal with its `static_light`, once for all cameras."""
    world = open_map(proposal)
    return world, static_light(world)


@dataclass(frozen=True)
class RayCasting(Renderer):
    """The built-in renderer; see `Renderer`."""

    name: str = "ray-casting"
    maps: tuple[str, ...] = MAPS
    characters: tuple[str, ...] = CHARACTERS
    animations: tuple[str, ...] = ANIMATIONS
    sensors_mm: tuple[tuple[float, float], ...] = (SENSOR_MM,)
    fingerprint: str = "1"
    cameras_per_task: int = 1

    def world(self, proposal: Proposal) -> RayWorld:
        """See `Renderer.world`. A map of the release is a stage."""
        return open_map(proposal)

    def views(self, plan: ScenePlan, *, cameras: tuple[int, ...]) -> Iterator[RenderedView]:
        """See `Renderer.views`."""
        world, light = _lit_map(plan.proposal)
        for frame in range(plan.proposal.request.frames):
            state = SceneState(
                world,
                walker=world.figure.limbs(plan.spawn, slope=world.slope, frame=frame),
                static_light=light,
            )
            for camera in cameras:
                yield RenderedView(*render_frame(state, view=plan.view(camera=camera, frame=frame)))

    def description(self, plan: ScenePlan) -> dict[str, object]:
        """See `Renderer.description`."""
        scene = open_map(plan.proposal)
        ground, walls = scene.ground.texture, scene.static_shapes[0].material.texture
        things = len(scene.static_shapes)
        shell = scene.static_shapes[: scene.shell]
        has_ceiling = any(shape.centre[2] - shape.half_m[2] > 2 for shape in shell)
        place = "room" if has_ceiling else "yard"
        detailed = (
            f"A figure walks over a ground of {ground}, among crates, balls and poles ({things} "
            f"things in all), before walls of {walls}."
        )
        return {
            "scene_type": "indoor" if has_ceiling else "outdoor",
            "setting": place,
            "primary_elements": ["figure", "crates", "balls", "poles", "walls"],
            "spatial_layout": "a figure in the middle, things scattered around it",
            "lighting_materials": "sunlight, matte procedural textures",
            "short_caption": f"A figure walks over {ground}.",
            "detailed_caption": detailed,
            "tags": [place, "figure", ground, walls],
        }


RAY_CASTING = RayCasting()
