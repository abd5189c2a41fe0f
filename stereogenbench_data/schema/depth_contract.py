"""What files say of how stored depth becomes metres, in tags and JSON, and whether it agrees.

Nobody of this project has seen a released depth video. So a scale is found by the words of its key
(`DEPTH_SCALE`, `meters_per_unit`, `units_per_meter`, `depth_unit_mm`), of its value ("0.001 m",
"mm", "1/1000"), or of a sentence ("stored = metres * 1000"). A number may be metres in a unit or
units in a metre: the name tells, and where it does not, a unit that cannot be rules one out.
Nothing is guessed: what is not understood, and what contradicts itself, is a problem with its
places.
"""

import json
import math
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final, Literal

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.document import is_number
from stereogenbench_data.schema.quantities import nodes_of
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.schema.text import shortened
from stereogenbench_data.schema.units import UNITS_M, words

About = Literal[
    "unit", "length unit", "near", "far", "offset", "normalised", "other meaning", "unclear"
]
Origin = Literal["tag", "metadata"]

LEAST_UNIT_M: Final = 1e-5
LARGEST_UNIT_M: Final = 1.0
"""Units of depth that can be: 16 bits of finer ones end at 0.7 m, coarser ones show no stereo."""
_LEAST_FAR_M: Final = 3.0
_LARGEST_FAR_M: Final = 10_000.0
"""Where the far end of a range of depth can be; it tells metres from cm where no unit stands."""
_SAME: Final = 0.005
"""Two statements agree within the rounding of either, which is at most this share."""
_EXACT: Final = 1e-4
"""A unit that is stated beside a range which does not begin at 0 must be that of the range."""
_MOST_SHOWN: Final = 4

_U: Final = "|".join(sorted((name.replace("_", "[ _]") for name in UNITS_M), key=len, reverse=True))
_THING: Final = (
    "(?:stored |depth |pixel |raw )?(?:units?|counts?|values?|pixels?|px|lsb|levels?|steps?|ticks?|"
    "numbers?|integers?|dn|stored|raw)"
)
_NUMBER: Final = r"\d+(?:[.,]\d+)?(?:e[-+]?\d+)?|\.\d+"
_RATIO: Final = rf"(?:(?:{_NUMBER})\s*[/:]\s*)?(?:{_NUMBER})"
_TEXT_NUMBER: Final = re.compile(rf"\s*([-+]?{_RATIO})\s*(.*)", re.DOTALL)
_PER: Final = r"\s*(?:/|per|an?|each|=|\bto an?\b|in an?)\s*(?:1\s*|one\s*|each\s*)?"

