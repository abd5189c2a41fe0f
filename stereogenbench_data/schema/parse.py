"""Metadata files to typed records: scene keys, ``baseline.json``, markers and descriptions.

A file is read by a declaration (`schema.declaration`), which says where each quantity stands. What
every sample needs (focal length, sensor width, baselines, which camera is left) must stand there
and be understood: `SchemaError` lists everything else that is wrong. What no sample needs (labels,
captions) is left out with a `Remark`.
"""

import functools
import itertools
import math
import re
from collections.abc import Iterator, Sequence
from decimal import Decimal
from typing import Any, Final, NamedTuple

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.declaration import (
    BUILT_IN,
    CAPTIONS,
    LABELS,
    Declaration,
    NumberAt,
    PairsAt,
)
from stereogenbench_data.schema.document import (
    MOST_LETTERS,
    brief,
    is_number,
    listed_keys,
    parse_object,
    parse_text,
)
from stereogenbench_data.schema.places import (
    entries_at,
    first_value,
    numbers_in,
    path_to,
    place_at,
    value_at,
)
from stereogenbench_data.schema.records import Remark, Rig, SceneId, SceneLabels
from stereogenbench_data.schema.release import (
    ADJACENT_CM,
    ADJACENT_PAIRS,
    CAMERA_COUNT,
    CAMERA_PAIRS,
    IMAGE_SIZE_PX,
    SENSOR_MM,
    subset_of_folder,
)
from stereogenbench_data.schema.text import counted, shortened
from stereogenbench_data.schema.units import UNITS_M, without_unit, words

_FOLDER: Final = re.compile(r"[!-\-0-\[\]-~](?:[ -\-0-\[\]-~]*[!-\-0-\[\]-~])?\Z")
"""Printable ASCII without dot, slash and backslash, and without a space at either end."""

_KEY_SHOWN: Final = 300
_SHOWN: Final = 20

Pair = tuple[int, int]


@functools.lru_cache(maxsize=2**14)  # opening a tree asks twice for each scene
def parse_scene_key(key: str) -> SceneId:
    """Return the split, subset, family and map that a scene's path names.

    Args:
        key: ``train/<family>/<map>/<scene>`` or ``eval/<subset>/<family>/<map>/<scene>``, with
            forward slashes. The first dot of a base name ends the key in a tar shard, so a
            folder name must not contain a dot.

    Raises:
        SchemaError: If the path has another form.

    Source: the paper's loading example.

    >>> parse_scene_key("train/Uniform/Stylized_Egypt/scene_000041").map_name
    'Stylized_Egypt'
    >>> parse_scene_key("eval/MapSeenInTrain/Uniform/Car_Dealer/scene_000000").subset
    'seen_map'
    """
    folders, shown = key.split("/"), shortened(key, _KEY_SHOWN)
    for folder in folders:
        if not _FOLDER.match(folder):
            raise SchemaError(
                f"scene {shown!r}: {shortened(folder)!r} is not a valid folder name: use printable "
                f"ASCII without a dot, which would end the scene's key in a tar shard, without a "
                f"backslash, and without a space at either end. Rename the folder."
            )
    if folders[0] == "train" and len(folders) == 4:
        return SceneId(key, "train", None, folders[1], folders[2])
    if folders[0] == "eval" and len(folders) == 5:
        return SceneId(key, "eval", subset_of_folder(folders[1]), folders[2], folders[3])
    raise SchemaError(
        f"scene {shown!r}: a scene's path must be train/<family>/<map>/<scene> or "
        f"eval/<subset>/<family>/<map>/<scene>, found {len(folders)} folders "
        f"that start with {shortened(folders[0])!r}. Name the scene by its path below the root."
    )


