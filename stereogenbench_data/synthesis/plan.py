"""The plan of a scene: a proposal that passed the filters, with the path that was found for it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.geometry.pose import rotation_from_rotator_deg
from stereogenbench_data.synthesis.cameras import rig_locations_cm
from stereogenbench_data.synthesis.proposal import Proposal
from stereogenbench_data.synthesis.ray_casting import View
from stereogenbench_data.synthesis.request import SynthRequest
from stereogenbench_data.synthesis.world import Spawn


@dataclass(frozen=True, slots=True, eq=False)
class ScenePlan:
    """One scene before it is rendered.

    Attributes:
        proposal: What was drawn.
        spawn: Where the subject starts.
        centres_m: The middle of the rig at each frame, in map axes.
        rotators_deg: Pitch, yaw in -180..180 and roll of all cameras at each frame.
        subject_m: Depth of the subject's middle at each frame, from the middle of the rig.
        splices: How often a part of the path was thrown away and connected anew.
    """

    proposal: Proposal
    spawn: Spawn
    centres_m: Float64[np.ndarray, "frames 3"]
    rotators_deg: Float64[np.ndarray, "frames 3"]
    subject_m: Float64[np.ndarray, " frames"]
    splices: int

    @property
    def request(self) -> SynthRequest:
        """The request that the scene belongs to."""
        return self.proposal.request

    @property
    def key(self) -> str:
        """The scene's whole path below the root."""
        return self.proposal.key

    def view(self, *, camera: int, frame: int) -> View:
        """Return a camera's view, in map axes."""
        axes = rotation_from_rotator_deg(self.rotators_deg[frame])
        places_cm = self.proposal.places_cm
        lateral_m = (places_cm[camera] - places_cm[-1] / 2) / 100
        width_px, height_px = self.request.picture_px
        return View(
            eye=self.centres_m[frame] + lateral_m * axes[:, 1],
            axes=axes,
            focal_px=self.proposal.focal_px,
            centre_px=(width_px / 2, height_px / 2),
            size_px=(width_px, height_px),
        )

    def world_locations_cm(self, frame: int) -> Float64[np.ndarray, "6 3"]:
        """Return the six camera centres in world axes."""
        return rig_locations_cm(
            centre_cm=100 * self.centres_m[frame],
            rotator_deg=self.rotators_deg[frame],
            places_cm=self.proposal.places_cm,
            offset_cm=self.proposal.offset_cm,
        )
