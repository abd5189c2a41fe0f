"""The naive loader, written after the paper's snippet.

Every sample parses the scene's JSONs, opens its files, decodes up to its frames, converts with
``to_ndarray`` and divides; torch's own `DataLoader` shuffles and batches.
"""

import json
from pathlib import Path
from typing import Any

import av
import numpy as np
from torch.utils.data import Dataset

from benchmarks.contestants.rig import disparity_px, pair_numbers, sample_of
from benchmarks.workloads import Job


def rgb_frames(
    path: Path, frames: tuple[int, ...], size: tuple[int, int] | None
) -> list[np.ndarray]:
    """Return frames of a video as uint8 (3, h, w), decoding from its start."""
    found = []
    scaled = {} if size is None else {"height": size[0], "width": size[1], "interpolation": "AREA"}
    with av.open(str(path)) as container:
        for number, frame in enumerate(container.decode(video=0)):
            if number in frames:
                found.append(frame.to_ndarray(format="rgb24", **scaled).transpose(2, 0, 1))
            if number == frames[-1]:
                return found
    raise RuntimeError(f"no frame {frames[-1]} in {path}")


def depth_frames(path: Path, frames: tuple[int, ...]) -> tuple[list[np.ndarray], float]:
    """Return stored depth of frames, decoding from the start, and metres in a stored unit."""
    found = []
    with av.open(str(path)) as container:
        unit_m = float(container.metadata.get("DEPTH_SCALE", 0.1))
        for number, frame in enumerate(container.decode(video=0)):
            if number in frames:
                found.append(frame.to_ndarray())
            if number == frames[-1]:
                return found, unit_m
    raise RuntimeError(f"no frame {frames[-1]} in {path}")


class NaivePairs(Dataset[dict[str, Any]]):
    """Samples by number."""

    def __init__(self, job: Job) -> None:
        """Take the samples to load."""
        self._job = job

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self._job.wanted)

    def __getitem__(self, number: int) -> dict[str, Any]:
        """Return a sample."""
        workload, wanted = self._job.workload, self._job.wanted[number]
        scene = self._job.tree / wanted.scene
        baseline = json.loads((scene / "baseline.json").read_text())
        json.loads((scene / "trajectory.json").read_text())
        size = workload.size
        width_px = size[1] if size else baseline.get("image_width", 1280)
        pair = pair_numbers(baseline, left=wanted.left, right=wanted.right, width_px=width_px)
        pictures = {}
        for name, camera in (("left", wanted.left), ("right", wanted.right)):
            pictures[name] = rgb_frames(scene / f"cam_{camera:02d}_rgb.mp4", wanted.frames, size)
        for name, camera in (("disparity", wanted.left), ("disparity_right", wanted.right)):
            if name in workload.fields:
                units, unit_m = depth_frames(scene / f"cam_{camera:02d}_depth.mkv", wanted.frames)
                pictures[name] = [
                    disparity_px(stored, pair, unit_m=unit_m, size=size) for stored in units
                ]
        return sample_of(wanted, pair, pictures, clip=workload.is_clip)