_SCALES: Final = frozenset(
    {"scale", "scales", "zscale", "scaling", "factor", "unit", "units", "quantum", "lsb",
     "conversion"}
)  # fmt: skip
_LENGTHS: Final[dict[About, frozenset[str]]] = {
    "far": frozenset({"far", "zfar", "max", "maximum", "zmax"}),
    "near": frozenset({"near", "znear", "min", "minimum", "zmin"}),
    "offset": frozenset({"offset", "bias", "shift"}),
}
_ROLES: Final = {
    "inverse": frozenset({"divisor", "denominator", "divide"}),
    "metres": frozenset({"multiplier", "multiply"}),
    "scale": _SCALES,
    "step": frozenset({"step", "precision", "resolution", "quantization", "quantisation"}),
}
"""What a number means by a word of its key. A "step" counts only with a unit beside it: it may be
one of pictures or bits."""
_RANGES: Final = frozenset({"range", "limits", "bounds"})
_ENDS: Final[tuple[About, About]] = ("near", "far")
_NAMED_RANGE: Final = frozenset({"near", "far", "znear", "zfar"})
_OTHER_MEANING: Final = re.compile(
    r"(?<![a-z])(?:inv(?:erse[d]?)?|disparit\w+|log(?:arithm\w*)?|non-?linear|gamma|sqrt|radial|"
    r"euclid\w*|reversed?|z-?buffer|device|perspective|rays?(?![ _-]?(?:trac|cast|march))|"
    r"spherical|l2|distance to (?:the )?cam\w*|range image|1 ?/ ?(?:z|depth))(?![a-z])|"
    r"[a-z] [-+] [\d.]+ ?\)|[a-z] ?[-+] ?\d+\.\d+ ?\)"
)
"""Words of a depth that is no length along the optical axis, or no linear one."""
_KINDS: Final = frozenset({"kind", "type", "definition", "projection", "annotator"})
"""Words of keys whose texts say what depth is."""
_PLANAR: Final = re.compile(
    r"planar|plane|axi|ortho|perpendicular|linear|metric|depth|\bz\b|\d|float|int|half|video|none|"
    r"normali[sz]"
)
"""Texts under such a key that are of depth along the optical axis, or of how it is stored."""
_SUM: Final = re.compile(r"[\w)\]] \+ [\w.(\[]|[*/][^,;\n]*[\w)\]] - \d")
"""A sum in a formula, which has an offset that nothing here reads."""
_NORMALISED: Final = re.compile(r"normali[sz]")
_STATISTICS: Final = frozenset(
    {"stat", "stats", "statistics", "valid", "observed", "mean", "median", "std", "percentile",
     "clip", "clipping", "clamp", "ratio", "share", "percent", "histogram", "coverage"}
)  # fmt: skip
_OTHER_DEPTHS: Final = re.compile(r"depth_of_field|(?:bit|colou?r)_depth|(?:^|_)dof(?:_|$)")
_HARMLESS: Final = frozenset(
    re.findall(
        r"\w+",
        """
        encoded time major minor version compatible bytes date copyright filename rate fps frame
        frames width height size bits bit bitdepth channels camera cameras cam scene index id
        number count seed track disc crc crf qp gop level levels preset threads slices quality
        focal fov sensor baseline year hash md5 sha256 checksum lines rotate rotation view map
        dtype invalid nodata sky stream streams name file files path codec pix fmt format type
        split
        """,
    )
)
"""Words of keys whose numbers are of something else than metres."""
_EVERYDAY: Final = re.compile(r"baseline|pose|locat|position|translat|trajector|lens|focal")
_DEPTH_WORDS: Final = re.compile(r"depth|stored|value|unit|uint|bit|\bz\b|linear|distance|pixel")
_SCALE_WORDS: Final = re.compile(
    rf"scal|unit|factor|near|far\b|rang|multipl|divid|met(?:er|re)|\b(?:{_U})\b|\*"
)
_METRES: Final = re.compile(rf"(?<![a-z])(?:{_U})(?![a-z])")
_DEPTH_VARIABLE: Final = re.compile(r"(?<![a-z])(?:depth|z|distance|dist)(?![a-z])")
_VARIABLE: Final = r"[a-z\[(][a-z \[\]()]*"
_EXPRESSION: Final = re.compile(
    rf"(?:(?P<left>{_VARIABLE})\s*=\s*)?(?:(?P<first>{_RATIO})\s*\*\s*(?P<scaled>{_VARIABLE})|"
    rf"(?P<right>{_VARIABLE})(?P<factors>(?:\s*[*/]\s*(?:{_NUMBER}))+))(?P<more>\s*[-+*/]\s*\w)?"
)
_BYTES: Final = re.compile(r"=?\s*\w+\s*(?:\*\s*256|<<\s*8)\s*[+|]\s*\w+\s*\Z")
"""How 16 bits follow from a high and a low byte."""
_RANGE_FORMULA: Final = re.compile(r"[^;,]*\(\s*z?far\s*-\s*z?near\s*\)[^;,]*")
_CLAUSES: Final = re.compile(r"[;\n]|\.(?=\s|$)|,(?!\d)")
_TYPES: Final = re.compile(r"\b[a-z]+\d\w*|\b\d+[ -]?bits?\b|\b\d+x\d+\b")
"""Names of types and sizes: uint16, gray16le, 16-bit, 1280x1280."""
_PHRASES: Final = tuple(
    (kind, re.compile(pattern))
    for kind, pattern in (
        ("metres", rf"(?P<number>{_RATIO})\s*(?P<unit>{_U}){_PER}(?:{_THING})\b"),
        ("inverse", rf"(?P<number>{_RATIO})\s*(?:{_THING})?{_PER}(?P<unit>{_U})\b"),
        ("metres", rf"\b(?:1 |one |an? )?(?:{_THING})\s*(?:=|is|:|equals|->)\s*(?P<number>{_RATIO})"
                   rf"\s*(?P<unit>{_U})\b"),
        ("range", rf"\brange\W*(?:of|is|from)?\W*(?P<near>{_NUMBER})\s*(?:{_U})?\s*"
                  rf"(?:-|to|\.\.+|,|\s)\s*(?P<far>{_NUMBER})\s*(?P<unit>{_U})?\b"),
        ("near", rf"\b(?:z?near|min(?:imum)?)\w*(?:[ _]depth)?\s*[=:]?\s*(?P<number>{_NUMBER})"
                 rf"\s*(?P<unit>{_U})?\b"),
        ("far", rf"\b(?:z?far|max(?:imum)?)\w*(?:[ _]depth)?\s*[=:]?\s*(?P<number>{_NUMBER})"
                rf"\s*(?P<unit>{_U})?\b"),
        ("scale", r"\b(?:scal|factor|unit|multipl|divid|times)\w*\s*(?:factor)?\s*"
                  rf"(?:=|:|of|is|by)?\s*(?P<number>{_RATIO})\s*(?P<unit>{_U})?\b"),
    )
)  # fmt: skip
"""What a sentence may say, the plainest first; each is cut out where it is found."""


