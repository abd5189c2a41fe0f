"""Attempts to decode and convert faster, each beside the package's own way.

They run in one process, with files in the page cache; the ways of a group take turns. They are
compared by processor time: a loader keeps every core busy anyway, so spreading work over cores
gains nothing.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Final

import av
import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import Interpolation, VideoReformatter

from benchmarks.material import Material
from benchmarks.results import Report, spread_of
from stereogenbench_data.media.video import VideoReader, read_rgb

PLACES: Final = (10, 30, 50, 70)
"""The pictures to decode at random, as shares of 81."""

PICTURES: Final = 24
"""How many pictures are decoded one after another."""

MOMENTS: Final = 2
"""Of how many moments all pairs are decoded."""

SMALL: Final = (480, 832)


@dataclass(frozen=True, slots=True)
class Way:
    """One way of doing something.

    Attributes:
        name: Its name in tables.
        run: Processes ``pictures`` pictures.
        pictures: Their number.
        result: Returns pictures to compare with those of the group's first way, if it may differ.
    """

    name: str
    run: Callable[[], object]
    pictures: int
    result: Callable[[], np.ndarray] | None = None


def measure_tried(material: Material, *, rounds: int, report: Report) -> dict[str, Any]:
    """Return the section of the results: for each group its ways, the package's own first."""
    folder = sorted(path.parent for path in material.release.rglob("baseline.json"))[0]
    found = {}
    for group, ways in _groups(folder, material).items():
        report(f"tried: {group}")
        times: dict[str, list[tuple[float, float]]] = {way.name: [] for way in ways}
        for number in range(rounds + 1):
            for way in ways if number % 2 else ways[::-1]:
                cpu_s, wall_s = time.process_time(), time.perf_counter()
                way.run()
                spent = time.process_time() - cpu_s, time.perf_counter() - wall_s
                if number > 0:  # the first round warms up
                    times[way.name].append(spent)
        found[group] = [_record_of(way, ways[0], times) for way in ways]
    return {"rounds": rounds, "groups": found}


def _record_of(way: Way, own: Way, times: dict[str, list[tuple[float, float]]]) -> dict[str, Any]:
    """Return the record of a way: milliseconds a picture, and the ratio to our own way."""
    ratio = spread_of(
        (theirs / way.pictures) / (ours / own.pictures)
        for (theirs, _), (ours, _) in zip(times[way.name], times[own.name], strict=True)
    )
    noted: dict[str, Any] = {
        "name": way.name,
        "cpu_ms": statistics.median(cpu_s for cpu_s, _ in times[way.name]) / way.pictures * 1e3,
        "wall_ms": statistics.median(wall_s for _, wall_s in times[way.name]) / way.pictures * 1e3,
        "times": ratio,
    }
    if way.result is not None and own.result is not None:
        mean_square = float(np.mean((way.result().astype(np.float64) - own.result()) ** 2))
        noted["psnr_db"] = 10 * np.log10(255**2 / mean_square) if mean_square else None
    return noted


def _groups(folder: Path, material: Material) -> dict[str, list[Way]]:
    rgb, depth = folder / "cam_00_rgb.mp4", folder / "cam_00_depth.mkv"
    count = min(PICTURES, material.frames)

    def decoding(name: str, path: Path, **settings: Any) -> Way:
        return Way(
            name, lambda: _decoded(path, count, **settings), count,
            lambda: np.stack([_luma(frame) for frame in _decoded(path, count, **settings)]),
        )  # fmt: skip

    return {
        "decoding colour, one picture after another": [
            decoding("one thread", rgb),
            decoding("two threads, by slices", rgb, thread_count=2, thread_type="SLICE"),
            decoding("two threads, by pictures", rgb, thread_count=2, thread_type="FRAME"),
            decoding("without the loop filter", rgb, options={"skip_loop_filter": "all"}),
        ],
        "decoding depth, one picture after another": [
            Way("one thread", lambda: _decoded(depth, count), count),
            Way(
                "two threads, by slices",
                lambda: _decoded(depth, count, thread_count=2, thread_type="SLICE"), count,
            ),
        ],
        "a picture at random": _at_random(rgb, frames=material.frames),
        "colour conversion, stored size": _conversions(rgb, None),
        "colour conversion, to 832x480": _conversions(rgb, SMALL),
        "the pictures of all 15 pairs of a moment": _pairs(folder, frames=material.frames),
    }  # fmt: skip


