"""Metadata files to typed records: scene keys, ``baseline.json``, markers and descriptions.

A file is read in tiers. What every sample needs (focal length, sensor width, baselines, which
camera is left) must be there and be understood: `SchemaError` lists everything else that is wrong.
What only some fields need, or none (principal point, labels, captions), becomes a `Remark`.
"""

import functools
import itertools
import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.conventions import (
    NUMBERS,
    At,
    Shape,
    keys_of,
    place_of,
    value_stated,
)
from stereogenbench_data.schema.document import (
    MOST_LETTERS,
    brief,
    camera_of,
    child_path,
    is_number,
    listed_keys,
    parse_object,
    parse_text,
)
from stereogenbench_data.schema.quantities import (
    NAMES,
    SPEAKS_OF_PAIRS,
    UNITS_M,
    Stated,
    Values,
    as_stated,
    is_below,
    named_unit_m,
    steps_of,
    without_unit,
    words,
)
from stereogenbench_data.schema.records import Remark, Rig, SceneId, SceneLabels
from stereogenbench_data.schema.release import (
    ADJACENT_CM,
    ADJACENT_PAIRS,
    BASELINE_JSON,
    CAMERA_COUNT,
    CAMERA_PAIRS,
    IMAGE_SIZE_PX,
    SENSOR_MM,
    subset_of_folder,
)
from stereogenbench_data.schema.text import counted, shortened

_FOLDER: Final = re.compile(r"[!-\-0-\[\]-~](?:[ -\-0-\[\]-~]*[!-\-0-\[\]-~])?\Z")
"""Printable ASCII without dot, slash and backslash, and without a space at either end."""

_KEY_SHOWN: Final = 300
_SHOWN: Final = 20
_PRINCIPAL: Final = re.compile(
    r"principal|optical_cent|(?:lens|sensor|film|filmback)_(?:shift|offset)|(?:\A|_)shift_[xy]|"
    r"(?:\A|_)(?:c|center|centre)_?[xy](?:_|\Z)"
)
"""Names of principal points, with the key above, whatever follows them."""
_CENTRE_PX: Final = 1.0
"""How far a principal point may be from the image's centre to be that centre: conventions of pixels
differ by a half, and centres are written as whole pixels."""

_SHARE: Final = 0.05
"""A point further off the centre by one share of both sides is the centre of another size."""
_NAMES_A_CAMERA: Final = re.compile(
    r"cam|left|right|index|\A[abij]\Z|_[abij12]\Z|src|dst|from|to\Z"
)

_FLOAT32: Final = 1e-6

Pair = tuple[int, int]
_NO_LENGTH: Final = "baseline_cm is missing"


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


class MetadataFile:
    """A JSON file of a scene: the values in it, and what is odd about them.

    Attributes:
        where: The file's path, for messages.
        content: Its bytes.
        document: The JSON object that these are.
        values: The values in it by quantity.
        problems: What stops a sample, in full sentences but for the last full stop.
        remarks: What only concerns some fields, or none.
    """

    def __init__(self, text: bytes, *, where: str, shape: Shape | None = None) -> None:
        """Parse a file.

        Raises:
            SchemaError: If it is not a JSON object, or lacks a place that conventions state.
        """
        self.where, self.content = where, text
        self.document = parse_object(text, where=where)
        self.is_stated, self.shape = shape is not None, shape or Shape()
        known = self.shape.known(self.document, where=where)
        self.values = Values(self.document, known=known, ignored=self.shape.ignored)
        self.problems: list[str] = []
        self.remarks: list[Remark] = []

    def remark(self, about: str, text: str) -> None:
        """Note what is odd, with the file's path in front."""
        self.remarks.append(Remark(about, f"{self.where}: {text}"))

    def labels(self) -> SceneLabels:
        """Return the identifiers in the file; one that is not of its kind is left out."""
        names = ("scene_label", "map_name", "map_path", "character", "animation")
        stops = (each.value for each in self.values.numbers("aperture_fstop") if each.value > 0)
        indices = (
            int(each.value)
            for each in self.values.stated("scene_index")
            if type(each.value) in (int, str) and re.fullmatch(r"[0-9]{1,15}", str(each.value))
        )
        return SceneLabels(
            **{name: self.text(name, about="labels") for name in names},
            scene_index=next(indices, None),
            aperture_fstop=next(map(float, stops), None),
        )

    def text(self, quantity: str, *, about: str) -> str | None:
        """Return a text that can be written as UTF-8, None where there is none."""
        odd = None
        for each in self.values.stated(quantity):
            value = each.value
            if isinstance(value, str) and len(value) <= MOST_LETTERS:
                if not any("\ud800" <= letter <= "\udfff" for letter in value):
                    return value
            elif isinstance(value, dict | list):
                continue
            odd = odd or f"{each.path}: must be a text, found {brief(value)}"
        if odd is not None:
            self.remark(about, odd)
        return None


def parse_complete(text: bytes, *, where: str) -> tuple[SceneLabels, tuple[Remark, ...]]:
    """Return the identifiers in a ``_scene_complete.json``, the marker of a finished scene.

    Whatever it holds, the scene is finished; what is not understood is left out with a remark.

    Source: the paper's appendix on the file schema.
    """
    try:
        file = MetadataFile(text, where=where)
    except SchemaError as error:
        return SceneLabels(), (Remark("labels", str(error)),)
    return file.labels(), tuple(file.remarks)


