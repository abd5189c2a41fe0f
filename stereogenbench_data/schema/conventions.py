"""Conventions: where quantities stand in a data set's files and how they are read, as TOML.

A person may write such a file by hand, from nothing: what it does not state is found as ever. What
it states is checked against everything else that the files say; a value that is known to be wrong
is named as ``ignored``. The whole file concerns all scenes, or each table ``[[shape]]`` those whose
files have the keys that it names.

    [focal_length]
    place = "$.camera_intrinsics.focal_length_mm"
    unit = "mm"

    [depth]
    unit_m = 0.001
    frame_lag = 1
"""

import difflib
import functools
import json
import math
import re
import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Final, get_args

from stereogenbench_data.errors import SchemaError, explain_os_errors
from stereogenbench_data.schema.document import is_number, listed_keys, parse_object
from stereogenbench_data.schema.quantities import (
    OTHER_UNITS,
    UNITS_M,
    Stated,
    as_stated,
    steps_of,
    value_at,
    words,
)
from stereogenbench_data.schema.records import DepthEncoding, DepthRisk, Scene
from stereogenbench_data.schema.text import plain_line, shortened

MAX_BYTES: Final = 2**18
"""The largest file of conventions that is read. One that was learned has some kilobytes."""

UNKNOWN: Final = "unknown"
"""The form of poses that nobody understands: rigs are assumed rectified, and poses are not read."""

_MOST: Final = 64
_LEAST_OFFSET_M: Final = 1e-4
_LONGEST: Final = 500


