"""The time to generate scenes with the built-in renderer, stage by stage, beside encoding alone.

It is part of the benchmark, and runs alone as ``python -m benchmarks.generation [--size 1280]
[--frames 4] [--maps SynthStage SynthHall] [--grow] [--out FILE]``. Each scene is proposed and
filtered whole (81 frames); a few frames of one camera are rendered, encoded and checked, and stand
for the 486 of a scene. It measures processor time of one process, which other work on the machine
hardly changes. A scene needs no other one and a camera no other camera, so N cores take an N-th of
the time, as long as the memory's speed lasts.
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import av
import torch

from benchmarks.results import Report
from stereogenbench_data.media.depth_packing import grey_frame
from stereogenbench_data.schema.release import CAMERA_COUNT, FRAME_COUNT
from stereogenbench_data.synthesis.camera_writer import (
    DEPTH_FORMAT,
    depth_units,
    depth_video,
    picture_video,
)
from stereogenbench_data.synthesis.checks import FrameStatistics
from stereogenbench_data.synthesis.filters import DEFAULT_LIMITS
from stereogenbench_data.synthesis.planning import plan_scene
from stereogenbench_data.synthesis.ray_renderer import RAY_CASTING
from stereogenbench_data.synthesis.request import SynthRequest

LIMIT = 3.0
"""Generating may take so many times the encoding alone."""
RELEASE_SCENES = 8493
PAPER_SCENES_AN_HOUR = (16, 36)
_CAMERA_FRAMES = CAMERA_COUNT * FRAME_COUNT
FRAMES = 4
"""Frames of one camera that are rendered and encoded by default."""
SCENES = 2
"""Scenes by default, of which medians are taken."""
MAPS = ("SynthStage", "SynthHall")
FAMILIES = ("IPD_Gaussian", "Uniform")


def measure_generation(*, size_px: int, report: Report) -> dict[str, Any]:
    """Return the section of the results on generation."""
    report(f"generation: {SCENES} scenes of {', '.join(MAPS)}")
    return measure(sizes_px=(size_px,), frames=FRAMES, scenes=SCENES)


def measure(
    *,
    sizes_px: Sequence[int],
    frames: int,
    scenes: int,
    maps: Sequence[str] = MAPS,
    families: Sequence[str] = FAMILIES,
) -> dict[str, Any]:
    """Return the times of scenes of each size, map and family."""
    torch.set_num_threads(1)
    # The textures are made once a process.
    warm = plan_scene(SynthRequest(size_px=64, frames=1), index=0).plan
    list(RAY_CASTING.views(warm, cameras=(0,)))
    return {
        "cores": os.cpu_count(),
        "paper_scenes_an_hour": PAPER_SCENES_AN_HOUR,
        "frames": frames,
        "scenes": scenes,
        "limit": LIMIT,
        "rows": [
            measured(map_name, family, size_px=size_px, frames=frames, scenes=scenes)
            for size_px in sizes_px
            for map_name in maps
            for family in families
        ],
    }


def stages_s(request: SynthRequest, *, index: int, frames: int, folder: Path) -> dict[str, float]:
    """Return the seconds of processor time of each stage of one scene of 6 x 81 frames."""
    start = time.process_time()
    search = plan_scene(request, index=index)
    propose_s = time.process_time() - start
    plan = search.plan
    chosen = iter(RAY_CASTING.views(plan, cameras=(CAMERA_COUNT // 2,)))
    start = time.process_time()
    views = [next(chosen) for _ in range(frames)]
    render_s = time.process_time() - start
    rgb, depth = folder / "rgb.mp4", folder / "depth.mkv"
    start = time.process_time()
    with picture_video(rgb) as writer:
        for view in views:
            frame = av.VideoFrame.from_ndarray(view.picture, format="rgb24")
            writer.write(frame.reformat(format="yuv420p", threads=1))
    rgb_s = time.process_time() - start
    start = time.process_time()
    with depth_video(depth, request.contract) as writer:
        for view in views:
            units = depth_units(view.depth_m, unit_m=request.contract.depth_unit_m)
            writer.write(grey_frame(units, pixel_format=DEPTH_FORMAT))
    depth_s = time.process_time() - start
    start = time.process_time()
    seen = FrameStatistics(plan, camera=0, limits=DEFAULT_LIMITS)
    for view in views:
        seen.add(view)
    seen.check()
    check_s = time.process_time() - start
    whole = _CAMERA_FRAMES / frames
    return {
        "propose": propose_s,
        "render": render_s * whole,
        "encode pictures": rgb_s * whole,
        "encode depth": depth_s * whole,
        "check": check_s * whole,
    }


def measured(
    map_name: str, family: str, *, size_px: int, frames: int, scenes: int
) -> dict[str, Any]:
    """Return the median seconds of each stage over scenes of a map, and what follows from them."""
    request = SynthRequest(family=family, map_name=map_name, size_px=size_px)
    with tempfile.TemporaryDirectory() as folder:
        found = [
            stages_s(request, index=index, frames=frames, folder=Path(folder))
            for index in range(scenes)
        ]
    stages = {name: statistics.median(each[name] for each in found) for name in found[0]}
    scene_s = sum(stages.values())
    encode_s = stages["encode pictures"] + stages["encode depth"]
    return {
        "map": map_name,
        "family": family,
        "size_px": size_px,
        "stages_s": {name: round(seconds, 2) for name, seconds in stages.items()},
        "scene_core_s": round(scene_s, 1),
        "encode_core_s": round(encode_s, 1),
        "times_encoding": round(scene_s / encode_s, 2),
        "scenes_an_hour_a_core": round(3600 / scene_s, 1),
        "release_core_hours": round(RELEASE_SCENES * scene_s / 3600),
    }


def main() -> None:
    """Measure maps, and how the time grows with the size of the pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=1280)
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--scenes", type=int, default=SCENES)
    parser.add_argument("--maps", nargs="+", default=MAPS)
    parser.add_argument("--families", nargs="+", default=FAMILIES)
    parser.add_argument("--grow", action="store_true", help="also at a half and a quarter")
    parser.add_argument("--out", type=Path)
    chosen = parser.parse_args()
    sizes = (chosen.size, *((chosen.size // 2, chosen.size // 4) if chosen.grow else ()))
    report = measure(
        sizes_px=sizes,
        frames=chosen.frames,
        scenes=chosen.scenes,
        maps=chosen.maps,
        families=chosen.families,
    )
    text = json.dumps(report, indent=2)
    if chosen.out:
        chosen.out.write_text(text)
    sys.stdout.write(f"{text}\n")


if __name__ == "__main__":
    main()
