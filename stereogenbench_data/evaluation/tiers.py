"""The paper's inference tiers: what a method of each tier is given, and nothing else.

Scores of different tiers answer different questions, so they are never ranked together.

Source: the StereoGenBench paper, section "Benchmark Protocol" and its appendix on inference
conditions.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

from stereogenbench_data.errors import EvaluationError

TierName = Literal["G0", "G1", "G2"]


@dataclass(frozen=True, slots=True)
class Tier:
    """One inference condition.

    Attributes:
        name: "G0", "G1" or "G2".
        meaning: What the tier measures.
        inputs: The fields of a sample (`PAIR_FIELDS`) that a method is given.
    """

    name: TierName
    meaning: str
    inputs: tuple[str, ...]

    def inputs_of(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """Return the fields of a sample that a method of this tier may see."""
        return {name: sample[name] for name in self.inputs}


TIERS: Final[dict[str, Tier]] = {
    "G0": Tier(
        "G0",
        "oracle geometry: rendering and inpainting under known target geometry",
        ("left", "disparity", "warped_right", "hole"),
    ),
    "G1": Tier(
        "G1",
        "calibrated target camera: no depth or disparity",
        ("left", "baseline_m", "intrinsics"),
    ),
    "G2": Tier("G2", "unaligned monocular: the left view alone", ("left",)),
}


def require_tier(name: object) -> Tier:
    """Return a tier by its name.

    Raises:
        EvaluationError: If there is no such tier.
    """
    if not isinstance(name, str) or name not in TIERS:
        known = "; ".join(f"{tier.name} ({tier.meaning})" for tier in TIERS.values())
        raise EvaluationError(f"there is no tier {name!r}: choose one of {known}.")
    return TIERS[name]
