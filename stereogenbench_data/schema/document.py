"""JSON documents that nobody has checked: from bytes to values that know their place in the file.

A check that fails records a problem and returns a stand-in of the right type, so that the rest of
the file is checked too. `Problems.require_none` then raises one error with all of them; a parser
calls it before it returns anything.
"""

import functools
import json
import math
import re
from dataclasses import dataclass
from typing import Any, Final, TypeGuard

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.schema.spellings import KNOWN_KEYS, LOOKALIKES, SPELLINGS
from stereogenbench_data.schema.text import shortened

MAX_TEXT_BYTES: Final = 32 * 2**20
"""The largest metadata file that is read. The release's largest is a third of a megabyte."""

MOST_LETTERS: Final = 2**16
"""The longest text of a metadata file or an index that is read; captions have some hundreds."""

_SHOWN: Final = 20
_LARGEST_INT: Final = 2**53
_PLAIN_KEY: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_CAMERA_NAME: Final = re.compile(r"[Cc]am_?([0-9]{1,6})\Z")
_PATHS: Final = {
    quantity: tuple(tuple(spelling.split(".")) for spelling in spellings)
    for quantity, spellings in SPELLINGS.items()
}


def require_text_size(size_bytes: int, *, where: str) -> None:
    """Refuse a metadata file that is too large, before it is read.

    Raises:
        SchemaError: If the size is above `MAX_TEXT_BYTES`.
    """
    if size_bytes > MAX_TEXT_BYTES:
        raise SchemaError(
            f"{where}: a metadata file may have {MAX_TEXT_BYTES:,} bytes, this one has "
            f"{size_bytes:,}. It was not read. Replace it with the file of the release."
        )


def parse_text(text: bytes, *, where: str) -> str:
    """Return the text of a metadata file, which is UTF-8 with or without a byte-order mark.

    Raises:
        SchemaError: If it is too large or not UTF-8.
    """
    require_text_size(len(text), where=where)
    try:
        return text.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SchemaError(
            f"{where}: not UTF-8: byte {error.start} is 0x{text[error.start]:02x}. "
            f"Save the file as UTF-8, or copy it from the release again."
        ) from error


