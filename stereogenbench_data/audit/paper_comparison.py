"""An index's statistics against the paper's figures, line by line."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from stereogenbench_data.audit.paper_figures import (
    ADJACENT,
    ADJACENT_TABLE,
    ALL_PAIRS,
    ALL_PAIRS_TABLE,
    BINS,
    BINS_TABLE,
    COUNTS,
    COUNTS_TABLE,
    EVAL_MAPS,
    EVAL_MAPS_TABLE,
    FOCAL_MM,
    SHORT_PAIRS,
    SHORT_PAIRS_MAP,
    SPLITS,
    TRAIN_MAPS_TABLE,
    map_counts,
)
from stereogenbench_data.audit.statistics import FamilyStatistics, Spread, Statistics

_RELEASE_SIZED: Final = 0.1
"""By which share a split's number of scenes may differ from the paper's to be compared with it."""


@dataclass(frozen=True, slots=True)
class Line:
    """One figure of the paper beside ours, both as texts with as many digits as the paper tells."""

    table: str
    item: str
    paper: str
    ours: str

    @property
    def agrees(self) -> bool:
        """Whether the two are the same."""
        return self.paper == self.ours


def release_sized_splits(found: Statistics) -> tuple[str, ...]:
    """Return the splits that have about as many scenes as the paper's, within a tenth."""
    scenes = dict.fromkeys(SPLITS, 0)
    for branch in found.branches:
        scenes[branch.split] = scenes.get(branch.split, 0) + branch.scenes
    return tuple(
        split
        for split, count in SPLITS.items()
        if abs(scenes[split] - count) <= _RELEASE_SIZED * count
    )


def compared(found: Statistics, *, splits: tuple[str, ...] = tuple(SPLITS)) -> tuple[Line, ...]:
    """Return every figure of the paper's tables on some splits beside that of the statistics."""
    lines = [
        *_count_lines(found),
        *_baseline_lines(found),
        *_short_lines(found),
        *_bin_lines(found),
        *_focal_lines(found),
        *_map_lines(found),
    ]
    return tuple(line for split, line in lines if split in splits)


def _count_lines(found: Statistics) -> Iterator[tuple[str, Line]]:
    ours = {(each.split, each.subset, each.family): each.scenes for each in found.families}
    for place in dict.fromkeys([*COUNTS, *ours]):
        item = "scenes, " + " ".join(part for part in place if part)
        yield place[0], Line(COUNTS_TABLE, item, str(COUNTS.get(place, 0)), str(ours.get(place, 0)))
    for split, count in SPLITS.items():
        total = sum(each.scenes for each in found.branches if each.split == split)
        yield split, Line(COUNTS_TABLE, f"scenes, {split} total", str(count), str(total))


def _baseline_lines(found: Statistics) -> Iterator[tuple[str, Line]]:
    branches = {(each.split, each.family): each for each in found.branches}
    for table, kind, figures in (
        (ADJACENT_TABLE, "adjacent", ADJACENT), (ALL_PAIRS_TABLE, "all pairs", ALL_PAIRS),
    ):  # fmt: skip
        for (split, family), told in figures.items():
            branch = branches.get((split, family))
            for name, paper in told.items():
                item = f"{kind}, {split} {family}: {name}" + (" (cm)" if name != "count" else "")
                yield split, Line(table, item, paper, _as_told(_spread(branch, kind), name, paper))


def _spread(branch: FamilyStatistics | None, kind: str) -> Spread | None:
    if branch is None:
        return None
    return branch.adjacent_cm if kind == "adjacent" else branch.all_pairs_cm


def _as_told(spread: Spread | None, name: str, paper: str) -> str:
    """Return a figure with as many decimals as the paper's, a dash where there is none."""
    if spread is None:
        return "-"
    decimals = len(paper.partition(".")[2])
    return f"{getattr(spread, name):.{decimals}f}"


def _short_lines(found: Statistics) -> Iterator[tuple[str, Line]]:
    short, item = found.short_pairs, "Pairwise_Uniform below 10 cm: "
    for name, paper, ours in (
        ("baselines", str(SHORT_PAIRS["baselines"]), str(short.baselines)),
        ("scenes", str(SHORT_PAIRS["scenes"]), str(short.scenes)),
        ("maps", SHORT_PAIRS_MAP, ", ".join(short.maps) or "-"),
    ):
        yield "train", Line(ALL_PAIRS_TABLE, item + name, paper, ours)


def _bin_lines(found: Statistics) -> Iterator[tuple[str, Line]]:
    bins = {
        name: primary
        for each in found.families
        if (each.split, each.subset, each.family) == ("eval", "seen_map", "Uniform")
        for name, (primary, _, _) in each.bins.items()
    }
    for name in dict.fromkeys([*BINS, *(name for name, count in bins.items() if count)]):
        item = f"scenes by primary baseline, eval seen_map Uniform, {name} cm"
        yield "eval", Line(BINS_TABLE, item, str(BINS.get(name, 0)), str(bins.get(name, 0)))


def _focal_lines(found: Statistics) -> Iterator[tuple[str, Line]]:
    low, high = FOCAL_MM
    told = f"{low:g} to {high:g}"
    for split in SPLITS:
        spreads = [each.focal_mm for each in found.branches if each.split == split]
        if not spreads:
            continue
        least, most = min(each.min for each in spreads), max(each.max for each in spreads)
        ours = told if low <= least and most <= high else f"{least:g} to {most:g}"
        item = f"focal lengths within (mm), {split}"
        yield split, Line("appendix on generation parameters", item, told, ours)


def _map_lines(found: Statistics) -> Iterator[tuple[str, Line]]:
    paper = map_counts()
    ours = {
        (each.split, each.family, name): count
        for each in found.branches
        for name, count in each.maps.items()
    }
    for place in dict.fromkeys([*paper, *ours]):
        split, family, name = place
        table = TRAIN_MAPS_TABLE if split == "train" else EVAL_MAPS_TABLE
        item = f"scenes, {split} {family} {name}"
        yield split, Line(table, item, str(paper.get(place, 0)), str(ours.get(place, 0)))
    subsets = {
        name: each.subset for each in found.families if each.split == "eval" for name in each.maps
    }
    for name, (subset, _, _) in EVAL_MAPS.items():
        item = f"subset of {name}"
        yield "eval", Line(EVAL_MAPS_TABLE, item, subset, subsets.get(name, "-"))
