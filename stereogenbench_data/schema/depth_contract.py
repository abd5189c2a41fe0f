"""What files say of how stored depth becomes metres, in tags and JSON, and whether it agrees.

A unit of depth is a number, or a word for a unit, under a key that speaks of a scale or a unit:
``DEPTH_SCALE=0.001``, ``depth_unit: "mm"``, ``units_per_meter=1000``, ``scale=0.001 m per unit``.
Sentences, formulas and ranges are not read. A tag that speaks of a scale or a unit and is not
understood, and what says that stored numbers are no plain depth, is a problem with its place: then
a file of conventions says what holds, below ``[depth]``.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.document import child_path
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.schema.text import shortened
from stereogenbench_data.schema.trajectory import number_of
from stereogenbench_data.schema.units import UNITS_M, words

Origin = Literal["tag", "metadata"]

LEAST_UNIT_M: Final = 1e-5
LARGEST_UNIT_M: Final = 1.0
"""Units of depth that can be: 16 bits of finer ones end at 0.7 m, coarser ones show no stereo."""
_SMALL_M: Final = 0.2
"""What is no larger under a key of depth may be a unit of it."""
_SAME: Final = 0.005
"""By what share two statements may differ: either may be rounded."""
_MOST_SHOWN: Final = 4
_DEEPEST: Final = 8
_MOST_NODES: Final = 20_000
"""How many values of a document are looked at: a released one has some hundreds."""

_SCALES: Final = frozenset(
    {"scale", "scales", "zscale", "scaling", "factor", "unit", "units", "quantum", "lsb",
     "conversion", "gain", "coefficient", "multiplier", "divisor", "precision", "step",
     "quantization", "quantisation", "formula", "equation"}
)  # fmt: skip
"""Words of keys under which a unit of depth stands."""
_RANGES: Final = frozenset(
    {"near", "far", "znear", "zfar", "min", "max", "minimum", "maximum", "zmin", "zmax", "range",
     "limits", "bounds"}
)  # fmt: skip
"""Words of keys of the ends of a range."""
_OFFSETS: Final = frozenset({"offset", "bias", "shift"})
"""Words of keys of the depth of the stored number 0."""
_OTHER_MEANING: Final = re.compile(
    r"(?<![a-z])(?:inv(?:erse[d]?)?|disparit\w+|log(?:arithm\w*)?|non_?linear|gamma|sqrt|radial|"
    r"euclid\w*|reversed?|device|perspective|rays?(?!_trac|_cast|_march)|spherical|"
    r"(?<![0-9_])1_(?:z|depth)|reciprocal|hyperbol\w*|exponential|ndc|colou?r_?map|turbo|float_?16|"
    r"normali[sz]\w*|distance_to_cam\w*|range_image|slant_range|(?:kind|type|encoding) "
    r"(?:range|distance))(?![a-z])"
)
"""Words of a depth that is no length along the optical axis, or not the stored number times one."""
_DEPTHS: Final = frozenset({"depth", "depthmap", "zbuffer", "zdepth"})
_NAMES_DEPTH: Final = re.compile(r"(?:.*[/_])?depth(?:map|\.[a-z0-9]+)?")
"""What an object names, such as the file cam_00_depth.mkv, if its scale and unit are of depth."""
_OTHER_DEPTHS: Final = re.compile(r"depth_of_field|(?:bit|colou?r)_depth|(?:^|_)dof(?:_|$)")
_TECHNICAL: Final = frozenset(
    {"encoder", "duration", "creation", "handler", "vendor", "language", "brand", "brands",
     "statistics", "bps", "timecode", "software", "mimetype", "time", "rgb", "color", "colour"}
)  # fmt: skip
"""Words of keys of tags that are not about depth."""
_STATISTICS: Final = frozenset(
    {"stat", "stats", "statistics", "valid", "observed", "mean", "median", "std", "percentile",
     "ratio", "share", "percent", "histogram", "coverage"}
)  # fmt: skip
_OF_STORED: Final = re.compile(r"depth|stored|value|uint|pixel|raw|\bz\b|\bv\b|=|unit|scale|factor")
_SPEAKS_OF_SCALE: Final = re.compile(
    r"scal(?:e|ed|ing)\b|\bunits?\b|\bfactor|multipl|divid|\bper\b"
)
_NUMBER: Final = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?"
_VALUE: Final = re.compile(rf"(?P<number>{_NUMBER})?\s*(?P<rest>[a-z _/]*)")
_BESIDE: Final = re.compile(
    r"(?:/|per|each)? *(?:(?:stored|depth|pixel|raw)[ _])?"
    r"(?:units?|counts?|values?|pixels?|lsb|levels?|steps?|ticks?)?"
)
_LONGEST: Final = 200
"""Longer texts are sentences, which nobody reads."""


@dataclass(frozen=True, slots=True)
class Statement:
    """One thing that a file says about the unit of its depth.

    Attributes:
        values: Metres in a stored unit, one for each possible reading; () where it is not
            understood.
        place: The file and the key.
        text: What stands there.
        origin: A tag of the video, or JSON of the scene.
        is_word: Whether it is a word for a unit, without a number.
        is_bare: Whether no unit stands beside the number.
        problem: Why depth is refused because of it; "" where it is a unit.
    """

    values: tuple[float, ...]
    place: str
    text: str
    origin: Origin
    is_word: bool = False
    is_bare: bool = False
    problem: str = ""

    def __str__(self) -> str:
        """Return place and text."""
        return f"{self.place} {self.text}"


def stated_in_tags(tags: Mapping[str, str], *, name: str) -> list[Statement]:
    """Return what the tags of a depth video say of its unit."""
    found: list[Statement] = []
    ranges: list[Statement] = []
    for key, value in sorted(tags.items()):
        parts = _key_words(key).split("_")
        place, text = f"{name}: tag {shortened(key)} =", str(value).strip()
        if not _TECHNICAL.isdisjoint(parts):
            continue
        if not _RANGES.isdisjoint(parts) and re.search(r"\d", text):
            ranges.append(_refused(place, text, "tag", MAY_BE_RANGE))
            continue
        statement = _stated("_".join(parts), text, place, "tag")
        found += [] if statement is None else [statement]
    # Beside a scale the ends of a range are figures of the scene.
    return found if any(each.values for each in found) else [*found, *ranges]


def _key_words(key: str) -> str:
    """Return a tag's key in snake_case; Matroska keeps capitals only: DEPTHSCALEMM."""
    name = words(key.removeprefix("stream."))
    return "_".join(_JOINED.findall(name)) if _ONLY_JOINED.fullmatch(name) else name


