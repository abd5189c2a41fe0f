"""Synthetic scenes on disk, for `stereogenbench synth`.

Proposals of each scene are examined until one passes. Its scene is rendered into a hidden folder,
checked, and moved to its place when it is complete. An interrupted run leaves no incomplete scenes,
and the next run of the same request goes on with what is missing.
"""

import json
import shutil
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import torch

from stereogenbench_data.audit.contract.doctor import diagnose
from stereogenbench_data.audit.geometry.audit import AuditRequest, audit, open_for_audit
from stereogenbench_data.engine import (
    LOCAL,
    Advance,
    Engine,
    Progress,
    advance_of,
    require_workers,
)
from stereogenbench_data.errors import (
    StereoGenBenchError,
    StorageError,
    SynthesisError,
    explain_os_errors,
)
from stereogenbench_data.index.open import warn_if_stale
from stereogenbench_data.jobs import do_items
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.schema.release import CAMERA_COUNT, COMPLETE_JSON
from stereogenbench_data.sources.files import try_locked
from stereogenbench_data.synthesis.decisions import Decision, Decisions, Drawn
from stereogenbench_data.synthesis.filters import Refusal
from stereogenbench_data.synthesis.planning import plan_scene, propose
from stereogenbench_data.synthesis.render import RAY_CASTING
from stereogenbench_data.synthesis.renderer import Renderer, ScenePlan
from stereogenbench_data.synthesis.request import SynthRequest
from stereogenbench_data.synthesis.review import HOLDOUT
from stereogenbench_data.synthesis.scene_files import (
    check_pictures,
    completion_text,
    metadata_texts,
    write_cameras,
)

_FEW: Final = 4
_MOST_RENDERED: Final = 8
"""How many rendered proposals of one scene may fail their checks."""
_CURE: Final = (
    "Check that the disk has free space and may be written to, then run the same request again: "
    "complete scenes are kept."
)

SearchTask = tuple[SynthRequest, Renderer, int, int]
"""A request, what draws it, a scene's number, and the proposal to begin with."""
RenderTask = tuple[ScenePlan, Renderer, tuple[int, ...], Path]
"""A scene, what draws it, some of its cameras, and the folder for their videos."""


