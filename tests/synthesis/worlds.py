"""Maps with known answers for filters: boxes on floors that may have holes, made without ours."""

from dataclasses import dataclass

import numpy as np


@dataclass
class Blocks:
    """A world of axis-aligned solid blocks, ``(low, high)`` each; no ground by itself.

    The subject is a post of points that stands still, or walks ahead; it may jump at frame 4.
    """

    blocks: list
    size_m: tuple = ((-20.0, -20.0, 0.0), (20.0, 20.0, 12.0))
    walk_m: float = 0.0
    jump_m: float = 0.0
    sunk_m: float = 0.0

    @property
    def bounds_m(self):
        return np.array(self.size_m)

    @property
    def spawn_bounds_m(self):
        return np.array([[-0.01, -0.01, 0.0], [0.01, 0.01, 2.5]])

    def cast(self, origins_m, directions):
        assert origins_m.shape == directions.shape
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-9)
        nearest = np.full(len(origins_m), np.inf)
        steps = np.where(directions == 0, 1e-30, directions)
        for block in np.array(self.blocks, float):
            sides = (block[:, None] - origins_m) / steps
            near, far = sides.min(axis=0).max(axis=1), sides.max(axis=0).min(axis=1)
            met = np.where((near <= far) & (far > 0), np.maximum(near, 0), np.inf)
            nearest = np.minimum(nearest, met)
        return nearest

    def subject_points_m(self, spawn, *, frame):
        yaw = np.radians(spawn.yaw_deg)
        ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        heights = np.linspace(-self.sunk_m, 1.75 - self.sunk_m, 12)
        middle = spawn.place_m + ahead * (self.walk_m * frame / 80 + self.jump_m * (frame >= 4))
        post = middle + heights[:, None] * np.array([0.0, 0.0, 1.0])
        return np.concatenate([post, post[::4] + 0.15 * ahead])


FLOOR = ((-20, -20, -1), (20, 20, 0))
BACKDROP = [
    ((-20, -20, 0), (-19.5, 20, 12)),
    ((19.5, -20, 0), (20, 20, 12)),
    ((-20, -20, 0), (20, -19.5, 12)),
    ((-20, 19.5, 0), (20, 20, 12)),
]
"""Four walls at the edge of the floor, so that every picture is full."""


def yard(*more, **options):
    """A walled yard of 40 x 40 m with more blocks in it."""
    return Blocks([FLOOR, *BACKDROP, *more], **options)