_JOINED: Final = re.compile(
    r"depth|scale|factor|units?|millimet(?:er|re)s?|centimet(?:er|re)s?|met(?:er|re)s?|mm|cm|"
    r"per|to|near|far|min(?:imum)?|max(?:imum)?|range|offset|normali[sz]ed|m"
)
_ONLY_JOINED: Final = re.compile(rf"(?:{_JOINED.pattern})+")


def stated_in_json(
    document: dict[str, Any], *, name: str, about: str = "", is_prose: bool = False
) -> list[Statement]:
    """Return what a metadata file says of the unit of depth under keys that name depth.

    Args:
        document: The file as parsed JSON.
        name: Its path, for messages.
        about: The name of a file that is itself about depth: its keys need not name it.
        is_prose: Whether it describes a scene: then texts count only below keys of a scale, as
            whatever stands in a list.
    """
    found: list[Statement] = []
    for path, key, value, owner in _nodes_of(document):
        place = words(f"{about} {path} {owner}")
        parts = words(key).split("_")
        if _DEPTHS.isdisjoint(place.split("_")) or _OTHER_DEPTHS.search(place):
            continue
        if not ({*place.split("_")}.isdisjoint(_STATISTICS) and _RANGES.isdisjoint(parts)):
            continue
        is_scale = not _SCALES.isdisjoint(parts) or _ratio(words(key)) is not None
        if not is_scale and (is_prose or "[" in path):
            continue
        text = value.strip() if isinstance(value, str) else json.dumps(value)
        statement = _stated(words(key), text, f"{name}: {path} is", "metadata")
        if statement is not None:
            found.append(statement)
    return found


