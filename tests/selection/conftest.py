"""An index of invented scenes whose every number is known."""

import itertools
from pathlib import Path

import numpy as np
import pytest

from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.records import Rig, Scene, SceneLabels
from stereogenbench_data.schema.release import CAMERA_PAIRS


def made_scene(key, *, gaps_cm=(6.0,) * 5, frames=81, primary=(0, 1), **labels):
    """Return a scene record whose cameras stand gaps_cm apart."""
    places = np.concatenate([[0], np.cumsum(gaps_cm)])
    return Scene(
        id=parse_scene_key(key),
        labels=SceneLabels(character=labels.get("character"), animation=labels.get("animation")),
        caption=labels.get("caption", ""),
        rig=Rig(
            focal_mm=labels.get("focal_mm", 35.0),
            sensor_width_mm=23.76,
            sensor_height_mm=23.76,
            image_width_px=64,
            image_height_px=64,
            principal_point_px=None,
            baselines_cm=tuple(float(places[b] - places[a]) for a, b in CAMERA_PAIRS),
            primary_pair=primary,
        ),
        frames=frames,
        frame_rate_hz=15.0,
        lateral_m=tuple(places / 100),
        rig_residual_px=0.0,
        depth_unit_m=(0.1,) * 6,
        depth_unit_source=("default",) * 6,
        depth_codec=("ffv1",) * 6,
        depth_pixel_format=("gray16le",) * 6,
        valid_depth_ratio=labels.get("valid_depth_ratio"),
        members={},
    )


@pytest.fixture(scope="session")
def index():
    """Two families in train, one in each eval subset; gaps of 6, 25 and 120 cm."""
    scenes = [
        made_scene(
            f"train/IPD_Gaussian/Egypt/scene_{number:06d}",
            focal_mm=20.0 + number,
            character="SK_A",
            caption="A courtyard under an open sky.",
        )
        for number in range(4)
    ]
    scenes += [
        made_scene(
            f"train/Uniform/Town/scene_{number:06d}",
            gaps_cm=gaps,
            character="SK_B",
            animation="AN_Walk",
            caption="A street at night",
        )
        for number, gaps in enumerate([(25.0,) * 5, (120.0,) * 5, (5.0, 25.0, 40.0, 70.0, 120.0)])
    ]
    scenes.append(made_scene("eval/MapSeenInTrain/Uniform/Town/scene_000000", primary=(2, 3)))
    scenes.append(made_scene("eval/MapUnseenInTrain/Uniform/Reef/scene_000000", frames=40))
    return SceneIndex.from_scenes(scenes, Path("release"))


@pytest.fixture(scope="session")
def wide_index():
    """Sixty scenes whose primary baselines crowd at the short end, as the release's do."""
    generator = np.random.default_rng(7)
    gaps = np.exp(generator.uniform(np.log(1.5), np.log(140), size=(60, 5)))
    names = (f"train/Uniform/Town/scene_{number:06d}" for number in itertools.count())
    return SceneIndex.from_scenes(
        [made_scene(name, gaps_cm=tuple(row)) for name, row in zip(names, gaps, strict=False)],
        Path("release"),
    )
