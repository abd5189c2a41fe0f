"""Units of length and of angles, and the words of keys: what names in files and tags consist of."""

import functools
import re
from typing import Final

UNITS_M: Final = {
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 1e-3),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 1e-2),
    **dict.fromkeys(("dm", "decimeter", "decimeters", "decimetre", "decimetres"), 1e-1),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("uu", "unreal_unit", "unreal_units"), 1e-2),
    **dict.fromkeys(("inch", "inches"), 0.0254),
    **dict.fromkeys(("ft", "foot", "feet"), 0.3048),
}
"""Metres in a unit of length; a unit of Unreal is a centimetre."""

PIXELS: Final = ("px", "pixel", "pixels")
ANGLES: Final = ("deg", "degree", "degrees", "rad", "radian", "radians")


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

    >>> without_unit("location_cm"), without_unit("roll_deg"), without_unit("m")
    (('location', 'cm'), ('roll', 'deg'), ('m', ''))
    """
    head, _, last = name.rpartition("_")
    last = "inch" if last == "in" else last
    if head and (last in UNITS_M or last in (*PIXELS, *ANGLES)):
        return head.removesuffix("_in"), last
    return name, ""


def named_unit_m(text: str) -> float | None:
    """Return the metres in the unit that a text begins with, or in the only one that it names.

    >>> named_unit_m("cm, as in Unreal"), named_unit_m("Unreal units (1 uu = 1 cm)")
    (0.01, 0.01)
    """
    named = words(text).split("_")
    found = {UNITS_M[name] for name in (words(text), *named) if name in UNITS_M}
    return UNITS_M.get(named[0], found.pop() if len(found) == 1 else None)