@dataclass(frozen=True, slots=True)
class Statement:
    """One thing that a file says about its depth.

    Attributes:
        about: "unit": ``values`` are the readings of metres in a stored unit; "length unit": a word
            for a unit, which may be that of stored numbers or of other lengths; "near", "far",
            "offset": a length; "normalised": stored numbers fill a range; "other meaning": inverse
            depth, length of rays and the like; "unclear": a number that nobody understands.
        values: Metres, one for each possible reading.
        place: The file and the key.
        text: What stands there.
        origin: A tag of the video, or JSON of the scene.
        is_bare: Whether no unit stands beside the number.
        is_weak: Whether it may be a figure of the scene instead of the contract.
        rounding: Half of the last digit written, as a share of the value.
    """

    about: About
    values: tuple[float, ...]
    place: str
    text: str
    origin: Origin
    is_bare: bool = False
    is_weak: bool = False
    rounding: float = 0.0

    def __str__(self) -> str:
        """Return place and text."""
        return f"{self.place} {self.text}"


@dataclass(frozen=True, slots=True)
class StatedDepth:
    """What all statements together say.

    Attributes:
        unit_m: Metres in a stored unit; None where nothing is stated.
        offset_m: Depth in metres of the stored number 0.
        origin: Where the unit stands.
    """

    unit_m: float | None = None
    offset_m: float = 0.0
    origin: Origin = "tag"


def stated_in_tags(tags: Mapping[str, str], *, name: str) -> list[Statement]:
    """Return what the tags of a depth video say; all of them are about depth."""
    found: list[Statement] = []
    for key, value in sorted(tags.items()):
        source = _Source(f"{name}: tag {shortened(key)} =", "tag")
        found += source.read(_key_words(key), value)
    return found


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
    """Return what a metadata file says under keys that name depth, or in a file ``about`` it.

    Of ``is_prose``, such as the description of a scene, only units count: "depth" may be a caption.
    """
    found: list[Statement] = []
    for node in nodes_of(document):
        place = words(f"{about} {node.path}")
        if "depth" not in place.split("_") or _OTHER_DEPTHS.search(place):
            continue
        value, is_scale = node.value, not _SCALES.isdisjoint(node.name.split("_"))
        if is_prose and isinstance(value, str) and not is_scale:
            continue
        source = _Source(f"{name}: {node.path} is", "metadata", path=place)
        if isinstance(value, list) and value[:1] * CAMERA_COUNT == value:
            value = value[0]
        if isinstance(value, list) and len(value) != 2:
            if is_scale:
                found.append(source.make("unclear", (), json.dumps(value)))
        elif not isinstance(value, dict):
            found += source.read(node.name, value)
    return [each for each in found if each.about in ("unit", "length unit")] if is_prose else found