def _labels(document: dict[str, Any], *, where: str) -> tuple[SceneLabels, list[Remark]]:
    """Return the identifiers in a document; one that is not of its kind is left out."""
    found: dict[str, Any] = {}
    remarks: list[Remark] = []
    for name, places in LABELS.items():
        path, value = first_value(document, places)
        if name == "aperture_fstop":
            found[name] = float(value) if is_number(value) and value > 0 else None
        elif name == "scene_index":
            is_index = type(value) in (int, str) and re.fullmatch(r"[0-9]{1,15}", str(value))
            found[name] = int(value) if is_index else None
        elif path:
            found[name] = _plain_text(value)
            if found[name] is None:
                told = f"{where}: {path}: must be a text, found {brief(value)}"
                remarks = remarks or [Remark("labels", told)]
    return SceneLabels(**found), remarks


def _plain_text(value: object) -> str | None:
    """Return a text that can be written as UTF-8, None for another value."""
    if not isinstance(value, str) or len(value) > MOST_LETTERS:
        return None
    has_halves = not value.isascii() and any("\ud800" <= letter <= "\udfff" for letter in value)
    return None if has_halves else value


def parse_complete(text: bytes, *, where: str) -> tuple[SceneLabels, tuple[Remark, ...]]:
    """Return the identifiers in a ``_scene_complete.json``, the marker of a finished scene.

    Whatever it holds, the scene is finished; what is not understood is left out with a remark.

    Source: the paper's appendix on the file schema.
    """
    try:
        labels, remarks = _labels(parse_object(text, where=where), where=where)
    except SchemaError as error:
        return SceneLabels(), (Remark("labels", str(error)),)
    return labels, tuple(remarks)


def parse_caption(text: bytes, *, where: str) -> tuple[str, tuple[Remark, ...]]:
    """Return the caption in a scene's description: the detailed one, else the short one, else "".

    A file with the suffix .txt is the caption. What is not understood is left out with a remark: no
    picture depends on it.

    Source: the paper's appendix on the file schema.
    """
    try:
        if where.endswith(".txt"):
            stated = {CAPTIONS[0].removeprefix("$."): parse_text(text, where=where).strip()}
        else:
            stated = parse_object(text, where=where)
    except SchemaError as error:
        return "", (Remark("caption", str(error)),)
    odd: list[Remark] = []
    for place in CAPTIONS:
        _, value = first_value(stated, (place,))
        caption = _plain_text(value)
        if caption:
            return caption, ()
        if value is not None and caption is None:
            told = f"{where}: {place}: must be a text, found {brief(value)}"
            odd.append(Remark("caption", told))
    return "", tuple(odd[:1])


def parse_rig(
    text: bytes, *, where: str, declared: Declaration = BUILT_IN, size_px: Pair | None = None
) -> tuple[Rig, SceneLabels, tuple[Remark, ...]]:
    """Return the rig and the identifiers that a ``baseline.json`` records, and what is odd.

    Without an image size, that of the videos is taken, or else the release's 1280 x 1280
    (``image_size_source`` says so). Without a sensor height, pixels are square, as in the paper's
    loading example. A principal point is in pixels of the recorded image, with the centre of the
    top-left pixel at (0.5, 0.5); one within a pixel of the centre is the centre. A focal length in
    pixels beside one in mm must be the same.

    Args:
        text: The file's bytes.
        where: The file's path, for messages.
        declared: Where the quantities stand in it.
        size_px: (width, height) of the videos, where these were opened.

    Raises:
        SchemaError: If focal length, sensor width, a baseline or the primary pair does not stand
            where it is declared, or is not understood; the message lists every problem, and for
            what is missing the lines of a file of conventions that say where it stands.

    Source: the paper's loading example and its appendix on the file schema.
    """
    file = _RigFile(parse_object(text, where=where), declared, where)
    rig = file.rig(size_px)
    labels, odd = _labels(file.document, where=where)
    if file.problems:
        listed = file.problems[:_SHOWN]
        if len(file.problems) > _SHOWN:
            listed.append(f"and {len(file.problems) - _SHOWN} more")
        head = counted(len(file.problems), "problem")
        raise SchemaError(f"{where}: {head}:\n  " + ".\n  ".join(listed) + ".")
    return rig, labels, (*file.remarks, *odd)


