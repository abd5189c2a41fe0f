"""Balanced parts: pairs by their baselines, and scenes by families and maps, drawn by a seed.

The release's baselines follow what passed its filters (short gaps are the most frequent); the
paper asks those who need a uniform distribution to subsample. Source: the paper's appendix on
the realised baseline distributions.
"""

import hashlib
from collections.abc import Iterable, Sequence
from itertools import zip_longest
from typing import Literal

import numpy as np
from jaxtyping import Float64, Int64

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import BASELINE_BINS, baseline_bin
from stereogenbench_data.schema.text import counted

Balance = Literal["bins", "log_baseline"]
LOG_STRATA = 16


def balanced(
    baselines_cm: Float64[np.ndarray, " n"], *, by: Balance, limit: int | None, seed: int
) -> Int64[np.ndarray, " m"]:
    """Return the places, ascending, of a subsample with equally many baselines of each stratum.

    Args:
        baselines_cm: Baselines in cm.
        by: "bins": the strata are the paper's baseline bins; "log_baseline": 16 equally wide
            intervals of log-baseline over the range at hand. Empty strata do not count.
        limit: How many to draw in all; the strata's shares differ by at most one. None draws as
            many from each stratum as the smallest one has.
        seed: The draw's seed.

    Raises:
        SelectionError: If a stratum has fewer baselines than its share of the limit, or the limit
            is less than one for each.
    """
    strata = _strata(baselines_cm, by=by)
    found = np.unique(strata).tolist()
    members = [np.flatnonzero(strata == stratum) for stratum in found]
    poorest = min(map(len, members))
    if limit is None:
        limit = poorest * len(found)
    if limit < len(found):
        raise SelectionError(
            f"limit={limit} is less than one pair for each of {len(found)} strata."
        )
    generator = np.random.default_rng(np.random.SeedSequence((seed, 0xBA1A)))
    drawn = []
    for number, (stratum, places) in enumerate(zip(found, members, strict=True)):
        share = limit // len(found) + (number < limit % len(found))
        if share > len(places):
            name = f"stratum {stratum + 1} of {LOG_STRATA} of log-baseline"
            if by == "bins":
                name = f"the bin {list(BASELINE_BINS)[stratum]} cm"
            raise SelectionError(
                f"balance={by!r}, limit={limit}: {share} pairs are wanted of {name}, which has "
                f"{len(places)}; the most that balances is {poorest * len(found)}."
            )
        drawn.append(generator.choice(places, size=share, replace=False))
    return np.sort(np.concatenate(drawn))


def _strata(baselines_cm: Float64[np.ndarray, " n"], *, by: Balance) -> Int64[np.ndarray, " n"]:
    if by == "bins":
        order = list(BASELINE_BINS)
        return np.array([order.index(baseline_bin(value)) for value in baselines_cm])
    if by != "log_baseline":
        raise SelectionError(f"balance must be 'bins' or 'log_baseline', got {by!r}.")
    logs = np.log(baselines_cm)
    width = max(float(np.ptp(logs)) / LOG_STRATA, np.finfo(np.float64).tiny)
    strata: Int64[np.ndarray, " n"] = ((logs - logs.min()) // width).astype(np.int64)
    strata[strata == LOG_STRATA] = LOG_STRATA - 1
    return strata


def balanced_share(
    index: SceneIndex,
    rows: Sequence[int],
    sizes_bytes: Sequence[int],
    *,
    scenes: int | None = None,
    max_bytes: int | None = None,
    seed: int = 0,
) -> Int64[np.ndarray, " n"]:
    """Return the rows, ascending, of a share of scenes.

    Families take turns, in each family its maps, and in each map its scenes, in an order that
    depends on their names and the seed alone. So a share of more scenes holds that of fewer.

    Args:
        index: What the rows are of.
        rows: The scenes to choose from.
        sizes_bytes: How many bytes each of them takes.
        scenes: How many to choose.
        max_bytes: How many bytes those that are chosen may take together.
        seed: Gives another order.

    Raises:
        SelectionError: If there are fewer scenes, or no scene fits into the bytes.
    """
    if scenes is not None and scenes > len(rows):
        raise SelectionError(
            f"{index.where}: {counted(scenes, 'scene')} wanted, and {len(rows)} can be chosen. "
            f"Ask for fewer, or widen the filters."
        )
    columns = (index.column(name) for name in ("family", "map_name", "key"))
    families, maps, keys = (column[np.asarray(rows)].tolist() for column in columns)
    tree: dict[str, dict[str, list[int]]] = {}
    for place in sorted(range(len(rows)), key=lambda place: _drawn(keys[place], seed)):
        tree.setdefault(families[place], {}).setdefault(maps[place], []).append(place)
    order = _in_turns(
        _in_turns(of_map[name] for name in sorted(of_map, key=lambda name: _drawn(name, seed)))
        for _, of_map in sorted(tree.items(), key=lambda item: _drawn(item[0], seed))
    )
    if max_bytes is not None:
        smallest = min(sizes_bytes)
        if smallest > max_bytes:
            raise SelectionError(
                f"{index.where}: no scene fits into {max_bytes:,} bytes: the smallest takes "
                f"{smallest:,}. Allow more, or take fewer cameras."
            )
        order = [place for place in order if sizes_bytes[place] <= max_bytes]
        taken = np.cumsum([sizes_bytes[place] for place in order])
        order = order[: int(np.searchsorted(taken, max_bytes, side="right"))]
    return np.sort(np.asarray(rows, dtype=np.int64)[order[:scenes]])


def _in_turns(lists: Iterable[Sequence[int]]) -> list[int]:
    """Return the elements of lists, the first of each, then the second of each, and so on."""
    return [each for turn in zip_longest(*lists) for each in turn if each is not None]


def _drawn(text: str, seed: int) -> bytes:
    return hashlib.sha256(f"{seed} {text}".encode()).digest()