def parse_caption(text: bytes, *, where: str) -> tuple[str, tuple[Remark, ...]]:
    """Return the caption in a scene's description: the detailed one, else the short one, else "".

    A file with the suffix .txt is the caption. What is not understood is left out with a remark: no
    picture depends on it.

    Source: the paper's appendix on the file schema.
    """
    try:
        if where.endswith(".txt"):
            text = json.dumps({"caption": parse_text(text, where=where).strip()}).encode()
        file = MetadataFile(text, where=where)
    except SchemaError as error:
        return "", (Remark("caption", str(error)),)
    written = [file.text(name, about="caption") for name in ("detailed_caption", "short_caption")]
    return next(filter(None, written), ""), tuple(file.remarks)


def parse_rig(
    text: bytes,
    *,
    where: str,
    shape: Shape | None = None,
    size_px: Pair | None = None,
    counts: Mapping[str, int | None] = MappingProxyType({}),
) -> tuple[Rig, SceneLabels, tuple[Remark, ...]]:
    """Return the rig and the identifiers that a ``baseline.json`` records, and what is odd.

    Without an image size, that of the videos is taken, or else the release's 1280 x 1280
    (``image_size_source`` says so).
    Without a sensor height, pixels are square, as in the paper's loading example. A principal
    point is in pixels of the recorded image, with the centre of the top-left pixel at (0.5, 0.5);
    one within a pixel of the centre is the centre. A value that is stated again and agrees within
    the digits that are written is the same value.

    Args:
        text: The file's bytes.
        where: The file's path, for messages.
        shape: What conventions state about such files.
        size_px: (width, height) of the videos, where these were opened.
        counts: The numbers of "cameras" and "frames", for a remark on others.

    Raises:
        SchemaError: If focal length, sensor width, a baseline or the primary pair is missing, not
            understood or stated twice with other values, or the conventions are contradicted; the
            message lists every problem.

    Source: the paper's appendix on the file schema.
    """
    file = _RigFile(text, where=where, shape=shape)
    rig, labels = file.rig(size_px), file.labels()
    if file.problems:
        listed = file.problems[:_SHOWN]
        if len(file.problems) > _SHOWN:
            listed.append(f"and {len(file.problems) - _SHOWN} more")
        head = counted(len(file.problems), "problem")
        raise SchemaError(f"{where}: {head}:\n  " + ".\n  ".join(listed) + ".")
    return rig, labels, (*file.remarks, *_counted_otherwise(file.values, counts, where=where))


def _counted_otherwise(
    values: Values, known: Mapping[str, int | None], *, where: str
) -> tuple[Remark, ...]:
    """Return which numbers of frames, cameras or pixels a file states that are not the known ones.

    An animation's number of frames is its own.
    """
    odd = [
        f"{each.path} states {quantity.replace('_', ' ')} {brief(each.value)}, not {count}"
        for quantity, count in known.items()
        for each in values.numbers(quantity)
        if count not in (None, each.value) and "anim" not in each.path.lower()
    ]
    return (Remark("stated", f"{where}: {'; '.join(odd)}"),) if odd else ()


def contradictions(
    head: dict[str, Any], rig: Rig, labels: SceneLabels, *, where: str, frames: int | None = None
) -> tuple[Remark, ...]:
    """Return what another file of a scene states otherwise of lens, baselines, pair and labels.

    Args:
        head: That file's JSON object; of long lists, such as frames, some elements are enough.
        rig: What ``baseline.json`` and the videos say.
        labels: What ``baseline.json`` says.
        where: The other file's path, for messages.
        frames: The number of frames of the videos, None where another may be right.
    """
    own = {
        "focal_length_mm": rig.focal_mm,
        "sensor_width_mm": rig.sensor_width_mm,
        "sensor_height_mm": rig.sensor_height_mm,
        "pairs": [[*pair, cm] for pair, cm in zip(CAMERA_PAIRS, rig.baselines_cm, strict=True)],
        "unit": "cm",
    }
    other = {key: value for key, value in head.items() if "primary" not in words(key)}
    file = _RigFile(json.dumps({"rig": own, "other": other}).encode(), where=where)
    width, height = rig.recorded_size_px or (rig.image_width_px, rig.image_height_px)
    file.rig((width, height))
    found = [_OWN.sub(BASELINE_JSON, each).replace("$.other", "$") for each in file.problems
             if _OWN.search(each) or "in mm mean" in each]  # fmt: skip
    told = [Remark("left", f"{where}: {'; '.join(found)}. {_UNREAD}")] if found else []
    named = Values({key: value for key, value in head.items() if "pair" in words(key)})
    for each in named.stated("primary_pair"):
        left, right = named_pair(each.value) or rig.primary_pair
        if rig.primary_pair not in ((left, right), (left - 1, right - 1)):
            states = f"{where}: {each.path} states cameras {left} and {right}"
            told.append(Remark("pair", f"{states}. The primary pair of {BASELINE_JSON} counts"))
    values = Values(head)
    known = {
        "cameras": CAMERA_COUNT,
        "frames": frames,
        "image_width": width,
        "image_height": height,
    }
    told += _counted_otherwise(values, known, where=where)
    for name in ("scene_label", "scene_index", "map_name", "map_path", "character", "animation"):
        label = getattr(labels, name)
        for each in values.stated(name):
            if each.plain == name and label is not None and each.value not in (label, str(label)):
                states = f"{where}: {each.path} states {brief(each.value)}, and {BASELINE_JSON}"
                told.append(Remark("stated", f"{states} {brief(label)}"))
    return tuple(told)


