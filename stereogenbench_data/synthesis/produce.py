"""Synthetic scenes on disk, for `stereogenbench synth`.

A scene is rendered into a hidden folder beside the splits and moved to its place when it is
complete; its completion marker is written last. An interrupted run leaves no incomplete scenes, and
the next run of the same request renders only the missing ones.
"""

import shutil
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Final

from stereogenbench_data.engine import LOCAL, Engine
from stereogenbench_data.errors import SynthesisError, cure_of
from stereogenbench_data.index.open import warn_if_stale
from stereogenbench_data.schema.release import CAMERA_COUNT, COMPLETE_JSON
from stereogenbench_data.synthesis.export import completion_text, metadata_texts
from stereogenbench_data.synthesis.plan import ScenePlan, plan_scene
from stereogenbench_data.synthesis.request import SynthRequest
from stereogenbench_data.synthesis.workers import CameraJob, run_jobs

Progress = Callable[[int, int], None]

_UNFINISHED: Final = ".unfinished"
_CURE: Final = "Check that the disk has free space and may be written to."


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
    if workers is not None and workers < 1:
        raise SynthesisError(f"workers must be at least 1, got {workers}.")
    root = Path(out)
    missing = [index for index in range(request.scenes) if _is_missing(root, request, index=index)]
    per_scene = CAMERA_COUNT * request.frames
    drawn = (request.scenes - len(missing)) * per_scene

    def after_frames(count: int) -> None:
        nonlocal drawn
        drawn += count
        if progress is not None:
            progress(drawn, request.scenes * per_scene)

    left = dict.fromkeys(missing, CAMERA_COUNT)
    jobs = list(_jobs(root, request, missing=missing))
    after_frames(0)
    try:
        with closing(
            run_jobs(jobs, workers=workers, engine=engine, after_frames=after_frames)
        ) as done:
            for job in done:
                left[job.index] -= 1
                if not left[job.index]:
                    _finish(root, plan_scene(request, index=job.index), drawn_in=job.folder)
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


def _jobs(out: Path, request: SynthRequest, *, missing: list[int]) -> Iterator[CameraJob]:
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
            yield CameraJob(request=request, index=index, camera=camera, folder=folder)


def _finish(out: Path, plan: ScenePlan, *, drawn_in: Path) -> None:
    """Write the metadata, with the completion marker last, and move the scene to its place."""
    folder = out / plan.key
    try:
        for name, text in metadata_texts(plan).items():
            (drawn_in / name).write_text(text)
        folder.parent.mkdir(parents=True, exist_ok=True)
        drawn_in.rename(folder)
    except OSError as error:
        raise SynthesisError(
            f"{plan.key}: cannot be completed in {out}: {error}. {cure_of(error, _CURE)} Then "
            f"run the same request again: complete scenes are kept."
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
