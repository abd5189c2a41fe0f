"""Where a quantity may stand in a metadata file, and in which unit: one table of names.

The paper prints some keys; those come first. Nobody of this project has seen the others, so a
quantity is found by the words of its key wherever it stands: case, underscores and a unit at the
end (``focalLengthMM``, ``sensor_width (cm)``) do not matter, and the key above may belong to it
(``"sensor": {"width": ...}``). A new spelling is a word more in `NAMES`.
"""

import functools
import json
import math
import re
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from typing import Any, Final

from stereogenbench_data.schema.document import child_path, is_number
from stereogenbench_data.schema.release import CAMERA_COUNT

NAMES: Final[dict[str, str]] = {
    "focal": "focal_length current_focal_length focal lens_focal_length lens f_mm",
    "focal_px": "focal_length focal fx focal_length_x fl_x",
    "sensor_width": "sensor_width film_width filmback_width sensor_size_x film_back_width "
    "horizontal_aperture horizontal_film_aperture",
    "sensor_height": "sensor_height film_height filmback_height sensor_size_y "
    "film_back_height vertical_aperture vertical_film_aperture",
    "fov": "fov hfov fov_x horizontal_fov field_of_view horizontal_field_of_view fov_horizontal "
    "fov_angle angle_of_view angle_x camera_angle_x",
    "fov_y": "vfov fov_y vertical_fov vertical_field_of_view fov_vertical angle_y camera_angle_y",
    "focal_y_px": "fy focal_length_y fl_y",
    "image_width": "image_width image_size_x resolution_x resolution_width width_px render_width "
    "frame_width image_size_width",
    "image_height": "image_height image_size_y resolution_y resolution_height height_px "
    "render_height frame_height image_size_height",
    "principal_x": "cx c_x principal_point_x principal_x optical_center_x optical_centre_x",
    "principal_y": "cy c_y principal_point_y principal_y optical_center_y optical_centre_y",
    "unit": "unit units length_unit unit_of_length world_unit location_unit position_unit "
    "translation_unit units_of_length",
    "primary_pair": "primary_stereo_pair primary_pair stereo_pair primary",
    "scene_label": "scene_label label scene_name",
    "scene_index": "scene_index scene_number scene_id",
    "map_name": "map_name map level_name level",
    "map_path": "map_path level_path",
    "character": "character_mesh character_id character character_name",
    "animation": "animation animation_name anim",
    "aperture_fstop": "aperture_fstop f_stop fstop aperture current_aperture",
    "short_caption": "short_caption caption summary short_description",
    "detailed_caption": "detailed_caption long_caption description detailed_description "
    "dense_caption",
    "scene_type": "scene_type",
    "setting": "setting",
    "tags": "tags keywords",
}
"""The words of the keys under which a quantity may stand, the likeliest first."""

PAIRS: Final[dict[str, tuple[str, str]]] = {
    "sensor_size": ("sensor_width", "sensor_height"),
    "filmback": ("sensor_width", "sensor_height"),
    "image_size": ("image_width", "image_height"),
    "image_resolution": ("image_width", "image_height"),
    "resolution": ("image_width", "image_height"),
    "principal_point": ("principal_x", "principal_y"),
    "optical_center": ("principal_x", "principal_y"),
    "optical_centre": ("principal_x", "principal_y"),
}
"""Keys of lists of two numbers, and what these are."""

MATRICES: Final = frozenset({"k", "camera_matrix", "intrinsic_matrix", "intrinsics_matrix",
                             "intrinsics", "camera_intrinsics"})  # fmt: skip
"""Keys of a camera matrix, in pixels: 3 rows of 3 numbers, or 9 numbers."""

UNITS_M: Final = {
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 1e-3),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 1e-2),
    **dict.fromkeys(("dm", "decimeter", "decimeters", "decimetre", "decimetres"), 1e-1),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("uu", "unreal_unit", "unreal_units"), 1e-2),
}
"""Metres in a unit of length; a unit of Unreal is a centimetre."""

OTHER_UNITS: Final = frozenset({"px", "pixel", "pixels", "deg", "degree", "degrees", "rad",
                                "radian", "radians"})  # fmt: skip
"""Units of what is no length."""
_TEXT_NUMBER: Final = re.compile(r"\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*([A-Za-z]*)\s*\Z")
_DEEPEST: Final = 8
_LONGEST: Final = 256
_MOST_NODES: Final = 20_000
"""How many values of a document are searched: a released one has some hundreds."""


@dataclass(frozen=True, slots=True)
class Stated:
    """A value as it stands in a file.

    Attributes:
        value: The JSON value; a text such as "32.5 mm" is its number.
        unit: The last words of its key, or of the text, that name a unit; "" without one.
        path: Its JSON path.
    """

    value: Any
    unit: str
    path: str

    @property
    def rounding(self) -> float:
        """Half of the last digit that is written, for numbers."""
        return rounding_of(self.value)


def rounding_of(value: float) -> float:
    """Return half of the last digit of a number as JSON writes it, at least a float32's rounding.

    >>> rounding_of(6.35), rounding_of(7)
    (0.005, 0.5)
    """
    try:
        exponent = Decimal(repr(value)).as_tuple().exponent
    except InvalidOperation:
        return 0.0
    half = 0.5 * 10.0**exponent if isinstance(exponent, int) else 0.0
    return max(half, abs(value) * 2**-23)


@functools.lru_cache(maxsize=4096)  # thousands of files have the same keys
def words(key: str) -> str:
    """Return a key in snake_case.

    >>> words("focalLengthMM"), words("Sensor Width (mm)"), words("Cam-00")
    ('focal_length_mm', 'sensor_width_mm', 'cam_00')
    """
    parted = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", key)
    return re.sub(r"[^a-z0-9]+", "_", parted.lower()).strip("_")