def _decoded(path: Path, count: int, **settings: Any) -> list[VideoFrame]:
    """Return the first pictures of a video."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        for name, value in ({"thread_count": 1} | settings).items():
            setattr(stream.codec_context, name, value)
        frames = container.decode(stream)
        return list(islice(frames, count))


def _luma(frame: VideoFrame) -> np.ndarray:
    plane = frame.planes[0]
    numbers = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)
    return numbers[:, : plane.width].copy()


def _at_random(path: Path, *, frames: int) -> list[Way]:
    places = [place * frames // 81 for place in PLACES]

    def opened_anew() -> None:
        for place in places:
            with VideoReader(path, name=path.name, frames=frames) as reader:
                reader.frame(place)

    def kept_open() -> None:
        with VideoReader(path, name=path.name, frames=frames) as reader:
            for place in places:
                reader.frame(place)

    def nothing_skipped() -> None:
        for place in places:
            _decoded(path, place + 1)

    return [
        Way("opened anew, skipping pictures that no other needs", opened_anew, len(places)),
        Way("opened anew, decoding all before it", nothing_skipped, len(places)),
        Way("kept open, in ascending order", kept_open, len(places)),
    ]


def _conversions(path: Path, size: tuple[int, int] | None) -> list[Way]:
    """Return ways from a decoded picture to red, green and blue planes in the batch."""
    frames = _decoded(path, 8)
    height, width = size or (frames[0].height, frames[0].width)
    out = np.empty((len(frames), 3, height, width), np.uint8)
    shrinks = Interpolation.AREA if size else Interpolation.BICUBIC
    kept = VideoReformatter()

    def planes(interpolation: Interpolation, *, scaler: VideoReformatter | None = kept) -> None:
        for number, frame in enumerate(frames):
            picture = (scaler or VideoReformatter()).reformat(
                frame, width=width, height=height, format="gbrp", threads=1,
                interpolation=interpolation,
            )  # fmt: skip
            for channel, plane in enumerate((2, 0, 1)):
                held = picture.planes[plane]
                numbers = np.frombuffer(held, np.uint8).reshape(height, held.line_size)
                out[number, channel] = numbers[:, :width]

    def interleaved() -> None:
        for number, frame in enumerate(frames):
            picture = frame.to_ndarray(
                format="rgb24", width=width, height=height, interpolation=shrinks
            )
            out[number] = picture.transpose(2, 0, 1)

    def stacked() -> None:
        np.stack(
            [
                np.ascontiguousarray(
                    frame.to_ndarray(
                        format="rgb24", width=width, height=height, interpolation=shrinks
                    ).transpose(2, 0, 1)
                )
                for frame in frames
            ]
        )

    def way(name: str, run: Callable[[], object]) -> Way:
        def result() -> np.ndarray:
            run()
            return out.copy()

        return Way(name, run, len(frames), result)

    fast = Interpolation.FAST_BILINEAR
    return [
        way("planes, written into the batch", lambda: planes(shrinks)),
        way("planes, with a new scaler for each", lambda: planes(shrinks, scaler=None)),
        way("planes, the scaler's fastest filter", lambda: planes(fast)),
        way("interleaved, transposed into the batch", interleaved),
        Way("interleaved, transposed, then stacked", stacked, len(frames)),
    ]


def _pairs(folder: Path, *, frames: int) -> list[Way]:
    cameras = range(6)
    pairs = [(left, right) for left in cameras for right in cameras if left < right]
    moments = range(min(MOMENTS, frames))

    def shared() -> None:
        readers = [_reader(folder, camera, frames) for camera in cameras]
        for moment in moments:
            pictures = [read_rgb(reader, moment) for reader in readers]
            for left, right in pairs:
                pictures[left], pictures[right]
        for reader in readers:
            reader.close()

    def apart() -> None:
        for pair in pairs:
            for camera in pair:
                with _reader(folder, camera, frames) as reader:
                    for moment in moments:
                        read_rgb(reader, moment)

    return [
        Way("each camera decoded once for all its pairs", shared, len(moments)),
        Way("each pair by itself", apart, len(moments)),
    ]


def _reader(folder: Path, camera: int, frames: int) -> VideoReader:
    name = f"cam_{camera:02d}_rgb.mp4"
    return VideoReader(folder / name, name=name, frames=frames)
