"""Synthetic scenes on disk, for `stereogenbench synth`.

Proposals of each scene are examined until one passes. Its scene is rendered into a hidden folder,
checked, and moved to its place when it is complete. An interrupted run leaves no incomplete scenes,
and the next run of the same request goes on with what is missing.
"""

import hashlib
import json
import shutil
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final, Unpack

import numpy as np
import torch
from jaxtyping import Float64

from stereogenbench_data.engine import Advance
from stereogenbench_data.errors import SynthesisError, explain_os_errors
from stereogenbench_data.jobs import WORK_DEFAULTS, WorkOptions, differing, do_items
from stereogenbench_data.schema.release import CAMERA_COUNT, COMPLETE_JSON
from stereogenbench_data.selection.options import require_options
from stereogenbench_data.selection.signatures import list_options
from stereogenbench_data.sources.files import try_locked
from stereogenbench_data.synthesis.filters import Refusal
from stereogenbench_data.synthesis.planning import Planned, plan_scene, propose
from stereogenbench_data.synthesis.proposal import Proposal
from stereogenbench_data.synthesis.render import RAY_CASTING
from stereogenbench_data.synthesis.renderer import Renderer, ScenePlan
from stereogenbench_data.synthesis.request import SynthRequest
from stereogenbench_data.synthesis.scene_files import (
    check_pictures,
    completion_text,
    metadata_texts,
    write_cameras,
)

_MOST_RENDERED: Final = 8
"""How many rendered proposals of one scene may fail their checks."""
_CURE: Final = (
    "Check that the disk has free space and may be written to, then run the same request again: "
    "complete scenes are kept."
)

FOLDER: Final = ".generation"
"""Where unfinished scenes are drawn, below the root."""


@list_options(WORK_DEFAULTS, {"workers": 1})
def synthesise(
    out: str | Path,
    request: SynthRequest,
    *,
    renderer: Renderer = RAY_CASTING,
    part: tuple[int, int] = (1, 1),
    **options: Unpack[WorkOptions],
) -> list[str]:
    """Write scenes in the released layout; keep scenes that the same request wrote before.

    Args:
        out: Root of the tree; created if it does not exist.
        request: The scenes. Scene i does not depend on the number of scenes or of workers.
        renderer: What draws them.
        part: (i, n) writes the i-th of n parts of the scenes, with i from 1. All parts together
            are the same scenes as without parts.
        **options: How it is done; progress is in frames of cameras. Each worker renders one scene
            at a time. There is one unless ``workers`` is given, and this process renders; more
            are spawned, so a script must call this function below ``if __name__ == "__main__"``.

    Returns:
        The scenes' keys, by number.

    Raises:
        SynthesisError: If there is no such part or map, another process draws this part now, a
            scene's folder has other content, a file cannot be written, or all proposals of a scene
            are refused.
        SelectionError: If an option is unknown.
        StorageError: If ``workers`` is below 1 or a worker process dies.
    """
    require_options(synthesise, options)
    tree = _Tree(Path(out), request, renderer)
    indices = _of_part(request, part)
    per_scene = CAMERA_COUNT * request.frames
    with _disk_errors(tree.out):
        there = tree.existing(indices)
        missing = [index for index in indices if index not in there]
        if missing:
            with tree.held(part) as unfinished:
                do_items(
                    partial(tree.draw, unfinished),
                    missing,
                    name=lambda index: f"scene {index} of {request.stream}",
                    options={"workers": 1, **options},
                    done=len(there) * per_scene,
                    total=len(indices) * per_scene,
                )
            there = tree.existing(indices)
    return [there[index] for index in sorted(there)]


@list_options(WORK_DEFAULTS, {"workers": 1})
def plan_scenes(
    out: str | Path,
    request: SynthRequest,
    *,
    renderer: Renderer = RAY_CASTING,
    part: tuple[int, int] = (1, 1),
    **options: Unpack[WorkOptions],
) -> dict[int, Planned]:
    """Search for the plans of the scenes that a tree does not have, without rendering them.

    The arguments are those of `synthesise`; progress is in scenes.

    Returns:
        What was found, by the scenes' numbers.

    Raises:
        SynthesisError, SelectionError, StorageError: As `synthesise`.
    """
    require_options(plan_scenes, options)
    tree = _Tree(Path(out), request, renderer)
    indices = _of_part(request, part)
    found: list[Planned] = []
    with _disk_errors(tree.out):
        there = tree.existing(indices)
        do_items(
            tree.plan,
            [index for index in indices if index not in there],
            name=lambda index: f"scene {index} of {request.stream}",
            keep=found.append,
            options={"workers": 1, **options},
            done=len(there),
            total=len(indices),
        )
    return {each.plan.proposal.index: each for each in found}


