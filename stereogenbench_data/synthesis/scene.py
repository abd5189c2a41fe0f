"""What a built-in scene is made of: boxes and ellipsoids on a plane, and a walking figure.

Axes are those of a map (x forward, y right, z up), in metres.

A ray is origin + t * direction. Where directions have a component of exactly 1 along the optical
axis, t is the depth along that axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from jaxtyping import Float64

Array = Any

_UP: Final = np.array([0.0, 0.0, 1.0])
_BATCH_RAYS: Final = 4096
_PARALLEL: Final = 1e-300
"""Replaces 0 for a ray parallel to a face: it enters and leaves the slab at infinity."""


@dataclass(frozen=True, slots=True)
class Material:
    """A texture, the metres of surface that one tile covers, and a colour to multiply it by."""

    texture: str
    tile_m: float
    tint: tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """A box or an ellipsoid.

    Attributes:
        centre: (3,) in the world, metres.
        axes: (3, 3), whose rows are the solid's unit axes in the world.
        half_m: (3,) half the solid's size along each of its axes.
    """

    kind: Literal["box", "ellipsoid"]
    centre: Float64[np.ndarray, "3"]
    axes: Float64[np.ndarray, "3 3"]
    half_m: Float64[np.ndarray, "3"]
    material: Material

    def corners(self) -> Float64[np.ndarray, "8 3"]:
        """Return the corners of the solid's bounding box along its own axes."""
        signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, 8).T
        corners: Float64[np.ndarray, "8 3"] = self.centre + (signs * self.half_m) @ self.axes
        return corners


def limb(
    start: Float64[np.ndarray, "3"],
    end: Float64[np.ndarray, "3"],
    *,
    radius_m: float,
    side: Float64[np.ndarray, "3"],
    material: Material,
) -> Shape:
    """Return an ellipsoid along the line between two joints, a little longer than the line.

    ``side`` is a unit direction that is not along the line.
    """
    along = end - start
    length = float(np.linalg.norm(along))
    first = along / length
    second = np.cross(first, side)
    second /= np.linalg.norm(second)
    axes = np.stack([first, second, np.cross(first, second)])
    half_m = np.array([length / 2 + 0.5 * radius_m, radius_m, radius_m])
    return Shape("ellipsoid", (start + end) / 2, axes, half_m, material)


