"""Places in a JSON document: one way of writing where values stand, read in linear time.

    $.camera_intrinsics.focal_length_mm     a value
    $.primary_stereo_pair[0]                an element of a list
    $["the map"].name                       a key that is no plain word
    $.frames[].cameras[]                    all elements of lists: an axis each
    $.frames{}, $.frames[].{Cam_}           all entries whose keys end in a number (after "Cam_")
    $.frames{*}, $.frames[].{Cam_*}         all entries (whose keys begin with "Cam_")
    $.frames[].cameras[].location[x,y,z]    several values below, side by side
    $.cameras[].pose[0:3]                   a part of a list
    $.pose~                                 the numbers of a text
    $.frames[].{}#, $.frames[].name#        the last number of the entry's key, or of a name; #0 is
                                            its first

There are no patterns: places come with an index from people whom nobody knows, and whatever they
say, each value of a document is visited once for each place.
"""

import functools
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.document import brief, child_path

_STEP: Final = re.compile(
    r'\.?(?P<plain>[^.\[\]{}#~"]+)|\[(?P<at>[0-9]{1,9})\]|\[(?P<quoted>"(?:[^"\\]|\\.)*")\]|'
    r"(?P<all>\[\])|\.?\{(?P<named>[^{}]{0,60})\}"
)
_TAIL: Final = re.compile(
    r"\[(?P<start>[0-9]{0,4}):(?P<stop>[0-9]{0,4})\]|\[(?P<parts>[^:\"]+,[^:\"]+)\]|(?P<text>~)|"
    r"#(?P<number>[0-9]?)"
)
_NUMBER: Final = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
_DIGITS: Final = re.compile(r"[0-9]+")
_ENDS_IN_DIGITS: Final = re.compile(r"(.*?)([0-9]{1,9})\Z", re.DOTALL)
_MOST_PARTS: Final = 16
_LONGEST_TEXT: Final = 4096


@dataclass(frozen=True, slots=True)
class Entries:
    """A step to entries of an object.

    They are those whose keys end in a number, after some text or any; or, where the text ends in
    "*", those whose keys begin with it.
    """

    text: str


@dataclass(frozen=True, slots=True)
class Every:
    """A step to all elements of a list."""


Step = str | int | Entries | Every


@dataclass(frozen=True, slots=True)
class Place:
    """A place as it is written, and its parts.

    Attributes:
        text: The place as it is written.
        steps: The way to it.
        tail: What is taken there: the value, numbers of a text, a number of the last key, values
            side by side, or a part of a list.
        number: Which number of the key; -1 is the last.
        parts: The ways to what stands side by side.
        part: The part of a list.
    """

    text: str
    steps: tuple[Step, ...]
    tail: Literal["", "text", "key", "parts", "slice"] = ""
    number: int = -1
    parts: tuple[tuple[Step, ...], ...] = ()
    part: tuple[int, int | None] = (0, None)

    @property
    def axes(self) -> int:
        """How many steps lead to all elements of a list or an object."""
        steps = self.steps + (self.parts[0] if self.parts else ())
        return sum(isinstance(step, Every | Entries) for step in steps)


@functools.lru_cache(maxsize=1024)
def place_at(text: str) -> Place:
    """Return a place that is written as above; without a ``$``, one below a row.

    Raises:
        LookupError: If it is not written so.

    >>> place_at('$.a[0]["b c"]').steps
    ('a', 0, 'b c')
    """
    rest = text.removeprefix("$")
    if rest != text and rest[:1] not in ("", ".", "[", "{"):
        raise LookupError(text)
    steps, end = _steps(rest)
    tail = _TAIL.fullmatch(rest, end)
    if end < len(rest) and tail is None:
        raise LookupError(text)
    if tail is None:
        return Place(text, steps)
    if tail["parts"]:
        parts = tail["parts"].split(",")
        ways = [_steps(part.strip()) for part in parts]
        is_whole = all(end == len(part.strip()) for part, (_, end) in zip(parts, ways, strict=True))
        if not is_whole or len(parts) > _MOST_PARTS:
            raise LookupError(text)
        return Place(text, steps, "parts", parts=tuple(way for way, _ in ways))
    if tail["text"]:
        return Place(text, steps, "text")
    if tail["number"] is not None:
        return Place(text, steps, "key", number=int(tail["number"] or -1))
    part = int(tail["start"] or 0), int(tail["stop"]) if tail["stop"] else None
    return Place(text, steps, "slice", part=part)