@functools.lru_cache(maxsize=4096)
def without_unit(name: str) -> tuple[str, str]:
    """Return a name in snake_case without the unit at its end, and the unit or "".

    >>> without_unit("sensor_width_mm"), without_unit("roll_deg"), without_unit("m")
    (('sensor_width', 'mm'), ('roll', 'deg'), ('m', ''))
    """
    head, _, last = name.rpartition("_")
    if head and (last in UNITS_M or last in OTHER_UNITS):
        return head.removesuffix("_in"), last
    return name, ""


@dataclass(frozen=True, slots=True)
class Node:
    """A value below a document: its key in words, without and with the unit, and its place.

    ``means`` is the quantity that conventions say it is, "" where only its name says it.
    """

    plain: str
    unit: str
    name: str
    parent: str
    value: Any
    path: str
    means: str = ""


def nodes_of(document: dict[str, Any]) -> list[Node]:
    """Return the values below a document, the outermost first; long lists are not searched."""
    found: list[Node] = []
    waiting: list[tuple[Any, str, str, int]] = [(document, "", "$", 0)]
    for node, parent, path, depth in waiting:
        for key, value in node.items() if isinstance(node, dict) else enumerate(node):
            if len(found) >= _MOST_NODES:
                return found
            name = words(key) if isinstance(key, str) else ""
            plain, unit = without_unit(name)
            place = child_path(path, key)
            if name and value is not None:
                found.append(Node(plain, unit, name, parent, value, place))
                found += _of_matrix(value, place) if plain in MATRICES else []
            is_long = isinstance(value, list) and len(value) > _LONGEST
            if isinstance(value, dict | list) and depth < _DEEPEST and not is_long:
                waiting.append((value, plain or parent, place, depth + 1))
    return found


def _of_matrix(value: Any, path: str) -> list[Node]:
    """Return the focal lengths and the principal point in a camera matrix, if it is one."""
    if isinstance(value, list) and len(value) == 3 and all(isinstance(v, list) for v in value):
        value = [number for row in value for number in row]
    if not isinstance(value, list) or len(value) != 9 or value[8] != 1:
        return []
    places = {"fx": 0, "fy": 4, "cx": 2, "cy": 5}
    return [Node(name, "px", name, "", value[at], path) for name, at in places.items()]


_STEP: Final = re.compile(r'\.([A-Za-z_][A-Za-z0-9_]*)|\[([0-9]{1,6})\]|\[("(?:[^"\\]|\\.)*")\]')


def value_at(document: Any, path: str) -> Any:
    """Return the value at a JSON path as `child_path` writes it.

    Raises:
        LookupError: If there is none.

    >>> value_at({"a": [{"b c": 7}]}, '$.a[0]["b c"]')
    7
    """
    node, at = document, 1
    while at < len(path):
        step = _STEP.match(path, at)
        if step is None:
            raise LookupError(path)
        plain, number, quoted = step.groups()
        key: Any = int(number) if number else json.loads(quoted) if quoted else plain
        is_there = key < len(node) if number and isinstance(node, list) else (
            isinstance(node, dict) and key in node
        )  # fmt: skip
        if not is_there:
            raise LookupError(path)
        node, at = node[key], step.end()
    return node


def stated(nodes: list[Node], quantity: str) -> list[Stated]:
    """Return the values of a quantity in a document, the likeliest name and the outermost first.

    What conventions state comes first, and they know the unit of a key that names none.
    """
    names = NAMES[quantity].split()
    known = {node.path for node in nodes if node.means == quantity}
    found: list[tuple[int, Stated]] = []
    for node in nodes:
        if node.means:
            if node.means == quantity:
                found.append((-1, as_stated(node.value, node.unit, node.path)))
            continue
        for key in (node.plain, f"{node.parent}_{node.plain}", node.name):
            if key in names:
                found.append((names.index(key), as_stated(node.value, node.unit, node.path)))
                break
        if quantity in PAIRS.get(node.plain, ()) and not isinstance(node.value, dict):
            at, value, path = PAIRS[node.plain].index(quantity), node.value, node.path
            if isinstance(value, list) and len(value) == 2:
                value, path = value[at], child_path(path, at)
            found.append((0, Stated(value, node.unit, path)))
    return [
        each
        for rank, each in sorted(found, key=lambda each: each[0])
        if rank < 0 or each.unit or each.path not in known
    ]


def numbers(nodes: list[Node], quantity: str) -> list[Stated]:
    """Return the finite numbers that a document states for a quantity."""
    return [each for each in stated(nodes, quantity) if is_number(each.value)]


def length_unit_m(nodes: list[Node]) -> float | None:
    """Return the metres in the unit that a document names for its lengths, None without one."""
    for each in stated(nodes, "unit"):
        if isinstance(each.value, str):
            unit = UNITS_M.get(words(each.value))
            if unit is not None:
                return unit
    return None


def as_stated(value: Any, unit: str, path: str) -> Stated:
    """Return a value with its unit, which may stand in it: "32.5 mm", or {"value", "unit"}."""
    if isinstance(value, dict) and isinstance(value.get("unit"), str) and "value" in value:
        value, unit = value["value"], words(value["unit"])
    if isinstance(value, list) and len(value) == CAMERA_COUNT and is_number(value[0]):
        value = value[0] if value.count(value[0]) == CAMERA_COUNT else value
    text = _TEXT_NUMBER.match(value) if isinstance(value, str) else None
    if text is not None:
        try:
            number = float(text[1])
        except ValueError:
            return Stated(value, unit, path)
        if math.isfinite(number) and (text[2].lower() or unit):
            return Stated(number, text[2].lower() or unit, path)
    return Stated(value, unit, path)
