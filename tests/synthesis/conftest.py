import json
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
import pytest

from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.request import SynthRequest

UNIT_M = 0.001
SENSOR_MM = 23.76


@dataclass
class Drawn:
    """A scene's folder, read with nothing but PyAV and json."""

    folder: Path

    def json(self, name):
        return json.loads((self.folder / name).read_text())

    def pictures(self, camera):
        return decoded(self.folder / f"cam_{camera:02d}_rgb.mp4", "rgb24").astype(np.float64)

    def units(self, camera):
        return decoded(self.folder / f"cam_{camera:02d}_depth.mkv", "gray16le")

    @property
    def focal_px(self):
        baseline = self.json("baseline.json")
        return (
            baseline["camera_intrinsics"]["focal_length_mm"] / SENSOR_MM * baseline["image_width"]
        )

    def baseline_m(self, left, right):
        for pair in self.json("baseline.json")["pairwise_pairs"]:
            if (pair["camera_index_a"], pair["camera_index_b"]) == (left, right):
                return pair["baseline_cm"] / 100
        raise LookupError((left, right))


def decoded(path, pixel_format):
    """All frames of a video."""
    with av.open(str(path)) as container:
        return np.stack(
            [each.to_ndarray(format=pixel_format) for each in container.decode(video=0)]
        )


@pytest.fixture(scope="session")
def draw(tmp_path_factory):
    """Draw one scene, once for all tests: by default 96 px wide, 3 frames."""
    drawn = {}

    def draw_scene(**request):
        asked = SynthRequest(**{"size_px": 96, "frames": 3, "seed": 2} | request)
        if asked not in drawn:
            out = tmp_path_factory.mktemp("synth")
            (key,) = synthesise(out, asked)
            drawn[asked] = Drawn(out / key)
        return drawn[asked]

    return draw_scene


@pytest.fixture(scope="session")
def uniform_scene(draw):
    """One scene, large enough for codecs and warps to behave as on large pictures."""
    return draw(family="Uniform", size_px=384, frames=2, seed=6)
