"""A pinhole camera's intrinsics in pixels, and how resizing, cropping and flipping change them.

Pixel (u, v) is column, row; the centre of the top-left pixel is (0.5, 0.5), so the middle of an
image w wide is u = w / 2. Camera axes are x right, y down, z forward: u = fx x / z + cx.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.errors import GeometryError
from stereogenbench_data.schema.records import Rig


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Focal lengths and principal point of an image, in pixels of that image.

    Raises:
        GeometryError: If a focal length is not positive and finite, the principal point is not
            finite, or a size is below 1.
    """

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    width_px: int
    height_px: int

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        places = (self.fx_px, self.fy_px, self.cx_px, self.cy_px)
        is_finite = all(map(math.isfinite, places))
        if (
            not is_finite
            or min(self.fx_px, self.fy_px) <= 0
            or min(self.width_px, self.height_px) < 1
        ):
            raise GeometryError(
                f"focal lengths must be positive, the principal point finite, and a size one pixel "
                f"or more, all in pixels of the image; got {self}."
            )

    def resized(self, *, width_px: int, height_px: int) -> "Intrinsics":
        """Return the intrinsics of the image stretched to exactly this size.

        Disparity in the resized image is the old one times ``width_px / self.width_px``, for any
        height.
        """
        sx, sy = width_px / self.width_px, height_px / self.height_px
        return replace(
            self,
            fx_px=self.fx_px * sx,
            fy_px=self.fy_px * sy,
            cx_px=self.cx_px * sx,
            cy_px=self.cy_px * sy,
            width_px=width_px,
            height_px=height_px,
        )

    def cropped(self, *, left_px: int, top_px: int, width_px: int, height_px: int) -> "Intrinsics":
        """Return the intrinsics of a window whose top-left pixel is (left_px, top_px).

        The window may reach beyond the image on any side (padding), so offsets may be negative.
        """
        return replace(
            self,
            cx_px=self.cx_px - left_px,
            cy_px=self.cy_px - top_px,
            width_px=width_px,
            height_px=height_px,
        )

    def flipped(self) -> "Intrinsics":
        """Return the intrinsics of the image mirrored left to right: cx becomes width - cx.

        The views of a stereo pair swap too: the mirrored right view becomes the left one.
        """
        return replace(self, cx_px=self.width_px - self.cx_px)

    def matrix(self) -> Float64[np.ndarray, "3 3"]:
        """Return K, which takes camera axes (x, y, z) to homogeneous pixels (u, v, 1) z."""
        return np.array(
            [[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]]
        )


def rig_intrinsics(rig: Rig) -> Intrinsics:
    """Return the intrinsics of all six cameras of a rig, for its stored pictures.

    Where these have another size than the recorded one, the numbers equal those of `resized`, bit
    for bit.
    """
    recorded = recorded_intrinsics(rig)
    if rig.recorded_size_px is None:
        return recorded
    return recorded.resized(width_px=rig.image_width_px, height_px=rig.image_height_px)


def recorded_intrinsics(rig: Rig) -> Intrinsics:
    """Return the intrinsics of all six cameras of a rig, at the recorded image size.

    Without a principal point it is the image's centre.

    Raises:
        GeometryError: If a length or a size is not positive and finite.

    Source: the StereoGenBench paper, fx = f_mm / sensor_width_mm * width_px.
    """
    sensor_mm = (rig.sensor_width_mm, rig.sensor_height_mm)
    if not min(sensor_mm) > 0:
        raise GeometryError(f"a sensor's width and height must be positive, got {sensor_mm} mm.")
    width_px, height_px = rig.recorded_size_px or (rig.image_width_px, rig.image_height_px)
    cx_px, cy_px = rig.principal_point_px or (width_px / 2, height_px / 2)
    return Intrinsics(
        fx_px=rig.focal_mm / sensor_mm[0] * width_px,
        fy_px=rig.focal_mm / sensor_mm[1] * height_px,
        cx_px=float(cx_px),
        cy_px=float(cy_px),
        width_px=width_px,
        height_px=height_px,
    )