def is_of_family(rig: Rig, family: str, *, scale: float = 1.0) -> bool:
    """Return whether neighbours' baselines, times a scale, lie in the paper's range of a family."""
    low_cm, high_cm = ADJACENT_CM.get(family, (0.0, math.inf))
    adjacent_cm = [rig.baseline_cm(a, b) * scale for a, b in ADJACENT_PAIRS]
    return low_cm * _NEARLY[0] <= min(adjacent_cm) and max(adjacent_cm) <= high_cm * _NEARLY[1]


def require_unit(rig: Rig, *, family: str, where: str) -> tuple[Remark, ...]:
    """Return a remark on baselines that the paper's family does not have.

    Raises:
        SchemaError: If they are far off, and would be the family's in another unit of length.
    """
    if is_of_family(rig, family):
        return ()
    low_cm, high_cm = ADJACENT_CM.get(family, (0.0, math.inf))
    adjacent_cm = [rig.baseline_cm(a, b) for a, b in ADJACENT_PAIRS]
    least_cm, most_cm = min(adjacent_cm), max(adjacent_cm)
    told = (
        f"{where}: neighbouring cameras are {least_cm:.6g} to {most_cm:.6g} cm apart, and in the "
        f"paper's family {family} {low_cm:g} to {high_cm:g} cm"
    )
    is_far = least_cm < low_cm * _NEARLY[0] or most_cm > high_cm * _FAR
    for unit, factor in (("m", 100.0), ("mm", 0.1)):
        if is_far and low_cm <= least_cm * factor and most_cm * factor <= high_cm:
            raise SchemaError(f"{told}. In {unit} they would be: correct the unit.")
    return (Remark("unit", told),)


_NEARLY: Final = (0.9, 1.1)
_FAR: Final = 3.0
"""How far above its family's largest baseline one must be for its unit to be refused: a rig may be
somewhat wider than the paper's, and in the unit below it would be one of the family, too."""
_DECLARED_LENSES: Final = (0.4, 6.0)
"""Focal lengths in widths of the sensor that conventions may mean: the release has 0.76 to 3.6."""
_LENSES: Final = (0.04, 60.0)
"""Focal lengths in widths of the sensor that files may mean: 171 degrees to one."""
_RATIO: Final = 5e-3
"""How far a focal length in pixels, or a field of view, may be from focal length over sensor width:
it is often rounded."""
_NOT_COMPARED: Final = "or say in a file of conventions where [focal_length] stands"
_CENTRE_PX: Final = 1.0
"""How far a principal point may be from the image's centre to be that centre: conventions of pixels
differ by a half, and centres are written as whole pixels."""
_SAME: Final = 1e-6
"""By what share a baseline that is recorded twice may differ."""
_NAME_READ: Final = 32
"""How many letters of a name tell its camera."""
_CAMERA_NAME: Final = re.compile(r"[Cc]am_?([0-9]{1,6})\Z")
"""The end of a camera's name, as the paper's loading example reads it."""


class _Length(NamedTuple):
    """A recorded baseline: the way to its row, its place there, what stands there, cm in a unit."""

    way: tuple[str | int, ...]
    place: str
    stated: float
    unit_cm: float

    @property
    def cm(self) -> float:
        """The baseline in cm."""
        return float(self.stated) * self.unit_cm if self.unit_cm != 1.0 else float(self.stated)

    @property
    def path(self) -> str:
        """Its JSON path."""
        return f"{path_to(self.way)}.{self.place}".removesuffix(".").replace(".[", "[")

    @property
    def rounding_cm(self) -> float:
        """Half of the last digit that is written, and at least a float32's rounding."""
        exponent = Decimal(repr(self.stated)).as_tuple().exponent
        half = 0.5 * 10.0 ** int(exponent)
        return max(half, float(self.stated) * 2**-23) * self.unit_cm


