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

from benchmarks.contestants.rig import rgb_of, sample_of
from benchmarks.workloads import Job


def frames_of(path: Path, numbers: tuple[int, ...]) -> tuple[list[Any], dict[str, str]]:
    """Return frames of a video, decoding from its start, and its tags."""
    found = []
    with av.open(str(path)) as container:
        for number, frame in enumerate(container.decode(video=0)):
            if number in numbers:
                found.append(frame)
            if number == numbers[-1]:
                return found, container.metadata
    raise RuntimeError(f"no frame {numbers[-1]} in {path}")


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

        def colours(camera: int) -> list[np.ndarray]:
            found, _ = frames_of(scene / f"cam_{camera:02d}_rgb.mp4", wanted.frames)
            return [rgb_of(frame, workload.size) for frame in found]

        def depth(camera: int) -> tuple[list[np.ndarray], float]:
            found, tags = frames_of(scene / f"cam_{camera:02d}_depth.mkv", wanted.frames)
            return [frame.to_ndarray() for frame in found], float(tags.get("DEPTH_SCALE", 0.1))

        return sample_of(workload, wanted, baseline, colours=colours, depth=depth)
