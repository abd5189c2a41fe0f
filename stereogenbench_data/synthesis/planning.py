"""The search for scenes: proposals are drawn and examined until one passes."""

from collections import Counter
from collections.abc import Sequence
from typing import Final, NamedTuple

from stereogenbench_data.errors import SynthesisError
from stereogenbench_data.synthesis.filters import Refusal
from stereogenbench_data.synthesis.proposal import (
    Proposal,
    lateral_places_cm,
    random_gaps_cm,
    random_stream,
)
from stereogenbench_data.synthesis.render import RAY_CASTING
from stereogenbench_data.synthesis.renderer import Renderer, ScenePlan
from stereogenbench_data.synthesis.request import SynthRequest
from stereogenbench_data.synthesis.trajectory import examine

MOST_PROPOSALS: Final = 4000
"""How many proposals of one scene are examined before the request counts as impossible."""

_OFFSET_RANGE_CM: Final = 1e6
_FOCAL_RANGE_MM: Final = (18.0, 85.0)


def propose(
    request: SynthRequest, *, index: int, number: int, renderer: Renderer = RAY_CASTING
) -> Proposal:
    """Draw a proposal of a scene.

    Args:
        request: The scenes; its maps are drawn from with equal probability.
        index: The scene's number.
        number: The proposal's number.
        renderer: Whose characters, animations and sensors are drawn from.
    """
    rng = random_stream(request, index=index, number=number, part="draw")
    places_cm = lateral_places_cm(random_gaps_cm(request.family, rng=rng))
    focal_mm = float(rng.uniform(*_FOCAL_RANGE_MM))
    return Proposal(
        request=request,
        index=index,
        number=number,
        map_name=request.maps[int(rng.integers(len(request.maps)))],
        character=renderer.characters[int(rng.integers(len(renderer.characters)))],
        animation=renderer.animations[int(rng.integers(len(renderer.animations)))],
        sensor_mm=renderer.sensors_mm[int(rng.integers(len(renderer.sensors_mm)))],
        focal_mm=focal_mm if request.focal_mm is None else request.focal_mm,
        places_cm=places_cm,
        offset_cm=rng.uniform(-1, 1, 3) * _OFFSET_RANGE_CM,
    )


class Planned(NamedTuple):
    """What was found for a scene.

    Attributes:
        plan: The first proposal that passes all filters, with its path.
        refused: The proposals before it, and why each was refused.
    """

    plan: ScenePlan
    refused: list[tuple[Proposal, Refusal]]


def plan_scene(
    request: SynthRequest,
    *,
    index: int,
    renderer: Renderer = RAY_CASTING,
    before: Sequence[tuple[Proposal, Refusal]] = (),
) -> Planned:
    """Return the first proposal of a scene that passes all filters, and those refused before it.

    Args:
        request: The scenes.
        index: The scene's number. Scenes do not depend on each other.
        renderer: Whose maps are asked.
        before: The first proposals, if they were refused already.

    Raises:
        SynthesisError: If 4,000 proposals are refused.
    """
    refused = list(before)
    for number in range(len(before), len(before) + MOST_PROPOSALS):
        proposal = propose(request, index=index, number=number, renderer=renderer)
        result = examine(proposal, world=renderer.world(proposal))
        if isinstance(result, ScenePlan):
            return Planned(result, refused)
        refused.append((proposal, result))
    reasons = Counter(refusal.reason for _, refusal in refused).most_common()
    counts = ", ".join(f"{reason} {count:,}" for reason, count in reasons)
    raise SynthesisError(
        f"scene {index} of {request.stream}: all of {MOST_PROPOSALS} proposals are refused "
        f"({counts}). Choose wider maps, another family or a shorter focal length."
    )
