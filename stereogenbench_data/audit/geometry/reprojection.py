"""The paper's reprojection error: left depth to the right camera, and back by the right depth.

A left pixel's centre u with depth z is the point X = z K^-1 u; the recorded poses take it to the
right camera, X' = R X + t, where it lands at u' with depth z'. The right camera's own depth z" is
that of the pixel at u'. If z" is measured and differs from z' by no more than a tolerance, the
pixel counts as not occluded. Then the point at u' with depth z" is taken back to the left camera;
its distance from u in pixels is the error. It is 0 if both cameras see the same point, and
B fx |1/z' - 1/z"| for a rectified pair.

A tolerance bounds the error that it keeps, so the median is reported with the share of pixels that
were kept. `contract.worlds` asks more strictly: for which share of the pixels that nothing in the
left view hides from the right camera the right depth agrees.

Source: the StereoGenBench paper, table of the geometry consistency audit and appendix on geometry
derivation. The paper does not state its tolerance; ours are `TOLERANCES`.
"""

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float64, UInt16

from stereogenbench_data.audit.geometry.records import QUANTILES, PairAudit
from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.projection import Projection, visible_from_source
from stereogenbench_data.media.depth import depth_m_from_units
from stereogenbench_data.schema.records import DepthEncoding

_SIGNIFICANT: Final = 7

Map = Float64[np.ndarray, "h w"]
Points = Float64[np.ndarray, "*any"]
Mask = Bool[np.ndarray, "h w"]

MOST_PIXELS: Final = 250_000
"""How many pixels of a picture are projected: every k-th row of a larger one."""


@dataclass(frozen=True, slots=True)
class Tolerance:
    """How far two depths may differ: a share of the depth plus a number of stored steps."""

    name: str
    share: float
    steps: float


TOLERANCES: Final = (
    Tolerance("same step", 0.0, 0.5),
    Tolerance("2 steps", 0.0, 2.0),
    Tolerance("0.5 % + 2 steps", 0.005, 2.0),
    Tolerance("2 % + 2 steps", 0.02, 2.0),
)
"""From strict to that of the field ``visible``, which is the last."""

STANDARD: Final = TOLERANCES[-1]


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredDepth:
    """One camera's depth of one frame.

    Attributes:
        depth_m: (h, w) float64 along the optical axis, 0 where not measured.
        measured: (h, w) bool.
        step_m: The step of stored depth in metres; for inverse depth, the divisor of depth
            squared that gives the step.
        form: "depth" or "inverse".
    """

    depth_m: Map
    measured: Mask
    step_m: float
    form: str = "depth"

    @classmethod
    def of(
        cls,
        units: UInt16[np.ndarray, "h w"],
        measured: Mask,
        *,
        encoding: DepthEncoding,
        intrinsics: Intrinsics,
    ) -> "MeasuredDepth":
        """Return the depth of stored numbers, by a contract whose unit is known."""
        depth_m = depth_m_from_units(
            units, measured=measured, encoding=encoding, intrinsics=intrinsics
        )
        known = measured & np.isfinite(depth_m)
        depth_m = np.where(known, depth_m, 0).astype(np.float64)
        return cls(depth_m, known, step_m=encoding.known_unit_m, form=encoding.form)

    def steps_m(self, depth_m: Map) -> Any:
        """Return the step in metres at each depth."""
        return self.step_m if self.form == "depth" else depth_m**2 / self.step_m


@dataclass(frozen=True, slots=True, eq=False)
class PairErrors:
    """The reprojection of one pair in one frame.

    Attributes:
        comparable: Number of left pixels that land inside the right picture where depth was
            measured.
        errors_px: For each of `TOLERANCES`, (n,) float64 errors of the pixels kept.
        unhidden: Comparable pixels that nothing in the left view hides.
        agreeing: Those of them kept at the last tolerance.
    """

    comparable: int
    errors_px: tuple[Float64[np.ndarray, " n"], ...]
    unhidden: int
    agreeing: int