class _RigFile:
    """A ``baseline.json`` that is read by a declaration.

    Attributes:
        document: The JSON object.
        problems: What stops a sample, in full sentences but for the last full stop.
        remarks: What only concerns some fields, or none.
    """

    def __init__(self, document: dict[str, Any], declared: Declaration, where: str) -> None:
        self.document = document
        self._declared, self._where = declared, where
        self.problems: list[str] = []
        self.remarks: list[Remark] = []
        inner = document.get("camera_intrinsics")
        inner = inner if isinstance(inner, dict) else {}
        self._keys = frozenset((*document, *(f"camera_intrinsics.{key}" for key in inner)))

    def rig(self, size_px: Pair | None) -> Rig:
        """Return the rig; what it lacks is a problem."""
        width, height = (self._side(name) for name in ("image_width", "image_height"))
        like_px = size_px or (IMAGE_SIZE_PX, IMAGE_SIZE_PX)
        width_px, height_px = width or like_px[0], height or width or like_px[1]
        _, sensor_height = self._number("sensor_height")
        focal_mm, sensor_width_mm = self._lens(width if size_px is None else width_px)
        sensor_height_mm = sensor_height or sensor_width_mm * height_px / width_px
        if size_px is not None or width is not None:
            self._compare_focal_y(focal_mm / sensor_height_mm * height_px)
        baselines_cm = self._baselines_cm()
        return Rig(
            focal_mm=focal_mm,
            sensor_width_mm=sensor_width_mm,
            sensor_height_mm=sensor_height_mm,
            image_width_px=width_px,
            image_height_px=height_px,
            principal_point_px=self._principal_point(width_px, height_px),
            baselines_cm=tuple(baselines_cm.get(pair, math.nan) for pair in CAMERA_PAIRS),
            primary_pair=self._primary_pair(),
            image_size_source="default" if width is None and height is None else "recorded",
        )

    def _missing(self, what: str, places: Sequence[str], lines: str) -> None:
        """Add that something is missing, with the lines that say where it stands."""
        keys = listed_keys(self._keys)
        self.problems.append(
            f"{' or '.join(places)} is missing, where {what} stands; the keys are: {keys}. If it "
            f"stands elsewhere, say where in a file of conventions: format = 2, then {lines}"
        )

    def _number(self, name: str) -> tuple[str, float]:
        """Return where a number stands, and it in mm, pixels or degrees; ("", 0) without one."""
        at = self._declared.numbers.get(name, NumberAt())
        if at.value is not None:
            return f"[{name}] of the conventions", at.value * _scale(at)
        path, value = first_value(self.document, _possible(at.places, self._keys))
        if not path or (value is None and name != "image_width"):
            return "", 0.0
        value = value[0] if path[-1] == "~" and value else value
        if not (is_number(value) and value > 0):
            if at.unit == "px" and name[:6] != "image_" and not at.is_needed:
                return "", 0.0
            self.problems.append(f"{path}: must be a number above zero, found {brief(value)}")
            return path, 0.0
        return path, float(value) * _scale(at)

    def _side(self, name: str) -> int | None:
        """Return a side of the recorded image in pixels, None where it has none."""
        path, side = self._number(name)
        if path and not side.is_integer():
            self.problems.append(f"{path}: must be a whole number of pixels, found {side:g}")
        return int(side) or None

    def _lens(self, width_px: int | None) -> tuple[float, float]:
        """Return focal length and sensor width in mm.

        One of them may follow from a field of view or a focal length in pixels, which must agree
        where both are there. Where neither is recorded, the sensor is that of the release.
        """
        focal_at, focal_mm = self._number("focal_length")
        sensor_at, sensor_mm = self._number("sensor_width")
        ratios = [*self._focal_ratios(width_px)]
        focal = self._declared.numbers.get("focal_length", NumberAt())
        if ratios and not focal.is_needed and not self.problems:
            if not (focal_mm or sensor_mm):
                sensor_mm = SENSOR_MM
                told = f"has no sensor width; that of the release is assumed, {SENSOR_MM} mm"
                self.remarks.append(Remark("sensor", f"{self._where}: {told}"))
            sensor_mm = sensor_mm or focal_mm / ratios[0][1]
            focal_mm = focal_mm or sensor_mm * ratios[0][1]
        for name, at, length_mm in (("focal_length", focal_at, focal_mm),
                                    ("sensor_width", sensor_at, sensor_mm)):  # fmt: skip
            if not at and not length_mm:
                places = self._declared.numbers.get(name, BUILT_IN.numbers[name]).places
                lines = f'[{name}] place = "$.its.place", unit = "mm"'
                self._missing(f"the {name.replace('_', ' ')}", places, lines)
        if not (focal_mm and sensor_mm):
            return focal_mm or 1.0, sensor_mm or 1.0
        found = focal_mm / sensor_mm
        for path, ratio in ratios:
            if abs(found - ratio) > _RATIO * ratio:
                self.problems.append(
                    f"{path}: means {ratio:.6g} focal lengths a sensor width, and focal length and "
                    f"sensor width in mm ({focal_at}, {sensor_at}) mean {found:.6g}. Correct the "
                    f"wrong one, {_NOT_COMPARED}"
                )
        low, high = _DECLARED_LENSES if self._declared.stated else _LENSES
        if not low <= found <= high:
            self.problems.append(
                f"a focal length of {focal_mm:.6g} mm on a sensor {sensor_mm:.6g} mm wide is "
                f"{found:.3g} widths of the sensor, and lenses have {low:g} to {high:g}. Correct "
                f"its unit or its place"
            )
        return focal_mm, sensor_mm

    def _focal_ratios(self, width_px: int | None) -> Iterator[tuple[str, float]]:
        """Yield the focal lengths a sensor width that follow from a field of view and pixels."""
        path, angle = self._number("field_of_view")
        if path and angle:
            unit = self._declared.numbers["field_of_view"].unit
            is_rad = unit.startswith("rad") or (not unit and angle < math.pi)
            angle_rad = angle if is_rad else math.radians(angle)
            if angle_rad < math.pi:
                yield path, 0.5 / math.tan(angle_rad / 2)
            else:
                self.problems.append(f"{path}: {angle:g} is no field of view")
        path, focal_px = self._number("focal_length_px")
        if path and focal_px and width_px:
            yield path, focal_px / width_px

    def _compare_focal_y(self, by_mm_px: float) -> None:
        """Refuse a vertical focal length in pixels that is not that of the lens in mm."""
        path, focal_y_px = self._number("focal_length_y_px")
        if path and abs(by_mm_px - focal_y_px) > _RATIO * focal_y_px and not self.problems:
            self.problems.append(
                f"{path}: is {focal_y_px:.6g} px, and by focal length and sensor in mm it is "
                f"{by_mm_px:.6g} px. Correct the wrong one, {_NOT_COMPARED}"
            )

    def _principal_point(self, *size_px: int) -> tuple[float, float] | None:
        """Return the principal point in pixels; None where it is the centre or not recorded."""
        (x_at, x_px), (y_at, y_px) = (self._number(f"principal_{axis}") for axis in "xy")
        if not x_at and not y_at:
            return None
        width_px, height_px = size_px
        if abs(x_px - 0.5) < _RATIO > abs(y_px - 0.5):
            return None  # in shares of the sides
        off_x, off_y = x_px / width_px - 0.5, y_px / height_px - 0.5
        if abs(off_x) > _SHARE < abs(off_y) and abs(off_x - off_y) < _SHARE:
            self.problems.append(
                f"{x_at}: by its principal point ({x_px:g}, {y_px:g}) it is of other pictures than "
                f"these, of {width_px}x{height_px}. State their size as image_width and "
                f"image_height"
            )
        if not (x_at and y_at and 1 < x_px < width_px and 1 < y_px < height_px):
            told = f"{x_at or y_at}: the principal point ({x_px:g}, {y_px:g}) must be x and y in "
            told += f"pixels inside a picture of {width_px}x{height_px}"
            self.remarks.append(Remark("principal point", f"{self._where}: {told}"))
            return None
        is_centre = abs(x_px - width_px / 2) <= _CENTRE_PX >= abs(y_px - height_px / 2)
        return None if is_centre else (x_px, y_px)

    def _primary_pair(self) -> Pair:
        at = self._declared.primary_pair
        ends = [first_value(self.document, places) for places in (at.left, at.right)]
        if not any(path for path, _ in ends):
            if at.is_needed:
                lines = '[primary_pair] left = "$.its.place", right = "$.its.place"'
                self._missing("the left camera", at.left, lines)
            else:
                told = "has no primary pair, so cameras are taken to be numbered from left to right"
                self.remarks.append(Remark("primary pair", f"{self._where}: {told}"))
            return 0, 1
        left, right = (camera_named(value) for _, value in ends)
        stated = self.document.get("primary_stereo_pair")
        if at == BUILT_IN.primary_pair and isinstance(stated, list):
            left = None if [*map(type, stated)] != [int, int] else left
        if left is None or right is None or left == right or not {left, right} <= _CAMERAS:
            found = ", ".join(f"{path or 'nothing'} {brief(value)}" for path, value in ends)
            self.problems.append(
                f"the primary pair must be a left and a right one of the cameras 0 to "
                f"{CAMERA_COUNT - 1}, as numbers or names that end in Cam_00, found {found}. Other "
                f'names: [primary_pair] left = "$.its.place#0" is the first number in one, # the '
                f"last"
            )
            return 0, 1
        return left, right

    def _baselines_cm(self) -> dict[Pair, float]:
        """Return each pair's baseline in cm.

        Those of pairs that are not recorded follow from those of neighbours, if these add up.
        """
        pairs = self._declared.pairs
        try:
            found = dict(self._rows(pairs if pairs.a else found_pairs(self.document, pairs)))
        except LookupError:
            row = (
                '[pairs] rows = "$.its.place[]", a = "...", b = "...", length = "...", unit = "cm"'
            )
            self._missing("the baseline of each pair of cameras", (pairs.rows,), row)
            return {}
        self._compare_gaps(found)
        lengths_cm = {pair: length.cm for pair, length in found.items()}
        lacking = ", ".join(f"{a}-{b}" for a, b in CAMERA_PAIRS if (a, b) not in found)
        if not lacking or self.problems:
            return lengths_cm
        added_cm = _added(found)
        if added_cm:
            told = f"the baselines of {lacking} are not recorded and were added up from the others"
            self.remarks.append(Remark("baselines", f"{self._where}: {told}"))
        else:
            self.problems.append(
                f"{pairs.rows} must have the baseline of each of the {len(CAMERA_PAIRS)} pairs of "
                f"cameras, and lacks {lacking}"
            )
        return added_cm | lengths_cm

    def _rows(self, at: PairsAt) -> Iterator[tuple[Pair, _Length]]:
        """Yield each recorded pair of cameras with its baseline.

        A row that does not have these is a problem, and one of gaps that need not be there is none.
        """
        known: dict[Pair, _Length] = {}
        for way, keys, row in entries_at(self.document, at.rows):
            try:
                pair, length = _row(at, row, keys, way)
            except _OddRow as odd:
                self.problems += [str(odd)] if at.is_needed else []
                continue
            if pair[0] == pair[1]:
                continue
            first = known.setdefault(pair, length)
            if first is length:
                yield pair, length
            elif at.is_needed:
                self._compare(pair, first, length)

    def _compare(self, pair: Pair, first: _Length, other: _Length) -> None:
        """Refuse a baseline that is recorded again with another value."""
        away_cm = abs(first.cm - other.cm) - _SAME * first.cm
        if away_cm > 0 and away_cm > first.rounding_cm + other.rounding_cm:
            self.problems.append(
                f"{other.path}: the baseline of cameras {pair[0]} and {pair[1]} is "
                f"{other.cm:.9g} cm here and {first.cm:.9g} cm at {first.path}. Correct the "
                f"wrong one"
            )

    def _compare_gaps(self, found: dict[Pair, _Length]) -> None:
        """Refuse gaps of neighbours that are not those of the pairs."""
        gaps = self._declared.gaps
        if gaps is None:
            return
        try:
            rows = [*self._rows(gaps)]
        except LookupError:
            if gaps.is_needed:
                self.problems.append(f"{gaps.rows} is missing, where gaps of neighbours stand")
            return
        for pair, length in rows:
            self._compare(pair, found.get(pair, length), length)


