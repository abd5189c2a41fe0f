"""Which cameras: the ordered pairs of each scene, by name, by index and by baseline."""

import multiprocessing
import operator
import re
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Bool, Float64, Int8, Int64

from stereogenbench_data.errors import SelectionError, text_without_secrets
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.release import (
    ADJACENT_PAIRS,
    BASELINE_BINS,
    CAMERA_COUNT,
    CAMERA_PAIRS,
    VIDEO_FILES,
    baseline_bin,
)
from stereogenbench_data.schema.text import counted
from stereogenbench_data.selection.filters import Range, filter_text, require_range

PairsSpec = (
    Literal["primary", "adjacent", "all", "sweep"]
    | str
    | tuple[int, int]
    | Sequence[tuple[int, int] | str]
)
Direction = Literal["left_to_right", "right_to_left"]
BaselineSpec = Range | str | Sequence[str]

_PAIR: Final = re.compile(r"\s*[0-9]+\s*-\s*[0-9]+\s*")


class FewerPairsWarning(UserWarning):
    """The data hold some cameras alone, so "all" or "adjacent" are fewer pairs than of six."""


PAIR_NUMBER: Int64[np.ndarray, "6 6"] = np.full((CAMERA_COUNT, CAMERA_COUNT), -1, dtype=np.int64)
"""[a, b]: the place of cameras a and b among `CAMERA_PAIRS`, in either order; -1 for a == b."""
for _number, (_a, _b) in enumerate(CAMERA_PAIRS):
    PAIR_NUMBER[_a, _b] = PAIR_NUMBER[_b, _a] = _number


@dataclass(frozen=True, slots=True, eq=False)
class PairList:
    """The chosen pairs of the chosen scenes, scene after scene.

    Attributes:
        row: (n,) int64, the scene's row in the index, ascending.
        source: (n,) int8, the camera whose pixels have the disparity.
        targets: (n, k) int8, the cameras that it is paired with: one, or for a sweep several,
            filled up with -1.
    """

    row: Int64[np.ndarray, " n"]
    source: Int8[np.ndarray, " n"]
    targets: Int8[np.ndarray, "n k"]

    def __len__(self) -> int:
        return len(self.row)

    def __getitem__(self, keep: Any) -> "PairList":
        """Return the entries that a mask or an array of places keeps."""
        return PairList(self.row[keep], self.source[keep], self.targets[keep])


def choose_pairs(
    index: SceneIndex,
    rows: Int64[np.ndarray, " s"],
    *,
    pairs: PairsSpec = "primary",
    direction: Direction = "left_to_right",
    baseline_cm: BaselineSpec | None = None,
) -> PairList:
    """Return the pairs of the given scenes.

    Args:
        index: The index that the rows belong to.
        rows: Rows of scenes, ascending.
        pairs: "primary" (one a scene), "adjacent" (5), "all" (15), one or several explicit pairs
            (left, right) or "left-right" with left < right, or "sweep", several pairs as one
            entry: the primary pair's left view with every view to its right, or right to left the
            rightmost view with every view to its left. Data with some cameras alone have fewer
            adjacent and all pairs, which `FewerPairsWarning` says.
        direction: "left_to_right": the left camera's pixels have the disparity.
            "right_to_left": the right camera's, with negative disparity and baseline.
        baseline_cm: A closed range in cm, or names of the paper's bins.

    Raises:
        SelectionError: If a pair does not exist or no baseline falls into the range.
    """
    if direction not in ("left_to_right", "right_to_left"):
        raise SelectionError(
            f"direction must be 'left_to_right' or 'right_to_left', got {direction!r}."
        )
    primary = np.stack(
        [index.column("primary_left")[rows], index.column("primary_right")[rows]], axis=1
    ).astype(np.int8)
    if isinstance(pairs, str) and pairs == "sweep":
        chosen = _sweeps(rows, primary, direction=direction)
    else:
        chosen = _plain(rows, primary, pairs=pairs, direction=direction)
        if isinstance(pairs, str) and pairs in ("adjacent", "all"):
            chosen = _of_held_cameras(index, rows, chosen, name=pairs)
    return chosen if baseline_cm is None else _within(index, chosen, baseline_cm)