def parse_object(text: bytes, *, where: str) -> dict[str, Any]:
    """Return the JSON object that a metadata file holds.

    NaN and Infinity, which are not JSON but which Python writes, are accepted here, so that the
    check of each value can report their place.

    Raises:
        SchemaError: If the text is too large, empty, truncated, not UTF-8, not JSON, nested too
            deep, has a key twice, or is not an object at its top level.
    """
    decoded = parse_text(text, where=where)
    if not decoded.strip():
        raise SchemaError(f"{where}: the file is empty. Copy it from the release again.")
    repeated: list[tuple[dict[str, Any], str]] = []

    def keep_pairs(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        kept = dict(pairs)
        if len(kept) != len(pairs):
            repeated.append((kept, _first_repeated(pairs)))
        return kept

    try:
        document = json.loads(decoded, object_pairs_hook=keep_pairs)
    except RecursionError as error:
        raise SchemaError(
            f"{where}: lists or objects are nested hundreds of levels deep; the release's files "
            f"have six levels. Copy the file from the release again."
        ) from error
    except json.JSONDecodeError as error:
        length = len(decoded.rstrip())
        truncated = error.pos >= length or error.msg.startswith("Unterminated")
        guess = "The file looks truncated: c" if truncated else "C"
        raise SchemaError(
            f"{where}: not valid JSON: {error.msg} at line {error.lineno}, column {error.colno} "
            f"(character {error.pos} of {length}). {guess}opy it from the release again."
        ) from error
    except ValueError as error:
        raise SchemaError(
            f"{where}: not valid JSON: {error}. Copy the file from the release again."
        ) from error
    if not isinstance(document, dict):
        raise SchemaError(
            f"{where}: $ must be an object, found {brief(document)}. "
            f"Check that this is the file that its name says."
        )
    if repeated:
        path = child_path(_path_of(document, repeated[0][0]), repeated[0][1])
        raise SchemaError(
            f"{where}: {path} is written {'twice' if len(repeated) == 1 else 'more than once'}, "
            f"and only one of its values can be read. Remove the wrong one."
        )
    return document


def _first_repeated(pairs: list[tuple[str, Any]]) -> str:
    places = {key: place for place, (key, _) in enumerate(pairs)}
    return next(key for place, (key, _) in enumerate(pairs) if places[key] != place)


def _path_of(document: object, wanted: object) -> str:
    """Return the JSON path of an element that is known to be in the document, by identity."""
    parents: dict[int, tuple[int, str | int]] = {}
    waiting = [document]
    while waiting:
        holder = waiting.pop()
        if holder is wanted:
            break
        if isinstance(holder, dict | list):
            children = holder.items() if isinstance(holder, dict) else enumerate(holder)
            for key, child in children:
                if isinstance(child, dict | list):
                    parents[id(child)] = id(holder), key
                    waiting.append(child)
    else:
        return "$..."
    keys, place = [], id(wanted)
    while place in parents:
        place, key = parents[place]
        keys.append(key)
    return functools.reduce(child_path, reversed(keys), "$")


def child_path(path: str, key: str | int) -> str:
    """Return the JSON path of an element of an object or a list.

    >>> child_path("$.frames", 3), child_path("$", "map name")
    ('$.frames[3]', '$["map name"]')
    """
    if isinstance(key, int):
        return f"{path}[{key}]"
    key = shortened(key)
    return f"{path}.{key}" if _PLAIN_KEY.match(key) else f"{path}[{json.dumps(key)}]"


def brief(value: object) -> str:
    """Return a JSON value as messages show it: the size of containers, the start of long texts."""
    if isinstance(value, dict):
        return f"an object with {len(value)} keys ({_keys(value)})" if value else "an empty object"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    return "null" if value is None else shortened(repr(value))


def _keys(document: dict[str, object]) -> str:
    """Return the keys of an object, sorted, as messages show them."""
    keys = sorted(document)
    more = f", and {len(keys) - _SHOWN} more" if len(keys) > _SHOWN else ""
    plain = (key if key.isascii() and key.isprintable() else ascii(key) for key in keys[:_SHOWN])
    return ", ".join(map(shortened, plain)) + more or "none"


class Problems:
    """The problems of one file. The same complaint about several places is reported once."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._paths: dict[str, list[str]] = {}
        self._count = 0

    def __len__(self) -> int:
        """The number of problems recorded so far."""
        return self._count

    def add(self, path: str, complaint: str) -> None:
        """Record a complaint about the value at a JSON path."""
        self._paths.setdefault(complaint, []).append(path)
        self._count += 1

    def require_none(self) -> None:
        """Raise one error that lists the problems recorded so far.

        Raises:
            SchemaError: If there are any. It lists twenty complaints and counts the others.
        """
        if not self._paths:
            return
        lines = []
        for complaint, paths in list(self._paths.items())[:_SHOWN]:
            again = f" (and in {len(paths) - 1} more places)" if len(paths) > 1 else ""
            lines.append(f"{paths[0]}: {complaint}{again}")
        if len(self._paths) > _SHOWN:
            lines.append(f"and {sum(map(len, list(self._paths.values())[_SHOWN:]))} more")
        head = "1 problem" if self._count == 1 else f"{self._count} problems"
        raise SchemaError(f"{self._where}: {head}:\n  " + "\n  ".join(lines))


@dataclass(frozen=True, slots=True)
class JsonValue:
    """One JSON value, its path, and the problems of its file."""

    value: Any
    path: str
    problems: Problems

    @classmethod
    def parse(cls, text: bytes, *, where: str) -> "JsonValue":
        """Return the top-level object of a file.

        Raises:
            SchemaError: As `parse_object` does.
        """
        return cls(parse_object(text, where=where), "$", Problems(where))

    def child(self, *keys: str | int) -> "JsonValue":
        """Return the element that the keys lead to."""
        value, path = self.value, self.path
        for key in keys:
            value, path = value[key], child_path(path, key)
        return JsonValue(value, path, self.problems)

    def complain(self, complaint: str) -> None:
        """Record a problem with this value."""
        self.problems.add(self.path, complaint)

    def find(self, quantity: str) -> "JsonValue | None":
        """Return a quantity of this object, None where it is absent.

        An unknown key that may hold the quantity (`LOOKALIKES`) is recorded as a problem.
        """
        found = self._known(quantity)
        if found is not None or quantity not in LOOKALIKES:
            return found
        inner = [self.child(key) for key in self.value if isinstance(self.value[key], dict)]
        for holder in (self, *inner):
            alike = [
                holder.child(key)
                for key, value in holder.value.items()
                if value is not None and key not in KNOWN_KEYS and _may_be(quantity, key)
            ]
            keys = _keys(holder.value) if alike else ""
            for each in alike:
                each.complain(
                    f"is not a known key and may stand for {SPELLINGS[quantity][0]}. Rename "
                    f"or remove it; the keys here are: {keys}"
                )
        return None

    def find_text(self, quantity: str) -> str | None:
        """Return a text of this object, None where it is absent."""
        found = self.find(quantity)
        return None if found is None else found.text()

    def require(self, quantity: str) -> "JsonValue | None":
        """Return a quantity of this object; where it is absent, record that with the keys found."""
        found = self._known(quantity)
        if found is None:
            *parents, last = _PATHS[quantity][0]
            holder = self
            while parents and isinstance(holder.value.get(parents[0]), dict):
                holder = holder.child(parents.pop(0))
            missing = ".".join([*parents, last])
            holder.complain(f"{missing} is missing; the keys here are: {_keys(holder.value)}")
        return found

    def _known(self, quantity: str) -> "JsonValue | None":
        for keys in _PATHS[quantity]:
            value = self.value
            for key in keys:
                value = value.get(key) if isinstance(value, dict) else None
                if value is None:
                    break
            else:
                return self.child(*keys)
        return None

    def objects(self) -> "list[JsonValue]":
        """Return the elements of this list, each of which must be an object."""
        if not isinstance(self.value, list):
            self.complain(f"must be a list, found {brief(self.value)}")
            return []
        elements = [self.child(place) for place in range(len(self.value))]
        for element in elements:
            if not isinstance(element.value, dict):
                element.complain(f"must be an object, found {brief(element.value)}")
        return [element for element in elements if isinstance(element.value, dict)]

    def number(self) -> float:
        """Return this value as a finite number."""
        if not is_number(self.value):
            self.complain(f"must be a finite number, found {brief(self.value)}")
            return 1.0
        return float(self.value)

    def positive(self) -> float:
        """Return this value as a finite number above zero."""
        number = self.number()
        if number > 0:
            return number
        self.complain(f"must be a number above zero, found {brief(self.value)}")
        return 1.0

    def integer(self) -> int:
        """Return this value as an integer; 3.0 counts as 3."""
        number = _as_integer(self.value)
        if number is None:
            self.complain(f"must be an integer, found {brief(self.value)}")
            return 1
        return number

    def text(self) -> str:
        """Return this value as a text that can be written as UTF-8."""
        if not isinstance(self.value, str):
            self.complain(f"must be a text, found {brief(self.value)}")
            return ""
        if len(self.value) > MOST_LETTERS:
            self.complain(f"may have {MOST_LETTERS:,} letters, found {len(self.value):,}")
            return ""
        if any("\ud800" <= letter <= "\udfff" for letter in self.value):
            self.complain(f"contains half a character (a lone surrogate): {brief(self.value)}")
            return ""
        return self.value

    def camera(self) -> int:
        """Return the camera that this index, or this name ending in ``Cam_00``, stands for."""
        index = camera_of(self.value)
        if index is None:
            self.complain(
                f"must be the index of a camera or a name such as 'Cam_00', "
                f"found {brief(self.value)}"
            )
            return 0
        if not 0 <= index < CAMERA_COUNT:
            self.complain(f"is camera {index}, and the rig has cameras 0 to {CAMERA_COUNT - 1}")
            return 0
        return index

    def axes(self, names: tuple[str, ...]) -> list[Any] | None:
        """Return the named components of this object, unchecked; None where one is missing."""
        if isinstance(self.value, dict) and all(name in self.value for name in names):
            return [self.value[name] for name in names]
        return None


def _may_be(quantity: str, key: str) -> bool:
    snake = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", key).lower()
    return LOOKALIKES[quantity].search(snake) is not None


def is_number(value: object) -> TypeGuard[int | float]:
    """Return whether a JSON value is a finite number (a bool is not)."""
    if type(value) is int:
        return abs(value) < _LARGEST_INT
    return type(value) is float and math.isfinite(value)


def _as_integer(value: object) -> int | None:
    if not is_number(value):
        return None
    number = float(value)
    return int(number) if number.is_integer() else None


def camera_of(value: object) -> int | None:
    """Return the number of the camera that an index or a name stands for, None for other values.

    >>> camera_of("Town_scene_7_Cam_03"), camera_of("cam2"), camera_of(4), camera_of("left")
    (3, 2, 4, None)
    """
    if isinstance(value, str):
        named = _CAMERA_NAME.search(value)
        return int(named[1]) if named else None
    return _as_integer(value)
