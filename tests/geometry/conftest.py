"""Both array libraries, and six-camera rigs whose true numbers are known."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch

from stereogenbench_data.geometry.camera import Intrinsics
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.geometry.projection import Projection


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
def make_rig():
    """Return one that builds the poses of a lateral rig, from cm and Unreal's axes.

    Camera k stands ``lateral_cm[k]`` along the right axis of ``rotation`` from ``offset_cm``.
    """

    def make(lateral_cm, *, rotation=None, offset_cm=(0, 0, 0), frames=1) -> CameraPoses:
        rotation = np.eye(3) if rotation is None else np.asarray(rotation)
        locations = np.array(offset_cm, float) + np.outer(lateral_cm, rotation[:, 1])
        locations = np.tile(locations, (frames, 1, 1))
        rotations = np.tile(rotation, (frames, 6, 1, 1))
        return CameraPoses.from_unreal(locations, rotations, unit_m=0.01)

    return make
