"""The search for scenes: proposals are drawn and examined until one passes all filters."""

from dataclasses import dataclass
from typing import Final

from stereogenbench_data.errors import SynthesisError
from stereogenbench_data.synthesis.filters import DEFAULT_LIMITS, Limits, Refusal
from stereogenbench_data.synthesis.plan import ScenePlan
from stereogenbench_data.synthesis.proposal import Proposal, draw_proposal
from stereogenbench_data.synthesis.ray_renderer import RAY_CASTING
from stereogenbench_data.synthesis.renderer import Renderer
from stereogenbench_data.synthesis.request import SynthRequest
from stereogenbench_data.synthesis.trajectory import examine

MOST_PROPOSALS: Final = 4000
"""How many proposals of one scene are examined before the request counts as impossible."""


@dataclass(frozen=True, slots=True)
class Examined:
    """A proposal that was refused.

    Attributes:
        proposal: What was drawn.
        refusal: Why it was refused.
    """

    proposal: Proposal
    refusal: Refusal


@dataclass(frozen=True, slots=True)
class PlanSearch:
    """The search for one scene.

    Attributes:
        plan: The first proposal that passed.
        refused: The proposals before it.
    """

    plan: ScenePlan
    refused: tuple[Examined, ...]


def propose(
    request: SynthRequest, *, index: int, number: int, renderer: Renderer = RAY_CASTING
) -> Proposal:
    """Return a proposal of a scene."""
    return draw_proposal(
        request,
        index=index,
        number=number,
        characters=renderer.characters,
        animations=renderer.animations,
        sensors_mm=renderer.sensors_mm,
    )


def plan_scene(
    request: SynthRequest,
    *,
    index: int,
    renderer: Renderer = RAY_CASTING,
    limits: Limits = DEFAULT_LIMITS,
    first: int = 0,
) -> PlanSearch:
    """Return the first proposal of a scene that passes all filters.

    Args:
        request: The scenes.
        index: The scene's number. Scenes do not depend on each other.
        renderer: Whose maps are asked.
        limits: The limits of the filters.
        first: The proposal to begin with.

    Raises:
        SynthesisError: If 4,000 proposals are refused.
    """
    refused: list[Examined] = []
    for number in range(first, first + MOST_PROPOSALS):
        proposal = propose(request, index=index, number=number, renderer=renderer)
        result = examine(proposal, world=renderer.world(proposal), limits=limits)
        if isinstance(result, ScenePlan):
            return PlanSearch(result, tuple(refused))
        refused.append(Examined(proposal, result))
    reasons = [each.refusal.reason for each in refused]
    counted = sorted({(reasons.count(reason), reason) for reason in reasons}, reverse=True)
    raise SynthesisError(
        f"scene {index} of {request.stream}: all of {MOST_PROPOSALS} proposals are refused ("
        + ", ".join(f"{reason} {count}" for count, reason in counted)
        + "). Choose wider maps, another family or a shorter focal length."
    )
