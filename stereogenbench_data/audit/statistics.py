"""The paper's statistics of an index: counts, baselines and focal lengths, beside its figures."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar, Unpack

import numpy as np
from jaxtyping import Float64, Int64

from stereogenbench_data.audit.paper_numbers import paper_table
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import (
    ADJACENT_PAIRS,
    BASELINE_BINS,
    CAMERA_PAIRS,
    FAMILIES,
    SCENE_COUNTS,
)
from stereogenbench_data.schema.text import counted, markdown_table, markdown_text
from stereogenbench_data.selection.filters import (
    PAIR_NUMBER,
    SceneFilters,
    filter_scenes,
    in_bin,
)
from stereogenbench_data.selection.signatures import list_options

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
        findings: What contradicts itself: maps of unseen_map that train has, too.
    """

    root: str
    scenes: int
    families: tuple[FamilyStatistics, ...]
    branches: tuple[FamilyStatistics, ...]
    derived: str = ""
    findings: tuple[str, ...] = ()


@list_options()
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
    families, branches = [], []
    splits, names = _texts(index, "split", rows), _texts(index, "family", rows)
    for split in _in_order(splits, _SPLITS):
        for family in _in_order(names[splits == split], FAMILIES):
            branch = rows[(splits == split) & (names == family)]
            branches.append(_family(index, branch, split=split, subset="", family=family))
            subsets = _texts(index, "subset", branch)
            for subset in _in_order(subsets, _SUBSETS):
                chosen = branch[subsets == subset]
                families.append(_family(index, chosen, split=split, subset=subset, family=family))
    return Statistics(
        root=index.where,
        scenes=len(rows),
        families=tuple(families),
        branches=tuple(branches),
        derived=index.derivation if index.is_derived else "",
        findings=tuple(_subset_findings(index)),
    )


def _subset_findings(index: SceneIndex) -> Iterator[str]:
    """Yield the maps of scenes of unseen_map that scenes of train have, too."""
    found = index.seen_maps_called_unseen()
    for name, count in Counter(found.values()).items():
        first = next(key for key, own in found.items() if own == name)
        yield (
            f"{name} is a map of train, and {counted(count, 'scene')} of unseen_map "
            f"{'has' if count == 1 else 'have'} it, such as {first}"
        )


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


_RELEASE_SIZED: Final = 0.1
"""Largest relative difference between a split's number of scenes and the paper's."""
_PAPERS_SCENES: Final = {
    split: sum(count for place, count in SCENE_COUNTS.items() if place[0] == split)
    for split in _SPLITS
}
_Place = TypeVar("_Place", bound=tuple[str, ...])
"""What scenes are counted by, the split first."""


@dataclass(frozen=True, slots=True)
class Line:
    """One figure of the paper and ours, both as texts with the paper's number of digits.

    Attributes:
        split: Of which scenes.
        table: Where it stands in the paper.
        item: What it is.
        paper: The paper's.
        ours: That of the data.
    """

    split: str
    table: str
    item: str
    paper: str
    ours: str

    @property
    def agrees(self) -> bool:
        """Whether the two are equal."""
        return self.paper == self.ours


def compared(found: Statistics) -> tuple[Line, ...]:
    """Return every figure of the paper's tables beside that of the statistics.

    Only splits whose number of scenes is within a tenth of the paper's are compared.
    """
    whole = [
        split
        for split, count in _PAPERS_SCENES.items()
        if abs(_scenes_of(found, split) - count) <= _RELEASE_SIZED * count
    ]
    lines = (*_count_lines(found), *_baseline_lines(found), *_bin_lines(found),
             *_map_lines(found))  # fmt: skip
    return tuple(line for line in lines if line.split in whole)


def _scenes_of(found: Statistics, split: str) -> int:
    return sum(each.scenes for each in found.branches if each.split == split)


def _beside(
    table: str, what: str, paper: Mapping[_Place, int], ours: Mapping[_Place, int]
) -> Iterator[Line]:
    """Yield the numbers of scenes that the paper or the data have, 0 where one has none."""
    for place in dict.fromkeys([*paper, *ours]):
        item = f"{what}, {' '.join(filter(None, place))}"
        yield Line(place[0], table, item, str(paper.get(place, 0)), str(ours.get(place, 0)))


def _count_lines(found: Statistics) -> Iterator[Line]:
    table = "table of scene counts by split and family"
    ours = {(each.split, each.subset, each.family): each.scenes for each in found.families}
    yield from _beside(table, "scenes", SCENE_COUNTS, ours)
    totals = {(split, "total"): _scenes_of(found, split) for split in _SPLITS}
    papers = {(split, "total"): count for split, count in _PAPERS_SCENES.items()}
    yield from _beside(table, "scenes", papers, totals)


def _baseline_lines(found: Statistics) -> Iterator[Line]:
    branches = {(each.split, each.family): each for each in found.branches}
    for name, table in (
        ("adjacent", "table of realized adjacent-baseline statistics"),
        ("all_pairs", "appendix on realized baseline distributions"),
    ):
        for row in paper_table(name):
            split, family = row["split"], row["family"]
            branch = branches.get((split, family))
            for figure in (figure for figure in ("count", *_FIGURES) if row[figure]):
                ours, decimals = "-", len(row[figure].partition(".")[2])
                if branch is not None:
                    ours = f"{getattr(branch, f'{name}_cm')[figure]:.{decimals}f}"
                unit = "" if figure == "count" else " (cm)"
                item = f"{name.replace('_', ' ')}, {split} {family}: {figure}{unit}"
                yield Line(split, table, item, row[figure], ours)


