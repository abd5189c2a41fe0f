"""Small scenes in the released layout, written without the package: 4 frames of 32 x 24 pixels."""

import itertools
import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.servers.tools import rewrite_json
from tests.servers.videos import FRAMES, SIZE, write_video

PLACES_CM = (0.0, 10.0, 25.0, 31.0, 60.0, 72.5)


@pytest.fixture(scope="session")
def video(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """A video file of a kind ("rgb.mp4" or "depth.mkv"), written once for each set of arguments."""
    folder = tmp_path_factory.mktemp("videos")
    known: dict[str, Path] = {}

    def write(kind: str, **how: Any) -> Path:
        tags = how.pop("tags", {"DEPTH_SCALE": "0.001"} if kind == "depth.mkv" else {})
        key = repr((kind, sorted(how.items()), sorted(tags.items())))
        if key not in known:
            known[key] = write_video(folder / f"{len(known)}_{kind}", tags=tags, **how)
        return known[key]

    return write


def pairs_at(places_cm: Sequence[float]) -> list[dict[str, Any]]:
    """The baselines of a baseline.json whose cameras stand on a line."""
    return [
        {"camera_index_a": a, "camera_index_b": b, "baseline_cm": places_cm[b] - places_cm[a]}
        for a, b in itertools.combinations(range(6), 2)
    ]


def frames_of(count: int, pose: Callable[[int, int], dict[str, Any]]) -> list[dict[str, Any]]:
    """The frames of a trajectory.json, each pose a function of frame and camera."""
    return [
        {
            "frame_index": frame,
            "cameras": [{"camera_index": camera} | pose(frame, camera) for camera in range(6)],
        }
        for frame in range(count)
    ]


def documents(frames: int = FRAMES) -> dict[str, Any]:
    """The metadata files of a scene whose six cameras stand on a line and look along x."""
    names = {"scene_label": "Town_scene_7", "scene_index": 7, "map_name": "Car_Dealer"}
    lens_mm = {"focal_length_mm": 30.0, "sensor_width_mm": 24.0, "sensor_height_mm": 18.0}
    level = {"pitch": 0.0, "yaw": 0.0, "roll": 0.0}

    def pose(frame: int, camera: int) -> dict[str, Any]:
        location = {"x": 500.0 + frame, "y": PLACES_CM[camera], "z": 160.0}
        return {"location": location, "rotation": dict(level)}

    return {
        "baseline.json": {
            **names,
            "image_width": SIZE[1],
            "image_height": SIZE[0],
            "camera_intrinsics": lens_mm,
            "primary_stereo_pair": [0, 1],
            "pairwise_pairs": pairs_at(PLACES_CM),
            "character_mesh": "SK_Ch13",
        },
        "trajectory.json": {"unit": "cm", "frames": frames_of(frames, pose)},
        "_scene_complete.json": {**names, "map_path": "/Game/Car_Dealer"},
        "scene_description_qwen_dataset_level.json": {"detailed_caption": "Cars behind glass."},
    }


@pytest.fixture
def make_scene(tmp_path: Path, video: Callable[..., Path]) -> Callable[..., Path]:
    """Write a whole scene below ``tmp_path / "release"`` and return its folder."""

    def make(key: str = "train/Uniform/Car_Dealer/scene_000001", *, frames: int = FRAMES) -> Path:
        folder = tmp_path / "release" / key
        folder.mkdir(parents=True)
        for name, document in documents(frames).items():
            (folder / name).write_text(json.dumps(document))
        for camera in range(6):
            for kind in ("rgb.mp4", "depth.mkv"):
                shutil.copy(video(kind, frames=frames), folder / f"cam_{camera:02d}_{kind}")
        return folder

    return make


@pytest.fixture
def rewrite() -> Callable[[Path, Callable[[Any], object]], Any]:
    """Change a JSON file in place."""
    return rewrite_json


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Where `make_scene` writes."""
    return tmp_path / "release"
