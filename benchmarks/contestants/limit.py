"""The limit: each needed stream decoded once by a bare PyAV loop, every array written once.

It does nothing else: no checks, no masks, no batches, no queues. It reuses its buffers, so it does
not even allocate memory. With N processes, N of these loops run over different scenes.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

import av
import av.filter
import numpy as np
from av.video.reformatter import Interpolation, VideoReformatter

from benchmarks.contestants.rig import camera_files, nearest_places, pair_numbers, unit_m_of
from benchmarks.workloads import Job, Wanted

_RED_GREEN_BLUE: Final = (2, 0, 1)


class Stream:
    """The frames of one video, forwards; keeps the last converted frame."""

    def __init__(self, file: Any, size: tuple[int, int]) -> None:
        """Open a video, to be scaled to (height, width); one thread decodes."""
        self.container = av.open(file)
        video = self.container.streams.video[0]
        video.codec_context.thread_count = 1
        self._decoded = self.container.decode(video)
        self._at = -1
        self._size = size
        self._scaler = VideoReformatter()
        self._graph: Any = None
        self._kept: Any = None

    def colours(self, index: int) -> list[np.ndarray]:
        """Return the red, green and blue planes of a frame."""
        if index != self._at:
            frame = self._frame(index)
            if self._size == (frame.height, frame.width):
                picture = self._scaler.reformat(
                    frame, format="gbrp", threads=1, interpolation=Interpolation.BICUBIC
                )
            else:
                picture = self._scaled(frame)
            self._kept = [_plane(picture, number, "u1") for number in _RED_GREEN_BLUE]
        return self._kept

    def _scaled(self, frame: Any) -> Any:
        """Return a frame at the target size, with chroma where luma is."""
        if self._graph is None:
            self._graph = av.filter.Graph()
            self._graph.threads = 1
            first = self._graph.add_buffer(template=self.container.streams.video[0])
            height, width = self._size
            scale = self._graph.add(
                "scale", f"w={width}:h={height}:flags=area:in_chroma_loc=center"
            )
            last = self._graph.add("buffersink")
            self._graph.link_nodes(
                first, scale, self._graph.add("format", "gbrp"), last
            ).configure()
            self._ends = first, last
        self._ends[0].push(frame)
        return self._ends[1].pull()

    def units(self, index: int) -> np.ndarray:
        """Return the stored depth of a frame."""
        if index != self._at:
            self._kept = _resized(_plane(self._frame(index), 0, "<u2"), self._size)
        return self._kept

    def unit_m(self) -> float:
        """Return the metres in a stored unit."""
        return unit_m_of(self.container)

    def close(self) -> None:
        """Close the video."""
        self.container.close()

    def _frame(self, index: int) -> Any:
        if index < self._at:
            raise ValueError(f"frame {index} is requested after frame {self._at}")
        for _ in range(self._at, index):
            frame = next(self._decoded)
        self._at = index
        return frame


def _resized(stored: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    if stored.shape == size:
        return stored
    rows, columns = nearest_places(stored.shape, size)
    return stored[rows].take(columns, axis=1)


def _plane(frame: Any, number: int, dtype: str) -> np.ndarray:
    """Return a plane of a frame as an array, without copying."""
    held = frame.planes[number]
    return np.frombuffer(held, dtype).reshape(held.height, -1)[:, : held.width]


Opened = tuple[dict[str, Any], Mapping[str, Any]]
"""A scene's baseline.json, and its open videos by their released names."""


def released(job: Job, key: str, names: Sequence[str]) -> Opened:
    """Open videos of a scene in the released layout."""
    folder = job.tree / key
    size = job.workload.size or (job.material.size_px, job.material.size_px)
    streams = {name: Stream(folder / name, size) for name in names}
    return json.loads((folder / "baseline.json").read_text()), streams


def samples(
    job: Job,
    scenes: Mapping[str, Sequence[Wanted]],
    *,
    opened: Callable[..., Opened] = released,
) -> Iterator[dict[str, Any]]:
    """Yield samples by scene, each scene's by frame; the next one overwrites the arrays."""
    workload = job.workload
    height, width = workload.size or (job.material.size_px, job.material.size_px)
    frames = len(next(iter(scenes.values()))[0].frames)
    arrays = {
        name: np.empty((frames, 3, height, width), np.uint8)
        if name in ("left", "right")
        else np.empty((frames, 1, height, width), np.float32)
        for name in ("left", "right", "disparity", "disparity_right")
        if name in workload.fields
    }
    cut = slice(None) if workload.is_clip else 0
    shown = {name: array[cut] for name, array in arrays.items()}
    for key, wanted in scenes.items():
        names = camera_files(wanted, both_ways=workload.both_ways)
        document, streams = opened(job, key, names)
        unit_m = streams[f"cam_{wanted[0].left:02d}_depth.mkv"].unit_m()
        for sample in wanted:
            pair = pair_numbers(document, left=sample.left, right=sample.right, width_px=width)
            _fill(arrays, sample, streams, np.float32(pair.fx_px * pair.baseline_m / unit_m))
            yield shown | {"wanted": sample}
        for stream in streams.values():
            stream.close()


def _fill(
    arrays: dict[str, np.ndarray], sample: Wanted, streams: dict[str, Stream], scale: np.float32
) -> None:
    views = {"left": sample.left, "right": sample.right}
    maps = {"disparity": sample.left, "disparity_right": sample.right}
    for place, index in enumerate(sample.frames):
        for name, camera in views.items():
            out = arrays[name][place]
            colours = streams[f"cam_{camera:02d}_rgb.mp4"].colours(index)
            for channel, plane in zip(out, colours, strict=True):
                channel[...] = plane
        for name, camera in maps.items():
            if name in arrays:
                units = streams[f"cam_{camera:02d}_depth.mkv"].units(index)
                with np.errstate(divide="ignore"):
                    np.divide(
                        scale, units, out=arrays[name][place, 0], dtype=np.float32,
                        casting="same_kind",
                    )  # fmt: skip
