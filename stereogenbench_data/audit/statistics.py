"""The paper's statistics of any data, from their index alone: counts, baselines, focal lengths."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, Final, Unpack

import numpy as np
from jaxtyping import Float64, Int64

from stereogenbench_data.audit.audit_records import plain
from stereogenbench_data.audit.paper_figures import SHORT_PAIRS
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import (
    ADJACENT_PAIRS,
    BASELINE_BINS,
    CAMERA_PAIRS,
    FAMILIES,
    baseline_bin,
)
from stereogenbench_data.selection.filters import SceneFilters, filter_scenes
from stereogenbench_data.selection.pairs import PAIR_NUMBER

ADJACENT_COLUMNS: Final = [CAMERA_PAIRS.index(pair) for pair in ADJACENT_PAIRS]
FOCAL_EDGES_MM: Final = np.arange(15.0, 86.0, 5.0)
"""Edges of the focal histogram, around the paper's 18 to 85 mm; two more bins are beyond them."""

_SPLITS: Final = ("train", "eval")
_SUBSETS: Final = ("", "seen_map", "unseen_map")


@dataclass(frozen=True, slots=True)
class Distribution:
    """How some numbers are spread; the standard deviation divides by their count."""

    count: int
    min: float
    max: float
    mean: float
    std: float
    median: float

    @classmethod
    def of(cls, values: Float64[np.ndarray, "*any"]) -> "Distribution":
        """Return the spread of one or more numbers."""
        return cls(
            count=int(values.size),
            min=float(values.min()),
            max=float(values.max()),
            mean=float(values.mean()),
            std=float(values.std()),
            median=float(np.median(values)),
        )


@dataclass(frozen=True, slots=True)
class FamilyStatistics:
    """Figures of one family of a split (and subset, empty where both are taken together).

    Attributes:
        split: "train" or "eval".
        subset: "seen_map", "unseen_map" or empty.
        family: Such as "Uniform".
        scenes: How many scenes.
        maps: Map to its number of scenes.
        adjacent_cm: Baselines of the five adjacent pairs of each scene.
        all_pairs_cm: Those of all 15.
        bins: Name of a baseline bin to how many primary, adjacent and all pairs lie in it.
        focal_mm: Focal lengths.
        focal_counts: Scenes in each bin of the focal histogram: below 15 mm, 14 of 5 mm, above
            85 mm.
    """

    split: str
    subset: str
    family: str
    scenes: int
    maps: dict[str, int]
    adjacent_cm: Distribution
    all_pairs_cm: Distribution
    bins: dict[str, tuple[int, int, int]]
    focal_mm: Distribution
    focal_counts: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class ShortPairs:
    """Train Pairwise_Uniform baselines below 10 cm: how many, of how many scenes, on which maps."""

    baselines: int
    scenes: int
    maps: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Statistics:
    """The statistics of some data.

    Attributes:
        root: Where the data are.
        scenes: How many scenes were counted.
        families: Each (split, subset, family) that there is.
        branches: Each (split, family), the subsets of eval together.
        short_pairs: The tail of Pairwise_Uniform.
    """

    root: str
    scenes: int
    families: tuple[FamilyStatistics, ...]
    branches: tuple[FamilyStatistics, ...]
    short_pairs: ShortPairs

    def to_json(self) -> dict[str, Any]:
        """Return the statistics as values that `json.dumps` takes."""
        document: dict[str, Any] = plain(asdict(self))
        document["focal_edges_mm"] = [float(edge) for edge in FOCAL_EDGES_MM]
        return document


def statistics(index: SceneIndex, **filters: Unpack[SceneFilters]) -> Statistics:
    """Return the statistics of an index, or of the scenes of it that pass filters.

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
        short_pairs=_short_pairs(index, rows),
    )


def branch_rows(
    index: SceneIndex, rows: Int64[np.ndarray, " n"]
) -> Iterator[tuple[str, str, Int64[np.ndarray, " m"]]]:
    """Yield each split and family that there is, the paper's first, with its rows."""
    splits, families = _texts(index, "split", rows), _texts(index, "family", rows)
    for split in _in_order(splits, _SPLITS):
        for family in _in_order(families[splits == split], FAMILIES):
            yield split, family, rows[(splits == split) & (families == family)]


def _family(
    index: SceneIndex, rows: Int64[np.ndarray, " n"], *, split: str, subset: str, family: str
) -> FamilyStatistics:
    baselines_cm = index.column("baselines_cm")[rows]
    left, right = index.column("primary_left")[rows], index.column("primary_right")[rows]
    primary_cm = baselines_cm[np.arange(len(rows)), PAIR_NUMBER[left, right]]
    focal_mm = index.column("focal_mm")[rows]
    names, counts = np.unique(_texts(index, "map_name", rows), return_counts=True)
    edges = [-np.inf, *FOCAL_EDGES_MM[:-1], np.nextafter(FOCAL_EDGES_MM[-1], np.inf), np.inf]
    return FamilyStatistics(
        split=split,
        subset=subset,
        family=family,
        scenes=len(rows),
        maps=dict(zip(names.tolist(), counts.tolist(), strict=True)),
        adjacent_cm=Distribution.of(baselines_cm[:, ADJACENT_COLUMNS]),
        all_pairs_cm=Distribution.of(baselines_cm),
        bins=_bins(primary_cm, baselines_cm[:, ADJACENT_COLUMNS], baselines_cm),
        focal_mm=Distribution.of(focal_mm),
        focal_counts=tuple(np.histogram(focal_mm, edges)[0].tolist()),
    )


def _bins(*kinds_cm: Float64[np.ndarray, "*any"]) -> dict[str, tuple[int, int, int]]:
    """Return how many baselines of each kind lie in each bin that holds any."""
    counted = []
    for kind_cm in kinds_cm:
        values, counts = np.unique(kind_cm, return_counts=True)
        in_bins = dict.fromkeys(BASELINE_BINS, 0)
        for value, count in zip(values.tolist(), counts.tolist(), strict=True):
            in_bins[baseline_bin(value)] += count
        counted.append(in_bins)
    primary, adjacent, every = counted
    return {
        name: (primary[name], adjacent[name], every[name]) for name in BASELINE_BINS if every[name]
    }


def _short_pairs(index: SceneIndex, rows: Int64[np.ndarray, " n"]) -> ShortPairs:
    train = _texts(index, "split", rows) == "train"
    chosen = rows[train & (_texts(index, "family", rows) == "Pairwise_Uniform")]
    short = index.column("baselines_cm")[chosen] < SHORT_PAIRS["below_cm"]
    concerned = chosen[short.any(axis=1)]
    maps = np.unique(_texts(index, "map_name", concerned)).tolist()
    return ShortPairs(baselines=int(short.sum()), scenes=len(concerned), maps=tuple(maps))


def _texts(index: SceneIndex, column: str, rows: Int64[np.ndarray, " n"]) -> np.ndarray:
    """Return a column's texts, empty where there is none."""
    return np.array([text or "" for text in index.column(column)[rows]], dtype=str)


def _in_order(values: np.ndarray, known: tuple[str, ...]) -> list[str]:
    """Return the different texts, the known ones first and in their order."""
    there = set(values.tolist())
    return [*(each for each in known if each in there), *sorted(there - set(known))]
