"""Both array libraries, six-camera rigs whose true numbers are known, and how pictures compare."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch

from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.geometry.projection import Projection
from stereogenbench_data.schema.records import Trajectory


@dataclass(frozen=True)
class Library:
    """One of the array libraries that geometry works on."""

    name: str
    array: Callable[[np.ndarray], Any]
    numpy: Callable[[Any], np.ndarray]

    def projection(self, u_px, v_px, depth_m, *, rows="moved"):
        """Return a projection of this library's arrays; where rows are kept, v is left out."""
        places = None if rows == "kept" else self.array(v_px)
        return Projection(self.array(u_px), places, self.array(depth_m))


@pytest.fixture(
    scope="session",
    params=[
        Library("numpy", np.asarray, np.asarray),
        Library("torch", lambda values: torch.from_numpy(values.copy()), lambda t: t.numpy()),
    ],
    ids=lambda library: library.name,
)
def library(request: pytest.FixtureRequest) -> Library:
    return request.param


@pytest.fixture
def intrinsics() -> Intrinsics:
    return Intrinsics(fx_px=70.0, fy_px=66.0, cx_px=21.5, cy_px=14.0, width_px=40, height_px=30)


@pytest.fixture(scope="session")
def make_trajectory():
    """Return one that builds a lateral rig's trajectory, in cm and Unreal's axes.

    Camera k stands ``lateral_cm[k]`` along the right axis of ``rotation`` from ``offset_cm``.
    """

    def make(lateral_cm, *, rotation, rotations, rotation_kind, offset_cm=(0, 0, 0), frames=1):
        offset_cm = np.array(offset_cm, dtype=np.float64)
        locations = offset_cm + np.outer(lateral_cm, np.asarray(rotation)[:, 1])
        recorded = np.broadcast_to(
            np.asarray(rotations, dtype=np.float64), (frames, 6, *np.shape(rotations))
        )
        return Trajectory(
            locations=np.broadcast_to(locations, (frames, 6, 3)).copy(),
            unit_m=0.01,
            rotations=recorded.copy(),
            rotation_kind=rotation_kind,
        )

    return make


@pytest.fixture(scope="session")
def make_rig(make_trajectory):
    """Return one that builds the poses of a lateral rig turned by an Unreal rotation matrix."""

    def make(lateral_cm, *, rotation=None, offset_cm=(0, 0, 0), frames=1) -> CameraPoses:
        rotation = np.eye(3) if rotation is None else rotation
        return CameraPoses.from_trajectory(
            make_trajectory(
                lateral_cm,
                rotation=rotation,
                rotations=rotation,
                rotation_kind="matrix",
                offset_cm=offset_cm,
                frames=frames,
            )
        )

    return make


@pytest.fixture(scope="session")
def psnr_db():
    """Return the PSNR in dB of two images (c, h, w) over the pixels of a mask, peak 255."""

    def measure(image: np.ndarray, reference: np.ndarray, mask: np.ndarray) -> float:
        error = (image.astype(np.float64) - reference)[..., mask]
        return float(10 * np.log10(255**2 / np.mean(error**2)))

    return measure
