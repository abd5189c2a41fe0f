"""What a built-in scene is made of: boxes and ellipsoids on a plane, and a walking figure.

Axes are those of a map (x forward, y right, z up), in metres.

A ray is origin + t * direction. Where directions have a component of exactly 1 along the optical
axis, t is the depth along that axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.schema.release import FRAME_RATE_HZ
from stereogenbench_data.synthesis.renderer import Bounds, Spawn

Array = Any
Kind = Literal["box", "ellipsoid"]

_UP: Final = np.array([0.0, 0.0, 1.0])
_SIGNS: Final = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, 8).T
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

    kind: Kind
    centre: Float64[np.ndarray, "3"]
    axes: Float64[np.ndarray, "3 3"]
    half_m: Float64[np.ndarray, "3"]
    material: Material

    def corners(self) -> Float64[np.ndarray, "8 3"]:
        """Return the corners of the solid's bounding box along its own axes."""
        corners: Float64[np.ndarray, "8 3"] = self.centre + (_SIGNS * self.half_m) @ self.axes
        return corners


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

    def limbs(self, spawn: Spawn, *, slope: Float64[np.ndarray, "2"], frame: int) -> list[Shape]:
        """Return its limbs at a frame.

        Args:
            spawn: Where it starts, and the direction in which it goes.
            slope: Rise of the ground per metre along x and y.
            frame: The frame, at 15 Hz.
        """
        starts, ends, radii_m = self._bones(spawn, slope, frame)
        yaw = np.radians(spawn.yaw_deg)
        side = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        skin, upper, lower = self.clothes
        materials = (upper, lower, skin, *(lower, lower, skin, upper, skin) * 2)
        # An ellipsoid along each line between two joints, a little longer than the line.
        along = ends - starts
        lengths_m = np.array([np.linalg.norm(each) for each in along])
        first = along / lengths_m[:, None]
        second = np.cross(first, side)
        second /= np.array([[np.linalg.norm(each)] for each in second])
        axes = np.stack([first, second, np.cross(first, second)], axis=1)
        halves_m = np.stack([lengths_m / 2 + 0.5 * radii_m, radii_m, radii_m], axis=1)
        return [
            Shape("ellipsoid", *limb)
            for limb in zip((starts + ends) / 2, axes, halves_m, materials, strict=True)
        ]

    def points_m(
        self, spawn: Spawn, *, slope: Float64[np.ndarray, "2"], frame: int
    ) -> Float64[np.ndarray, "p 3"]:
        """Return both ends of every limb at a frame, given what `limbs` is given."""
        first, second, radii_m = self._bones(spawn, slope, frame)
        along = second - first
        along *= (0.5 * radii_m / np.sqrt((along * along).sum(axis=1)))[:, None]
        return np.stack([first - along, second + along], axis=1).reshape(-1, 3)

    def _bones(self, spawn: Spawn, slope: Array, frame: int) -> tuple[Array, Array, Array]:
        """Return where the limbs start and end, (13, 3) each, and their radii."""
        moment_s = frame / FRAME_RATE_HZ
        yaw, swing = np.radians(spawn.yaw_deg), 2 * np.pi * moment_s / self.stride_s
        rise = float(slope @ (np.cos(yaw), np.sin(yaw)))
        ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        side = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        feet = spawn.place_m + self.walk_m_s * moment_s * (ahead + rise * _UP)
        # The limbs of a figure of scale 1 whose hips are at the origin.
        neck = 0.52 * _UP + 0.03 * ahead
        bones = [
            (np.zeros(3), neck, 0.17),
            (-0.04 * _UP, 0.1 * _UP, 0.16),
            (neck + 0.1 * _UP, neck + 0.27 * _UP, 0.1),
        ]
        for sign in (-1.0, 1.0):
            phase = sign * np.sin(swing)
            lag = sign * np.sin(swing - 0.9)
            hip = 0.1 * sign * side
            knee = hip + 0.43 * _limb_direction(0.5 * phase, ahead)
            heel = knee + 0.42 * _limb_direction(0.5 * phase - 0.35 - 0.35 * lag, ahead)
            shoulder = neck + 0.2 * sign * side - 0.04 * _UP
            elbow = shoulder + 0.29 * _limb_direction(-0.5 * phase, ahead) + 0.04 * sign * side
            hand = elbow + 0.27 * _limb_direction(0.3 - 0.5 * phase, ahead)
            bones += [
                (hip, knee, 0.09),
                (knee, heel, 0.065),
                (heel, heel + 0.17 * ahead, 0.05),
                (shoulder, elbow, 0.055),
                (elbow, hand, 0.045),
            ]
        first, second, radii = (np.array(each) for each in zip(*bones, strict=True))
        hips = feet + self.scale * (0.93 + 0.025 * np.cos(2 * swing)) * _UP
        return hips + self.scale * first, hips + self.scale * second, self.scale * radii