def synthesise(  # noqa: PLR0913 - each names one thing that a user chooses
    out: str | Path,
    request: SynthRequest,
    *,
    renderer: Renderer = RAY_CASTING,
    part: tuple[int, int] = (1, 1),
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
        workers: The number of processes; each renders one camera of one scene at a time. With 1,
            this process renders; None is one a core. More are spawned, so a script must call
            this function below ``if __name__ == "__main__"``.
        engine: Where the processes run: `engine.LOCAL`, or an `engine.RayCluster`.
        progress: Called repeatedly with the numbers of camera frames rendered so far and in total.

    Returns:
        The scenes' keys, by number. Scenes in the holdout are left out.

    Raises:
        SynthesisError: If ``workers`` is below 1, there is no such part or map, another process
            draws this part now, a scene's folder has other content, a file cannot be written, all
            proposals of a scene are refused, or a worker process dies.
    """
    run = _Run(Path(out), request, renderer, workers, engine)
    indices = _of_part(request, part)
    with _as_synthesis_error(run.out):
        there = run.existing(indices)
        missing = [index for index in indices if index not in there]
        if missing:
            with _held(run.decisions.folder, part) as unfinished:
                run.draw(missing, unfinished=unfinished, progress=progress, done=len(there))
            there = run.existing(indices)
    warn_if_stale(run.out)
    return [key for _, key in sorted(there.items()) if key is not None]


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
    that are kept; ``progress`` is called with the numbers of scenes.

    Returns:
        The decisions by the scenes' numbers.

    Raises:
        SynthesisError: As `synthesise`.
    """
    run = _Run(Path(out), request, renderer, workers, engine)
    indices = _of_part(request, part)
    with _as_synthesis_error(run.out):
        run.existing(indices)
        read = {index: run.decisions.read(index) for index in indices}
        known = {index: each for index, each in read.items() if each and each.is_accepted}
        missing = [index for index in indices if index not in known]
        found = run.search(missing, progress=progress, done=len(known))
    decided = known | {index: decision for index, (decision, _) in found.items()}
    return [decided[index] for index in indices]


class _Run:
    """One run of a request in a tree."""

    def __init__(
        self,
        out: Path,
        request: SynthRequest,
        renderer: Renderer,
        workers: int | None,
        engine: Engine,
    ) -> None:
        with _as_synthesis_error(out):
            require_workers(workers)
        for name in set(request.maps) - set(renderer.maps):
            # The renderer has others, or says what it has.
            alone = replace(request, map_name=name)
            renderer.world(propose(alone, index=0, number=0, renderer=renderer))
        self.out, self.request, self.renderer = out, request, renderer
        self.workers, self.engine = workers, engine
        self.decisions = Decisions(out, request, renderer=renderer)
        self.drawn_by = f"{renderer.name} {renderer.fingerprint}"

    def existing(self, indices: list[int]) -> dict[int, str | None]:
        """Return the keys of the scenes that the tree has; None for those in the holdout.

        Raises:
            SynthesisError: If another request wrote one of them.
        """
        found: dict[int, str | None] = {}
        for root in (self.out / HOLDOUT, self.out):
            for name in self.request.maps:
                folder = root / self.request.folder(name)
                there = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
                for index in indices:
                    key = self.request.key(index, map_name=name)
                    if key.rpartition("/")[2] in there:
                        self._require_own(root / key, index)
                        found[index] = key if root == self.out else None
        return found

    def _require_own(self, folder: Path, index: int) -> None:
        """Refuse a folder whose completion marker is of no proposal of the scene."""
        with suppress(OSError, ValueError, KeyError, TypeError, OverflowError):
            found = (folder / COMPLETE_JSON).read_text()
            number = max(0, int(json.loads(found)["synthesis"]["proposal"]))
            proposal = propose(self.request, index=index, number=number, renderer=self.renderer)
            if found == completion_text(proposal, renderer=self.drawn_by):
                return
        raise SynthesisError(
            f"{folder}: another request wrote this scene (its {COMPLETE_JSON} differs or is "
            f"missing). Choose another output or another map, or move the folder away."
        )

    def search(
        self, indices: list[int], *, progress: Progress | None = None, done: int = 0
    ) -> dict[int, tuple[Decision, ScenePlan]]:
        """Return a plan of each scene, after the proposals refused before, and keep decisions."""
        before = {index: self.decisions.read(index) for index in indices}
        refused = {index: each.refused if each else [] for index, each in before.items()}
        found = {}

        def keep(result: tuple[ScenePlan, list[Drawn]]) -> None:
            plan, others = result
            index = plan.proposal.index
            decision = Decision.of(plan, [*refused[index], *others])
            self.decisions.write(decision)
            found[index] = decision, plan

        # To start processes takes longer than a few searches.
        few = len(indices) <= _FEW
        do_items(
            _search,
            [(self.request, self.renderer, each, len(refused[each])) for each in indices],
            name=lambda task: f"scene {task[2]} of {self.request.stream}",
            keep=keep,
            engine=LOCAL if few else self.engine,
            workers=1 if few else self.workers,
            progress=progress,
            done=done,
            total=done + len(indices),
        )
        return found

    def draw(
        self, missing: list[int], *, unfinished: Path, progress: Progress | None, done: int
    ) -> None:
        """Render scenes until each passes its checks, given how many there are already."""
        per_scene = CAMERA_COUNT * self.request.frames
        total = (done + len(missing)) * per_scene
        advance = advance_of(progress, done=done * per_scene, total=total)
        advance(0)
        refused: dict[int, Refusal] = {}
        for _ in range(_MOST_RENDERED):
            refused = self._rendered(self.search(missing), unfinished=unfinished, advance=advance)
            # A scene that failed its checks goes on with its next proposal.
            missing = sorted(refused)
            if not missing:
                return
        index, last = next(iter(refused.items()))
        raise SynthesisError(
            f"{self.request.stream}: {_MOST_RENDERED} rendered proposals of scene {index} fail "
            f"their checks, the last one with {last.reason} ({last.text}). Check the renderer's "
            f"maps and lights, and the depth's unit."
        )

    def _rendered(
        self,
        found: dict[int, tuple[Decision, ScenePlan]],
        *,
        unfinished: Path,
        advance: Advance,
    ) -> dict[int, Refusal]:
        """Render scenes, move those that pass to their places, and return why others do not."""
        together = self.renderer.cameras_per_task
        tasks: list[RenderTask] = []
        for _, (_, plan) in sorted(found.items()):
            folder = unfinished / plan.key
            folder.mkdir(parents=True)
            for first in range(0, CAMERA_COUNT, together):
                cameras = tuple(range(first, first + together))
                tasks.append((plan, self.renderer, cameras, folder))
        measured: dict[int, dict[int, Any]] = {index: {} for index in found}
        refused: dict[int, Refusal] = {}
        rendered = self.engine.map(
            _render,
            tasks,
            name=lambda task: f"{task[0].key}, camera {', '.join(map(str, task[2]))}",
            workers=self.workers,
            advance=advance,
        )
        with closing(rendered):
            for plan, rows in rendered:
                index = plan.proposal.index
                measured[index] |= rows
                if len(measured[index]) < CAMERA_COUNT:
                    continue
                refusal = check_pictures(measured[index]) or self._finish(plan, unfinished)
                if refusal is not None:
                    refused[index] = refusal
                    decision, _ = found[index]
                    last = replace(decision.proposals[-1], refusal=replace(refusal, rendered=True))
                    self.decisions.write(replace(decision, proposals=[*decision.refused, last]))
                    shutil.rmtree(unfinished / plan.key)
        return refused

    def _finish(self, plan: ScenePlan, unfinished: Path) -> Refusal | None:
        """Complete a rendered scene and move it to its place, or return why it is refused.

        The completion marker is written last, and the scene appears whole, by one renaming.
        """
        folder, target = unfinished / plan.key, self.out / plan.key
        description = self.renderer.description(plan)
        texts = metadata_texts(plan, renderer=self.drawn_by, description=description)
        for name, text in texts.items():
            (folder / name).write_text(text)
        refusal = _audited(unfinished, plan) if self.request.check == "audit" else None
        if refusal is None:
            target.parent.mkdir(parents=True, exist_ok=True)
            if target.exists():  # A run of other parts was faster.
                self._require_own(target, plan.proposal.index)
            else:
                folder.rename(target)
        return refusal


def _search(task: SearchTask, after_scene: Advance) -> tuple[ScenePlan, list[Drawn]]:
    """Search for a scene's plan; a worker process calls this."""
    request, renderer, index, first = task
    plan, refused = plan_scene(request, index=index, renderer=renderer, first=first)
    after_scene(1)
    return plan, [Drawn.of(proposal, refusal) for proposal, refusal in refused]


def _render(task: RenderTask, after_frames: Advance) -> tuple[ScenePlan, dict[int, Any]]:
    """Write the videos of cameras; a worker process calls this."""
    plan, renderer, cameras, folder = task
    # Torch renders with one thread, because its rounding depends on the number of threads.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return plan, write_cameras(
            plan,
            renderer=renderer,
            cameras=cameras,
            folder=folder,
            after_frame=lambda: after_frames(1),
        )
    finally:
        torch.set_num_threads(threads)


