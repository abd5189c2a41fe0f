"""Statistics as Markdown: the paper's tables, and its figures beside ours."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from stereogenbench_data.audit.paper_comparison import Line
from stereogenbench_data.audit.statistics import (
    FOCAL_EDGES_MM,
    FamilyStatistics,
    Spread,
    Statistics,
)
from stereogenbench_data.schema.text import markdown_text

_BAR: Final = 40


def statistics_markdown(found: Statistics, lines: Sequence[Line] = ()) -> str:
    """Return statistics as Markdown, with the paper's figures beside, where given."""
    text = [
        f"# Statistics of {markdown_text(str(found.root))}",
        *_section("Scenes", _count_rows(found)),
        *_section("Adjacent baselines (cm)", _spread_rows(found.branches, "adjacent")),
        *_section("Baselines of all 15 pairs (cm)", _spread_rows(found.branches, "all pairs")),
        *_section("Pairs by baseline (cm): primary / adjacent / all", _bin_rows(found.families)),
        *_section("Scenes by focal length (mm)", _focal_rows(found.branches)),
        *_section("Scenes by map", _map_rows(found.branches)),
    ]
    if lines:
        agreeing = sum(line.agrees for line in lines)
        title = f"Against the paper: {agreeing} of {len(lines)} figures agree"
        text += _section(title, _paper_rows(lines))
    return "\n".join(text) + "\n"


def _paper_rows(lines: Sequence[Line]) -> Iterator[Sequence[str]]:
    """Yield the compared figures, those that differ first."""
    yield ("", "figure", "paper", "here", "source")
    for line in sorted(lines, key=lambda each: each.agrees):
        mark = "same" if line.agrees else "**differs**"
        yield (mark, line.item, line.paper, line.ours, line.table)


def _section(title: str, rows: Iterable[Sequence[str]]) -> list[str]:
    return ["", f"## {title}", "", *_table(rows)]


def _table(rows: Iterable[Sequence[str]]) -> Iterator[str]:
    for place, row in enumerate(rows):
        yield f"| {' | '.join(map(markdown_text, row))} |"
        if place == 0:
            yield "|" + "---|" * len(row)


def _count_rows(found: Statistics) -> Iterator[Sequence[str]]:
    yield ("split", "subset", "family", "scenes")
    for each in found.families:
        yield (each.split, each.subset or "-", each.family, f"{each.scenes:,}")
    for split in dict.fromkeys(each.split for each in found.branches):
        total = sum(each.scenes for each in found.branches if each.split == split)
        yield (split, "", "total", f"{total:,}")
    yield ("all", "", "total", f"{found.scenes:,}")


def _spread_rows(branches: Sequence[FamilyStatistics], kind: str) -> Iterator[Sequence[str]]:
    yield ("split", "family", "count", "min", "max", "mean", "std", "median")
    for each in branches:
        spread = each.adjacent_cm if kind == "adjacent" else each.all_pairs_cm
        yield (each.split, each.family, *_spread(spread))


def _spread(spread: Spread) -> tuple[str, ...]:
    lengths = (spread.min, spread.max, spread.mean, spread.std, spread.median)
    return (f"{spread.count:,}", *(f"{length:.4f}" for length in lengths))


def _bin_rows(families: Sequence[FamilyStatistics]) -> Iterator[Sequence[str]]:
    names = list(dict.fromkeys(name for each in families for name in each.bins))
    names.sort(key=lambda name: float(name[1:].partition(",")[0]))
    yield ("split", "subset", "family", *names)
    for each in families:
        cells = [
            " / ".join(f"{count:,}" for count in each.bins.get(name, (0, 0, 0))) for name in names
        ]
        yield (each.split, each.subset or "-", each.family, *cells)


def _focal_rows(branches: Sequence[FamilyStatistics]) -> Iterator[Sequence[str]]:
    yield ("focal length", *(f"{each.split} {each.family}" for each in branches), "all")
    totals = [sum(counts) for counts in zip(*(each.focal_counts for each in branches), strict=True)]
    edges = [f"{edge:g}" for edge in FOCAL_EDGES_MM]
    names = [f"below {edges[0]}", *map(" to ".join, itertools.pairwise(edges)),
             f"above {edges[-1]}"]  # fmt: skip
    for place, (name, total) in enumerate(zip(names, totals, strict=True)):
        if total or 0 < place < len(names) - 1:
            bar = "#" * round(_BAR * total / max(totals))
            counts = [f"{each.focal_counts[place]:,}" for each in branches]
            yield (name, *counts, f"{total:,} {bar}".rstrip())


def _map_rows(branches: Sequence[FamilyStatistics]) -> Iterator[Sequence[str]]:
    yield ("map", *(f"{each.split} {each.family}" for each in branches))
    for name in sorted({name for each in branches for name in each.maps}):
        yield (name, *(f"{each.maps[name]:,}" if name in each.maps else "-" for each in branches))
