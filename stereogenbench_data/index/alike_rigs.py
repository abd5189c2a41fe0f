"""Thousands of ``baseline.json`` that are alike: read in a tenth of the time of one by itself.

Files that one program wrote differ in numbers and names alone. After some files of one shape (the
same keys, lists and kinds of values) the places are known at which the values of a rig stand, by
the values that `parse_rig` found. Another file of that shape is read at these places if all else in
it is as in those; where anything differs that was the same so far, `parse_rig` reads it, too.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from operator import itemgetter
from typing import Any, Final, NamedTuple

from stereogenbench_data.schema.conventions import Shape
from stereogenbench_data.schema.document import MOST_LETTERS, camera_of, is_number, parse_object
from stereogenbench_data.schema.parse import parse_rig
from stereogenbench_data.schema.records import Remark, Rig, SceneLabels
from stereogenbench_data.schema.release import CAMERA_COUNT

Parsed = tuple[Rig, SceneLabels, tuple[Remark, ...]]

_LEARNED_FROM: Final = 8
_MOST_EXAMPLES: Final = 64
_MOST_VALUES: Final = 2000
"""A file with more values is read by itself: a released one has some hundreds."""
_SCALES: Final = (1.0, 100.0, 0.1, 10.0, 1000.0)
"""From a unit in which lengths may be written to cm or mm."""
_NUMBERS: Final = {
    **dict.fromkeys(("focal_mm", "sensor_width_mm", "sensor_height_mm"), float),
    **dict.fromkeys(("image_width_px", "image_height_px"), int),
}
_LABELS: Final = tuple(each.name for each in fields(SceneLabels))


class _Source(NamedTuple):
    """Where a value of the record stands in files of a shape, and what it is multiplied by.

    Without places the value is the same in all files.
    """

    places: tuple[int, ...]
    scale: float
    value: Any


@dataclass(slots=True)
class _Shape:
    """Files of one shape: those that `parse_rig` read, and what follows for others."""

    examples: list[tuple[list[Any], Parsed]] = field(default_factory=list)
    sources: list[_Source] | None = None
    same_at: tuple[int, ...] = ()
    same: tuple[Any, ...] = ()
    ends: dict[int, str] = field(default_factory=dict)
    varied: tuple[int, ...] = ()

    def add(self, values: list[Any], parsed: Parsed) -> None:
        """Take another example, and find the places anew."""
        if len(self.examples) >= _MOST_EXAMPLES:
            return
        self.examples.append((values, parsed))
        if len(self.examples) >= _LEARNED_FROM:
            self._learn()

    def _learn(self) -> None:
        self.sources = None
        columns = list(zip(*(values for values, _ in self.examples), strict=True))
        rig = self.examples[0][1][0]
        if any(_unlearned(parsed[0]) != _unlearned(rig) for _, parsed in self.examples):
            return
        is_same = [all(value == column[0] for value in column) for column in columns]
        varied = [place for place, same in enumerate(is_same) if not same]
        sources = []
        for wanted in zip(*(_values(parsed) for _, parsed in self.examples), strict=True):
            source = _source(wanted, {place: columns[place] for place in varied})
            if source is None:
                return
            sources.append(source)
        self.ends = {}
        for place in varied:
            texts = [each for each in columns[place] if isinstance(each, str)]
            if len({camera_of(each) for each in texts}) == 1 and camera_of(texts[0]) is not None:
                end = texts[0]
                while not all(text.endswith(end) for text in texts):
                    end = end[1:]
                self.ends[place] = end
        same_at = [place for place, same in enumerate(is_same) if same]
        # The first one twice: of one place `itemgetter` would return no tuple.
        self.same_at = (*same_at, *same_at[:1])
        self.same = itemgetter(*self.same_at)(self.examples[0][0]) if same_at else ()
        self.varied, self.sources = tuple(varied), sources

    def read(self, values: list[Any]) -> Parsed | None:
        """Return what a file of this shape holds; None where it is not like the examples."""
        if self.sources is None or not self._is_alike(values):
            return None
        found = []
        for places, scale, value in self.sources:
            if not places:
                found.append(value)
                continue
            stated = values[places[0]]
            is_text = isinstance(stated, str)
            if any(values[place] != stated for place in places) or not (is_text or stated > 0):
                return None
            found.append(stated if is_text or scale == 1 else stated * scale)
        return _parsed(found, like=self.examples[0][1][0])

    def _is_alike(self, values: list[Any]) -> bool:
        """Return whether what was the same in all examples is so here, and the rest is plain."""
        if self.same and itemgetter(*self.same_at)(values) != self.same:
            return False
        for place in self.varied:
            value = values[place]
            if not isinstance(value, str):
                if not is_number(value):
                    return False
            elif (
                len(value) > MOST_LETTERS
                or not value.isascii()
                or not value.endswith(self.ends.get(place, ""))
            ):
                return False
        return True


class RigReader:
    """Reads ``baseline.json`` files as `parse_rig` does, faster where many are alike."""

    def __init__(self, stated: Shape | None = None) -> None:
        """Know no file yet, but what conventions state."""
        self._stated = stated
        self._shapes: dict[tuple[Any, ...], _Shape] = {}

    def read(self, text: bytes, *, where: str) -> Parsed:
        """Return what `parse_rig` returns.

        A second statement of a value that was another number than the first in all files so far,
        such as a field of view, is not compared here.

        Raises:
            SchemaError: As `parse_rig`.
        """
        shape, values = _flat(parse_object(text, where=where))
        if len(values) > _MOST_VALUES:
            return parse_rig(text, where=where, shape=self._stated)
        known = self._shapes.setdefault(shape, _Shape())
        found = known.read(values)
        if found is None:
            found = parse_rig(text, where=where, shape=self._stated)
            if not found[2]:
                known.add(values, found)
        return found


def _flat(document: dict[str, Any]) -> tuple[tuple[Any, ...], list[Any]]:
    """Return the shape of a document, which can be compared, and its texts, numbers and others.

    What looks like the number of a camera is a part of the shape: primary pairs may differ.
    """
    shape: list[Any] = []
    values: list[Any] = []
    waiting: list[Any] = [document]
    for node in waiting:
        if type(node) is dict:
            shape.append(tuple(node))
            inner: Any = node.values()
        else:
            shape.append(len(node))
            inner = node
        for value in inner:
            kind: Any = type(value)
            if kind is dict or kind is list:
                waiting.append(value)
            else:
                values.append(value)
                if kind is int and 0 <= value <= CAMERA_COUNT:
                    kind = value
                elif kind is str and value[-1:].isdigit() and "cam" in value.lower():
                    kind = value[-2:]
            shape.append(kind)
    return tuple(shape), values


def _values(parsed: Parsed) -> list[Any]:
    """Return the values of records for which places are looked for."""
    rig, labels, _ = parsed
    numbers = [getattr(rig, name) for name in _NUMBERS]
    return [*numbers, *rig.baselines_cm, *(getattr(labels, name) for name in _LABELS)]


def _parsed(values: Sequence[Any], *, like: Rig) -> Parsed:
    """Return the records of such values."""
    count = len(_NUMBERS)
    labels_at = count + len(like.baselines_cm)
    numbers: dict[str, Any] = {
        name: kind(value) for (name, kind), value in zip(_NUMBERS.items(), values, strict=False)
    }
    rig = replace(like, baselines_cm=tuple(map(float, values[count:labels_at])), **numbers)
    return rig, SceneLabels(*values[labels_at:]), ()


def _unlearned(rig: Rig) -> Rig:
    """Return what of a rig must be the same in all files of a shape."""
    nothing: dict[str, Any] = dict.fromkeys(_NUMBERS, 0)
    return replace(rig, baselines_cm=(), **nothing)


def _source(wanted: tuple[Any, ...], columns: dict[int, tuple[Any, ...]]) -> _Source | None:
    """Return where a value stands in files, given the values of some that vary."""
    if all(value == wanted[0] for value in wanted):
        return _Source((), 1.0, wanted[0])
    for scale in _SCALES:
        places = tuple(
            place
            for place, column in columns.items()
            if all(
                _scaled(value, scale) == other and type(value) is not bool
                for value, other in zip(column, wanted, strict=True)
            )
        )
        if places:
            return _Source(places, scale, None)
    return None


def _scaled(value: Any, scale: float) -> Any:
    """Return a number of a file in another unit; other values as they are."""
    if scale == 1 or not isinstance(value, int | float):
        return value
    return value * scale if math.isfinite(value) else math.nan
