"""What a pinhole camera sees first, at the centre of each pixel.

Pixel (u, v) is column, row; the centre of the top-left pixel is (0.5, 0.5). Axes are those of a map
(x forward, y right, z up), in metres. The ray of a pixel is ahead + right * r - up * b, where r and
b are the pixel's place to the right of and below the optical axis, at depth 1. So the t of a hit is
its depth along that axis.

The inverse depth of a plane is affine in r and b, and so are its edges. So a face of a box is drawn
without dividing, and one buffer of inverse depths keeps the nearest.
"""

from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float64, Int32

from stereogenbench_data.synthesis.renderer import View
from stereogenbench_data.synthesis.scene import Shape

Array = Any

SKY: Final = 0
GROUND: Final = 1
_FIRST_FACE: Final = 2
_FACES: Final = 6

_NEAREST_M: Final = 0.05
_TILE_PX: Final = 256
"""Side of the squares that are drawn at a time: they stay in the processor's cache."""


def in_unit_solid(view: View, shape: Shape) -> tuple[Array, Array]:
    """Return the eye, and the ray's coefficients as columns, in the unit solid's coordinates."""
    from_map = shape.axes / shape.half_m[:, None]
    return from_map @ (view.eye - shape.centre), from_map @ view.ray


def face_id(shape: int, *, axis: int = 0, sign: float = -1.0) -> int:
    """Return the number of a face of a box, or of an ellipsoid, by the number of the shape."""
    return _FIRST_FACE + _FACES * shape + 2 * axis + (sign > 0)


def shape_of(face: Array) -> Array:
    """Return the number of the shape that a face belongs to; negative for sky and ground."""
    return (face - _FIRST_FACE) // _FACES


class Plane(NamedTuple):
    """A plane of which a part is seen. Three numbers are the coefficients of 1, r and b.

    Attributes:
        face: Its number.
        inverse: The inverse depth.
        sides: For each of two directions, a quantity whose absolute value is at most the inverse
            depth inside the part; none for all of the plane.
    """

    face: int
    inverse: Array
    sides: tuple[Array, ...]


class Ball(NamedTuple):
    """An ellipsoid: its number, the eye in the unit ball's coordinates, and the ray's columns."""

    face: int
    eye: Array
    ray: Array


def ground_plane(view: View, *, slope: Float64[np.ndarray, "2"]) -> Plane:
    """Return the ground z = slope . (x, y), as seen from above."""
    normal = np.array([-slope[0], -slope[1], 1.0])
    return Plane(GROUND, -(normal @ view.ray) / (normal @ view.eye), ())


def visible_parts(view: View, *, number: int, shape: Shape) -> Iterator[Plane | Ball]:
    """Yield the faces of a box that are turned to the camera, or the ellipsoid."""
    eye, ray = in_unit_solid(view, shape)
    if shape.kind == "ellipsoid":
        if eye @ eye > 1:
            yield Ball(face_id(number), eye, ray)
        return
    for axis in range(3):
        if abs(eye[axis]) > 1:
            sign = float(np.sign(eye[axis]))
            inverse = ray[axis] / (sign - eye[axis])
            others = [other for other in range(3) if other != axis]
            sides = tuple(eye[other] * inverse + ray[other] for other in others)
            yield Plane(face_id(number, axis=axis, sign=sign), inverse, sides)


def inverse_depth(part: Plane | Ball, *, right: Array, below: Array) -> Array:
    """Return the inverse depth of what is seen of a part, nan where it is missed.

    With q = |eye|^2 - 1 > 0, b = eye . ray and s = b^2 - |ray|^2 q, the depth of an ellipsoid is
    q / (-b + sqrt s).

    Args:
        part: A plane or an ellipsoid.
        right: Where rays pass to the right of the axis, at depth 1.
        below: Where they pass below it; both broadcast.
    """
    if isinstance(part, Plane):
        c_0, c_r, c_b = part.inverse
        inverse = (c_0 + c_b * below) + c_r * right
        for s_0, s_r, s_b in part.sides:
            side = (s_0 + s_b * below) + s_r * right
            np.copyto(inverse, np.nan, where=np.abs(side, out=side) > inverse)
        return inverse
    c_0, c_r, c_b = part.ray.T
    outside = part.eye @ part.eye - 1
    towards = (part.eye @ c_0 + (part.eye @ c_b) * below) + (part.eye @ c_r) * right
    squared = (c_0 @ c_0 + below * (2 * (c_0 @ c_b) + (c_b @ c_b) * below)) + right * (
        2 * (c_0 @ c_r) + (c_r @ c_r) * right
    )
    squared += (2 * (c_r @ c_b) * below) * right
    squared *= -outside
    squared += towards * towards
    with np.errstate(invalid="ignore"):
        inverse = np.sqrt(squared)
    inverse -= towards
    inverse /= outside
    # Behind the camera both are negative.
    return np.where(towards < 0, inverse, np.nan)