_UNREAD: Final = 'Or read no poses: form = "unknown" below [poses] in a file of conventions.'
_OWN: Final = re.compile(r"\$\.rig(?:\.\w+)+(?:\[\d+\])*")


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
    low_cm, high_cm = ADJACENT_CM.get(family, (0.0, math.inf))
    adjacent_cm = [rig.baseline_cm(a, b) for a, b in ADJACENT_PAIRS]
    least_cm, most_cm = min(adjacent_cm), max(adjacent_cm)
    if is_of_family(rig, family):
        return ()
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
_LEAST_MM, _MOST_MM = 4.0, 150.0
"""Lengths of cameras whose unit is not written: the release's lenses have 18 to 85 mm."""
_FOCAL_LENGTHS: Final = (0.4, 6.0)
"""Focal lengths in widths of the sensor that conventions may mean: the release has 0.76 to 3.6."""
_LENSES: Final = (0.04, 60.0)
"""Focal lengths in widths of the sensor that files may mean: 171 degrees to one."""
_LENS_MODELS: Final = re.compile(
    r"distort|camera_model|lens_model|projection_type|overscan|squeeze|anamorph|\Ak[123]\Z"
)
_ODD_LENS: Final = re.compile(r"fisheye|ortho|equi|brown|spheri|panoram|kannala|distort|anamorph")
_RATIO: Final = 1e-3
"""How far a field of view may be from focal length over sensor width: it is often rounded."""


@dataclass(slots=True)
class _Length:
    """A recorded baseline: its cameras as they are written, in cm, and where it stands.

    ``is_by_place`` says that its cameras follow from its place in a list, and count from 0.
    """

    cameras: Pair
    cm: float
    stated: Stated
    is_by_place: bool = False

    @property
    def rounding_cm(self) -> float:
        """Half of the last digit that is written."""
        return self.cm / abs(self.stated.value) * self.stated.rounding if self.stated.value else 0.0


