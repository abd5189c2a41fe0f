"""The plan of a synthetic scene: all its random choices, and the cameras that follow from them."""

import zlib
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

from stereogenbench_data.geometry.pose import rotation_from_rotator_deg
from stereogenbench_data.schema.release import FRAME_RATE_HZ
from stereogenbench_data.synthesis.cameras import (
    FOCAL_RANGE_MM,
    CameraPath,
    lateral_places_cm,
    random_gaps_cm,
    random_path,
    rig_locations_cm,
)
from stereogenbench_data.synthesis.ray_casting import View
from stereogenbench_data.synthesis.request import SynthRequest
from stereogenbench_data.synthesis.scene import Framing, SceneModel, random_scene

_SUBJECT_M: Final = 1.75
_SUBJECT_PART: Final = 0.62
_FIRST_LABEL: Final = 1000
_MIDDLE_S: Final = 2.6


@dataclass(frozen=True, slots=True, eq=False)
class ScenePlan:
    """One scene before it is rendered.

    Attributes:
        places_cm: The distance of each camera to the right of camera 0.
        heading_deg: The scene's heading in the world.
        offset_cm: The scene's origin in the world.
        character: Name of the subject.
    """

    request: SynthRequest
    index: int
    places_cm: Float64[np.ndarray, "6"]
    focal_mm: float
    path: CameraPath
    scene: SceneModel
    heading_deg: float
    offset_cm: Float64[np.ndarray, "3"]
    character: str

    @property
    def key(self) -> str:
        """The scene's whole path below the root."""
        return self.request.key(self.index)

    @property
    def label_number(self) -> int:
        """The number in the scene's label, which differs from that of its folder."""
        return _FIRST_LABEL + self.index

    @property
    def label(self) -> str:
        """The scene's label."""
        return f"{self.request.map_name}_scene_{self.label_number}"

    @property
    def focal_px(self) -> tuple[float, float]:
        """Focal lengths along the picture's width and height."""
        width_px, height_px = self.request.picture_px
        sensor_mm = self.request.contract.sensor_mm
        return self.focal_mm / sensor_mm[0] * width_px, self.focal_mm / sensor_mm[1] * height_px

    def view(self, *, camera: int, frame: int) -> View:
        """Return a camera's view; the frame may lie before the first or after the last."""
        moment_s = self.moment_s(frame)
        axes = rotation_from_rotator_deg(self.path.rotator_deg(moment_s))
        lateral_m = (self.places_cm[camera] - self.places_cm[-1] / 2) / 100
        width_px, height_px = self.request.picture_px
        return View(
            eye=self.path.centre_m(moment_s) + lateral_m * axes[:, 1],
            axes=axes,
            focal_px=self.focal_px,
            centre_px=self.request.contract.principal_point_px or (width_px / 2, height_px / 2),
            size_px=(width_px, height_px),
        )

    def moment_s(self, frame: int) -> float:
        """Return the time of a frame; the subject passes the scene's origin at 0."""
        return frame / FRAME_RATE_HZ - _MIDDLE_S

    def world_rotator_deg(self, frame: int) -> Float64[np.ndarray, "3"]:
        """Return pitch, yaw in -180..180 and roll of all cameras, in world axes."""
        pitch, yaw, roll = self.path.rotator_deg(self.moment_s(frame))
        return np.array([pitch, (yaw + self.heading_deg + 180) % 360 - 180, roll])

    def world_locations_cm(self, frame: int) -> Float64[np.ndarray, "6 3"]:
        """Return the six camera centres in world axes."""
        heading = rotation_from_rotator_deg(np.array([0.0, self.heading_deg, 0.0]))
        return rig_locations_cm(
            centre_cm=100 * heading @ self.path.centre_m(self.moment_s(frame)),
            rotator_deg=self.world_rotator_deg(frame),
            places_cm=self.places_cm,
            offset_cm=self.offset_cm,
        )


def plan_scene(request: SynthRequest, *, index: int) -> ScenePlan:
    """Return the random plan of a scene, which follows from seed, folder and the scene's number."""
    seed = np.random.SeedSequence((request.seed, index, zlib.crc32(request.folder.encode())))
    rig_rng, path_rng, scene_rng = (np.random.default_rng(child) for child in seed.spawn(3))
    places_cm = lateral_places_cm(random_gaps_cm(request.family, rng=rig_rng))
    drawn_mm = float(rig_rng.uniform(*FOCAL_RANGE_MM))
    focal_mm = drawn_mm if request.focal_mm is None else request.focal_mm
    width_mm, height_mm = request.contract.sensor_mm
    span_m = places_cm[-1] / 100
    # The subject fills part of the picture, but the cameras keep away from it.
    framing = Framing(
        distance_m=max(_SUBJECT_M / _SUBJECT_PART * focal_mm / height_mm, span_m, 1.5),
        width_per_m=width_mm / focal_mm,
        span_m=span_m,
        pixel_per_m=width_mm / focal_mm / request.size_px,
    )
    walk_m_s = float(path_rng.choice([-1.0, 1.0]) * path_rng.uniform(0.5, 0.8))
    offset_cm = path_rng.uniform(-1, 1, 3) * request.world_offset_cm
    heading_deg = float(path_rng.uniform(-180, 180))
    return ScenePlan(
        request=request,
        index=index,
        places_cm=places_cm,
        focal_mm=focal_mm,
        path=random_path(path_rng, distance_m=framing.distance_m, follow_m_s=0.6 * walk_m_s),
        scene=random_scene(scene_rng, framing=framing, walk_m_s=walk_m_s),
        heading_deg=heading_deg,
        offset_cm=offset_cm,
        character=f"SK_Synth{int(path_rng.integers(1, 20)):02d}",
    )
