"""Synthetic scenes on disk, for `stereogenbench synth`.

Proposals of each scene are examined until one passes. Its scene is rendered into a hidden folder
beside the splits, checked, and moved to its place when it is complete. An interrupted run leaves no
incomplete scenes, and the next run of the same request goes on with what is missing.
"""

import json
import math
import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import torch

from stereogenbench_data.engine import (
    LOCAL,
    Advance,
    Engine,
    Progress,
    advance_of,
    require_workers,
)
from stereogenbench_data.errors import StorageError, SynthesisError, cure_of, explain_os_errors
from stereogenbench_data.index.open import warn_if_stale
from stereogenbench_data.schema.parse import parse_scene_key
from stereogenbench_data.schema.release import CAMERA_COUNT, COMPLETE_JSON
from stereogenbench_data.sources.files import try_locked
from stereogenbench_data.synthesis.camera_writer import write_cameras
from stereogenbench_data.synthesis.checks import (
    CameraStatistics,
    check_files,
    check_pictures,
    check_scene,
)
from stereogenbench_data.synthesis.decisions import Check, Decision, Decisions, Drawn
from stereogenbench_data.synthesis.export import completion_text, metadata_texts
from stereogenbench_data.synthesis.filters import DEFAULT_LIMITS, Limits, Refusal
from stereogenbench_data.synthesis.plan import ScenePlan
from stereogenbench_data.synthesis.planning import PlanSearch, plan_scene, propose
from stereogenbench_data.synthesis.proposal import Proposal
from stereogenbench_data.synthesis.ray_renderer import RAY_CASTING
from stereogenbench_data.synthesis.renderer import Renderer
from stereogenbench_data.synthesis.request import SynthRequest

_TEMPORARY: Final = ".unfinished"
_HOLDOUT: Final = ".holdout"
_FEW: Final = 4
_MOST_RENDERED: Final = 8
"""How many rendered proposals of one scene may fail their checks."""
_CURE: Final = "Check that the disk has free space and may be written to."
_AGAIN: Final = "Then run the same request again: complete scenes are kept."


@dataclass(frozen=True, slots=True)
class _SearchTask:
    """A scene to search a plan for, from one of its proposals on."""

    request: SynthRequest
    index: int
    first: int
    renderer: Renderer
    limits: Limits


@dataclass(frozen=True, slots=True)
class _RenderTask:
    """Some cameras of one scene, and the folder for their videos."""

    plan: ScenePlan
    renderer: Renderer
    limits: Limits
    cameras: tuple[int, ...]
    folder: Path


@dataclass(frozen=True, slots=True)
class _Work:
    """What all steps of a run share."""

    out: Path
    request: SynthRequest
    renderer: Renderer
    limits: Limits
    decisions: Decisions
    workers: int | None
    engine: Engine

    @property
    def drawn_by(self) -> str:
        """Name and fingerprint of the renderer, for completion markers."""
        return f"{self.renderer.name} {self.renderer.fingerprint}"