@dataclass(frozen=True, slots=True, kw_only=True)
class At:
    """Where a quantity stands in ``baseline.json``; `_KEYS` says what each table may have.

    Attributes:
        place: The JSON path of a number, or of the list or object that holds the baselines.
        value: The number itself, for files that do not have it.
        unit: Its unit; None takes that of the key, or the usual one.
        left: The JSON path of the name or number of the primary pair's left camera.
        right: That of the right camera.
        ignored: JSON paths of other values of the quantity, which do not count.
    """

    place: str | None = None
    value: float | None = None
    unit: str | None = None
    left: str | None = None
    right: str | None = None
    ignored: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class PosesAs:
    """How ``trajectory.json`` is read, as `geometry.pose_forms` names it.

    Attributes:
        location: The keys on the way to the locations; None where matrices hold them.
        rotation: The keys on the way to the rotations or matrices.
        form: The form of the rotations; "unknown" if nobody understands the poses.
        axes: The axes of the cameras.
        unit: The unit of locations; None takes the one that the file states.
    """

    location: str | None = None
    rotation: str | None = None
    form: str | None = None
    axes: str | None = None
    unit: str | None = None

    @classmethod
    def of_reading(cls, name: str) -> "PosesAs":
        """Return what the name of a reading says, with its metres in a unit or without."""
        name, _, unit_m = name.partition(" @ ")
        places, _, rest = name.partition(": ")
        location, _, rotation = places.rpartition(" and ")
        form, axes = rest.split(", ")[:2]
        known = (unit for unit, metres in UNITS_M.items() if math.isclose(metres, float(unit_m)))
        unit, axes = next(known) if unit_m else None, axes.removesuffix(" axes")
        return cls(location=location or None, rotation=rotation, form=form, axes=axes, unit=unit)

    def fits(self, name: str) -> bool:
        """Return whether the reading of a name is one of these."""
        found = self.of_reading(name)
        return all(
            getattr(self, part) in (None, getattr(found, part))
            for part in ("location", "rotation", "form", "axes")
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthAs:
    """The depth contract.

    Attributes:
        encoding: The contract; its unit is None where files state theirs.
        instead_of_tag_m: The unit that tags state and that is wrong, which ``unit_m`` replaces.
    """

    encoding: DepthEncoding
    instead_of_tag_m: float | None = None

    def require(self, unit_m: float, offset_m: float, *, where: str) -> None:
        """Refuse what files state, if it is neither the contract's nor what that replaces.

        Raises:
            SchemaError: With both figures.
        """
        known_m, expected_m = self.instead_of_tag_m or self.encoding.unit_m, self.encoding.offset_m
        told, is_replaced = "", self.instead_of_tag_m is not None
        if known_m is not None and not math.isclose(unit_m, known_m):
            told = (
                f"{unit_m:g} m in a stored unit of depth, and the conventions expect {known_m:g} m"
            )
        elif not is_replaced and not math.isclose(offset_m, expected_m, abs_tol=_LEAST_OFFSET_M):
            told = f"a range from {offset_m:g} m, and the conventions expect {expected_m:g} m"
        if told:
            raise SchemaError(
                f"{where}: states {told}. Correct unit_m and offset_m in [depth]; or, if the files "
                f"are known to be wrong, add instead_of_tag_m = {unit_m:g}."
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """What is stated about the scenes whose files have some keys.

    Attributes:
        has: Keys that tell these scenes from others, as `keys_of` names them; () is all scenes.
        at: Where quantities of ``baseline.json`` stand, by the names of tables.
        poses: How poses are read.
        depth: The depth contract.
    """

    has: tuple[str, ...] = ()
    at: Mapping[str, At] = field(default_factory=dict)
    poses: PosesAs | None = None
    depth: DepthAs | None = None

    def table(self) -> dict[str, Any]:
        """Return the shape as a TOML or JSON document has it."""
        table: dict[str, Any] = {"has": list(self.has)} if self.has else {}
        table |= {name: _plain_table(at) for name, at in self.at.items()}
        if self.poses is not None:
            table["poses"] = _plain_table(self.poses)
        if self.depth is not None:
            table["depth"] = _plain_table(self.depth.encoding)
            if self.depth.instead_of_tag_m is not None:
                table["depth"]["instead_of_tag_m"] = self.depth.instead_of_tag_m
        return table

    def text(self) -> str:
        """Return the shape as one line of JSON, as an index keeps it beside each scene."""
        return json.dumps(self.table(), sort_keys=True)

    def known(self, document: dict[str, Any], *, where: str) -> dict[str, Stated]:
        """Return the numbers that are stated, or stand where it is stated, by their quantities.

        Raises:
            SchemaError: If a place that is stated is not in the document.
        """
        known = {}
        for name, quantity in NUMBERS.items():
            at = self.at.get(name, At())
            if at.place is not None:
                value = value_stated(document, at.place, name, where=where)
                known[quantity] = as_stated(Stated(value, at.unit or "", at.place))
            elif at.value is not None:
                known[quantity] = Stated(at.value, at.unit or "", f"[{name}] of the conventions")
        return known

    @property
    def ignored(self) -> list[str]:
        """The JSON paths of what does not count in ``baseline.json``."""
        return [each for at in self.at.values() for each in at.ignored]


def value_stated(document: dict[str, Any], path: str | None, table: str, *, where: str) -> Any:
    """Return the value at a place that conventions state.

    Raises:
        SchemaError: If it is not in the document.
    """
    try:
        return value_at(document, str(path))
    except LookupError as error:
        keys = plain_line(listed_keys(document))
        raise SchemaError(
            f"{where}: {plain_line(str(path))} is not in the file, and the conventions say that "
            f"[{table}] stands there; its keys are: {keys}. Correct the place, or state another "
            f"[[shape]] for such files."
        ) from error


@dataclass(frozen=True, slots=True)
class Conventions:
    """What a file of conventions states: one shape of files or several, the first that fits counts.

    Attributes:
        shapes: At least one.
        where: The file, for messages.
    """

    shapes: tuple[Shape, ...]
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

    def shape_of(self, keys: Callable[[], Collection[str]], *, where: str) -> Shape:
        """Return the first shape that has nothing but keys of a scene.

        Args:
            keys: Returns the keys of the scene's files, as `keys_of` names them.
            where: The scene, for messages.

        Raises:
            SchemaError: If no shape has these keys.
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


NUMBERS: Final = {
    "focal_length": "focal",
    "sensor_width": "sensor_width",
    "sensor_height": "sensor_height",
    "field_of_view": "fov",
    "focal_length_px": "focal_px",
    "image_width": "image_width",
    "image_height": "image_height",
    "principal_x": "principal_x",
    "principal_y": "principal_y",
}
"""The tables of quantities that are one number, and their names in `quantities.NAMES`."""

_PIXELS: Final = ("px", "pixel", "pixels")
_UNITS: Final[dict[str, tuple[str, ...]]] = {
    "field_of_view": tuple(sorted(OTHER_UNITS - {*_PIXELS})),
    **dict.fromkeys(
        ("focal_length_px", "image_width", "image_height", "principal_x", "principal_y"), _PIXELS
    ),
}
"""The units that a table may have, where it is no length."""

_KEYS: Final = {
    **dict.fromkeys(NUMBERS, "place value unit ignored"),
    "baselines": "place unit ignored",
    "primary_pair": "left right ignored",
    "poses": "location rotation form axes unit",
    "depth": "unit_m offset_m kind form frame_lag no_depth accept instead_of_tag_m",
}
"""The tables, and what each may have."""


def depth_of(scene: Scene) -> DepthEncoding:
    """Return the depth contract of a scene by its conventions; what these leave out is usual."""
    if scene.conventions is None:
        return DepthEncoding()
    shape = shape_of_text(scene.conventions)
    return _USUAL if shape.depth is None else shape.depth.encoding


_USUAL: Final = DepthEncoding(source="conventions")


@functools.lru_cache(maxsize=64)
def shape_of_text(text: str) -> Shape:
    """Return the shape that an index keeps beside a scene.

    Raises:
        SchemaError: If the text is not a shape.
    """
    where = "the conventions of a scene"
    return _shape(parse_object(text.encode(errors="surrogatepass"), where=where), where)


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
    tables = document.get("shape", [document])
    if "shape" in document and len(document) > 1:
        other = next(name for name in document if name != "shape")
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
    shapes = map(_shape, tables, places if len(tables) > 1 else [where])
    return Conventions(tuple(shapes), where)


def _shape(table: dict[str, Any], where: str) -> Shape:
    _require_known(table, ("has", *_KEYS), where=where)
    tables: dict[str, dict[str, Any]] = {}
    for name in (each for each in table if each != "has"):
        content, place = table[name], f"{where}: [{name}]"
        if not isinstance(content, dict):
            raise SchemaError(f"{place} must be a table, found {_shown(content)}.")
        _require_known(content, _KEYS[name].split(), where=place)
        tables[name] = values = {
            key: _checked(key, value, where=place) for key, value in content.items()
        }
        unit, known = values.get("unit"), _UNITS.get(name, UNITS_M)
        if unit is not None and unit not in known:
            options = ", ".join(sorted(known))
            raise SchemaError(f"{place}: unit must be one of {options}, found {_shown(unit)}.")
        needed = {"baselines": ["place"], "primary_pair": ["left", "right"]}.get(name, [])
        for key in needed:
            if key not in values:
                raise SchemaError(f"{place}: {key} is missing. Write a JSON path, such as $.pairs.")
        stated = values.keys() & {"place", "value"}
        if name in NUMBERS and len(stated) != 1 and (stated or "ignored" not in values):
            raise SchemaError(
                f"{place} must have either a place, such as "
                f'place = "$.camera_intrinsics.{name}", or the value that it has in every scene.'
            )
    poses, depth = tables.pop("poses", None), tables.pop("depth", None)
    return Shape(
        has=_checked("has", table.get("has", []), where=where),
        at={name: At(**tables[name]) for name in _KEYS if name in tables},
        poses=None if poses is None else PosesAs(**poses),
        depth=None if depth is None else _depth(depth, where=f"{where}: [depth]"),
    )


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


_RULES: Final[tuple[tuple[str, Callable[[Any], bool], str], ...]] = (
    ("kind form location rotation axes unit has accept", _is_text, "a text"),
    ("place left right ignored", lambda value: _is_text(value) and value[0] == "$" < value,
     "a JSON path, such as $.camera_intrinsics.focal_length_mm"),
    ("value instead_of_tag_m", lambda value: is_number(value) and value > 0,
     "a number above zero"),
    ("unit_m offset_m frame_lag", lambda value: not isinstance(value, bool), "a number"),
    ("no_depth", lambda value: type(value) in (int, str), 'a stored number or "max"'),
)  # fmt: skip
"""What the value of a key must be, or each of a list."""
_LISTS: Final = ("has", "accept", "ignored", "no_depth")


def _checked(key: str, value: Any, *, where: str) -> Any:
    """Return the value of a key as records hold it."""
    is_right, what = next((rule, what) for keys, rule, what in _RULES if key in keys.split())
    is_list = isinstance(value, list)
    values = value if is_list else [value]
    if is_list != (key in _LISTS) or len(values) > _MOST or not all(map(is_right, values)):
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


def _plain_table(record: Any) -> dict[str, Any]:
    """Return the fields of a record that are not as usual, as TOML and JSON have them."""
    usual, table = type(record)(), {}
    for name in (each.name for each in fields(record) if each.name != "source"):
        value = getattr(record, name)
        if value != getattr(usual, name):
            listed = sorted(value, key=str) if isinstance(value, frozenset) else value
            table[name] = list(listed) if isinstance(value, tuple | frozenset) else value
    return table


def write_toml(conventions: Conventions, notes: Mapping[tuple[int, str], Iterable[str]]) -> str:
    """Return conventions as TOML that `parse_conventions` reads, with notes as comments.

    Args:
        conventions: What is stated.
        notes: Lines about a table, by the number of its shape and its name; those of (n, "") stand
            in front of shape n, those of (-1, "") in front of all.
    """
    is_one = len(conventions.shapes) == 1 and not conventions.shapes[0].has
    lines = [*_comments(notes.get((-1, ""), ()))]
    for number, shape in enumerate(conventions.shapes):
        lines += ["", *_comments(notes.get((number, ""), ()))]
        table = shape.table()
        if not is_one:
            lines += ["[[shape]]"]
            lines += [f"has = {_toml(table.pop('has', []))}"]
        noted = [name for at, name in notes if at == number and name and name not in table]
        for name in sorted({*table, *noted}, key=[*_KEYS].index):
            lines += ["", *_comments(notes.get((number, name), ()))]
            if name in table:
                lines += [f"[{name}]" if is_one else f"[shape.{name}]"]
                lines += [f"{key} = {_toml(value)}" for key, value in table[name].items()]
    return "\n".join(lines).strip() + "\n"


def _comments(notes: Iterable[str]) -> Iterator[str]:
    for note in notes:
        yield f"# {plain_line(note)}".rstrip()


def _toml(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, str):
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


def place_of(path: str) -> str:
    """Return a JSON path as `keys_of` names it.

    >>> place_of('$.pairwise_pairs[3].baseline_cm'), place_of('$.baselines["0-1"]')
    ('$.pairwise_pairs[].baseline_cm', '$.baselines.#_#')
    """
    named = (
        "[]" if isinstance(step, int) else f".{re.sub('[0-9]+', '#', words(step))}"
        for step in steps_of(path)
    )
    return "$" + "".join(named)
