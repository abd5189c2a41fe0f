"""Which scenes and which pairs of their cameras: by filters, by a key, by names and baselines.

Filters name themselves where they leave nothing.
"""

import difflib
import multiprocessing
import operator
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, TypedDict

import numpy as np
from jaxtyping import Bool, Float64, Int8, Int64

from stereogenbench_data.errors import SelectionError, text_without_secrets
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.records import SceneId
from stereogenbench_data.schema.release import (
    ADJACENT_PAIRS,
    BASELINE_BINS,
    CAMERA_COUNT,
    CAMERA_PAIRS,
    VIDEO_FILES,
    baseline_bin,
)
from stereogenbench_data.schema.text import counted, shortened
from stereogenbench_data.selection.spelling import did_you_mean

Range = tuple[float, float]


class SceneFilters(TypedDict, total=False):
    """Conditions on scenes. A filter that is left out, or None, lets every scene pass.

    Text filters take one value or several, of which one must match exactly. Ranges are closed:
    both ends belong to them.

    Attributes:
        split: "train" or "eval".
        subset: "seen_map" or "unseen_map" (of eval scenes).
        family: Such as "Uniform".
        map: Such as "Stylized_Egypt".
        character: The identifier of the character's mesh.
        animation: The identifier of the animation.
        scenes: Keys, such as "train/Uniform/Stylized_Egypt/scene_000041", or parts of keys that
            only one scene has, as `find_scene` understands them.
        focal_mm: Range of focal lengths in mm.
        valid_depth_ratio: Range of the share of measured depth pixels, known only for an index
            that was made with it.
        min_frames: The fewest frames that a scene may have, so that clips of that length fit.
        caption: Whole words that must all occur in the caption, in any case and order; of several
            such texts, those of one.
    """

    split: str | Sequence[str] | None
    subset: str | Sequence[str] | None
    family: str | Sequence[str] | None
    map: str | Sequence[str] | None
    character: str | Sequence[str] | None
    animation: str | Sequence[str] | None
    scenes: str | Sequence[str] | None
    focal_mm: Range | None
    valid_depth_ratio: Range | None
    min_frames: int | None
    caption: str | Sequence[str] | None


_TEXT_COLUMNS = {name: name for name in ("split", "subset", "family", "character", "animation")} | {
    "map": "map_name",
    "scenes": "key",
}
_RANGE_COLUMNS = ("focal_mm", "valid_depth_ratio")
_MOST_VALUES = 12
_LONGEST_SHOWN = 255
_PLAIN = re.compile(r"[\w./@+:-]+")
"""A value that needs no quotes in a message."""
_MOST_KEYS = 6


def filter_scenes(index: SceneIndex, filters: SceneFilters) -> Int64[np.ndarray, " n"]:
    """Return the rows of the index that pass every filter, ascending, never none.

    Raises:
        SelectionError: If no scene passes, naming the filter that left nothing, what it was
            given and what exists there; or if a filter cannot be understood.
    """
    rows = np.arange(len(index), dtype=np.int64)
    applied: list[str] = []
    for name, wanted in filters.items():
        if wanted is None:
            continue
        keep, there = _apply(index, name, wanted, rows=rows)
        if not keep.any():
            before = f" that {', '.join(applied)} left" if applied else ""
            raise SelectionError(
                f"{filter_text(name, wanted)} matches none of {counted(len(rows), 'scene')}"
                f"{before}; found {there()}{stale_note(index)}"
            )
        rows = rows[keep]
        applied.append(filter_text(name, wanted))
    if len(rows) == 0:
        raise SelectionError(f"{index.where}: the index holds no scene at all.")
    return rows


def may_pass(filters: Mapping[str, Any]) -> Callable[[SceneId], bool] | None:
    """Return whether a scene may pass filters, by its path alone; None if all may.

    All may where several characters or animations are named: their files alone say which there are.
    """
    of_path = {
        name: {wanted} if isinstance(wanted, str) else set(wanted)
        for name, wanted in filters.items()
        if name in ("split", "subset", "family", "map", "scenes")
        and isinstance(wanted, str | list | tuple)
    }
    of_files = [filters.get(name) for name in ("character", "animation")]
    if not of_path or any(isinstance(wanted, list | tuple) for wanted in of_files):
        return None

    def passes(scene: SceneId) -> bool:
        return all(
            any(str(part).strip("/").lower() in scene.key.lower() for part in wanted)
            if name == "scenes"
            else getattr(scene, _TEXT_COLUMNS[name]) in wanted
            for name, wanted in of_path.items()
        )

    return passes


def stale_note(index: SceneIndex) -> str:
    """Return what to add to a message about scenes that an index does not have."""
    return f" {index.stale}" if index.stale else ""