def synthesise(  # noqa: PLR0913 - each names one thing that a user chooses
    out: str | Path,
    request: SynthRequest,
    *,
    renderer: Renderer = RAY_CASTING,
    part: tuple[int, int] = (1, 1),
    check: Check = "pictures",
    workers: int | None = 1,
    engine: Engine = LOCAL,
    progress: Progress | None = None,
) -> list[str]:
    """Write scenes in the released layout; keep scenes that the same request wrote before.

    Args:
        out: Root of the tree; created if it does not exist.
        request: The scenes. Scene i does not depend on the number of scenes or on ``workers``.
        renderer: What draws them.
        part: (i, n) writes the i-th of n parts of the scenes, with i from 1. All parts together
            are the same scenes as without parts.
        check: What a rendered scene must pass: "pictures" looks for missing frames, pixels without
            depth, dark and flat pictures, and near things at the border; "audit" also lets the
            audit and the doctor look at the scene.
        workers: The number of processes; each renders one camera of one scene at a time. With 1,
            this process renders; None is one a core. More are spawned, so a script must call
            this function below ``if __name__ == "__main__"``.
        engine: Where the processes run: `engine.LOCAL`, or an `engine.RayCluster`.
        progress: Called repeatedly with the numbers of camera frames rendered so far and in total.

    Returns:
        The scenes' keys, by number. Scenes in the holdout are left out.

    Raises:
        SynthesisError: If ``workers`` is below 1, there is no such part or map, another process
            draws these scenes now, a scene's folder has other content, other scenes of the request
            had to pass another check, a file cannot be written, all proposals of a scene are
            refused, or a worker process dies.
    """
    work = _work(Path(out), request, renderer=renderer, workers=workers, engine=engine)
    indices = _of_part(request, part)
    with _as_synthesis_error():
        _require_drawable(work, indices)
        work.decisions.require_check(check)
        plans = _searched(work, indices)
        with _alone(work, indices, part=part):
            accepted = {index: _proposed(work, index) for index in indices}
            missing = [index for index, each in accepted.items() if _is_missing(work, each)]
            per_scene = CAMERA_COUNT * request.frames
            total = len(accepted) * per_scene
            advance = advance_of(progress, done=total - len(missing) * per_scene, total=total)
            advance(0)
            while missing:
                known = {index: plans[index] for index in missing if index in plans}
                lost = {index: accepted[index].number for index in missing if index not in known}
                for search in _search_all(work, lost):
                    known[search.plan.proposal.index] = _same_plan(work, search.plan)
                refused = _rendered(work, known, check=check, advance=advance)
                # A scene that failed its checks goes on with its next proposal.
                before = {
                    index: _refuse(work, index, why, indices) for index, why in refused.items()
                }
                first = {index: drawn[-1].number + 1 for index, drawn in before.items()}
                plans = {}
                for search in _search_all(work, first):
                    index = search.plan.proposal.index
                    work.decisions.write(Decision.of(search, before=before[index], check=check))
                    plans[index], accepted[index] = search.plan, search.plan.proposal
                missing = [index for index in sorted(plans) if _is_missing(work, accepted[index])]
    # Another process may have drawn other parts meanwhile.
    work.decisions.require_check(check)
    warn_if_stale(work.out)
    keys = (each.key for each in accepted.values())
    return [key for key in keys if not (work.out / _HOLDOUT / key).exists()]


def plan_scenes(  # noqa: PLR0913 - the choices of `synthesise`
    out: str | Path,
    request: SynthRequest,
    *,
    renderer: Renderer = RAY_CASTING,
    part: tuple[int, int] = (1, 1),
    workers: int | None = 1,
    engine: Engine = LOCAL,
    progress: Progress | None = None,
) -> list[Decision]:
    """Search for the plans of scenes without rendering them, and keep what was decided.

    The arguments are those of `synthesise`, which takes the same decisions, and goes on from those
    that are kept.

    Args:
        out: Root of the tree; the decisions go into a hidden folder there.
        request: The scenes.
        renderer: Whose maps are asked.
        part: (i, n) for the i-th of n parts.
        workers: The number of processes.
        engine: Where they run.
        progress: Called with the numbers of scenes decided so far and in total.

    Returns:
        The decisions by the scenes' numbers.

    Raises:
        SynthesisError: As `synthesise`.
    """
    work = _work(Path(out), request, renderer=renderer, workers=workers, engine=engine)
    indices = _of_part(request, part)
    with _as_synthesis_error():
        _require_drawable(work, indices)
        _searched(work, indices, progress=progress)
    return [_decided(work, index) for index in indices]


def hold_out(out: str | Path, keys: Sequence[str]) -> list[str]:
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
    moved = []
    for key in dict.fromkeys(keys):
        try:
            parse_scene_key(key)
        except ValueError as error:
            raise SynthesisError(f"{key!r} is not the path of a scene: {error}") from error
        if not (root / key).is_dir() and not (root / _HOLDOUT / key).is_dir():
            raise SynthesisError(
                f"{root}: there is no scene {key!r} to hold out. List whole paths, such as "
                f"train/Uniform/SynthStage/scene_000000, one a line."
            )
    for key in dict.fromkeys(keys):
        if not (root / key).is_dir():
            continue
        target = root / _HOLDOUT / key
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            (root / key).rename(target)
        except OSError as error:
            raise SynthesisError(
                f"{root / key}: cannot be moved to {target}: {error}. {cure_of(error, _CURE)}"
            ) from error
        moved.append(key)
    warn_if_stale(root)
    return moved


