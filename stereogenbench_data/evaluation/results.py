"""What a method scored, pair by pair, and which methods may stand in one table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.aggregate import PairMeans
from stereogenbench_data.evaluation.frechet import FrechetDistance
from stereogenbench_data.evaluation.protocol import EvaluationProtocol
from stereogenbench_data.index.table import SceneIndex

Labels = tuple[str, ...]

CONTROL: Final = "control"
"""The tier of calibration controls."""


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """What one method scored.

    Attributes:
        name: What tables call it.
        tier: "G0", "G1", "G2" or "control".
        protocol: How it was scored.
        settings: The same with every choice of every metric, as plain values.
        index: The index of the scenes.
        pairs: The scores of each pair of each scene.
        distances: Distances between sets, by branch (subset, family), of primary pairs.
    """

    name: str
    tier: str
    protocol: EvaluationProtocol
    settings: Mapping[str, Any]
    index: SceneIndex
    pairs: tuple[PairMeans, ...]
    distances: Mapping[Labels, Mapping[str, FrechetDistance]] = field(default_factory=dict)


def require_comparable(results: Sequence[Scores]) -> None:
    """Refuse to put methods into one table that answer different questions.

    Raises:
        EvaluationError: Naming the first two that differ, and in what.
    """
    if not results:
        raise EvaluationError("a table needs the scores of one method at least, got none.")
    first = results[0]
    for other in results[1:]:
        for what, here, there in (
            ("tier", first.tier, other.tier),
            ("protocol", first.protocol, other.protocol),
            ("data", first.index.digest, other.index.digest),
        ):
            if here != there:
                raise EvaluationError(
                    f"{first.name} and {other.name} cannot share a table: their {what} differs "
                    f"({here} and {there}). Make a table for each."
                )
