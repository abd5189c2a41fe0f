"""``trajectory.json``: the numbers of six cameras over the frames of a scene, found by structure.

Nobody of this project has seen a released trajectory. So no key is expected: every list, and every
object whose keys only count (``"Cam_00"``, ``"frame_0007"``), is an axis, and numbers at the same
place in all of them become one array. `RecordedPoses` holds those that have an axis of six cameras
and an axis of frames; what they mean as poses is for `geometry.pose_forms` to say and for
`index.evidence` to confirm.
"""

import math
import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.document import (
    brief,
    camera_of,
    is_number,
    listed_keys,
    parse_document,
)
from stereogenbench_data.schema.quantities import Values
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.schema.units import without_unit, words

_COUNTING: Final = re.compile(r"(.*?)(\d+)\Z")
_SPEAKS_OF_FORM: Final = re.compile(
    r"rotation|orientation|euler|quaternion|representation|convention|coordinate|handed|axes|axis|"
    r"matrix|transform|pose|extrinsic|world|angle|format|unit|frame_of_reference|system"
)
_COMPONENTS: Final = (
    ("pitch", "yaw", "roll"),
    ("p", "y", "r"),
    ("qx", "qy", "qz", "qw"),
    ("x", "y", "z", "w"),
    ("x", "y", "z"),
    ("tx", "ty", "tz"),
    ("rx", "ry", "rz"),
    tuple(f"m{row}{column}" for row in range(4) for column in range(4)),
)
"""Names of components, in the order in which they are kept; the first that are all there win."""
_TRAILING: Final = ((4, 4), (3, 4), (3, 3), (16,), (12,), (9,), (4,), (3,))
_MOST_VALUES: Final = 2_000_000
_DEEPEST: Final = 20

