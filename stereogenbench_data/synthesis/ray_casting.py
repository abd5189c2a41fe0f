"""What a pinhole camera sees first, at the centre of each pixel.

Pixel (u, v) is column, row; the centre of the top-left pixel is (0.5, 0.5). Axes are those of a map
(x forward, y right, z up), in metres. The ray of a pixel is ahead + right * r - up * b, where r and
b are the pixel's place to the right of and below the optical axis, at depth 1. So the t of a hit is
its depth along that axis.

The inverse depth of a plane is affine in r and b, and so are its edges. So a face of a box is drawn
like a polygon, without dividing, and one buffer of inverse depths keeps the nearest.
"""

from collections.abc import Iterator, Sequence
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
_BLOCK_PX: Final = 1 << 16
"""Pixels that are drawn at a time, so that they stay in the processor's cache."""


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
    shape: Shape


def ground_plane(view: View, *, slope: Float64[np.ndarray, "2"]) -> Plane:
    """Return the ground z = slope . (x, y), as seen from above."""
    normal = np.array([-slope[0], -slope[1], 1.0])
    return Plane(GROUND, -(normal @ view.ray) / (normal @ view.eye), ())


def visible_parts(view: View, *, number: int, shape: Shape) -> Iterator[Plane | Ball]:
    """Yield the faces of a box that are turned to the camera, or the ellipsoid."""
    eye, ray = in_unit_solid(view, shape)
    if shape.kind == "ellipsoid":
        if eye @ eye > 1:
            yield Ball(face_id(number), eye, ray, shape)
        return
    for axis in range(3):
        if abs(eye[axis]) > 1:
            sign = float(np.sign(eye[axis]))
            inverse = ray[axis] / (sign - eye[axis])
            others = [other for other in range(3) if other != axis]
            sides = tuple(eye[other] * inverse + ray[other] for other in others)
            yield Plane(face_id(number, axis=axis, sign=sign), inverse, sides)


def first_hits(
    view: View, *, shapes: Sequence[Shape], slope: Float64[np.ndarray, "2"]
) -> tuple[Float64[np.ndarray, "h w"], Int32[np.ndarray, "h w"]]:
    """Return the inverse depth in 1/m of each pixel's first hit, and the face that it hits.

    A face is `SKY` (with inverse depth 0), `GROUND`, or a `face_id`.
    """
    width, height = view.size_px
    inverse = np.zeros((height, width))
    faces = np.zeros((height, width), np.int32)
    picture = _Picture(
        inverse,
        faces,
        view.right_of_axis(np.arange(width) + 0.5),
        view.below_axis(np.arange(height) + 0.5),
    )
    _draw_plane(picture, ground_plane(view, slope=slope), view=view)
    for number, shape in enumerate(shapes):
        bounds = _bounds(shape, view=view)
        if bounds is None or not picture.overlaps(bounds):
            continue
        for part in visible_parts(view, number=number, shape=shape):
            if isinstance(part, Plane):
                _draw_plane(picture, part, view=view)
            else:
                _draw_ball(picture, part, bounds=bounds)
    return inverse, faces


class _Picture(NamedTuple):
    """The nearest inverse depths so far, their faces, and the places of columns and rows."""

    inverse: Array
    faces: Array
    right: Array
    below: Array

    def overlaps(self, bounds: tuple[float, float, float, float]) -> bool:
        """Return whether left, right, top and bottom bounds have a part of the picture."""
        left, right, top, bottom = bounds
        return bool(
            left <= self.right[-1]
            and right >= self.right[0]
            and top <= self.below[-1]
            and bottom >= self.below[0]
        )


