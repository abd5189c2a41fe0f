"""What is chosen on the page, from what its query says."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.schema.release import BASELINE_BINS

FACETS: Final = {"split": "split", "subset": "subset", "family": "family", "map": "map_name"}
"""The filters of which the page lists every value, and the columns that have them."""
PairKind = Literal["primary", "adjacent", "all"]
PAIR_KINDS: Final[dict[str, PairKind]] = {
    "primary": "primary", "adjacent": "adjacent", "all": "all"
}  # fmt: skip
"""The pairs that can be chosen, by their names in a query."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What is chosen on the page.

    Attributes:
        texts: Of each of `FACETS`, the values of which one must match; empty lets all pass.
        focal_mm: A closed range in mm, or None.
        baseline_cm: A closed range in cm, names of bins, or None.
        caption: Words that must all be in the caption.
        pairs: Which pairs of the scenes.
    """

    texts: tuple[tuple[str, tuple[str, ...]], ...] = ()
    focal_mm: tuple[float, float] | None = None
    baseline_cm: tuple[float, float] | tuple[str, ...] | None = None
    caption: str = ""
    pairs: PairKind = "all"

    def filters(self) -> dict[str, Any]:
        """Return the filters of scenes that are set, by their names in `SceneFilters`."""
        found: dict[str, Any] = {
            name: values[0] if len(values) == 1 else list(values) for name, values in self.texts
        }
        if self.focal_mm is not None:
            found["focal_mm"] = self.focal_mm
        if self.caption.split():
            found["caption"] = " ".join(self.caption.split())
        return found


def parse_choice(query: Mapping[str, list[str]]) -> Choice:
    """Return the choice that a query states.

    Args:
        query: Names to values: those of `FACETS` any number of times, ``bin`` likewise;
            ``focal_low``, ``focal_high``, ``baseline_low``, ``baseline_high``, ``caption`` and
            ``pairs`` once.

    Raises:
        SelectionError: If a number is none, or a value is none of those there are.
    """
    texts = tuple((name, tuple(sorted(set(query[name])))) for name in FACETS if query.get(name))
    bins = tuple(sorted(set(query.get("bin", ()))))
    unknown = [name for name in bins if name not in BASELINE_BINS]
    pairs = query.get("pairs", ["all"])[0]
    if unknown or pairs not in PAIR_KINDS:
        raise SelectionError(f"there is no {(unknown or [pairs])[0]!r} to choose.")
    return Choice(
        texts=texts,
        focal_mm=_range(query, "focal"),
        baseline_cm=bins or _range(query, "baseline"),
        caption=query.get("caption", [""])[0],
        pairs=PAIR_KINDS[pairs],
    )


def _range(query: Mapping[str, list[str]], name: str) -> tuple[float, float] | None:
    """Return the closed range that two numbers mean; an end that is left out is open."""
    ends: list[float] = []
    for end, default in (("low", 0.0), ("high", 1e6)):
        text = query.get(f"{name}_{end}", [""])[0].strip()
        try:
            ends.append(float(text) if text else default)
        except ValueError:
            raise SelectionError(f"{name} must be of numbers, got {text!r}.") from None
        if not math.isfinite(ends[-1]):
            raise SelectionError(f"{name} must be of finite numbers, got {text!r}.")
        if ends[-1].is_integer():
            ends[-1] = int(ends[-1])
    return None if ends == [0.0, 1e6] else (ends[0], ends[1])