class _RigFile(MetadataFile):
    """A ``baseline.json``, of which each quantity is looked for."""

    def rig(self, size_px: Pair | None = None) -> Rig:
        """Return the rig; what it lacks is a problem."""
        baselines_cm = self._baselines_cm()
        width, height = self._side("image_width"), self._side("image_height")
        like_px = size_px or (IMAGE_SIZE_PX, IMAGE_SIZE_PX)
        width_px, height_px = width or like_px[0], height or width or like_px[1]
        known_px = width if size_px is None else width_px
        focal_mm, sensor_width_mm = self._lens(width_px=known_px, aspect=width_px / height_px)
        sensor_height_mm = self._length_mm("sensor_height")
        fit = {words(str(each.value)) for each in self.values.stated("sensor_fit")}
        if "vertical" in fit and sensor_height_mm:
            # Blender's pixels are square, and the height counts.
            sensor_width_mm = sensor_height_mm * width_px / height_px
        elif "horizontal" in fit or ("auto" in fit and width_px >= height_px):
            sensor_height_mm = sensor_width_mm * height_px / width_px
        odd = [node.path for node in self.values.nodes
               if _LENS_MODELS.search(node.name) and _is_lens_model(node.value)]  # fmt: skip
        if odd:
            self.remark("lens", f"{', '.join(odd[:3])}: a pinhole lens is assumed all the same")
        for each in self.values.positive("focal_y_px"):
            sensor_height_mm = sensor_height_mm or focal_mm * height_px / each.value
        return Rig(
            focal_mm=focal_mm,
            sensor_width_mm=sensor_width_mm,
            sensor_height_mm=sensor_height_mm or sensor_width_mm * height_px / width_px,
            image_width_px=width_px,
            image_height_px=height_px,
            principal_point_px=self._principal_point(width_px, height_px),
            baselines_cm=tuple(baselines_cm.get(pair, math.nan) for pair in CAMERA_PAIRS),
            primary_pair=self._primary_pair(),
            image_size_source="default" if width is None and height is None else "recorded",
        )

    @property
    def _cure(self) -> str:
        more = ", or list its place as 'ignored' in the conventions" if self.is_stated else ""
        return f"Remove the wrong one{more}"

    @property
    def _keys(self) -> str:
        inner = self.document.get("camera_intrinsics")
        inner = inner if isinstance(inner, dict) else {}
        return listed_keys([*self.document, *(f"camera_intrinsics.{key}" for key in inner)])

    def _conflict(self, what: str, first: Stated, other: Stated) -> None:
        again, known = (f"{brief(each.value)} {each.unit}".rstrip() for each in (other, first))
        self.problems.append(
            f"{other.path}: states another {what} ({again}) than {first.path} ({known}). "
            f"{self._cure}"
        )

    def _side(self, quantity: str) -> int | None:
        """Return a side of the recorded image in pixels, None where it has none."""
        values = (float(each.value) for each in self.values.positive(quantity))
        return next((int(each) for each in values if each.is_integer()), None)

    def _length_mm(self, quantity: str) -> float:
        """Return a length of the camera in mm, the unit of cameras; 0 where there is none."""
        found: Stated | None = None
        length_mm, odd = 0.0, ""
        for each in self.values.stated(quantity):
            scale_mm = UNITS_M.get(each.unit or "mm", math.nan) * 1000
            if math.isnan(scale_mm) or isinstance(each.value, dict | list):
                continue
            again_mm = each.value * scale_mm if is_number(each.value) else 0.0
            if again_mm <= 0:
                odd = f"{each.path}: must be a number above zero, found {brief(each.value)}"
            elif not each.unit and not _LEAST_MM <= again_mm <= _MOST_MM:
                shown = brief(each.value)
                odd = f"{each.path}: {shown} is no length in mm of a camera: name its unit"
            elif found is None:
                found, length_mm = each, again_mm
            elif abs(again_mm - length_mm) > each.rounding * scale_mm + found.rounding:
                self._conflict(quantity.replace("_", " "), found, each)
        if odd and found is None:
            self.problems.append(odd)
        return length_mm

    def _lens(self, *, width_px: int | None, aspect: float) -> tuple[float, float]:
        """Return focal length and sensor width in mm.

        One of them may follow from a field of view, or a focal length in pixels, which must agree
        where both are there. Where neither is recorded, the sensor is that of the release.
        """
        focal_mm, sensor_mm = self._length_mm("focal"), self._length_mm("sensor_width")
        ratios = list(self._focal_ratios(width_px, aspect))
        if ratios and not self.problems:
            if not (focal_mm or sensor_mm):
                sensor_mm = SENSOR_MM
                told = f"has no sensor width; that of the release is assumed, {SENSOR_MM} mm"
                self.remark("sensor", told)
            sensor_mm = sensor_mm or focal_mm / ratios[0][1]
            focal_mm = focal_mm or sensor_mm * ratios[0][1]
        for each, ratio in ratios:
            allowed = (_RATIO + each.rounding / each.value) * ratio
            if focal_mm and sensor_mm and abs(focal_mm / sensor_mm - ratio) > allowed:
                self.problems.append(
                    f"{each.path}: {brief(each.value)} means {ratio:.6g} focal lengths a sensor "
                    f"width, and focal length and sensor width in mm mean "
                    f"{focal_mm / sensor_mm:.6g}. {self._cure}"
                )
        for name, length_mm in (("focal_length_mm", focal_mm), ("sensor_width_mm", sensor_mm)):
            if not length_mm and not any(name[:5] in problem for problem in self.problems):
                missing = f"$.camera_intrinsics.{name} is missing; the keys are: {self._keys}"
                self.problems.append(missing)
        low, high = _FOCAL_LENGTHS if self.is_stated else _LENSES
        if focal_mm and sensor_mm and not low <= focal_mm / sensor_mm <= high:
            self.problems.append(
                f"a focal length of {focal_mm:.6g} mm on a sensor {sensor_mm:.6g} mm wide is "
                f"{focal_mm / sensor_mm:.3g} widths of the sensor, and lenses have {low:g} to "
                f"{high:g}. Correct its unit or its place"
            )
        return focal_mm or 1.0, sensor_mm or 1.0

    def _focal_ratios(self, width_px: int | None, aspect: float) -> Iterator[tuple[Stated, float]]:
        """Yield the focal lengths a sensor width that follow from fields of view and pixels.

        An angle of the height counts only where pixels may be taken to be square.
        """
        for quantity, scale in (("fov", 1.0), ("fov_y", aspect)):
            for each in self.values.numbers(quantity):
                is_rad = each.unit.startswith("rad") or (not each.unit and each.value < math.pi)
                angle = each.value if is_rad else math.radians(each.value)
                if 0 < angle < math.pi:
                    yield each, 0.5 / math.tan(angle / 2) / scale
        for each in self.values.positive("focal_px") if width_px else ():
            if each.unit.startswith("p") or each.path.lower().endswith("x"):
                yield each, each.value / (width_px or 1)

    def _principal_point(self, *size_px: int) -> tuple[float, float] | None:
        """Return the principal point in pixels; None where it is the centre or not known."""
        points = [[each for each in self.values.stated(quantity) if "cent" not in str(each.value)]
                  for quantity in ("principal_x", "principal_y")]  # fmt: skip
        read = [each.path for found in points for each in found]
        odd = [f"{node.path} {brief(node.value)}" for node in self.values.nodes
               if _PRINCIPAL.search(f"{node.parent}_{node.name}"
                                    if is_number(node.value) else node.name)
               and not isinstance(node.value, dict)
               and not any(path.startswith(node.path) for path in read)
               and node.value not in (0, [0, 0], [0.5, 0.5])
               and "cent" not in str(node.value)]  # fmt: skip
        if odd:
            self.remark("principal point", f"a principal point is not understood: {odd[0]}")
        if not any(points):
            return None
        usable = [[each for each in found if is_number(each.value)] for found in points]
        x, y = (found[0].value / side_px if found else 0.5
                for found, side_px in zip(usable, size_px, strict=True))  # fmt: skip
        if self.values.positive("focal_px") and x > 0.01 and abs(x - y) < _SHARE < abs(x - 0.5):
            self.problems.append(
                f"{points[0][0].path}: by its principal point it is of other pictures than these, "
                f"of {size_px[0]}x{size_px[1]}. State their size as image_width and image_height"
            )
        x_px, y_px = map(self._along, usable, size_px)
        if x_px is None or y_px is None:
            unread = points[0 if x_px is None else 1]
            shown = ", ".join(f"{each.path} {brief(each.value)}" for each in unread) or "one side"
            told = f"the principal point is not understood ({shown}): it must be x and y in pixels"
            told = f"{told} inside a picture of {size_px[0]}x{size_px[1]}"
            self.remark("principal point", told)
            return None
        is_centre = abs(x_px - size_px[0] / 2) <= _CENTRE_PX >= abs(y_px - size_px[1] / 2)
        return None if is_centre else (x_px, y_px)

    def _along(self, found: list[Stated], side_px: int) -> float | None:
        """Return where along a side a principal point is, in pixels; None if not understood."""
        if not found:
            return None
        first, *more = found
        if abs(first.value - 0.5) < 1e-3:
            return side_px / 2  # a share of the side
        if not 1 < first.value < side_px:
            return None
        for each in more if self.is_stated else ():
            if abs(each.value - first.value) > each.rounding + first.rounding:
                self._conflict("principal point", first, each)
        return float(first.value)

    def _primary_pair(self) -> Pair:
        pairs: list[tuple[Stated, Pair]] = []
        odd: list[str] = []
        stated = self.values.stated("primary_pair")
        at = self.shape.at.get("primary_pair")
        if at is not None:
            ends = [value_stated(self.document, path, "primary_pair", where=self.where)
                    for path in (at.left, at.right)]  # fmt: skip
            stated = [Stated(ends, "", f"{at.left} and {at.right}"), *stated]
        first_number = _first_number(self.lengths)
        # Names may count from 0 beside numbers from 1.
        names = re.findall(rb'(?i)"([^"]*cam[^"]*)"', self.content if first_number else b"")
        names_camera_0 = any(camera_of(name.decode(errors="replace")) == 0 for name in names)
        for each in stated:
            left, right = named_pair(each.value) or (0, 0)
            if first_number and not (isinstance(each.value, dict) and names_camera_0):
                left, right = left - 1, right - 1
            if left == right or not {left, right} <= set(range(CAMERA_COUNT)):
                shown = shortened(json.dumps(each.value), 100)
                odd.append(
                    f"{each.path}: must be {{left_camera, right_camera}} or a list of two of the "
                    f"cameras 0 to {CAMERA_COUNT - 1}, found {shown}"
                )
                continue
            if pairs and pairs[0][1] != (left, right):
                self._conflict("primary pair", pairs[0][0], each)
            pairs.append((each, (left, right)))
        if pairs and not (at is not None and odd):
            return pairs[0][1]
        self.problems += odd
        if not odd:
            self.remark(
                "primary pair",
                f"has no primary_stereo_pair, so cameras are taken to be numbered from left to "
                f"right, as in the release; the keys are: {self._keys}",
            )
        return 0, 1

    def _baselines_cm(self) -> dict[Pair, float]:
        """Return each pair's baseline in cm.

        Those of pairs that are not recorded follow from the others, if these lie on a line.
        """
        first_number = _first_number(self.lengths)
        best: dict[Pair, _Length] = {}
        for each in self.lengths:
            first = 0 if each.is_by_place else first_number
            pair = min(each.cameras) - first, max(each.cameras) - first
            if pair not in CAMERA_PAIRS:
                self.problems.append(
                    f"{each.stated.path}: is of cameras {each.cameras[0]} and {each.cameras[1]}, "
                    f"and the rig has cameras 0 to {CAMERA_COUNT - 1}"
                )
                continue
            known = best.setdefault(pair, each)
            away_cm, least_cm = abs(each.cm - known.cm), _FLOAT32 * known.cm
            if away_cm > max(each.rounding_cm + known.rounding_cm, least_cm):
                self.problems.append(
                    f"{each.stated.path}: the baseline of cameras {pair[0]} and {pair[1]} is "
                    f"{each.cm:.9g} cm here and {known.cm:.9g} cm at {known.stated.path}. "
                    f"{self._cure}"
                )
            elif away_cm > least_cm and each.rounding_cm < known.rounding_cm:
                best[pair] = each
        listed = ", ".join(f"{a}-{b}" for a, b in CAMERA_PAIRS if (a, b) not in best)
        added_cm = _completed(best) if listed else {}
        if listed and not added_cm:
            self.problems.append(
                f"$.pairwise_pairs must have the baseline of each of the {len(CAMERA_PAIRS)} "
                f"camera pairs, and lacks {listed}; the keys are: {self._keys}"
            )
        elif listed:
            told = f"the baselines of {listed} are not recorded and were added up from the others"
            self.remark("baselines", told)
        return added_cm | {pair: each.cm for pair, each in best.items()}

    @functools.cached_property
    def lengths(self) -> list[_Length]:
        """The baselines of pairs that the file records, those of the paper's key first."""
        self._found: list[_Length] = []
        unit_m = self.values.length_unit_m or 0.01
        at = self.shape.at.get("baselines", At())
        if at.place is not None:
            unit_m = UNITS_M.get(at.unit or "", unit_m)
            value = value_stated(self.document, at.place, "baselines", where=self.where)
            name = f"baselines_{words(at.place.rpartition('.')[2])}"
            self._look_below(value, name, at.place, unit_m)
            if not any(math.isclose(each.cm / each.stated.value, unit_m * 100)
                       for each in self._found):  # fmt: skip
                self.problems.append(
                    f"{at.place}: by the conventions baselines in "
                    f"{at.unit or 'the unit of the file'} stand here, and "
                    f"{brief(value)} has none. Correct the place or the unit"
                )
        for key in sorted(self.document, key=lambda key: key != "pairwise_pairs"):
            self._look_below(self.document[key], words(key), child_path("$", key), unit_m)
        for node in () if self._found else self.values.nodes:
            places = _places_of(node.value) if _PLACES.search(node.plain) else None
            if places is not None:
                own_m = UNITS_M.get(node.unit, unit_m)
                for a, b in CAMERA_PAIRS:
                    length = math.dist(places[a], places[b])
                    self._add((a, b), length, own_m, node.path, is_by_place=True)
                break
        return self._found

    def _look_below(self, value: Any, name: str, path: str, unit_m: float) -> None:
        """Add the baselines in a value below a key that speaks of pairs or baselines.

        Pairs are objects with two cameras and a length, keys such as "0-1" with a length, lists of
        two cameras and a length, tables, or lists of five lengths of neighbours.

        Args:
            value: The value.
            name: Its keys in words.
            path: Its JSON path.
            unit_m: Metres in the unit of lengths whose keys name none.
        """
        waiting: list[tuple[Any, str, str, int | None, float]] = [(value, name, path, None, unit_m)]
        for node, words_, place, row, above_m in waiting:
            if "primary" in words_ or not isinstance(node, dict | list):
                continue
            is_of_pairs = SPEAKS_OF_PAIRS.search(words_) is not None
            inner_m = _unit_below(node, above_m)
            own_m = UNITS_M.get(without_unit(words_)[1], inner_m)
            if is_of_pairs and isinstance(node, dict) and _are_columns(node):
                rows = zip(*node.values(), strict=True)
                node = [dict(zip(node, row, strict=True)) for row in rows]
            cameras = _cameras_of(node) if is_of_pairs else None
            if cameras is not None:
                length = node if isinstance(node, dict) else node[2]
                self._add_pair(cameras, length, own_m, place)
            elif (ends_of := self._ends_of(node, words_)) is not None:
                for number, (ends, each) in enumerate(zip(ends_of, node, strict=True)):
                    self._add(ends, each, own_m, child_path(place, number), is_by_place=True)
            elif is_of_pairs or isinstance(node, dict):
                for key, inner in node.items() if isinstance(node, dict) else enumerate(node):
                    own, at = words(str(key)), child_path(place, key)
                    named = _pair_of(own) if isinstance(key, str) else None
                    camera = (
                        int(own) if own.isdigit() else camera_of(key) if named is None else None
                    )
                    pair = named if row is None or camera is None else (row, camera)
                    if is_of_pairs and pair is not None:
                        self._add_pair(pair, inner, own_m, at)
                        continue
                    is_row = camera is not None and _is_row(inner, of=node)
                    longer = words_ if isinstance(key, int) or is_row else f"{words_}_{own}"
                    waiting.append((inner, longer, at, camera if is_row else None, inner_m))

    def _ends_of(self, value: Any, name: str) -> tuple[Pair, ...] | None:
        """Return whose baselines a list of numbers has: of neighbours, or of all pairs."""
        is_spacing = "spacing" in name and not self._found and not _FIGURES.search(name)
        if ("adjacent" in name or is_spacing) and _are_numbers(value, len(ADJACENT_PAIRS)):
            return ADJACENT_PAIRS
        is_of_all = "baseline" in name and _are_numbers(value, len(CAMERA_PAIRS))
        return CAMERA_PAIRS if is_of_all and not _FIGURES.search(name) else None

    def _add_pair(self, cameras: Pair, value: Any, unit_m: float, path: str) -> None:
        """Add the baseline that a value is, or those of an entry, in one unit or in several."""
        if cameras[0] == cameras[1]:
            return
        if not isinstance(value, dict):
            self._add(cameras, value, unit_m, path)
            return
        names = {key: words(key) for key in value}
        keys = [key for key, name in names.items() if "length" in _roles(name)]
        if not keys and is_below(path, [self.shape.at.get("baselines", At()).place or ""]):
            # Where conventions say that baselines stand, the only number beside cameras is one.
            others = [key for key in value if is_number(value[key]) and not _roles(names[key])]
            keys = others if len(others) == 1 else []
        if not keys and not any(_NO_LENGTH in problem for problem in self.problems):
            listed = ", ".join(sorted(value))
            self.problems.append(f"{path}: {_NO_LENGTH}; the keys here are: {listed}")
        unit_m = _unit_below(value, unit_m)
        for key in keys:
            unit = names[key] if names[key] in UNITS_M else without_unit(names[key])[1]
            is_inner = isinstance(value[key], dict) and "value" not in value[key]
            if not is_inner and not isinstance(value[key], list) and unit in ("", *UNITS_M):
                at = child_path(path, key)
                self._add(cameras, value[key], UNITS_M.get(unit, unit_m), at)

    def _add(
        self, cameras: Pair, value: object, unit_m: float, path: str, *, is_by_place: bool = False
    ) -> None:
        found = as_stated(Stated(value, "", path))
        length = found.value
        if is_number(length) and cameras[0] > cameras[1]:
            length = abs(length)  # from the camera with the higher number it may be signed
        if is_below(path, self.shape.ignored):
            return
        if not (is_number(length) and length > 0):
            told = f"must be a number above zero, found {brief(found.value)}"
            self.problems.append(f"{path}: {told}")
            return
        cm = float(length) * (UNITS_M.get(found.unit, unit_m) / 0.01)
        self._found.append(_Length(cameras, cm, found, is_by_place))
        if math.isnan(cm):
            self.problems.append(f"{path}: is in a unit of length that is not known: correct it")


