"""What a renderer gives to generation: maps to ask, and pictures of accepted plans."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64, UInt8

from stereogenbench_data.errors import SynthesisError
from stereogenbench_data.selection.options import nearest_first
from stereogenbench_data.synthesis.plan import ScenePlan
from stereogenbench_data.synthesis.proposal import Proposal
from stereogenbench_data.synthesis.world import World

_NEAREST: Final = 3


@dataclass(frozen=True, slots=True, eq=False)
class RenderedView:
    """What one camera sees at one frame.

    Attributes:
        picture: Red, green and blue.
        depth_m: Depth along the optical axis at pixel centres, exact; infinite where there is
            nothing.
    """

    picture: UInt8[np.ndarray, "h w 3"]
    depth_m: Float64[np.ndarray, "h w"]


@runtime_checkable
class Renderer(Protocol):
    """A way to draw scenes. It is pickled into worker processes, so it opens its assets there.

    Attributes:
        name: What the command calls it.
        maps: Names of its maps, as folders of the release.
        characters: Names of the subjects.
        animations: Names of the subjects' motions.
        sensors_mm: Width and height of the sensors to draw from.
        fingerprint: Changes when the same proposal gives another scene: a version, a digest of
            assets.
        cameras_per_task: How many cameras one process draws together; 1, 2, 3 or 6.
    """

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def maps(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def characters(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def animations(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def sensors_mm(self) -> tuple[tuple[float, float], ...]: ...  # noqa: D102
    @property
    def fingerprint(self) -> str: ...  # noqa: D102
    @property
    def cameras_per_task(self) -> int: ...  # noqa: D102

    def world(self, proposal: Proposal) -> World:
        """Return the map of a proposal, for its filters.

        Raises:
            SynthesisError: If the map, character or animation cannot be opened.
        """

    def views(self, plan: ScenePlan, *, cameras: tuple[int, ...]) -> Iterator[RenderedView]:
        """Yield the views of cameras: all of frame 0 in the order of ``cameras``, then frame 1, on.

        Raises:
            SynthesisError: If the scene cannot be rendered.
        """

    def description(self, plan: ScenePlan) -> dict[str, object]:
        """Return the document of ``scene_description_qwen_dataset_level.json``."""


def unknown_map(where: str, name: str, known: Iterable[str], *, choose: str) -> SynthesisError:
    """Return the error of a map that a renderer does not have.

    Args:
        where: What should have it.
        name: The map.
        known: The maps that may be meant; the three nearest are named.
        choose: What there is to choose from.
    """
    near = ", ".join(nearest_first(name, known)[:_NEAREST])
    return SynthesisError(
        f"{where}: there is no map {name!r}. Nearest: {near}. Choose by --map {choose}."
    )
