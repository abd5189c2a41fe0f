"""What one scene's pictures say about its depth contract."""

import math
from dataclasses import dataclass, field
from typing import Any, Final

from stereogenbench_data.audit.contract_cameras import CameraCheck
from stereogenbench_data.audit.contract_fit import Free
from stereogenbench_data.audit.contract_hypotheses import Question, Structure
from stereogenbench_data.audit.contract_scoring import Pair
from stereogenbench_data.audit.contract_statistics import Evidence

LEAST_LOG_SCALE: Final = 0.01
"""A unit that is off by less is not called wrong."""
BIAS_PX: Final = 0.1
"""By how much disparity may be off however many pixels agree: interpolation on small pictures."""
LEAST_OFFSET_PX: Final = 0.3
_NOTHING: Final = Evidence(math.nan, math.inf)


@dataclass(frozen=True, slots=True)
class Rival:
    """Another answer to one question, all else as in the best contract but for the scale.

    ``behind`` is by how much the best contract is better.
    """

    question: Question
    answer: Any
    behind: Evidence


@dataclass(frozen=True, slots=True)
class SceneDiagnosis:
    """What one scene's pictures say about its depth contract.

    Attributes:
        key: The scene.
        views: How many views (a pair in a frame) were compared.
        pairs: The pairs.
        matches: Pixels that were found in both pictures of a view.
        textured: Pixels that were looked for.
        unit_m: The declared unit of the primary pair's left depth, in metres.
        unit_source: Where it comes from: "tag", "default", "user" or "unreadable".
        focal_ratios: In words, other readings of focal length and sensor, and what disparity
            each gives over that of the width; those that give the same are left out.
        recorded_pair: The primary pair as it is recorded, if its left camera stands to the right
            of the other by the poses; None if it does not.
        declared: The declared answers.
        best: The answers of the best contract.
        changed: What else the best contract changes: the scale, the offset, or both.
        scale: Found over declared disparity, fitted with the best contract's answers.
        scale_error: Standard error of log(scale).
        other_kind_scale: Scale with the other kind of depth, all else as in the best contract.
        offsets_px: Constant disparity of each pair at the best contract.
        gain: By how much the best contract beats the declared one.
        parallax: By how much it beats no disparity at all.
        agreement: Share of the matches of neighbouring cameras that the best contract explains.
        rivals: The other answers.
        equals: Contracts with as few changes that are not clearly worse, in words.
        disparity_px: Root mean square of the disparities found.
        spread_px: Root mean square of the same, less the mean of each view.
        depth_step: How far apart neighbouring stored depths lie, as a share.
        check: What the best contract leaves to explain, camera by camera.
        problem: Why nothing could be told; empty where something could.
    """

    key: str
    views: int
    pairs: tuple[Pair, ...]
    matches: int
    textured: int
    unit_m: float
    unit_source: str
    focal_ratios: dict[str, float]
    recorded_pair: Pair | None
    declared: Structure
    best: Structure
    changed: Free = "nothing"
    scale: float = 1.0
    scale_error: float = math.inf
    other_kind_scale: float = math.nan
    offsets_px: dict[Pair, float] = field(default_factory=dict)
    gain: Evidence = _NOTHING
    parallax: Evidence = _NOTHING
    agreement: float = math.nan
    rivals: tuple[Rival, ...] = ()
    equals: tuple[tuple[Structure, Free, float], ...] = ()
    disparity_px: float = math.inf
    spread_px: float = math.inf
    depth_step: float = 0.0
    check: CameraCheck = field(default_factory=CameraCheck)
    problem: str = ""


def allowed_log_scale(depth_step: float) -> float:
    """Return by how much log(unit) may be off without being called wrong.

    Coarse depth moves the mean of 1 / depth by the order of its step squared, where it was rounded;
    a quarter of a step allows for some that was cut off.
    """
    return max(LEAST_LOG_SCALE, depth_step / 4 + depth_step**2)
