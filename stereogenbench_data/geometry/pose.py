"""Camera poses: from Unreal's recorded rotations to rigid motions between OpenCV cameras.

Unreal axes (as recorded): x forward, y right, z up, left-handed. OpenCV axes (everywhere else):
x right, y down, z forward, right-handed. A matrix ``a_from_b`` takes points in b's axes to a's.
Everything is float64, and centres are subtracted before they are scaled or rotated: at 1e6 cm from
the world's origin, a float32 centre is off by 0.06 cm.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float64

OPENCV_FROM_UNREAL: Final = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""A mirror (determinant -1), so a rotation R becomes S R S^T."""


def rotation_from_rotator_deg(
    pitch_yaw_roll_deg: Float64[np.ndarray, "*batch 3"],
) -> Float64[np.ndarray, "*batch 3 3"]:
    """Return the rotations of Unreal rotators (pitch, yaw, roll in degrees), in Unreal axes.

    The columns are the camera's forward, right and up axes in the world. Positive yaw turns
    right, positive pitch looks up, positive roll tilts clockwise: Rz(yaw) Ry(-pitch) Rx(-roll).
    The result is exact at pitch +-90 degrees too; only the inverse is not unique there.

    Source: Unreal Engine, FRotationMatrix.
    """
    sin_p, sin_y, sin_r = np.moveaxis(np.sin(np.deg2rad(pitch_yaw_roll_deg)), -1, 0)
    cos_p, cos_y, cos_r = np.moveaxis(np.cos(np.deg2rad(pitch_yaw_roll_deg)), -1, 0)
    forward = (cos_p * cos_y, cos_p * sin_y, sin_p)
    right = (
        sin_r * sin_p * cos_y - cos_r * sin_y,
        sin_r * sin_p * sin_y + cos_r * cos_y,
        -sin_r * cos_p,
    )
    up = (
        -cos_r * sin_p * cos_y - sin_r * sin_y,
        -cos_r * sin_p * sin_y + sin_r * cos_y,
        cos_r * cos_p,
    )
    return np.stack([np.stack(axis, axis=-1) for axis in (forward, right, up)], axis=-1)


def rotation_from_quaternion_xyzw(
    quaternion_xyzw: Float64[np.ndarray, "*batch 4"],
) -> Float64[np.ndarray, "*batch 3 3"]:
    """Return the rotations of quaternions x, y, z, w, in the same axes.

    Quaternions are normalised: a length that is off by 1e-3 would distort angles by as much.

    Source: Shoemake, Animating rotation with quaternion curves, 1985.
    """
    length = np.linalg.norm(quaternion_xyzw, axis=-1, keepdims=True)
    x, y, z, w = np.moveaxis(quaternion_xyzw / length, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def nearest_rotation(
    matrices: Float64[np.ndarray, "*batch 3 3"],
) -> Float64[np.ndarray, "*batch 3 3"]:
    """Return the rotations nearest to recorded matrices, which are not exact due to rounding.

    Of matrices with a negative determinant these are reflections.

    Source: Kabsch; the orthogonal Procrustes problem, solved by the SVD.
    """
    left, _, right = np.linalg.svd(matrices)
    return np.asarray(left @ right)


def invert_rigid(a_from_b: Float64[np.ndarray, "*batch 4 4"]) -> Float64[np.ndarray, "*batch 4 4"]:
    """Return b_from_a of rigid motions a_from_b."""
    rotation = np.swapaxes(a_from_b[..., :3, :3], -1, -2)
    return _rigid(rotation, -(rotation @ a_from_b[..., :3, 3:])[..., 0])


def rotation_angle_rad(
    first: Float64[np.ndarray, "*batch 3 3"], second: Float64[np.ndarray, "*batch 3 3"]
) -> Float64[np.ndarray, "*batch"]:
    """Return the angle between rotations in radians, accurate for very small angles too."""
    chord = np.linalg.norm(first - second, axis=(-2, -1)) / np.sqrt(8.0)
    return np.asarray(2 * np.arcsin(np.minimum(chord, 1.0)))


@dataclass(frozen=True, slots=True, eq=False)
class CameraPoses:
    """The poses of six cameras over the frames of a scene.

    Attributes:
        centres: (frames, 6, 3) float64, in the recorded unit and Unreal world axes.
        unit_m: Metres in one recorded unit.
        world_from_cam_rotations: (frames, 6, 3, 3) float64, from OpenCV camera axes to OpenCV
            world axes (Unreal's world, mirrored by `OPENCV_FROM_UNREAL`).
    """

    centres: Float64[np.ndarray, "frames 6 3"]
    unit_m: float
    world_from_cam_rotations: Float64[np.ndarray, "frames 6 3 3"]

    @classmethod
    def from_unreal(
        cls,
        centres: Float64[np.ndarray, "frames 6 3"],
        rotations: Float64[np.ndarray, "frames 6 3 3"],
        *,
        unit_m: float,
    ) -> "CameraPoses":
        """Return the poses of cameras whose rotations, too, are in Unreal's axes."""
        return cls(centres, unit_m, OPENCV_FROM_UNREAL @ rotations @ OPENCV_FROM_UNREAL.T)

    @property
    def frame_count(self) -> int:
        """The number of frames that have poses."""
        return len(self.centres)

    def cam_from_cam(self, frame: int, *, target: int, source: int) -> Float64[np.ndarray, "4 4"]:
        """Return the transform from one camera's axes to another's in one frame, in metres."""
        target_from_world = self.world_from_cam_rotations[frame, target].T
        step = OPENCV_FROM_UNREAL @ (self.centres[frame, source] - self.centres[frame, target])
        return _rigid(
            target_from_world @ self.world_from_cam_rotations[frame, source],
            target_from_world @ step * self.unit_m,
        )

    def world_from_cam(self, frame: int, camera: int) -> Float64[np.ndarray, "4 4"]:
        """Return a camera's pose in metres, in a right-handed world: S R S^T, S t."""
        centre = OPENCV_FROM_UNREAL @ self.centres[frame, camera]
        return _rigid(self.world_from_cam_rotations[frame, camera], centre * self.unit_m)

    def later_from_cam(self, frame: int, later: int, *, camera: int) -> Float64[np.ndarray, "4 4"]:
        """Return the transform from a camera's axes in one frame to those in another, in metres."""
        later_from_world = invert_rigid(self.world_from_cam(later, camera))
        moved: Float64[np.ndarray, "4 4"] = later_from_world @ self.world_from_cam(frame, camera)
        return moved

    def baseline_m(self, frame: int, camera_a: int, camera_b: int) -> float:
        """Return the distance between two cameras' centres in one frame, in metres."""
        step = self.centres[frame, camera_b] - self.centres[frame, camera_a]
        return float(np.linalg.norm(step)) * self.unit_m


def _rigid(
    rotation: Float64[np.ndarray, "*batch 3 3"], translation: Float64[np.ndarray, "*batch 3"]
) -> Float64[np.ndarray, "*batch 4 4"]:
    motion = np.zeros((*rotation.shape[:-2], 4, 4))
    motion[..., :3, :3] = rotation
    motion[..., :3, 3] = translation
    motion[..., 3, 3] = 1.0
    return motion
