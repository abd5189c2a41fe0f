"""What was decided about proposals, on disk beside the scenes, so that a stopped run goes on.

    OUT/.generation/<request>/request.json       what was asked for, and of which renderer
    OUT/.generation/<request>/scene_000012.json  what scene 12 refused, and what it accepted
    OUT/.generation/<folder>.1_of_2.lock         a process is drawing this part of a map's scenes

Each file is written whole or not at all, and by one machine: the parts of a request share a folder.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from stereogenbench_data.errors import SynthesisError, cure_of
from stereogenbench_data.geometry.pose import rotation_from_rotator_deg
from stereogenbench_data.jobs import json_bytes, read_json
from stereogenbench_data.sources.files import write_atomic
from stereogenbench_data.synthesis.filters import Limits, ProposedRig, Refusal
from stereogenbench_data.synthesis.plan import ScenePlan
from stereogenbench_data.synthesis.planning import PlanSearch
from stereogenbench_data.synthesis.proposal import Proposal
from stereogenbench_data.synthesis.renderer import Renderer
from stereogenbench_data.synthesis.request import SynthRequest
from stereogenbench_data.synthesis.trajectory import steps

FOLDER: Final = ".generation"
_REQUEST: Final = "request.json"
Check = Literal["pictures", "audit"]
"""What rendered scenes must pass."""

_VERSION: Final = 2
"""Raise it when the same request comes to other decisions."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """What reports show of a proposal.

    Attributes:
        number: The proposal's number among those of its scene.
        map_name: Its map.
        character: Its subject.
        animation: Its motion.
        focal_mm: Its focal length.
        gaps_cm: The five gaps between neighbouring cameras.
        refusal: Why it was refused; None if it was accepted.
    """

    number: int
    map_name: str
    character: str
    animation: str
    focal_mm: float
    gaps_cm: tuple[float, ...]
    refusal: Refusal | None

    @classmethod
    def of(cls, proposal: Proposal, refusal: Refusal | None) -> "Drawn":
        """Return what reports show of a proposal."""
        return cls(
            number=proposal.number,
            map_name=proposal.map_name,
            character=proposal.character,
            animation=proposal.animation,
            focal_mm=proposal.focal_mm,
            gaps_cm=tuple(np.diff(proposal.places_cm).tolist()),
            refusal=refusal,
        )


@dataclass(frozen=True, slots=True)
class Motion:
    """How the cameras of an accepted proposal move.

    Attributes:
        step_m: Mean way of the fastest camera from frame to frame.
        turn_deg: Mean rotation from frame to frame.
        largest_step_m: The largest such way.
        largest_turn_deg: The largest such rotation.
        splices: How often a part of the path was thrown away and connected anew.
    """

    step_m: float
    turn_deg: float
    largest_step_m: float
    largest_turn_deg: float
    splices: int

    @classmethod
    def of(cls, plan: ScenePlan) -> "Motion":
        """Return the motion of a plan."""
        axes = rotation_from_rotator_deg(plan.rotators_deg)
        step_m, turn_deg = steps(ProposedRig.of(plan.proposal).eyes(plan.centres_m, axes), axes)
        if not len(step_m):
            return cls(0.0, 0.0, 0.0, 0.0, plan.splices)
        return cls(
            float(step_m.mean()),
            float(turn_deg.mean()),
            float(step_m.max()),
            float(turn_deg.max()),
            plan.splices,
        )


@dataclass(frozen=True, slots=True)
class Decision:
    """All proposals of one scene up to the accepted one.

    Attributes:
        index: The scene's number.
        refused: The proposals that were refused, in order.
        accepted: The one that was not.
        motion: How its cameras move.
        check: What its pictures had to pass; "" as long as none were drawn.
    """

    index: int
    refused: tuple[Drawn, ...]
    accepted: Drawn
    motion: Motion
    check: Check | Literal[""] = ""

    @classmethod
    def of(
        cls,
        search: PlanSearch,
        *,
        before: tuple[Drawn, ...] = (),
        check: Check | Literal[""] = "",
    ) -> "Decision":
        """Return the decision of a search, given what was refused before it by what check."""
        plan = search.plan
        refused = [Drawn.of(each.proposal, each.refusal) for each in search.refused]
        return cls(
            index=plan.proposal.index,
            refused=(*before, *refused),
            accepted=Drawn.of(plan.proposal, None),
            motion=Motion.of(plan),
            check=check,
        )


@dataclass(frozen=True, slots=True)
class Decisions:
    """The decisions of one request.

    Attributes:
        folder: Where they lie.
        asked: The request, as reports show it.
    """

    folder: Path
    asked: dict[str, Any]

    @classmethod
    def at(
        cls, out: Path, request: SynthRequest, *, renderer: Renderer, limits: Limits
    ) -> "Decisions":
        """Return the decisions of a request in a tree. Scenes can be added to a request."""
        asked = {
            "version": _VERSION,
            "family": request.family,
            "split": request.split,
            "subset": request.subset,
            "maps": list(request.maps),
            "seed": request.seed,
            "frames": request.frames,
            "picture_px": list(request.picture_px),
            "focal_mm": request.focal_mm,
            "world_offset_cm": request.world_offset_cm,
            "sensors_mm": [list(sensor_mm) for sensor_mm in renderer.sensors_mm],
            "renderer": renderer.name,
            "fingerprint": renderer.fingerprint,
            "limits": asdict(limits),
        }
        digest = hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()
        return cls(out / FOLDER / f"{request.family}_{digest[:16]}", asked)

    def read(self, index: int) -> Decision | None:
        """Return a scene's decision; None if there is none, or it was cut short."""
        return _read(self._path(index))

    def write(self, decision: Decision) -> None:
        """Write a scene's decision.

        Raises:
            SynthesisError: If it cannot be written.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if not (self.folder / _REQUEST).exists():
                write_atomic(self.folder / _REQUEST, json_bytes(self.asked))
            write_atomic(self._path(decision.index), json_bytes(asdict(decision)))
        except OSError as error:
            raise SynthesisError(
                f"{self.folder}: cannot write there ({error}). "
                + cure_of(error, "Choose an output that you may write to.")
            ) from error

    def remove(self, indices: Iterable[int]) -> None:
        """Remove the decisions on scenes, and the folders if they hold nothing else.

        What cannot be removed stays.
        """
        with suppress(OSError):
            for index in indices:
                self._path(index).unlink(missing_ok=True)
            if not any(self.folder.glob("scene_*.json")):
                (self.folder / _REQUEST).unlink(missing_ok=True)
                self.folder.rmdir()
                self.folder.parent.rmdir()

    def require_check(self, check: Check) -> None:
        """Refuse another check than the one that the request's scenes passed so far.

        Raises:
            SynthesisError: If there is a scene that had to pass another one.
        """
        for path in sorted(self.folder.glob("scene_*.json")):
            decision = _read(path)
            if decision is not None and decision.check not in ("", check):
                raise SynthesisError(
                    f"{path}: this scene had to pass the check {decision.check!r}, and others of "
                    f"the same request would have to pass {check!r}. Give the check "
                    f"{decision.check!r} again, or choose another output."
                )

    def _path(self, index: int) -> Path:
        return self.folder / f"scene_{index:06d}.json"


def all_decisions(out: Path) -> Iterator[tuple[dict[str, Any], list[Decision]]]:
    """Yield each request that a tree has decisions of, with its decisions."""
    for folder in sorted((out / FOLDER).glob("*/")):
        try:
            asked = json.loads((folder / _REQUEST).read_text())
            texts = [path.read_text() for path in sorted(folder.glob("scene_*.json"))]
            yield asked, [_parsed(json.loads(text)) for text in texts]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise SynthesisError(
                f"{folder}: its decisions cannot be read ({error!r}). Remove this folder: the next "
                f"run of the same request comes to the same decisions."
            ) from error


def _read(path: Path) -> Decision | None:
    with suppress(OSError, ValueError, KeyError, TypeError):
        return _parsed(read_json(path))
    return None


def _parsed(document: Any) -> Decision:
    return Decision(
        index=int(document["index"]),
        refused=tuple(_drawn(each) for each in document["refused"]),
        accepted=_drawn(document["accepted"]),
        motion=Motion(**document["motion"]),
        check=document.get("check", ""),
    )


def _drawn(document: Any) -> Drawn:
    refusal = document["refusal"]
    return Drawn(
        **document
        | {
            "gaps_cm": tuple(map(float, document["gaps_cm"])),
            "refusal": None if refusal is None else Refusal(**refusal),
        }
    )