def baselines_cm(index: SceneIndex, pairs: PairList) -> Float64[np.ndarray, "n k"]:
    """Return the recorded baseline of every pair in cm, nan where a sweep has no target."""
    number = PAIR_NUMBER[pairs.source[:, None], pairs.targets]
    recorded: Float64[np.ndarray, "n k"] = np.take_along_axis(
        index.column("baselines_cm")[pairs.row], number, axis=1
    )
    return np.where(pairs.targets >= 0, recorded, np.nan)


def require_pairs(pairs: Any) -> tuple[tuple[int, int], ...]:
    """Return explicit camera pairs as a tuple of (left, right).

    Args:
        pairs: Pairs such as (0, 5) or "0-5", or one of them.

    Raises:
        SelectionError: If one is not two cameras of 0 to 5, the left before the right, or if one
            is given twice.

    >>> require_pairs((0, 1)), require_pairs("0-1"), require_pairs([(0, 1), "0-5"])
    (((0, 1),), ((0, 1),), ((0, 1), (0, 5)))
    """
    listed: Any = pairs.tolist() if isinstance(pairs, np.ndarray) else pairs
    if isinstance(pairs, str) and all(map(_PAIR.fullmatch, pairs.split(","))):
        listed = pairs.split(",")
    if not isinstance(listed, Iterable) or isinstance(listed, str):
        raise SelectionError(
            "pairs must be 'primary', 'adjacent', 'all', 'sweep' or camera pairs such as "
            f"(0, 5) or [(0, 5), (1, 3)], got {pairs!r}."
        )
    listed = [*listed]
    if len(listed) == 2 and all(isinstance(camera, int | np.integer) for camera in listed):
        listed = [listed]
    found = []
    for pair in listed:
        is_text = isinstance(pair, str) and _PAIR.fullmatch(pair)
        try:
            left, right = map(int, pair.split("-")) if is_text else map(operator.index, pair)
        except (TypeError, ValueError):
            raise SelectionError(
                f"a pair is two camera numbers, such as (0, 5) or '0-5', got {pair!r}."
            ) from None
        if (left, right) not in CAMERA_PAIRS:
            cure = f"write two different cameras from 0 to {CAMERA_COUNT - 1}, the left one first"
            if (right, left) in CAMERA_PAIRS:
                cure = (
                    f"the left camera comes first: write {(right, left)}, and for the other way "
                    "round also direction='right_to_left'"
                )
            raise SelectionError(f"there is no pair {(left, right)}: {cure}.")
        found.append((left, right))
    if not found or len(set(found)) < len(found):
        raise SelectionError(f"pairs must be at least one and each only once, got {pairs!r}.")
    return tuple(found)


def _plain(
    rows: Int64[np.ndarray, " s"],
    primary: Int8[np.ndarray, "s 2"],
    *,
    pairs: PairsSpec,
    direction: Direction,
) -> PairList:
    if isinstance(pairs, str) and pairs == "primary":
        per_scene = primary[:, None, :]
    else:
        fixed = {"adjacent": ADJACENT_PAIRS, "all": CAMERA_PAIRS}.get(
            pairs if isinstance(pairs, str) else ""
        ) or require_pairs(pairs)
        per_scene = np.broadcast_to(np.array(fixed, dtype=np.int8), (len(rows), len(fixed), 2))
    flat = per_scene.reshape(-1, 2)
    if direction == "right_to_left":
        flat = flat[:, ::-1]
    return PairList(
        row=np.repeat(rows, per_scene.shape[1]),
        source=np.ascontiguousarray(flat[:, 0]),
        targets=np.ascontiguousarray(flat[:, 1:]),
    )


