"""Files of conventions: declarations that replace tables of the built-in one, as TOML.

    format = 2

    [focal_length]
    place = "$.lens.f"
    unit = "mm"

    [pairs]
    rows = "$.gaps[]"
    a = "i"
    b = "j"
    length = "d"
    unit = "m"

    [depth]
    unit_m = 0.001

A table in a file replaces the built-in table whole; tables that are not in the file stay. The whole
file concerns all scenes, or each table ``[[shape]]`` those whose files have the keys that it names.
Files without a ``format`` are of an earlier one, and are read as declarations, too.
"""

import difflib
import functools
import json
import re
import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, get_args

from stereogenbench_data.errors import SchemaError, explain_os_errors
from stereogenbench_data.schema.declaration import (
    BUILT_IN,
    Declaration,
    DepthAs,
    NumberAt,
    PairsAt,
    PosesAt,
    PrimaryPairAt,
)
from stereogenbench_data.schema.document import is_number, parse_object
from stereogenbench_data.schema.places import place_at
from stereogenbench_data.schema.records import DepthEncoding, DepthRisk, Scene
from stereogenbench_data.schema.text import plain_line, shortened
from stereogenbench_data.schema.units import ANGLES, PIXELS, UNITS_M, without_unit, words

MAX_BYTES: Final = 2**18
"""The largest file of conventions that is read. One that was learned has some kilobytes."""

_MOST: Final = 64
_LONGEST: Final = 500


@dataclass(frozen=True, slots=True)
class Conventions:
    """What a file of conventions states: one declaration or several, the first that fits counts.

    Attributes:
        shapes: At least one.
        where: The file, for messages.
    """

    shapes: tuple[Declaration, ...]
    where: str = field(default="conventions", compare=False)

    @classmethod
    def read(cls, source: "str | Path | Conventions") -> "Conventions":
        """Return the conventions in a file; conventions are returned as they are.

        Raises:
            StorageError: If the file cannot be read.
            SchemaError: If it states something that is not understood; each message names the
                table, the key, the value and the cure.
        """
        if isinstance(source, Conventions):
            return source
        path = Path(source)
        with (
            explain_os_errors(f"{path}: cannot be read", "Name a file of conventions."),
            path.open("rb") as file,
        ):
            text = file.read(MAX_BYTES + 1)
        return parse_conventions(text, where=str(path))

    def shape_of(self, keys: Callable[[], Collection[str]], *, where: str) -> Declaration:
        """Return the first declaration that has nothing but keys of a scene.

        Args:
            keys: Returns the keys of the scene's files, as `keys_of` names them.
            where: The scene, for messages.

        Raises:
            SchemaError: If none has these keys.
        """
        there: Collection[str] = () if not self.shapes[0].has else keys()
        for shape in self.shapes:
            if set(shape.has) <= set(there):
                return shape
        raise SchemaError(
            f"{where}: its files have the keys of none of the {len(self.shapes)} shapes of "
            f"{self.where} ({self.shapes[0].has[0]} is not among them). Add a [[shape]] without "
            f"'has' at the end, or learn the conventions again: `stereogenbench conventions ROOT`."
        )


def declaration_of(scene: Scene) -> Declaration:
    """Return where quantities stand in a scene's files by its row."""
    return BUILT_IN if scene.conventions is None else declaration_of_text(scene.conventions)


def depth_of(scene: Scene) -> DepthEncoding:
    """Return the depth encoding of a scene by its conventions; what these leave out is usual."""
    if scene.conventions is None:
        return DepthEncoding()
    shape = declaration_of(scene)
    return _USUAL if shape.depth is None else shape.depth.encoding


_USUAL: Final = DepthEncoding(source="conventions")


@functools.lru_cache(maxsize=64)
def declaration_of_text(text: str) -> Declaration:
    """Return the declaration that an index keeps beside a scene.

    Raises:
        SchemaError: If the text is none.
    """
    where = "the conventions of a scene"
    table = parse_object(text.encode(errors="surrogatepass"), where=where)
    return _declaration(table, where, format_=_format_of(table, where))