def reproject(
    left: MeasuredDepth,
    right: MeasuredDepth,
    *,
    intrinsics: Intrinsics,
    right_from_left: Float64[np.ndarray, "4 4"],
) -> PairErrors:
    """Return the reprojection errors of a left camera's pixels, all in float64.

    Args:
        left: Depth of the camera whose pixels are taken.
        right: Depth of the camera to which they go and from which they come back.
        intrinsics: The intrinsics of both pictures.
        right_from_left: The motion between the cameras' axes, in metres.
    """
    height_px, width_px = left.depth_m.shape
    step = max(1, math.ceil(height_px * width_px / MOST_PIXELS))
    first = step // 2
    depth_m, measured = left.depth_m[first::step], left.measured[first::step]
    u_px = np.broadcast_to(np.arange(width_px) + 0.5, depth_m.shape)
    v_px = np.broadcast_to(np.arange(first, height_px, step)[:, None] + 0.5, depth_m.shape)
    forth_u, forth_v, expected_m = moved_points(u_px, v_px, depth_m, intrinsics, right_from_left)
    inside = measured & (expected_m > 0)
    inside &= (forth_u >= 0) & (forth_u < width_px) & (forth_v >= 0) & (forth_v < height_px)
    column = np.where(inside, forth_u, 0).astype(np.intp)
    row = np.where(inside, forth_v, 0).astype(np.intp)
    found_m = right.depth_m[row, column]
    comparable = inside & right.measured[row, column]
    back_u, back_v, _ = moved_points(
        forth_u, forth_v, found_m, intrinsics, np.linalg.inv(right_from_left)
    )
    error_px = np.hypot(back_u - u_px, back_v - v_px)
    away_m = np.abs(found_m - expected_m)
    steps_m = np.maximum(left.steps_m(expected_m), right.steps_m(expected_m))
    kept = [
        comparable & (away_m <= each.share * expected_m + each.steps * steps_m)
        for each in TOLERANCES
    ]
    unhidden = comparable & visible_from_source(
        Projection(u_px=forth_u, v_px=None, depth_m=np.where(inside, expected_m, 1.0)),
        measured=inside,
        quantum_m=steps_m,
        tolerance=STANDARD.share,
    )
    return PairErrors(
        comparable=int(comparable.sum()),
        errors_px=tuple(error_px[each] for each in kept),
        unhidden=int(unhidden.sum()),
        agreeing=int((unhidden & kept[-1]).sum()),
    )


def moved_points(
    u_px: Points,
    v_px: Points,
    depth_m: Points,
    intrinsics: Intrinsics,
    target_from_source: Float64[np.ndarray, "4 4"],
) -> tuple[Points, Points, Points]:
    """Return where points of one camera land in the other, and their depth; nan if behind it."""
    x_m = (u_px - intrinsics.cx_px) / intrinsics.fx_px * depth_m
    y_m = (v_px - intrinsics.cy_px) / intrinsics.fy_px * depth_m
    moved = [
        row[0] * x_m + row[1] * y_m + row[2] * depth_m + row[3] for row in target_from_source[:3]
    ]
    ahead_m = np.where(moved[2] > 0, moved[2], np.nan)
    return (
        intrinsics.fx_px * (moved[0] / ahead_m) + intrinsics.cx_px,
        intrinsics.fy_px * (moved[1] / ahead_m) + intrinsics.cy_px,
        moved[2],
    )


def pair_audit(found: list[PairErrors]) -> PairAudit:
    """Return the figures of a pair over all audited frames."""
    errors_px = [
        np.concatenate([np.empty(0), *of_frames])
        for of_frames in zip(*(each.errors_px for each in found), strict=True)
    ] or [np.empty(0)] * len(TOLERANCES)
    quantiles = [np.quantile(each, QUANTILES).tolist() if len(each) else [] for each in errors_px]
    return PairAudit(
        comparable=sum(each.comparable for each in found),
        kept=[len(each) for each in errors_px],
        errors_px=[[float(f"{px:.{_SIGNIFICANT}g}") for px in each] for each in quantiles],
    )
