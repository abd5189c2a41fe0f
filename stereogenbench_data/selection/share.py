"""A share of scenes that fits a number or a size, balanced over families and maps."""

import hashlib
from collections.abc import Iterable, Sequence
from itertools import zip_longest

import numpy as np
from jaxtyping import Int64

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.text import counted


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