def first_hits(
    view: View, *, shapes: Sequence[Shape], slope: Float64[np.ndarray, "2"]
) -> tuple[Float64[np.ndarray, "h w"], Int32[np.ndarray, "h w"]]:
    """Return the inverse depth in 1/m of each pixel's first hit, and the face that it hits.

    A face is `SKY` (with inverse depth 0), `GROUND`, or a `face_id`.
    """
    width, height = view.size_px
    nearest = np.zeros((height, width))
    faces = np.zeros((height, width), np.int32)
    right = view.right_of_axis(np.arange(width) + 0.5)
    below = view.below_axis(np.arange(height) + 0.5)

    def draw(part: Plane | Ball, rows: range, columns: range) -> None:
        for top, first in product(rows, columns):
            tile = np.s_[
                top : min(top + _TILE_PX, rows.stop), first : min(first + _TILE_PX, columns.stop)
            ]
            across, down = right[tile[1]], below[tile[0]]
            if isinstance(part, Plane) and _misses(part, right=across, below=down):
                continue
            inverse = inverse_depth(part, right=across, below=down[:, None])
            nearer = inverse > nearest[tile]
            np.copyto(nearest[tile], inverse, where=nearer)
            np.copyto(faces[tile], part.face, where=nearer)

    draw(ground_plane(view, slope=slope), range(0, height, _TILE_PX), range(0, width, _TILE_PX))
    for number, shape in enumerate(shapes):
        bounds = _bounds(shape, view=view)
        first, last = np.searchsorted(right, bounds[:2]).tolist()
        top, bottom = np.searchsorted(below, bounds[2:]).tolist()
        rows, columns = range(top, bottom, _TILE_PX), range(first, last, _TILE_PX)
        if rows and columns:
            for part in visible_parts(view, number=number, shape=shape):
                draw(part, rows, columns)
    return nearest, faces


def _misses(plane: Plane, *, right: Array, below: Array) -> bool:
    """Return whether a rectangle of rays lies beyond one of the edges of a plane's part."""
    for side in plane.sides:
        for c_0, c_r, c_b in (plane.inverse - side, plane.inverse + side):
            corners = c_0 + c_r * right[[0, -1]] + c_b * below[[0, -1], None]
            if corners.max() < 0:
                return True
    return False


def _bounds(shape: Shape, *, view: View) -> tuple[float, float, float, float]:
    """Return left, right, top and bottom bounds of a shape at depth 1; all 0 if it is behind."""
    forward, right, up = ((shape.corners() - view.eye) @ view.axes).T
    if forward.max() <= 0:
        return 0.0, 0.0, 0.0, 0.0
    if forward.min() < _NEAREST_M:
        return -np.inf, np.inf, -np.inf, np.inf
    across, down = right / forward, -up / forward
    return float(across.min()), float(across.max()), float(down.min()), float(down.max())


def hits_of_list(
    view: View,
    *,
    right: Float64[np.ndarray, " n"],
    below: Float64[np.ndarray, " n"],
    shapes: Sequence[Shape],
    slope: Float64[np.ndarray, "2"],
    among: Sequence[tuple[int, Array]],
) -> tuple[Float64[np.ndarray, " n"], Int32[np.ndarray, " n"]]:
    """Return the inverse depth and the face of each ray's first hit.

    Args:
        view: The camera.
        right: Where the rays pass to the right of the axis, at depth 1.
        below: Where they pass below it.
        shapes: The shapes.
        slope: The ground's.
        among: Numbers of shapes, each with the indices of the rays that may hit it.
    """
    nearest = np.maximum(
        inverse_depth(ground_plane(view, slope=slope), right=right, below=below), 0
    )
    faces = np.where(nearest > 0, GROUND, SKY).astype(np.int32)
    for number, index in among:
        for part in visible_parts(view, number=number, shape=shapes[number]):
            found = inverse_depth(part, right=right[index], below=below[index])
            nearer = found > nearest[index]
            nearest[index[nearer]] = found[nearer]
            faces[index[nearer]] = part.face
    return nearest, faces