def _apply(
    index: SceneIndex, name: str, wanted: Any, *, rows: Int64[np.ndarray, " n"]
) -> tuple[Bool[np.ndarray, " n"], Callable[[], str]]:
    """Return which rows one filter keeps, and what describes the values that there are."""
    if name in _TEXT_COLUMNS:
        field = _TEXT_COLUMNS[name]
        column = index.column(field)
        values = column[rows]
        names = _texts(name, wanted)
        there = [*column.tolist(), *(getattr(scene, field, None) for scene in index.others)]
        known = set(there)
        if name == "scenes":  # parts of keys stand for whole ones
            names = [key if key in known else _find_key(index, sorted(there), key) for key in names]
        nowhere = sorted(set(names) - known)
        if nowhere and len(nowhere) < len(set(names)):
            raise SelectionError(
                f"{filter_text(name, nowhere[0])} matches none of {counted(len(there), 'scene')} "
                f"of the index; found {_listed(there, near=nowhere)}{stale_note(index)}"
            )
        return np.isin(values.astype(str), names), lambda: _listed(values, near=nowhere)
    if name in _RANGE_COLUMNS:
        numbers = index.column(name)[rows].astype(np.float64)
        low, high = require_range(name, wanted)
        if np.isnan(numbers).all():
            raise SelectionError(
                f"{filter_text(name, wanted)}: the index does not know it for any of "
                f"{counted(len(rows), 'scene')}. "
                "Make the index with `stereogenbench index ROOT --valid-depth`."
            )
        keep = (numbers >= low) & (numbers <= high)
        return keep, lambda: f"{np.nanmin(numbers):g} to {np.nanmax(numbers):g}."
    if name == "min_frames":
        frames = index.column("frames")[rows]
        fewest = require_whole("min_frames", wanted, least=1)
        return frames >= fewest, lambda: f"{frames.min()} to {frames.max()}."
    if name == "caption":
        texts = [wanted] if isinstance(wanted, str) else wanted
        is_list = isinstance(texts, list | tuple) and len(texts) > 0
        if not is_list or not all(isinstance(text, str) and text.split() for text in texts):
            raise SelectionError(
                f"caption must be one or more words, or a list of such texts, got {wanted!r}."
            )
        captions = [str(caption).lower() for caption in index.column("caption")[rows]]
        # Every word of one of the texts, each whole.
        patterns = [
            [re.compile(rf"(?<!\w){re.escape(word)}(?!\w)") for word in text.lower().split()]
            for text in texts
        ]
        keep = np.array(
            [
                any(all(word.search(caption) for word in words) for words in patterns)
                for caption in captions
            ],
            dtype=bool,
        )
        written = counted(sum(map(bool, captions)), "scene")
        asked = " or ".join(
            "all of " * (" " in text.strip()) + ", ".join(map(_quoted, text.lower().split()))
            for text in texts
        )
        return keep, lambda: f"captions of {written}, none with {asked}."
    filters = SceneFilters.__annotations__
    raise SelectionError(
        f"there is no filter {name!r}{did_you_mean(name, filters)} There are {', '.join(filters)}."
    )


def filter_text(name: str, wanted: Any) -> str:
    """Return a filter in the words in which it is typed, in Python and on a command line alike.

    >>> filter_text("family", ["Uniform", "IPD_Gaussian"]), filter_text("focal_mm", (18, 35))
    ('family Uniform or IPD_Gaussian', 'focal_mm 18 to 35')
    """
    is_one = isinstance(wanted, str) or whole_number(wanted) is not None
    if is_one or not isinstance(wanted, Iterable):
        return f"{name} {_quoted(wanted)}"
    values = [*wanted]
    is_range = len(values) == 2 and not any(isinstance(value, str) for value in values)
    return f"{name} {(' to ' if is_range else ' or ').join(map(_quoted, values))}"


def _quoted(value: Any) -> str:
    """Return a value as text, in quotes if spaces or odd characters are in it."""
    number = value if isinstance(value, int | float) else whole_number(value)
    if number is not None:
        return f"{number:g}"
    is_plain = isinstance(value, str) and _PLAIN.fullmatch(value)
    return shortened(value if is_plain else repr(value), _LONGEST_SHOWN)


def whole_number(number: Any) -> int | None:
    """Return a whole number of Python, numpy or torch; None of anything else.

    >>> whole_number(np.int64(3)), whole_number(3.0), whole_number(True)
    (3, None, None)
    """
    try:
        return None if isinstance(number, bool) else operator.index(number)
    except TypeError:
        return None


def require_whole(name: str, number: Any, *, least: int) -> int:
    """Return a whole number of Python, numpy or torch.

    Raises:
        SelectionError: If it is another kind of number, or below the least.
    """
    whole = whole_number(number)
    if whole is None or whole < least:
        raise SelectionError(f"{name} must be a whole number from {least}, got {number!r}.")
    return whole


def require_range(name: str, wanted: Any) -> Range:
    """Return a (low, high) pair of numbers as floats.

    Raises:
        SelectionError: If it is not two numbers in ascending order.
    """
    try:
        low, high = (float(number) for number in wanted)
    except (TypeError, ValueError):
        raise SelectionError(f"{name} must be a pair (low, high), got {wanted!r}.") from None
    if not low <= high:
        raise SelectionError(
            f"{name}: {low:g} to {high:g} is no range: give two numbers, the lower first."
        )
    return low, high