_CAMERAS: Final = frozenset(range(CAMERA_COUNT))
_SHARE: Final = 0.05
"""A point further off the centre by one share of both sides is the centre of another size."""


@functools.lru_cache(maxsize=256)  # thousands of files have the same keys
def _possible(places: tuple[str, ...], keys: frozenset[str]) -> tuple[str, ...]:
    """Return the places whose first key, or first two in the intrinsics, a file has."""

    def is_there(text: str) -> bool:
        way = [step for step in place_at(text).steps[:2] if isinstance(step, str)]
        way = way if way[:1] == ["camera_intrinsics"] else way[:1]
        return not way or ".".join(way) in keys

    return tuple(filter(is_there, places))


def _scale(at: NumberAt) -> float:
    """Return by how much a number becomes millimetres; others stay."""
    unit_m = UNITS_M.get(at.unit, 1e-3)
    return 1.0 if unit_m == 1e-3 else unit_m * 1000


def camera_named(value: object) -> int | None:
    """Return the camera that a number or a name stands for, None for other values.

    >>> camera_named("Town_scene_7_Cam_03"), camera_named(4), camera_named("left")
    (3, 4, None)
    """
    if type(value) is str:
        match = _CAMERA_NAME.search(value[-_NAME_READ:])
        return None if match is None else int(match[1])
    return value if type(value) is int else None