def _nodes_of(document: dict[str, Any]) -> Iterator[tuple[str, str, Any, str]]:
    """Yield path, key and value of each text and number, and what the object says that it is of."""
    waiting: list[tuple[str, str, Any, int, str]] = [("$", "", document, 0, "")]
    for path, key, node, depth, owner in waiting:  # which grows
        is_open = depth < _DEEPEST and len(waiting) < _MOST_NODES
        if isinstance(node, list) and is_open:
            waiting += [(f"{path}[{at}]", key, each, depth + 1, owner)
                        for at, each in enumerate(node)]  # fmt: skip
        elif isinstance(node, dict) and is_open:
            is_of_cameras = {*map(number_of, node)} == {*range(CAMERA_COUNT)}
            texts = (each for each in node.values() if isinstance(each, str) and depth > 0)
            of_depth = any(_NAMES_DEPTH.fullmatch(each.lower()) for each in texts)
            owner = "depth" if of_depth else owner
            waiting += [
                (child_path(path, each), key if is_of_cameras or each == "value" else each,
                 node[each], depth + 1, owner)
                for each in node
            ]  # fmt: skip
        elif isinstance(node, str | int | float):
            yield path, key, node, owner


def _refused(place: str, text: str, origin: Origin, why: str) -> Statement:
    return Statement((), place, shortened(repr(text)), origin, problem=why)


def _stated(key: str, text: str, place: str, origin: Origin) -> Statement | None:
    """Return what stands under a key, in snake_case; None where it says nothing of the unit."""
    parts, low = key.split("_"), text.lower()
    if not _OFFSETS.isdisjoint(parts) and re.search(r"\d", text):
        is_zero = re.search(r"[1-9]", text) is None
        return None if is_zero else _refused(place, text, origin, MAY_BE_RANGE)
    is_scale = not _SCALES.isdisjoint(parts) or _ratio(key) is not None
    if low in ("false", "no", "0") and not {"planar", "linear"}.isdisjoint(parts):
        return _refused(place, text, origin, NO_LENGTH)
    if low in ("false", "no", "none", "null", "") and not (low == "" and is_scale):
        return None
    has_other = _OTHER_MEANING.search(f"{key} {words(text)}" if len(text) < _LONGEST else key)
    if has_other:
        return _refused(place, text, origin, NO_LENGTH)
    if is_scale:
        found = _unit(key, low, place, text, origin) if len(low) < _LONGEST else None
        return found or _refused(place, text, origin, NOT_UNDERSTOOD)
    named = {*re.findall("[a-z]+", low)} & UNITS_M.keys()
    of_scale = _SPEAKS_OF_SCALE.search(low)
    is_of_unit = bool(named and of_scale) or (
        bool(named or of_scale) and _OF_STORED.search(f"{key} {low}") is not None
    )
    is_of_unit = is_of_unit or low in UNITS_M
    if re.fullmatch(_NUMBER, low):  # DEPTH_MM=1, DEPTH_FOO=0.001, depth_foo_m: 0.001
        is_small = 0 < abs(float(low)) * UNITS_M.get(parts[-1], 1.0) <= _SMALL_M
        of_length = parts[-1] in UNITS_M
        is_of_unit = is_small and of_length if origin == "metadata" else (
            "depth" in parts and (is_small or of_length)
        )  # fmt: skip
    return _refused(place, text, origin, NOT_UNDERSTOOD) if is_of_unit else None


NO_LENGTH: Final = "is no plain length along the optical axis"
MAY_BE_RANGE: Final = "may be the range that stored numbers fill"
NOT_UNDERSTOOD: Final = (
    f"does not tell the unit as a number of metres from {LEAST_UNIT_M:g} to {LARGEST_UNIT_M:g}"
)
UNREAD: Final = (NO_LENGTH, MAY_BE_RANGE, NOT_UNDERSTOOD)
"""Why a statement is not read, other than that it contradicts another."""


