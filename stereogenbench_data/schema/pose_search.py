"""Where poses may stand in a ``trajectory.json`` that nobody has declared: a search by structure.

Every list, and every object whose keys only count (``"Cam_00"``, ``"frame_0007"``), is an axis. The
first element of each is looked at, so the search is as long as one pose: what it finds are places,
from which `schema.trajectory` reads the numbers of all. Settling alone searches.
"""

import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.declaration import PosesAt
from stereogenbench_data.schema.document import (
    brief,
    child_path,
    is_number,
    listed_keys,
)
from stereogenbench_data.schema.places import first_value
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.schema.trajectory import COMPONENTS, Block, number_of, read_block
from stereogenbench_data.schema.units import named_unit_m, without_unit, words

_COUNTING: Final = re.compile(r"(.*?)[0-9]{1,9}\Z", re.DOTALL)
_LAST_WORD: Final = re.compile(r"[A-Za-z]+[ _-]*\Z")
_PLAIN_KEY: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_SPEAKS_OF_FORM: Final = re.compile(
    r"rotation|orientation|euler|quaternion|representation|convention|coordinate|handed|axes|axis|"
    r"matrix|transform|pose|extrinsic|world|angle|format|unit|frame_of_reference|system"
)
_UNITS: Final = tuple(f"$.{name}" for name in ("unit", "units", "length_unit", "world_unit",
                                               "location_unit", "position_unit"))  # fmt: skip
_TRAILING: Final = ((4, 4), (3, 4), (3, 3), (16,), (12,), (9,), (4,), (3,))
_DEEPEST: Final = 20
_MOST_PLACES: Final = 40
"""How many places of numbers are read: a pose has some few, and each is read through the file."""
_MOST_HINTS: Final = 64


@dataclass(frozen=True, slots=True)
class RecordedPoses:
    """What a trajectory records.

    Attributes:
        blocks: The numbers that may be part of poses.
        hints: The words of the texts in which a file says how they are to be read.
        unit_m: Metres in the unit that the file names for lengths, None without one.
        odd: What is wrong with numbers that could not be read.
    """

    blocks: tuple[Block, ...]
    hints: frozenset[str]
    unit_m: float | None
    odd: tuple[str, ...]


def recorded_in(document: dict[str, Any], *, where: str) -> RecordedPoses:
    """Return all numbers of six cameras in each frame that a ``trajectory.json`` may mean.

    Raises:
        SchemaError: If there are none, or frames or cameras have no order.
    """
    blocks: list[Block] = []
    odd: list[str] = []
    for at in places_in(document):
        try:
            blocks.append(read_block(document, at, str(at.rotation), where=where))
        except SchemaError as error:
            odd.append(str(error).removeprefix(f"{where}: ").rstrip("."))
    if not blocks:
        reason = "; ".join([*dict.fromkeys(odd)][:3]) or (
            f"no numbers of {CAMERA_COUNT} cameras in each frame are in it; the keys are: "
            f"{listed_keys(document)}"
        )
        raise SchemaError(f"{where}: {reason}.")
    numbered = [each for each in odd if "must be numbered" in each or " apart" in each]
    if numbered:
        raise SchemaError(f"{where}: {numbered[0]}.")
    unit_m = unit_in(document, where=where)
    return RecordedPoses(tuple(blocks), hints_in(document), unit_m, tuple(odd))


def unit_in(document: dict[str, Any], *, where: str) -> float | None:
    """Return the metres in the unit that a file names for lengths; None without one.

    Raises:
        SchemaError: If it is not known.
    """
    path, text = first_value(document, _UNITS)
    if not isinstance(text, str):
        return None
    unit_m = named_unit_m(text)
    if unit_m is None:
        raise SchemaError(
            f"{where}: {path}: {brief(text)} is not a unit of length that is known (mm, cm, m). "
            f"Correct it."
        )
    return unit_m


def hints_in(document: dict[str, Any]) -> frozenset[str]:
    """Return the words of short texts, outside frames, that speak of how poses are written."""
    found: set[str] = set()
    waiting: list[tuple[str, Any]] = [(words(key), value) for key, value in document.items()]
    while waiting:
        name, value = waiting.pop()
        if isinstance(value, dict) and len(value) < _MOST_HINTS:
            waiting += [(f"{name}_{words(key)}", inner) for key, inner in value.items()]
        elif isinstance(value, str) and len(value) < 200 and _SPEAKS_OF_FORM.search(name):
            parts = words(value).split("_")
            found |= {*parts, *name.split("_"), *map("".join, itertools.pairwise(parts))}
        elif isinstance(value, list) and 0 < len(value) <= 4 and _SPEAKS_OF_FORM.search(name):
            found |= {"".join(map(str, value)).lower()}
    return frozenset(found)