def _work(
    out: Path,
    request: SynthRequest,
    *,
    renderer: Renderer,
    workers: int | None,
    engine: Engine,
) -> _Work:
    limits = DEFAULT_LIMITS
    decisions = Decisions.at(out, request, renderer=renderer, limits=limits)
    return _Work(out, request, renderer, limits, decisions, workers, engine)


@contextmanager
def _alone(work: _Work, indices: list[int], *, part: tuple[int, int]) -> Iterator[None]:
    """Keep other processes from drawing these scenes meanwhile, if one is missing.

    Raises:
        SynthesisError: If another process is drawing some of them.
    """
    folder = work.decisions.folder.parent
    try:
        with ExitStack() as held:
            if any(_is_missing(work, _proposed(work, index)) for index in indices):
                where = f"{folder}: cannot write there"
                with explain_os_errors(where, "Choose another output.", kind=SynthesisError):
                    for name in work.request.maps:
                        _lock(work, name, part=part, held=held)
            yield
    finally:
        with suppress(OSError):
            folder.rmdir()  # It is empty if a refused request left no decisions.


def _lock(work: _Work, map_name: str, *, part: tuple[int, int], held: ExitStack) -> None:
    """Hold the lock of a part of a map's scenes, unless a part that shares scenes is locked."""
    number, count = part
    begin = work.request.folder(map_name).replace("/", "__")
    folder = work.decisions.folder.parent
    own = folder / f"{begin}.{number}_of_{count}.lock"
    is_free = held.enter_context(try_locked(own))
    if is_free:
        held.callback(own.unlink, missing_ok=True)
    for path in folder.glob(f"{begin}.*_of_*.lock"):
        other, of = (int(word) for word in path.name.split(".")[-2].split("_of_"))
        if path != own and (other - number) % math.gcd(of, count) == 0:
            with try_locked(path) as is_left:
                if is_left:  # Its process was killed.
                    path.unlink(missing_ok=True)
            is_free = is_free and is_left
    if not is_free:
        raise SynthesisError(
            f"{work.out / work.request.folder(map_name)}: another process is drawing scenes of "
            f"part {number}/{count} there now. Wait for it, or give each process a --part of its "
            f"own, all of the same number."
        )


@contextmanager
def _as_synthesis_error() -> Iterator[None]:
    try:
        yield
    except StorageError as error:
        raise SynthesisError(str(error)) from error


def _of_part(request: SynthRequest, part: tuple[int, int]) -> list[int]:
    number, count = part
    if not 1 <= number <= count:
        raise SynthesisError(
            f"part {number}/{count} is none: the first number must be from 1 to the second."
        )
    return list(range(number - 1, request.scenes, count))


def _require_drawable(work: _Work, indices: list[int]) -> None:
    """Refuse, before anything is decided, a request that cannot be drawn into this tree."""
    require_workers(work.workers)
    for name in work.request.maps:
        if name not in work.renderer.maps:
            # The renderer has others, or says what it has.
            alone = replace(work.request, map_name=name)
            work.renderer.world(propose(alone, index=0, number=0, renderer=work.renderer))
        folder = work.out / work.request.folder(name)
        there = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        for index in indices:
            key = work.request.key(index, map_name=name)
            if key.rpartition("/")[2] in there:
                _require_own(work, index, name, found=_marker(work.out / key))


def _require_own(work: _Work, index: int, map_name: str, *, found: str) -> None:
    """Refuse a scene of the tree whose marker belongs to no proposal of the request."""
    with suppress(ValueError, KeyError, TypeError, OverflowError):
        number = max(0, int(json.loads(found)["synthesis"]["proposal"]))
        proposal = propose(work.request, index=index, number=number, renderer=work.renderer)
        if found == completion_text(proposal, renderer=work.drawn_by):
            return
    raise _of_another_request(work.out / work.request.key(index, map_name=map_name))


def _marker(folder: Path) -> str:
    """Return the completion marker of a scene's folder."""
    try:
        return (folder / COMPLETE_JSON).read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise SynthesisError(
            f"{folder}: a scene belongs here, but the {COMPLETE_JSON} of this folder cannot be "
            f"read ({error}). Move the folder away or choose another output."
        ) from error


