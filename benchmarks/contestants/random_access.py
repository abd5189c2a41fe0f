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

from benchmarks.contestants.rig import PairNumbers, disparity_px, pair_numbers, sample_of, unit_m_of
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
        if not self._next <= index < self._next + 12:
            rate, base = self._stream.average_rate, self._stream.time_base
            self._container.seek(round(index / rate / base), stream=self._stream)
            self._frames = self._container.decode(self._stream)
            frame = next(self._frames)
            self._next = round(frame.pts * base * rate) + 1
            if self._next == index + 1:
                return frame
        while True:
            frame = next(self._frames)
            self._next += 1
            if self._next == index + 1:
                return frame


class KeptOpenPairs(Dataset[dict[str, Any]]):
    """Samples by number."""

    def __init__(self, job: Job, video: type[TorchcodecVideo] | type[DecordVideo]) -> None:
        """Take the samples to load, and the class that reads pictures."""
        self._job = job
        self._video = video
        self._open: OrderedDict[Path, Any] = OrderedDict()
        self._pairs: dict[tuple[str, int, int], PairNumbers] = {}

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self._job.wanted)

    def __getitem__(self, number: int) -> dict[str, Any]:
        """Return a sample."""
        workload, wanted = self._job.workload, self._job.wanted[number]
        scene = self._job.tree / wanted.scene
        pair = self._pair(scene, wanted.scene, wanted.left, wanted.right)
        pictures = {}
        for name, camera in (("left", wanted.left), ("right", wanted.right)):
            video = self._kept(scene / f"cam_{camera:02d}_rgb.mp4")
            pictures[name] = video.pictures(wanted.frames)
        for name, camera in (("disparity", wanted.left), ("disparity_right", wanted.right)):
            if name in workload.fields:
                video = self._kept(scene / f"cam_{camera:02d}_depth.mkv")
                pictures[name] = [
                    disparity_px(units, pair, unit_m=video.unit_m, size=workload.size)
                    for units in video.units(wanted.frames)
                ]
        return sample_of(wanted, pair, pictures, clip=workload.is_clip)

    def _kept(self, path: Path) -> Any:
        if path not in self._open:
            while len(self._open) >= self._video.KEPT:
                self._open.popitem(last=False)
            is_depth = path.suffix == ".mkv"
            size = self._job.workload.size
            self._open[path] = DepthVideo(path) if is_depth else self._video(path, size)
        self._open.move_to_end(path)
        return self._open[path]

    def _pair(self, scene: Path, key: str, left: int, right: int) -> PairNumbers:
        if (key, left, right) not in self._pairs:
            document = json.loads((scene / "baseline.json").read_text())
            width_px = (self._job.workload.size or (0, document["image_width"]))[1]
            numbers = pair_numbers(document, left=left, right=right, width_px=width_px)
            self._pairs[key, left, right] = numbers
        return self._pairs[key, left, right]