@dataclass(frozen=True, slots=True)
class _Axis:
    """A list or an object whose elements are frames or cameras.

    Attributes:
        path: The place of its elements.
        owner: The key that it stands under.
        elements: Its elements.
        is_keyed: Whether their numbers are their keys.
    """

    path: str
    owner: str
    elements: Sequence[Any]
    is_keyed: bool = False


def places_in(document: dict[str, Any]) -> list[PosesAt]:
    """Return the places of numbers of six cameras in each frame, each as a rotation's."""
    found = [*itertools.islice(_places(document, "$", "", (), 0), _MOST_PLACES)]
    lists = [each for each in found if not str(each.rotation).endswith(",]")]
    order = document.get("camera_order")
    has_order = isinstance(order, list) and [*map(number_of, order)].count(None) == 0
    named = "$.camera_order[]" if has_order and len(order or ()) == CAMERA_COUNT else None
    return [
        replace(each, rotation=str(each.rotation).replace(",]", "]"), camera=each.camera or named)
        for each in (*lists, *(each for each in found if each not in lists))
    ]


def _places(
    node: Any, path: str, owner: str, axes: tuple[_Axis, ...], depth: int
) -> Iterator[PosesAt]:
    """Yield the places below a node; those of components end in ",]" for now."""
    if depth > _DEEPEST:
        return
    if isinstance(node, list) and node:
        yield from _places_in_list(node, path, owner, axes, depth)
    elif isinstance(node, dict):
        groups = _counted(node) if len(axes) < 2 else {}
        for text, keys in groups.items():
            elements = [node[key] for key in keys]
            inner = f"{path}.{{{text}}}"
            name = words(text).rpartition("_")[2] or owner
            axis = _Axis(inner, name, elements, is_keyed=True)
            yield from _places(elements[0], inner, name, (*axes, axis), depth + 1)
        among = {key for keys in groups.values() for key in keys}
        others = {key: value for key, value in node.items() if key not in among}
        if len(axes) == 2:
            yield from _components(others, path, axes)
        for key, value in others.items():
            if isinstance(value, dict | list):
                inner = child_path(path, key)
                yield from _places(value, inner, words(key), axes, depth + 1)


def _places_in_list(
    node: list[Any], path: str, owner: str, axes: tuple[_Axis, ...], depth: int
) -> Iterator[PosesAt]:
    if len(axes) == 2 and _shape_of(node) in _TRAILING:
        yield from _numbered(path, axes)
    elif len(node) == 1:  # a list of one shot, or of one vector
        yield from _places(node[0], f"{path}[0]", owner, axes, depth + 1)
    if len(axes) == 2:
        return
    inner = f"{path}[]"
    axis = _Axis(inner, owner, node)
    own = (axis, axis) if not axes and _are_rows(node) else (*axes, axis)
    own_name = "" if isinstance(node[0], list) else owner  # that of the outer list
    yield from _places(node[0], inner, own_name, own, depth + 1)


def _shape_of(node: list[Any]) -> tuple[int, ...]:
    """Return the shape of a list of numbers or of lists of numbers; () of others."""
    if all(isinstance(each, list) for each in node):
        widths = {len(each) for each in node}
        are_numbers = all(is_numeric(value) for each in node for value in each)
        return (len(node), widths.pop()) if len(widths) == 1 and are_numbers else ()
    return (len(node),) if all(map(is_numeric, node)) else ()


def is_numeric(value: object) -> bool:
    """Return whether a value is a number, finite or not."""
    return type(value) is float or is_number(value)


def _counted(node: dict[str, Any]) -> dict[str, list[str]]:
    """Return the keys of an object that only count, by the last word before their numbers."""
    groups: dict[str, list[str]] = {}
    for key, value in node.items():
        match = _COUNTING.match(key[-256:]) if isinstance(value, dict | list) else None
        if match is not None:
            last = _LAST_WORD.search(match[1])
            groups.setdefault("" if last is None else last[0], []).append(key)
    return {text: keys for text, keys in groups.items() if len(keys) > 1}


