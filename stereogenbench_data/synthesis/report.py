"""What became of proposals: acceptance, reasons, realised baselines, focal lengths, motion."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from stereogenbench_data.schema.text import counted
from stereogenbench_data.synthesis.decisions import Decision, Drawn, Motion, all_decisions

ALL_MAPS: Final = "all maps"


@dataclass(frozen=True, slots=True)
class Average:
    """Mean and median of a number."""

    mean: float
    median: float


def _average(values: Sequence[float]) -> Average | None:
    return Average(float(np.mean(values)), float(np.median(values))) if values else None


def _text(average: Average | None, digits: int) -> str:
    return "-" if average is None else f"{average.mean:.{digits}f} / {average.median:.{digits}f}"


@dataclass(frozen=True, slots=True)
class Acceptance:
    """What became of the proposals of one map and family, or of all maps of a family.

    Attributes:
        family: The family of baselines.
        map_name: The map; "all maps" for all.
        proposals: How many were examined.
        accepted: How many passed.
        reasons: How many were refused for each reason, the most frequent first.
        proposed_cm: Gaps between neighbouring cameras of all proposals.
        realised_cm: The same of accepted proposals.
        proposed_mm: Focal lengths of all proposals.
        realised_mm: The same of accepted proposals.
        step_m: Mean way of the fastest camera from frame to frame, of accepted proposals.
        turn_deg: Their mean rotation from frame to frame.
        splices: How many transitions of their paths were replaced.
    """

    family: str
    map_name: str
    proposals: int
    accepted: int
    reasons: dict[str, int]
    proposed_cm: Average | None
    realised_cm: Average | None
    proposed_mm: Average | None
    realised_mm: Average | None
    step_m: Average | None
    turn_deg: Average | None
    splices: int


def report_of(requests: Iterable[tuple[str, Sequence[Decision]]]) -> list[Acceptance]:
    """Return acceptance by family and map, and by family over all its maps.

    Args:
        requests: The family of each request, and its decisions.
    """
    drawn: dict[tuple[str, str], list[Drawn]] = defaultdict(list)
    motions: dict[tuple[str, str], list[Motion]] = defaultdict(list)
    for family, decisions in requests:
        for decision in decisions:
            for each in (*decision.refused, decision.accepted):
                for name in (ALL_MAPS, each.map_name):
                    drawn[family, name].append(each)
            for name in (ALL_MAPS, decision.accepted.map_name):
                motions[family, name].append(decision.motion)
    places = sorted(drawn, key=lambda each: (each[0], each[1] == ALL_MAPS, each[1]))
    return [_acceptance(*place, drawn[place], motions[place]) for place in places]


def report_of_tree(out: Path) -> list[Acceptance]:
    """Return the report of all decisions that a tree keeps.

    Raises:
        SynthesisError: If they cannot be read.
    """
    return report_of((str(asked["family"]), decisions) for asked, decisions in all_decisions(out))


def _acceptance(
    family: str, map_name: str, drawn: list[Drawn], motions: list[Motion]
) -> Acceptance:
    passed = [each for each in drawn if each.refusal is None]
    reasons = Counter(str(each.refusal.reason) for each in drawn if each.refusal is not None)
    return Acceptance(
        family=family,
        map_name=map_name,
        proposals=len(drawn),
        accepted=len(passed),
        reasons=dict(reasons.most_common()),
        proposed_cm=_average([gap for each in drawn for gap in each.gaps_cm]),
        realised_cm=_average([gap for each in passed for gap in each.gaps_cm]),
        proposed_mm=_average([each.focal_mm for each in drawn]),
        realised_mm=_average([each.focal_mm for each in passed]),
        step_m=_average([motion.step_m for motion in motions]),
        turn_deg=_average([motion.turn_deg for motion in motions]),
        splices=sum(motion.splices for motion in motions),
    )


def rows_of(report: Sequence[Acceptance]) -> list[tuple[str, ...]]:
    """Return the report as rows of texts, means and medians; the first row has names."""
    head = (
        "family", "map", "proposals", "accepted", "gaps proposed, cm", "gaps realised, cm",
        "focal proposed, mm", "focal realised, mm", "m a frame", "degrees a frame", "splices",
        "refused for",
    )  # fmt: skip
    body = [
        (
            each.family,
            each.map_name,
            f"{each.proposals:,}",
            f"{each.accepted:,} ({each.accepted / each.proposals:.1%})",
            _text(each.proposed_cm, 1),
            _text(each.realised_cm, 1),
            _text(each.proposed_mm, 1),
            _text(each.realised_mm, 1),
            _text(each.step_m, 3),
            _text(each.turn_deg, 2),
            f"{each.splices:,}",
            ", ".join(f"{reason} {count:,}" for reason, count in each.reasons.items()) or "-",
        )
        for each in report
    ]
    return [head, *body]


def markdown_of(report: Sequence[Acceptance]) -> str:
    """Return the report as a table in Markdown."""
    head, *body = rows_of(report)
    total, passed = (
        sum(getattr(each, name) for each in report if each.map_name == ALL_MAPS)
        for name in ("proposals", "accepted")
    )
    rows = [f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *body)]
    title = (
        "# Proposals and what became of them\n\n"
        f"{counted(total, 'proposal')}, {counted(passed, 'scene')} accepted. Means / medians.\n"
    )
    return "\n".join([title, *rows]) + "\n"


def json_of(report: Sequence[Acceptance]) -> list[dict[str, Any]]:
    """Return the report as values for `json.dumps`."""
    return [asdict(each) for each in report]
