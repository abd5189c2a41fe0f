"""What was decided about proposals: on disk beside the scenes, and as a report.

    OUT/.generation/<request>/request.json       what was asked for, and of which renderer
    OUT/.generation/<request>/scene_000012.json  what scene 12 refused, and what it accepted
    OUT/.generation/<request>/1_of_2.lock        locked by the process that draws this part

Each file is written whole or not at all, and by one machine: the parts of a request share a folder.
A stopped run goes on from its decisions.
"""

import hashlib
import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from stereogenbench_data.errors import SynthesisError
from stereogenbench_data.jobs import json_bytes, read_json
from stereogenbench_data.sources.files import write_atomic
from stereogenbench_data.synthesis.filters import LIMITS, Refusal
from stereogenbench_data.synthesis.proposal import Proposal
from stereogenbench_data.synthesis.renderer import Renderer, ScenePlan
from stereogenbench_data.synthesis.request import SynthRequest

FOLDER: Final = ".generation"
ALL_MAPS: Final = "all maps"
_REQUEST: Final = "request.json"
_VERSION: Final = 3
"""Raise it when the same request comes to other decisions."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """What reports show of a proposal.

    Attributes:
        number: The proposal's number among those of its scene.
        map_name: Its map.
        focal_mm: Its focal length.
        gaps_cm: The five gaps between neighbouring cameras.
        refusal: Why it was refused; None if it was accepted.
    """

    number: int
    map_name: str
    focal_mm: float
    gaps_cm: list[float]
    refusal: Refusal | None

    @classmethod
    def of(cls, proposal: Proposal, refusal: Refusal | None) -> "Drawn":
        """Return what reports show of a proposal."""
        return cls(
            number=proposal.number,
            map_name=proposal.map_name,
            focal_mm=proposal.focal_mm,
            gaps_cm=np.diff(proposal.places_cm).tolist(),
            refusal=refusal,
        )


@dataclass(frozen=True, slots=True)
class Decision:
    """The proposals of one scene up to the accepted one.

    Attributes:
        index: The scene's number.
        proposals: The proposals in order. The last was accepted, unless what was rendered of it
            was refused and its successor is not found yet.
        step_m: Mean way of the fastest camera of the last one from frame to frame.
        turn_deg: Its mean rotation from frame to frame.
        splices: How often a part of its path was thrown away and connected anew.
    """

    index: int
    proposals: list[Drawn]
    step_m: float
    turn_deg: float
    splices: int

    @classmethod
    def of(cls, plan: ScenePlan, refused: list[Drawn]) -> "Decision":
        """Return the decision for a plan, after the proposals that were refused before it."""
        step_m, turn_deg = (float(each.mean()) if len(each) else 0.0 for each in plan.steps())
        accepted = Drawn.of(plan.proposal, None)
        return cls(plan.proposal.index, [*refused, accepted], step_m, turn_deg, plan.splices)

    @property
    def refused(self) -> list[Drawn]:
        """The proposals that were refused."""
        return [each for each in self.proposals if each.refusal is not None]

    @property
    def is_accepted(self) -> bool:
        """Whether the last proposal was accepted."""
        return self.proposals[-1].refusal is None


class Decisions:
    """The decisions of one request.

    Attributes:
        folder: Where they lie.
        asked: The request, as reports show it.
    """

    def __init__(self, out: Path, request: SynthRequest, *, renderer: Renderer) -> None:
        """Name the folder of a request's decisions in a tree. Scenes can be added to a request."""
        self.asked = asdict(request) | {
            "version": _VERSION,
            "maps": request.maps,
            "sensors_mm": renderer.sensors_mm,
            "renderer": renderer.name,
            "fingerprint": renderer.fingerprint,
            "limits": asdict(LIMITS),
        }
        for name in ("scenes", "map_name", "contract"):  # No decision depends on them.
            del self.asked[name]
        digest = hashlib.sha256(json.dumps(self.asked, sort_keys=True).encode()).hexdigest()
        self.folder = out / FOLDER / f"{request.family}_{digest[:16]}"

    def read(self, index: int) -> Decision | None:
        """Return a scene's decision; None if there is none, or it was cut short."""
        with suppress(OSError, ValueError, KeyError, TypeError):
            return _parsed(read_json(self._path(index)))
        return None

    def write(self, decision: Decision) -> None:
        """Write a scene's decision."""
        self.folder.mkdir(parents=True, exist_ok=True)
        if not (self.folder / _REQUEST).exists():
            write_atomic(self.folder / _REQUEST, json_bytes(self.asked))
        write_atomic(self._path(decision.index), json_bytes(asdict(decision)))

    def _path(self, index: int) -> Path:
        return self.folder / f"scene_{index:06d}.json"


