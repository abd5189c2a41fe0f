"""Where a quantity may stand in a metadata file, and in which unit: one table of names.

The paper prints some keys; those come first. Nobody of this project has seen the others, so a
quantity is found by the words of its key wherever it stands: case, underscores and a unit at the
end (``focalLengthMM``, ``sensor_width (cm)``) do not matter, and the key above may belong to it
(``"sensor": {"width": ...}``). A new spelling is a word more in `NAMES`.
"""

import functools
import json
import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from operator import itemgetter
from types import MappingProxyType
from typing import Any, Final

from stereogenbench_data.schema.document import camera_of, child_path, is_number
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.schema.units import named_unit_m, without_unit, words

NAMES: Final[dict[str, str]] = {
    "focal": "focal_length current_focal_length focal lens_focal_length lens f_mm",
    "focal_px": "focal_length focal fx focal_length_x fl_x",
    "sensor_width": "sensor_width film_width filmback_width sensor_size_x film_back_width "
    "horizontal_aperture horizontal_film_aperture sw_mm sensor_w",
    "sensor_height": "sensor_height film_height filmback_height sensor_size_y "
    "film_back_height vertical_aperture vertical_film_aperture sh_mm sensor_h",
    "fov": "fov hfov fov_x horizontal_fov field_of_view horizontal_field_of_view fov_horizontal "
    "fov_angle angle_of_view angle_x camera_angle_x camera_fov",
    "fov_y": "vfov fov_y vertical_fov vertical_field_of_view fov_vertical angle_y camera_angle_y",
    "focal_y_px": "fy focal_length_y fl_y",
    "image_width": "image_width image_size_x resolution_x resolution_width width_px render_width "
    "frame_width image_size_width camera_intrinsics_width intrinsics_width",
    "image_height": "image_height image_size_y resolution_y resolution_height height_px "
    "render_height frame_height image_size_height camera_intrinsics_height intrinsics_height",
    "frames": "frame_count num_frames n_frames number_of_frames total_frames frames",
    "cameras": "camera_count num_cameras n_cameras number_of_cameras",
    "principal_x": "cx c_x principal_point_x principal_x optical_center_x optical_centre_x",
    "principal_y": "cy c_y principal_point_y principal_y optical_center_y optical_centre_y",
    "sensor_fit": "sensor_fit",
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
}
"""The words of the keys under which a quantity may stand, the likeliest first."""

