"""A synthetic 3-D scene: a slanted ground, a backdrop, boxes, balls, poles and a walking figure.

Scene axes are Unreal's (x forward, y right, z up), in metres. The subject walks around the origin
and the cameras are at negative x. Sizes follow the width of the picture at the depth of an object,
so that a picture is full at any focal length.

A ray is origin + t * direction. Where directions have a component of exactly 1 along the optical
axis, t is the depth along that axis.
"""

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from jaxtyping import Float64

Array = Any

_GROUNDS: Final = ("soil", "mosaic", "bricks", "boards")
_WALLS: Final = ("bricks", "plaster", "boards", "mosaic")
_THINGS: Final = ("boards", "weave", "mosaic", "plaster", "soil", "bricks")
_CLOTHES: Final = ("weave", "plaster", "mosaic")
_UP: Final = np.array([0.0, 0.0, 1.0])
_STRIDE_S: Final = 1.1
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
    material: Material,
) -> Shape:
    """Return an ellipsoid along the line between two joints, a little longer than the line."""
    along = end - start
    length = float(np.linalg.norm(along))
    first = along / length
    second = np.cross(first, [1.0, 0.0, 0.0])
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


@dataclass(frozen=True, slots=True)
class Framing:
    """The part of a scene that the cameras see.

    Attributes:
        distance_m: Distance from the cameras to the subject.
        width_per_m: Width of the picture at one metre, in metres.
        span_m: Distance from the first camera to the last.
        pixel_per_m: Width of a pixel at one metre, in metres.
    """

    distance_m: float
    width_per_m: float
    span_m: float
    pixel_per_m: float

    def width_m(self, x_m: float) -> float:
        """Return the width of the picture at a place in the scene."""
        return (x_m + self.distance_m) * self.width_per_m


@dataclass(frozen=True, slots=True, eq=False)
class SceneModel:
    """The contents of a scene.

    Attributes:
        slope: (2,) rise of the ground per metre along x and y.
        ground: The ground's material.
        static_shapes: The shapes that do not move.
        clothes: Three materials of the walker: skin, upper and lower clothes.
        walk_m_s: Speed of the walker, positive to the right.
        sun: (3,) unit direction to the sun.
        shadow_range_m: Distance from the origin up to which there are shadows.
    """

    slope: Float64[np.ndarray, "2"]
    ground: Material
    static_shapes: tuple[Shape, ...]
    clothes: tuple[Material, Material, Material]
    walk_m_s: float
    sun: Float64[np.ndarray, "3"]
    shadow_range_m: float

    def ground_m(self, x_m: float, y_m: float) -> float:
        """Return the ground's height at a place."""
        return float(self.slope @ (x_m, y_m))

    def walker(self, moment_s: float) -> list[Shape]:
        """Return the walker's limbs at a time."""
        y_m = self.walk_m_s * moment_s
        hips = np.array([0.0, y_m, self.ground_m(0.0, y_m) + 0.93])
        swing = 2 * np.pi * moment_s / _STRIDE_S
        return _limbs(hips, swing=swing, heading=np.sign(self.walk_m_s), clothes=self.clothes)


def random_scene(rng: np.random.Generator, *, framing: Framing, walk_m_s: float) -> SceneModel:
    """Return a random scene for a framing, without its cameras."""
    slope = rng.uniform(-0.07, 0.07, 2)
    towards = rng.uniform(np.radians(-75), np.radians(75))
    height = rng.uniform(np.radians(32), np.radians(58))
    sun = np.array(
        [-np.cos(height) * np.cos(towards), np.cos(height) * np.sin(towards), np.sin(height)]
    )
    static_shapes = [
        *_backdrop(rng, framing=framing),
        *_objects(rng, framing=framing),
        *_poles(rng, framing=framing),
    ]
    return SceneModel(
        slope=slope,
        ground=_material(rng, textures=_GROUNDS, tile_m=(2.0, 4.0)),
        # The shapes stand on a level ground; here they are raised to the slanted one.
        static_shapes=tuple(
            replace(shape, centre=shape.centre + _UP * (slope @ shape.centre[:2]))
            for shape in static_shapes
        ),
        clothes=(
            Material("plaster", 0.5, (1.5, 1.05, 0.8)),
            _material(rng, textures=_CLOTHES, tile_m=(0.3, 0.8)),
            _material(rng, textures=_CLOTHES, tile_m=(0.3, 0.8)),
        ),
        walk_m_s=walk_m_s,
        sun=sun,
        shadow_range_m=3 * framing.distance_m + 4,
    )


def _material(
    rng: np.random.Generator, *, textures: tuple[str, ...], tile_m: tuple[float, float]
) -> Material:
    hue, saturation, value = rng.uniform((0, 0.03, 1.15), (1, 0.4, 1.5))
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation, value)
    texture = textures[int(rng.integers(len(textures)))]
    return Material(texture, float(rng.uniform(*tile_m)), (red, green, blue))


def _rotated_axes(*, yaw: float, tilt: float = 0.0) -> Array:
    """Return the axes of a solid that is turned around the vertical and then tilted."""
    c, s = np.cos(yaw), np.sin(yaw)
    upright = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    c, s = np.cos(tilt), np.sin(tilt)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]]) @ upright


