"""Synthetic scenes on disk, for `stereogenbench synth`.

A scene is rendered into a hidden folder beside the splits and moved to its place when it is
complete. An interrupted run leaves no incomplete scenes, and the next run of the same request
renders only the missing ones.
"""

import shutil
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import torch

from stereogenbench_data.engine import LOCAL, Advance, Engine, Progress, advance_of
from stereogenbench_data.errors import StorageError, SynthesisError, cure_of
from stereogenbench_data.index.open import warn_if_stale
from stereogenbench_data.schema.release import CAMERA_COUNT, COMPLETE_JSON
from stereogenbench_data.synthesis.camera_writer import write_camera
from stereogenbench_data.synthesis.export import completion_text, metadata_texts
from stereogenbench_data.synthesis.plan import ScenePlan, plan_scene
from stereogenbench_data.synthesis.request import SynthRequest

_UNFINISHED: Final = ".unfinished"
_CURE: Final = "Check that the disk has free space and may be written to."
_AGAIN: Final = "Then run the same request again: complete scenes are kept."


@dataclass(frozen=True, slots=True)
class _CameraTask:
    """One camera of one scene, and the folder for its videos."""

    request: SynthRequest
    index: int
    camera: int
    folder: Path


def synthesise(
    out: str | Path,
    request: SynthRequest,
    *,
    workers: int | None = 1,
    engine: Engine = LOCAL,
    progress: Progress | None = None,
) -> list[str]:
    """Write scenes in the released layout; keep scenes that the same request wrote before.

    Args:
        out: Root of the tree; created if it does not exist.
        request: The scenes. Scene i does not depend on the number of scenes or on ``workers``.
        workers: The number of processes; each renders one camera of one scene at a time. With 1,
            this process renders; None is one a core. More are spawned, so a script must call
            this function below ``if __name__ == "__main__"``.
        engine: Where the processes run: `engine.LOCAL`, or an `engine.RayCluster`.
        progress: Called repeatedly with the numbers of camera frames rendered so far and in total.

    Returns:
        The scenes' keys, from scene 0 on.

    Raises:
        SynthesisError: If ``workers`` is below 1, a scene's folder has other content, a file
            cannot be written, or a worker process dies.
    """
    root = Path(out)
    missing = [index for index in range(request.scenes) if _is_missing(root, request, index=index)]
    per_scene = CAMERA_COUNT * request.frames
    total = request.scenes * per_scene
    advance = advance_of(progress, done=total - len(missing) * per_scene, total=total)
    left = dict.fromkeys(missing, CAMERA_COUNT)
    advance(0)
    try:
        written = engine.map(
            _write_camera,
            list(_camera_tasks(root, request, missing=missing)),
            name=lambda task: f"{task.request.key(task.index)}, camera {task.camera}",
            workers=workers,
            advance=advance,
        )
        with closing(written):
            for task in written:
                left[task.index] -= 1
                if not left[task.index]:
                    _finish(root, plan_scene(request, index=task.index), rendered_in=task.folder)
    except StorageError as error:
        raise SynthesisError(str(error)) from error
    finally:
        _clear(root, request, missing=missing)
    warn_if_stale(root)
    return [request.key(index) for index in range(request.scenes)]


def _is_missing(out: Path, request: SynthRequest, *, index: int) -> bool:
    """Return whether a scene must be rendered; refuse a folder that another request wrote."""
    folder = out / request.key(index)
    try:
        if not folder.exists():
            return True
        found = (folder / COMPLETE_JSON).read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise SynthesisError(
            f"{folder}: a scene belongs here, but the {COMPLETE_JSON} of this folder cannot be "
            f"read ({error}). Move the folder away or choose another output."
        ) from error
    if found != completion_text(plan_scene(request, index=index)):
        raise SynthesisError(
            f"{folder}: another request wrote this scene (its {COMPLETE_JSON} differs). Choose "
            f"another output or map_name, or move the folder away."
        )
    return False


def _camera_tasks(out: Path, request: SynthRequest, *, missing: list[int]) -> Iterator[_CameraTask]:
    """Yield the cameras of all missing scenes, whose folders are made empty."""
    for index in missing:
        folder = out / _UNFINISHED / request.key(index)
        try:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        except OSError as error:
            raise SynthesisError(
                f"{out}: cannot create a folder there ({error}). "
                + cure_of(error, "Choose an output that you may write to.")
            ) from error
        for camera in range(CAMERA_COUNT):
            yield _CameraTask(request, index, camera, folder)


def _write_camera(task: _CameraTask, after_frames: Advance) -> _CameraTask:
    """Write a camera's videos; a worker process calls this."""
    plan = plan_scene(task.request, index=task.index)
    # Torch renders with one thread, because its rounding depends on the number of threads.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        write_camera(
            plan, camera=task.camera, folder=task.folder, after_frame=lambda: after_frames(1)
        )
    except OSError as error:
        raise SynthesisError(
            f"{plan.key}: camera {task.camera} cannot be written to {task.folder}: {error}. "
            f"{cure_of(error, _CURE)} {_AGAIN}"
        ) from error
    finally:
        torch.set_num_threads(threads)
    return task


def _finish(out: Path, plan: ScenePlan, *, rendered_in: Path) -> None:
    """Write the metadata, with the completion marker last, and move the scene to its place."""
    folder = out / plan.key
    try:
        for name, text in metadata_texts(plan).items():
            (rendered_in / name).write_text(text)
        folder.parent.mkdir(parents=True, exist_ok=True)
        rendered_in.rename(folder)
    except OSError as error:
        raise SynthesisError(
            f"{plan.key}: cannot be completed in {out}: {error}. {cure_of(error, _CURE)} {_AGAIN}"
        ) from error


def _clear(out: Path, request: SynthRequest, *, missing: list[int]) -> None:
    """Remove incomplete scenes, and the folders that are then empty."""
    for index in missing:
        shutil.rmtree(out / _UNFINISHED / request.key(index), ignore_errors=True)
    folder = out / _UNFINISHED / request.folder
    while folder != out:
        with suppress(OSError):
            folder.rmdir()
        folder = folder.parent