@dataclass(frozen=True, slots=True)
class _Tree:
    """The scenes of a request in a tree; it is pickled into worker processes."""

    out: Path
    request: SynthRequest
    renderer: Renderer

    def __post_init__(self) -> None:
        """Refuse maps that the renderer does not have."""
        for name in set(self.request.maps) - set(self.renderer.maps):
            # The renderer has others, or says what it has.
            alone = replace(self.request, map_name=name)
            self.renderer.world(propose(alone, index=0, number=0, renderer=self.renderer))

    @property
    def drawn_by(self) -> str:
        """What the completion marker says of the renderer."""
        return f"{self.renderer.name} {self.renderer.fingerprint}"

    def existing(self, indices: list[int]) -> dict[int, str]:
        """Return the keys of the scenes that the tree has.

        Raises:
            SynthesisError: If another request wrote one of them.
        """
        found: dict[int, str] = {}
        for name in self.request.maps:
            folder = self.out / self.request.folder(name)
            there = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
            for index in indices:
                key = self.request.key(index, map_name=name)
                if key.rpartition("/")[2] in there:
                    self._require_own(self.out / key, index)
                    found[index] = key
        return found

    def _require_own(self, folder: Path, index: int) -> None:
        """Refuse a folder whose completion marker is of no proposal of the scene."""
        differs = f"its {COMPLETE_JSON} is missing or damaged"
        with suppress(OSError, ValueError, KeyError, TypeError, OverflowError):
            found = (folder / COMPLETE_JSON).read_text()
            marker = json.loads(found)
            number = max(0, int(marker["synthesis"]["proposal"]))
            proposal = propose(self.request, index=index, number=number, renderer=self.renderer)
            expected = completion_text(proposal, renderer=self.drawn_by)
            if found == expected:
                return
            # What was asked for comes before what was drawn by it.
            settings = json.loads(expected)["synthesis"]
            for name, theirs, ours in differing(marker["synthesis"], settings):
                differs = f"its {name} is {theirs!r}, and {ours!r} in this one"
                break
            else:
                differs = f"its {COMPLETE_JSON} differs"
        raise SynthesisError(
            f"{folder}: another request wrote this scene ({differs}). Choose another output or "
            f"another map, or move the folder away."
        )

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

    def plan(self, index: int, after_scene: Advance) -> Planned:
        """Search for a scene's plan; a worker process calls this."""
        planned = plan_scene(self.request, index=index, renderer=self.renderer)
        after_scene(1)
        return planned

    def draw(self, unfinished: Path, index: int, after_frames: Advance) -> None:
        """Render proposals of a scene until one passes its checks, and move it to its place.

        A worker process calls this, with the folder of unfinished scenes.
        """
        refused: list[tuple[Proposal, Refusal]] = []
        for _ in range(_MOST_RENDERED):
            plan, before = plan_scene(
                self.request, index=index, renderer=self.renderer, before=refused
            )
            folder = unfinished / plan.proposal.key
            folder.mkdir(parents=True)
            refusal = check_pictures(self._rendered(plan, folder, after_frames))
            if refusal is None:
                self._finish(plan, folder)
                return
            shutil.rmtree(folder)
            # The scene goes on with its next proposal.
            refused = [*before, (plan.proposal, refusal)]
        _, last = refused[-1]
        raise SynthesisError(
            f"{self.request.stream}: {_MOST_RENDERED} rendered proposals of scene {index} fail "
            f"their checks, the last one with {last.reason} ({last.value:.3g}, limit "
            f"{last.limit:.3g}). Check the renderer's maps and lights, and the depth's unit."
        )

    def _rendered(
        self, plan: ScenePlan, folder: Path, after_frames: Advance
    ) -> dict[int, Float64[np.ndarray, "frames 4"]]:
        """Write the videos of all cameras, and return what they show (`write_cameras`)."""
        measured: dict[int, Float64[np.ndarray, "frames 4"]] = {}
        together = self.renderer.cameras_per_task
        # Torch renders with one thread, because its rounding depends on the number of threads.
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            for first in range(0, CAMERA_COUNT, together):
                measured |= write_cameras(
                    plan,
                    renderer=self.renderer,
                    cameras=tuple(range(first, first + together)),
                    folder=folder,
                    after_frame=lambda: after_frames(1),
                )
        finally:
            torch.set_num_threads(threads)
        return measured

    def _finish(self, plan: ScenePlan, folder: Path) -> None:
        """Complete a rendered scene and move it to its place.

        The completion marker is written last, and the scene appears whole, by one renaming.
        """
        target = self.out / plan.proposal.key
        description = self.renderer.description(plan)
        texts = metadata_texts(plan, renderer=self.drawn_by, description=description)
        for name, text in texts.items():
            (folder / name).write_text(text)
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists():  # A run of other parts was faster.
            self._require_own(target, plan.proposal.index)
        else:
            folder.rename(target)


def _of_part(request: SynthRequest, part: tuple[int, int]) -> list[int]:
    number, count = part
    if not 1 <= number <= count:
        raise SynthesisError(
            f"part {number}/{count}: the first number must be from 1 to the second."
        )
    return list(range(number - 1, request.scenes, count))


def _disk_errors(out: Path) -> AbstractContextManager[None]:
    return explain_os_errors(f"{out}: cannot write there", _CURE, kind=SynthesisError)