def _texts(name: str, wanted: Any) -> list[str]:
    names = [wanted] if isinstance(wanted, str) or not isinstance(wanted, Iterable) else [*wanted]
    if not names or not all(isinstance(value, str) for value in names):
        raise SelectionError(f"{name} must be a text or a sequence of texts, got {wanted!r}.")
    return names


def _listed(values: Any, *, near: list[str]) -> str:
    found = sorted({str(value) for value in values if value is not None and str(value)})
    if not found:
        return "no value."
    close = [match for name in near for match in difflib.get_close_matches(name, found, n=2)]
    first = list(dict.fromkeys([*close, *found]))[:_MOST_VALUES]
    more = f" and {len(found) - len(first)} more" if len(found) > len(first) else ""
    guess = did_you_mean(near[0], found) if near else "."
    return ", ".join(map(_quoted, first)) + more + guess


def find_scene(index: SceneIndex, text: str) -> int:
    """Return the row of the one scene whose key is a text, or ends in it, or contains it.

    Matches of whole folder names win over matches of parts of names.

    Args:
        index: Where to look.
        text: A key, or a part of one, in any case.

    Raises:
        SelectionError: If no key or several keys hold the text, naming those that are close.
    """
    keys = [str(key) for key in index.column("key")]
    return keys.index(_find_key(index, keys, text))


def _find_key(index: SceneIndex, keys: list[str], text: str) -> str:
    """Return the one of sorted keys that a text stands for; see `find_scene`."""
    lowered = [key.lower() for key in keys]
    wanted = text.strip("/").lower()
    for matches in (
        [row for row, key in enumerate(keys) if key == text],
        [row for row, key in enumerate(lowered) if f"/{key}".endswith(f"/{wanted}")],
        [row for row, key in enumerate(lowered) if f"/{wanted}/" in f"/{key}/"],
        [row for row, key in enumerate(lowered) if wanted in key],
    ):
        if len(matches) == 1:
            return keys[matches[0]]
        if matches:
            raise SelectionError(
                f"{shortened(text)!r} is a part of {len(matches)} keys: "
                f"{_first_keys([keys[row] for row in matches])}. Give more of the key."
            )
    near = _near_keys(wanted, keys)
    raise SelectionError(
        f"{shortened(text)!r} is not a key of {counted(len(keys), 'scene')}, nor a part of one. "
        + (f"Did you mean {_first_keys(near)}?" if near else f"There is {_first_keys(keys)}.")
        + stale_note(index)
    )


def _near_keys(wanted: str, keys: list[str]) -> list[str]:
    """Return the keys whose end, as long as what is wanted, is most like it."""
    levels = wanted.count("/") + 1
    ends: dict[str, list[str]] = {}
    for key in keys:
        ends.setdefault("/".join(key.lower().split("/")[-levels:]), []).append(key)
    close = difflib.get_close_matches(wanted, ends, n=_MOST_KEYS)
    return [key for end in close for key in ends[end]]


def _first_keys(keys: list[str]) -> str:
    more = f" and {len(keys) - _MOST_KEYS} more" if len(keys) > _MOST_KEYS else ""
    return ", ".join(keys[:_MOST_KEYS]) + more


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
    is_turned, count = direction == "right_to_left", len(rows)
    primary = np.stack(
        [index.column("primary_left")[rows], index.column("primary_right")[rows]], axis=1
    ).astype(np.int8)
    name = pairs if isinstance(pairs, str) else ""
    if name == "sweep":
        cameras = np.tile(
            np.arange(CAMERA_COUNT, dtype=np.int8)[:: -1 if is_turned else 1], (count, 1)
        )
        source = np.full(count, CAMERA_COUNT - 1, np.int8) if is_turned else primary.min(axis=1)
        beside = cameras < source[:, None] if is_turned else cameras > source[:, None]
        chosen = PairList(rows, source, _packed(cameras, beside))
    else:
        per_scene = primary[:, None, :]
        if name != "primary":
            named = {"adjacent": ADJACENT_PAIRS, "all": CAMERA_PAIRS}
            fixed = np.array(named.get(name) or require_pairs(pairs), dtype=np.int8)
            per_scene = np.broadcast_to(fixed, (count, *fixed.shape))
        flat = per_scene.reshape(-1, 2)[:, :: -1 if is_turned else 1]
        chosen = PairList(np.repeat(rows, per_scene.shape[1]), flat[:, 0], flat[:, 1:])
        if name in ("adjacent", "all"):
            chosen = _of_held_cameras(index, rows, chosen, name=name)
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
    if len(listed) == 2 and None not in map(whole_number, listed):
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
        keep = np.logical_or.reduce([in_bin(found, str(name)) for name in names])
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
