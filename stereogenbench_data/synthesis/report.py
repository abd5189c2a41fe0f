"""What became of proposals: acceptance, reasons, realised baselines, focal lengths, motion."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stereogenbench_data.schema.text import counted
from stereogenbench_data.synthesis.decisions import Decision, Drawn, Motion, all_decisions


@dataclass(frozen=True, slots=True)
class Spread:
    """The distribution of a number."""

    count: int
    least: float
    median: float
    mean: float
    sd: float
    largest: float

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread | None":
        """Return the distribution of values; None if there are none."""
        if not len(values):
            return None
        array = np.array(values, np.float64)
        return cls(
            len(array),
            float(array.min()),
            float(np.median(array)),
            float(array.mean()),
            float(array.std()),
            float(array.max()),
        )


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
    proposed_cm: Spread | None
    realised_cm: Spread | None
    proposed_mm: Spread | None
    realised_mm: Spread | None
    step_m: Spread | None
    turn_deg: Spread | None
    splices: int

    @property
    def share(self) -> float:
        """Share of proposals that were accepted."""
        return self.accepted / self.proposals if self.proposals else 0.0


ALL_MAPS = "all maps"


def report_of(requests: Iterable[tuple[str, Sequence[Decision]]]) -> list[Acceptance]:
    """Return acceptance by family and map, and by family over all its maps.

    Args:
        requests: The family of each request, and its decisions.
    """
    refused: dict[tuple[str, str], list[Drawn]] = {}
    accepted: dict[tuple[str, str], list[tuple[Drawn, Motion]]] = {}
    for family, decisions in requests:
        for decision in decisions:
            for place in (ALL_MAPS, decision.accepted.map_name):
                passed = accepted.setdefault((family, place), [])
                passed.append((decision.accepted, decision.motion))
            for drawn in decision.refused:
                for place in (ALL_MAPS, drawn.map_name):
                    refused.setdefault((family, place), []).append(drawn)
    places = sorted({*refused, *accepted}, key=lambda each: (each[0], each[1] == ALL_MAPS, each[1]))
    return [_acceptance(place, refused.get(place, []), accepted.get(place, [])) for place in places]


def report_of_tree(out: Path) -> list[Acceptance]:
    """Return the report of all decisions that a tree keeps.

    Raises:
        SynthesisError: If they cannot be read.
    """
    return report_of((str(asked["family"]), decisions) for asked, decisions in all_decisions(out))


def _acceptance(
    place: tuple[str, str], refused: list[Drawn], accepted: list[tuple[Drawn, Motion]]
) -> Acceptance:
    passed = [drawn for drawn, _ in accepted]
    motions = [motion for _, motion in accepted]
    everything = [*refused, *passed]
    reasons = Counter(drawn.refusal.reason for drawn in refused if drawn.refusal is not None)
    return Acceptance(
        family=place[0],
        map_name=place[1],
        proposals=len(everything),
        accepted=len(passed),
        reasons={str(reason): count for reason, count in reasons.most_common()},
        proposed_cm=Spread.of([gap for drawn in everything for gap in drawn.gaps_cm]),
        realised_cm=Spread.of([gap for drawn in passed for gap in drawn.gaps_cm]),
        proposed_mm=Spread.of([drawn.focal_mm for drawn in everything]),
        realised_mm=Spread.of([drawn.focal_mm for drawn in passed]),
        step_m=Spread.of([motion.step_m for motion in motions]),
        turn_deg=Spread.of([motion.turn_deg for motion in motions]),
        splices=sum(motion.splices for motion in motions),
    )


_HEAD = (
    "family", "map", "proposals", "accepted", "gaps proposed, cm", "gaps realised, cm",
    "focal proposed, mm", "focal realised, mm", "m a frame", "degrees a frame", "splices",
    "refused for",
)  # fmt: skip


def _median(spread: Spread | None, digits: int) -> str:
    return "-" if spread is None else f"{spread.median:.{digits}f}"


def rows_of(report: Sequence[Acceptance]) -> list[tuple[str, ...]]:
    """Return the report as rows of texts, medians of spreads; the first row has names."""
    rows: list[tuple[str, ...]] = [_HEAD]
    for each in report:
        reasons = ", ".join(f"{reason} {count:,}" for reason, count in each.reasons.items())
        rows.append(
            (
                each.family,
                each.map_name,
                f"{each.proposals:,}",
                f"{each.accepted:,} ({each.share:.1%})",
                _median(each.proposed_cm, 1),
                _median(each.realised_cm, 1),
                _median(each.proposed_mm, 1),
                _median(each.realised_mm, 1),
                _median(each.step_m, 3),
                _median(each.turn_deg, 2),
                f"{each.splices:,}",
                reasons or "-",
            )
        )
    return rows


def markdown_of(report: Sequence[Acceptance]) -> str:
    """Return the report as Markdown: a table by family and map, and one of realised baselines."""
    head, *body = rows_of(report)
    lines = ["# Proposals and what became of them", ""]
    total, passed = (
        sum(getattr(each, name) for each in report if each.map_name == ALL_MAPS)
        for name in ("proposals", "accepted")
    )
    lines += [f"{counted(total, 'proposal')}, {counted(passed, 'scene')} accepted. Medians.", ""]
    lines += [_markdown_row(head), _markdown_row(["---"] * len(head))]
    lines += [_markdown_row(row) for row in body]
    lines += ["", "## Gaps between neighbouring cameras, cm", ""]
    columns = ["family", "map", "", "count", "least", "median", "mean", "sd", "largest"]
    lines += [_markdown_row(columns), _markdown_row(["---"] * len(columns))]
    for each in report:
        for name, spread in (("proposed", each.proposed_cm), ("realised", each.realised_cm)):
            if spread is not None:
                count, *figures = asdict(spread).values()
                lines.append(
                    _markdown_row(
                        [each.family, each.map_name, name, f"{count:,}"]
                        + [f"{figure:.2f}" for figure in figures]
                    )
                )
    return "\n".join(lines) + "\n"


def _markdown_row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def json_of(report: Sequence[Acceptance]) -> list[dict[str, Any]]:
    """Return the report as values for `json.dumps`."""
    return [asdict(each) | {"share": each.share} for each in report]
