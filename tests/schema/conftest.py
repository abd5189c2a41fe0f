"""Metadata files as the release writes them, to be changed by each test."""

import json
from collections.abc import Callable
from typing import Any

import pytest

from tests.servers.scene_fixtures import frames_of, pairs_at

PLACES_CM = (0.0, 6.5, 13.25, 19.0, 26.0, 32.5)
LENS_MM = {"focal_length_mm": 32.5, "sensor_width_mm": 23.76, "sensor_height_mm": 17.82}


@pytest.fixture
def rig_document() -> dict[str, Any]:
    """A baseline.json of cameras on a line, with the spellings of the paper's example."""
    return {
        "scene_label": "Town_scene_1166",
        "scene_index": 1166,
        "map_name": "Town",
        "unit": "cm",
        "camera_count": 6,
        "image_width": 640,
        "image_height": 480,
        "camera_intrinsics": dict(LENS_MM),
        "primary_stereo_pair": {
            "left_camera": "Town_scene_1166_Cam_00",
            "right_camera": "Town_scene_1166_Cam_01",
        },
        "pairwise_pairs": pairs_at(PLACES_CM),
    }


@pytest.fixture
def trajectory_document() -> dict[str, Any]:
    """A trajectory.json of three frames; camera c of frame f stands at (100 f, c, -5)."""

    def pose(frame: int, camera: int) -> dict[str, Any]:
        location = {"x": 100.0 * frame, "y": float(camera), "z": -5.0}
        rotation = {"pitch": 1.5, "yaw": 10.0 * frame, "roll": -camera / 4}
        return {"location": location, "rotation": rotation}

    how = {"unit": "cm", "rotation_representation": "unreal_rotator_degrees"}
    return how | {"frames": frames_of(3, pose)}


@pytest.fixture
def dumped() -> Callable[[Any], bytes]:
    """From a document to the bytes of its file."""
    return lambda document: json.dumps(document, indent=2).encode()