def _of_another_request(folder: Path) -> SynthesisError:
    return SynthesisError(
        f"{folder}: another request wrote this scene (its {COMPLETE_JSON} differs). Choose "
        f"another output or map_name, or move the folder away."
    )


def _searched(
    work: _Work, indices: list[int], *, progress: Progress | None = None
) -> dict[int, ScenePlan]:
    """Decide what is not decided yet, and return the plans that were found."""
    left = {index: 0 for index in indices if work.decisions.read(index) is None}
    advance = advance_of(progress, done=len(indices) - len(left), total=len(indices))
    advance(0)
    plans = {}
    for search in _search_all(work, left):
        work.decisions.write(Decision.of(search))
        plans[search.plan.proposal.index] = search.plan
        advance(1)
    return plans


def _search_all(work: _Work, first: dict[int, int]) -> Iterator[PlanSearch]:
    """Yield the searches of scenes, each from one of its proposals on."""
    # To start processes takes longer than a few searches.
    few = len(first) <= _FEW
    require_workers(work.workers)
    searches = (LOCAL if few else work.engine).map(
        _search,
        [
            _SearchTask(work.request, index, number, work.renderer, work.limits)
            for index, number in sorted(first.items())
        ],
        name=lambda task: f"scene {task.index} of {work.request.stream}",
        workers=1 if few else work.workers,
    )
    with closing(searches):
        yield from searches


def _search(task: _SearchTask, after_proposals: Advance) -> PlanSearch:
    """Search for a scene's plan; a worker process calls this."""
    return plan_scene(
        task.request,
        index=task.index,
        renderer=task.renderer,
        limits=task.limits,
        first=task.first,
    )


def _decided(work: _Work, index: int) -> Decision:
    decision = work.decisions.read(index)
    if decision is None:
        raise SynthesisError(
            f"{work.decisions.folder}: the decision on scene {index} was removed or changed while "
            f"scenes were generated. Run the same request again."
        )
    return decision


def _same_plan(work: _Work, plan: ScenePlan) -> ScenePlan:
    """Return a plan that was searched again; refuse one of another proposal."""
    kept = _decided(work, plan.proposal.index).accepted.number
    if plan.proposal.number != kept:
        raise SynthesisError(
            f"{work.decisions.folder}: proposal {kept} of scene {plan.proposal.index} was accepted "
            f"by another version of this package; this one refuses it. Move this folder away."
        )
    return plan


def _proposed(work: _Work, index: int) -> Proposal:
    """Return the accepted proposal of a scene."""
    number = _decided(work, index).accepted.number
    return propose(work.request, index=index, number=number, renderer=work.renderer)


def _is_missing(work: _Work, proposal: Proposal) -> bool:
    """Return whether a scene must be rendered; refuse a folder that another request wrote."""
    folder = work.out / proposal.key
    if (work.out / _HOLDOUT / proposal.key).exists():
        return False
    if not folder.exists():
        return True
    if _marker(folder) != completion_text(proposal, renderer=work.drawn_by):
        raise _of_another_request(folder)
    return False


def _refuse(work: _Work, index: int, refusal: Refusal, indices: list[int]) -> tuple[Drawn, ...]:
    """Return what was refused of a scene, with the accepted proposal as the last.

    If too many were, the run ends, and leaves no decisions on scenes that are not drawn.
    """
    decision = _decided(work, index)
    why = replace(refusal, rendered=True)
    drawn = (*decision.refused, replace(decision.accepted, refusal=why))
    rendered = [each.refusal for each in drawn if each.refusal and each.refusal.rendered]
    if len(rendered) >= _MOST_RENDERED:
        work.decisions.remove(each for each in indices if not _is_drawn(work, each))
        raise SynthesisError(
            f"{work.request.stream}: {len(rendered)} rendered proposals of scene {index} fail "
            f"their checks, the last one with {refusal.reason} ({refusal.text}). Check the "
            f"renderer's maps and lights, and the depth's unit."
        )
    return drawn


def _is_drawn(work: _Work, index: int) -> bool:
    """Return whether the tree or its holdout has the accepted scene."""
    decision = work.decisions.read(index)
    if decision is None:
        return False
    key = work.request.key(index, map_name=decision.accepted.map_name)
    return any((root / key).exists() for root in (work.out, work.out / _HOLDOUT))