def _bin_lines(found: Statistics) -> Iterator[Line]:
    branch = ("eval", "seen_map", "Uniform,")
    paper = {
        (*branch, f"{row['baseline']} cm"): int(row["n_scenes"]) for row in paper_table("bins")
    }
    ours = {
        (*branch, f"{name} cm"): primary
        for each in found.families
        if (each.split, each.subset, f"{each.family},") == branch
        for name, (primary, _, _) in each.bins.items()
        if primary
    }
    table = "table of baseline-stratified diagnostics (N_s)"
    return _beside(table, "scenes by primary baseline", paper, ours)


def _map_lines(found: Statistics) -> Iterator[Line]:
    for split, table, rows in (
        ("train", "table of train scene counts per family and map", paper_table("train_maps")),
        ("eval", "table of evaluation scene counts per family and map", paper_table("eval_maps")),
    ):
        paper = {
            (split, family, row["map"]): int(row[family])
            for row in rows for family in FAMILIES if int(row.get(family, 0))
        }  # fmt: skip
        ours = {
            (split, each.family, name): count
            for each in found.branches if each.split == split for name, count in each.maps.items()
        }  # fmt: skip
        yield from _beside(table, "scenes", paper, ours)


def statistics_markdown(found: Statistics, lines: Sequence[Line] = ()) -> str:
    """Return statistics as Markdown, with the comparison with the paper if given."""
    text = [
        f"# Statistics of {markdown_text(str(found.root))}",
        *([] if not found.derived else ["", f"These are {found.derived}."]),
        *(line for each in found.findings for line in ("", f"**{markdown_text(each)}.**")),
        *_section("Scenes", _count_rows(found)),
        *_section("Adjacent baselines (cm)", _spread_rows(found.branches, "adjacent_cm")),
        *_section("Baselines of all 15 pairs (cm)", _spread_rows(found.branches, "all_pairs_cm")),
        *_section("Pairs by baseline (cm): primary / adjacent / all", _bin_rows(found.families)),
        *_section("Focal lengths (mm)", _spread_rows(found.branches, "focal_mm")),
        *_section("Scenes by map", _map_rows(found.branches)),
    ]
    if lines:
        agreeing = sum(line.agrees for line in lines)
        title = f"Against the paper: {agreeing} of {len(lines)} figures agree"
        rows = [
            ("same" if each.agrees else "**differs**", each.item, each.paper, each.ours, each.table)
            for each in sorted(lines, key=lambda each: each.agrees)
        ]
        text += _section(title, [("", "figure", "paper", "here", "source"), *rows])
    return "\n".join(text) + "\n"


def screen(
    found: Statistics, lines: Sequence[Line]
) -> tuple[str, list[tuple[str, list[Sequence[str]]]]]:
    """Return what a screen shows of statistics: a verdict, and tables with their titles."""
    verdict = f"{counted(found.scenes, 'scene')} of {found.root}"
    differing = [line for line in lines if not line.agrees]
    if lines:
        agreeing = len(lines) - len(differing)
        verdict += f": {agreeing} of {len(lines)} figures of the paper agree"
    verdict += "".join(f". {each}" for each in found.findings)
    rows = [(each.item, each.paper, each.ours) for each in differing]
    parts: list[tuple[str, list[Sequence[str]]]] = [
        ("Scenes", [*_count_rows(found)]),
        ("Adjacent baselines (cm)", [*_spread_rows(found.branches, "adjacent_cm")]),
    ]
    if rows:
        parts.append(("Differs from the paper", [("figure", "paper", "here"), *rows]))
    return f"{verdict}.", parts


def _section(title: str, rows: Iterable[Sequence[str]]) -> list[str]:
    return ["", f"## {title}", "", *markdown_table(*rows)]


def _count_rows(found: Statistics) -> Iterator[Sequence[str]]:
    yield ("split", "subset", "family", "scenes")
    for each in found.families:
        yield (each.split, each.subset or "-", each.family, f"{each.scenes:,}")
    for split in dict.fromkeys(each.split for each in found.branches):
        yield (split, "", "total", f"{_scenes_of(found, split):,}")
    yield ("all", "", "total", f"{found.scenes:,}")


def _spread_rows(branches: Sequence[FamilyStatistics], name: str) -> Iterator[Sequence[str]]:
    yield ("split", "family", "count", "min", "max", "mean", "std", "median")
    for each in branches:
        count, *lengths = getattr(each, name).values()
        yield (each.split, each.family, f"{count:,}", *(f"{length:.4f}" for length in lengths))


def _bin_rows(families: Sequence[FamilyStatistics]) -> Iterator[Sequence[str]]:
    names = list(dict.fromkeys(name for each in families for name in each.bins))
    names.sort(key=lambda name: float(name[1:].partition(",")[0]))
    yield ("split", "subset", "family", *names)
    for each in families:
        cells = [
            " / ".join(f"{count:,}" for count in each.bins.get(name, (0, 0, 0))) for name in names
        ]
        yield (each.split, each.subset or "-", each.family, *cells)


def _map_rows(branches: Sequence[FamilyStatistics]) -> Iterator[Sequence[str]]:
    yield ("map", *(f"{each.split} {each.family}" for each in branches))
    for name in sorted({name for each in branches for name in each.maps}):
        yield (name, *(f"{each.maps[name]:,}" if name in each.maps else "-" for each in branches))