def entry_depth(shape: Shape, *, origin: Sequence[Array], direction: Sequence[Array]) -> Array:
    """Return the t at which rays enter a shape from outside, infinity where they miss it.

    ``origin`` and ``direction`` are three arrays each, which broadcast together: the rays in the
    unit solid's coordinates.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        if shape.kind == "box":
            near, far = -np.inf, np.inf
            for o, d in zip(origin, direction, strict=True):
                inverse = 1 / np.where(d == 0, _PARALLEL, d)
                middle, reach = -o * inverse, np.abs(inverse)
                near = np.maximum(near, middle - reach)
                far = np.minimum(far, middle + reach)
            return np.where((near < far) & (near > 0), near, np.inf)
        squared = sum(d * d for d in direction)
        half_linear = sum(o * d for o, d in zip(origin, direction, strict=True))
        constant = sum(o * o for o in origin) - 1
        root = np.sqrt(half_linear * half_linear - squared * constant)
        t = (-half_linear - root) / squared
        return np.where(t > 0, t, np.inf)


class Surface(NamedTuple):
    """The surface of a shape where rays hit it, with one number per ray in each attribute.

    Attributes:
        u_m: Place on the surface, in metres along the texture's width.
        v_m: The same along its height.
        facing: Cosine between the ray and the surface's normal, 0 for a grazing ray.
        sunward: Cosine between the normal and the direction to the sun, negative in shade.
        upward: Cosine between the normal and the vertical.
    """

    u_m: Array
    v_m: Array
    facing: Array
    sunward: Array
    upward: Array


def surface(shape: Shape, *, point: Array, direction: Array, sun: Array) -> Surface:
    """Describe the surface where rays hit it.

    The texture of a face lies in its plane. An ellipsoid is textured like a box: along the two axes
    that are most perpendicular to its normal.

    Args:
        shape: The shape that the rays hit.
        point: (3, n) the hits, in the unit solid's coordinates.
        direction: (3, n) the rays' directions in the same coordinates.
        sun: (3,) unit direction to the sun, in the world.
    """
    half_m = shape.half_m[:, None]
    gradient = point if shape.kind == "box" else point / half_m
    face = np.abs(gradient).argmax(axis=0)
    if shape.kind == "box":
        normal = np.where(face == np.arange(3)[:, None], np.sign(point), 0.0)
    else:
        normal = gradient / np.sqrt((gradient * gradient).sum(axis=0))
    ray = direction * half_m
    place_m = point * half_m + 7.3 * shape.centre.sum()
    return Surface(
        u_m=np.where(face == 0, place_m[1], place_m[0]) + 0.37 * face,
        v_m=np.where(face == 2, place_m[1], place_m[2]),
        facing=np.abs((normal * ray).sum(axis=0)) / np.sqrt((ray * ray).sum(axis=0)),
        sunward=(shape.axes @ sun) @ normal,
        upward=shape.axes[:, 2] @ normal,
    )


@dataclass(frozen=True, slots=True, eq=False)
class SceneModel:
    """A map without its subject.

    Attributes:
        slope: (2,) rise of the ground per metre along x and y; the ground passes the origin.
        ground: The ground's material.
        static_shapes: The shapes, none of which moves.
        shell: How many of the first shapes, walls and ceilings, cast no shadow on the ground.
        sun: (3,) unit direction to the sun.
        shadow_range_m: Distance from the origin, along x and y, up to which there are shadows.
    """

    slope: Float64[np.ndarray, "2"]
    ground: Material
    static_shapes: tuple[Shape, ...]
    shell: int
    sun: Float64[np.ndarray, "3"]
    shadow_range_m: float

    def ground_m(self, x_m: float, y_m: float) -> float:
        """Return the ground's height at a place."""
        return float(self.slope @ (x_m, y_m))

    def distances(
        self, origins_m: Float64[np.ndarray, "n 3"], directions: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, " n"]:
        """Return how far rays of unit direction go until they meet the map, as `World.cast`."""
        result = np.empty(len(origins_m))
        for start in range(0, len(origins_m), _BATCH_RAYS):
            batch = slice(start, start + _BATCH_RAYS)
            result[batch] = self._distances(origins_m[batch].T, directions[batch].T)
        return result

    def _distances(self, origins_m: Array, directions: Array) -> Array:
        rise_x, rise_y = self.slope
        above = origins_m[2] - rise_x * origins_m[0] - rise_y * origins_m[1]
        descent = rise_x * directions[0] + rise_y * directions[1] - directions[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            nearest = np.where(descent > 0, above / descent, np.inf)
        nearest = np.where(above <= 0, 0.0, nearest)
        for shape in self.static_shapes:
            apart = [o - c for o, c in zip(origins_m, shape.centre, strict=True)]
            from_world = shape.axes / shape.half_m[:, None]
            origin = [a * apart[0] + b * apart[1] + c * apart[2] for a, b, c in from_world]
            if shape.kind == "box":
                inside = np.maximum(np.maximum(abs(origin[0]), abs(origin[1])), abs(origin[2])) < 1
            else:
                inside = sum(o * o for o in origin) < 1
            ray = [
                a * directions[0] + b * directions[1] + c * directions[2] for a, b, c in from_world
            ]
            met = entry_depth(shape, origin=origin, direction=ray)
            nearest = np.minimum(nearest, np.where(inside, 0.0, met))
        return nearest


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure, about 1.75 m tall, that walks straight ahead.

    Attributes:
        clothes: Materials of its skin, upper and lower clothes.
        walk_m_s: How fast it goes ahead.
        stride_s: How long two steps take.
        scale: Its size as a multiple of the usual one.
    """

    clothes: tuple[Material, Material, Material]
    walk_m_s: float
    stride_s: float
    scale: float

    def limbs(
        self, *, start_m: Float64[np.ndarray, "3"], yaw_deg: float, rise: float, moment_s: float
    ) -> list[Shape]:
        """Return its limbs at a time.

        Args:
            start_m: Its place on the ground at time 0.
            yaw_deg: Where it faces.
            rise: Rise of the ground per metre in that direction.
            moment_s: The time.
        """
        skin, upper, lower = self.clothes
        yaw = np.radians(yaw_deg)
        ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        side = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        swing = 2 * np.pi * moment_s / self.stride_s
        feet = start_m + self.walk_m_s * moment_s * (ahead + rise * _UP)
        scale = self.scale
        hips = feet + scale * (0.93 + 0.025 * np.cos(2 * swing)) * _UP
        neck = hips + scale * (0.52 * _UP + 0.03 * ahead)

        def part(first: Array, second: Array, *, radius_m: float, material: Material) -> Shape:
            return limb(first, second, radius_m=scale * radius_m, side=side, material=material)

        shapes = [
            part(hips, neck, radius_m=0.17, material=upper),
            part(
                hips - 0.04 * scale * _UP, hips + 0.1 * scale * _UP, radius_m=0.16, material=lower
            ),
            part(neck + 0.1 * scale * _UP, neck + 0.27 * scale * _UP, radius_m=0.1, material=skin),
        ]
        for sign in (-1.0, 1.0):
            phase = sign * np.sin(swing)
            lag = sign * np.sin(swing - 0.9)
            hip = hips + 0.1 * scale * sign * side
            knee = hip + 0.43 * scale * _limb_direction(0.5 * phase, ahead)
            heel = knee + 0.42 * scale * _limb_direction(0.5 * phase - 0.35 - 0.35 * lag, ahead)
            shoulder = neck + scale * (0.2 * sign * side - 0.04 * _UP)
            elbow = shoulder + scale * (
                0.29 * _limb_direction(-0.5 * phase, ahead) + 0.04 * sign * side
            )
            hand = elbow + 0.27 * scale * _limb_direction(0.3 - 0.5 * phase, ahead)
            shapes += [
                part(hip, knee, radius_m=0.09, material=lower),
                part(knee, heel, radius_m=0.065, material=lower),
                part(heel, heel + 0.17 * scale * ahead, radius_m=0.05, material=skin),
                part(shoulder, elbow, radius_m=0.055, material=upper),
                part(elbow, hand, radius_m=0.045, material=skin),
            ]
        return shapes


def _limb_direction(angle: float, ahead: Array) -> Array:
    """Return the direction of a hanging limb that swings forward by an angle."""
    return np.sin(angle) * ahead - np.cos(angle) * _UP
