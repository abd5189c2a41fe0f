"""What the page lists: the scenes and pairs that a choice leaves, counts, and a Python line."""

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Int64

from stereogenbench_data.audit.pictures import derived_text
from stereogenbench_data.errors import SelectionError
from stereogenbench_data.geometry.camera import rig_intrinsics
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.conventions import depth_of
from stereogenbench_data.schema.records import Scene
from stereogenbench_data.schema.release import BASELINE_BINS, CAMERA_PAIRS, baseline_bin
from stereogenbench_data.schema.text import shortened
from stereogenbench_data.selection.filters import (
    PairList,
    baselines_cm,
    choose_pairs,
    filter_scenes,
    find_scene,
    in_bin,
)

MOST_ROWS: Final = 200
"""The largest number of scenes in one response."""

FACETS: Final = {"split": "split", "subset": "subset", "family": "family", "map": "map_name"}
"""The filters whose values the page lists, and the index columns of these."""
PAIR_KINDS: Final = ("primary", "adjacent", "all")

Choice = Mapping[str, Any]
"""The filters that are set on the page, as keyword arguments of `StereoPairs`."""


def parse_choice(query: Mapping[str, list[str]]) -> Choice:
    """Return the choice in a query.

    Args:
        query: Maps names to values: names of `FACETS` and ``bin`` with any number of values;
            ``focal_low``, ``focal_high``, ``baseline_low``, ``baseline_high``, ``caption`` and
            ``pairs`` with one.

    Raises:
        SelectionError: If a number is not a number, or there are no such pairs.
    """
    texts = {name: sorted(set(query[name])) for name in FACETS if query.get(name)}
    choice: dict[str, Any] = {
        name: values[0] if len(values) == 1 else values for name, values in texts.items()
    }
    choice |= {
        "focal_mm": _range(query, "focal"),
        "caption": " ".join(query.get("caption", [""])[0].split()),
        "baseline_cm": sorted(set(query.get("bin", ()))) or _range(query, "baseline"),
    }
    pairs = query.get("pairs", ["all"])[0]
    if pairs not in PAIR_KINDS:
        known = ", ".join(PAIR_KINDS)
        raise SelectionError(f"there is no choice {shortened(pairs)!r}: choose among {known}.")
    return {name: value for name, value in choice.items() if value} | {"pairs": pairs}


def _range(query: Mapping[str, list[str]], name: str) -> tuple[float, ...] | None:
    """Return the closed range of two numbers; an end that is left out is open."""
    ends = [query.get(f"{name}_{end}", [""])[0].strip() for end in ("low", "high")]
    try:
        numbers = float(ends[0] or 0), float(ends[1] or 1e6)
        whole = tuple(int(each) if each == round(each) else each for each in numbers)
    except (ValueError, OverflowError):
        raise SelectionError(f"{name} must be of numbers, got {shortened(str(ends))}.") from None
    return whole if any(ends) else None


class ChosenPairs(NamedTuple):
    """Rows of scenes with a pair left, ascending; these pairs; and why there is none, if so."""

    rows: Int64[np.ndarray, " n"]
    pairs: PairList
    reason: str = ""