def _steps(text: str) -> tuple[tuple[Step, ...], int]:
    """Return the steps that a text begins with, and where they end."""
    steps: list[Step] = []
    end = 0
    while (match := _STEP.match(text, end)) is not None:
        if match["plain"] is not None:
            if end and text[end] != ".":
                break
            steps.append(match["plain"])
        elif match["quoted"] is not None:
            try:
                steps.append(json.loads(match["quoted"]))
            except json.JSONDecodeError as error:  # an escape that JSON does not have
                raise LookupError(text) from error
        elif match["at"] is not None:
            steps.append(int(match["at"]))
        else:
            steps.append(Every() if match["all"] else Entries(match["named"]))
        end = match.end()
    return tuple(steps), end


def value_at(document: Any, text: str) -> Any:
    """Return the value at a place without axes.

    Raises:
        LookupError: If there is none.

    >>> value_at({"a": [{"b c": 7}]}, '$.a[0]["b c"]'), value_at({"a": "0-3"}, "$.a~")
    (7, [0.0, -3.0])
    """
    found = _value(document, place_at(text))
    if found is _NOTHING:
        raise LookupError(text)
    return found


def first_value(document: Any, places: Sequence[str]) -> tuple[str, Any]:
    """Return the first of some places at which something stands, and what; ("", None) if none."""
    for text in places:
        found = _value(document, place_at(text))
        if found is not _NOTHING:
            return text, found
    return "", None


_NOTHING: Final = object()


def _value(document: Any, place: Place) -> Any:
    for step in place.steps:
        kind = type(document)
        if kind is dict:
            document = document.get(step, _NOTHING)
        elif kind is list and type(step) is int and step < len(document):
            document = document[step]
        else:
            return _NOTHING
    return at_end(document, place) if place.tail else document


def at_end(value: Any, place: Place) -> Any:
    """Return what a place takes of the value to which its steps lead."""
    if place.tail == "slice" and type(value) is list:
        return value[slice(*place.part)]
    if place.tail == "text" and type(value) is str and len(value) <= _LONGEST_TEXT:
        return [float(number) for number in _NUMBER.findall(value)]
    if place.tail == "key":
        numbers = numbers_in(str(value))
        return numbers[place.number] if len(numbers) > max(place.number, 0) else _NOTHING
    if place.tail == "parts":
        parts = [_value(value, Place("", way)) for way in place.parts]
        return _NOTHING if _NOTHING in parts else parts
    return _NOTHING


def numbers_in(text: str) -> list[int]:
    """Return the whole numbers in a text.

    >>> numbers_in("cam_00 to cam_05")
    [0, 5]
    """
    return [int(digits) for digits in _DIGITS.findall(text[:_LONGEST_TEXT]) if len(digits) < 10]


Row = tuple[tuple[str | int, ...], str, Any]
"""The steps on the way to a value at a place with axes, its keys of axes, and the value."""


def entries_at(document: Any, text: str) -> list[Row]:
    """Return the values at a place with axes.

    Raises:
        LookupError: If the place is not in the document.

    >>> entries_at({"a": {"0-1": 5, "0-2": 7}}, "$.a{}")
    [(('a', '0-1'), '0-1', 5), (('a', '0-2'), '0-2', 7)]
    """
    found: list[Row] = [((), "", document)]
    for step in place_at(text).steps:
        is_axis = isinstance(step, Every | Entries)
        found = [
            ((*way, key), f"{keys} {key}".strip() if is_axis else keys, value)
            for way, keys, node in found
            for key, value in _children(node, step, text)
        ]
    return found


def path_to(way: Sequence[str | int]) -> str:
    """Return the JSON path of the value to which keys and places lead."""
    return functools.reduce(child_path, way, "$")


