"""Metadata files to typed records: scene keys, ``baseline.json``, markers and descriptions.

A file is read in tiers. What every sample needs (focal length, sensor width, baselines, which
camera is left) must be there and be understood: `SchemaError` lists everything else that is wrong.
What only some fields need, or none (principal point, labels, captions), becomes a `Remark`.
"""

import itertools
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, Final

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.conventions import (
    NUMBERS,
    BaselinesAt,
    NumberAt,
    PrimaryPairAt,
    Shape,
    keys_of,
    place_of,
)
from stereogenbench_data.schema.document import (
    MOST_LETTERS,
    brief,
    camera_of,
    child_path,
    is_number,
    parse_object,
)
from stereogenbench_data.schema.quantities import (
    NAMES,
    UNITS_M,
    Node,
    Stated,
    as_stated,
    length_unit_m,
    nodes_of,
    numbers,
    stated,
    without_unit,
    words,
)
from stereogenbench_data.schema.records import Description, Remark, Rig, SceneId, SceneLabels
from stereogenbench_data.schema.release import (
    ADJACENT_CM,
    ADJACENT_PAIRS,
    CAMERA_COUNT,
    CAMERA_PAIRS,
    IMAGE_SIZE_PX,
    SENSOR_MM,
    subset_of_folder,
)
from stereogenbench_data.schema.text import shortened

_FOLDER: Final = re.compile(r"[!-\-0-\[\]-~](?:[ -\-0-\[\]-~]*[!-\-0-\[\]-~])?\Z")
"""Printable ASCII without dot, slash and backslash, and without a space at either end."""

_KEY_SHOWN: Final = 300
_SHOWN: Final = 20
_CENTRE_PX: Final = 1.0
"""How far a principal point may be from the image's centre to be that centre: conventions of pixels
differ by a half, and centres are written as whole pixels."""

_BY_PLACE: Final = "by place"
"""What stands for the unit of baselines whose cameras follow from their place in a list."""

_NAMES_A_CAMERA: Final = re.compile(
    r"cam|left|right|index|\A[abij]\Z|_[abij12]\Z|src|dst|from|to\Z"
)

_FLOAT32: Final = 1e-6

Pair = tuple[int, int]
_NO_LENGTH: Final = "baseline_cm is missing"