PAIRS: Final[dict[str, tuple[str, str]]] = {
    **dict.fromkeys(("sensor_size", "sensor"), ("sensor_width", "sensor_height")),
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

LENS_PARAMS: Final = {
    ("pinhole", 4): {"fx": 0, "fy": 1, "cx": 2, "cy": 3},
    ("simple_pinhole", 3): {"fx": 0, "fy": 0, "cx": 1, "cy": 2},
}
"""What stands where in COLMAP's ``params``, by its ``model`` and their number, in pixels."""
_MATRIX_PLACES: Final = {"fx": 0, "fy": 4, "cx": 2, "cy": 5}

_TEXT_NUMBER: Final = re.compile(r"\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*([A-Za-z]*)\s*\Z")
_DEEPEST: Final = 8
_LONGEST: Final = 256
SPEAKS_OF_PAIRS: Final = re.compile(r"pair|baseline")
"""Keys of the baselines of pairs of cameras."""
_MOST_NODES: Final = 20_000
"""How many values of a document are searched: a released one has some hundreds."""


@dataclass(slots=True)
class Stated:
    """A value as it stands in a file.

    Attributes:
        value: The JSON value; of a quantity, a text such as "32.5 mm" is its number.
        unit: The last words of its key, or of the text, that name a unit; "" without one.
        path: Its JSON path.
        plain: The key in words, without the unit; "" in lists.
        name: The key in words, with the unit.
        parent: The nearest key above, in words without a unit.
        holder: The object or list that it stands in.
    """

    value: Any
    unit: str
    path: str
    plain: str = ""
    name: str = ""
    parent: str = ""
    holder: Any = None


def nodes_of(document: Any) -> list[Stated]:
    """Return the values below a document, the outermost first.

    Lists that are long, or whose keys speak of pairs, are not searched.
    """
    waiting = [(Stated(document, "", "$"), 0)]
    for node, depth in waiting:  # which grows
        value = node.value
        if not isinstance(value, dict | list) or depth > _DEEPEST:
            continue
        if isinstance(value, list) and (len(value) > _LONGEST or SPEAKS_OF_PAIRS.search(node.name)):
            continue
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            if len(waiting) > _MOST_NODES:
                break
            name = words(key.rpartition(".")[2]) if isinstance(key, str) else ""
            if name or isinstance(inner, dict | list):
                path, (plain, unit) = child_path(node.path, key), without_unit(name)
                child = Stated(inner, unit, path, plain, name, node.plain or node.parent, value)
                if node.name and isinstance(key, str) and camera_of(key) is not None:
                    child = replace(node, value=inner, path=path)  # one camera's share
                waiting.append((child, depth + 1))
    return [node for node, _ in waiting if node.name and node.value is not None]


class Values:
    """The values below a document, by the quantities that their keys may name.

    Attributes:
        nodes: All of them.
    """

    def __init__(
        self,
        document: Any,
        *,
        known: Mapping[str, Stated] = MappingProxyType({}),
        ignored: Collection[str] = (),
    ) -> None:
        """Find them.

        Args:
            document: The document.
            known: Values that conventions state. They come first, and know the unit of a key that
                names none.
            ignored: The JSON paths of what does not count.
        """
        self.nodes = [each for each in nodes_of(document) if not is_below(each.path, ignored)]
        ranked: dict[str, list[tuple[int, Stated]]] = defaultdict(list)
        for node in self.nodes:
            for quantity, rank in _quantities(node.plain, node.parent, node.name):
                ranked[quantity].append((rank, as_stated(node)))
            for quantity, rank, stated in _parts(node):
                ranked[quantity].append((rank, stated))
        self._stated = {
            quantity: [each for _, each in sorted(found, key=itemgetter(0))]
            for quantity, found in ranked.items()
        }
        for quantity, first in known.items():
            others = (
                each for each in self.stated(quantity) if each.unit or each.path != first.path
            )
            self._stated[quantity] = [first, *others]

    def stated(self, quantity: str) -> list[Stated]:
        """Return the values of a quantity, the likeliest name and the outermost first."""
        return self._stated.get(quantity, [])

    def numbers(self, quantity: str) -> list[Stated]:
        """Return the finite numbers that are stated for a quantity."""
        return [each for each in self.stated(quantity) if is_number(each.value)]

    def positive(self, quantity: str) -> list[Stated]:
        """Return the numbers above zero that are stated for a quantity."""
        return [each for each in self.numbers(quantity) if each.value > 0]

    @property
    def length_unit_m(self) -> float | None:
        """The metres in the unit that the document names for its lengths, None without one."""
        named = (each.value for each in self.stated("unit") if isinstance(each.value, str))
        known = map(named_unit_m, named)
        return next((unit_m for unit_m in known if unit_m is not None), None)


@functools.lru_cache(maxsize=4096)
def _quantities(plain: str, parent: str, name: str) -> list[tuple[str, int]]:
    """Return the quantities that a key may name, and which of their names it is."""
    found = []
    for quantity, listed in NAMES.items():
        known = listed.split()
        ranks = [known.index(key) for key in (plain, f"{parent}_{plain}", name) if key in known]
        found += [(quantity, ranks[0])] if ranks else []
    return found


def _parts(node: Stated) -> Iterator[tuple[str, int, Stated]]:
    """Yield the quantities in a list of two numbers or in a camera matrix, with their ranks."""
    value = node.value
    if node.plain in PAIRS and not isinstance(value, dict):
        for at, quantity in enumerate(PAIRS[node.plain]):
            is_pair = isinstance(value, list) and len(value) == len(PAIRS[node.plain])
            yield (
                quantity,
                0,
                (Stated(value[at], node.unit, child_path(node.path, at)) if is_pair else node),
            )
    places: dict[str, int] = {}
    if node.plain in MATRICES:
        value = value.get("data") if isinstance(value, dict) else value  # as OpenCV writes it
        if isinstance(value, list) and len(value) in (3, 4):
            rows = [row[:3] for row in value[:3] if isinstance(row, list)]
            value = [number for row in rows for number in row]
        if isinstance(value, list) and len(value) == 9 and value[8] == 1 and not value[1]:
            places = _MATRIX_PLACES  # whose pixels are not skewed
    elif node.plain == "params" and isinstance(value, list):
        models = (str(each) for key, each in node.holder.items() if "model" in key)
        places = LENS_PARAMS.get((words(next(models, "")), len(value)), {})
    for name, at in places.items():
        for quantity, rank in _quantities(name, "", name):
            yield quantity, rank, Stated(value[at], "px", node.path)


_STEP: Final = re.compile(r'\.([^.\[]+)|\[([0-9]{1,9})\]|\[("(?:[^"\\]|\\.)*")\]')


def steps_of(path: str) -> list[str | int]:
    """Return the keys and places on the way to what stands at a JSON path.

    Raises:
        LookupError: If it is not written as `child_path` does.

    >>> steps_of('$.a[0]["b c"]')
    ['a', 0, 'b c']
    """
    steps = [*_STEP.finditer(path)]
    if "$" + "".join(step[0] for step in steps) != path:
        raise LookupError(path)
    try:
        return [int(number) if number else json.loads(quoted) if quoted else plain
                for plain, number, quoted in (step.groups() for step in steps)]  # fmt: skip
    except json.JSONDecodeError as error:  # an escape that JSON does not have
        raise LookupError(path) from error


def value_at(document: Any, path: str) -> Any:
    """Return the value at a JSON path as `child_path` writes it.

    Raises:
        LookupError: If there is none.

    >>> value_at({"a": [{"b c": 7}]}, '$.a[0]["b c"]')
    7
    """
    for key in steps_of(path):
        is_there = isinstance(document, list if isinstance(key, int) else dict)
        if not is_there:
            raise LookupError(path)
        document = document[key]
    return document


def is_below(path: str, places: Collection[str]) -> bool:
    """Return whether a JSON path is one of some places, or below one."""
    return any(path == each or path.startswith((f"{each}.", f"{each}[")) for each in places)


def as_stated(found: Stated) -> Stated:
    """Return a value with its unit, which may be in it: "32 mm", [32, "mm"], {"value", "unit"}."""
    value, unit = found.value, found.unit
    if type(value) is float or type(value) is int:
        return found
    if isinstance(value, dict) and isinstance(value.get("unit"), str) and "value" in value:
        value, unit = value["value"], words(value["unit"])
    if isinstance(value, list) and [*map(type, value)] in ([float, str], [int, str]):
        value, unit = value[0], words(value[1])
    if isinstance(value, list) and len(value) >= CAMERA_COUNT and is_number(value[0]):
        value = value[0] if value.count(value[0]) == len(value) else value
    text = _TEXT_NUMBER.match(value) if isinstance(value, str) else None
    if text is not None and (text[2] or unit):
        with suppress(ValueError):
            value, unit = float(text[1]), text[2].lower() or unit
    return replace(found, value=value, unit=unit)