class _OddRow(Exception):
    """A row that has no pair of cameras with a baseline."""


def _row(at: PairsAt, row: Any, keys: str, way: tuple[str | int, ...]) -> tuple[Pair, _Length]:
    """Return the cameras of a row, in ascending order, and their baseline.

    Raises:
        _OddRow: If it does not have them.
    """
    try:
        if at is BUILT_IN.pairs or at is BUILT_IN.gaps:  # the paper's example compares numbers
            a, b, stated = row[at.a], row[at.b], row[at.length]
            if not type(a) is type(b) is int:  # 0.0 is camera 0 there
                a, b = (int(each) if is_number(each) and each == int(each) else None
                        for each in (a, b))  # fmt: skip
        else:
            a, b = _camera_of_row(row, keys, at.a, 0), _camera_of_row(row, keys, at.b, 1)
            stated = value_at(row, at.length) if at.length else row
    except LookupError as error:
        raise _OddRow(f"{path_to(way)}: has no {error.args[0]}; it is {brief(row)}") from error
    except TypeError as error:
        keys = ", ".join((at.a, at.b, at.length))
        raise _OddRow(f"{path_to(way)}: must have the keys {keys}; it is {brief(row)}") from error
    if a is None or b is None or not 0 <= a - at.first < CAMERA_COUNT > b - at.first >= 0:
        raise _OddRow(
            f"{path_to(way)}: is of cameras {a} and {b}, and the rig has cameras {at.first} to "
            f"{CAMERA_COUNT - 1 + at.first}"
        )
    length = _Length(way, at.length, stated, UNITS_M[at.unit] * 100)
    if a != b and not (is_number(stated) and stated > 0):
        raise _OddRow(f"{length.path}: must be a number above zero, found {brief(stated)}")
    return (a - at.first, b - at.first) if a < b else (b - at.first, a - at.first), length