def _are_rows(node: list[Any]) -> bool:
    """Return whether each element of a list names its camera and its frame."""
    first = node[0]
    if not isinstance(first, dict) or len(node) <= CAMERA_COUNT or len(node) % CAMERA_COUNT:
        return False
    cameras = _key_of(node, _CAMERA_KEYS)
    frames = _key_of(node, tuple(key for key in _FRAME_KEYS if key != cameras))
    numbers = {number_of(each.get(cameras)) for each in node} if cameras else set()
    return bool(frames) and len(numbers) == CAMERA_COUNT


def _components(node: dict[str, Any], path: str, axes: tuple[_Axis, ...]) -> Iterator[PosesAt]:
    """Yield the places of numbers whose components are keys; a prefix (``location_x``) is one."""
    groups: dict[str, dict[str, str]] = {}
    for key, value in node.items():
        if is_numeric(value) and _PLAIN_KEY.match(key):
            head, _, last = without_unit(words(key))[0].rpartition("_")
            groups.setdefault(head, {}).setdefault(last, key)
    for components in groups.values():
        names_there = [names for names in COMPONENTS if set(names) <= set(components)]
        if ("x", "y", "z", "w") in names_there:
            names_there.remove(("x", "y", "z"))
        for names in names_there:
            yield from _numbered(f"{path}[{','.join(components[name] for name in names)},]", axes)


def _numbered(text: str, axes: tuple[_Axis, ...]) -> Iterator[PosesAt]:
    """Yield a place with how its frames and cameras are numbered, if six of an axis are cameras."""
    outer, inner = axes
    if outer is inner:
        camera = _key_of(outer.elements, _CAMERA_KEYS)
        frame = _key_of(outer.elements, tuple(k for k in _FRAME_KEYS if k != camera))
        places = (child_path(outer.path, key) for key in (str(frame), str(camera)))
        yield PosesAt(rotation=text, outer="rows", frame=next(places), camera=next(places))
        return
    sizes = len(outer.elements), len(inner.elements)
    if CAMERA_COUNT not in sizes:
        return
    is_named = "cam" in outer.owner or "view" in outer.owner
    is_outer = sizes[0] == CAMERA_COUNT and (sizes[1] != CAMERA_COUNT or is_named)
    cameras, frames = (outer, inner) if is_outer else (inner, outer)
    if "frame" in cameras.owner and "cam" not in cameras.owner:
        return
    frame = _numbers_at(frames, _FRAME_KEYS)
    yield PosesAt(
        rotation=text,
        outer="cameras" if is_outer else "frames",
        camera=_numbers_at(cameras, _CAMERA_KEYS),
        frame=frame,
        step=_step(frames, frame),
    )


def _numbers_at(axis: _Axis, keys: Sequence[str]) -> str | None:
    """Return where the elements of an axis have their numbers; None where they have none."""
    if axis.is_keyed:
        return f"{axis.path}#"
    key = _key_of(axis.elements, keys)
    return None if key is None else child_path(axis.path, key)


def _key_of(elements: Sequence[Any], keys: Sequence[str]) -> str | None:
    """Return the first likely key under which the first element has a number."""
    first = elements[0]
    if not isinstance(first, dict) or not all(isinstance(each, dict) for each in elements):
        return None
    named = {words(key): key for key in first}
    there = (named[key] for key in keys if key in named)
    numbered = (key for key in there if number_of(first[key]) is not None)
    # Under "t" there may be seconds, which count nothing.
    return next(
        (key for key in numbered
         if words(key) != "t" or all(number_of(each.get(key)) is not None for each in elements)),
        None,
    )  # fmt: skip


def _step(frames: _Axis, place: str | None) -> int | None:
    """Return by how much the numbers of frames grow, None for 1."""
    if place is None or frames.is_keyed:
        return None
    key = _key_of(frames.elements, _FRAME_KEYS)
    numbers = sorted(number_of(each.get(key)) or 0 for each in frames.elements)
    steps = {b - a for a, b in itertools.pairwise(numbers)}
    step = steps.pop() if len(steps) == 1 else 1
    return step if step > 1 else None


_CAMERA_KEYS: Final = ("camera_index", "camera_id", "cam_index", "cam_id", "camera_number", "index",
                       "id", "camera", "cam", "camera_name", "name", "label")  # fmt: skip
_FRAME_KEYS: Final = ("frame_index", "frame", "frame_number", "frame_id", "index", "id", "number",
                      "t", "frame_idx", "idx")  # fmt: skip
