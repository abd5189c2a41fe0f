"""What a renderer gives to generation: maps that filters ask, and pictures of accepted plans.

Map axes are Unreal's (left-handed: x forward, y right, z up), in metres, with an origin that the
map chooses. Angles are degrees; yaw turns from x towards y.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float64, UInt8

from stereogenbench_data.errors import SynthesisError
from stereogenbench_data.geometry.pose import rotation_from_rotator_deg
from stereogenbench_data.selection.spelling import did_you_mean
from stereogenbench_data.synthesis.proposal import Proposal

Array = Any


Bounds = Float64[np.ndarray, "2 3"]
"""A box along the axes of a map: its corners with the smallest and with the largest coordinates."""


@dataclass(frozen=True, slots=True, eq=False)
class Spawn:
    """The place where the subject starts.

    Attributes:
        place_m: The point of the floor between its feet at frame 0.
        yaw_deg: The direction that it faces; 0 is along x, 90 along y.
    """

    place_m: Float64[np.ndarray, "3"]
    yaw_deg: float


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


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The view of one pinhole camera, whose principal point is the middle of the picture.

    Attributes:
        eye: (3,) the camera's centre.
        axes: (3, 3) whose columns are the camera's forward, right and up axes.
        focal_px: Focal lengths along the picture's width and height.
        size_px: Width and height of the picture.
    """

    eye: Float64[np.ndarray, "3"]
    axes: Float64[np.ndarray, "3 3"]
    focal_px: tuple[float, float]
    size_px: tuple[int, int]

    def right_of_axis(self, u_px: Array) -> Array:
        """Return the distance of a column to the right of the optical axis, at depth 1."""
        return (u_px - self.size_px[0] / 2) / self.focal_px[0]

    def below_axis(self, v_px: Array) -> Array:
        """Return the distance of a row below the optical axis, at depth 1."""
        return (v_px - self.size_px[1] / 2) / self.focal_px[1]

    @property
    def ray(self) -> Float64[np.ndarray, "3 3"]:
        """The coefficients of 1, r and b in the directions of rays, as columns.

        r and b are a pixel's distances to the right of and below the optical axis, at depth 1.
        """
        return self.axes * (1.0, 1.0, -1.0)


@dataclass(frozen=True, slots=True, eq=False)
class ScenePlan:
    """A proposal that passed the filters, with the path that was found for it.

    Attributes:
        proposal: What was drawn.
        spawn: Where the subject starts.
        centres_m: The middle of the rig at each frame, in map axes.
        rotators_deg: Pitch, yaw in -180..180 and roll of all cameras at each frame.
        subject_m: Depth of the subject's middle at each frame, from the middle of the rig.
    """

    proposal: Proposal
    spawn: Spawn
    centres_m: Float64[np.ndarray, "frames 3"]
    rotators_deg: Float64[np.ndarray, "frames 3"]
    subject_m: Float64[np.ndarray, " frames"]

    def view(self, *, camera: int, frame: int) -> View:
        """Return a camera's view, in map axes."""
        axes = rotation_from_rotator_deg(self.rotators_deg[frame])
        return View(
            eye=self.centres_m[frame] + self.proposal.rig.lateral_m[camera] * axes[:, 1],
            axes=axes,
            focal_px=self.proposal.focal_px,
            size_px=self.proposal.request.picture_px,
        )

    def steps(self) -> tuple[Float64[np.ndarray, " s"], Float64[np.ndarray, " s"]]:
        """Return the largest way of a camera (m) and the rotation (degrees) from frame to frame."""
        axes = rotation_from_rotator_deg(self.rotators_deg)
        way = np.diff(self.proposal.rig.eyes(self.centres_m, axes), axis=0)
        step_m = np.sqrt((way * way).sum(axis=2)).max(axis=1, initial=0)
        apart = np.diff(axes, axis=0)
        half_sine = np.sqrt((apart * apart).sum(axis=(1, 2)) / 8)
        return step_m, 2 * np.degrees(np.arcsin(np.minimum(half_sine, 1)))

    def world_locations_cm(self, frame: int) -> Float64[np.ndarray, "6 3"]:
        """Return the six camera centres in the recorded world.

        The world's offset is added last, so the error of distances between centres is at most the
        rounding of a coordinate of that size (1.2e-10 cm at 1e6 cm).
        """
        right = rotation_from_rotator_deg(self.rotators_deg[frame])[:, 1]
        places_cm = self.proposal.places_cm
        near_cm = 100 * self.centres_m[frame] + (places_cm - places_cm[-1] / 2)[:, None] * right
        centres_cm: Float64[np.ndarray, "6 3"] = near_cm + self.proposal.offset_cm
        return centres_cm


@dataclass(frozen=True, slots=True, eq=False)
class RenderedView:
    """What one camera sees at one frame.

    Attributes:
        picture: Red, green and blue.
        depth_m: Depth along the optical axis at pixel centres, exact; infinite where there is
            nothing.
    """

    picture: UInt8[np.ndarray, "h w 3"]
    depth_m: Float64[np.ndarray, "h w"]


@dataclass(frozen=True)
class Renderer(ABC):
    """A way to draw scenes. It is pickled into worker processes, so it opens its assets there.

    Attributes:
        name: What the command calls it.
        maps: Names of its maps, as folders of the release.
        characters: Names of the subjects.
        animations: Names of the subjects' motions.
        sensors_mm: Width and height of the sensors to draw from.
        fingerprint: Changes when the same proposal gives another scene: a version, a digest of
            assets.
        cameras_per_task: How many cameras one process draws together; 1, 2, 3 or 6.
    """

    name: str
    maps: tuple[str, ...]
    characters: tuple[str, ...]
    animations: tuple[str, ...]
    sensors_mm: tuple[tuple[float, float], ...]
    fingerprint: str
    cameras_per_task: int

    @abstractmethod
    def world(self, proposal: Proposal) -> World:
        """Return the map of a proposal, for its filters.

        Raises:
            SynthesisError: If the map, character or animation cannot be opened.
        """

    @abstractmethod
    def views(self, plan: ScenePlan, *, cameras: tuple[int, ...]) -> Iterator[RenderedView]:
        """Yield the views of cameras: all of frame 0 in the order of ``cameras``, then frame 1, on.

        Raises:
            SynthesisError: If the scene cannot be rendered.
        """

    @abstractmethod
    def description(self, plan: ScenePlan) -> dict[str, object]:
        """Return the document of ``scene_description_qwen_dataset_level.json``."""


def unknown_map(where: str, name: str, known: Iterable[str], *, choose: str) -> SynthesisError:
    """Return the error of a map that a renderer does not have.

    Args:
        where: What should have it.
        name: The map.
        known: The maps that may be meant.
        choose: What there is to choose from.
    """
    meant = did_you_mean(name, known)
    return SynthesisError(f"{where}: there is no map {name!r}{meant} Choose by --map {choose}.")