_PLACES: Final = re.compile(r"offset|lateral|along|(?:camera|rig)_(?:position|place|cent[er])")
_FIGURES: Final = re.compile(
    r"target|request|nominal|desired|min|max|mean|std|range|count|error|focal|times"
)
"""Words of lengths beside two cameras that are not their baseline."""


@functools.lru_cache(maxsize=4096)
def _roles(name: str) -> frozenset[str]:
    """Return what a key in an entry of a pair may name.

    >>> [*_roles("baseline_cm"), *_roles("target_baseline"), *_roles("camera_index_a")]
    ['length', 'figure', 'camera']
    """
    if name in UNITS_M or re.search(
        r"baseline|distance|length|count|separation|delta|\Avalue\Z", name
    ):
        is_length = name in UNITS_M or re.search(
            r"(?:baseline|distance|separation|length|value)\Z", without_unit(name)[0]
        )
        return frozenset({"length" if is_length and not _FIGURES.search(name) else "figure"})
    found = {"pair"} if re.search(r"pair|key|id|name", name) else set()
    if "pair" not in name and _NAMES_A_CAMERA.search(name):
        found.add("camera")
    return frozenset(found)


def _cameras_of(entry: dict[str, Any] | list[Any]) -> Pair | None:
    """Return the two cameras that an entry names, None where it does not name two."""
    by_number: list[int] = []
    by_name: list[int] = []
    if isinstance(entry, list):
        is_triple = len(entry) == 3 and all(type(each) is int for each in entry[:2])
        by_number = entry[:2] if is_triple and {*entry[:2]} <= {*range(CAMERA_COUNT + 1)} else []
        entry = {}
    is_table = sum(camera_of(key) is not None for key in entry) > 2
    for key, value in entry.items() if not is_table else ():
        roles = _roles(words(key))
        pair = _pair_of(value) if isinstance(value, str) and "pair" in roles else None
        if roles & {"length", "figure"}:
            continue
        if type(value) is int:
            by_number += [value] if "camera" in roles and 0 <= value < 100 else []
        elif isinstance(value, list) and len(value) == 2:
            by_number += [each for each in map(camera_of, value) if each is not None]
        elif pair is not None:
            by_name += pair
        elif "camera" in roles and not (isinstance(value, str) and len(by_number) == 2):
            camera = _camera(value)
            own = by_name if isinstance(value, str) else by_number
            own += [] if camera is None else [camera]
    for cameras in (by_number, by_name):
        if len(cameras) == 2 and cameras[0] != cameras[1]:
            return cameras[0], cameras[1]
    return None