def _camera_of_row(row: Any, keys: str, at: str, number: int) -> int | None:
    """Return the camera that a row names at a place below it.

    Raises:
        LookupError: If nothing stands there.
    """
    if at == "order":
        return numbers_in(keys)[-1] + number
    if at.startswith("#"):
        return numbers_in(keys)[int(at[1:] or -1)]
    return camera_named(value_at(row, at))


def found_pairs(document: dict[str, Any], pairs: PairsAt) -> PairsAt:
    """Return where baselines stand below a list or an object, by what its first row has.

    A row is an object with two cameras and one other number, or with the printed keys; a list of
    these three; or a length, whose cameras are in its key, or which is of neighbours.

    Raises:
        LookupError: If there are no such rows.
    """
    holder = value_at(document, pairs.rows)
    axis = "{}" if isinstance(holder, dict) else "[]"
    rows = f"{pairs.rows}{axis}"
    first = next((row for _, _, row in entries_at(document, rows)), None)
    printed = BUILT_IN.pairs
    if isinstance(first, dict) and {printed.a, printed.b, printed.length} <= first.keys():
        names = [printed.a, printed.b, printed.length]
    elif isinstance(first, dict):
        names = _row_keys(first, in_key=axis == "{}")
    elif isinstance(first, list) and len(first) == 3:
        names = ["[0]", "[1]", "[2]"]
    elif is_number(first):
        names = ["#0", "#1", ""] if axis == "{}" else ["order", "order", ""]
    else:
        names = []
    if len(names) != 3:
        keys = f"; the keys here are: {listed_keys(first)}" if isinstance(first, dict) else ""
        raise SchemaError(
            f"{rows} does not tell which two values are cameras and which is their baseline{keys}. "
            f"Say it in a file of conventions of format 2, below [pairs]: a, b and length"
        )
    a, b, length = names
    own_unit = without_unit(words(length))[1]
    unit = pairs.unit or (own_unit if own_unit in UNITS_M else "cm")
    return PairsAt(rows=rows, a=a, b=b, length=length, unit=unit)