def _audited(root: Path, plan: ScenePlan) -> Refusal | None:
    """Return what the audit or the doctor finds in a complete scene below a root, if anything."""
    depth = DepthEncoding(unit_m=plan.request.contract.depth_unit_m)
    scenes = (plan.key,)
    try:
        index = open_for_audit(root, workers=1, scenes=scenes)
        report = audit(index, AuditRequest(depth=depth), workers=1, scenes=scenes)
        diagnosis = diagnose(index, scenes=1, depth=depth, workers=1, filters={"scenes": scenes})
    except StereoGenBenchError as error:
        return Refusal("audit", 1, 0, str(error))
    if report.findings:
        first = report.findings[0]
        text = f"{first.member}: {first.check}: {first.found}"
        return Refusal("audit", len(report.findings), 0, text)
    if diagnosis.is_wrong:
        problems = [text for verdict in diagnosis.verdicts for text in verdict.problems]
        return Refusal("doctor", len(problems), 0, "; ".join(problems))
    return None


def _of_part(request: SynthRequest, part: tuple[int, int]) -> list[int]:
    number, count = part
    if not 1 <= number <= count:
        raise SynthesisError(
            f"part {number}/{count}: the first number must be from 1 to the second."
        )
    return list(range(number - 1, request.scenes, count))


@contextmanager
def _held(folder: Path, part: tuple[int, int]) -> Iterator[Path]:
    """Keep other processes from drawing a part, and yield a folder for its unfinished scenes.

    The file of the lock stays, so that no process can lock a file that another has replaced.
    """
    name = "{}_of_{}".format(*part)
    folder.mkdir(parents=True, exist_ok=True)
    with try_locked(folder / f"{name}.lock") as is_free:
        if not is_free:
            raise SynthesisError(
                f"{folder}: another process is drawing part {part[0]}/{part[1]} of these scenes "
                f"now. Wait for it, or give each process a --part of its own."
            )
        unfinished = folder / name
        shutil.rmtree(unfinished, ignore_errors=True)
        try:
            yield unfinished
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)


@contextmanager
def _as_synthesis_error(out: Path) -> Iterator[None]:
    """Raise errors of engines and of the disk as those of synthesis."""
    with explain_os_errors(f"{out}: cannot write there", _CURE, kind=SynthesisError):
        try:
            yield
        except StorageError as error:
            raise SynthesisError(str(error)) from error