def named_pair(value: Any) -> Pair | None:
    """Return the left and the right camera that a value names, None where it names no two."""
    if isinstance(value, str):
        return _pair_of(value)
    for side in ("left", "right") if isinstance(value, dict) else ():
        sided = (inner for key, inner in value.items() if side in words(key).split("_"))
        named = [camera for camera in map(_camera, sided) if camera is not None]
        if named and max(named) - min(named) > 1:  # names may count from 0 beside numbers from 1
            return None
    ends = _ends(value)
    if isinstance(value, dict) and ends == [None, None]:
        return _cameras_of(value)
    cameras = [camera for camera in (_camera(value[end]) for end in ends if end is not None)
               if camera is not None]  # fmt: skip
    return (cameras[0], cameras[1]) if len(cameras) == 2 else None


def _ends(value: Any) -> list[Any]:
    """Return the keys under which a value names the left and the right camera, None for neither."""
    if isinstance(value, list) and len(value) == 2:
        return [0, 1]
    keys = value.items() if isinstance(value, dict) else []
    return [
        next((key for key, inner in keys
              if {side, side[0]} & {*words(key).split("_")} and _camera(inner) is not None), None)
        for side in ("left", "right")
    ]  # fmt: skip


def _pair_of(text: str) -> Pair | None:
    """Return the two cameras that a text names, None where it does not name two.

    >>> _pair_of("0-1"), _pair_of("Town_2_Cam_00 to Town_2_Cam_03"), _pair_of("baseline_1")
    ((0, 1), (0, 3), None)
    """
    name = words(text)
    found = re.findall(r"cam(?:era)?_?(\d+)", name) or re.findall(r"\d+", name)
    return (int(found[0]), int(found[1])) if len(found) == 2 else None


