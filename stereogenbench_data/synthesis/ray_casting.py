"""Rays from a pinhole camera, and their first hits.

Pixel (u, v) is column, row; the centre of the top-left pixel is (0.5, 0.5). Scene axes are Unreal's
(x forward, y right, z up), in metres. The direction of a ray has a component of 1 along the optical
axis, so the t of a hit is its depth along that axis.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.synthesis.scene import Shape, entry_depth

Array = Any

SKY: Final = 0
GROUND: Final = 1
FIRST_SHAPE: Final = 2

_NEAREST_M: Final = 0.05
_STRIP_RAYS: Final = 1 << 17


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The view of one pinhole camera in a scene.

    Attributes:
        eye: (3,) the camera's centre.
        axes: (3, 3) whose columns are the camera's forward, right and up axes.
        focal_px: Focal lengths along the picture's width and height.
        centre_px: Principal point.
        size_px: Width and height of the picture.
    """

    eye: Float64[np.ndarray, "3"]
    axes: Float64[np.ndarray, "3 3"]
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    size_px: tuple[int, int]

    def right_of_axis(self, u_px: Array) -> Array:
        """Return the distance of a column to the right of the optical axis, at depth 1."""
        return (u_px - self.centre_px[0]) / self.focal_px[0]

    def below_axis(self, v_px: Array) -> Array:
        """Return the distance of a row below the optical axis, at depth 1."""
        return (v_px - self.centre_px[1]) / self.focal_px[1]

    def in_unit_solid(self, shape: Shape) -> tuple[Array, Array]:
        """Return the eye, and the camera's axes as columns, in the unit solid's coordinates."""
        from_world = shape.axes / shape.half_m[:, None]
        return from_world @ (self.eye - shape.centre), from_world @ self.axes


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """Rays by their place in the plane at depth 1, to the right of and below the optical axis.

    They are either a grid, with ``right`` (1, w) and ``below`` (h, 1), or a list, with both (n,).
    """

    right: Array
    below: Array

    def within(self, bounds: tuple[float, float, float, float]) -> tuple[Any, "Rays"]:
        """Return the index of the rays within left, right, top and bottom bounds, and the rays."""
        left, right, top, bottom = bounds
        if self.right.ndim == 2:
            columns = slice(*np.searchsorted(self.right[0], (left, right)))
            rows = slice(*np.searchsorted(self.below[:, 0], (top, bottom)))
            return (rows, columns), Rays(self.right[:, columns], self.below[rows])
        inside = (self.right >= left) & (self.right <= right)
        inside &= (self.below >= top) & (self.below <= bottom)
        index = np.flatnonzero(inside)
        return index, Rays(self.right[index], self.below[index])

    def listed(self) -> "Rays":
        """Return the same rays as a list."""
        right, below = np.broadcast_arrays(self.right, self.below)
        return Rays(right.ravel(), below.ravel())

    def directions(self, axes: Array) -> list[Array]:
        """Return the three components of the directions, given the camera's axes as columns."""
        return [ahead + (right * self.right - up * self.below) for ahead, right, up in axes]


def pixel_rays(view: View) -> Iterator[tuple[slice, Rays]]:
    """Yield the rays through pixel centres, in strips of rows that fit the processor's cache."""
    width, height = view.size_px
    step = max(1, _STRIP_RAYS // width)
    right = view.right_of_axis(np.arange(width)[None] + 0.5)
    for top in range(0, height, step):
        rows = np.arange(top, min(top + step, height))
        yield slice(top, top + len(rows)), Rays(right, view.below_axis(rows[:, None] + 0.5))


def first_hits(
    rays: Rays, *, view: View, shapes: Sequence[Shape], slope: Float64[np.ndarray, "2"]
) -> tuple[Array, Array]:
    """Return the depth in metres of each ray's first hit, and the number of the solid.

    The ground is the plane z = slope . (x, y). A solid is `SKY` (at infinite depth), `GROUND`,
    or `FIRST_SHAPE` plus the index of a shape in ``shapes``.
    """
    normal = np.array([-slope[0], -slope[1], 1.0])
    (descent,) = rays.directions(-(normal @ view.axes)[None])
    with np.errstate(divide="ignore"):
        depth_m = np.where(descent > 0, (normal @ view.eye) / descent, np.inf)
    solid = np.where(np.isfinite(depth_m), GROUND, SKY)
    for number, shape in enumerate(shapes, FIRST_SHAPE):
        index, inside = rays.within(_bounds(shape, view=view))
        if inside.right.size == 0 or inside.below.size == 0:
            continue
        origin, axes = view.in_unit_solid(shape)
        t = entry_depth(shape, origin=list(origin), direction=inside.directions(axes))
        nearer = t < depth_m[index]
        depth_m[index] = np.where(nearer, t, depth_m[index])
        solid[index] = np.where(nearer, number, solid[index])
    return depth_m, solid


def _bounds(shape: Shape, *, view: View) -> tuple[float, float, float, float]:
    """Return left, right, top and bottom bounds of a shape in the plane at depth 1."""
    forward, right, up = ((shape.corners() - view.eye) @ view.axes).T
    if forward.max() <= 0:
        return np.inf, -np.inf, np.inf, -np.inf
    if forward.min() < _NEAREST_M:
        return -np.inf, np.inf, -np.inf, np.inf
    across, down = right / forward, -up / forward
    return float(across.min()), float(across.max()), float(down.min()), float(down.max())
