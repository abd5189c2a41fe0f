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
from stereogenbench_data.synthesis.camera_writer import write_cameras
from stereogenbench_data.synthesis.export import completion_text, metadata_texts
from stereogenbench_data.synthesis.plan import ScenePlan
from stereogenbench_data.synthesis.planning import plan_scene
from stereogenbench_data.synthesis.ray_renderer import RAY_CASTING
from stereogenbench_data.synthesis.renderer import Renderer
from stereogenbench_data.synthesis.request import SynthRequest

_TEMPORARY: Final = ".unfinished"
_CURE: Final = "Check that the disk has free space and may be written to."
_AGAIN: Final = "Then run the same request again: complete scenes are kept."


@dataclass(frozen=True, slots=True)
class _PlanTask:
    """One scene to search a plan for."""

    request: SynthRequest
    index: int
    renderer: Renderer


@dataclass(frozen=True, slots=True)
class _RenderTask:
    """Some cameras of one scene, and the folder for their videos."""

    plan: ScenePlan
    renderer: Renderer
    cameras: tuple[int, ...]
    folder: Path


def synthesise(
    out: str | Path,
    request: SynthRequest,
    *,
    renderer: Renderer = RAY_CASTING,
    workers: int | None = 1,
    engine: Engine = LOCAL,
    progress: Progress | None = None,
) -> list[str]:
    """Write scenes in the released layout; keep scenes that the same request wrote before.

    Args:
        out: Root of the tree; created if it does not exist.
        request: The scenes. Scene i does not depend on the number of scenes or on ``workers``.
        renderer: What draws them.
        workers: The number of processes; each renders one camera of one scene at a time. With 1,
            this process renders; None is one a core. More are spawned, so a script must call
            this function below ``if __name__ == "__main__"``.
        engine: Where the processes run: `engine.LOCAL`, or an `engine.RayCluster`.
        progress: Called repeatedly with the numbers of camera frames rendered so far and in total.

    Returns:
        The scenes' keys, from scene 0 on.

    Raises:
        SynthesisError: If ``workers`` is below 1, a scene's folder has other content, a file
            cannot be written, all proposals of a scene are refused, or a worker process dies.
    """
    root = Path(out)
    plans: dict[int, ScenePlan] = {}
    per_scene = CAMERA_COUNT * request.frames
    total = request.scenes * per_scene
    try:
        searches = engine.map(
            _search,
            [_PlanTask(request, index, renderer) for index in range(request.scenes)],
            name=lambda task: f"scene {task.index} of {request.stream}",
            workers=workers,
        )
        with closing(searches):
            for plan in searches:
                plans[plan.proposal.index] = plan
        missing = [
            plan for _, plan in sorted(plans.items()) if _is_missing(root, plan, renderer=renderer)
        ]
        advance = advance_of(progress, done=total - len(missing) * per_scene, total=total)
        advance(0)
        left = {plan.key: CAMERA_COUNT for plan in missing}
        written = engine.map(
            _render,
            list(_render_tasks(root, missing, renderer=renderer)),
            name=lambda task: f"{task.plan.key}, camera {', '.join(map(str, task.cameras))}",
            workers=workers,
            advance=advance,
        )
        with closing(written):
            for task in written:
                left[task.plan.key] -= len(task.cameras)
                if not left[task.plan.key]:
                    _finish(root, task.plan, renderer=renderer, rendered_in=task.folder)
    except StorageError as error:
        raise SynthesisError(str(error)) from error
    finally:
        _clear(root, list(plans.values()))
    warn_if_stale(root)
    return [plan.key for _, plan in sorted(plans.items())]


def _search(task: _PlanTask, after_proposals: Advance) -> ScenePlan:
    """Search for a scene's plan; a worker process calls this."""
    return plan_scene(task.request, index=task.index, renderer=task.renderer).plan


def _drawn_by(renderer: Renderer) -> str:
    return f"{renderer.name} {renderer.fingerprint}"


def _is_missing(out: Path, plan: ScenePlan, *, renderer: Renderer) -> bool:
    """Return whether a scene must be rendered; refuse a folder that another request wrote."""
    folder = out / plan.key
    try:
        if not folder.exists():
            return True
        found = (folder / COMPLETE_JSON).read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise SynthesisError(
            f"{folder}: a scene belongs here, but the {COMPLETE_JSON} of this folder cannot be "
            f"read ({error}). Move the folder away or choose another output."
        ) from error
    if found != completion_text(plan, renderer=_drawn_by(renderer)):
        raise SynthesisError(
            f"{folder}: another request wrote this scene (its {COMPLETE_JSON} differs). Choose "
            f"another output or map_name, or move the folder away."
        )
    return False


def _render_tasks(
    out: Path, missing: list[ScenePlan], *, renderer: Renderer
) -> Iterator[_RenderTask]:
    """Yield the cameras of all missing scenes, whose folders are made empty."""
    together = renderer.cameras_per_task
    for plan in missing:
        folder = out / _TEMPORARY / plan.key
        try:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        except OSError as error:
            raise SynthesisError(
                f"{out}: cannot create a folder there ({error}). "
                + cure_of(error, "Choose an output that you may write to.")
            ) from error
        for first in range(0, CAMERA_COUNT, together):
            yield _RenderTask(plan, renderer, tuple(range(first, first + together)), folder)


def _render(task: _RenderTask, after_frames: Advance) -> _RenderTask:
    """Write the videos of cameras; a worker process calls this."""
    plan = task.plan
    # Torch renders with one thread, because its rounding depends on the number of threads.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        write_cameras(
            plan,
            renderer=task.renderer,
            cameras=task.cameras,
            folder=task.folder,
            after_frame=lambda: after_frames(1),
        )
    except OSError as error:
        raise SynthesisError(
            f"{plan.key}: camera {', '.join(map(str, task.cameras))} cannot be written to "
            f"{task.folder}: {error}. {cure_of(error, _CURE)} {_AGAIN}"
        ) from error
    finally:
        torch.set_num_threads(threads)
    return task


def _finish(out: Path, plan: ScenePlan, *, renderer: Renderer, rendered_in: Path) -> None:
    """Write the metadata, with the completion marker last, and move the scene to its place."""
    folder = out / plan.key
    texts = metadata_texts(
        plan, renderer=_drawn_by(renderer), description=renderer.description(plan)
    )
    try:
        for name, text in texts.items():
            (rendered_in / name).write_text(text)
        folder.parent.mkdir(parents=True, exist_ok=True)
        rendered_in.rename(folder)
    except OSError as error:
        raise SynthesisError(
            f"{plan.key}: cannot be completed in {out}: {error}. {cure_of(error, _CURE)} {_AGAIN}"
        ) from error


def _clear(out: Path, plans: list[ScenePlan]) -> None:
    """Remove incomplete scenes, and the folders that are then empty."""
    for plan in plans:
        folder = out / _TEMPORARY / plan.key
        shutil.rmtree(folder, ignore_errors=True)
        while folder.parent != out:
            folder = folder.parent
            with suppress(OSError):
                folder.rmdir()
