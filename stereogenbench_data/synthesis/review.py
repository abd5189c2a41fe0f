"""A person's pass over scenes: contact sheets to look through, and a holdout of what is refused."""

from contextlib import closing
from pathlib import Path
from typing import Final, Unpack

import numpy as np

from stereogenbench_data.audit.geometry.audit import open_for_audit
from stereogenbench_data.audit.pictures.scene_pictures import scene_sheet
from stereogenbench_data.audit.pictures.scene_reader import SceneReader
from stereogenbench_data.engine import Advance
from stereogenbench_data.errors import SynthesisError, explain_os_errors
from stereogenbench_data.jobs import WorkOptions, do_items
from stereogenbench_data.samples.picture import write_png
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.schema.release import COMPLETE_JSON

HOLDOUT: Final = ".holdout"
_TILE_PX: Final = 224


def hold_out(out: str | Path, keys: list[str]) -> list[str]:
    """Move scenes that a person refused out of the tree, into its hidden folder ``.holdout``.

    A later run of their request does not render them again.

    Args:
        out: Root of the tree.
        keys: Whole paths of scenes below the root. All must be in the tree or in the holdout.

    Returns:
        The keys of the scenes that were moved now.

    Raises:
        SynthesisError: If a key is no scene of the tree, or a folder cannot be moved.
    """
    root = Path(out)
    for key in keys:
        try:
            parse_scene_key(key)
            is_there = (root / key).is_dir() or (root / HOLDOUT / key).is_dir()
        except ValueError:
            is_there = False
        if not is_there:
            raise SynthesisError(
                f"{root}: there is no scene {key!r} to hold out. List whole paths, such as "
                f"train/Uniform/SynthStage/scene_000000, one a line."
            )
    moved = [key for key in dict.fromkeys(keys) if (root / key).is_dir()]
    for key in moved:
        target = root / HOLDOUT / key
        where = f"{root / key}: cannot be moved to {target}"
        with explain_os_errors(where, "Check that both may be written to.", kind=SynthesisError):
            target.parent.mkdir(parents=True, exist_ok=True)
            (root / key).rename(target)
    return moved


def write_sheets(
    out: str | Path,
    keys: list[str],
    *,
    folder: str | Path,
    unit_m: float,
    **options: Unpack[WorkOptions],
) -> list[Path]:
    """Write the sheets of each scene at its first, middle and last frame, one below the other.

    Args:
        out: Root of the tree.
        keys: The scenes' whole paths below it.
        folder: Where the pictures go, one a scene, named after its path; those that are newer than
            their scenes are kept.
        unit_m: Metres in one stored unit of depth.
        **options: How it is done; progress is in scenes.

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
    where = f"{folder}: contact sheets cannot be written there"
    with explain_os_errors(where, "Choose a folder that you may write to.", kind=SynthesisError):
        Path(folder).mkdir(parents=True, exist_ok=True)
        do_items(
            _write_sheet,
            tasks,
            name=lambda task: task[1],
            options=options,
            done=len(keys) - len(tasks),
            total=len(keys),
        )
    return paths


def _is_newer(path: Path, *, than: Path) -> bool:
    return path.exists() and path.stat().st_mtime_ns >= than.stat().st_mtime_ns


def _write_sheet(task: tuple[Path, str, Path, float], after_scene: Advance) -> None:
    """Draw the sheet of a scene; a worker process calls this."""
    out, key, path, unit_m = task
    index = open_for_audit(out, workers=1, scenes=(key,))
    frames = index.scene(0).frames
    with closing(SceneReader(index, depth=DepthEncoding(unit_m=unit_m))) as reader:
        sheets = [
            scene_sheet(reader, 0, frame=frame, tile_px=_TILE_PX)
            for frame in sorted({0, frames // 2, frames - 1})
        ]
    write_png(path, np.concatenate(sheets))
    after_scene(1)