def all_decisions(out: Path) -> Iterator[tuple[str, list[Decision]]]:
    """Yield the family of each request that a tree has decisions of, with its decisions.

    Raises:
        SynthesisError: If they cannot be read.
    """
    for folder in sorted((out / FOLDER).glob("*/")):
        try:
            decisions = [_parsed(read_json(path)) for path in sorted(folder.glob("scene_*.json"))]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise SynthesisError(
                f"{folder}: its decisions cannot be read ({error!r}). Remove this folder: the next "
                f"run of the same request comes to the same decisions."
            ) from error
        yield folder.name.rpartition("_")[0], decisions


def _parsed(document: dict[str, Any]) -> Decision:
    proposals = [
        Drawn(**each | {"refusal": each["refusal"] and Refusal(**each["refusal"])})
        for each in document["proposals"]
    ]
    return Decision(**document | {"proposals": proposals})


# The report.


def report_of(requests: Iterable[tuple[str, Sequence[Decision]]]) -> list[dict[str, Any]]:
    """Return what became of proposals, by family and map, and by family over all its maps.

    Args:
        requests: The family of each request, and its decisions.

    Returns:
        Rows for JSON: the numbers of proposals and accepted ones, how many were refused for each
        reason, and mean and median of gaps (cm) and focal lengths (mm), proposed and realised, and
        of the accepted cameras' motion a frame (m and degrees).
    """
    groups: dict[tuple[str, str], list[tuple[Decision, Drawn]]] = defaultdict(list)
    for family, decisions in requests:
        for decision in decisions:
            for drawn in decision.proposals:
                for name in (ALL_MAPS, drawn.map_name):
                    groups[family, name].append((decision, drawn))
    rows = []
    for family, name in sorted(groups, key=lambda each: (each[0], each[1] == ALL_MAPS, each[1])):
        proposed = [drawn for _, drawn in groups[family, name]]
        passed = [pair for pair in groups[family, name] if pair[1].refusal is None]
        reasons = Counter(str(each.refusal.reason) for each in proposed if each.refusal)
        rows.append(
            {
                "family": family,
                "map_name": name,
                "proposals": len(proposed),
                "accepted": len(passed),
                "reasons": dict(reasons.most_common()),
                "proposed_cm": _average([gap for each in proposed for gap in each.gaps_cm]),
                "realised_cm": _average([gap for _, each in passed for gap in each.gaps_cm]),
                "proposed_mm": _average([each.focal_mm for each in proposed]),
                "realised_mm": _average([each.focal_mm for _, each in passed]),
                "step_m": _average([decision.step_m for decision, _ in passed]),
                "turn_deg": _average([decision.turn_deg for decision, _ in passed]),
                "splices": sum(decision.splices for decision, _ in passed),
            }
        )
    return rows


def _average(values: Sequence[float]) -> dict[str, float] | None:
    if not values:
        return None
    return {"mean": float(np.mean(values)), "median": float(np.median(values))}


_COLUMNS: Final = {
    "proposed_cm": ("gaps proposed, cm", 1),
    "realised_cm": ("gaps realised, cm", 1),
    "proposed_mm": ("focal proposed, mm", 1),
    "realised_mm": ("focal realised, mm", 1),
    "step_m": ("m a frame", 3),
    "turn_deg": ("degrees a frame", 2),
}
"""The heading of each average, and its digits."""


def report_markdown(report: Sequence[dict[str, Any]]) -> str:
    """Return the report as an aligned table in Markdown; averages are means / medians."""
    headings = [heading for heading, _ in _COLUMNS.values()]
    rows = [["family", "map", "proposals", "accepted", *headings, "splices", "refused for"]]
    for each in report:
        averages = [
            f"{each[name]['mean']:.{digits}f} / {each[name]['median']:.{digits}f}"
            if each[name]
            else "-"
            for name, (_, digits) in _COLUMNS.items()
        ]
        reasons = ", ".join(f"{reason} {count:,}" for reason, count in each["reasons"].items())
        accepted = f"{each['accepted']:,} ({each['accepted'] / each['proposals']:.1%})"
        rows.append(
            [
                each["family"], each["map_name"], f"{each['proposals']:,}", accepted,
                *averages, f"{each['splices']:,}", reasons or "-",
            ]
        )  # fmt: skip
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    rows.insert(1, ["-" * width for width in widths])
    return "".join(f"| {' | '.join(map(str.ljust, row, widths))} |\n" for row in rows)
