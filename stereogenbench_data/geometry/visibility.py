"""Which source pixels a target camera sees: inside its image, and not behind something else.

Depth is along the optical axis in metres. Two depths agree where they differ by no more than
``tolerance`` of the projected depth plus two quanta (the steps in which depth is stored), on
either side: a point in front of what the target sees is as wrong as one behind it.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from stereogenbench_data.geometry.arrays import scatter_min, take_flat, values_where
from stereogenbench_data.geometry.projection import (
    Projection,
    landing_pixels,
    row_blocks,
    rows_of,
)


def visible_in_target(
    projection: Projection,
    *,
    measured: Bool[Any, "*batch h w"],
    target_depth_m: Float[Any, "*batch target_h target_w"],
    target_measured: Bool[Any, "*batch target_h target_w"],
    quantum_m: float | Float[Any, "*batch h w"],
    tolerance: float = 0.02,
) -> Bool[Any, "*batch h w"]:
    """Return the source pixels that the target camera sees, judged by its own depth.

    A pixel is visible if it was measured, lands inside the target image, and the depth that the
    target measured at the pixel where it lands (the one that holds the point, not an average of
    neighbours) agrees with its own.

    Args:
        projection: Where source pixels land in the target.
        measured: Where source depth was measured.
        target_depth_m: The target camera's depth in metres.
        target_measured: Where target depth was measured.
        quantum_m: The step in which depth is stored, in metres (the coarser of the two views);
            one number, or a map of the source's pixels where the step varies with depth.
        tolerance: Share of the depth by which the two may differ beside two quanta.

    Returns:
        True where visible.

    Raises:
        GeometryError: If a rectified projection's rows are not the target's.

    Source: the StereoGenBench paper, appendix on the geometry audit, which compares projected
    points with the target's depth buffer; the tolerance is ours.
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
    seen_m = take_flat(values_where(target_measured, target_depth_m, otherwise=-math.inf), pixel)
    inside &= measured
    inside &= seen_m >= projection.depth_m * (1.0 - tolerance) - 2.0 * quantum_m
    inside &= seen_m <= projection.depth_m * (1.0 + tolerance) + 2.0 * quantum_m
    return inside


def visible_from_source(
    projection: Projection,
    *,
    measured: Bool[Any, "*batch h w"],
    quantum_m: float | Float[Any, "*batch h w"],
    tolerance: float = 0.02,
) -> Bool[Any, "*batch h w"]:
    """Return the source pixels that nothing else in the source view hides from the target.

    The same test as `visible_in_target` against a z-buffer of the source's own points, for where
    the target's depth is not at hand. It does not know what stands outside the source view or
    behind what the source sees, so it calls visible what the target may not see.

    Args:
        projection: Where source pixels land in a target image of the same size.
        measured: Where source depth was measured.
        quantum_m: The step in which depth is stored, in metres.
        tolerance: Share of the depth by which a point may be behind the nearest one.

    Returns:
        True where nothing in the source view hides the pixel and it lands inside the image.
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
    """Return the depth step of some rows, where it is a map."""
    return quantum_m if isinstance(quantum_m, float) else quantum_m[..., rows, :]