def agreed(statements: Sequence[Statement], *, largest: int) -> StatedDepth:
    """Return the unit and the offset that all statements give.

    Args:
        statements: Of the tags of a video and of the scene's JSON.
        largest: The largest number that the video's pixel format stores.

    Raises:
        SchemaError: If they contradict each other, or do not tell the unit although they are about
            it; it names their places.
    """
    about: dict[About, list[Statement]] = defaultdict(list)
    for each in statements:
        about[each.about].append(each)
    _refuse("is no plain length along the optical axis", about["other meaning"])
    _refuse(
        f"gives no unit of {LEAST_UNIT_M:g} to {LARGEST_UNIT_M:g} m",
        [each for each in about["unit"] if not each.values],
    )
    _refuse("may be metres or stored units", [each for each in about["offset"] if each.is_bare])
    units, names = about["unit"], about["length unit"]
    near_m, ranged = _of_range(about, largest=largest)
    if ranged is not None:
        unit_m = ranged.values[0]
        is_same = any(
            abs(value - unit_m) <= _EXACT * unit_m for each in units for value in each.values
        )
        if near_m and units and not about["normalised"] and not is_same:
            _refuse(_CONTRADICTION, [*units, ranged])  # ends of a range, or planes that clip
        units = [*units, ranged]
        # A word for a unit is that of the range's ends, where these have none themselves.
        is_of_range = any(each.is_bare for each in [*about["near"], *about["far"]])
        names = [] if is_of_range else names
    found = _of_units(units, names)
    if found.unit_m is None:
        _refuse("says nothing of the nearest and the farthest depth", about["normalised"])
        _refuse("is not understood", about["unclear"])
        _refuse("tells no unit", about["offset"])
        return found
    offsets = {each.values[0] for each in about["offset"]} | ({near_m} - {0.0})
    if offsets and max(offsets) - min(offsets) > _SAME * max(map(abs, offsets)):
        _refuse(_CONTRADICTION, [*about["offset"], *about["near"]])
    return StatedDepth(found.unit_m, max(offsets, default=0.0), found.origin)


_CONTRADICTION: Final = "contradict each other"


def _refuse(why: str, statements: Sequence[Statement]) -> None:
    if statements:
        listed = ", ".join(dict.fromkeys(str(each) for each in statements[:_MOST_SHOWN]))
        raise SchemaError(f"{listed}: {why}")


def _of_units(units: Sequence[Statement], names: Sequence[Statement]) -> StatedDepth:
    """Return the unit of stored numbers that numbers and words agree on."""
    # A word for metres names what numbers become; beside the number 1, a word names the unit.
    told = [each for each in names if each.values[0] != 1]
    numbers = [each for each in units if not (told and each.is_bare and each.values == (1.0,))]
    everything = [*numbers, *told]
    if everything and all(each.is_bare and each.values == (1.0,) for each in everything):
        _refuse("may mean a metre, or that stored numbers are not scaled", everything)
    if not everything:
        _refuse("does not tell how many metres a stored unit has", names)
        return StatedDepth()
    best = min(everything, key=lambda each: (len(each.values), each.rounding))
    for unit_m in best.values:
        shares = [min(_SAME, max(each.rounding + best.rounding, 1e-6)) for each in everything]
        if all(
            any(abs(value - unit_m) <= share * unit_m for value in each.values)
            for each, share in zip(everything, shares, strict=True)
        ):
            is_tagged = any(each.origin == "tag" for each in everything)
            return StatedDepth(unit_m, origin="tag" if is_tagged else "metadata")
    _refuse(_CONTRADICTION, everything)
    return StatedDepth()


def _of_range(
    about: Mapping[About, list[Statement]], *, largest: int
) -> tuple[float, Statement | None]:
    """Return the nearest depth and the unit of a range that all stored numbers fill.

    The least and the greatest depth may be figures of the scene: in JSON they are, unless it says
    that numbers are normalised.
    """
    is_normalised = bool(about["normalised"])
    lengths = {each.values[0] for each in about["length unit"]}
    ends = [*about["far"], *about["near"]]
    weak = [each for each in ends if each.is_weak and not is_normalised]
    doubtful = [each for each in weak if each.origin == "metadata" or lengths - {1.0}]
    # Statistics have two ends; what has the nearest alone may be the depth of stored zeros.
    is_start = any(each.values[0] for each in doubtful) and {each.about for each in doubtful} == {
        "near"
    }
    if doubtful and (is_start or not about["unit"]):
        _refuse("may be the range that stored numbers fill, or the scene's", doubtful)
    ends = [each for each in ends if each not in doubtful]
    if not ends:
        return 0.0, None
    scale = 1.0
    if any(each.is_bare and each.values[0] for each in ends):
        farthest = max(each.values[0] for each in ends)
        possible = [m for m in (1.0, 1e-2, 1e-3) if _LEAST_FAR_M <= farthest * m <= _LARGEST_FAR_M]
        possible = list(lengths) or possible
        if len(possible) != 1:
            _refuse("may be metres or centimetres", ends)
        scale = possible[0]
    found: dict[About, float] = {}
    for each in ends:
        value = each.values[0] * (scale if each.is_bare else 1.0)
        known = found.setdefault(each.about, value)
        if abs(known - value) > _SAME * abs(known):
            _refuse(_CONTRADICTION, about[each.about])
    if "far" not in found:
        _refuse("tells no farthest depth", ends)
    near_m = found.get("near", 0.0)
    unit_m = (found["far"] - near_m) / largest
    is_round = math.isclose(unit_m, float(f"{unit_m:.2e}"), rel_tol=1e-4)
    if "near" not in found and not (is_normalised or is_round):
        _refuse("tells no nearest depth", ends)
    if not LEAST_UNIT_M <= unit_m <= LARGEST_UNIT_M:
        _refuse("is no range of depth", ends)
    shown = ", ".join(str(each) for each in ends)
    rounding = max(each.rounding for each in ends)
    return near_m, Statement("unit", (unit_m,), shown, "", ends[0].origin, rounding=rounding)


