import json
import zlib
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
import pytest

from stereogenbench_data.synthesis.planning import plan_scene
from stereogenbench_data.synthesis.produce import synthesise
from stereogenbench_data.synthesis.render import RAY_CASTING
from stereogenbench_data.synthesis.request import SynthRequest
from stereogenbench_data.synthesis.scene_files import metadata_texts, write_cameras

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
def draw(once):
    """Draw one scene, once for all tests: by default 96 px wide, 3 frames."""

    def draw_scene(**request):
        asked = SynthRequest(**{"size_px": 96, "frames": 3, "seed": 2} | request)
        name = f"synth_{zlib.crc32(repr(asked).encode())}"
        out = once(name, lambda root: synthesise(root, asked))
        return Drawn(out / asked.key(0))

    return draw_scene


@pytest.fixture
def draw_cameras(tmp_path_factory):
    """Write a scene with the videos of some cameras only."""

    def draw_scene(*cameras, **request):
        folder = tmp_path_factory.mktemp("cameras")
        plan, _ = plan_scene(SynthRequest(**request), index=0)
        description = RAY_CASTING.description(plan)
        for name, text in metadata_texts(plan, renderer="", description=description).items():
            (folder / name).write_text(text)
        how = {"renderer": RAY_CASTING, "folder": folder, "after_frame": int}
        write_cameras(plan, cameras=cameras, **how)
        return Drawn(folder)

    return draw_scene


@pytest.fixture(scope="session")
def uniform_scene(draw):
    """One scene, large enough for codecs and warps to behave as on large pictures."""
    return draw(family="Uniform", size_px=384, frames=2, seed=6)
