"""What filters ask a map: rays, extent, and where the subject is. A renderer answers.

Map axes are Unreal's (left-handed: x forward, y right, z up), in metres, with an origin that the
map chooses. Angles are degrees; yaw turns from x towards y.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64


@dataclass(frozen=True, slots=True, eq=False)
class Bounds:
    """A box along the axes of a map.

    Attributes:
        low_m: Its corner with the smallest coordinates.
        high_m: Its corner with the largest coordinates.
    """

    low_m: Float64[np.ndarray, "3"]
    high_m: Float64[np.ndarray, "3"]

    @property
    def size_m(self) -> Float64[np.ndarray, "3"]:
        """Its length, width and height."""
        size_m: Float64[np.ndarray, 3] = self.high_m - self.low_m
        return size_m


@dataclass(frozen=True, slots=True, eq=False)
class Spawn:
    """The place where the subject starts.

    Attributes:
        place_m: The point of the floor between its feet at frame 0.
        yaw_deg: The direction that it faces; 0 is along x, 90 along y.
    """

    place_m: Float64[np.ndarray, "3"]
    yaw_deg: float


@runtime_checkable
class World(Protocol):
    """The map of one proposal. Its answers follow from the proposal alone."""

    @property
    def bounds_m(self) -> Bounds:
        """The part of the map in which cameras may be."""

    @property
    def spawn_bounds_m(self) -> Bounds:
        """The part in which subjects are spawned, on any floor; `bounds_m` if it is all of it."""

    def cast(
        self, origins_m: Float64[np.ndarray, "n 3"], directions: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, " n"]:
        """Return how far each ray goes until it meets the map; the subject does not stop it.

        Args:
            origins_m: Where the rays start.
            directions: Their directions, of length 1.

        Returns:
            Distances along the rays in metres: infinity where nothing is met, 0 where a ray starts
            inside a solid, as far as the renderer can tell.
        """

    def subject_points_m(self, spawn: Spawn, *, frame: int) -> Float64[np.ndarray, "p 3"]:
        """Return points spread over the subject's body at a frame, from the soles to the crown.

        Args:
            spawn: Where the subject starts.
            frame: From 0 to the last frame, at 15 Hz.

        Returns:
            At least 8 points, as many and in the same order at every frame. Some of them are the
            lowest points of the body.
        """
