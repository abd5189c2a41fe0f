"""A picture sampled where points land, by scipy: what the package's projections are judged by."""

import numpy as np
from scipy.ndimage import map_coordinates

from stereogenbench_data.geometry.projection import landing_pixels


def sampled_where_points_land(image, projection):
    """Return (c, h, w) samples of an image between its pixel centres, and which land inside."""
    height_px, width_px = image.shape[-2:]
    inside, _ = landing_pixels(projection, height_px=height_px, width_px=width_px)
    rows, u_px = np.arange(height_px)[:, None] + 0.5, projection.u_px
    v_px = np.broadcast_to(rows, u_px.shape) if projection.v_px is None else projection.v_px
    places = [np.where(inside, v_px, 0.5) - 0.5, np.where(inside, u_px, 0.5) - 0.5]
    channels = [
        map_coordinates(each.astype(np.float64), places, order=1, mode="nearest") for each in image
    ]
    return np.stack(channels) * inside, inside
