"""A scene over time: left, right, disparity and anaglyph side by side, as MP4 or GIF."""

from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import av
import numpy as np
from PIL import Image

from stereogenbench_data.audit.colour_scale import ColourScale, scale_of
from stereogenbench_data.audit.drawing import (
    FAINT,
    Page,
    disparity_rows,
    line_height,
    resized,
)
from stereogenbench_data.audit.scene_reader import SceneReader
from stereogenbench_data.audit.scene_sheet import tile_width
from stereogenbench_data.errors import SelectionError
from stereogenbench_data.geometry.camera import rig_intrinsics
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.samples.picture import Picture, anaglyph
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.sources.files import open_output

CLIP_FIELDS: Final = ("left", "right", "disparity", "valid", "baseline_m")
CLIP_SUFFIXES: Final = (".mp4", ".gif")

_SCALED_ON: Final = 5
"""From how many frames the range of colours is taken, which is the same throughout."""

Progress = Callable[[int, int], None]


def clip_pages(
    reader: SceneReader, row: int, *, pair: tuple[int, int] | None = None, tile_px: int | None
) -> Iterator[Picture]:
    """Yield a page for each frame of a scene, all of one size with even sides.

    Args:
        reader: Reads the data.
        row: The scene's row in the index.
        pair: The cameras (left, right), None for the pair that the scene records.
        tile_px: How wide one picture is drawn, None for what suits it.

    Raises:
        SelectionError: If there is no such pair.
        StorageError: If a file is missing or is not the one that was indexed.
        MediaError: If a video does not decode to what the index says.
    """
    scene = reader.index.scene(row)
    pair = pair or scene.rig.primary_pair
    first = sorted({scene.frames * number // _SCALED_ON for number in range(_SCALED_ON)})
    found = [
        reader.pair(row, pair=pair, frame=frame, fields=("disparity", "valid")) for frame in first
    ]
    scale = scale_of(
        np.stack([sample["disparity"] for sample in found]),
        measured=np.stack([sample["valid"] for sample in found]),
    )
    width_px = tile_width(scene, tile_px)
    for frame in range(scene.frames):
        sample = reader.pair(row, pair=pair, frame=frame, fields=CLIP_FIELDS)
        heading = f"{scene.id.key}, pair {pair[0]}-{pair[1]}, frame {frame}"
        yield _page(scene, sample, scale, heading=heading, width_px=width_px)


def _page(
    scene: Scene, sample: Sample, scale: ColourScale, *, heading: str, width_px: int
) -> Picture:
    font_px = min(max(round(width_px / 21), 13), 30)
    gap, line = font_px, line_height(font_px)
    left, right = (
        np.ascontiguousarray(sample[name].transpose(1, 2, 0)) for name in ("left", "right")
    )
    baseline_m = float(sample["baseline_m"])
    disparity = scale.paint(sample["disparity"][0], measured=sample["valid"][0])
    tiles = [
        ("left", resized(left, width_px=width_px)),
        (f"right, {baseline_m * 100:.2f} cm", resized(right, width_px=width_px)),
        ("disparity, px (below: m)", resized(disparity, width_px=width_px, shrink="nearest")),
        ("anaglyph", resized(anaglyph(sample["left"], sample["right"]), width_px=width_px)),
    ]
    height_px = tiles[0][1].shape[0]
    top = gap + 2 * line
    size = (len(tiles) * (width_px + gap) + gap, top + height_px + gap + 3 * line)
    page = Page(size[0] + size[0] % 2, size[1] + size[1] % 2, font_px=font_px)
    page.text((gap, gap // 2), heading, width_px=size[0] - 2 * gap, colour=FAINT)
    for column, (caption, tile) in enumerate(tiles):
        at = gap + column * (width_px + gap)
        page.text((at, top - line - 4), caption, width_px=width_px)
        page.picture((at, top), tile)
        if caption.startswith("disparity"):
            rows = disparity_rows(scale, shift_px_m=rig_intrinsics(scene.rig).fx_px * baseline_m)
            page.bar((at, top + height_px + gap // 2), scale, rows, width_px=width_px)
    return page.finished()


def write_clip(
    path: Path,
    pages: Iterator[Picture],
    *,
    frames: int,
    rate_hz: float,
    progress: Progress | None = None,
) -> None:
    """Write pages as an H.264 video or as an animated GIF, by the path's ending.

    Args:
        path: Ends in .mp4 or .gif; a file that is there is replaced.
        pages: (h, w, 3) uint8, with even sides.
        frames: How many pages there are, for the progress.
        rate_hz: Pages a second.
        progress: Called with (pages written, all) after each.

    Raises:
        SelectionError: If the path ends in neither.
        OSError: If the file cannot be written.
    """
    writers = {".mp4": _write_mp4, ".gif": _write_gif}
    write = writers.get(path.suffix.lower())
    if write is None:
        raise SelectionError(f"{path}: a clip is {' or '.join(CLIP_SUFFIXES)}, by its ending.")
    try:
        with open_output(path) as file:
            write(file, _counted(pages, frames=frames, progress=progress), rate_hz)
    except av.FFmpegError as error:
        # PyAV says only that writing to the file object failed; why is what it came upon.
        if isinstance(error.__context__, OSError):
            raise error.__context__ from None
        raise


def _counted(
    pages: Iterator[Picture], *, frames: int, progress: Progress | None
) -> Iterator[Picture]:
    for number, page in enumerate(pages, start=1):
        yield page
        if progress is not None:
            progress(number, frames)


def _write_mp4(file: Any, pages: Iterator[Picture], rate_hz: float) -> None:
    rate = Fraction(rate_hz).limit_denominator(1001)
    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=rate, options={"crf": "18"})
        for number, page in enumerate(pages):
            if number == 0:
                stream.height, stream.width = page.shape[:2]
                stream.pix_fmt = "yuv420p"
            frame = av.VideoFrame.from_ndarray(page, format="rgb24")
            frame.pts, frame.time_base = number, 1 / rate
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def _write_gif(file: Any, pages: Iterator[Picture], rate_hz: float) -> None:
    """Write a GIF with the colours of its first page; its clock ticks hundredths of a second."""
    first = Image.fromarray(next(pages)).quantize(256, dither=Image.Dither.NONE)
    others = (
        Image.fromarray(page).quantize(palette=first, dither=Image.Dither.NONE) for page in pages
    )
    hundredths = max(2, round(100 / rate_hz))
    first.save(file, format="GIF", save_all=True, append_images=others, loop=0,
               duration=10 * hundredths)  # fmt: skip
