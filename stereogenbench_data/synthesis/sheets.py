"""Contact sheets of scenes, for a person who looks through them and refuses some."""

from contextlib import closing
from pathlib import Path
from typing import Final

import numpy as np

from stereogenbench_data.audit.geometry.audit import open_for_audit
from stereogenbench_data.audit.pictures.scene_pictures import scene_sheet
from stereogenbench_data.audit.pictures.scene_reader import SceneReader
from stereogenbench_data.engine import LOCAL, Advance, Engine, Progress, advance_of
from stereogenbench_data.errors import SynthesisError, explain_os_errors
from stereogenbench_data.samples.picture import write_png
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.schema.release import COMPLETE_JSON

_TILE_PX: Final = 224


def write_sheets(  # noqa: PLR0913 - each names one thing that a user chooses
    out: str | Path,
    keys: list[str],
    *,
    folder: str | Path,
    unit_m: float,
    workers: int | None = 1,
    engine: Engine = LOCAL,
    progress: Progress | None = None,
) -> list[Path]:
    """Write the sheets of each scene at its first, middle and last frame, one below the other.

    Args:
        out: Root of the tree.
        keys: The scenes' whole paths below it.
        folder: Where the pictures go, one a scene, named after its path; those that are newer than
            their scenes are kept.
        unit_m: Metres in one stored unit of depth.
        workers: The number of processes; None is one a core.
        engine: Where they run.
        progress: Called with the numbers of scenes done and in all.

    Returns:
        The pictures' paths, as ``keys``.

    Raises:
        SynthesisError: If a picture cannot be written.
        StorageError: If a scene cannot be read.
    """
    paths = [Path(folder) / f"{key.replace('/', '__')}.png" for key in keys]
    tasks = [
        (Path(out), key, path, unit_m)
        for key, path in zip(keys, paths, strict=True)
        if not _is_newer(path, than=Path(out) / key / COMPLETE_JSON)
    ]
    advance = advance_of(progress, done=len(keys) - len(tasks), total=len(keys))
    advance(0)
    where = f"{folder}: contact sheets cannot be written there"
    with explain_os_errors(where, "Choose a folder that you may write to.", kind=SynthesisError):
        Path(folder).mkdir(parents=True, exist_ok=True)
    for _ in engine.map(_write, tasks, name=lambda task: task[1], workers=workers):
        advance(1)
    return paths


def _is_newer(path: Path, *, than: Path) -> bool:
    try:
        return path.stat().st_mtime_ns >= than.stat().st_mtime_ns
    except OSError:
        return False


def _write(task: tuple[Path, str, Path, float], after_scene: Advance) -> None:
    out, key, path, unit_m = task
    index = open_for_audit(out, workers=1, scenes=(key,))
    frames = index.scene(0).frames
    with closing(SceneReader(index, depth=DepthEncoding(unit_m=unit_m))) as reader:
        sheets = [
            scene_sheet(reader, 0, frame=frame, tile_px=_TILE_PX)
            for frame in sorted({0, frames // 2, frames - 1})
        ]
    where = f"{path}: the contact sheet cannot be written"
    with explain_os_errors(where, "Choose a folder that you may write to.", kind=SynthesisError):
        write_png(path, np.concatenate(sheets))