def _draw_plane(picture: _Picture, plane: Plane, *, view: View) -> None:
    """Draw a part of a plane: in each row it covers the columns between two edges."""
    ahead, across, down = plane.inverse
    in_row = ahead + down * picture.below
    if not plane.sides:
        edges = [(in_row, across)]
    else:
        edges = []
        for c_0, c_r, c_b in plane.sides:
            side = c_0 + c_b * picture.below
            edges += [(in_row - side, across - c_r), (in_row + side, across + c_r)]
    least = np.full(len(in_row), -np.inf)
    most = np.full(len(in_row), np.inf)
    with np.errstate(divide="ignore", over="ignore"):
        for constant, rate in edges:
            if rate > 0:
                least = np.maximum(least, -constant / rate)
            elif rate < 0:
                most = np.minimum(most, -constant / rate)
            else:
                most = np.where(constant < 0, -np.inf, most)
    width = len(picture.right)
    scale, shift = view.focal_px[0], (view.size_px[0] - 1) / 2
    first = np.ceil(np.clip(least * scale + shift, -1, width)).clip(0).astype(np.int32)
    last = np.floor(np.clip(most * scale + shift, -1, width)).clip(max=width - 1).astype(np.int32)
    rows = np.flatnonzero(first <= last)
    if not len(rows):
        return
    left, right = int(first[rows].min()), int(last[rows].max()) + 1
    in_column = across * picture.right[left:right]
    columns = np.arange(left, right, dtype=np.int32)
    step = max(1, _BLOCK_PX // (right - left))
    for top in range(int(rows[0]), int(rows[-1]) + 1, step):
        block = slice(top, min(top + step, int(rows[-1]) + 1))
        inverse = in_row[block, None] + in_column
        kept = picture.inverse[block, left:right]
        nearer = inverse > kept
        if plane.sides:
            nearer &= columns >= first[block, None]
            nearer &= columns <= last[block, None]
        np.copyto(kept, inverse, where=nearer)
        np.copyto(picture.faces[block, left:right], plane.face, where=nearer)


def _draw_ball(picture: _Picture, ball: Ball, *, bounds: tuple[float, float, float, float]) -> None:
    left, right = np.searchsorted(picture.right, bounds[:2])
    top, bottom = np.searchsorted(picture.below, bounds[2:])
    if left == right:
        return
    step = max(1, _BLOCK_PX // int(right - left))
    for start in range(int(top), int(bottom), step):
        block = slice(start, min(start + step, int(bottom)))
        inverse = ball_inverse(
            ball, right=picture.right[left:right], below=picture.below[block, None]
        )
        kept = picture.inverse[block, left:right]
        nearer = inverse > kept
        np.copyto(kept, inverse, where=nearer)
        np.copyto(picture.faces[block, left:right], ball.face, where=nearer)


def ball_inverse(ball: Ball, *, right: Array, below: Array) -> Array:
    """Return the inverse depth of an ellipsoid, nan where it is missed; arrays broadcast.

    With q = |eye|^2 - 1 > 0, b = eye . ray and s = b^2 - |ray|^2 q, the depth is q / (-b + sqrt s).
    """
    c_0, c_r, c_b = ball.ray.T
    outside = ball.eye @ ball.eye - 1
    towards = (ball.eye @ c_0 + (ball.eye @ c_b) * below) + (ball.eye @ c_r) * right
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


def _bounds(shape: Shape, *, view: View) -> tuple[float, float, float, float] | None:
    """Return left, right, top and bottom bounds of a shape at depth 1; None if it is behind."""
    forward, right, up = ((shape.corners() - view.eye) @ view.axes).T
    if forward.max() <= 0:
        return None
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
    inverse = np.zeros(len(right))
    faces = np.zeros(len(right), np.int32)
    c_0, c_r, c_b = ground_plane(view, slope=slope).inverse
    ground = c_0 + c_r * right + c_b * below
    np.copyto(inverse, ground, where=ground > 0)
    np.copyto(faces, GROUND, where=ground > 0)
    for number, index in among:
        r, b = right[index], below[index]
        for part in visible_parts(view, number=number, shape=shapes[number]):
            if isinstance(part, Ball):
                found = ball_inverse(part, right=r, below=b)
            else:
                c_0, c_r, c_b = part.inverse
                found = c_0 + c_r * r + c_b * b
                for s_0, s_r, s_b in part.sides:
                    found[np.abs(s_0 + s_r * r + s_b * b) > found] = np.nan
            nearer = found > inverse[index]
            inverse[index[nearer]] = found[nearer]
            faces[index[nearer]] = part.face
    return inverse, faces
