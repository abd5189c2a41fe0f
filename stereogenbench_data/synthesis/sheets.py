"""Contact sheets of scenes, for a person who looks through them and refuses some."""

from pathlib import Path
from typing import Final

import av
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from stereogenbench_data.engine import LOCAL, Advance, Engine, Progress, advance_of
from stereogenbench_data.errors import SynthesisError, cure_of
from stereogenbench_data.samples.picture import coloured, write_png
from stereogenbench_data.schema.release import CAMERA_COUNT, COMPLETE_JSON, depth_name, rgb_name

_TILE_PX: Final = 224
_CAPTION_PX: Final = 18
_GAP_PX: Final = 4
_MOMENTS: Final = 3

Picture = UInt8[np.ndarray, "h w 3"]


def write_sheets(
    out: str | Path,
    keys: list[str],
    *,
    folder: str | Path,
    workers: int | None = 1,
    engine: Engine = LOCAL,
    progress: Progress | None = None,
) -> list[Path]:
    """Write a picture for each scene: all six cameras and two depths at three moments.

    Args:
        out: Root of the tree.
        keys: The scenes' whole paths below it.
        folder: Where the pictures go, one a scene, named after its path; those that are newer than
            their scenes are kept.
        workers: The number of processes; None is one a core.
        engine: Where they run.
        progress: Called with the numbers of scenes done and in all.

    Returns:
        The pictures' paths, as ``keys``.

    Raises:
        SynthesisError: If a scene cannot be read or a picture not be written.
    """
    paths = [Path(folder) / f"{key.replace('/', '__')}.png" for key in keys]
    tasks = [
        (Path(out) / key, path)
        for key, path in zip(keys, paths, strict=True)
        if not _is_newer(path, than=Path(out) / key / COMPLETE_JSON)
    ]
    advance = advance_of(progress, done=len(keys) - len(tasks), total=len(keys))
    advance(0)
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SynthesisError(
            f"{folder}: contact sheets cannot be written there ({error}). "
            + cure_of(error, "Choose a folder that you may write to.")
        ) from error
    for _ in engine.map(_write, tasks, name=lambda task: task[0].name, workers=workers):
        advance(1)
    return paths


def _is_newer(path: Path, *, than: Path) -> bool:
    try:
        return path.stat().st_mtime_ns >= than.stat().st_mtime_ns
    except OSError:
        return False


def _write(task: tuple[Path, Path], after_scene: Advance) -> None:
    scene, path = task
    try:
        write_png(path, contact_sheet(scene))
    except (OSError, av.error.FFmpegError) as error:
        raise SynthesisError(
            f"{scene}: its contact sheet {path} cannot be made ({error}). Check that the folder "
            f"may be written to, and the scene with `stereogenbench audit`."
        ) from error


def contact_sheet(scene: Path) -> Picture:
    """Return one row of tiles for the first, the middle and the last frame of a scene.

    A row has the pictures of all cameras from left to right, and the depths of the outer two, from
    dark blue (near) to red (far); grey is no depth.
    """
    columns = [(f"camera {camera}", _pictures(scene, camera)) for camera in range(CAMERA_COUNT)]
    outer = (0, CAMERA_COUNT - 1)
    columns += [(f"depth {camera}", _depths(scene, camera)) for camera in outer]
    rows = max(len(tiles) for _, tiles in columns)
    height = max(len(tile) for _, tiles in columns for tile in tiles)
    size = (len(columns) * (_TILE_PX + _GAP_PX), _CAPTION_PX + rows * (height + _GAP_PX))
    sheet = Image.new("RGB", size, (255, 255, 255))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=13)
    for column, (caption, tiles) in enumerate(columns):
        left = column * (_TILE_PX + _GAP_PX)
        draw.text((left + 2, 1), caption, fill=(0, 0, 0), font=font)
        for row, tile in enumerate(tiles):
            sheet.paste(Image.fromarray(tile), (left, _CAPTION_PX + row * (height + _GAP_PX)))
    return np.asarray(sheet)


def _moments(path: Path, *, pixel_format: str) -> list[UInt8[np.ndarray, "..."]]:
    """Return the first, the middle and the last frame of a video."""
    with av.open(path) as container:
        count = sum(packet.size > 0 for packet in container.demux(video=0))
    wanted = {0, count // 2, count - 1} if count > _MOMENTS else set(range(count))
    with av.open(path) as container:
        return [
            frame.to_ndarray(format=pixel_format)
            for number, frame in enumerate(container.decode(video=0))
            if number in wanted
        ]


def _scaled(picture: Picture) -> Picture:
    height, width, _ = picture.shape
    size = (_TILE_PX, max(1, round(_TILE_PX * height / width)))
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX))


def _pictures(scene: Path, camera: int) -> list[Picture]:
    return [_scaled(each) for each in _moments(scene / rgb_name(camera), pixel_format="rgb24")]


def _depths(scene: Path, camera: int) -> list[Picture]:
    tiles = []
    for units in _moments(scene / depth_name(camera), pixel_format="gray16le"):
        measured = (units > 0) & (units < units.max(initial=1))
        largest = float(np.percentile(units[measured], 95)) if measured.any() else 1.0
        tiles.append(_scaled(coloured(units.astype(float), measured=measured, largest=largest)))
    return tiles
