"""Which scenes: by filters, each of which names itself where it leaves nothing, or by a key."""

import difflib
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypedDict

import numpy as np
from jaxtyping import Bool, Int64

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.records import SceneId
from stereogenbench_data.schema.text import counted, shortened
from stereogenbench_data.selection.options import did_you_mean

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
        caption: Words that must all occur in the caption, in any case and order.
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
    caption: str | None


_TEXT_COLUMNS = {
    "split": "split",
    "subset": "subset",
    "family": "family",
    "map": "map_name",
    "character": "character",
    "animation": "animation",
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
            before = f" of those left by {', '.join(applied)}" if applied else ""
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
    """Return whether a scene may pass filters, by its path alone; None if all may."""
    of_path = {
        name: {wanted} if isinstance(wanted, str) else set(wanted)
        for name, wanted in filters.items()
        if name in ("split", "subset", "family", "map", "scenes")
        and isinstance(wanted, str | list | tuple)
    }
    if not of_path:
        return None

    def passes(scene: SceneId) -> bool:
        values = {
            "split": scene.split, "subset": scene.subset, "family": scene.family,
            "map": scene.map_name,
        }  # fmt: skip
        return all(
            any(str(part).strip("/").lower() in scene.key.lower() for part in wanted)
            if name == "scenes"
            else values[name] in wanted
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
        column = index.column(_TEXT_COLUMNS[name])
        values = column[rows]
        names = _texts(name, wanted)
        if name == "scenes":
            names = _whole_keys(index, names)
        nowhere = sorted(set(names) - set(column.tolist()))
        if nowhere and len(nowhere) < len(set(names)):
            raise SelectionError(
                f"{filter_text(name, nowhere[0])} matches none of {counted(len(column), 'scene')} "
                f"of the index; found {_listed(column, near=nowhere)}{stale_note(index)}"
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
        if isinstance(wanted, bool) or not isinstance(wanted, int | np.integer) or wanted < 1:
            raise SelectionError(f"min_frames must be a whole number from 1, got {wanted!r}.")
        return frames >= wanted, lambda: f"{frames.min()} to {frames.max()}."
    if name == "caption":
        return _caption_filter(index, wanted, rows=rows)
    known = SceneFilters.__annotations__
    raise SelectionError(
        f"there is no filter {name!r}{did_you_mean(name, known)} There are {', '.join(known)}."
    )


def filter_text(name: str, wanted: Any) -> str:
    """Return a filter in the words in which it is typed, in Python and on a command line alike.

    >>> filter_text("family", ["Uniform", "IPD_Gaussian"]), filter_text("focal_mm", (18, 35))
    ('family Uniform or IPD_Gaussian', 'focal_mm 18 to 35')
    """
    if isinstance(wanted, str) or not isinstance(wanted, Iterable):
        return f"{name} {_quoted(wanted)}"
    values = [*wanted]
    is_range = len(values) == 2 and not any(isinstance(value, str) for value in values)
    return f"{name} {(' to ' if is_range else ' or ').join(map(_quoted, values))}"


def _quoted(value: Any) -> str:
    """Return a value as text, in quotes if spaces or odd characters are in it."""
    if isinstance(value, int | float):
        return f"{value:g}"
    is_plain = isinstance(value, str) and _PLAIN.fullmatch(value)
    return shortened(value if is_plain else repr(value), _LONGEST_SHOWN)


def _whole_keys(index: SceneIndex, names: list[str]) -> list[str]:
    """Return keys of scenes in place of parts of keys."""
    known = set(index.column("key").tolist())
    return [
        name if name in known else str(index.column("key")[find_scene(index, name)])
        for name in names
    ]


def _caption_filter(
    index: SceneIndex, wanted: Any, *, rows: Int64[np.ndarray, " n"]
) -> tuple[Bool[np.ndarray, " n"], Callable[[], str]]:
    if not isinstance(wanted, str) or not wanted.split():
        raise SelectionError(f"caption must be one or more words, got {wanted!r}.")
    words = wanted.lower().split()
    captions = [str(caption).lower() for caption in index.column("caption")[rows]]
    keep = np.array([all(word in caption for word in words) for caption in captions], dtype=bool)
    written = sum(map(bool, captions))
    all_words = f"all of {', '.join(map(_quoted, words))}" if len(words) > 1 else _quoted(words[0])
    return keep, lambda: f"captions of {counted(written, 'scene')}, none with {all_words}."


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
    lowered = [key.lower() for key in keys]
    wanted = text.strip("/").lower()
    for matches in (
        [row for row, key in enumerate(keys) if key == text],
        [row for row, key in enumerate(lowered) if f"/{key}".endswith(f"/{wanted}")],
        [row for row, key in enumerate(lowered) if f"/{wanted}/" in f"/{key}/"],
        [row for row, key in enumerate(lowered) if wanted in key],
    ):
        if len(matches) == 1:
            return matches[0]
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