def _row_keys(row: dict[str, Any], *, in_key: bool) -> list[str]:
    """Return the keys of the two cameras and of the only other number of a row."""
    plain = {key: value for key, value in row.items() if re.fullmatch(r"[A-Za-z_][\w-]*", key)}
    lengths = [key for key, value in plain.items() if is_number(value)
               and re.search(r"baseline|distance|length|separation", words(key))]  # fmt: skip
    cameras = [key for key, value in plain.items()
               if key not in lengths and camera_named(value) in _CAMERAS]  # fmt: skip
    if len(cameras) > 2:
        named = [
            key for key in cameras if re.search(r"cam|index|\A[abij]\Z|left|right", words(key))
        ]
        cameras = named if len(named) == 2 else cameras
    others = lengths or [key for key, value in plain.items()
                         if key not in cameras and is_number(value)]  # fmt: skip
    if in_key and not cameras:
        return ["#0", "#1", *others] if len(others) == 1 else []
    return [*cameras, *others] if len(cameras) == 2 and len(others) == 1 else []


def _added(found: dict[Pair, _Length]) -> dict[Pair, float]:
    """Return all 15 baselines where those of neighbours are known and add up to the others."""
    if not set(ADJACENT_PAIRS) <= found.keys():
        return {}
    gaps = [found[pair] for pair in ADJACENT_PAIRS]
    places_cm = [0.0, *itertools.accumulate(gap.cm for gap in gaps)]
    rounding_cm = sum(gap.rounding_cm for gap in gaps)
    added_cm = {(a, b): places_cm[b] - places_cm[a] for a, b in CAMERA_PAIRS}
    are_same = (abs(added_cm[pair] - each.cm) <= rounding_cm + each.rounding_cm
                for pair, each in found.items())  # fmt: skip
    return added_cm if all(are_same) else {}
