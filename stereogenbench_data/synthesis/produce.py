"""Synthetic scenes on disk, for `stereogenbench synth`.

Proposals of each scene are examined until one passes. Its scene is rendered into a hidden folder,
checked, and moved to its place when it is complete. An interrupted run leaves no incomplete scenes,
and the next run of the same request goes on with what is missing.
"""

import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import torch

from stereogenbench_data.engine import (
    LOCAL,
    Advance,
    Engine,
    Progress,
    advance_of,
)
from stereogenbench_data.errors import (
    SynthesisError,
    explain_os_errors,
)
from stereogenbench_data.jobs import do_items
from stereogenbench_data.schema.release import CAMERA_COUNT, COMPLETE_JSON
from stereogenbench_data.sources.files import try_locked
from stereogenbench_data.synthesis.filters import Refusal
from stereogenbench_data.synthesis.planning import Planned, plan_scene, propose
from stereogenbench_data.synthesis.proposal import Proposal
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

SearchTask = tuple[SynthRequest, Renderer, int, Sequence[tuple[Proposal, Refusal]]]
"""A request, what draws it, a scene's number, and its proposals that were refused already."""
RenderTask = tuple[ScenePlan, Renderer, tuple[int, ...], Path]
"""A scene, what draws it, some of its cameras, and the folder for their videos."""

FOLDER: Final = ".generation"
"""Where unfinished scenes are drawn, below the root."""


