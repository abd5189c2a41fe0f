"""Pictures of a scene: all views and maps on one page, or a clip of one pair over time."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, Literal

import av
import numpy as np
from PIL import Image

from stereogenbench_data.audit.pictures.drawing import (
    FAINT,
    FRAME,
    GREY,
    Colour,
    ColourScale,
    Label,
    Page,
    disparity_rows,
    line_height,
    resized,
    scale_of,
    scale_rows,
)
from stereogenbench_data.audit.pictures.scene_reader import SceneReader
from stereogenbench_data.engine import Progress, advance_of
from stereogenbench_data.errors import SelectionError
from stereogenbench_data.geometry.camera import rig_intrinsics
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.samples.picture import Picture, anaglyph
from stereogenbench_data.schema.conventions import depth_of
from stereogenbench_data.schema.records import DepthEncoding, Scene
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.sources.files import open_output

SHEET_FIELDS: Final = (
    "left", "right", "disparity", "valid", "visible", "depth", "warped_right", "hole", "baseline_m",
)  # fmt: skip
LEFT: Final[Colour] = (0, 104, 178)
RIGHT: Final[Colour] = (196, 52, 32)
HIDDEN: Final[Colour] = (204, 0, 150)
MOST_DIFFERENT: Final = 64
"""The difference of two pictures, of 255 levels, that is drawn white."""

_NARROWEST_PX: Final = 200
_USUAL_PX: Final = 320
_WIDEST_PX: Final = 2048
_LEGEND_LINES: Final = 3


@dataclass(frozen=True, slots=True)
class _Tile:
    caption: str
    picture: Picture
    legend: Callable[[Page, tuple[int, int], int], None]
    frame: Colour = FRAME
    shrink: Literal["average", "nearest"] = "average"


def tile_width(scene: Scene, wanted_px: int | None) -> int:
    """Return a tile's width in pixels: as asked, or a whole multiple of a small picture.

    A tile has at least 200 pixels, enough for its caption.
    """
    width = scene.rig.image_width_px
    if wanted_px is None:
        wanted_px = _USUAL_PX if width > _USUAL_PX else width * max(1, _USUAL_PX // width)
    return min(max(wanted_px, _NARROWEST_PX), _WIDEST_PX)


def scene_sheet(
    reader: SceneReader,
    row: int,
    *,
    pair: tuple[int, int] | None = None,
    frame: int = 0,
    tile_px: int | None = None,
) -> Picture:
    """Return a scene's contact sheet as (h, w, 3) uint8.

    Args:
        reader: Reads the data.
        row: The scene's row in the index.
        pair: The cameras (left, right), None for the pair that the scene records.
        frame: The frame's number.
        tile_px: The width of one picture on the sheet, None for a suitable one. Numbers on the
            sheet always refer to the stored pictures.

    Raises:
        SelectionError: If there is no such pair or frame.
        StorageError: If a file is missing or is not the one that was indexed.
        MediaError: If a video does not decode to what the index says.
    """
    scene = reader.index.scene(row)
    pair = pair or scene.rig.primary_pair
    sample = reader.pair(row, pair=pair, frame=frame, fields=SHEET_FIELDS)
    views = reader.views(row, frame=frame)
    width = tile_width(scene, tile_px)
    rows = [_view_tiles(scene, views, pair), _pair_tiles(scene, sample)]
    encoding = scene.depth_encoding(pair[0], reader.depth or depth_of(scene))
    return _contact_sheet(
        _title(scene, sample, encoding, pair=pair, frame=frame), rows, width_px=width
    )


def _text_sizes(width_px: int) -> tuple[int, int]:
    """Return the font size, which is also the gap between tiles, and the height of a line."""
    font_px = min(max(round(width_px / 21), 13), 30)
    return font_px, line_height(font_px)


def _contact_sheet(title: list[str], rows: list[list[_Tile]], *, width_px: int) -> Picture:
    gap, line = _text_sizes(width_px)
    shape = rows[0][0].picture.shape
    height_px = max(1, round(shape[0] * width_px / shape[1]))
    legends = [0, _LEGEND_LINES * line + gap // 2]
    head = round(line * 1.6) + line * (len(title) - 1) + gap
    total = 2 * gap + head + sum(line + 4 + height_px + gap + legend for legend in legends)
    inner = len(rows[0]) * (width_px + gap) - gap
    page = Page(inner + 2 * gap, total - gap // 2, font_px=gap)  # no gap below the last legend
    page.text((gap, gap), title[0], width_px=inner, scale=1.3)
    for number, text in enumerate(title[1:]):
        place = (gap, gap + round(line * 1.6) + number * line)
        page.text(place, text, width_px=inner, colour=FAINT)
    top = gap + head
    for tiles, legend in zip(rows, legends, strict=True):
        for column, tile in enumerate(tiles):
            left = gap + column * (width_px + gap)
            page.text((left, top), tile.caption, width_px=width_px)
            drawn = resized(tile.picture, width_px=width_px, shrink=tile.shrink)
            thick = 1 if tile.frame is FRAME else 3
            page.picture((left, top + line + 4), drawn, frame=tile.frame, frame_px=thick)
            tile.legend(page, (left, top + line + 4 + height_px + gap // 2), width_px)
        top += line + 4 + height_px + gap + legend
    return page.finished()


def _title(
    scene: Scene, sample: Sample, encoding: DepthEncoding, *, pair: tuple[int, int], frame: int
) -> list[str]:
    rig, camera = scene.rig, rig_intrinsics(scene.rig)
    baseline_cm = float(sample["baseline_m"]) * 100
    facts = (
        f"pair {pair[0]}-{pair[1]}, baseline {baseline_cm:.2f} cm; frame {frame} of "
        f"{scene.frames} at {scene.frame_rate_hz:g} Hz; {rig.image_width_px} x "
        f"{rig.image_height_px} px; focal length {rig.focal_mm:.4g} mm, fx {camera.fx_px:.1f} px; "
        f"depth unit {encoding.known_unit_m:g} m ({encoding.source}); "
        f"rig residual {scene.rig_residual_px:.2g} px"
    )
    texts = [text for text in (derived_text(scene), scene.caption) if text]
    return [scene.id.key, facts, *texts]


def derived_text(scene: Scene) -> str:
    """Return what a scene of training shards is, in a few words; empty for a released scene."""
    facts, recorded = scene.training, scene.rig.recorded_size_px
    if facts is None or recorded is None:
        return ""
    held = [each for each in facts.psnr_db if not math.isnan(each)]
    return (
        f"training shard, derived from {recorded[0]} x {recorded[1]} px: quality "
        f"{facts.quality} ({facts.codec}), PSNR {min(held):.1f} dB or more"
    )


def _view_tiles(scene: Scene, views: Any, pair: tuple[int, int]) -> list[_Tile]:
    tiles = []
    for camera in range(CAMERA_COUNT):
        side, frame = {pair[1]: (": right", RIGHT), pair[0]: (": left", LEFT)}.get(
            camera, ("", FRAME)
        )
        caption = f"camera {camera}, at {scene.lateral_m[camera] * 100:.1f} cm{side}"
        tiles.append(_Tile(caption, _channels_last(views[camera]), _key([]), frame))
    return tiles


def _channels_last(picture: Any) -> Picture:
    return np.ascontiguousarray(picture.transpose(1, 2, 0))


def _pair_tiles(scene: Scene, sample: Sample) -> list[_Tile]:
    shift_px_m = rig_intrinsics(scene.rig).fx_px * float(sample["baseline_m"])
    valid = sample["valid"][0]
    disparity = scale_of(sample["disparity"][0], measured=valid)
    depth = scale_of(sample["depth"][0], measured=valid, kind="log")
    # The left view, faint, with what the right one does not see in one colour.
    grey_levels = sample["left"].astype(np.float32).mean(axis=0) * 0.6 + 90
    hidden = np.repeat(np.minimum(grey_levels, 255).astype(np.uint8)[..., None], 3, axis=-1)
    hidden[~sample["visible"][0]] = HIDDEN
    hidden[~valid] = GREY
    holes = _channels_last(sample["warped_right"])
    holes[sample["hole"][0]] = HIDDEN
    seen = float(sample["visible"].mean())
    empty = float(sample["hole"].mean())
    difference, median = _difference(sample)
    grey = (GREY, f"depth not measured, {1 - valid.mean():.1%}")
    return [
        _Tile("disparity, px (below: m)", disparity.paint(sample["disparity"][0], measured=valid),
              _bar(disparity, disparity_rows(disparity, shift_px_m=shift_px_m)), shrink="nearest"),
        _Tile("depth, m", depth.paint(sample["depth"][0], measured=valid),
              _bar(depth, scale_rows(depth)), shrink="nearest"),
        _Tile(f"visible in both, {seen:.1%}", hidden,
              _key([(HIDDEN, f"hidden or outside, {float(valid.mean()) - seen:.1%}"), grey]),
              shrink="nearest"),
        _Tile("anaglyph", anaglyph(sample["left"], sample["right"]),
              _key([(RIGHT, "red of the left view"), ((0, 160, 160), "cyan of the right view")])),
        _Tile("left warped to right", holes,
              _key([(HIDDEN, f"holes, {empty:.1%}")]), shrink="nearest"),
        _Tile("warped less right", difference,
              _key([((0, 0, 0), f"equal; median {median:.1f} of 255"),
                    ((255, 255, 255), f"{MOST_DIFFERENT} of 255 apart or more")])),
    ]  # fmt: skip


def _difference(sample: Sample) -> tuple[Picture, float]:
    """Return the difference of the warped and the right view, black where equal; and its median."""
    landed = ~sample["hole"][0]
    apart = np.abs(sample["warped_right"].astype(np.int16) - sample["right"]).mean(axis=0)
    median = float(np.median(apart[landed])) if landed.any() else 0.0
    level = np.minimum(apart * (255 / MOST_DIFFERENT), 255).astype(np.uint8)
    level[~landed] = 0
    return np.repeat(level[..., None], 3, axis=-1), median


def _key(entries: list[tuple[Colour, str]]) -> Callable[[Page, tuple[int, int], int], None]:
    return lambda page, place, width_px: page.swatches(place, entries, width_px=width_px)


def _bar(
    scale: ColourScale, rows: list[list[Label]]
) -> Callable[[Page, tuple[int, int], int], None]:
    return lambda page, place, width_px: page.bar(place, scale, rows, width_px=width_px)


CLIP_FIELDS: Final = ("left", "right", "disparity", "valid", "baseline_m")
CLIP_SUFFIXES: Final = (".mp4", ".gif")

_SCALED_ON: Final = 5
"""How many frames determine the range of colours, which is the same throughout."""


def clip_pages(
    reader: SceneReader, row: int, *, pair: tuple[int, int] | None = None, tile_px: int | None
) -> Iterator[Picture]:
    """Yield a page for each frame of a scene, all of one size with even sides.

    Args:
        reader: Reads the data.
        row: The scene's row in the index.
        pair: The cameras (left, right), None for the pair that the scene records.
        tile_px: The width of one picture on the page, None for a suitable one.

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
    gap, line = _text_sizes(width_px)
    left, right = (_channels_last(sample[name]) for name in ("left", "right"))
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
    page = Page(size[0] + size[0] % 2, size[1] + size[1] % 2, font_px=gap)
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
        path: Ends in .mp4 or .gif; an existing file is replaced.
        pages: (h, w, 3) uint8, with even sides.
        frames: Number of pages, for the progress.
        rate_hz: Pages a second.
        progress: Called with (pages written, all) after each page.

    Raises:
        SelectionError: If the path ends in neither.
        OSError: If the file cannot be written.
    """
    writers = {".mp4": _write_mp4, ".gif": _write_gif}
    write = writers.get(path.suffix.lower())
    if write is None:
        raise SelectionError(f"{path}: a clip is {' or '.join(CLIP_SUFFIXES)}, by its ending.")
    advance = advance_of(progress, total=frames)

    def reported() -> Iterator[Picture]:
        for page in pages:
            yield page
            advance(1)

    try:
        with open_output(path) as file:
            write(file, reported(), rate_hz)
    except av.FFmpegError as error:
        # PyAV only says that writing to the file object failed; the reason is the error's context.
        if isinstance(error.__context__, OSError):
            raise error.__context__ from None
        raise


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
    """Write a GIF with the colours of its first page, timed in hundredths of a second."""
    first = Image.fromarray(next(pages)).quantize(256, dither=Image.Dither.NONE)
    others = (
        Image.fromarray(page).quantize(palette=first, dither=Image.Dither.NONE) for page in pages
    )
    hundredths = max(2, round(100 / rate_hz))
    first.save(file, format="GIF", save_all=True, append_images=others, loop=0,
               duration=10 * hundredths)  # fmt: skip