def _camera(value: object) -> int | None:
    """Return the camera that an index, a name, or an object with one of these stands for."""
    if isinstance(value, dict):
        found = {camera_of(each) for each in value.values()} - {None}
        return found.pop() if len(found) == 1 else None
    return camera_of(value)


def _unit_below(node: Any, above_m: float) -> float:
    """Return the metres in the unit that an object names, nan if not known, or in that above."""
    keys = node.items() if isinstance(node, dict) else ()
    named = [
        each for key, each in keys if words(key) in ("unit", "units") and isinstance(each, str)
    ]
    unit_m = named_unit_m(named[0]) if named else above_m
    return math.nan if unit_m is None else unit_m


def _are_columns(table: dict[str, Any]) -> bool:
    """Return whether an object has the cameras and the lengths of all pairs as lists."""
    lengths = {len(each) if isinstance(each, list) else -1 for each in table.values()}
    roles = (role for key in table for role in _roles(words(key)))
    return len(lengths) == 1 and max(lengths) > 2 and {"camera", "length"} <= {*roles}


def _are_numbers(value: Any, count: int) -> bool:
    return isinstance(value, list) and len(value) == count and all(map(is_number, value))


def _places_of(value: Any) -> list[list[float]] | None:
    """Return where six cameras stand on a line or in space, None where a value does not tell it."""
    if isinstance(value, dict) and [*map(camera_of, value)] == [*range(CAMERA_COUNT)]:
        value = [*value.values()]
    listed = value if isinstance(value, list) and len(value) == CAMERA_COUNT else []
    points = [each if isinstance(each, list) else [each] for each in listed]
    are_known = points and len(points[0]) in (1, 3)
    return points if are_known and all(_are_numbers(p, len(points[0])) for p in points) else None