def synthesise(  # noqa: PLR0913 - each names one thing that a user chooses
    out: str | Path,
    request: SynthRequest,
    *,
    renderer: Renderer = RAY_CASTING,
    part: tuple[int, int] = (1, 1),
    workers: int | None = 1,
    engine: Engine = LOCAL,
    progress: Progress | None = None,
    planned: dict[int, Planned] | None = None,
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
        planned: What `plan_scenes` found, so that it is not searched for again. Scenes that fail
            after rendering get another plan there.

    Returns:
        The scenes' keys, by number. Scenes in the holdout are left out.

    Raises:
        SynthesisError: If there is no such part or map, another process draws this part now, a
            scene's folder has other content, a file cannot be written, or all proposals of a scene
            are refused.
        StorageError: If ``workers`` is below 1 or a worker process dies.
    """
    run = _Run(Path(out), request, renderer, workers, engine)
    indices = _of_part(request, part)
    with _disk_errors(run.out):
        there = run.existing(indices)
        missing = [index for index in indices if index not in there]
        if missing:
            planned = {} if planned is None else planned
            planned |= run.search({index: () for index in missing if index not in planned})
            due = {index: planned[index] for index in missing}
            with run.held(part) as unfinished:
                planned |= run.draw(due, unfinished=unfinished, progress=progress, done=len(there))
            there = run.existing(indices)
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
) -> dict[int, Planned]:
    """Search for the plans of the scenes that a tree does not have, without rendering them.

    The arguments are those of `synthesise`; ``progress`` is called with the numbers of scenes.

    Returns:
        What was found, by the scenes' numbers.

    Raises:
        SynthesisError, StorageError: As `synthesise`.
    """
    run = _Run(Path(out), request, renderer, workers, engine)
    indices = _of_part(request, part)
    with _disk_errors(run.out):
        there = run.existing(indices)
        missing = (index for index in indices if index not in there)
        return run.search(dict.fromkeys(missing, ()), progress=progress, done=len(there))


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
        for name in set(request.maps) - set(renderer.maps):
            # The renderer has others, or says what it has.
            alone = replace(request, map_name=name)
            renderer.world(propose(alone, index=0, number=0, renderer=renderer))
        self.out, self.request, self.renderer = out, request, renderer
        self.workers, self.engine = workers, engine
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
        self,
        before: Mapping[int, Sequence[tuple[Proposal, Refusal]]],
        *,
        progress: Progress | None = None,
        done: int = 0,
    ) -> dict[int, Planned]:
        """Return a plan of each scene, given its proposals that were refused before."""
        found: list[Planned] = []
        # To start processes takes longer than a few searches.
        few = len(before) <= _FEW
        do_items(
            _search,
            [(self.request, self.renderer, *each) for each in before.items()],
            name=lambda task: f"scene {task[2]} of {self.request.stream}",
            keep=found.append,
            options={
                "engine": LOCAL if few else self.engine,
                "workers": 1 if few else self.workers,
                "progress": progress,
            },
            done=done,
            total=done + len(before),
        )
        return {each.plan.proposal.index: each for each in found}

    def draw(
        self,
        due: dict[int, Planned],
        *,
        unfinished: Path,
        progress: Progress | None,
        done: int,
    ) -> dict[int, Planned]:
        """Render scenes until each passes its checks, given how many there are already.

        Returns:
            What was found for those whose first plan failed its checks.
        """
        per_scene = CAMERA_COUNT * self.request.frames
        total = (done + len(due)) * per_scene
        advance = advance_of(progress, done=done * per_scene, total=total)
        advance(0)
        refused: dict[int, Refusal] = {}
        others: dict[int, Planned] = {}
        for _ in range(_MOST_RENDERED):
            refused = self._rendered(due, unfinished=unfinished, advance=advance)
            if not refused:
                return others
            # A scene that failed its checks goes on with its next proposal.
            due = self.search(
                {
                    index: [*due[index].refused, (due[index].plan.proposal, refusal)]
                    for index, refusal in refused.items()
                }
            )
            others |= due
        index, last = next(iter(refused.items()))
        raise SynthesisError(
            f"{self.request.stream}: {_MOST_RENDERED} rendered proposals of scene {index} fail "
            f"their checks, the last one with {last.reason} ({last.text}). Check the renderer's "
            f"maps and lights, and the depth's unit."
        )

    def _rendered(
        self,
        planned: Mapping[int, Planned],
        *,
        unfinished: Path,
        advance: Advance,
    ) -> dict[int, Refusal]:
        """Render scenes, move those that pass to their places, and return why others do not."""
        together = self.renderer.cameras_per_task
        tasks: list[RenderTask] = []
        for plan in (planned[index].plan for index in sorted(planned)):
            folder = unfinished / plan.key
            folder.mkdir(parents=True)
            for first in range(0, CAMERA_COUNT, together):
                cameras = tuple(range(first, first + together))
                tasks.append((plan, self.renderer, cameras, folder))
        measured: dict[int, dict[int, Any]] = {index: {} for index in planned}
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
                refusal = check_pictures(measured[index])
                if refusal is None:
                    self._finish(plan, unfinished)
                    continue
                refused[index] = refusal
                shutil.rmtree(unfinished / plan.key)
        return refused

    @contextmanager
    def held(self, part: tuple[int, int]) -> Iterator[Path]:
        """Keep other processes from drawing a part, and yield a folder for its unfinished scenes.

        The file of the lock stays, so that no process can lock a file that another has replaced.
        """
        same = repr((replace(self.request, scenes=1), self.drawn_by)).encode()
        name = f"{hashlib.sha256(same).hexdigest()[:16]}_{part[0]}_of_{part[1]}"
        folder = self.out / FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        with try_locked(folder / f"{name}.lock") as is_free:
            if not is_free:
                raise SynthesisError(
                    f"{folder}: another process is drawing part {part[0]}/{part[1]} of these "
                    f"scenes now. Wait for it, or give each process a --part of its own."
                )
            unfinished = folder / name
            shutil.rmtree(unfinished, ignore_errors=True)
            try:
                yield unfinished
            finally:
                shutil.rmtree(unfinished, ignore_errors=True)

    def _finish(self, plan: ScenePlan, unfinished: Path) -> None:
        """Complete a rendered scene and move it to its place.

        The completion marker is written last, and the scene appears whole, by one renaming.
        """
        folder, target = unfinished / plan.key, self.out / plan.key
        description = self.renderer.description(plan)
        texts = metadata_texts(plan, renderer=self.drawn_by, description=description)
        for name, text in texts.items():
            (folder / name).write_text(text)
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists():  # A run of other parts was faster.
            self._require_own(target, plan.proposal.index)
        else:
            folder.rename(target)


def _search(task: SearchTask, after_scene: Advance) -> Planned:
    """Search for a scene's plan; a worker process calls this."""
    request, renderer, index, before = task
    planned = plan_scene(request, index=index, renderer=renderer, before=before)
    after_scene(1)
    return planned


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


def _of_part(request: SynthRequest, part: tuple[int, int]) -> list[int]:
    number, count = part
    if not 1 <= number <= count:
        raise SynthesisError(
            f"part {number}/{count}: the first number must be from 1 to the second."
        )
    return list(range(number - 1, request.scenes, count))


def _disk_errors(out: Path) -> AbstractContextManager[None]:
    return explain_os_errors(f"{out}: cannot write there", _CURE, kind=SynthesisError)