def _unit(key: str, low: str, place: str, text: str, origin: Origin) -> Statement | None:
    """Return the unit that a number or a word under a key of a scale is; None if it is none."""
    match = _VALUE.fullmatch(low)
    if match is None:
        return None
    rest = match["rest"].strip()
    word = re.match(r"[a-z]+", rest)
    named = word[0] if word is not None and word[0] in UNITS_M else ""
    if not _BESIDE.fullmatch(rest.removeprefix(named).strip()):
        return None
    shown = shortened(repr(text))
    if match["number"] is None:
        return Statement((UNITS_M[named],), place, shown, origin, is_word=True) if named else None
    number, ratio, last = float(match["number"]), _ratio(key), key.split("_")[-1]
    unit_m = UNITS_M.get(named) or (UNITS_M.get(last) if "_" in key else None)
    if ratio is not None:
        is_inverse, of_m = ratio
        readings = [of_m / number] if is_inverse and number > 0 else [number * of_m]
    else:
        readings = [number * (unit_m or 1.0)]
        if unit_m is None and number > 1 and number.is_integer():
            readings.append(1.0 / number)  # stored units in a metre
    possible = tuple(each for each in readings if LEAST_UNIT_M <= each <= LARGEST_UNIT_M)
    is_bare = unit_m is None and ratio is None
    return Statement(possible, place, shown, origin, is_bare=is_bare) if possible else None


def _ratio(key: str) -> tuple[bool, float] | None:
    """Return whether a key counts units in a length instead of lengths in a unit, and that in m.

    >>> _ratio("units_per_meter"), _ratio("mm_per_lsb"), _ratio("depth_to_m"), _ratio("scale")
    ((True, 1.0), (False, 0.001), (False, 1.0), None)
    """
    for link in ("per", "to"):
        over, found, under = key.rpartition(f"_{link}_")
        above, below = UNITS_M.get(over.rpartition("_")[2]), UNITS_M.get(under)
        if found and (above is None) != (below is None):
            is_per = link == "per"
            return (is_per == (above is None), above or below or 1.0)
    return None


def agreed(statements: Sequence[Statement]) -> tuple[float, Origin] | None:
    """Return the metres in a stored unit that all statements give, and where it stands.

    None where nothing is stated.

    Raises:
        SchemaError: If they contradict each other, or do not tell the unit although they are about
            it; it names their places.
    """
    for each in statements:
        if each.problem:
            _refuse(each.problem, [other for other in statements if other.problem == each.problem])
    # A word for metres names what numbers become; beside the number 1, a word names the unit.
    told = [each for each in statements if each.is_word and each.values[0] != 1]
    numbers = [each for each in statements if not each.is_word
               and not (told and each.is_bare and each.values == (1.0,))]  # fmt: skip
    everything = [*numbers, *told]
    if not everything:
        _refuse("does not tell how many metres a stored unit has", statements)
        return None
    if all(each.is_bare and each.values == (1.0,) for each in everything):
        _refuse("may mean a metre, or that stored numbers are not scaled", everything)
    for unit_m in min(everything, key=lambda each: len(each.values)).values:
        if all(any(abs(value - unit_m) <= _SAME * unit_m for value in each.values)
               for each in everything):  # fmt: skip
            is_tagged = any(each.origin == "tag" for each in everything)
            return unit_m, "tag" if is_tagged else "metadata"
    one_of_each = {each.values: each for each in reversed(everything)}
    _refuse("contradict each other", [*one_of_each.values()][::-1])
    return None


def _refuse(why: str, statements: Sequence[Statement]) -> None:
    if statements:
        listed = ", ".join(dict.fromkeys(str(each) for each in statements[:_MOST_SHOWN]))
        raise SchemaError(f"{listed}: {why}")