def _children(node: Any, step: Step, text: str) -> list[tuple[str | int, Any]]:
    """Return what a step leads to from a value.

    Raises:
        LookupError: If it leads nowhere.
    """
    if type(node) is dict:
        if type(step) is str and step in node:
            return [(step, node[step])]
        if type(step) is Entries:
            return [each for each in node.items() if is_entry(each[0], step)]
    elif type(node) is list:
        if type(step) is int and step < len(node):
            return [(step, node[step])]
        if type(step) is Every:
            return [*enumerate(node)]
    raise LookupError(text)


def is_entry(key: str, step: Entries) -> bool:
    """Return whether a key is of an entry to which a step leads."""
    if step.text.endswith("*"):
        return key.startswith(step.text[:-1])
    match = _ENDS_IN_DIGITS.match(key[-_LONGEST_TEXT:])
    return match is not None and match[1].endswith(step.text)


Leaves = tuple[list[Any], tuple[int, ...]]
"""The values at a place with axes in their order, and the lengths of the axes."""


def leaves_at(document: Any, place: Place, *, where: str, way: Sequence[Step] = ()) -> Leaves:
    """Return the values at a place, of which each axis has one length.

    Args:
        document: The document.
        place: The place; of its tail only the number of a key is taken.
        where: The file's path, for messages.
        way: The way on from there.

    Raises:
        SchemaError: If the place is not everywhere in the document, or an axis has several lengths;
            it names the first place that is odd.
    """
    nodes: list[Any] = [document]
    lengths: list[int] = []
    keys: list[str] = []
    steps = (*place.steps, *way)
    for number, step in enumerate(steps):
        if not nodes:
            raise SchemaError(f"{where}: {place.text} is empty")
        kind = list if type(step) is int or type(step) is Every else dict
        if not {*map(type, nodes)} <= {kind}:
            at = next(at for at, node in enumerate(nodes) if type(node) is not kind)
            raise _missing(document, steps[: number + 1], nodes[at], at, lengths, where)
        if type(step) is Every or type(step) is Entries:
            if type(step) is Entries:
                keys = [key for node in nodes for key in node if is_entry(key, step)]
                counts = [sum(is_entry(key, step) for key in node) for node in nodes]
                nodes = [node[key] for node in nodes for key in node if is_entry(key, step)]
            else:
                counts = [*map(len, nodes)]
                nodes = [each for node in nodes for each in node]
            if len({*counts}) != 1:
                at = next(at for at, count in enumerate(counts) if count != counts[0])
                path = path_of(document, steps[:number], at, lengths)
                raise SchemaError(
                    f"{where}: {path} has {counts[at]}, and the first such has {counts[0]}"
                )
            lengths.append(counts[0])
            continue
        try:
            nodes = [node[step] for node in nodes]
        except (KeyError, IndexError):
            leads = (step < len(node) if type(step) is int else step in node for node in nodes)
            at = [*leads].index(False)
            raise _missing(document, steps[: number + 1], nodes[at], at, lengths, where) from None
    if place.tail == "key":
        texts = keys if isinstance(steps[-1], Entries) else map(str, nodes)
        numbers = [numbers_in(text) for text in texts]
        if not all(len(each) > max(place.number, 0) for each in numbers):
            raise SchemaError(f"{where}: {place.text}: a name has no such number in it")
        nodes = [each[place.number] for each in numbers]
    return nodes, tuple(lengths)


def _missing(
    document: Any, steps: Sequence[Step], node: Any, at: int, lengths: Sequence[int], where: str
) -> SchemaError:
    """Return the error of a step that leads nowhere."""
    path = path_of(document, steps[:-1], at, lengths)
    step = steps[-1]
    if isinstance(step, Entries):
        wanted = f"{{{step.text}}}"
    else:
        wanted = "[]" if isinstance(step, Every) else child_path("", step).removeprefix(".")
    return SchemaError(f"{where}: {path} has no {wanted}; it is {brief(node)}")


def path_of(document: Any, steps: Sequence[Step], at: int, lengths: Sequence[int]) -> str:
    """Return the JSON path of the value with a number among those to which steps lead."""
    places: list[int] = []
    for length in reversed(lengths):
        at, place = divmod(at, length)
        places.insert(0, place)
    path, node = "$", document
    for step in steps:
        is_axis = isinstance(step, Every | Entries)
        children = _children(node, step, path)
        key, node = children[places.pop(0)] if is_axis else children[0]
        path = child_path(path, key)
    return path