def parse_conventions(text: bytes, *, where: str) -> Conventions:
    """Return the conventions that a file states.

    Args:
        text: The file's bytes: TOML.
        where: The file's path, for messages.

    Raises:
        SchemaError: If it is too large, not TOML, or states what is not understood.
    """
    if len(text) > MAX_BYTES:
        raise SchemaError(
            f"{where}: a file of conventions may have {MAX_BYTES:,} bytes, and this one has more. "
            f"Name another file."
        )
    try:
        document = tomllib.loads(text.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise SchemaError(f"{where}: not UTF-8 (byte {error.start}). Save it as UTF-8.") from error
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise SchemaError(f"{where}: not TOML: {error}. Correct that line.") from error
    format_ = _format_of(document, where)
    tables = document.get("shape", [document])
    if "shape" in document and document.keys() - {"shape", "format"}:
        other = next(name for name in document if name not in ("shape", "format"))
        raise SchemaError(
            f"{where}: [{plain_line(shortened(other))}] stands beside [[shape]], so it is not told "
            f"which scenes it concerns. Write it as [shape.{plain_line(shortened(other))}] below "
            f"its [[shape]]."
        )
    if not (isinstance(tables, list) and 0 < len(tables) <= _MOST
            and all(isinstance(table, dict) for table in tables)):  # fmt: skip
        rule = f"shape must be 1 to {_MOST} tables, written [[shape]]"
        raise SchemaError(f"{where}: {rule}, found {_shown(tables)}.")
    places = [f"{where}: shape {at}" for at in range(1, len(tables) + 1)]
    shapes = (
        _declaration(table, place, format_=format_)
        for table, place in zip(tables, places if len(tables) > 1 else [where], strict=True)
    )
    return Conventions(tuple(shapes), where)


def _format_of(document: Mapping[str, Any], where: str) -> int:
    """Return the format of a file of conventions: 1 where none is stated.

    Raises:
        SchemaError: If it is not known.
    """
    format_ = document.get("format", 1)
    if format_ not in _TABLES or type(format_) is not int:
        raise SchemaError(
            f"{where}: format must be 2, found {_shown(format_)}. Write format = 2, or install the "
            f"version of this package that wrote the file."
        )
    return int(format_)


_OF_LENGTH: Final = ("focal_length", "sensor_width", "sensor_height")
_OF_PIXELS: Final = ("image_width", "image_height", "principal_x", "principal_y")
_OF_DEPTH: Final = "unit_m offset_m kind form frame_lag no_depth accept channels instead_of_tag_m"
_TABLES: Final[Mapping[int, Mapping[str, str]]] = {
    1: {
        **dict.fromkeys((*_OF_LENGTH[:3], "field_of_view", "focal_length_px", *_OF_PIXELS),
                        "place value unit ignored"),
        "baselines": "place unit ignored",
        "primary_pair": "left right ignored",
        "poses": "location rotation form axes unit",
        "depth": _OF_DEPTH,
    },
    2: {
        "focal_length": "place value unit as optional",
        **dict.fromkeys((*_OF_LENGTH[1:], *_OF_PIXELS), "place value unit optional"),
        **dict.fromkeys(("pairs", "gaps"), "rows a b length unit first optional"),
        "primary_pair": "left right optional",
        "poses": "location rotation frame camera outer first step form axes unit",
        "depth": _OF_DEPTH,
    },
}  # fmt: skip
"""The tables of each format, and what each may have."""

_NEEDED: Final = {
    (1, "baselines"): ("place",), (1, "primary_pair"): ("left", "right"),
    (2, "primary_pair"): ("left", "right"), (2, "pairs"): ("rows", "a", "b"),
    (2, "gaps"): ("rows", "a", "b"),
}  # fmt: skip

_AS: Final = {"field of view": "field_of_view", "pixels": "focal_length_px"}
"""What a focal length may be instead of a length, and the quantity that it is then."""


def _declaration(table: Mapping[str, Any], where: str, *, format_: int) -> Declaration:
    """Return what a table states, in place of the tables of the built-in declaration."""
    known = _TABLES[format_]
    _require_known(table, ("format", "has", *known), where=where)
    tables: dict[str, dict[str, Any]] = {}
    for name in (each for each in table if each not in ("has", "format")):
        content, place = table[name], f"{where}: [{name}]"
        if not isinstance(content, dict):
            raise SchemaError(f"{place} must be a table, found {_shown(content)}.")
        _require_known(content, known[name].split(), where=place)
        tables[name] = values = {
            key: _checked(key, value, where=place, format_=format_)
            for key, value in content.items()
        }
        unit, units = values.get("unit"), _units_of(name, values)
        if unit is not None and unit not in units:
            options = ", ".join(sorted(units))
            raise SchemaError(f"{place}: unit must be one of {options}, found {_shown(unit)}.")
        for key in _NEEDED.get((format_, name), ()):
            if key not in values:
                raise SchemaError(f"{place}: {key} is missing. Write a JSON path, such as $.pairs.")
        stated = values.keys() & {"place", "value"}
        if "value" in known[name].split() and len(stated) != 1 and (
            stated or not values.keys() & {"ignored", "optional"}
        ):  # fmt: skip
            raise SchemaError(
                f"{place} must have either a place, such as "
                f'place = "$.camera_intrinsics.{name}", or the value that it has in every scene.'
            )
    poses, depth = tables.pop("poses", None), tables.pop("depth", None)
    written = {
        name: {key: list(value) if isinstance(value, tuple) else value
               for key, value in values.items() if value not in ((), None)}
        for name, values in tables.items()
    }  # fmt: skip
    return Declaration(
        **_by_tables(_as_now(tables) if format_ == 1 else tables),
        has=_checked("has", table.get("has", []), where=where, format_=format_),
        poses=None if poses is None else PosesAt(**poses),
        depth=None if depth is None else _depth(depth, where=f"{where}: [depth]"),
        stated=({} if format_ == 1 else {"format": format_}) | written,
    )


def _units_of(name: str, values: Mapping[str, Any]) -> Collection[str]:
    """Return the units that a table may have."""
    as_ = _AS.get(values.get("as", ""), name)
    if as_ == "field_of_view":
        return ANGLES
    return PIXELS if as_ in (*_OF_PIXELS, "focal_length_px") else UNITS_M


def _by_tables(tables: Mapping[str, Mapping[str, Any] | None]) -> dict[str, Any]:
    """Return the parts of a declaration that tables replace; None is that there are none."""
    numbers, parts = dict(BUILT_IN.numbers), dict[str, Any]()
    if {"place", "value"} & (tables.get("focal_length") or {}).keys():
        # Who says where it stands does not want it compared with what stands elsewhere.
        for name in ("focal_length", "focal_length_px", "focal_length_y_px"):
            del numbers[name]
    for name, values in tables.items():
        if values is None:
            parts[name] = None
            continue
        is_needed = not values.get("optional", False)
        if name in ("pairs", "gaps"):
            own = {key: value for key, value in values.items() if key != "optional"}
            parts[name] = PairsAt(is_needed=is_needed, **own)
        elif name == "primary_pair":
            left, right = (_listed(values[end]) for end in ("left", "right"))
            parts[name] = PrimaryPairAt(left=left, right=right, is_needed=is_needed)
        elif {"place", "value"} & values.keys():
            quantity = _AS.get(values.get("as", ""), name)
            numbers[quantity] = _number(quantity, values, is_needed=is_needed)
        else:
            from_release = numbers[name]
            numbers[name] = NumberAt(places=from_release.places, unit=from_release.unit)
    return {"numbers": numbers} | parts


def _as_now(tables: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return tables of the first format as those of the second.

    What is not in such a file was found; now it stands where the paper prints it. A unit that is
    not stated is that at the end of the key.
    """
    now: dict[str, Any] = {}
    for name, values in tables.items():
        place = values.get("place", "")
        unit = values.get("unit") or without_unit(words(place.rpartition(".")[2]))[1]
        if name == "baselines":
            now["pairs"] = {"rows": place, "unit": unit if unit in UNITS_M else ""}
            if place != BUILT_IN.pairs.rows.removesuffix("[]"):
                now["gaps"] = None
        elif name == "primary_pair":
            now[name] = values
        elif {"place", "value"} & values.keys():
            now[name] = {**values, "unit": unit if unit in _units_of(name, values) else None}
    if {"field_of_view", "focal_length_px"} & tables.keys() and "focal_length" not in tables:
        now["focal_length"] = {"optional": True}
    return now


def _number(name: str, values: Mapping[str, Any], *, is_needed: bool) -> NumberAt:
    usual = "mm" if name in _OF_LENGTH else "" if name == "field_of_view" else "px"
    return NumberAt(
        places=_listed(values.get("place", ())),
        value=values.get("value"),
        unit=values.get("unit") or usual,
        is_needed=is_needed,
    )


def _listed(value: str | tuple[str, ...]) -> tuple[str, ...]:
    return (value,) if isinstance(value, str) else value


def _depth(values: dict[str, Any], *, where: str) -> DepthAs:
    instead_m = values.pop("instead_of_tag_m", None)
    if instead_m is not None and "unit_m" not in values:
        raise SchemaError(f"{where}: instead_of_tag_m needs the right unit_m beside it.")
    try:
        encoding = DepthEncoding(**values, source="conventions")
    except SchemaError as error:
        raise SchemaError(f"{where}: {error}") from error
    return DepthAs(encoding=encoding, instead_of_tag_m=instead_m)


def _require_known(names: Iterable[str], known: Iterable[str], *, where: str) -> None:
    for name in names:
        if name not in (listed := list(known)):
            near = difflib.get_close_matches(name, listed, n=1)
            cure = f"did you mean {near[0]}?" if near else f"known are {', '.join(listed)}."
            raise SchemaError(f"{where}: {plain_line(shortened(name))!r} is not known; {cure}")


def _is_text(value: object) -> bool:
    return isinstance(value, str) and 0 < len(value) <= _LONGEST


def _axes_of(value: object) -> int | None:
    """Return how many axes a place in a document or below a row has; None of what is no place."""
    if isinstance(value, str) and len(value) <= _LONGEST:
        with suppress(LookupError):
            return place_at(value).axes
    return None


def _is_place(*axes: int) -> Callable[[Any], bool]:
    """Return what tells whether a value is a place in a document, with such a number of axes."""
    return lambda value: _is_text(value) and value[0] == "$" < value and _axes_of(value) in axes


_PLACE: Final = "a JSON path, such as $.camera_intrinsics.focal_length_mm"
_RULES: Final[tuple[tuple[str, Callable[[Any], bool], str], ...]] = (
    ("kind form axes unit has accept channels", _is_text, "a text"),
    ("as", lambda value: value in _AS, '"field of view" or "pixels"'),
    ("outer", lambda value: value in ("frames", "cameras", "rows"),
     '"frames", "cameras" or "rows"'),
    ("optional", lambda value: isinstance(value, bool), "true or false"),
    ("first step", lambda value: type(value) is int and 0 <= value < 10**6, "a whole number"),
    ("value instead_of_tag_m", lambda value: is_number(value) and value > 0,
     "a number above zero"),
    ("unit_m offset_m frame_lag", lambda value: not isinstance(value, bool), "a number"),
    ("no_depth", lambda value: type(value) in (int, str), 'a stored number or "max"'),
)  # fmt: skip
_RULES_OF: Final[Mapping[int, tuple[tuple[str, Callable[[Any], bool], str], ...]]] = {
    1: (
        ("location rotation", _is_text, "a text"),
        ("place left right ignored", _is_place(0), _PLACE),
    ),
    2: (
        ("location rotation frame camera", _is_place(1, 2),
         "a JSON path with the frames and the cameras, such as "
         "$.frames[].cameras[].location[x,y,z]"),
        ("rows", _is_place(1, 2),
         "a JSON path that ends in [] or {}, such as $.pairwise_pairs[]"),
        ("a b length", lambda value: value == "order" or _axes_of(value) == 0,
         'a place below the row, such as "camera_index_a" or "#0"'),
        ("place left right", _is_place(0), _PLACE),
    ),
}  # fmt: skip
"""What the value of a key must be, or each of a list."""
_LISTS: Final = ("has", "accept", "ignored", "no_depth")
_MAY_BE_LISTS: Final = ("place", "left", "right")


def _checked(key: str, value: Any, *, where: str, format_: int) -> Any:
    """Return the value of a key as records hold it."""
    rules = (*_RULES_OF[format_], *_RULES)
    is_right, what = next((rule, what) for keys, rule, what in rules if key in keys.split())
    is_list = isinstance(value, list)
    values = value if is_list else [value]
    may_be = key in _LISTS or (format_ > 1 and key in _MAY_BE_LISTS and bool(value))
    is_of_kind = may_be if is_list else key not in _LISTS
    if not is_of_kind or len(values) > _MOST or not all(map(is_right, values)):
        what = f"a list, and each {what}" if key in _LISTS else what
        raise SchemaError(f"{where}: {key} must be {what}, found {_shown(value)}.")
    if key == "accept":
        _require_known(value, get_args(DepthRisk), where=f"{where}: {key}")
        return frozenset(value)
    if key == "unit":
        return words(value)
    if key in ("value", "instead_of_tag_m"):
        return float(value)
    return tuple(value) if is_list else value


def _shown(value: object) -> str:
    return plain_line(shortened(repr(value)))


def write_toml(conventions: Conventions, notes: Mapping[tuple[int, str], Iterable[str]]) -> str:
    """Return conventions as TOML that `parse_conventions` reads, with notes as comments.

    Args:
        conventions: What is stated.
        notes: Lines about a table, by the number of its shape and its name; those of (n, "") stand
            in front of shape n, those of (-1, "") in front of all.
    """
    is_one = len(conventions.shapes) == 1 and not conventions.shapes[0].has
    lines = [*_comments(notes.get((-1, ""), ()))]
    formats = {shape.tables().get("format", 1) for shape in conventions.shapes}
    lines += [f"format = {max(formats)}"] if max(formats) > 1 else []
    for number, shape in enumerate(conventions.shapes):
        lines += ["", *_comments(notes.get((number, ""), ()))]
        table = shape.tables()
        table.pop("format", None)
        if not is_one:
            lines += ["[[shape]]"]
            lines += [f"has = {_toml(table.pop('has', []))}"]
        noted = [name for at, name in notes if at == number and name and name not in table]
        for name in sorted({*table, *noted}, key=_ORDER.index):
            header = f"[{name}]" if is_one else f"[shape.{name}]"
            about = (header if each == f"[{name}]" else each  # of a candidate
                     for each in notes.get((number, name), ()))  # fmt: skip
            lines += ["", *_comments(about)]
            if name in table:
                lines += [header]
                lines += [f"{key} = {_toml(value)}" for key, value in table[name].items()]
    return "\n".join(lines).strip() + "\n"


_ORDER: Final = [*dict.fromkeys(name for tables in (_TABLES[2], _TABLES[1]) for name in tables)]


def _comments(notes: Iterable[str]) -> Iterator[str]:
    for note in notes:
        yield f"# {plain_line(note)}".rstrip()


def _toml(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, str | bool):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)


def keys_of(node: Any, *, place: str = "$") -> set[str]:
    """Return the places of all values of a JSON document; elements of lists have none of their own.

    Keys that only count, such as ``cam_00``, are one key: what differs from scene to scene is the
    content, not the shape.

    >>> sorted(keys_of({"a": [{"b": 1}], "cam_0": 2, "cam_1": 3}))
    ['$.a', '$.a[].b', '$.cam_#']
    """
    found: set[str] = set()
    if isinstance(node, list):
        for each in node:
            if isinstance(each, dict | list):
                found |= keys_of(each, place=f"{place}[]")
    elif isinstance(node, dict):
        for key, value in node.items():
            inner = f"{place}.{re.sub(r'[0-9]+', '#', words(key))}"
            found |= {inner} if not isinstance(value, dict) else set()
            found |= keys_of(value, place=inner)
    return found