@dataclass(frozen=True, slots=True)
class _Source:
    """A place from which statements are read."""

    place: str
    origin: Origin
    path: str = ""

    def read(self, name: str, value: object) -> list[Statement]:
        """Return what a value under a key, in snake_case, says."""
        text = value.strip() if isinstance(value, str) else json.dumps(value)
        if value is False and "planar" in name:
            return [self.make("other meaning", (), text)]
        if value is None or value is False or text.lower() in ("", "false", "no", "none"):
            is_scale = text == "" and not _SCALES.isdisjoint(name.split("_"))
            return [self.make("unclear", (), text)] if is_scale else []
        if text.startswith("{") and isinstance(value, str):
            with suppress(ValueError, RecursionError):
                inner = nodes_of(json.loads(text if '"' in text else text.replace("'", '"')))
                listed = [each for each in inner if not isinstance(each.value, dict)]
                return [each for node in listed for each in self.read(node.name, node.value)]
        return list(self._read(name, value, text))

    def _read(self, name: str, value: object, text: str) -> Iterator[Statement]:
        parts = name.split("_")
        if self.origin == "tag" and not _TECHNICAL.isdisjoint(parts):
            return
        is_kind = not _KINDS.isdisjoint(parts) and isinstance(value, str)
        is_other_kind = is_kind and not _PLANAR.search(text.lower())
        if is_other_kind or _OTHER_MEANING.search(name.replace("_", " ")):
            yield self.make("other meaning", (), text)
            return
        if _NORMALISED.search(self.path or name):
            yield self.make("normalised", (), text)
        if not self._words(parts).isdisjoint(_STATISTICS):
            return
        number, rest = _number_of(value)
        if not _RANGES.isdisjoint(parts):
            yield from self._range(parts, text)
        elif number is not None and (not rest or words(rest) in UNITS_M):
            unit_m = UNITS_M[words(rest)] if rest else None
            yield from self._number(parts, number, unit_m, text)
        elif number is not None and re.fullmatch("[a-z]+", rest):
            yield self.make("unclear" if _SCALES.isdisjoint(parts) else "unit", (), text)
        elif isinstance(value, str):
            key = "" if number is None else f"{name.replace('_', ' ')} "
            is_about_unit = number is not None or not _SCALES.isdisjoint(parts)
            yield from self._sentence(key + text.lower(), is_about_unit=is_about_unit)

    def _words(self, parts: Sequence[str]) -> frozenset[str]:
        """Return the words of the place of a key, or of a tag's key."""
        return frozenset(self.path.split("_") if self.path else parts)

    def _number(
        self, parts: Sequence[str], number: float, unit_m: float | None, text: str
    ) -> Iterator[Statement]:
        """Return what a number says by the words of its key, and the unit beside it."""
        metre = unit_m or (UNITS_M.get(parts[-1]) if len(parts) > 1 else None)
        ratio = _ratio(" ".join(parts))
        end = next((end for end, known in _LENGTHS.items() if not known.isdisjoint(parts)), None)
        role = next((role for role, known in _ROLES.items() if not known.isdisjoint(parts)), None)
        if ratio is not None:
            kind, named_m = ratio
            yield self._unit(number, kind, named_m * (unit_m or 1.0), text)
        elif end is not None:
            if number or end != "offset":
                yield self._length(end, number, metre, text, parts)
        elif role in ("inverse", "metres"):
            yield self._unit(number, role, metre or 1.0, text)
        elif role == "scale" or (role == "step" and metre):
            yield self._unit(number, "metres" if metre else "either", metre or 1.0, text)
        elif self._words(parts).isdisjoint(_HARMLESS):
            # What nobody understands may be a scale; of JSON, only fractions and powers of ten.
            is_power = number >= 10 and math.log10(number).is_integer()
            if self.origin == "tag" or (number > 0 and (number % 1 != 0 or is_power)):
                yield self.make("unclear", (), text)

    def _range(self, parts: Sequence[str], text: str) -> Iterator[Statement]:
        numbers = map(_parsed, re.findall(_NUMBER, text.lower()))
        ends = sorted(number for number in numbers if number is not None)
        unit = _METRES.search(text.lower())
        metre = UNITS_M.get(parts[-1]) if unit is None else UNITS_M[words(unit[0])]
        if len(ends) != len(_ENDS):
            yield self.make("unclear", (), text)
        else:
            for about, number in zip(_ENDS, ends, strict=True):
                yield self._length(about, number, metre, text, parts)

    def _sentence(self, text: str, *, is_about_unit: bool) -> Iterator[Statement]:
        """Return what a text says of the unit, the range and the meaning of depth."""
        plain = text.replace("\u00d7", "*").replace("\u00f7", "/").replace("_", " ").strip()
        plain = re.sub(r" x (?=[\d.])|(?<=\d) x ", " * ", _BYTES.sub(" ", plain))
        if _METRES.fullmatch(plain):
            yield self.make("length unit", (UNITS_M[words(plain)],), text)
            return
        formula = "=" in plain or "*" in plain
        if _OTHER_MEANING.search(plain) or (
            formula and _SUM.search(_RANGE_FORMULA.sub(" ", plain))
        ):
            yield self.make("other meaning", (), text)
            return
        if _NORMALISED.search(plain) or _RANGE_FORMULA.search(plain):
            yield self.make("normalised", (), text)
        for clause in _CLAUSES.split(_RANGE_FORMULA.sub(" ", plain)):
            is_of_depth = _DEPTH_WORDS.search(plain) and not _EVERYDAY.search(clause)
            found = list(self._clause(clause, text, has_units=is_about_unit or bool(is_of_depth)))
            is_number = re.search(r"\d", _TYPES.sub(" ", clause)) and _SCALE_WORDS.search(clause)
            if not found and (is_about_unit or (is_number and not _EVERYDAY.search(clause))):
                found.append(self.make("unclear", (), text))
            yield from found

    def _clause(self, clause: str, text: str, *, has_units: bool) -> Iterator[Statement]:
        rest = _TYPES.sub(" ", clause)
        for match in _EXPRESSION.finditer(rest):
            yield from self._expression(match, text)
        rest = _EXPRESSION.sub(" ", rest)
        for kind, pattern in _PHRASES:
            for match in pattern.finditer(rest):
                yield from self._phrase(kind, match, text)
            rest = pattern.sub(" ", rest)
        for match in _METRES.finditer(rest) if has_units else ():
            if not re.search(r"[\d.] ?$", rest[: match.start()]):
                yield self.make("length unit", (UNITS_M[words(match[0])],), text)

    def _expression(self, match: re.Match[str], text: str) -> Iterator[Statement]:
        """Return what an equation says, such as "stored = metres * 1000", or half of one."""
        left, right = match["left"] or "", match["right"] or match["scaled"]
        factor = _parsed(match["first"]) or 1.0
        for sign, number in re.findall(rf"([*/])\s*({_NUMBER})", match["factors"] or ""):
            value = _parsed(number) or math.nan
            factor = factor / value if sign == "/" else factor * value
        units = [UNITS_M[words(each[0])] if each else None
                 for each in (_METRES.search(left), _METRES.search(right))]  # fmt: skip
        is_depth = [bool(_DEPTH_VARIABLE.search(each)) for each in (left, right)]
        if match["more"]:
            yield self.make("other meaning", (), text)
        elif not (math.isfinite(factor) and factor > 0):
            yield self.make("unclear", (), text)
        elif units[0] is not None and units[1] is None:
            yield self._unit(factor, "metres", units[0], text)
        elif units[1] is not None and units[0] is None:
            yield self._unit(factor, "inverse", units[1], text)
        elif left and units == [None, None] and is_depth != [True, True] and any(is_depth):
            yield self._unit(factor, "metres" if is_depth[0] else "inverse", 1.0, text)
        elif not left and (is_depth[1] or _DEPTH_WORDS.search(right)):
            yield self._unit(factor, "either", 1.0, text)
        elif left or is_depth[1]:
            yield self.make("unclear", (), text)

    def _phrase(self, kind: str, match: re.Match[str], text: str) -> Iterator[Statement]:
        metre = None if match["unit"] is None else UNITS_M[words(match["unit"])]
        parts = [] if kind == "range" else [kind]
        for about in _ENDS:
            number = _parsed(match[about] if kind == "range" else match["number"])
            if number is not None and kind in ("range", about):
                yield self._length(about, number, metre, text, parts)
        if kind not in ("range", *_ENDS) and (number := _parsed(match["number"])) is not None:
            if kind == "scale":
                kind = "metres" if metre else "either"
            yield self._unit(number, kind, metre or 1.0, text)

    def _unit(self, number: float, kind: str, metre: float, text: str) -> Statement:
        readings = []
        if number > 0:
            if kind != "inverse":
                readings.append(number * metre)
            # Stored units a metre are a round number, such as 1000 or 256.
            is_round = float(f"{number:.1e}") == number or math.log2(number).is_integer()
            may_divide = number > 1 and number.is_integer() and is_round
            if kind == "inverse" or (kind == "either" and may_divide):
                readings.append(metre / number)
        possible = (each for each in readings if LEAST_UNIT_M <= each <= LARGEST_UNIT_M)
        values = tuple(dict.fromkeys(possible))
        return self.make("unit", values, text, is_bare=kind == "either", number=number)

    def _length(
        self, about: About, number: float, metre: float | None, text: str, parts: Sequence[str]
    ) -> Statement:
        is_weak = about != "offset" and _NAMED_RANGE.isdisjoint(parts)
        return self.make(
            about, (number * (metre or 1.0),), text,
            is_bare=metre is None, is_weak=is_weak, number=number,
        )  # fmt: skip

    def make(
        self, about: About, values: tuple[float, ...], text: str, *, number: float = 0.0,
        **facts: bool,
    ) -> Statement:  # fmt: skip
        """Return a statement; the digits of its number tell how it is rounded."""
        digits = len(f"{number:.12g}".replace(".", "").lstrip("0").partition("e")[0].rstrip("0"))
        rounding = 0.5 * 10.0 ** (1 - digits) if number else 0.0
        shown = shortened(repr(text))
        return Statement(about, values, self.place, shown, self.origin, rounding=rounding, **facts)


