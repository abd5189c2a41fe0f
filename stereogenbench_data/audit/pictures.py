"""Pictures of a scene: read, and drawn as all views and maps on one page or a clip over time."""

import math
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import UInt8

from stereogenbench_data.bridges.picture import (
    FRAME,
    NOT_MEASURED,
    Colour,
    ColourScale,
    Picture,
    Tile,
    anaglyph,
    channels_last,
    draw_sheet,
    pair_tiles,
)
from stereogenbench_data.engine import Progress, advance_of
from stereogenbench_data.errors import MediaError, SelectionError
from stereogenbench_data.geometry.camera import rig_intrinsics
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.jobs import named_errors
from stereogenbench_data.media.depth import DEPTH_CURES, NO_DEPTH_UNIT
from stereogenbench_data.media.encoder import Encoding, VideoEncoder
from stereogenbench_data.samples.fields import Request, Sample
from stereogenbench_data.samples.load import SampleDecoder
from stereogenbench_data.schema.conventions import depth_of
from stereogenbench_data.schema.records import DepthEncoding, Scene
from stereogenbench_data.schema.release import CAMERA_COUNT, rgb_name
from stereogenbench_data.selection.filters import require_pairs
from stereogenbench_data.selection.plan import Address
from stereogenbench_data.sources.files import open_output

OPEN_VIDEOS: Final = 6
"""How many videos the reading of one set of fields keeps open: those of a scene of one kind."""


class SceneReader:
    """Reads pictures and maps of one pair and one frame at a time; may be used by any thread.

    Reads of the same fields share open videos, of which the last frame is kept.
    """

    def __init__(self, index: SceneIndex) -> None:
        """Prepare to read the data of an index; nothing is opened yet."""
        self.index = index
        self._turn = threading.Lock()
        self._decoders: dict[Request, SampleDecoder] = {}

    def pair(
        self, row: int, *, pair: tuple[int, int], frame: int, fields: tuple[str, ...]
    ) -> Sample:
        """Return fields (of `PAIR_FIELDS`) of a pair at a frame, as numpy arrays.

        Raises:
            SelectionError: If there is no such pair or frame.
            StorageError: If a file is missing or is not the one that was indexed.
            MediaError: If a video does not decode to what the index says, or the unit of depth that
                a field needs is not known.
        """
        left, right = require_pairs([pair])[0]
        request = Request(kind="pairs", fields=fields, layout="single")
        return self._read(request, Address(row, left, (right,), (frame,)))

    def views(self, row: int, *, frame: int) -> dict[int, UInt8[np.ndarray, "3 h w"]]:
        """Return the picture of each camera at a frame, if there is one; raises as `pair` does."""
        members = self.index.scene(row).members
        cameras = [camera for camera in range(CAMERA_COUNT) if rgb_name(camera) in members]
        request = Request(kind="views", fields=("image",), layout="stacked")
        address = Address(row, cameras[0], tuple(cameras[1:]), (frame,))
        return dict(zip(cameras, self._read(request, address)["image"], strict=True))

    def close(self) -> None:
        """Close open videos; the reader can be used again."""
        with self._turn:
            for decoder in self._decoders.values():
                decoder.close()

    def _read(self, request: Request, address: Address) -> Sample:
        scene, frame = self.index.scene(address.row), address.frames[0]
        if not 0 <= frame < scene.frames:
            raise SelectionError(
                f"{scene.id.key} has no frame {frame}: its {scene.frames} are 0 to "
                f"{scene.frames - 1}. Choose one of them."
            )
        needs_depth = not request.streams.isdisjoint({"source_depth", "target_depth"})
        if needs_depth and any(
            scene.depth_encoding(camera, depth_of(scene)).unit_m is None
            for camera in (address.source, *address.targets)
        ):
            raise MediaError(
                scene.remark("depth") or f"{scene.id.key}: {NO_DEPTH_UNIT}. {DEPTH_CURES}"
            )
        with self._turn:
            if request not in self._decoders:
                self._decoders[request] = SampleDecoder(self.index, request)
                self._decoders[request].keep_open(OPEN_VIDEOS)
            return self._decoders[request].load(address, clip="frame")


SHEET_FIELDS: Final = (
    "left", "right", "disparity", "valid", "visible", "depth", "warped_right", "hole", "baseline_m",
)  # fmt: skip
LEFT: Final[Colour] = (0, 104, 178)
RIGHT: Final[Colour] = (196, 52, 32)
HIDDEN: Final[Colour] = (204, 0, 150)
MOST_DIFFERENT: Final = 64
"""The difference of two pictures, of 255 levels, that is drawn white."""

_NARROWEST_PX: Final = 200
"""What a tile's caption needs."""
_USUAL_PX: Final = 320


