"""Which source pixels a target camera sees: those inside its image that nothing occludes.

Depth is along the optical axis in metres. Two depths agree where they differ by no more than
``tolerance`` of the projected depth plus two quanta (the steps in which depth is stored), in
either direction: a point in front of the target's depth is as inconsistent as one behind it.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int64

from stereogenbench_data.geometry.arrays import scatter_min, take_flat, values_where
from stereogenbench_data.geometry.projection import Projection, landing_pixels, row_blocks, rows_of


def visible_in_target(
    projection: Projection,
    *,
    measured: Bool[Any, "*batch h w"],
    target_depth_m: Float[Any, "*batch target_h target_w"],
    target_measured: Bool[Any, "*batch target_h target_w"],
    quantum_m: float | Float[Any, "*#batch #h #w"],
    tolerance: float = 0.02,
) -> Bool[Any, "*batch h w"]:
    """Return the source pixels that the target camera sees, decided by the target's depth.

    A pixel is visible if it was measured, lands inside the target image, and its depth there agrees
    with the depth that the target measured at the pixel that contains the point (not an average of
    neighbours).

    Args:
        projection: Where source pixels land in the target.
        measured: Where source depth was measured.
        target_depth_m: The target camera's depth in metres.
        target_measured: Where target depth was measured.
        quantum_m: The step in which depth is stored, in metres (the coarser of the two views);
            one number, or a map over source pixels if the step varies with depth.
        tolerance: Fraction of the depth by which the two may differ, in addition to two quanta.

    Returns:
        True where visible.

    Raises:
        GeometryError: If a rectified projection's rows are not the target's.

    Source: the StereoGenBench paper, appendix on the geometry audit, which compares projected
    points with the target's depth buffer; the tolerance is our choice.
    """
    blocks = row_blocks(projection, height_px=target_depth_m.shape[-2])
    if len(blocks) > 1:
        visible = np.empty(projection.u_px.shape, dtype=np.bool_)
        for rows in blocks:
            visible[..., rows, :] = visible_in_target(
                rows_of(projection, rows),
                measured=measured[..., rows, :],
                target_depth_m=target_depth_m[..., rows, :],
                target_measured=target_measured[..., rows, :],
                quantum_m=_rows_of_step(quantum_m, rows),
                tolerance=tolerance,
            )
        return visible
    height_px, width_px = target_depth_m.shape[-2:]
    inside, pixel = landing_pixels(projection, height_px=height_px, width_px=width_px)
    inside &= measured
    seen_m = values_where(target_measured, target_depth_m, otherwise=-math.inf)
    return agrees_with_target(
        projection, landed=(inside, pixel), seen_m=seen_m, quantum_m=quantum_m, tolerance=tolerance
    )


def agrees_with_target(
    projection: Projection,
    *,
    landed: tuple[Bool[Any, "*batch h w"], Int64[Any, "*batch h w"]],
    seen_m: Float[Any, "*batch target_h target_w"],
    quantum_m: float | Float[Any, "*#batch #h #w"],
    tolerance: float = 0.02,
) -> Bool[Any, "*batch h w"]:
    """Return which source pixels have the depth that the target measured where they land.

    It is what `visible_in_target` decides, of steps that its caller may have done before.

    Args:
        projection: Where source pixels land in the target.
        landed: Which source pixels were measured and land inside the target image, and on which of
            its pixels, as `landing_pixels` counts them.
        seen_m: The target camera's depth in metres, -inf where it was not measured.
        quantum_m: As for `visible_in_target`.
        tolerance: As for `visible_in_target`.
    """
    inside, pixel = landed
    there_m = take_flat(seen_m, pixel)
    visible = there_m >= projection.depth_m * (1.0 - tolerance) - 2.0 * quantum_m
    visible &= there_m <= projection.depth_m * (1.0 + tolerance) + 2.0 * quantum_m
    visible &= inside
    return visible


def visible_from_source(
    projection: Projection,
    *,
    measured: Bool[Any, "*batch h w"],
    quantum_m: float | Float[Any, "*#batch #h #w"],
    tolerance: float = 0.02,
) -> Bool[Any, "*batch h w"]:
    """Return the source pixels that nothing in the source view occludes from the target.

    This is the test of `visible_in_target` with a z-buffer of the source's own points, for use
    without the target's depth. It does not know about occluders outside the source view or behind
    its surfaces, so some pixels that it calls visible are occluded.

    Args:
        projection: Where source pixels land in a target image of the same size.
        measured: Where source depth was measured.
        quantum_m: The step in which depth is stored, in metres.
        tolerance: Fraction of the depth by which a point may be behind the nearest one.

    Returns:
        True where the pixel lands inside the image and nothing in the source view occludes it.
    """
    blocks = row_blocks(projection, height_px=projection.u_px.shape[-2])
    if len(blocks) > 1:
        visible = np.empty(projection.u_px.shape, dtype=np.bool_)
        for rows in blocks:
            visible[..., rows, :] = visible_from_source(
                rows_of(projection, rows),
                measured=measured[..., rows, :],
                quantum_m=_rows_of_step(quantum_m, rows),
                tolerance=tolerance,
            )
        return visible
    depth_m, (height_px, width_px) = projection.depth_m, projection.u_px.shape[-2:]
    inside, pixel = landing_pixels(projection, height_px=height_px, width_px=width_px)
    inside &= measured
    landed_m = values_where(inside, depth_m, otherwise=math.inf)
    front_m = take_flat(scatter_min(landed_m, pixel, shape=depth_m.shape), pixel)
    inside &= front_m >= depth_m * (1.0 - tolerance) - 2.0 * quantum_m
    return inside


def _rows_of_step(quantum_m: Any, rows: slice) -> Any:
    """Return the depth steps of some rows if they are a map, else the one step."""
    return quantum_m if isinstance(quantum_m, float) else quantum_m[..., rows, :]
