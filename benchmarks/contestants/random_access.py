"""torchcodec and decord for the pictures, PyAV for depth: decoders kept open, frames by number.

Neither returns all 16 bits of depth, so PyAV decodes depth and seeks to the key frame before the
frame. As a careful user would, the loader keeps as many videos open as pays off.
"""

import json
from collections import OrderedDict
from pathlib import Path
from typing import Any, Final

import av
import numpy as np
import torch
from torch.utils.data import Dataset

from benchmarks.contestants.rig import sample_of, unit_m_of
from benchmarks.workloads import Job


class TorchcodecVideo:
    """Pictures through torchcodec."""

    KEPT: Final = 48
    """How many videos a process keeps open, depth among them."""

    def __init__(self, path: Path, size: tuple[int, int] | None) -> None:
        """Open a video."""
        from torchcodec.decoders import VideoDecoder

        self._decoder = VideoDecoder(str(path), num_ffmpeg_threads=1, seek_mode="approximate")
        self._size = size

    def pictures(self, frames: tuple[int, ...]) -> list[np.ndarray]:
        """Return frames as uint8 (3, h, w)."""
        found = self._decoder.get_frames_at(list(frames)).data
        if self._size is not None:
            scaled = torch.nn.functional.interpolate(found.float(), self._size, mode="area")
            found = scaled.round_().to(torch.uint8)
        return list(found.numpy())


class DecordVideo:
    """Pictures through decord."""

    KEPT: Final = 1
    """Fastest of 1, 2, 4 and 48: each open reader keeps a thread busy, even while it waits."""

    def __init__(self, path: Path, size: tuple[int, int] | None) -> None:
        """Open a video."""
        import decord

        height, width = size or (-1, -1)
        self._reader = decord.VideoReader(str(path), width=width, height=height, num_threads=1)

    def pictures(self, frames: tuple[int, ...]) -> list[np.ndarray]:
        """Return frames as uint8 (3, h, w)."""
        found = self._reader.get_batch(list(frames)).asnumpy()
        return list(found.transpose(0, 3, 1, 2))


class DepthVideo:
    """Stored depth through PyAV."""

    def __init__(self, path: Path) -> None:
        """Open a video."""
        self._container = av.open(str(path))
        self._stream = self._container.streams.video[0]
        self._stream.codec_context.thread_count = 1
        self.unit_m = unit_m_of(self._container)
        self._frames = self._container.decode(self._stream)
        self._next = 0

    def units(self, frames: tuple[int, ...]) -> list[np.ndarray]:
        """Return frames as uint16 (h, w)."""
        return [self._frame(index).to_ndarray() for index in frames]

    def _frame(self, index: int) -> Any:
        rate, base = self._stream.average_rate, self._stream.time_base
        if not self._next <= index < self._next + 12:
            self._container.seek(round(index / rate / base), stream=self._stream)
            self._frames = self._container.decode(self._stream)
        self._next = index + 1
        return next(frame for frame in self._frames if round(frame.pts * base * rate) == index)


class KeptOpenPairs(Dataset[dict[str, Any]]):
    """Samples by number."""

    def __init__(self, job: Job, video: type[TorchcodecVideo] | type[DecordVideo]) -> None:
        """Take the samples to load, and the class that reads pictures."""
        self._job = job
        self._video = video
        self._open: OrderedDict[Path, Any] = OrderedDict()
        self._documents: dict[str, Any] = {}

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self._job.wanted)

    def __getitem__(self, number: int) -> dict[str, Any]:
        """Return a sample."""
        wanted = self._job.wanted[number]
        scene = self._job.tree / wanted.scene
        if wanted.scene not in self._documents:
            self._documents[wanted.scene] = json.loads((scene / "baseline.json").read_text())

        def colours(camera: int) -> Any:
            return self._kept(scene / f"cam_{camera:02d}_rgb.mp4").pictures(wanted.frames)

        def depth(camera: int) -> tuple[list[np.ndarray], float]:
            video = self._kept(scene / f"cam_{camera:02d}_depth.mkv")
            return video.units(wanted.frames), video.unit_m

        document = self._documents[wanted.scene]
        return sample_of(self._job.workload, wanted, document, colours=colours, depth=depth)

    def _kept(self, path: Path) -> Any:
        if path not in self._open:
            while len(self._open) >= self._video.KEPT:
                self._open.popitem(last=False)
            is_depth = path.suffix == ".mkv"
            size = self._job.workload.size
            self._open[path] = DepthVideo(path) if is_depth else self._video(path, size)
        self._open.move_to_end(path)
        return self._open[path]