def tile_width(scene: Scene) -> int:
    """Return a tile's width in pixels: a whole multiple of a small picture, wide enough."""
    width = scene.rig.image_width_px
    return max(_NARROWEST_PX, _USUAL_PX if width > _USUAL_PX else width * (_USUAL_PX // width))


def scene_sheet(
    reader: SceneReader,
    row: int,
    *,
    pair: tuple[int, int] | None = None,
    frame: int = 0,
) -> Picture:
    """Return a scene's contact sheet as (h, w, 3) uint8.

    Args:
        reader: Reads the data.
        row: The scene's row in the index.
        pair: The cameras (left, right), None for the pair that the scene records.
        frame: The frame's number. Numbers on the sheet refer to the stored pictures.

    Raises:
        SelectionError: If there is no such pair or frame.
        StorageError: If a file is missing or is not the one that was indexed.
        MediaError: If a video does not decode to what the index says.
    """
    scene = reader.index.scene(row)
    pair = pair or scene.rig.primary_pair
    sample = reader.pair(row, pair=pair, frame=frame, fields=SHEET_FIELDS)
    views = reader.views(row, frame=frame)
    encoding = scene.depth_encoding(pair[0], depth_of(scene))
    title = _title(scene, sample, encoding, pair=pair, frame=frame)
    rows = [_view_tiles(scene, views, pair), _pair_tiles(scene, sample)]
    return draw_sheet(title, rows, width_px=tile_width(scene))


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
    told = derived_text(scene), scene.remark("left"), scene.caption
    texts = [text for text in told if text]
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


def _view_tiles(scene: Scene, views: dict[int, Any], pair: tuple[int, int]) -> list[Tile]:
    tiles = []
    for camera, picture in views.items():
        side, frame = {pair[1]: (": right", RIGHT), pair[0]: (": left", LEFT)}.get(
            camera, ("", FRAME)
        )
        caption = f"camera {camera}, at {scene.lateral_m[camera] * 100:.1f} cm{side}"
        tiles.append(Tile(caption, channels_last(picture), frame=frame))
    return tiles


def _pair_tiles(scene: Scene, sample: Sample) -> list[Tile]:
    _, _, disparity = pair_tiles(sample, fx_px=rig_intrinsics(scene.rig).fx_px)
    valid = sample["valid"][0]
    scale = ColourScale.of(sample["depth"][0], measured=valid, kind="log")
    # The left view, faint, with what the right one does not see in one colour.
    grey_levels = sample["left"].astype(np.float32).mean(axis=0) * 0.6 + 90
    hidden = np.repeat(np.minimum(grey_levels, 255).astype(np.uint8)[..., None], 3, axis=-1)
    hidden[~sample["visible"][0]] = HIDDEN
    hidden[~valid] = NOT_MEASURED
    holes = channels_last(sample["warped_right"])
    holes[sample["hole"][0]] = HIDDEN
    seen = float(sample["visible"].mean())
    difference, median = _difference(sample)
    return [
        disparity,
        Tile("depth, m", scale.paint(sample["depth"][0], measured=valid), scale=scale,
             labels=("{:.3g}".format,), shrink="nearest"),
        Tile(f"visible in both, {seen:.1%}", hidden,
             ((HIDDEN, f"hidden or outside, {float(valid.mean()) - seen:.1%}"),
              (NOT_MEASURED, f"depth not measured, {1 - valid.mean():.1%}")), shrink="nearest"),
        Tile("anaglyph", anaglyph(sample["left"], sample["right"]),
             ((RIGHT, "red of the left view"), ((0, 160, 160), "cyan of the right view"))),
        Tile("left warped to right", holes,
             ((HIDDEN, f"holes, {float(sample['hole'].mean()):.1%}"),), shrink="nearest"),
        Tile("warped less right", difference,
             (((0, 0, 0), f"equal; median {median:.1f} of 255"),
              ((255, 255, 255), f"{MOST_DIFFERENT} of 255 apart or more"))),
    ]  # fmt: skip


def _difference(sample: Sample) -> tuple[Picture, float]:
    """Return the difference of the warped and the right view, black where equal; and its median."""
    landed = ~sample["hole"][0]
    apart = np.abs(sample["warped_right"].astype(np.int16) - sample["right"]).mean(axis=0)
    median = float(np.median(apart[landed])) if landed.any() else 0.0
    level = np.minimum(apart * (255 / MOST_DIFFERENT), 255).astype(np.uint8)
    level[~landed] = 0
    return np.repeat(level[..., None], 3, axis=-1), median


CLIP_FIELDS: Final = ("left", "right", "disparity", "valid", "baseline_m")

_SCALED_ON: Final = 5
"""How many frames determine the range of colours, which is the same throughout."""


def clip_pages(
    reader: SceneReader,
    row: int,
    *,
    pair: tuple[int, int] | None = None,
) -> Iterator[Picture]:
    """Yield a page for each frame of a scene, all of one size with even sides.

    Args:
        reader: Reads the data.
        row: The scene's row in the index.
        pair: The cameras (left, right), None for the pair that the scene records.

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
    scale = ColourScale.of(
        np.stack([sample["disparity"] for sample in found]),
        measured=np.stack([sample["valid"] for sample in found]),
    )
    width_px, fx_px = tile_width(scene), rig_intrinsics(scene.rig).fx_px
    for frame in range(scene.frames):
        sample = reader.pair(row, pair=pair, frame=frame, fields=CLIP_FIELDS)
        heading = f"{scene.id.key}, pair {pair[0]}-{pair[1]}, frame {frame}"
        tiles = [
            *pair_tiles(sample, fx_px=fx_px, scale=scale),
            Tile("anaglyph", anaglyph(sample["left"], sample["right"])),
        ]
        page = draw_sheet([heading], [tiles], width_px=width_px)
        height, width = page.shape[:2]
        yield np.pad(page, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def write_clip(
    path: Path,
    pages: Iterator[Picture],
    *,
    frames: int,
    rate_hz: float,
    progress: Progress | None = None,
) -> None:
    """Write pages as an H.264 video.

    Args:
        path: An MP4 file; an existing one is replaced.
        pages: (h, w, 3) uint8, with even sides.
        frames: Number of pages, for the progress.
        rate_hz: Pages a second.
        progress: Called with (pages written, all) after each page.

    Raises:
        StorageError: If the file cannot be written.
    """
    advance = advance_of(progress, total=frames)
    with (
        named_errors(path),
        open_output(path) as file,
        VideoEncoder(file, rate_hz=rate_hz, encoding=Encoding(crf=18)) as video,
    ):
        for page in pages:
            video.write_picture(page)
            advance(1)