def _of_held_cameras(
    index: SceneIndex, rows: Int64[np.ndarray, " s"], pairs: PairList, *, name: str
) -> PairList:
    """Keep the pairs of cameras that the data hold; all of them where that would be none."""
    partial = rows[index.video_counts()[rows] < len(VIDEO_FILES)]
    keep = np.ones(len(pairs), dtype=bool)
    for row in partial.tolist():
        held = {int(video[4:6]) for video in index.indexed_scene(row).held_videos}
        own = slice(*np.searchsorted(pairs.row, [row, row + 1]))
        keep[own] = np.isin(pairs.source[own], [*held]) & np.isin(pairs.targets[own, 0], [*held])
    if keep.all() or not keep.any():
        return pairs
    if multiprocessing.parent_process() is None:
        message = text_without_secrets(
            f"{index.where}: holds some cameras alone, so pairs={name!r} gives {keep.sum()} of "
            f"{counted(len(pairs), 'pair')}."
        )
        warnings.warn(message, FewerPairsWarning, stacklevel=5)
    return pairs[keep]


def _sweeps(
    rows: Int64[np.ndarray, " s"], primary: Int8[np.ndarray, "s 2"], *, direction: Direction
) -> PairList:
    cameras = np.broadcast_to(np.arange(CAMERA_COUNT, dtype=np.int8), (len(rows), CAMERA_COUNT))
    if direction == "right_to_left":
        source = np.full(len(rows), CAMERA_COUNT - 1, dtype=np.int8)
        return PairList(row=rows, source=source, targets=cameras[:, -2::-1])
    source = primary.min(axis=1)
    return PairList(row=rows, source=source, targets=_packed(cameras, cameras > source[:, None]))


def _packed(cameras: Int8[np.ndarray, "n m"], keep: Bool[np.ndarray, "n m"]) -> Any:
    """Move the kept cameras of each row to its front, fill up with -1, cut to the longest."""
    order = np.argsort(~keep, axis=1, kind="stable")
    packed = np.take_along_axis(np.where(keep, cameras, np.int8(-1)), order, axis=1)
    return packed[:, : max(1, int(keep.sum(axis=1).max(initial=0)))]


def _within(index: SceneIndex, pairs: PairList, wanted: BaselineSpec) -> PairList:
    """Keep what lies in a range or in bins; a sweep keeps those of its targets that do."""
    found = baselines_cm(index, pairs)
    names = [wanted] if isinstance(wanted, str) else wanted
    if isinstance(names, Sequence) and names and isinstance(names[0], str):
        keep = np.zeros(found.shape, dtype=bool)
        for name in names:
            keep |= in_bin(found, str(name))
    else:
        low, high = require_range("baseline_cm", wanted)
        keep = (found >= low) & (found <= high)
    if not keep.any():
        bins = sorted({baseline_bin(value) for value in found[~np.isnan(found)]})
        raise SelectionError(
            f"{filter_text('baseline_cm', wanted)} matches none of {counted(len(pairs), 'pair')}; "
            f"found {np.nanmin(found):g} to {np.nanmax(found):g} cm, in the bins "
            f"{', '.join(bins)}."
        )
    kept = PairList(pairs.row, pairs.source, _packed(pairs.targets, keep))
    return kept[keep.any(axis=1)]


def in_bin(found: Float64[np.ndarray, "*any"], name: str) -> Bool[np.ndarray, "*any"]:
    """Return which baselines in cm lie in a bin of `BASELINE_BINS`.

    Raises:
        SelectionError: If there is no such bin.
    """
    if name not in BASELINE_BINS:
        raise SelectionError(
            f"there is no baseline bin {name!r}; the bins are {', '.join(BASELINE_BINS)}."
        )
    low, high = BASELINE_BINS[name]
    last = "[100,150]"
    above = found > low if name == "(150,inf)" else found >= low
    return above & (found <= high if name == last else found < high)