class Catalogue:
    """The scenes of an index as the page asks for them; may be used by any thread."""

    def __init__(self, index: SceneIndex, *, shown_data: str) -> None:
        """Take an index, and the argument of `StereoPairs` for its data."""
        self.index = index
        self._data = shown_data

    def row(self, key: str) -> int:
        """Return the row of a key, or of a part of one that only one scene has.

        Raises:
            SelectionError: If there is no such scene, naming those that are close.
        """
        return find_scene(self.index, key)

    def about(self) -> dict[str, Any]:
        """Return what the page shows of the data as a whole."""
        focal_mm = self.index.column("focal_mm")
        rows = np.arange(len(self.index), dtype=np.int64)
        found = baselines_cm(self.index, choose_pairs(self.index, rows, pairs="all"))
        return {
            "data": self._data,
            "scenes": len(self.index),
            "focal_mm": [float(focal_mm.min()), float(focal_mm.max())],
            "baseline_cm": [float(found.min()), float(found.max())],
            "left_out": {**self.index.broken, **self.index.incomplete},
        }

    def summary(self, choice: Choice) -> dict[str, Any]:
        """Return how many scenes and pairs a choice leaves, why none, and the filters' counts.

        The line is Python that selects the chosen pairs with all frames; it runs as it is.
        A filter's value counts the scenes that all other filters leave; a baseline bin counts
        pairs.
        """
        chosen = self.choose(choice)
        return {
            "scenes": len(chosen.rows),
            "pairs": len(chosen.pairs),
            "reason": chosen.reason,
            "line": self._line("pairs", {"pairs": "all", **choice, "frames": "all"}),
            "counts": {name: self._counts(choice, name) for name in FACETS}
            | {"bin": self._bin_counts(choice)},
        }

    def listed(self, choice: Choice, *, first: int, count: int) -> dict[str, Any]:
        """Return some of the chosen scenes, in the order of their keys."""
        rows = self.choose(choice).rows
        first = min(max(first, 0), len(rows))
        wanted = rows[first : first + min(max(count, 0), MOST_ROWS)]
        names = ("key", "subset", "focal_mm", "baselines_cm")
        columns = {name: self.index.column(name) for name in names}
        return {
            "total": len(rows),
            "first": first,
            "rows": [
                {
                    "key": str(columns["key"][row]),
                    "subset": columns["subset"][row] or "",
                    "focal_mm": round(float(columns["focal_mm"][row]), 2),
                    "baseline_cm": [
                        round(float(columns["baselines_cm"][row].min()), 2),
                        round(float(columns["baselines_cm"][row].max()), 2),
                    ],
                }
                for row in wanted.tolist()
            ],
        }

    def place(self, choice: Choice, key: str) -> int:
        """Return the position of a scene among the chosen ones, -1 if it is not one of them."""
        rows, row = self.choose(choice).rows, self.row(key)
        place = int(np.searchsorted(rows, row))
        return place if place < len(rows) and rows[place] == row else -1

    def scene(self, key: str, choice: Choice) -> dict[str, Any]:
        """Return a scene's facts, and its pairs from the narrowest to the widest.

        Args:
            key: A key, or a part of one that only one scene has.
            choice: Whose pairs are marked as chosen.

        Raises:
            SelectionError: If there is no such scene, naming those that are close.
        """
        row = self.row(key)
        scene, pairs = self.index.scene(row), self.choose(choice).pairs
        mine = pairs.row == row
        selected = set(
            zip(pairs.source[mine].tolist(), pairs.targets[mine, 0].tolist(), strict=True)
        )
        return _facts(scene) | {
            "place": self.place(choice, key),
            "pairs": [
                {
                    "cameras": [left, right],
                    "baseline_cm": scene.rig.baseline_cm(left, right),
                    "bin": baseline_bin(scene.rig.baseline_cm(left, right)),
                    "primary": (left, right) == scene.rig.primary_pair,
                    "chosen": (left, right) in selected,
                }
                for left, right in sorted(
                    CAMERA_PAIRS, key=lambda pair: (scene.rig.baseline_cm(*pair), pair)
                )
            ],
        }

    def sample_line(self, key: str, *, pair: tuple[int, int], frame: int) -> str:
        """Return Python that gives the sample shown; it runs as it is."""
        key = str(self.index.column("key")[self.row(key)])
        return self._line("sample", {"scenes": key, "pairs": [pair], "frames": frame}) + "[0]"

    def _line(self, name: str, options: Mapping[str, Any]) -> str:
        given = "".join(f", {option}={value!r}" for option, value in options.items())
        return (
            f"from stereogenbench_data import StereoPairs\n"
            f"{name} = StereoPairs({self._data!r}{given})"
        )

    def choose(self, choice: Choice) -> ChosenPairs:
        """Return what a choice leaves."""
        filters: Any = dict(choice)
        wanted = {name: filters.pop(name, None) for name in ("pairs", "baseline_cm")}
        try:
            rows = filter_scenes(self.index, filters)
            pairs = choose_pairs(
                self.index, rows, pairs=wanted["pairs"] or "all", baseline_cm=wanted["baseline_cm"]
            )
        except SelectionError as error:
            empty = choose_pairs(self.index, np.zeros(0, dtype=np.int64), pairs="all")
            return ChosenPairs(empty.row, empty, str(error))
        return ChosenPairs(np.unique(pairs.row), pairs)

    def _counts(self, choice: Choice, facet: str) -> dict[str, int]:
        """Return, for each value of a filter, how many scenes the other filters leave."""
        others = {name: value for name, value in choice.items() if name != facet}
        column = self.index.column(FACETS[facet])
        known = sorted({str(value) for value in column if value is not None})
        found, counts = np.unique(column[self.choose(others).rows].astype(str), return_counts=True)
        left = dict(zip(found.tolist(), counts.tolist(), strict=True))
        return {value: left.get(value, 0) for value in known}

    def _bin_counts(self, choice: Choice) -> dict[str, int]:
        pairs = self.choose({n: each for n, each in choice.items() if n != "baseline_cm"}).pairs
        found = baselines_cm(self.index, pairs)[:, 0]
        return {name: int(in_bin(found, name).sum()) for name in BASELINE_BINS}


def _facts(scene: Scene) -> dict[str, Any]:
    rig, camera = scene.rig, rig_intrinsics(scene.rig)
    encoding = scene.depth_encoding(0, depth_of(scene))
    return {
        "key": scene.id.key,
        "caption": scene.caption,
        "frames": scene.frames,
        "frame_rate_hz": scene.frame_rate_hz,
        "width_px": rig.image_width_px,
        "height_px": rig.image_height_px,
        "focal_mm": rig.focal_mm,
        "fx_px": camera.fx_px,
        "depth_unit_m": encoding.unit_m,
        "depth_unit_source": encoding.source,
        "rig_residual_px": scene.rig_residual_px,
        "derived": derived_text(scene),
    }
