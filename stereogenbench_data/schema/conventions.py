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
from stereogenbench_data.schema.document import is_number
from stereogenbench_data.schema.quantities import (
    OTHER_UNITS,
    UNITS_M,
    Node,
    nodes_of,
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
_LONGEST: Final = 500
_PLACE: Final = re.compile(r"\$.+", re.DOTALL)


@dataclass(frozen=True, slots=True, kw_only=True)
class NumberAt:
    """Where a number stands in ``baseline.json``, or which one it is in every scene.

    Attributes:
        place: Its JSON path.
        value: The number itself, for files that do not have it.
        unit: Its unit; None takes that of the key, or the usual one.
        ignored: JSON paths of other values of the quantity, which do not count.
    """

    place: str | None = None
    value: float | None = None
    unit: str | None = None
    ignored: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class BaselinesAt:
    """Where the baselines of the camera pairs stand in ``baseline.json``.

    Attributes:
        place: The JSON path of the list, or object, that holds them.
        unit: Their unit; None takes that of the key, or the file's.
        ignored: JSON paths of other baselines, which do not count.
    """

    place: str
    unit: str | None = None
    ignored: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class PrimaryPairAt:
    """Where ``baseline.json`` names the left and the right camera of the primary pair.

    Attributes:
        left: The JSON path of the left camera's name or number.
        right: That of the right camera.
        ignored: JSON paths of other pairs, which do not count.
    """

    left: str
    right: str
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """What is stated about the scenes whose files have some keys.

    Attributes:
        has: Keys that tell these scenes from others, as `keys_of` names them; () is all scenes.
        numbers: The quantities that are one number, by the names of `NUMBERS`.
        baselines: Where the baselines stand.
        primary_pair: Where the primary pair stands.
        poses: How poses are read.
        depth: The depth contract.
    """

    has: tuple[str, ...] = ()
    numbers: Mapping[str, NumberAt]
    baselines: BaselinesAt | None = None
    primary_pair: PrimaryPairAt | None = None
    poses: PosesAs | None = None
    depth: DepthAs | None = None

    def table(self) -> dict[str, Any]:
        """Return the shape as a TOML or JSON document has it."""
        table: dict[str, Any] = {"has": list(self.has)} if self.has else {}
        others = {name: getattr(self, name) for name in ("baselines", "primary_pair", "poses")}
        for name, record in (*self.numbers.items(), *others.items()):
            if record is not None:
                table[name] = _plain_table(record)
        if self.depth is not None:
            changed = _plain_table(self.depth.encoding, beside=_USUAL)
            table["depth"] = changed | {
                name: value
                for name, value in (("instead_of_tag_m", self.depth.instead_of_tag_m),)
                if value is not None
            }
        return table

    def text(self) -> str:
        """Return the shape as one line of JSON, as an index keeps it beside each scene."""
        return json.dumps(self.table(), sort_keys=True)

    def nodes(self, document: dict[str, Any], *, where: str) -> list[Node]:
        """Return the values below a document, with those that are stated, without ignored ones.

        Raises:
            SchemaError: If a place that is stated is not in the document.
        """
        nodes = []
        for name, at in self.numbers.items():
            value, path = at.value, at.place or f"[{name}] of the conventions"
            if at.place is not None:
                value = self.value_at(document, at.place, table=name, where=where)
            if at.place is not None or at.value is not None:
                nodes.append(Node("", at.unit or "", "", "", value, path, means=NUMBERS[name]))
        return nodes + [node for node in nodes_of(document) if not self.ignores(node.path)]

    def value_at(self, document: dict[str, Any], path: str, *, table: str, where: str) -> Any:
        """Return the value at a place that is stated.

        Raises:
            SchemaError: If it is not in the document.
        """
        try:
            return value_at(document, path)
        except LookupError as error:
            keys = plain_line(shortened(", ".join(sorted(document)), 400))
            raise SchemaError(
                f"{where}: {plain_line(path)} is not in the file, and the conventions say that "
                f"[{table}] stands there; its keys are: {keys}. Correct the place, or state "
                f"another [[shape]] for such files."
            ) from error

    def ignores(self, path: str) -> bool:
        """Return whether what stands at a JSON path, or the object around it, does not count."""
        records = [*self.numbers.values(), self.baselines, self.primary_pair]
        listed = {each for record in records if record is not None for each in record.ignored}
        return any(path == each or path.startswith((f"{each}.", f"{each}[")) for each in listed)


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
            SchemaError: If there is none.
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

_KINDS: Final[dict[str, Any]] = {
    **dict.fromkeys(NUMBERS, NumberAt),
    "baselines": BaselinesAt,
    "primary_pair": PrimaryPairAt,
    "poses": PosesAs,
    "depth": DepthAs,
}


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
        SchemaError: If it is none.
    """
    where = "the conventions of a scene"
    try:
        table = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SchemaError(f"{where}: not JSON: {error}.") from error
    if not isinstance(table, dict):
        raise SchemaError(f"{where}: not an object.")
    return _shape(table, where=where)


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
    if not isinstance(tables, list) or not 0 < len(tables) <= _MOST:
        raise SchemaError(f"{where}: [[shape]] must be 1 to {_MOST} tables. Write [[shape]].")
    shapes = []
    for number, table in enumerate(tables, 1):
        place = f"{where}: shape {number}" if len(tables) > 1 else where
        if not isinstance(table, dict):
            raise SchemaError(f"{place}: shape must be a table, found {_shown(table)}: [[shape]].")
        shapes.append(_shape(table, where=place))
    return Conventions(tuple(shapes), where)


def _shape(table: dict[str, Any], *, where: str) -> Shape:
    _require_known(table, ("has", *_KINDS), where=where)
    records: dict[str, Any] = {}
    for name, content in table.items():
        place = f"{where}: [{name}]"
        if name == "has":
            records[name] = _texts(content, where=f"{where}: has")
        elif not isinstance(content, dict):
            raise SchemaError(f"{place} must be a table, found {_shown(content)}.")
        elif name == "depth":
            records[name] = _depth(content, where=place)
        else:
            records[name] = _record(_KINDS[name], content, where=place)
    numbers = {name: records.pop(name) for name in NUMBERS if name in records}
    for name, record in {**numbers, **records}.items():
        unit, known = getattr(record, "unit", None), _UNITS.get(name, UNITS_M)
        if unit is not None and unit not in known:
            raise SchemaError(
                f"{where}: [{name}]: unit must be one of {', '.join(sorted(known))}, found "
                f"{_shown(unit)}."
            )
    for name, number in numbers.items():
        if (number.place is None) == (number.value is None) and not number.ignored:
            raise SchemaError(
                f"{where}: [{name}] must have either a place, such as "
                f'place = "$.camera_intrinsics.{name}", or the value that it has in every scene.'
            )
    return Shape(**records, numbers=numbers)


def _record(kind: Any, table: dict[str, Any], *, where: str) -> Any:
    known = {field.name: field for field in fields(kind)}
    _require_known(table, known, where=where)
    values = {name: _CHECKS[name](value, where=f"{where}: {name}") for name, value in table.items()}
    missing = [name for name in ("place", "left", "right") if name in known and name not in values]
    if missing and kind is not NumberAt:
        raise SchemaError(f"{where}: {missing[0]} is missing. Write a JSON path, such as $.pairs.")
    return kind(**values)


def _depth(table: dict[str, Any], *, where: str) -> DepthAs:
    names = {field.name for field in fields(DepthEncoding)} - {"source"}
    _require_known(table, (*sorted(names), "instead_of_tag_m"), where=where)
    values = dict(table)
    instead_m = values.pop("instead_of_tag_m", None)
    if instead_m is not None:
        instead_m = _positive(instead_m, where=f"{where}: instead_of_tag_m")
        if "unit_m" not in values:
            raise SchemaError(f"{where}: instead_of_tag_m needs the right unit_m beside it.")
    for name, value in values.items():
        values[name] = _DEPTH_CHECKS.get(name, _no_bool)(value, where=f"{where}: {name}")
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


def _text(value: object, *, where: str) -> str:
    if not isinstance(value, str) or not 0 < len(value) <= _LONGEST:
        raise SchemaError(f"{where} must be a text, found {_shown(value)}.")
    return value


def _path(value: object, *, where: str) -> str:
    text = _text(value, where=where)
    if not _PLACE.fullmatch(text):
        raise SchemaError(
            f"{where} must be a JSON path, such as $.camera_intrinsics.focal_length_mm, found "
            f"{_shown(value)}."
        )
    return text


def _texts(value: object, *, where: str) -> tuple[str, ...]:
    if not isinstance(value, list) or len(value) > _MOST:
        raise SchemaError(f"{where} must be a list of texts, found {_shown(value)}.")
    return tuple(_text(each, where=where) for each in value)


def _paths(value: object, *, where: str) -> tuple[str, ...]:
    return tuple(_path(each, where=where) for each in _texts(value, where=where))


def _positive(value: object, *, where: str) -> float:
    if not is_number(value) or value <= 0:
        raise SchemaError(f"{where} must be a number above zero, found {_shown(value)}.")
    return float(value)


def _unit(value: object, *, where: str) -> str:
    return words(_text(value, where=where))


def _no_bool(value: object, *, where: str) -> object:
    if isinstance(value, bool):
        raise SchemaError(f"{where} must not be {_shown(value)}.")
    return value


def _risks(value: object, *, where: str) -> frozenset[str]:
    accepted = _texts(value, where=where)
    _require_known(accepted, get_args(DepthRisk), where=where)
    return frozenset(accepted)


def _stored_numbers(value: object, *, where: str) -> tuple[Any, ...]:
    if not isinstance(value, list) or len(value) > _MOST:
        raise SchemaError(
            f'{where} must be a list of stored numbers, such as [0, "max"], found {_shown(value)}.'
        )
    return tuple(value)


_DEPTH_CHECKS: Final[dict[str, Callable[..., Any]]] = {
    "accept": _risks, "no_depth": _stored_numbers, "kind": _text, "form": _text,
}  # fmt: skip
_CHECKS: Final[dict[str, Callable[..., Any]]] = {
    "place": _path, "value": _positive, "unit": _unit, "ignored": _paths, "left": _path,
    "right": _path, "location": _text, "rotation": _text, "form": _text, "axes": _text,
}  # fmt: skip


def _shown(value: object) -> str:
    return plain_line(shortened(repr(value)))


def _plain_table(record: Any, *, beside: Any = None) -> dict[str, Any]:
    """Return the fields of a record that say something, as TOML and JSON have them."""
    table = {}
    for name in (each.name for each in fields(record) if each.name != "source"):
        value = getattr(record, name)
        default = None if beside is None else getattr(beside, name)
        if value is None or value == () or value == default:
            continue
        is_many = isinstance(value, tuple | frozenset)
        table[name] = sorted(value, key=str) if isinstance(value, frozenset) else (
            list(value) if is_many else value
        )  # fmt: skip
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
        for name in sorted({*table, *noted}, key=[*_KINDS].index):
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
    steps = re.findall(r'\.([^.\[]+)|\[([0-9]+)\]|\["((?:[^"\\]|\\.)*)"\]', path)
    named = ("[]" if number else f".{re.sub('[0-9]+', '#', words(plain or quoted))}"
             for plain, number, quoted in steps)  # fmt: skip
    return "$" + "".join(named)