def _is_row(value: Any, *, of: dict[str, Any] | list[Any]) -> bool:
    """Return whether a value is a row of a table with a number for each two cameras."""
    if isinstance(value, dict):
        return bool(value) and all(key.isdigit() or camera_of(key) is not None for key in value)
    return isinstance(value, list) and len(of) == len(value) == CAMERA_COUNT


def _is_lens_model(value: Any) -> bool:
    """Return whether a value says that a lens is no pinhole."""
    if isinstance(value, list | dict):
        return any(map(_is_lens_model, value.values() if isinstance(value, dict) else value))
    return _ODD_LENS.search(value.lower()) is not None if isinstance(value, str) else (
        is_number(value) and value not in (0, 1)
    )  # fmt: skip


def _first_number(lengths: list[_Length]) -> int:
    """Return the number of the first camera: 0 or 1."""
    cameras = {camera for each in lengths if not each.is_by_place for camera in each.cameras}
    return 1 if cameras and min(cameras) == 1 and max(cameras) == CAMERA_COUNT else 0


def _completed(best: dict[Pair, _Length]) -> dict[Pair, float]:
    """Return all 15 baselines where those of neighbours are known and add up to the others."""
    if not set(ADJACENT_PAIRS) <= set(best):
        return {}
    places_cm = [0.0, *itertools.accumulate(best[pair].cm for pair in ADJACENT_PAIRS)]
    rounding_cm = sum(best[pair].rounding_cm for pair in ADJACENT_PAIRS)
    added_cm = {(a, b): places_cm[b] - places_cm[a] for a, b in CAMERA_PAIRS}
    for pair, each in best.items():
        if abs(added_cm[pair] - each.cm) > rounding_cm + each.rounding_cm:
            return {}
    return added_cm


def see_rig(text: bytes, *, where: str) -> tuple[Shape, dict[str, list[str]], list[str]]:
    """Return where the quantities of a ``baseline.json`` stand, as `parse_rig` finds them.

    Returns:
        What conventions would state about the file; for each table, the values that it means, and
        other places that state the same; and the places of numbers and texts, as `keys_of` names
        them, that nothing reads.

    Raises:
        SchemaError: If it is not a JSON object.
    """
    file = _RigFile(text, where=where)
    at: dict[str, At] = {}
    found: dict[str, list[str]] = {}
    for name, quantity in NUMBERS.items():
        usable = [each for each in file.values.positive(quantity) if _is_usable(name, each)]
        if usable:
            unit = usable[0].unit or _USUAL_UNITS.get(name)
            at[name] = At(place=usable[0].path, unit=unit)
            units = [unit or "", *(each.unit for each in usable[1:])]
            found[name] = [f"{each.path} is {each.value:g} {unit}".rstrip()
                           for each, unit in zip(usable, units, strict=True)]  # fmt: skip
    read = {place_of(each.path) for name in NAMES for each in file.values.stated(name)}
    read |= {place_of(each.stated.path) for each in file.lengths}
    if file.lengths:
        first = file.lengths[0]
        steps = [steps_of(each.stated.path) for each in file.lengths]
        same = [each for each in steps if each[:1] == steps[0][:1]]
        by_step = zip(*(each[:-1] for each in same), strict=False)
        common = itertools.takewhile(lambda each: len({*each}) == 1, by_step)
        place = functools.reduce(child_path, (each[0] for each in common), "$")
        unit_m = first.cm / 100 / first.stated.value
        known = [name for name, metres in UNITS_M.items() if math.isclose(metres, unit_m)]
        at["baselines"] = At(place=place, unit=next(iter(known), None))
        found["baselines"] = [
            f"{first.stated.path} is {first.stated.value:g}, {first.cm:g} cm of cameras "
            f"{first.cameras[0]} and {first.cameras[1]}",
            f"{len(same)} lengths below {place}, {len(steps) - len(same)} elsewhere",
        ]
    for each in file.values.stated("primary_pair"):
        ends = _ends(each.value)
        if None not in ends:
            left, right = (child_path(each.path, end) for end in ends)
            at["primary_pair"] = At(left=left, right=right)
            found["primary_pair"] = [f"{left} is the left camera, {right} the right"]
            break
    keys = keys_of(file.document)
    unknown = sorted(
        key for key in keys
        if not is_below(key, read)
        and not any(each.startswith(f"{key}[]") for each in keys)
        and not _NAMES_A_CAMERA.search(key.rpartition(".")[2])
    )  # fmt: skip
    return Shape(at=at), found, unknown


_USUAL_UNITS: Final = {
    **dict.fromkeys(("focal_length", "sensor_width", "sensor_height"), "mm"),
    "field_of_view": "deg",
}


def _is_usable(name: str, each: Stated) -> bool:
    """Return whether a number above zero is what a table of conventions may mean."""
    if name in ("focal_length", "sensor_width", "sensor_height"):
        return each.unit in ("", *UNITS_M)
    return name != "focal_length_px" or each.unit.startswith("p") or each.path[-1:] in "xX"