def _backdrop(rng: np.random.Generator, *, framing: Framing) -> list[Shape]:
    """Return buildings and walls behind the subject, with gaps that show the sky."""
    shapes = []
    for x_m in framing.distance_m * rng.uniform(1.5, 3.5, 9) + 2:
        view_m = framing.width_m(x_m)
        half_m = view_m * rng.uniform((0.05, 0.08, 0.08), (0.1, 0.22, 0.3))
        y_m = rng.uniform(-0.6, 0.6) * (view_m + framing.span_m)
        shapes.append(
            Shape(
                "box",
                np.array([x_m, y_m, half_m[2] * 0.98]),
                _rotated_axes(yaw=rng.uniform(-0.5, 0.5)),
                half_m,
                _material(rng, textures=_WALLS, tile_m=(2.0, 4.0)),
            )
        )
    return shapes


def _objects(rng: np.random.Generator, *, framing: Framing) -> list[Shape]:
    """Return crates and balls in front of and behind the subject, from near to far."""
    shapes = []
    near, far = -0.55 * framing.distance_m, 1.6 * framing.distance_m
    for place in (np.arange(16) + rng.uniform(0, 1, 16)) / 16:
        x_m = near + place * (far - near)
        view_m = framing.width_m(x_m)
        half_m = view_m * rng.uniform(0.025, 0.075) * rng.uniform(0.7, 1.4, 3)
        y_m = rng.uniform(-0.5, 0.5) * (view_m + framing.span_m)
        if abs(x_m) < 0.4 + half_m.max():
            x_m = 0.6 + 2 * half_m.max()
        is_box = rng.random() < 0.55
        tilt = rng.uniform(-0.6, 0.6) if rng.random() < 0.4 else 0.0
        shapes.append(
            Shape(
                "box" if is_box else "ellipsoid",
                np.array([x_m, y_m, half_m[2] * rng.uniform(0.75, 0.98)]),
                _rotated_axes(yaw=rng.uniform(0, np.pi), tilt=tilt),
                half_m,
                _material(rng, textures=_THINGS, tile_m=(0.6, 2.0)),
            )
        )
    return shapes


def _poles(rng: np.random.Generator, *, framing: Framing) -> list[Shape]:
    """Return thin upright posts, a few pixels wide, some of them nearer than the subject."""
    shapes = []
    for x_part in (*rng.uniform(-0.6, -0.25, 3), *rng.uniform(0.4, 1.6, 4)):
        x_m = x_part * framing.distance_m + (0.8 if x_part > 0 else 0.0)
        depth_m = x_m + framing.distance_m
        relative = rng.uniform(0.002, 0.006) * framing.width_per_m
        width_m = depth_m * max(relative, 2.2 * framing.pixel_per_m)
        height_m = framing.width_m(x_m) * rng.uniform(0.3, 0.8) + 0.5
        y_m = rng.uniform(-0.45, 0.45) * (framing.width_m(x_m) + framing.span_m)
        shapes.append(
            Shape(
                "box",
                np.array([x_m, y_m, 0.48 * height_m]),
                _rotated_axes(yaw=rng.uniform(0, np.pi), tilt=rng.uniform(-0.12, 0.12)),
                np.array([width_m / 2, width_m / 2, height_m / 2]),
                _material(rng, textures=_WALLS, tile_m=(0.3, 0.8)),
            )
        )
    return shapes


def _limbs(
    hips: Float64[np.ndarray, "3"],
    *,
    swing: float,
    heading: float,
    clothes: tuple[Material, Material, Material],
) -> list[Shape]:
    """Return the limbs of a figure, about 1.75 m tall, that walks along y."""
    skin, upper, lower = clothes
    ahead, side = np.array([0.0, heading, 0.0]), np.array([1.0, 0.0, 0.0])
    hips = hips + _UP * 0.025 * np.cos(2 * swing)
    neck = hips + 0.52 * _UP + 0.03 * ahead
    shapes = [
        limb(hips, neck, radius_m=0.17, material=upper),
        limb(hips - 0.04 * _UP, hips + 0.1 * _UP, radius_m=0.16, material=lower),
        limb(neck + 0.1 * _UP, neck + 0.27 * _UP, radius_m=0.1, material=skin),
    ]
    for sign in (-1.0, 1.0):
        phase = sign * np.sin(swing)
        lag = sign * np.sin(swing - 0.9)
        hip = hips + 0.1 * sign * side
        knee = hip + 0.43 * _limb_direction(0.5 * phase, ahead)
        heel = knee + 0.42 * _limb_direction(0.5 * phase - 0.35 - 0.35 * lag, ahead)
        shoulder = neck + 0.2 * sign * side - 0.04 * _UP
        elbow = shoulder + 0.29 * _limb_direction(-0.5 * phase, ahead) + 0.04 * sign * side
        hand = elbow + 0.27 * _limb_direction(0.3 - 0.5 * phase, ahead)
        shapes += [
            limb(hip, knee, radius_m=0.09, material=lower),
            limb(knee, heel, radius_m=0.065, material=lower),
            limb(heel, heel + 0.17 * ahead, radius_m=0.05, material=skin),
            limb(shoulder, elbow, radius_m=0.055, material=upper),
            limb(elbow, hand, radius_m=0.045, material=skin),
        ]
    return shapes


def _limb_direction(angle: float, ahead: Array) -> Array:
    """Return the direction of a hanging limb that swings forward by an angle."""
    return np.sin(angle) * ahead - np.cos(angle) * _UP