def _rendered(
    work: _Work,
    plans: dict[int, ScenePlan],
    *,
    check: Check,
    advance: Advance,
) -> dict[int, Refusal]:
    """Render scenes, move those that pass to their places, and return why others are refused."""
    left = dict.fromkeys(plans, CAMERA_COUNT)
    checks: dict[int, list[CameraStatistics]] = {index: [] for index in plans}
    refused: dict[int, Refusal] = {}
    try:
        written = work.engine.map(
            _render,
            list(_render_tasks(work, plans)),
            name=lambda task: f"{task.plan.key}, {_cameras(task)}",
            workers=work.workers,
            advance=advance,
        )
        with closing(written):
            for task, found in written:
                index = task.plan.proposal.index
                checks[index] += found
                left[index] -= len(task.cameras)
                if not left[index]:
                    refusal = _finish(work, task, checks[index], check=check)
                    if refusal is not None:
                        refused[index] = refusal
    finally:
        _clear(work.out, [plan.key for plan in plans.values()])
    return refused


def _render_tasks(work: _Work, plans: dict[int, ScenePlan]) -> Iterator[_RenderTask]:
    """Yield the cameras of scenes, whose folders are made empty."""
    together = work.renderer.cameras_per_task
    for _, plan in sorted(plans.items()):
        folder = work.out / _TEMPORARY / plan.key
        try:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        except OSError as error:
            raise SynthesisError(
                f"{work.out}: cannot create a folder there ({error}). "
                + cure_of(error, "Choose an output that you may write to.")
            ) from error
        for first in range(0, CAMERA_COUNT, together):
            cameras = tuple(range(first, first + together))
            yield _RenderTask(plan, work.renderer, work.limits, cameras, folder)


def _cameras(task: _RenderTask) -> str:
    return f"camera {', '.join(map(str, task.cameras))}"


def _render(task: _RenderTask, after_frames: Advance) -> tuple[_RenderTask, list[CameraStatistics]]:
    """Write the videos of cameras; a worker process calls this."""
    plan = task.plan
    # Torch renders with one thread, because its rounding depends on the number of threads.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        checks = write_cameras(
            plan,
            renderer=task.renderer,
            cameras=task.cameras,
            folder=task.folder,
            limits=task.limits,
            after_frame=lambda: after_frames(1),
        )
    except OSError as error:
        raise SynthesisError(
            f"{plan.key}: {_cameras(task)} cannot be written to {task.folder}: {error}. "
            f"{cure_of(error, _CURE)} {_AGAIN}"
        ) from error
    finally:
        torch.set_num_threads(threads)
    return task, checks


def _finish(
    work: _Work,
    task: _RenderTask,
    checks: list[CameraStatistics],
    *,
    check: Check,
) -> Refusal | None:
    """Check a rendered scene and move it to its place, or return why it is refused.

    The completion marker is written last. The scene appears whole, by one renaming, once its
    decision says what it had to pass.
    """
    plan, folder = task.plan, task.folder
    refusal = check_pictures(checks, limits=work.limits) or check_files(
        folder, frames=plan.request.frames
    )
    if refusal is not None:
        return refusal
    texts = metadata_texts(
        plan, renderer=work.drawn_by, description=work.renderer.description(plan)
    )
    target = work.out / plan.key
    try:
        for name, text in texts.items():
            (folder / name).write_text(text)
        if check == "audit":
            refusal = check_scene(
                work.out / _TEMPORARY, key=plan.key, unit_m=plan.request.contract.depth_unit_m
            )
            if refusal is not None:
                return refusal
        work.decisions.write(replace(_decided(work, plan.proposal.index), check=check))
        target.parent.mkdir(parents=True, exist_ok=True)
        folder.rename(target)
    except OSError as error:
        raise SynthesisError(
            f"{plan.key}: cannot be completed in {work.out}: {error}. {cure_of(error, _CURE)} "
            f"{_AGAIN}"
        ) from error
    return None


def _clear(out: Path, keys: list[str]) -> None:
    """Remove incomplete scenes, and the folders that are then empty."""
    for key in keys:
        folder = out / _TEMPORARY / key
        shutil.rmtree(folder, ignore_errors=True)
        while folder.parent != out:
            folder = folder.parent
            with suppress(OSError):
                folder.rmdir()
