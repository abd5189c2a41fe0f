"""Thousands of ``baseline.json`` that are alike: read in a tenth of the time of one by itself.

Files that one program wrote differ in numbers and names alone. After some files of one shape (the
same keys, lists and kinds of values) the places are known at which the values of a rig stand, by
the values that `parse_rig` found. Another file of that shape is read at these places if all else in
it is as in those; where anything differs that was the same so far, `parse_rig` reads it, too.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Final

from stereogenbench_data.schema.conventions import Shape
from stereogenbench_data.schema.document import MOST_LETTERS, camera_of, is_number, parse_object
from stereogenbench_data.schema.parse import parse_rig
from stereogenbench_data.schema.records import Remark, Rig, SceneLabels
from stereogenbench_data.schema.release import CAMERA_COUNT, CAMERA_PAIRS

Parsed = tuple[Rig, SceneLabels, tuple[Remark, ...]]
Source = tuple[tuple[int, ...], float, Any]
"""The places in files of a shape at which a value of the records stands, what it is multiplied by
there, and its value in the first file: without places, that of all."""

_LEARNED_FROM: Final = 8
_MOST_EXAMPLES: Final = 64
_MOST_VALUES: Final = 2000
"""A file with more values is read by itself: a released one has some hundreds."""
_SCALES: Final = (1.0, 100.0, 0.1, 10.0, 1000.0)
"""From a unit in which lengths may be written to cm or mm."""
_RIG, _LABELS = ([each.name for each in fields(kind) if each.name != "baselines_cm"]
                 for kind in (Rig, SceneLabels))  # fmt: skip


@dataclass(slots=True)
class _Shape:
    """Files of one shape: those that `parse_rig` read, and what follows for others."""

    examples: list[tuple[list[Any], Parsed]] = field(default_factory=list)
    sources: list[Source] = field(default_factory=list)
    same: dict[int, Any] = field(default_factory=dict)

    def add(self, values: list[Any], parsed: Parsed) -> None:
        """Take another example, and find the places anew."""
        self.examples.append((values, parsed))
        if not _LEARNED_FROM <= len(self.examples) <= _MOST_EXAMPLES:
            return
        columns = dict(enumerate(zip(*(values for values, _ in self.examples), strict=True)))
        varied = {at: column for at, column in columns.items() if len({*column}) > 1}
        wanted = zip(*(_values_of(parsed) for _, parsed in self.examples), strict=True)
        found = [_source(each, varied) for each in wanted]
        # Where names vary and end in one camera alike, another file may name another camera.
        ends = ({*map(camera_of, column)} for column in varied.values()
                if _kind_of(column[0]) is str)  # fmt: skip
        is_odd = None in found or any(len(each) == 1 and None not in each for each in ends)
        self.sources = [] if is_odd else [each for each in found if each]
        self.same = {at: column[0] for at, column in columns.items() if at not in varied}

    def read(self, values: list[Any]) -> Parsed | None:
        """Return what a file of this shape holds; None where it is not like the examples."""
        if not self.sources or any(values[at] != same for at, same in self.same.items()):
            return None
        if not all(_is_plain(value) for at, value in enumerate(values) if at not in self.same):
            return None
        found = []
        for places, scale, first in self.sources:
            stated = values[places[0]] if places else first
            if any(values[at] != stated for at in places):
                return None
            if places and not isinstance(stated, str):
                if stated <= 0:
                    return None
                stated = type(first)(stated * scale)
            found.append(stated)
        count = len(CAMERA_PAIRS)
        rig: dict[str, Any] = dict(zip(_RIG, found[count:], strict=False))
        labels = SceneLabels(*found[count + len(_RIG) :])
        return Rig(baselines_cm=tuple(found[:count]), **rig), labels, ()


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
        known = self._shapes.setdefault(shape, _Shape())
        found = known.read(values)
        if found is None:
            found = parse_rig(text, where=where, shape=self._stated)
            if not found[2] and len(values) <= _MOST_VALUES:
                known.add(values, found)
        return found


def _flat(document: dict[str, Any]) -> tuple[tuple[Any, ...], list[Any]]:
    """Return the shape of a document, which can be compared, and its texts, numbers and others."""
    shape: list[Any] = []
    values: list[Any] = []
    waiting: list[Any] = [document]
    for node in waiting:
        is_object = type(node) is dict
        shape.append(tuple(node) if is_object else len(node))
        for value in node.values() if is_object else node:
            if type(value) is dict or type(value) is list:
                waiting.append(value)
                shape.append(type(value))
            else:
                values.append(value)
                shape.append(_kind_of(value))
    return tuple(shape), values


def _kind_of(value: Any) -> Any:
    """Return a value's type, or the number of a camera that it looks like: primary pairs differ."""
    if type(value) is int and 0 <= value <= CAMERA_COUNT:
        return value
    if type(value) is str and value[-1:].isdigit() and "cam" in value.lower():
        return value[-2:]
    return type(value)


def _is_plain(value: Any) -> bool:
    """Return whether a value is a number or a short text that `parse_rig` accepts as a label."""
    if isinstance(value, str):
        return len(value) <= MOST_LETTERS and value.isascii()
    return is_number(value)


def _values_of(parsed: Parsed) -> list[Any]:
    """Return the values of records for which places are looked for."""
    rig, labels, _ = parsed
    numbers = [*rig.baselines_cm, *(getattr(rig, name) for name in _RIG)]
    return [*numbers, *(getattr(labels, name) for name in _LABELS)]


def _source(wanted: tuple[Any, ...], columns: Mapping[int, tuple[Any, ...]]) -> Source | None:
    """Return where a value stands in files, given the values of some that vary."""
    if all(value == wanted[0] for value in wanted):
        return (), 1.0, wanted[0]
    for scale in _SCALES:
        places = tuple(
            at for at, column in columns.items()
            if all(other == (value * scale if is_number(value) and scale != 1 else value)
                   and type(value) is not bool
                   for value, other in zip(column, wanted, strict=True))
        )  # fmt: skip
        if places:
            return places, scale, wanted[0]
    return None
