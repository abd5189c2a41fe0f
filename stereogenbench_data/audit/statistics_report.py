"""Statistics compared with the paper's figures, as Markdown."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from stereogenbench_data.audit.paper_numbers import (
    ADJACENT,
    ADJACENT_TABLE,
    ALL_PAIRS,
    ALL_PAIRS_TABLE,
    BINS,
    BINS_TABLE,
    COUNTS_TABLE,
    EVAL_MAPS,
    EVAL_MAPS_TABLE,
    FOCAL_MM,
    SPLITS,
    TRAIN_MAPS_TABLE,
    map_counts,
)
from stereogenbench_data.audit.statistics import FamilyStatistics, Statistics
from stereogenbench_data.schema.release import SCENE_COUNTS
from stereogenbench_data.schema.text import markdown_table, markdown_text

_RELEASE_SIZED: Final = 0.1
"""Largest relative difference between a split's number of scenes and the paper's."""


@dataclass(frozen=True, slots=True)
class Line:
    """One figure of the paper and ours, both as texts with the paper's number of digits."""

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
    splits = [
        split
        for split, count in SPLITS.items()
        if abs(_scenes_of(found, split) - count) <= _RELEASE_SIZED * count
    ]
    lines = [
        *_count_lines(found),
        *_baseline_lines(found),
        *_bin_lines(found),
        *_focal_lines(found),
        *_map_lines(found),
    ]
    return tuple(line for line in lines if line.split in splits)


def _scenes_of(found: Statistics, split: str) -> int:
    return sum(each.scenes for each in found.branches if each.split == split)


def _count_lines(found: Statistics) -> Iterator[Line]:
    ours = {(each.split, each.subset, each.family): each.scenes for each in found.families}
    for place in dict.fromkeys([*SCENE_COUNTS, *ours]):
        item = "scenes, " + " ".join(part for part in place if part)
        paper, here = (str(counts.get(place, 0)) for counts in (SCENE_COUNTS, ours))
        yield Line(place[0], COUNTS_TABLE, item, paper, here)
    for split, count in SPLITS.items():
        total = _scenes_of(found, split)
        yield Line(split, COUNTS_TABLE, f"scenes, {split} total", str(count), str(total))


def _baseline_lines(found: Statistics) -> Iterator[Line]:
    branches = {(each.split, each.family): each for each in found.branches}
    for table, kind, attribute, figures in (
        (ADJACENT_TABLE, "adjacent", "adjacent_cm", ADJACENT),
        (ALL_PAIRS_TABLE, "all pairs", "all_pairs_cm", ALL_PAIRS),
    ):
        for (split, family), expected in figures.items():
            branch = branches.get((split, family))
            for name, paper in expected.items():
                ours = "-"
                if branch is not None:
                    decimals = len(paper.partition(".")[2])
                    ours = f"{getattr(branch, attribute)[name]:.{decimals}f}"
                item = f"{kind}, {split} {family}: {name}" + (" (cm)" if name != "count" else "")
                yield Line(split, table, item, paper, ours)


def _bin_lines(found: Statistics) -> Iterator[Line]:
    bins = {
        name: primary
        for each in found.families
        if (each.split, each.subset, each.family) == ("eval", "seen_map", "Uniform")
        for name, (primary, _, _) in each.bins.items()
    }
    for name in dict.fromkeys([*BINS, *(name for name, count in bins.items() if count)]):
        item = f"scenes by primary baseline, eval seen_map Uniform, {name} cm"
        yield Line("eval", BINS_TABLE, item, str(BINS.get(name, 0)), str(bins.get(name, 0)))


def _focal_lines(found: Statistics) -> Iterator[Line]:
    low, high = FOCAL_MM
    paper = f"{low:g} to {high:g}"
    for split in SPLITS:
        spreads = [each.focal_mm for each in found.branches if each.split == split]
        if not spreads:
            continue
        least, most = min(each["min"] for each in spreads), max(each["max"] for each in spreads)
        ours = paper if low <= least and most <= high else f"{least:g} to {most:g}"
        item = f"focal lengths within (mm), {split}"
        yield Line(split, "appendix on generation parameters", item, paper, ours)


def _map_lines(found: Statistics) -> Iterator[Line]:
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
        yield Line(split, table, item, str(paper.get(place, 0)), str(ours.get(place, 0)))
    subsets = {
        name: each.subset for each in found.families if each.split == "eval" for name in each.maps
    }
    for name, (subset, _, _) in EVAL_MAPS.items():
        item = f"subset of {name}"
        yield Line("eval", EVAL_MAPS_TABLE, item, subset, subsets.get(name, "-"))


def statistics_markdown(found: Statistics, lines: Sequence[Line] = ()) -> str:
    """Return statistics as Markdown, with the comparison with the paper if given."""
    text = [
        f"# Statistics of {markdown_text(str(found.root))}",
        *([] if not found.derived else ["", f"These are {found.derived}."]),
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
            ("same" if line.agrees else "**differs**", line.item, line.paper, line.ours, line.table)
            for line in sorted(lines, key=lambda each: each.agrees)
        ]
        text += _section(title, [("", "figure", "paper", "here", "source"), *rows])
    return "\n".join(text) + "\n"


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