Place = tuple[str, ...]
Columns = dict[Place, tuple[tuple[int, ...], list[Any]]]
"""The values at each place of a document, with the lengths of the axes on the way to them."""


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Numbers of each camera in each frame.

    Attributes:
        name: The keys on the way to them, in snake_case, outermost first; "*" is an axis.
        components: The names of the components, where they are keys: ("pitch", "yaw", "roll").
        unit: The unit at the end of their keys, "" without one.
        values: (frames, 6, ...) float64: frames and cameras in the order of their numbers.
    """

    name: Place
    components: tuple[str, ...]
    unit: str
    values: np.ndarray

    @property
    def words(self) -> frozenset[str]:
        """The words of the last two keys: what the numbers are called."""
        keys = [key for key in self.name if key != "*"][-2:]
        found = {word for key in keys for word in key.split("_")}
        return frozenset(found | {word.removesuffix("s") for word in found})

    @property
    def key(self) -> str:
        """The keys as messages show them."""
        return ".".join("[]" if key == "*" else key for key in self.name).replace(".[]", "[]")


@dataclass(frozen=True, slots=True)
class RecordedPoses:
    """What a trajectory records.

    Attributes:
        blocks: The numbers that may be part of poses.
        hints: The words of the texts in which a file says how they are to be read.
        unit_m: Metres in the unit that the file names for lengths, None without one.
        head: The file with three elements of each long list: what it states beside poses.
        first_frame: The least number that frames have, 0 where they have none.
    """

    blocks: tuple[Block, ...]
    hints: frozenset[str]
    unit_m: float | None
    head: dict[str, Any]
    first_frame: int = 0


def record_poses(text: bytes, *, where: str) -> RecordedPoses:
    """Return the numbers of a ``trajectory.json`` that belong to six cameras in each frame.

    Args:
        text: The file's bytes.
        where: The file's path, for messages.

    Raises:
        SchemaError: If the file is not JSON, or no numbers of six cameras over frames are in it.

    Source: the paper's appendix on the file schema.
    """
    document = parse_document(text, where=where)
    if not isinstance(document, dict):
        document = {"frames": document}
    columns = _columns(document)
    if sum(len(values) for _, values in columns.values()) > _MOST_VALUES:
        raise SchemaError(f"{where}: has over {_MOST_VALUES:,} values. Replace it with the file of "
                          "the release.")  # fmt: skip
    blocks, odd = [], []
    lists = [_of_list(place, *column) for place, column in columns.items()]
    for block in (*filter(None, lists), *_of_components(columns)):
        try:
            ordered = _ordered(block.name, block.values, columns)
        except _Odd as error:
            odd.append(str(error))
            continue
        if ordered is not None:
            blocks.append(replace(block, values=ordered))
    if not blocks or odd:
        reason = "; ".join(dict.fromkeys(odd)) or (
            f"no numbers of {CAMERA_COUNT} cameras in each frame are in it; the keys are: "
            f"{listed_keys(document)}"
        )
        raise SchemaError(f"{where}: {reason}.")
    head = _head_of(document)
    unit_m, first_frame = _unit_m(head, where), _first_frame(columns)
    return RecordedPoses(tuple(blocks), _hints(document), unit_m, head, first_frame)


def _first_frame(columns: Columns) -> int:
    named = (values for place, (lengths, values) in columns.items()
             if lengths and place[-1] in ("#", *_FRAME_KEYS) and "frame" in "".join(place[-3:])
             and "cam" not in "".join(place[-2:]))  # fmt: skip
    numbers = (number for values in named for number in map(_frame_of, values))
    return min((number for number in numbers if number is not None), default=0)


def _head_of(node: Any) -> Any:
    """Return a document with the first, a middle and the last element of what has many elements."""
    if not isinstance(node, dict | list):
        return node
    step = 1 if len(node) <= _MOST_HINTS else (len(node) - 1) // 2
    if isinstance(node, list):
        return [_head_of(each) for each in node[::step]]
    return {key: _head_of(node[key]) for key in [*node][::step]}


def _unit_m(head: dict[str, Any], where: str) -> float | None:
    values = Values(head)
    named = [each for each in values.stated("unit") if isinstance(each.value, str)]
    if named and values.length_unit_m is None:
        raise SchemaError(
            f"{where}: {named[0].path}: {brief(named[0].value)} is not a unit of length that is "
            f"known (mm, cm, m). Correct it."
        )
    return values.length_unit_m


def _hints(document: dict[str, Any]) -> frozenset[str]:
    """Return the words of short texts, outside frames, that speak of how poses are written."""
    found: set[str] = set()
    waiting: list[tuple[str, Any]] = [(words(key), value) for key, value in document.items()]
    while waiting:
        name, value = waiting.pop()
        if isinstance(value, dict) and len(value) < _MOST_HINTS:
            waiting += [(f"{name}_{words(key)}", inner) for key, inner in value.items()]
        elif isinstance(value, str) and len(value) < 200 and _SPEAKS_OF_FORM.search(name):
            found |= {words(value), *words(value).split("_"), *name.split("_")}
        elif isinstance(value, list) and 0 < len(value) <= 4 and _SPEAKS_OF_FORM.search(name):
            found |= {"".join(map(str, value)).lower()}
    return frozenset(found)


_MOST_HINTS: Final = 64


class _Odd(Exception):
    """Numbers of cameras that cannot be put in order."""


def _columns(document: dict[str, Any]) -> Columns:
    """Return the values at each place of a document: the lengths of its axes, and all values.

    Places that not all elements of a list have alike, and very deep ones, are left out, and so are
    axes of one element below those of frames and cameras.
    """
    found: dict[Place, list[Any]] = defaultdict(list)
    lengths: dict[Place, set[int]] = defaultdict(set)
    for place, value in _leaves(document, (), lengths):
        found[place].append(value)
    columns: Columns = {}
    for place, values in found.items():
        axes = {at: lengths[place[: at + 1]] for at, key in enumerate(place) if key == "*"}
        if any(len(each) > 1 for each in axes.values()):
            continue
        of_one = [at for at, each in [*axes.items()][2:] if each == {1}]
        plain = tuple(key for at, key in enumerate(place) if at not in of_one)
        if math.prod(count for (count,) in axes.values()) == len(values):
            columns[plain] = tuple(n for at, (n,) in axes.items() if at not in of_one), values
    return columns


def _leaves(node: Any, place: Place, lengths: dict[Place, set[int]]) -> Iterator[tuple[Place, Any]]:
    """Yield the values below a node with their places, and add the lengths of the axes."""
    if not isinstance(node, dict | list) or len(place) >= _DEEPEST:
        yield place, node
        return
    is_list = isinstance(node, list)
    groups = _counted(node) if isinstance(node, dict) else {"": [*enumerate(_by_frame(node))]}
    for name, group in groups.items():
        axis = (*place, name, "*") if name else (*place, "*")
        lengths[axis].add(len(group))
        for number, value in group:
            yield from () if is_list else [((*axis, "#"), number)]
            yield from _leaves(value, axis, lengths)
    among = {id(value) for group in groups.values() for _, value in group}
    pairs = node.items() if isinstance(node, dict) else ()
    others = {words(key): value for key, value in pairs if id(value) not in among}
    for name, value in others.items():
        yield from _leaves(value, (*place, name), lengths)


def _counted(node: dict[str, Any]) -> dict[str, list[tuple[int, Any]]]:
    """Return the objects and lists of an object whose keys only count, by their numbers.

    There is one group for what stands before the numbers, of which the last word is kept.
    """
    groups: dict[str, list[tuple[int, Any]]] = {}
    for key, value in node.items():
        match = _COUNTING.match(key) if isinstance(value, dict | list) else None
        if match is not None:
            groups.setdefault(match[1], []).append((int(match[2]), value))
    return {
        words(before).rpartition("_")[2]: sorted(group, key=lambda each: each[0])
        for before, group in groups.items()
        if len(group) > 1
    }


def _by_frame(records: list[Any]) -> list[Any]:
    """Return one list of poses for each frame, where each record names its camera and its frame."""
    if len(records) <= CAMERA_COUNT or not all(isinstance(each, dict) for each in records):
        return records
    named = [{words(key): value for key, value in each.items()} for each in records]
    key = next((name for name in _CAMERA_KEYS if name in named[0]), None)
    frame_key = next((name for name in _FRAME_KEYS if name in named[0] and name != key), None)
    cameras = {camera_of(each.get(key)) for each in named} if key else set()
    if frame_key is None or len(cameras) != CAMERA_COUNT or None in cameras:
        return records
    frames: dict[int, list[Any]] = {}
    for name, record in zip(named, records, strict=True):
        frame = _frame_of(name.get(frame_key))
        if frame is None:
            return records
        frames.setdefault(frame, []).append(record)
    if max(frames) - min(frames) >= len(frames) or {*map(len, frames.values())} != {CAMERA_COUNT}:
        return records
    return [frames[frame] for frame in sorted(frames)]


def _of_list(place: Place, lengths: tuple[int, ...], values: list[Any]) -> Block | None:
    """Return the numbers of a list or of nested lists in each camera of each frame."""
    axes = len(lengths) - 2
    if lengths[2:] not in _TRAILING or {*place[-axes:]} != {"*"}:
        return None
    array, (*base, last) = _as_numbers(values, lengths), place[:-axes]
    name, unit = without_unit(last)
    return None if array is None else Block((*base, name), (), unit, array)


def _of_components(columns: Columns) -> list[Block]:
    """Return the numbers whose components are keys; a prefix (``location_x``) joins the place."""
    groups: dict[tuple[Place, tuple[int, ...]], dict[str, tuple[str, list[Any]]]] = {}
    for place, (lengths, values) in columns.items():
        if place and place[-1] not in ("*", "#") and len(lengths) == 2:
            name, unit = without_unit(place[-1])
            head, _, last = name.rpartition("_")
            base = (*place[:-1], head) if head else place[:-1]
            groups.setdefault((base, lengths), {}).setdefault(last, (unit, values))
    found: list[Block] = []
    for (base, lengths), components in groups.items():
        names_there = [names for names in _COMPONENTS if set(names) <= set(components)]
        if ("x", "y", "z", "w") in names_there:
            names_there.remove(("x", "y", "z"))
        last, own_unit = without_unit(base[-1])
        for names in names_there:
            parts = [_as_numbers(components[name][1], lengths) for name in names]
            numbers = [part for part in parts if part is not None]
            if len(numbers) == len(names):
                unit = components[names[0]][0] or own_unit
                names = _COMPONENTS[0] if names == ("p", "y", "r") else names
                found.append(Block((*base[:-1], last), names, unit, np.stack(numbers, axis=-1)))
    return found


def _as_numbers(values: list[Any], lengths: tuple[int, ...]) -> np.ndarray | None:
    """Return values as float64, None where one is not a number; nan stays where the file has it."""
    kinds = set(map(type, values))
    if not kinds <= {int, float}:
        return None
    if int in kinds and not all(is_number(value) for value in values if type(value) is int):
        return None
    return np.array(values, dtype=np.float64).reshape(lengths)


def _ordered(place: Place, values: np.ndarray, columns: Columns) -> np.ndarray | None:
    """Return values as (frames, 6, ...), in the order of the numbers; None where no axis has six.

    Raises:
        _Odd: If frames or cameras are numbered twice or with a gap.
    """
    axes = [at for at, key in enumerate(place) if key == "*"][:2]
    if len(axes) < 2 or CAMERA_COUNT not in values.shape[:2]:
        return None
    owners = [next((key for key in reversed(place[:at]) if key != "*"), "") for at in axes]
    named = ["cam" in owner or "view" in owner for owner in owners]
    is_outer = values.shape[0] == CAMERA_COUNT and (values.shape[1] != CAMERA_COUNT or named[0])
    if values.shape[0] == values.shape[1] and named[0] != named[1]:
        is_outer = named[0]
    camera_axis = 0 if is_outer else 1
    is_of_frames = "frame" in place[: axes[camera_axis]][-1] and not named[camera_axis]
    if values.shape[camera_axis] != CAMERA_COUNT or is_of_frames:
        return None
    values = np.swapaxes(values, 0, 1) if is_outer else values
    # Cameras first: each frame may list them in an order of its own.
    for what, axis, at in (("cameras", 1, axes[camera_axis]), ("frames", 0, axes[1 - camera_axis])):
        numbers = _numbers_of(place[: at + 1], columns, what)
        if numbers is not None:
            if numbers.ndim == 1:
                numbers = np.expand_dims(numbers, 1 - axis)
            elif is_outer:
                numbers = numbers.T
            order = np.apply_along_axis(_order, axis, numbers, what)
            order = np.expand_dims(order, tuple(range(2, values.ndim)))
            values = np.take_along_axis(values, order, axis=axis)
    return np.ascontiguousarray(values)


def _order(numbers: np.ndarray, what: str) -> np.ndarray:
    """Return how elements are put in the order of their numbers, which have no gap.

    Cameras count from 0 or 1, frames from any number.
    """
    order = np.argsort(numbers, kind="stable")
    ascending = numbers[order]
    is_odd = ascending[0] not in (0, 1) if what == "cameras" else ascending[0] < 0
    if is_odd or (np.diff(ascending) != 1).any():
        repeated = ascending[1:][np.diff(ascending) == 0]
        found = f"{repeated[0]} is there twice" if len(repeated) else (
            f"there are {len(numbers)} of {ascending[0]} to {ascending[-1]}"
        )  # fmt: skip
        start = " from 0 or 1" if what == "cameras" else " from 0 or above"
        raise _Odd(f"{what} must be numbered{start} without a gap, and {found}")
    return order


def _numbers_of(place: Place, columns: Columns, what: str) -> np.ndarray | None:
    """Return the numbers of the elements of an axis, (n,) or (outer, inner), None without any.

    They are the keys of an object, or stand in the elements under a key that speaks of them.
    """
    keyed = columns.get((*place, "#"))
    if keyed is not None:
        lengths, values = keyed
        return np.array(values).reshape(lengths) if len(lengths) <= 2 else None
    names, number_of = (_CAMERA_KEYS, camera_of) if what == "cameras" else (_FRAME_KEYS, _frame_of)
    known: dict[str, np.ndarray] = {}
    for name in names:
        lengths, values = columns.get((*place, name), ((), []))
        found = list(map(number_of, values))
        if found and len(lengths) <= 2 and None not in found:
            known[name] = np.array(found, dtype=np.int64).reshape(lengths)
    if what == "cameras" and not known:
        lengths, values = columns.get(("camera_order", "*"), ((), []))
        order = list(map(camera_of, values))
        is_order = lengths == (CAMERA_COUNT,) and None not in order
        return np.array(order, dtype=np.int64) if is_order else None
    if not known:
        return None
    first, numbers = next(iter(known.items()))
    for name, others in known.items():
        is_number_too = {*np.unique(others)} == {*np.unique(numbers)}
        if is_number_too and not np.array_equal(others, numbers):
            raise _Odd(f"{first} and {name} number {what} apart")
    is_same = numbers.ndim == 2 and bool((numbers == numbers[:1]).all())
    return np.asarray(numbers[0]) if is_same else numbers


def _frame_of(value: object) -> int | None:
    match = _COUNTING.match(value) if isinstance(value, str) else None
    return int(match[2]) if match else None if isinstance(value, str) else camera_of(value)


_CAMERA_KEYS: Final = ("camera_index", "camera_id", "cam_index", "cam_id", "camera_number", "index",
                       "id", "camera", "cam", "camera_name", "name", "label")  # fmt: skip
_FRAME_KEYS: Final = ("frame_index", "frame", "frame_number", "frame_id", "index", "id", "number",
                      "t", "frame_idx", "idx")  # fmt: skip