_Recorded = tuple[Pair, float, Stated]
"""The cameras of a pair as they are written, their baseline in cm, and where it stands."""
_Waiting = tuple[Any, str, str, int | None]
"""A value that may hold baselines, the words of its keys, its path, and the row of a table."""


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
    if "." in key:
        raise SchemaError(
            f"scene {shown!r}: a folder name contains a dot, which would end the scene's key "
            f"in a tar shard. Rename the folder."
        )
    bad = next((folder for folder in folders if not _FOLDER.match(folder)), None)
    if bad is not None:
        raise SchemaError(
            f"scene {shown!r}: {shortened(bad)!r} is not a valid folder name: use printable ASCII "
            f"without a backslash, and without a space at either end. Rename the folder."
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


@dataclass(slots=True)
class _Findings:
    """What is wrong in a file: what stops a sample, and what only concerns some fields."""

    where: str
    keys: str = ""
    shape: Shape | None = None
    problems: list[str] = field(default_factory=list)
    remarks: list[Remark] = field(default_factory=list)

    def conflict(self, what: str, first: Stated, other: Stated) -> None:
        self.problems.append(
            f"{other.path}: states another {what} ({brief(other.value)} {other.unit}) than "
            f"{first.path} ({brief(first.value)} {first.unit}). {self.cure}"
        )

    @property
    def cure(self) -> str:
        """What to do about values that conflict."""
        if self.shape is None:
            return "Remove the wrong one"
        return "Remove the wrong one, or list its place as 'ignored' in the conventions"

    def require_none(self) -> None:
        if self.problems:
            head = "1 problem" if len(self.problems) == 1 else f"{len(self.problems)} problems"
            listed = self.problems[:_SHOWN]
            if len(self.problems) > _SHOWN:
                listed.append(f"and {len(self.problems) - _SHOWN} more")
            raise SchemaError(f"{self.where}: {head}:\n  " + ".\n  ".join(listed) + ".")


def _labels(nodes: list[Node], findings: _Findings) -> SceneLabels:
    """Return the identifiers in a file; one that is not of its kind is left out with a remark."""

    def text(quantity: str) -> str | None:
        return _text(nodes, quantity, findings, about="labels")

    return SceneLabels(
        scene_label=text("scene_label"),
        scene_index=_scene_index(nodes),
        map_name=text("map_name"),
        map_path=text("map_path"),
        character=text("character"),
        animation=text("animation"),
        aperture_fstop=next(
            (float(each.value) for each in numbers(nodes, "aperture_fstop") if each.value > 0),
            None,
        ),
    )


def _scene_index(nodes: list[Node]) -> int | None:
    for each in stated(nodes, "scene_index"):
        text = str(each.value)
        if type(each.value) in (int, str) and re.fullmatch(r"[0-9]{1,15}", text):
            return int(text)
    return None


def _text(nodes: list[Node], quantity: str, findings: _Findings, *, about: str) -> str | None:
    """Return a text that can be written as UTF-8, None where there is none."""
    odd = None
    for each in stated(nodes, quantity):
        value = each.value
        if isinstance(value, str) and len(value) <= MOST_LETTERS:
            if not any("\ud800" <= letter <= "\udfff" for letter in value):
                return value
        elif isinstance(value, dict | list) and not each.path.endswith("]"):
            continue
        odd = odd or f"{each.path}: must be a text, found {brief(value)}"
    if odd is not None:
        findings.remarks.append(Remark(about, f"{findings.where}: {odd}"))
    return None


def parse_complete(text: bytes, *, where: str) -> tuple[SceneLabels, tuple[Remark, ...]]:
    """Return the identifiers in a ``_scene_complete.json``, the marker of a finished scene.

    Whatever it holds, the scene is finished; what is not understood is left out with a remark.

    Source: the paper's appendix on the file schema.
    """
    findings = _Findings(where)
    try:
        labels = _labels(nodes_of(parse_object(text, where=where)), findings)
    except SchemaError as error:
        return SceneLabels(), (Remark("labels", str(error)),)
    return labels, tuple(findings.remarks)


def parse_description(text: bytes, *, where: str) -> tuple[Description, tuple[Remark, ...]]:
    """Return a scene's machine-written description; absent texts are empty.

    What is not understood is left out with a remark: no picture depends on it.

    Source: the paper's appendix on the file schema.
    """
    findings = _Findings(where)
    try:
        nodes = nodes_of(parse_object(text, where=where))
    except SchemaError as error:
        return Description(), (Remark("caption", str(error)),)
    short, detailed, scene_type, setting = (
        _text(nodes, quantity, findings, about="caption") or ""
        for quantity in ("short_caption", "detailed_caption", "scene_type", "setting")
    )
    tags: tuple[str, ...] = ()
    for each in stated(nodes, "tags"):
        listed = each.value.split(",") if isinstance(each.value, str) else each.value
        if isinstance(listed, list):
            tags = tuple(tag.strip() for tag in listed if isinstance(tag, str))
            break
    return Description(short, detailed, scene_type, setting, tags), tuple(findings.remarks)


def parse_rig(
    text: bytes, *, where: str, shape: Shape | None = None, size_px: Pair | None = None
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

    Raises:
        SchemaError: If focal length, sensor width, a baseline or the primary pair is missing, not
            understood or stated twice with other values, or the conventions are contradicted; the
            message lists every problem.

    Source: the paper's appendix on the file schema.
    """
    document = parse_object(text, where=where)
    nodes = nodes_of(document) if shape is None else shape.nodes(document, where=where)
    findings = _Findings(where, keys=_keys(document), shape=shape)
    baselines_cm, first_number = _baselines(document, nodes, findings)
    width, height = _side(nodes, "image_width"), _side(nodes, "image_height")
    like_px = size_px or (IMAGE_SIZE_PX, IMAGE_SIZE_PX)
    width_px, height_px = width or like_px[0], height or width or like_px[1]
    known_px = width if size_px is None else width_px
    focal_mm, sensor_width_mm = _lens(
        nodes, findings, width_px=known_px, aspect=width_px / height_px
    )
    sensor_height_mm = _length_mm(nodes, "sensor_height", findings)
    for each in numbers(nodes, "focal_y_px"):
        if each.value > 0:
            sensor_height_mm = sensor_height_mm or focal_mm * height_px / each.value
    rig = Rig(
        focal_mm=focal_mm,
        sensor_width_mm=sensor_width_mm,
        sensor_height_mm=sensor_height_mm or sensor_width_mm * height_px / width_px,
        image_width_px=width_px,
        image_height_px=height_px,
        principal_point_px=_principal_point(nodes, findings, size_px=(width_px, height_px)),
        baselines_cm=tuple(baselines_cm.get(pair, math.nan) for pair in CAMERA_PAIRS),
        primary_pair=_primary_pair(document, nodes, findings, first_number=first_number),
        image_size_source="default" if width is None and height is None else "recorded",
    )
    labels = _labels(nodes, findings)
    findings.require_none()
    return rig, labels, tuple(findings.remarks)


def require_unit(rig: Rig, *, family: str, where: str) -> tuple[Remark, ...]:
    """Return a remark on baselines that the paper's family does not have.

    Raises:
        SchemaError: If they are far off, and would be the family's in another unit of length.
    """
    low_cm, high_cm = ADJACENT_CM.get(family, (0.0, math.inf))
    adjacent_cm = [rig.baseline_cm(a, b) for a, b in ADJACENT_PAIRS]
    least_cm, most_cm = min(adjacent_cm), max(adjacent_cm)
    if low_cm * _NEARLY[0] <= least_cm and most_cm <= high_cm * _NEARLY[1]:
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


def _side(nodes: list[Node], quantity: str) -> int | None:
    """Return a side of the recorded image in pixels; what is none is as good as not recorded."""
    for each in numbers(nodes, quantity):
        if each.value > 0 and float(each.value).is_integer():
            return int(each.value)
    return None


def _length_mm(nodes: list[Node], quantity: str, findings: _Findings) -> float:
    """Return a length of the camera in mm, the unit of cameras; 0 where there is none."""
    found: Stated | None = None
    length_mm, odd = 0.0, ""
    for each in stated(nodes, quantity):
        if each.unit and each.unit not in UNITS_M:
            continue
        scale_mm = UNITS_M.get(each.unit, 1e-3) * 1000
        if not is_number(each.value) or each.value <= 0:
            if not isinstance(each.value, dict | list):
                odd = f"{each.path}: must be a number above zero, found {brief(each.value)}"
            continue
        again_mm = each.value * scale_mm
        if not each.unit and not _LEAST_MM <= again_mm <= _MOST_MM:
            odd = f"{each.path}: {brief(each.value)} is no length in mm of a camera: name its unit"
        elif found is None:
            found, length_mm = each, again_mm
        elif abs(again_mm - length_mm) > each.rounding * scale_mm + found.rounding:
            findings.conflict(quantity.replace("_", " "), found, each)
    if odd and found is None:
        findings.problems.append(odd)
    return length_mm


_LEAST_MM, _MOST_MM = 4.0, 150.0
"""Lengths of cameras whose unit is not written: the release's lenses have 18 to 85 mm."""


def _lens(
    nodes: list[Node], findings: _Findings, *, width_px: int | None, aspect: float
) -> tuple[float, float]:
    """Return focal length and sensor width in mm.

    One of them may follow from a field of view, or a focal length in pixels, which must agree where
    both are there. Where neither is recorded, the sensor is that of the release.
    """
    focal_mm, sensor_mm = (_length_mm(nodes, name, findings) for name in ("focal", "sensor_width"))
    ratios = _focal_ratios(nodes, width_px=width_px, aspect=aspect)
    if ratios and not findings.problems:
        if not (focal_mm or sensor_mm):
            sensor_mm = SENSOR_MM
            told = f"has no sensor width; that of the release is assumed, {SENSOR_MM} mm"
            findings.remarks.append(Remark("sensor", f"{findings.where}: {told}"))
        sensor_mm = sensor_mm or focal_mm / ratios[0][1]
        focal_mm = focal_mm or sensor_mm * ratios[0][1]
    for each, ratio in ratios:
        if focal_mm and sensor_mm and abs(focal_mm / sensor_mm - ratio) > _RATIO * ratio:
            findings.problems.append(
                f"{each.path}: {brief(each.value)} means {ratio:.6g} focal lengths a sensor width, "
                f"and focal length and sensor width in mm mean {focal_mm / sensor_mm:.6g}. "
                f"{findings.cure}"
            )
    for name, length_mm in (("focal_length_mm", focal_mm), ("sensor_width_mm", sensor_mm)):
        if not length_mm and not any(name[:5] in problem for problem in findings.problems):
            findings.problems.append(
                f"$.camera_intrinsics.{name} is missing; the keys are: {findings.keys}"
            )
    low, high = _LENSES if findings.shape is None else _FOCAL_LENGTHS
    if focal_mm and sensor_mm and not low <= focal_mm / sensor_mm <= high:
        angle = math.degrees(2 * math.atan(0.5 * sensor_mm / focal_mm))
        findings.problems.append(
            f"a focal length of {focal_mm:.6g} mm on a sensor {sensor_mm:.6g} mm wide, "
            f"{focal_mm / sensor_mm:.3g} widths, would see {angle:.3g} degrees, and lenses have "
            f"{low:g} to {high:g} widths. Correct its unit or its place"
        )
    return focal_mm or 1.0, sensor_mm or 1.0


def _focal_ratios(
    nodes: list[Node], *, width_px: int | None, aspect: float
) -> list[tuple[Stated, float]]:
    """Return the focal lengths a sensor width that follow from fields of view and pixels.

    An angle of the height counts only where pixels may be taken to be square.
    """
    ratios = []
    for each in numbers(nodes, "fov"):
        angle = each.value if _is_rad(each) else math.radians(each.value)
        if 0 < angle < math.pi:
            ratios.append((each, 0.5 / math.tan(angle / 2)))
    for each in numbers(nodes, "fov_y"):
        angle = each.value if _is_rad(each) else math.radians(each.value)
        if 0 < angle < math.pi:
            ratios.append((each, 0.5 / math.tan(angle / 2) / aspect))
    for each in numbers(nodes, "focal_px"):
        is_px = each.unit.startswith("p") or each.path.lower().endswith("x")
        if width_px and is_px and each.value > 0:
            ratios.append((each, each.value / width_px))
    return ratios


def _is_rad(angle: Stated) -> bool:
    return angle.unit.startswith("rad") or (not angle.unit and angle.value < math.pi)


_FOCAL_LENGTHS: Final = (0.4, 6.0)
"""Focal lengths in widths of the sensor that conventions may mean: the release has 0.76 to 3.6."""
_LENSES: Final = (0.04, 60.0)
"""Focal lengths in widths of the sensor that files may mean: 171 degrees to one."""
_RATIO: Final = 1e-3
"""How far a field of view may be from focal length over sensor width: it is often rounded."""


def _keys(document: dict[str, Any]) -> str:
    inner = document.get("camera_intrinsics")
    inner = inner if isinstance(inner, dict) else {}
    keys = [*document, *(f"camera_intrinsics.{key}" for key in inner)]
    plain = [key if key.isascii() and key.isprintable() else ascii(key) for key in sorted(keys)]
    return shortened(", ".join(plain) or "none", 400)


def _principal_point(
    nodes: list[Node], findings: _Findings, *, size_px: Pair
) -> tuple[float, float] | None:
    """Return the principal point in pixels; None where it is the image's centre or not known."""
    points = [stated(nodes, quantity) for quantity in ("principal_x", "principal_y")]
    if not any(points):
        return None
    place_px: list[float] = []
    for found, side_px in zip(points, size_px, strict=True):
        usable = [each for each in found if is_number(each.value)]
        if usable and abs(usable[0].value - 0.5) < 1e-3:
            place_px.append(side_px / 2)  # a share of the side
        elif usable and 1 < usable[0].value < side_px:
            place_px.append(float(usable[0].value))
            for each in usable[1:] if findings.shape is not None else ():
                if abs(each.value - usable[0].value) > each.rounding + usable[0].rounding:
                    findings.conflict("principal point", usable[0], each)
        else:
            shown = ", ".join(f"{each.path} {brief(each.value)}" for each in found) or "one side"
            findings.remarks.append(
                Remark(
                    "principal point",
                    f"{findings.where}: the principal point is not understood ({shown}): it must "
                    f"be x and y in pixels inside a picture of {size_px[0]}x{size_px[1]}",
                )
            )
            return None
    if all(abs(a - b / 2) <= _CENTRE_PX for a, b in zip(place_px, size_px, strict=True)):
        return None
    return place_px[0], place_px[1]


def _primary_pair(
    document: dict[str, Any], nodes: list[Node], findings: _Findings, *, first_number: int
) -> Pair:
    pairs: list[tuple[Stated, Pair]] = []
    odd: list[str] = []
    for each in [*_stated_pair(document, findings), *stated(nodes, "primary_pair")]:
        value = each.value
        named = named_pair(value)
        if named is None:
            odd.append(
                f"{each.path}: must be {{left_camera, right_camera}} or a list of two cameras, "
                f"found {brief(value)}"
            )
            continue
        is_named_from_0 = isinstance(value, dict) and _names_camera_0(nodes)
        first = 0 if is_named_from_0 else first_number
        left, right = named[0] - first, named[1] - first
        if left == right or not {left, right} <= set(range(CAMERA_COUNT)):
            odd.append(
                f"{each.path}: names cameras {left} and {right}, and a pair is two of the "
                f"cameras 0 to {CAMERA_COUNT - 1}"
            )
            continue
        if pairs and pairs[0][1] != (left, right):
            findings.conflict("primary pair", pairs[0][0], each)
        pairs.append((each, (left, right)))
    is_stated = findings.shape is not None and findings.shape.primary_pair is not None
    if pairs and not (is_stated and odd):
        return pairs[0][1]
    findings.problems += odd
    if not odd:
        told = (
            f"{findings.where}: has no primary_stereo_pair, so cameras are taken to be numbered "
            f"from left to right, as in the release; the keys are: {findings.keys}"
        )
        findings.remarks.append(Remark("primary pair", told))
    return 0, 1


def named_pair(value: object) -> Pair | None:
    """Return the left and the right camera that a value names, None where it names no two."""
    left = right = None
    if isinstance(value, dict):
        left, right = (_end(value, side) for side in ("left", "right"))
        if left is None and right is None:
            return _cameras_of(value)
    elif isinstance(value, list) and len(value) == 2:
        left, right = map(_camera, value)
    elif isinstance(value, str):
        return _pair_of(value)
    return None if left is None or right is None else (left, right)


def _names_camera_0(nodes: list[Node]) -> bool:
    """Return whether a text names camera 0: names may count from 0 beside numbers from 1."""
    texts = (node.value for node in nodes if isinstance(node.value, str))
    return any("cam" in text.lower() and camera_of(text) == 0 for text in texts)


def _stated_pair(document: dict[str, Any], findings: _Findings) -> list[Stated]:
    """Return the primary pair that conventions state, as a list of two cameras."""
    shape = findings.shape
    if shape is None or shape.primary_pair is None:
        return []
    paths = (shape.primary_pair.left, shape.primary_pair.right)
    cameras = [
        shape.value_at(document, path, table="primary_pair", where=findings.where) for path in paths
    ]
    return [Stated(cameras, "", " and ".join(paths))]


def _end(pair: dict[str, Any], side: str) -> int | None:
    """Return the camera of a side of the primary pair."""
    for key, value in pair.items():
        if side in words(key).split("_"):
            camera = _camera(value)
            if camera is not None:
                return camera
    return None


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


def _baselines(
    document: dict[str, Any], nodes: list[Node], findings: _Findings
) -> tuple[dict[Pair, float], int]:
    """Return each pair's baseline in cm, and the number of the first camera.

    Baselines of pairs that are not recorded follow from those that are, if these lie on a line.
    """
    found = sorted(
        _recorded_lengths(document, nodes, findings),
        key=lambda each: not each[2].path.startswith("$.pairwise_pairs"),
    ) or [*_offsets(nodes, length_unit_m(nodes) or 0.01, findings)]
    cameras = {camera for pair, _, each in found for camera in pair if each.unit != _BY_PLACE}
    first_number = 1 if cameras and min(cameras) == 1 and max(cameras) == CAMERA_COUNT else 0
    best: dict[Pair, tuple[float, float, Stated]] = {}
    for (a, b), length_cm, each in found:
        first = 0 if each.unit == _BY_PLACE else first_number
        low, high = sorted((a - first, b - first))
        pair = (low, high)
        if pair not in CAMERA_PAIRS:
            findings.problems.append(
                f"{each.path}: is of cameras {a} and {b}, and the rig has cameras 0 to "
                f"{CAMERA_COUNT - 1}"
            )
            continue
        rounding_cm = abs(length_cm / each.value) * each.rounding if each.value else 0.0
        known_cm, known_rounding_cm, known = best.get(pair, (length_cm, math.inf, each))
        if abs(length_cm - known_cm) > rounding_cm + known_rounding_cm:
            findings.problems.append(
                f"{each.path}: the baseline of cameras {low} and {high} is {length_cm:.9g} cm "
                f"here and {known_cm:.9g} cm at {known.path}. {findings.cure}"
            )
        elif pair not in best or (
            rounding_cm < known_rounding_cm and abs(length_cm - known_cm) > _FLOAT32 * length_cm
        ):
            best[pair] = length_cm, rounding_cm, each
    lengths_cm = {pair: length_cm for pair, (length_cm, _, _) in best.items()}
    missing = [f"{a}-{b}" for a, b in CAMERA_PAIRS if (a, b) not in lengths_cm]
    if missing:
        lengths_cm = _completed(lengths_cm, best)
    if len(lengths_cm) < len(CAMERA_PAIRS):
        findings.problems.append(
            f"$.pairwise_pairs must have the baseline of each of the {len(CAMERA_PAIRS)} camera "
            f"pairs, and lacks {', '.join(missing)}; the keys are: {findings.keys}"
        )
    elif missing:
        findings.remarks.append(
            Remark(
                "baselines",
                f"{findings.where}: the baselines of {', '.join(missing)} are not recorded and "
                f"were added up from the others",
            )
        )
    return lengths_cm, first_number


def _completed(
    lengths_cm: dict[Pair, float], best: dict[Pair, tuple[float, float, Stated]]
) -> dict[Pair, float]:
    """Return all 15 baselines where those of neighbours are known and add up to the others."""
    if not set(ADJACENT_PAIRS) <= set(lengths_cm):
        return lengths_cm
    places_cm = [0.0, *itertools.accumulate(lengths_cm[pair] for pair in ADJACENT_PAIRS)]
    rounding_cm = sum(best[pair][1] for pair in ADJACENT_PAIRS)
    added_cm = {(a, b): places_cm[b] - places_cm[a] for a, b in CAMERA_PAIRS}
    for pair, (length_cm, own_cm, _) in best.items():
        if abs(added_cm[pair] - length_cm) > rounding_cm + own_cm:
            return lengths_cm
    return added_cm | lengths_cm


def _recorded_lengths(
    document: dict[str, Any], nodes: list[Node], findings: _Findings
) -> Iterable[_Recorded]:
    """Yield the cameras, baseline in cm and place of each pair that a document records.

    Pairs are objects with two cameras and a length, keys such as "0-1" with a length, or lists of
    five lengths of neighbours, below a key that speaks of pairs or baselines.
    """
    default_m = length_unit_m(nodes) or 0.01
    shape = findings.shape
    at = None if shape is None else shape.baselines
    if at is not None and shape is not None:
        default_m = UNITS_M.get(at.unit or "", default_m)
        value = shape.value_at(document, at.place, table="baselines", where=findings.where)
        name = f"baselines_{words(at.place.rpartition('.')[2])}"
        there = list(_lengths_below([(value, name, at.place, None)], default_m, findings))
        if not any(math.isclose(cm / each.value, default_m * 100) for _, cm, each in there):
            findings.problems.append(
                f"{at.place}: by the conventions baselines in {at.unit or 'the unit of the file'} "
                f"stand here, and {brief(value)} has none. Correct the place or the unit"
            )
        yield from there
    keys = sorted(document, key=lambda key: key != "pairwise_pairs")
    by_name: list[_Waiting] = [
        (document[key], words(key), child_path("$", key), None) for key in keys
    ]
    for found in _lengths_below(by_name, default_m, findings):
        if shape is None or not shape.ignores(found[2].path):
            yield found


def _lengths_below(
    waiting: list[_Waiting], default_m: float, findings: _Findings
) -> Iterable[_Recorded]:
    """Yield the pairs of `_recorded_lengths` in values with their names in words and places."""
    for node, name, path, row in waiting:
        if "primary" in name or not isinstance(node, dict | list):
            continue
        speaks_of_pairs = re.search(r"pair|baseline", name) is not None
        cameras = _cameras_of(node) if speaks_of_pairs and isinstance(node, dict) else None
        if cameras is not None and isinstance(node, dict):
            yield from _lengths_of(node, cameras, path, default_m, findings)
        elif isinstance(node, list) and _is_of_lengths(node, name):
            yield from _neighbours(node, name, path, default_m, findings)
        elif speaks_of_pairs or isinstance(node, dict):
            for key, value in node.items() if isinstance(node, dict) else enumerate(node):
                place, own = child_path(path, key), words(str(key))
                pair = _pair_of(own) if isinstance(key, str) else None
                if row is not None and own.isdigit():
                    pair = row, int(own)  # of a table
                if not speaks_of_pairs or pair is None:
                    is_row = own.isdigit() and _is_row(value, of=node)
                    longer = name if isinstance(key, int) or is_row else f"{name}_{own}"
                    waiting.append((value, longer, place, int(own) if is_row else None))
                elif pair[0] != pair[1]:
                    yield from _of_pair(value, pair, name, place, default_m, findings)


def _of_pair(
    value: Any, pair: Pair, name: str, path: str, default_m: float, findings: _Findings
) -> Iterable[_Recorded]:
    """Yield the baselines of a pair: those in an object, or the value itself."""
    if isinstance(value, dict):
        yield from _lengths_of(value, pair, path, default_m, findings)
    else:
        unit_m = UNITS_M.get(without_unit(name)[1], default_m)
        yield from _length(pair, value, unit_m, path, findings)


def _is_of_lengths(node: list[Any], name: str) -> bool:
    """Return whether a list is the baselines of neighbours, or two cameras and their baseline."""
    return ("adjacent" in name and bool(node) and all(map(is_number, node))) or (
        re.search(r"pair|baseline", name) is not None and _is_triple(node)
    )


def _is_triple(node: list[Any]) -> bool:
    """Return whether a list is two cameras and their baseline."""
    cameras = range(CAMERA_COUNT + 1)
    is_pair = len(node) == 3 and all(type(each) is int and each in cameras for each in node[:2])
    return is_pair and node[0] != node[1]


def _is_row(value: Any, *, of: dict[str, Any] | list[Any]) -> bool:
    """Return whether a value is a row of a table with a number for each two cameras."""
    if isinstance(value, dict):
        return bool(value) and all(key.isdigit() for key in value)
    return isinstance(value, list) and len(of) == len(value) == CAMERA_COUNT


def _neighbours(
    lengths: list[Any], name: str, path: str, default_m: float, findings: _Findings
) -> Iterable[_Recorded]:
    """Yield the baselines of neighbours, of which a list has one each, or that of one pair."""
    if _is_triple(lengths):
        unit_m = UNITS_M.get(without_unit(name)[1], default_m)
        yield from _length((lengths[0], lengths[1]), lengths[2], unit_m, path, findings)
        return
    if len(lengths) != len(ADJACENT_PAIRS):
        findings.problems.append(
            f"{path}: must be a list of {len(ADJACENT_PAIRS)} baselines, found {brief(lengths)}"
        )
        return
    unit_m = UNITS_M.get(without_unit(name)[1], default_m)
    for place, (pair, value) in enumerate(zip(ADJACENT_PAIRS, lengths, strict=True)):
        for _, length_cm, each in _length(pair, value, unit_m, child_path(path, place), findings):
            yield pair, length_cm, replace(each, unit=_BY_PLACE)


def _cameras_of(entry: dict[str, Any]) -> Pair | None:
    """Return the two cameras that an entry names, None where it does not name two."""
    by_number: list[int] = []
    by_name: list[int] = []
    for key, value in entry.items():
        name = words(key)
        if re.search(r"baseline|distance|length|count", name):
            continue
        pair = _pair_of(value) if isinstance(value, str) else None
        if isinstance(value, list) and len(value) == 2:
            by_number += [each for each in map(camera_of, value) if each is not None]
        elif pair is not None and re.search(r"pair|key|id|name", name):
            by_name += pair
        elif "pair" not in name and _NAMES_A_CAMERA.search(name):
            camera = _camera(value)
            own = by_name if isinstance(value, str) else by_number
            own += [] if camera is None else [camera]
    for cameras in (by_number, by_name):
        if len(cameras) == 2 and cameras[0] != cameras[1]:
            return cameras[0], cameras[1]
    return None


def _lengths_of(
    entry: dict[str, Any], cameras: Pair, path: str, default_m: float, findings: _Findings
) -> Iterable[_Recorded]:
    """Yield the baselines that an entry of a pair states, in one unit or in several."""
    keys = [
        key
        for key in entry
        if re.search(r"baseline|distance|length|separation", words(key))
        and not re.search(r"target|request|nominal|desired|min|max|mean|std|range", words(key))
    ]
    at = None if findings.shape is None else findings.shape.baselines
    if not keys and at is not None and path.startswith((f"{at.place}.", f"{at.place}[")):
        # Where conventions say that baselines stand, the only number beside two cameras is one.
        keys = [key for key, value in entry.items()
                if is_number(value) and not _NAMES_A_CAMERA.search(words(key))]  # fmt: skip
        keys = keys if len(keys) == 1 else []
    if not keys and not any(_NO_LENGTH in problem for problem in findings.problems):
        findings.problems.append(
            f"{path}: {_NO_LENGTH}; the keys here are: {', '.join(sorted(entry))}"
        )
    for key in keys:
        _, unit = without_unit(words(key))
        if isinstance(entry[key], dict | list) or unit not in ("", *UNITS_M):
            continue
        place = child_path(path, key)
        unit_m = UNITS_M.get(unit, default_m)
        yield from _length(cameras, entry[key], unit_m, place, findings)


def _length(
    cameras: Pair, value: object, unit_m: float, path: str, findings: _Findings
) -> Iterable[_Recorded]:
    found = as_stated(value, "", path)
    if not is_number(found.value) or found.value <= 0:
        findings.problems.append(f"{path}: must be a number above zero, found {brief(value)}")
        return
    unit_m = UNITS_M.get(found.unit, unit_m)
    yield cameras, float(found.value) * (unit_m / 0.01), replace(found, unit="")


def _offsets(nodes: list[Node], default_m: float, findings: _Findings) -> Iterable[_Recorded]:
    """Yield all baselines by the places of the cameras along the rig, where these are listed."""
    for node in nodes:
        places = node.value
        is_listed = isinstance(places, list) and len(places) == CAMERA_COUNT
        if not (_PLACES.search(node.plain) and is_listed and all(map(is_number, places))):
            continue
        for a, b in CAMERA_PAIRS:
            unit_m = UNITS_M.get(node.unit, default_m)
            found = _length((a, b), abs(places[b] - places[a]), unit_m, node.path, findings)
            for pair, length_cm, each in found:
                yield pair, length_cm, replace(each, unit=_BY_PLACE)
        return


_PLACES: Final = re.compile(r"offset|lateral|along|(?:camera|rig)_(?:position|place)")


@dataclass(frozen=True, slots=True)
class Seen:
    """Where the quantities of a ``baseline.json`` stand.

    Attributes:
        shape: What conventions would state about the file.
        found: For each table, the values that it means, and other places that state the same.
        unknown: The places of numbers and texts, as `keys_of` names them, that nothing reads.
    """

    shape: Shape
    found: dict[str, list[str]]
    unknown: list[str]


def see_rig(text: bytes, *, where: str) -> Seen:
    """Return where the quantities of a ``baseline.json`` stand, as `parse_rig` finds them.

    Raises:
        SchemaError: If it is not a JSON object.
    """
    document = parse_object(text, where=where)
    nodes, findings = nodes_of(document), _Findings(where)
    numbers_at: dict[str, NumberAt] = {}
    found: dict[str, list[str]] = {}
    read: set[str] = set()
    for name, quantity in NUMBERS.items():
        usable = [each for each in numbers(nodes, quantity) if _is_usable(name, each)]
        read |= {place_of(each.path) for each in stated(nodes, quantity)}
        if not usable:
            continue
        first, *others = usable
        unit = first.unit or _USUAL_UNITS.get(name)
        numbers_at[name] = NumberAt(place=first.path, unit=unit)
        found[name] = [f"{first.path} is {first.value:g}{f' {unit}' if unit else ''}"]
        found[name] += [f"{each.path} is {each.value:g} {each.unit}".rstrip() for each in others]
    lengths = list(_recorded_lengths(document, nodes, findings))
    lengths.sort(key=lambda each: not each[2].path.startswith("$.pairwise_pairs"))
    read |= {place_of(each.path) for _, _, each in lengths}
    baselines = None
    if lengths:
        steps = [_steps(each.path) for _, _, each in lengths]
        same = [each for each in steps if each[:1] == steps[0][:1]]
        alike = itertools.takewhile(lambda step: len({*step}) == 1, zip(*same, strict=False))
        common = [step[0] for step in alike]
        place = "$" + "".join(common if len(common) < len(steps[0]) else common[:-1])
        pair, length_cm, each = lengths[0]
        unit_m = length_cm / 100 / each.value
        unit = next((name for name in ("mm", "cm", "m") if math.isclose(UNITS_M[name], unit_m)), "")
        baselines = BaselinesAt(place=place, unit=unit or None)
        found["baselines"] = [
            f"{each.path} is {each.value:g}, {length_cm:g} cm of cameras {pair[0]} and {pair[1]}",
            f"{len(same)} lengths below {place}, {len(lengths) - len(same)} elsewhere",
        ]
    primary = _seen_pair(nodes)
    if primary is not None:
        found["primary_pair"] = [f"{primary.left} is the left camera, {primary.right} the right"]
        read |= {place_of(primary.left), place_of(primary.right)}
    read |= {place_of(each.path) for quantity in NAMES for each in stated(nodes, quantity)}
    shape = Shape(numbers=numbers_at, baselines=baselines, primary_pair=primary)
    keys = keys_of(document)
    unknown = sorted(
        key for key in keys
        if not any(key == each or key.startswith((f"{each}.", f"{each}[")) for each in read)
        and not any(each.startswith(f"{key}[]") for each in keys)
        and not _NAMES_A_CAMERA.search(key.rpartition(".")[2])
    )  # fmt: skip
    return Seen(shape, found, unknown)


_USUAL_UNITS: Final = {
    **dict.fromkeys(("focal_length", "sensor_width", "sensor_height"), "mm"),
    "field_of_view": "deg",
}


def _is_usable(name: str, each: Stated) -> bool:
    """Return whether a number is what a table of conventions may mean."""
    if name in ("focal_length", "sensor_width", "sensor_height"):
        return each.value > 0 and each.unit in ("", *UNITS_M)
    if name == "focal_length_px":
        return bool(each.value > 0 and (each.unit.startswith("p") or each.path[-1:] in "xX"))
    return bool(each.value > 0)


def _steps(path: str) -> list[str]:
    return re.findall(r"\.[^.\[]+|\[[^\]]*\]", path)


def _seen_pair(nodes: list[Node]) -> PrimaryPairAt | None:
    """Return where the primary pair names its cameras."""
    for each in stated(nodes, "primary_pair"):
        ends: list[str | int] = [0, 1]
        if isinstance(each.value, dict):
            sides = {
                side: key for side in ("right", "left") for key, value in each.value.items()
                if side in words(key).split("_") and _camera(value) is not None
            }  # fmt: skip
            ends = [sides[side] for side in ("left", "right") if side in sides]
        elif not isinstance(each.value, list) or len(each.value) != 2:
            continue
        if len(ends) == 2:
            left, right = (child_path(each.path, end) for end in ends)
            return PrimaryPairAt(left=left, right=right)
    return None
