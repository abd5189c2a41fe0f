"""A value of a JSON document together with its path, and the checks that every file shares.

A check that fails notes a problem and returns a stand-in of the right type, so that the rest of
the file is checked too; nothing is returned to a caller once a problem was noted.
"""

import math
import re
from dataclasses import dataclass
from typing import Any, Final, TypeGuard

from stereogenbench_data.schema.problems import Problems, brief, child_path, names
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.schema.spellings import SPELLINGS, UNITS_M, find

_CAMERA_NAME: Final = re.compile(r"[Cc]am(?:era)?_?([0-9]{1,6})\Z")
_LARGEST_INT: Final = 2**53


@dataclass(frozen=True, slots=True)
class Node:
    """One JSON value, its path, and where its problems are gathered."""

    value: Any
    path: str
    problems: Problems

    def child(self, *keys: str | int) -> "Node":
        """Return the element that some keys lead to."""
        value, path = self.value, self.path
        for key in keys:
            value, path = value[key], child_path(path, key)
        return Node(value, path, self.problems)

    def complain(self, complaint: str) -> None:
        """Note a problem with this value."""
        self.problems.add(self.path, complaint)

    def find(self, quantity: str) -> "Node | None":
        """Return a quantity of this object under the first of its spellings that is there."""
        found = find(self.value, quantity)
        return None if found is None else self.child(*found[0])

    def require(self, quantity: str) -> "Node | None":
        """Return a quantity of this object; note what was looked for where there is none."""
        found = self.find(quantity)
        if found is None:
            first, *others = SPELLINGS[quantity]
            spellings = ", ".join(others[:7]) + (", ..." if len(others) > 7 else "")
            also = f" (or, in any case style, {spellings})" if others else ""
            self.complain(f"{first} is missing{also}; the keys here are: {names(self.value)}")
        return found

    def objects(self) -> "list[Node]":
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
        if number <= 0:
            self.complain(f"must be a number above zero, found {brief(self.value)}")
            return 1.0
        return number

    def integer(self) -> int:
        """Return this value as an integer; 3.0 counts as 3."""
        number = as_integer(self.value)
        if number is None:
            self.complain(f"must be an integer, found {brief(self.value)}")
            return 1
        return number

    def text(self) -> str:
        """Return this value as a text that can be written as UTF-8."""
        if not isinstance(self.value, str):
            self.complain(f"must be a text, found {brief(self.value)}")
            return ""
        if any("\ud800" <= letter <= "\udfff" for letter in self.value):
            self.complain(f"holds half a character (a lone surrogate): {brief(self.value)}")
            return ""
        return self.value

    def camera(self) -> int:
        """Return the camera that an index or a name ending in ``Cam_00`` means."""
        index = camera_of(self.value)
        if index is None:
            self.complain(
                f"must name a camera, by an index or by a name such as 'Cam_00', "
                f"found {brief(self.value)}"
            )
            return 0
        if not 0 <= index < CAMERA_COUNT:
            self.complain(
                f"names camera {index}, and the rig's cameras are 0 to {CAMERA_COUNT - 1}"
            )
            return 0
        return index


def is_number(value: object) -> TypeGuard[int | float]:
    """Return whether a JSON value is a finite number (a bool is not)."""
    if type(value) is int:
        return abs(value) < _LARGEST_INT
    return type(value) is float and math.isfinite(value)


def as_integer(value: object) -> int | None:
    """Return a JSON number that is an integer, None where it is something else."""
    if not is_number(value):
        return None
    number = float(value)
    return int(number) if number.is_integer() else None


def camera_of(value: object) -> int | None:
    """Return the number of the camera that an index or a name means, None where it means none.

    >>> camera_of("Town_scene_7_Cam_03"), camera_of("cam2"), camera_of(4), camera_of("left")
    (3, 2, 4, None)
    """
    if isinstance(value, str):
        named = _CAMERA_NAME.search(value)
        return int(named[1]) if named else None
    return as_integer(value)


def axes_of(value: object, styles: tuple[tuple[str, ...], ...]) -> list[Any] | None:
    """Return the components of an object or of a list, None where it has others."""
    if isinstance(value, dict):
        for style in styles:
            if style[0] in value and all(name in value for name in style):
                return [value[name] for name in style]
        return None
    return value if isinstance(value, list) and len(value) == len(styles[0]) else None


def unit_m(root: Node) -> float:
    """Return the metres in the unit that a file names; Unreal's centimetre where it names none."""
    unit = root.find("unit")
    if unit is None:
        return 0.01
    name = unit.value.strip().lower().replace(" ", "_") if isinstance(unit.value, str) else None
    metres = UNITS_M.get(name, UNITS_M.get(name.removesuffix("s"))) if name else None
    if metres is None:
        unit.complain(f"must be a unit of length (cm, m or mm), found {brief(unit.value)}")
        return 0.01
    return metres


def require_six_cameras(root: Node) -> None:
    """Note a problem where a file says that the rig has another number of cameras than six."""
    count = root.find("camera_count")
    if count is not None and count.integer() != CAMERA_COUNT:
        count.complain(f"a rig has {CAMERA_COUNT} cameras, found {brief(count.value)}")