def _limb_direction(angle: float, ahead: Array) -> Array:
    """Return the direction of a hanging limb that swings forward by an angle."""
    return np.sin(angle) * ahead - np.cos(angle) * _UP


@dataclass(frozen=True, slots=True, eq=False)
class RayWorld:
    """A built-in map with the figure of a proposal; see `World`.

    Attributes:
        slope: (2,) rise of the ground per metre along x and y; the ground passes the origin.
        ground: The ground's material.
        static_shapes: The shapes, none of which moves.
        shell: How many of the first shapes, walls and ceilings, cast no shadow on the ground.
        sun: (3,) unit direction to the sun.
        shadow_range_m: Distance from the origin, along x and y, up to which there are shadows.
        bounds_m: Where cameras may be.
        spawn_bounds_m: Where the figure may start.
        figure: The subject.
    """

    slope: Float64[np.ndarray, "2"]
    ground: Material
    static_shapes: tuple[Shape, ...]
    shell: int
    sun: Float64[np.ndarray, "3"]
    shadow_range_m: float
    bounds_m: Bounds
    spawn_bounds_m: Bounds
    figure: Figure

    def cast(
        self, origins_m: Float64[np.ndarray, "n 3"], directions: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, " n"]:
        """See `World.cast`."""
        result = np.empty(len(origins_m))
        for start in range(0, len(origins_m), _BATCH_RAYS):
            batch = slice(start, start + _BATCH_RAYS)
            result[batch] = self._distances(origins_m[batch].T, directions[batch].T)
        return result

    def subject_points_m(self, spawn: Spawn, *, frame: int) -> Float64[np.ndarray, "p 3"]:
        """Return both ends of every limb; see `World.subject_points_m`."""
        return self.figure.points_m(spawn, slope=self.slope, frame=frame)

    def _distances(self, origins_m: Array, directions: Array) -> Array:
        rise_x, rise_y = self.slope
        above = origins_m[2] - rise_x * origins_m[0] - rise_y * origins_m[1]
        descent = rise_x * directions[0] + rise_y * directions[1] - directions[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            nearest = np.where(descent > 0, above / descent, np.inf)
        nearest = np.where(above <= 0, 0.0, nearest)
        for shape, near in zip(
            self.static_shapes, self._may_meet(origins_m, directions), strict=True
        ):
            index = np.flatnonzero(near)
            if not len(index):
                continue
            apart = [o[index] - c for o, c in zip(origins_m, shape.centre, strict=True)]
            from_world = shape.axes / shape.half_m[:, None]
            origin = [a * apart[0] + b * apart[1] + c * apart[2] for a, b, c in from_world]
            if shape.kind == "box":
                inside = np.maximum(np.maximum(abs(origin[0]), abs(origin[1])), abs(origin[2])) < 1
            else:
                inside = sum(o * o for o in origin) < 1
            x, y, z = (d[index] for d in directions)
            ray = [a * x + b * y + c * z for a, b, c in from_world]
            met = np.where(inside, 0.0, entry_depth(shape, origin=origin, direction=ray))
            nearest[index] = np.minimum(nearest[index], met)
        return nearest

    def _may_meet(self, origins_m: Array, directions: Array) -> Array:
        """Return for each shape which rays pass its bounding sphere."""
        centres = np.array([shape.centre for shape in self.static_shapes]).reshape(-1, 3)
        radii_m = np.array([np.linalg.norm(shape.half_m) for shape in self.static_shapes])
        ahead = centres @ directions - (origins_m * directions).sum(axis=0)
        squared = (centres * centres).sum(axis=1)[:, None] - 2 * (centres @ origins_m)
        squared += (origins_m * origins_m).sum(axis=0)
        radii_m = radii_m[:, None] * 1.001 + 0.001
        return (ahead > -radii_m) & (squared - ahead * ahead < radii_m * radii_m)
