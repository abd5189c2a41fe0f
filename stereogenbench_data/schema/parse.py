"""Metadata files to typed records: scene keys, ``baseline.json``, markers and descriptions.

Each function records every problem of its file and raises one `SchemaError` that names the file
and the JSON path of each problem. ``trajectory.json`` has a module of its own.
"""

import math
import re
from typing import Final

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.schema.document import JsonValue, brief
from stereogenbench_data.schema.records import Description, Rig, SceneId, SceneLabels
from stereogenbench_data.schema.release import (
    ADJACENT_PAIRS,
    CAMERA_COUNT,
    CAMERA_PAIRS,
    IMAGE_SIZE_PX,
    subset_of_folder,
)
from stereogenbench_data.schema.spellings import UNITS_M
from stereogenbench_data.schema.text import shortened

_FOLDER: Final = re.compile(r"[!-\-0-\[\]-~](?:[ -\-0-\[\]-~]*[!-\-0-\[\]-~])?\Z")
"""Printable ASCII without dot, slash and backslash, and without a space at either end."""

_KEY_SHOWN: Final = 300

_AGREEMENT: Final = 1e-6
"""How far two records of one baseline may differ, relative: ten float32 roundings."""

Pair = tuple[int, int]


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


def _labels(root: JsonValue) -> SceneLabels:
    """Return the identifiers in a file; each is optional."""
    index, fstop = root.find("scene_index"), root.find("aperture_fstop")
    return SceneLabels(
        scene_label=root.find_text("scene_label"),
        scene_index=None if index is None else index.integer(),
        map_name=root.find_text("map_name"),
        map_path=root.find_text("map_path"),
        character=root.find_text("character"),
        animation=root.find_text("animation"),
        aperture_fstop=None if fstop is None else fstop.positive(),
    )


def parse_complete(text: bytes, *, where: str) -> SceneLabels:
    """Return the identifiers in a ``_scene_complete.json``, the marker of a finished scene.

    Raises:
        SchemaError: If the file is not a JSON object or an identifier has the wrong type.

    Source: the paper's appendix on the file schema.
    """
    root = JsonValue.parse(text, where=where)
    labels = _labels(root)
    root.problems.require_none()
    return labels


def parse_description(text: bytes, *, where: str) -> Description:
    """Return a scene's machine-written description; absent texts are empty.

    Raises:
        SchemaError: If the file is not a JSON object, a text has the wrong type, or an unknown
            key may stand for a caption that is absent.

    Source: the paper's appendix on the file schema.
    """
    root = JsonValue.parse(text, where=where)
    short, detailed, scene_type, setting = (
        root.find_text(quantity) or ""
        for quantity in ("short_caption", "detailed_caption", "scene_type", "setting")
    )
    tags, texts = root.find("tags"), []
    if tags is not None and isinstance(tags.value, list):
        texts = [tags.child(place).text() for place in range(len(tags.value))]
    elif tags is not None:
        tags.complain(f"must be a list of texts, found {brief(tags.value)}")
    root.problems.require_none()
    return Description(short, detailed, scene_type, setting, tuple(texts))


def parse_rig(text: bytes, *, where: str) -> tuple[Rig, SceneLabels]:
    """Return the rig and the identifiers that a ``baseline.json`` records.

    Without an image size, the release's 1280 x 1280 is assumed (``image_size_source`` says so).
    Without a sensor height, pixels are square, as in the paper's loading example. A principal
    point is in pixels of the recorded image, with the centre of the top-left pixel at (0.5, 0.5).

    Args:
        text: The file's bytes.
        where: The file's path, for messages.

    Raises:
        SchemaError: If the file does not follow the format; the message lists every problem.

    Source: the paper's appendix on the file schema.
    """
    root = JsonValue.parse(text, where=where)
    unit_m(root)
    require_six_cameras(root)
    width, height = root.find("image_width_px"), root.find("image_height_px")
    width_px, height_px = _side_px(width), _side_px(height)
    sensor_width_mm = _required_positive(root, "sensor_width_mm")
    sensor_height = root.find("sensor_height_mm")
    baselines_cm = _pairwise(root)
    _require_adjacent_agree(root, baselines_cm)
    rig = Rig(
        focal_mm=_required_positive(root, "focal_mm"),
        sensor_width_mm=sensor_width_mm,
        sensor_height_mm=(
            sensor_width_mm * height_px / width_px
            if sensor_height is None
            else sensor_height.positive()
        ),
        image_width_px=width_px,
        image_height_px=height_px,
        principal_point_px=_principal_point(root, size_px=(width_px, height_px)),
        baselines_cm=tuple(baselines_cm.get(pair, math.nan) for pair in CAMERA_PAIRS),
        primary_pair=_primary_pair(root),
        image_size_source="default" if width is None and height is None else "recorded",
    )
    labels = _labels(root)
    root.problems.require_none()
    return rig, labels


def _required_positive(root: JsonValue, quantity: str) -> float:
    found = root.require(quantity)
    return 1.0 if found is None else found.positive()


def _side_px(side: JsonValue | None) -> int:
    if side is None:
        return IMAGE_SIZE_PX
    size_px = side.integer()
    if size_px <= 0:
        side.complain(f"must be a positive number of pixels, found {brief(side.value)}")
        return 1
    return size_px


