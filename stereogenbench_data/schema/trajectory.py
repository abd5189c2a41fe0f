"""``trajectory.json``: the numbers of six cameras in each frame, read where they stand.

A `PosesAt` says where; `schema.pose_search` finds it where nobody has said it. What the numbers
mean as poses is for `geometry.pose_forms` to say and for `geometry.pose_evidence` to confirm.
"""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from jaxtyping import Float64, Int64

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.declaration import PosesAt
from stereogenbench_data.schema.document import brief, is_number, parse_document
from stereogenbench_data.schema.places import (
    Entries,
    Every,
    Place,
    Step,
    at_end,
    leaves_at,
    path_of,
    place_at,
)
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.schema.units import without_unit, words

_COUNTING: Final = re.compile(r"(.*?)([0-9]{1,9})\Z", re.DOTALL)
COMPONENTS: Final = (
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
_LARGEST: Final = 10**9
"""The largest number of a frame or a camera."""
_MOST_VALUES: Final = 2_000_000
_DEEPEST: Final = 3
"""How deep in a frame is looked for what counts it."""


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Numbers of each camera in each frame.

    Attributes:
        name: The keys on the way to them, in snake_case, outermost first; "*" is an axis.
        components: The names of the components, where they are keys: ("pitch", "yaw", "roll").
        unit: The unit at the end of their keys, "" without one.
        values: (frames, 6, ...) float64: frames and cameras in the order of their numbers.
        at: Where they stand, as a rotation, and how frames and cameras are numbered.
    """

    name: tuple[str, ...]
    components: tuple[str, ...]
    unit: str
    values: np.ndarray
    at: PosesAt

    @property
    def words(self) -> frozenset[str]:
        """The words of the last two keys: what the numbers are called."""
        keys = [key for key in self.name if key != "*"][-2:]
        found = {word for key in keys for word in key.split("_")}
        return frozenset(found | {word.removesuffix("s") for word in found})

    @property
    def key(self) -> str:
        """The keys as messages show them."""
        return shown_key(self.name)


def shown_key(name: Sequence[str]) -> str:
    """Return keys on the way to numbers as messages and the names of readings have them."""
    return ".".join("[]" if key == "*" else key for key in name).replace(".[]", "[]")


def parse_trajectory(text: bytes, *, where: str) -> dict[str, Any]:
    """Return the JSON object of a ``trajectory.json``; a bare list is that of its frames.

    Raises:
        SchemaError: If it is not JSON.
    """
    document = parse_document(text, where=where)
    return document if isinstance(document, dict) else {"frames": document}


def read_block(document: dict[str, Any], at: PosesAt, text: str, *, where: str) -> Block:
    """Return the numbers at a place, in the order of frames and cameras.

    Args:
        document: The file as parsed JSON.
        at: How frames and cameras are numbered.
        text: The place.
        where: The file's path, for messages.

    Raises:
        SchemaError: If something is missing, is no number, or frames or cameras are numbered twice
            or with a gap; it names the first place, or frame and camera, that is odd.

    Source: the paper's appendix on the file schema.
    """
    place = place_at(text)
    name, components, unit = named(place)
    if place.tail == "parts":
        columns = [_numbers(document, place, at, way=way, where=where) for way in place.parts]
        values = np.stack(columns, axis=-1)
        known = next((each for each in COMPONENTS if {*each} == {*components}), None)
        # Three that end in x, y and z stay in the order that is stated: they may be angles.
        if known is not None and known[-1][-1] != "z" and len(components) == len(known):
            values = values[..., [components.index(each) for each in known]]
            components = COMPONENTS[0] if known == ("p", "y", "r") else known
    else:
        values = _numbers(document, place, at, where=where)
    ordered = _ordered(document, at, values, where=where)
    return Block(name, components, unit, ordered, replace(at, location=None, rotation=text))


def named(place: Place) -> tuple[tuple[str, ...], tuple[str, ...], str]:
    """Return the keys on the way to numbers in words, the names of components, and their unit.

    >>> named(place_at("$.frames[].{Cam_}.location_cm[x,y,z]"))
    (('frames', '*', 'cam', '*', 'location'), ('x', 'y', 'z'), 'cm')
    """
    keys: list[str] = []
    for step in place.steps:
        if isinstance(step, Every):
            keys.append("*")
        elif isinstance(step, Entries):
            keys += [*filter(None, [words(step.text).rpartition("_")[2]]), "*"]
        elif isinstance(step, str):
            keys.append(words(step))
    parts = [words(str(way[0])) for way in place.parts if way]
    plain = [without_unit(part) for part in parts]
    own_unit = plain[0][1] if plain else ""
    heads = {part.rpartition("_")[0] for part, _ in plain}
    if len(heads) == 1 and heads != {""}:  # location_x, location_y, location_z
        keys += heads
    if keys and keys[-1] != "*":
        keys[-1], unit = without_unit(keys[-1])
        own_unit = own_unit or unit
    return tuple(keys), tuple(part.rpartition("_")[2] for part, _ in plain), own_unit


def _numbers(
    document: dict[str, Any], place: Place, at: PosesAt, *, where: str, way: Sequence[Step] = ()
) -> Float64[np.ndarray, "..."]:
    """Return the numbers at a place, by its axes, and then by the lists that stand there."""
    leaves, lengths = leaves_at(document, place, where=where, way=way)

    def unreadable(odd: int) -> SchemaError:
        """Return the error of a value that is no number, or no list like the others."""
        pose = odd // math.prod(shape[len(lengths) :])
        path = path_of(document, (*place.steps, *way), pose, lengths)
        of_pose = ""
        if len(lengths) == 2:
            frame, camera = divmod(pose, lengths[1])
            frame, camera = (camera, frame) if at.outer == "cameras" else (frame, camera)
            of_pose = f"frame {frame}, camera {camera}: "
        return SchemaError(
            f"{where}: {of_pose}{path} must be a number, or as many as in the first pose, found "
            f"{brief(leaves[odd])}"
        )

    if place.tail in ("slice", "text"):
        taken = (at_end(leaf, place) for leaf in leaves)  # a list, or nothing
        leaves = [each if type(each) is list else leaf
                  for leaf, each in zip(leaves, taken, strict=True)]  # fmt: skip
    shape = list(lengths)
    while leaves and type(leaves[0]) is list and len(leaves) < _MOST_VALUES:
        count = len(leaves[0])
        odd = next((n for n, leaf in enumerate(leaves)
                    if type(leaf) is not list or len(leaf) != count), None)  # fmt: skip
        if odd is not None:
            raise unreadable(odd)
        shape.append(count)
        leaves = [each for leaf in leaves for each in leaf]
    if len(leaves) > _MOST_VALUES:
        raise SchemaError(f"{where}: has over {_MOST_VALUES:,} values. Replace it with the file of "
                          "the release.")  # fmt: skip
    kinds, whole = {*map(type, leaves)}, [each for each in leaves if type(each) is int]
    are_plain = kinds <= {int, float} and all(map(is_number, whole))
    values = np.array(leaves if are_plain else [math.nan], dtype=np.float64)
    if not np.isfinite(values).all():
        odd = next(n for n, each in enumerate(leaves) if not is_number(each))
        raise unreadable(odd)
    return values.reshape(shape)


def _ordered(
    document: dict[str, Any], at: PosesAt, values: np.ndarray, *, where: str
) -> Float64[np.ndarray, "frames 6 ..."]:
    """Return values as (frames, 6, ...), in the order of the numbers.

    Raises:
        SchemaError: If frames or cameras are numbered twice or with a gap, or are not six.
    """
    numbers = {
        what: None if text is None else _counted(document, text, where=where)
        for what, text in (("frames", at.frame), ("cameras", at.camera))
    }
    frames, cameras = numbers["frames"], numbers["cameras"]
    if frames is not None and cameras is not None and at.outer == "rows":
        order = np.lexsort((cameras, frames))
        if len(order) % CAMERA_COUNT or len(order) != len(values):
            raise SchemaError(f"{where}: has {len(order)} poses, not {CAMERA_COUNT} in each frame")
        shape = (-1, CAMERA_COUNT)
        values = values[order].reshape(*shape, *values.shape[1:])
        frames, cameras = frames[order].reshape(shape), cameras[order].reshape(shape)
    elif at.outer == "cameras":
        values = np.swapaxes(values, 0, 1)
        frames, cameras = (each.T if each is not None and each.ndim == 2 else each
                           for each in (frames, cameras))  # fmt: skip
    if values.ndim < 3 or values.shape[1] != CAMERA_COUNT:
        found = values.shape[1] if values.ndim > 1 else 0
        raise SchemaError(f"{where}: must have {CAMERA_COUNT} cameras in each frame, found {found}")
    for what, axis, each in (("cameras", 1, cameras), ("frames", 0, frames)):
        if each is None:
            continue
        if each.size not in (values.shape[axis], math.prod(values.shape[:2])):
            raise SchemaError(f"{where}: {each.size} numbers of {what} for {values.shape[axis]}")
        each = np.expand_dims(each, 1 - axis) if each.ndim == 1 else each
        if each.ndim == 2 and (each == each[:1] if axis else each == each[:, :1]).all():
            order = _order(each[0] if axis else each[:, 0], what, at, where)
            if (order != np.arange(len(order))).any():
                values = np.take(values, order, axis=axis)
            continue
        order = np.apply_along_axis(_order, axis, each, what, at, where)
        order = np.expand_dims(order, tuple(range(2, values.ndim)))
        values = np.take_along_axis(values, order, axis=axis)
    return np.ascontiguousarray(values)


_COUNTS: Final = re.compile(
    r"time|stamp|tick|(?:^|_)(?:frame|image|img|picture|exr|file|path|name|shot|sample|step|order|index|"
    r"idx|number|num|sequence|n|id|no|t|ms|sec|seconds|pts|dts|elapsed|clock|when)(?:_|$)"
)
"""Words of keys of what counts frames, and of their times."""
_ROUNDED: Final = 0.1
"""By what share steps of times may differ."""


def require_order(document: dict[str, Any], at: PosesAt, *, where: str) -> None:
    """Refuse frames whose order in their list is not that of what seems to count them.

    That are numbers, times and names that all fall, or that have one step once they are sorted.

    Args:
        document: The file as parsed JSON.
        at: Where poses stand; of frames that are in the order of their list.
        where: The file's path, for messages.

    Raises:
        SchemaError: If so; it names the key.
    """
    place = place_at(str(at.rotation))
    axes = [n for n, step in enumerate(place.steps) if isinstance(step, Every | Entries)]
    frames_at = axes[1 if at.outer == "cameras" else 0] + 1
    frames, lengths = leaves_at(document, Place(place.text, place.steps[:frames_at]), where=where)
    counts: dict[str, list[Any]] = {}
    for frame in frames[: lengths[-1]]:
        for key, value in _named_values(frame):
            counts.setdefault(key, []).append(value)
    for key, values in counts.items():
        digits = [re.findall(r"[0-9]+", str(value)) for value in values]
        is_count = _COUNTS.search(words(key.rpartition(".")[2])) and all(digits)
        if not is_count or not 1 < len(values) == lengths[-1]:
            continue
        are_numbers = {*map(type, values)} <= {int, float}
        found = np.array(values if are_numbers else [float("".join(each)) for each in digits])
        given, steps = np.diff(found), np.diff(np.sort(found))
        is_regular = (steps > 0).all() and np.allclose(steps, steps[0], rtol=_ROUNDED)
        if (given < 0).all() or (is_regular and (given < 0).any()):
            first = ", ".join(brief(value) for value in values[:3])
            raise SchemaError(
                f"{where}: its frames are in another order than their {key} says: {first}, ... "
                f"Sort them, or say where their numbers stand: frame below [poses] of conventions"
            )


def _named_values(node: Any, path: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Yield the numbers and texts of a frame, also of an object in it and of its first camera."""
    node = node[0] if type(node) is list and node else node
    for key, value in node.items() if type(node) is dict and depth < _DEEPEST else ():
        if type(value) in (int, float, str):
            yield f"{path}{key}", value
        else:
            yield from _named_values(value, f"{path}{key}.", depth + 1)


def first_frame(document: dict[str, Any], at: PosesAt) -> int | None:
    """Return the least number that frames have, None where they have none."""
    if at.frame is None:
        return None
    return int(_counted(document, at.frame, where="").min())


def _counted(document: dict[str, Any], text: str, *, where: str) -> Int64[np.ndarray, "..."]:
    """Return the numbers of frames or cameras at a place, by its axes."""
    place = place_at(text)
    leaves, lengths = leaves_at(document, place, where=where)
    found = leaves if {*map(type, leaves)} <= {int} else [*map(number_of, leaves)]
    if None in found or max(map(abs, found), default=0) > _LARGEST:
        odd = next(n for n, each in enumerate(found) if each is None or abs(each) > _LARGEST)
        path = path_of(document, place.steps, odd, lengths)
        raise SchemaError(f"{where}: {path}: must be a number or a name with one, found "
                          f"{brief(leaves[odd])}")  # fmt: skip
    return np.array(found, dtype=np.int64).reshape(lengths)


def _order(numbers: np.ndarray, what: str, at: PosesAt, where: str) -> np.ndarray:
    """Return how elements are put in the order of their numbers, which have no gap.

    Cameras count from 0 or 1, frames from what is stated or any number.
    """
    order = np.argsort(numbers, kind="stable")
    ascending = numbers[order]
    step = 1 if what == "cameras" else at.step or 1
    first = ascending[0] if what == "cameras" or at.first is None else at.first
    is_odd = ascending[0] not in (0, 1) if what == "cameras" else ascending[0] < 0
    steps = np.diff(ascending)
    if is_odd or (steps != step).any() or ascending[0] != first:
        repeated = ascending[1:][steps == 0]
        found = f"{repeated[0]} is there twice" if len(repeated) else (
            f"there are {len(numbers)} of {ascending[0]} to {ascending[-1]}"
        )  # fmt: skip
        start = " from 0 or 1" if what == "cameras" else f" from {at.first or '0 or above'}"
        by = f" by {step}" if step > 1 else ""
        raise SchemaError(f"{where}: {what} must be numbered{start}{by} without a gap, and {found}")
    return order


def number_of(value: object) -> int | None:
    """Return the number that a name of a frame or a camera ends in, or is; None for other values.

    >>> number_of("Town_scene_7_Cam_03"), number_of("frame 2"), number_of(4), number_of("left")
    (3, 2, 4, None)
    """
    if isinstance(value, str):
        match = _COUNTING.match(value[-64:])
        return int(match[2]) if match else None
    return int(value) if is_number(value) and float(value).is_integer() else None
