"""Solids that a ray meets: boxes and ellipsoids, each an affine picture of a unit solid.

World axes are Unreal's (x forward, y right, z up), in metres from the middle of the stage. A ray
is origin + t * direction; where directions have a part of exactly 1 along the optical axis, t is
depth along that axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Float64

Array = Any

_PARALLEL: Final = 1e-300
"""Stands for 0 where a ray runs along a face: it enters and leaves the slab at infinity."""


@dataclass(frozen=True, slots=True)
class Material:
    """A texture, how many metres of surface one tile covers, and the colour it is multiplied by."""

    texture: str
    tile_m: float
    tint: tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """A box or an ellipsoid.

    Attributes:
        centre: (3,) in the world, metres.
        axes: (3, 3), whose rows are the solid's own unit axes in the world.
        half_m: (3,) half the solid's extent along each of its axes.
    """

    kind: Literal["box", "ellipsoid"]
    centre: Float64[np.ndarray, "3"]
    axes: Float64[np.ndarray, "3 3"]
    half_m: Float64[np.ndarray, "3"]
    material: Material

    def corners(self) -> Float64[np.ndarray, "8 3"]:
        """Return the corners of the box that holds the solid."""
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


def entry(shape: Shape, *, origin: Sequence[Array], direction: Sequence[Array]) -> Array:
    """Return t where rays enter a shape from outside, infinity where they do not.

    ``origin`` and ``direction`` are three arrays each, that broadcast together: the rays in the
    unit solid's coordinates.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        if shape.kind == "box":
            return _box_entry(origin, direction)
        return _ellipsoid_entry(origin, direction)


def _box_entry(origin: Sequence[Array], direction: Sequence[Array]) -> Array:
    near, far = -np.inf, np.inf
    for o, d in zip(origin, direction, strict=True):
        inverse = 1 / np.where(d == 0, _PARALLEL, d)
        middle = -o * inverse
        reach = np.abs(inverse)
        near = np.maximum(near, middle - reach)
        far = np.minimum(far, middle + reach)
    return np.where((near < far) & (near > 0), near, np.inf)


def _ellipsoid_entry(origin: Sequence[Array], direction: Sequence[Array]) -> Array:
    squared = sum(d * d for d in direction)
    half_linear = sum(o * d for o, d in zip(origin, direction, strict=True))
    constant = sum(o * o for o in origin) - 1
    root = np.sqrt(half_linear * half_linear - squared * constant)
    t = (-half_linear - root) / squared
    return np.where(t > 0, t, np.inf)


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """What rays meet on a shape: for each ray one number in each of these.

    Attributes:
        u_m: Place on the surface, in metres along the texture's width.
        v_m: The same along its height.
        facing: Cosine between the ray and the surface's normal, 0 where it is grazed.
        sunward: Cosine between the normal and the direction to the sun, negative in shade.
        upward: The same for straight up.
    """

    u_m: Array
    v_m: Array
    facing: Array
    sunward: Array
    upward: Array


def surface(shape: Shape, *, point: Array, direction: Array, sun: Array) -> Surface:
    """Describe the surface where rays meet it; a face's texture lies in the plane of the face.

    An ellipsoid is textured as a box is: by the two axes that its normal points along least.

    Args:
        shape: What the rays meet.
        point: (3, n) where they meet it, in the unit solid's coordinates.
        direction: (3, n) their directions in the same coordinates.
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