_TECHNICAL: Final = frozenset(
    {"encoder", "duration", "creation", "handler", "vendor", "language", "brand", "brands",
     "statistics", "bps", "timecode", "software", "mimetype"}
)  # fmt: skip


def _ratio(plain: str) -> tuple[str, float] | None:
    """Return whether a name counts metres in a unit or units in a metre, and that length in m.

    >>> _ratio("units per meter"), _ratio("mm per lsb"), _ratio("depth to m"), _ratio("scale")
    (('inverse', 1.0), ('metres', 0.001), ('metres', 1.0), None)
    """
    match = _NAMED_RATIO.search(plain)
    if match is None or (match["over"] is None) == (match["under"] is None):
        return None
    is_per = match["by"] == "per"
    if match["over"] is not None:
        return "metres" if is_per else "inverse", UNITS_M[words(match["over"])]
    return "inverse" if is_per else "metres", UNITS_M[words(match["under"])]


_NAMED_RATIO: Final = re.compile(
    rf"\b(?:(?P<over>{_U})|\w+) (?P<by>per|to) (?:(?P<under>{_U})|\w+(?: \w+)?)$"
)


def _number_of(value: object) -> tuple[float | None, str]:
    """Return the number that a value begins with, and what follows it."""
    if is_number(value):
        return float(value), ""
    match = _TEXT_NUMBER.fullmatch(value.lower()) if isinstance(value, str) else None
    if match is None:
        return None, ""
    return _parsed(match[1]), match[2].strip()


def _parsed(text: str | None) -> float | None:
    """Return a number or a ratio of two; a comma may stand for the point."""
    if text is None:
        return None
    above, _, below = re.sub(r"\s", "", text).replace(",", ".").replace(":", "/").partition("/")
    try:
        number = float(above) / (float(below) if below else 1.0)
    except (ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None
