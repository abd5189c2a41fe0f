"""The paper's statistics, from an index alone: counts, baselines and focal lengths."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any, Final, Unpack

import numpy as np
from jaxtyping import Float64, Int64

from stereogenbench_data.audit.geometry.records import plain
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import (
    ADJACENT_PAIRS,
    BASELINE_BINS,
    CAMERA_PAIRS,
    FAMILIES,
)
from stereogenbench_data.selection.filters import PAIR_NUMBER, SceneFilters, filter_scenes, in_bin

ADJACENT_COLUMNS: Final = [CAMERA_PAIRS.index(pair) for pair in ADJACENT_PAIRS]
_SPLITS: Final = ("train", "eval")
_SUBSETS: Final = ("", "seen_map", "unseen_map")


_FIGURES: Final[dict[str, Callable[[Any], Any]]] = {
    "min": np.min, "max": np.max, "mean": np.mean, "std": np.std, "median": np.median,
}  # fmt: skip


def distribution(values: Float64[np.ndarray, "*any"]) -> dict[str, float]:
    """Return count, min, max, mean, std and median; the standard deviation divides by the count."""
    found = {name: float(figure(values)) for name, figure in _FIGURES.items()}
    return {"count": values.size} | found


@dataclass(frozen=True, slots=True)
class FamilyStatistics:
    """Figures of one family of a split, and of a subset.

    Attributes:
        split: "train" or "eval".
        subset: "seen_map" or "unseen_map"; empty for both together and for train.
        family: Such as "Uniform".
        scenes: Number of scenes.
        maps: Maps each map to its number of scenes.
        adjacent_cm: Baselines of the five adjacent pairs of each scene.
        all_pairs_cm: Baselines of all 15 pairs of each scene.
        bins: Maps each baseline bin to its number of primary, adjacent and all pairs.
        focal_mm: Focal lengths.
    """

    split: str
    subset: str
    family: str
    scenes: int
    maps: dict[str, int]
    adjacent_cm: dict[str, float]
    all_pairs_cm: dict[str, float]
    bins: dict[str, tuple[int, ...]]
    focal_mm: dict[str, float]


@dataclass(frozen=True, slots=True)
class Statistics:
    """The statistics of a data set.

    Attributes:
        root: Where the data are.
        scenes: Number of scenes.
        families: Figures of each (split, subset, family) of the data.
        branches: Figures of each (split, family), the subsets of eval together.
        derived: What training shards were derived from, and how; empty for released data.
    """

    root: str
    scenes: int
    families: tuple[FamilyStatistics, ...]
    branches: tuple[FamilyStatistics, ...]
    derived: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the statistics as values for `json.dumps`."""
        document: dict[str, Any] = plain(asdict(self))
        return document


def statistics(index: SceneIndex, **filters: Unpack[SceneFilters]) -> Statistics:
    """Return the statistics of an index, or of its scenes that pass filters.

    Args:
        index: The index; nothing else is read.
        **filters: Which scenes, see `SceneFilters`.

    Raises:
        SelectionError: If no scene passes.

    Source: the StereoGenBench paper, tables of scene counts and of adjacent baselines, and its
    appendices on realized baselines and per-map counts.
    """
    rows = filter_scenes(index, filters)
    families = []
    branches = []
    for split, family, of_branch in branch_rows(index, rows):
        branches.append(_family(index, of_branch, split=split, subset="", family=family))
        subsets = _texts(index, "subset", of_branch)
        for subset in _in_order(subsets, _SUBSETS):
            chosen = of_branch[subsets == subset]
            families.append(_family(index, chosen, split=split, subset=subset, family=family))
    return Statistics(
        root=index.where,
        scenes=len(rows),
        families=tuple(families),
        branches=tuple(branches),
        derived=index.derivation if index.is_derived else "",
    )


def branch_rows(
    index: SceneIndex, rows: Int64[np.ndarray, " n"]
) -> Iterator[tuple[str, str, Int64[np.ndarray, " m"]]]:
    """Yield each split and family of the data with its rows, the paper's first."""
    splits, families = _texts(index, "split", rows), _texts(index, "family", rows)
    for split in _in_order(splits, _SPLITS):
        for family in _in_order(families[splits == split], FAMILIES):
            yield split, family, rows[(splits == split) & (families == family)]


def _family(
    index: SceneIndex, rows: Int64[np.ndarray, " n"], *, split: str, subset: str, family: str
) -> FamilyStatistics:
    baselines_cm = index.column("baselines_cm")[rows]
    adjacent_cm = baselines_cm[:, ADJACENT_COLUMNS]
    left, right = index.column("primary_left")[rows], index.column("primary_right")[rows]
    primary_cm = baselines_cm[np.arange(len(rows)), PAIR_NUMBER[left, right]]
    focal_mm = index.column("focal_mm")[rows]
    names, counts = np.unique(_texts(index, "map_name", rows), return_counts=True)
    return FamilyStatistics(
        split=split,
        subset=subset,
        family=family,
        scenes=len(rows),
        maps=dict(zip(names.tolist(), counts.tolist(), strict=True)),
        adjacent_cm=distribution(adjacent_cm),
        all_pairs_cm=distribution(baselines_cm),
        bins={
            name: tuple(
                int(in_bin(each, name).sum()) for each in (primary_cm, adjacent_cm, baselines_cm)
            )
            for name in BASELINE_BINS
            if in_bin(baselines_cm, name).any()
        },
        focal_mm=distribution(focal_mm),
    )


def _texts(index: SceneIndex, column: str, rows: Int64[np.ndarray, " n"]) -> np.ndarray:
    """Return a column's texts, empty for missing ones."""
    return np.array([text or "" for text in index.column(column)[rows]], dtype=str)


def _in_order(values: np.ndarray, known: tuple[str, ...]) -> list[str]:
    """Return the distinct texts, the known ones first and in their order."""
    there = set(values.tolist())
    return [*(each for each in known if each in there), *sorted(there - set(known))]
