"""``baseline.json``: the camera, the 15 baselines and the primary pair."""

import math
from typing import Final, Literal

from stereogenbench_data.schema.document import parse_object
from stereogenbench_data.schema.labels import labels_of
from stereogenbench_data.schema.nodes import Node, axes_of, require_six_cameras, unit_m
from stereogenbench_data.schema.problems import Problems, brief
from stereogenbench_data.schema.records import Rig, SceneLabels
from stereogenbench_data.schema.release import (
    ADJACENT_PAIRS,
    CAMERA_PAIRS,
    IMAGE_SIZE_PX,
)
from stereogenbench_data.schema.spellings import AXES

_AGREEMENT: Final = 1e-6
"""How far two records of one baseline may differ, relative: ten float32 roundings."""

Pair = tuple[int, int]


def parse_rig(text: bytes, *, where: str) -> tuple[Rig, SceneLabels]:
    """Return the rig and the identifiers that a ``baseline.json`` records.

    Where no image size is recorded it is the release's 1280 x 1280 (``image_size_source`` says
    so); where no sensor height is recorded pixels are square, as the paper's loading example
    takes them to be. A principal point is in pixels of the recorded image, with the centre of
    the top-left pixel at (0.5, 0.5).

    Args:
        text: The file's bytes.
        where: The file's path, for messages.

    Raises:
        SchemaError: If the file does not follow the format; every problem is told.

    Source: the paper's appendix on the file schema.
    """
    problems = Problems(where)
    root = Node(parse_object(text, where=where), "$", problems)
    unit_m(root)
    require_six_cameras(root)
    width_px, height_px, size_source = _image_size(root)
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
        image_size_source=size_source,
    )
    labels = labels_of(root)
    problems.require_none()
    return rig, labels


def _required_positive(root: Node, quantity: str) -> float:
    found = root.require(quantity)
    return 1.0 if found is None else found.positive()


def _image_size(root: Node) -> tuple[int, int, Literal["recorded", "default"]]:
    width, height = root.find("image_width_px"), root.find("image_height_px")
    if width is None and height is None:
        return IMAGE_SIZE_PX, IMAGE_SIZE_PX, "default"
    return _size(width), _size(height), "recorded"


def _size(side: Node | None) -> int:
    if side is None:
        return IMAGE_SIZE_PX
    size_px = side.integer()
    if size_px <= 0:
        side.complain(f"must be a number of pixels above zero, found {brief(side.value)}")
        return 1
    return size_px


def _principal_point(root: Node, *, size_px: tuple[int, int]) -> tuple[float, float] | None:
    point = root.find("principal_point_px")
    x, y = root.find("principal_x_px"), root.find("principal_y_px")
    if point is not None:
        values = axes_of(point.value, AXES["principal_point_px"])
        if values is None:
            point.complain(
                f"must be {{x, y}} or [x, y] in pixels, found {brief(point.value)}; "
                f"leave it out where it is the image's centre"
            )
            return None
        x, y = (Node(value, point.path, root.problems) for value in values)
    if x is None and y is None:
        return None
    if x is None or y is None:
        given = x or y or root
        given.complain("one coordinate of the principal point is recorded and the other is not")
        return None
    for place, side_px in zip((x, y), size_px, strict=True):
        if not 1 < place.number() < side_px:
            place.complain(
                f"must be a place inside a picture of {side_px} pixels, in pixels and not as a "
                f"share, found {brief(place.value)}"
            )
    return x.number(), y.number()


def _primary_pair(root: Node) -> Pair:
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
        pair.complain(f"names camera {left} as left and as right")
    return left, right


def _pairwise(root: Node) -> dict[Pair, float]:
    """Return the baseline in cm of each pair; note problems unless all 15 are there once."""
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
                f"cameras {pair[0]} and {pair[1]} were already given at {seen[pair]}; "
                f"keep the right one of the two"
            )
            continue
        seen[pair] = entry.path
        baselines_cm[pair] = length_cm
    missing = [f"{a}-{b}" for a, b in CAMERA_PAIRS if (a, b) not in seen]
    if missing and isinstance(entries.value, list):
        entries.complain(
            f"must have each of the {len(CAMERA_PAIRS)} pairs of cameras once, "
            f"and has none for {', '.join(missing)}"
        )
    return baselines_cm


def _pair_of(entry: Node) -> Pair | None:
    ends = [entry.require("camera_a"), entry.require("camera_b")]
    before = len(entry.problems)
    cameras = [end.camera() for end in ends if end is not None]
    if len(cameras) < 2 or len(entry.problems) > before:
        return None
    if cameras[0] == cameras[1]:
        entry.complain(f"names camera {cameras[0]} twice")
        return None
    return min(cameras), max(cameras)


def _require_adjacent_agree(root: Node, baselines_cm: dict[Pair, float]) -> None:
    """Note a problem where the adjacent baselines, recorded a second time, are different."""
    records: list[tuple[Pair, Node]] = []
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
                f"and {first_cm:.9g} cm among the pairwise ones"
            )