def _principal_point(root: JsonValue, *, size_px: Pair) -> tuple[float, float] | None:
    point = root.find("principal_point_px")
    if point is None:
        return None
    if point.axes(("x", "y")) is None:
        point.complain(
            f"must be {{x, y}} in pixels, found {brief(point.value)}; "
            f"leave it out where it is the image's centre"
        )
        return None
    place_px = []
    for side, side_px in zip((point.child("x"), point.child("y")), size_px, strict=True):
        place_px.append(side.number())
        if not 1 < place_px[-1] < side_px:
            side.complain(
                f"must lie inside a picture of {side_px} pixels, in pixels and not as a "
                f"fraction, found {brief(side.value)}"
            )
    return place_px[0], place_px[1]


def _primary_pair(root: JsonValue) -> Pair:
    pair = root.require("primary_pair")
    if pair is None:
        return 0, 1
    before = len(root.problems)
    if isinstance(pair.value, dict):
        sides = [pair.require("left_camera"), pair.require("right_camera")]
        left, right = (0 if side is None else side.camera() for side in sides)
    elif isinstance(pair.value, list) and len(pair.value) == 2:
        left, right = pair.child(0).camera(), pair.child(1).camera()
    else:
        pair.complain(
            f"must be {{left_camera, right_camera}} or a list of two cameras, "
            f"found {brief(pair.value)}"
        )
        return 0, 1
    if left == right and len(root.problems) == before:
        pair.complain(f"has camera {left} on both sides")
    return left, right


def _pairwise(root: JsonValue) -> dict[Pair, float]:
    """Return the baseline of each pair in cm; each of the 15 pairs must be there once."""
    entries = root.require("pairwise_pairs")
    if entries is None:
        return {}
    seen: dict[Pair, str] = {}
    baselines_cm: dict[Pair, float] = {}
    for entry in entries.objects():
        pair, baseline_cm = _pair_of(entry), entry.require("baseline_cm")
        length_cm = math.nan if baseline_cm is None else baseline_cm.positive()
        if pair is None:
            continue
        if pair in seen:
            entry.complain(
                f"cameras {pair[0]} and {pair[1]} are already at {seen[pair]}; "
                f"remove the wrong entry"
            )
            continue
        seen[pair] = entry.path
        baselines_cm[pair] = length_cm
    missing = [f"{a}-{b}" for a, b in CAMERA_PAIRS if (a, b) not in seen]
    if missing and isinstance(entries.value, list):
        entries.complain(
            f"must have each of the {len(CAMERA_PAIRS)} camera pairs once, "
            f"and lacks {', '.join(missing)}"
        )
    return baselines_cm


def _pair_of(entry: JsonValue) -> Pair | None:
    ends = [entry.require("camera_a"), entry.require("camera_b")]
    before = len(entry.problems)
    cameras = [end.camera() for end in ends if end is not None]
    if len(cameras) < 2 or len(entry.problems) > before:
        return None
    if cameras[0] == cameras[1]:
        entry.complain(f"has camera {cameras[0]} twice")
        return None
    return min(cameras), max(cameras)


def _require_adjacent_agree(root: JsonValue, baselines_cm: dict[Pair, float]) -> None:
    """Record a problem where a second record of an adjacent baseline differs from the first."""
    records: list[tuple[Pair, JsonValue]] = []
    entries = root.find("adjacent_pairs")
    for entry in [] if entries is None else entries.objects():
        pair, baseline_cm = _pair_of(entry), entry.require("baseline_cm")
        if pair is not None and baseline_cm is not None:
            records.append((pair, baseline_cm))
    lengths = root.find("adjacent_cm")
    if lengths is not None:
        if not isinstance(lengths.value, list) or len(lengths.value) != len(ADJACENT_PAIRS):
            lengths.complain(
                f"must be a list of {len(ADJACENT_PAIRS)} baselines, found {brief(lengths.value)}"
            )
        else:
            records += [(pair, lengths.child(place)) for place, pair in enumerate(ADJACENT_PAIRS)]
    for pair, record in records:
        again_cm, first_cm = record.positive(), baselines_cm.get(pair, math.nan)
        if abs(again_cm - first_cm) > _AGREEMENT * first_cm:
            record.complain(
                f"the baseline of cameras {pair[0]} and {pair[1]} is {again_cm:.9g} cm here "
                f"and {first_cm:.9g} cm in pairwise_pairs"
            )


def unit_m(root: JsonValue) -> float:
    """Return the metres in the unit of a file's lengths; Unreal's centimetre where none is named.

    Other units are recorded as a problem.
    """
    unit = root.find("unit")
    if unit is None:
        return 0.01
    metres = UNITS_M.get(unit.value.strip().lower()) if isinstance(unit.value, str) else None
    if metres is None:
        unit.complain(f"must be one of {', '.join(UNITS_M)}, found {brief(unit.value)}")
        return 0.01
    return metres


def require_six_cameras(root: JsonValue) -> None:
    """Record a problem where a file says that the rig does not have six cameras."""
    count = root.find("camera_count")
    if count is not None and count.integer() != CAMERA_COUNT:
        count.complain(f"a rig has {CAMERA_COUNT} cameras, found {brief(count.value)}")
