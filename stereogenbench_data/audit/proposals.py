"""What a file of conventions might say where nothing is settled: candidates, best first.

Near spellings of the printed keys are ranked by what geometry says of them: rows of numbers that
are the distances of the poses, a lens that cameras have, forms of poses that fit the rig. They are
proposals for a person to read, and nothing is read by them until they stand in a file.
"""

import difflib
import itertools
import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np

from stereogenbench_data.errors import SchemaError
from stereogenbench_data.geometry.pose_evidence import every_fitting
from stereogenbench_data.schema.conventions import parse_conventions
from stereogenbench_data.schema.declaration import BUILT_IN, NumberAt, PairsAt, PrimaryPairAt
from stereogenbench_data.schema.document import child_path, is_number
from stereogenbench_data.schema.parse import camera_named, found_pairs, parse_rig
from stereogenbench_data.schema.places import first_value, value_at
from stereogenbench_data.schema.pose_search import recorded_in
from stereogenbench_data.schema.records import Rig
from stereogenbench_data.schema.release import CAMERA_COUNT, CAMERA_PAIRS, SENSOR_MM
from stereogenbench_data.schema.trajectory import parse_trajectory
from stereogenbench_data.schema.units import ANGLES, PIXELS, UNITS_M, without_unit, words

MOST: Final = 3
"""How many candidates of a table are shown."""
_MOST_NODES: Final = 2000
_DEEPEST: Final = 6
_LONGEST: Final = 40
_LENSES: Final = (0.4, 6.0)
"""Focal lengths in widths of the sensor; the release has 0.76 to 3.6."""
_FOCAL: Final = {"focal", "fl", "lens", "f", "zoom", "focallength"}
_ANGLE: Final = {"fov", "hfov", "angle", "field"}
_SENSOR: Final = {"sensor", "film", "filmback", "aperture", "gate", "back", "chip"}
_ACROSS: Final = {"height", "h", "vertical", "y", "fstop", "px"}
_ALIKE: Final = 0.01
"""By what share distances may differ from one multiple of those of the poses."""
_LEFT, _RIGHT = (list(cameras) for cameras in zip(*CAMERA_PAIRS, strict=True))


@dataclass(frozen=True, slots=True)
class Candidate:
    """What might be stated.

    Attributes:
        table: The name of its table.
        values: Its keys and values.
        why: What speaks for it.
    """

    table: str
    values: Mapping[str, str | float | bool]
    why: str

    @property
    def lines(self) -> list[str]:
        """The table as it stands in a file."""
        values = [f"{key} = {json.dumps(value)}" for key, value in self.values.items()]
        return [f"# {self.why}", f"[{self.table}]", *values]


def proposed(baseline: bytes, trajectory: bytes, *, where: str) -> list[list[Candidate]]:
    """Return candidates for what a scene's files do not say as the built-in declaration reads it.

    Args:
        baseline: The bytes of its ``baseline.json``.
        trajectory: Those of its ``trajectory.json``; empty without one.
        where: The scene, for messages.

    Returns:
        For each table that is missing its candidates, the best first; of poses only where a rig is
        known, by the files or by the best candidates.

    Raises:
        SchemaError: If a file is no JSON object.
    """
    document = parse_trajectory(baseline, where=where)
    moves = parse_trajectory(trajectory, where=where) if trajectory else None
    lacks = [name for name in ("focal_length", "sensor_width")
             if not first_value(document, BUILT_IN.numbers[name].places)[0]]  # fmt: skip
    groups = [*_lens(document, lacks)]
    rig_alone = _with_rows(BUILT_IN.pairs)
    try:
        parse_rig(baseline, where=where, declared=rig_alone)
    except SchemaError:
        groups.append(_pairs(baseline, document, moves, where=where))
    if not first_value(document, BUILT_IN.primary_pair.left)[0]:
        groups.append([*_primary_pairs(document)])
    groups = [group[:MOST] for group in groups if group]
    rig = _rig_of(baseline, [group[0] for group in groups], where=where)
    if rig is not None and trajectory:
        groups += _poses(trajectory, rig, where=where)
    return groups


def _with_rows(pairs: PairsAt) -> Any:
    """Return a declaration by which all but the baselines of a file are known."""
    numbers = {name: NumberAt(value=1.0, unit="mm", is_needed=True)
               for name in ("focal_length", "sensor_width")}  # fmt: skip
    nowhere = PrimaryPairAt(left=("$.nowhere",), right=("$.nowhere",), is_needed=False)
    return replace(BUILT_IN, numbers=numbers, pairs=pairs, gaps=None, primary_pair=nowhere)


def text_of(candidates: Iterable[Candidate]) -> str:
    """Return candidates as a file of conventions."""
    return "\n".join(["format = 2", *(line for each in candidates for line in each.lines)]) + "\n"


def _rig_of(baseline: bytes, best: Iterable[Candidate], *, where: str) -> Rig | None:
    with suppress(SchemaError):
        (declared,) = parse_conventions(text_of(best).encode(), where=where).shapes
        return parse_rig(baseline, where=where, declared=declared)[0]
    return None


def _nodes(document: dict[str, Any]) -> Iterator[tuple[str, str, Any]]:
    """Yield path, name and value of what a document has, the outermost first."""
    waiting: list[tuple[str, str, Any, int]] = [("$", "", document, 0)]
    for path, name, node, depth in itertools.islice(waiting, _MOST_NODES):  # which grows
        if depth:
            yield path, name, node
        if isinstance(node, dict) and depth < _DEEPEST:
            waiting += [(child_path(path, key), words(key), value, depth + 1)
                        for key, value in node.items()]  # fmt: skip


def _numbers(document: dict[str, Any]) -> Iterator[tuple[str, str, float, str]]:
    """Yield place, name without unit, value and unit of numbers, also of those in short texts."""
    for path, name, node in _nodes(document):
        name, unit = without_unit(name)
        if is_number(node) and node > 0:
            yield path, name, float(node), unit
        elif isinstance(node, str) and len(node) < _LONGEST and path[-1] != "]":
            found = value_at(document, f"{path}~")
            beside = words(node).split("_")[-1]
            if len(found) == 1 and found[0] > 0:
                yield f"{path}~", name, found[0], beside if beside in UNITS_M else unit


def _lens(document: dict[str, Any], lacks: list[str]) -> Iterator[list[Candidate]]:
    """Yield the candidates for focal length and sensor width, those that make a lens first."""
    found: dict[str, list[_Length]] = {name: [] for name in ("focal_length", "sensor_width")}
    at, focal_px = first_value(document, BUILT_IN.numbers["focal_length_px"].places)
    if at and is_number(focal_px):
        found["focal_length"].append(_length("focal_length", at, focal_px, "px", "pixels"))
    for place, name, value, unit in _numbers(document):
        parts = {*name.split("_")}
        if parts & (_FOCAL | _ANGLE) and "px" not in parts:
            as_ = "field of view" if parts & _ANGLE and "focal" not in parts else ""
            as_ = "pixels" if unit in PIXELS else as_
            usual = unit if unit in (*UNITS_M, *ANGLES) else "" if as_ else "mm"
            found["focal_length"].append(_length("focal_length", place, value, usual, as_))
        elif parts & _SENSOR and not parts & _ACROSS:
            usual = unit if unit in UNITS_M else "mm"
            found["sensor_width"].append(_length("sensor_width", place, value, usual, ""))
    if not found["sensor_width"]:
        told = "no key speaks of a sensor; this is the one of scenes in the public viewer"
        viewer = Candidate("sensor_width", {"value": SENSOR_MM, "unit": "mm"}, told)
        found["sensor_width"] = [(0.0, viewer, SENSOR_MM)]
    for name in {*found} - {*lacks}:
        printed = BUILT_IN.numbers[name].places[0]
        value = first_value(document, [printed])[1]
        found[name] = [_length(name, printed, value if is_number(value) else 0.0, "mm", "")]
    lenses = sorted(itertools.product(*found.values()), key=_is_odd_lens)
    for side, name in enumerate(found):
        if name in lacks:
            yield [*{id(lens[side]): lens[side][1] for lens in lenses}.values()]


_Length = tuple[float, Candidate, float]
"""How near a key is to the printed one, the candidate, and its length in mm, 0 without one."""


def _is_odd_lens(lens: tuple[_Length, ...]) -> tuple[bool, float]:
    """Return whether a focal length and a sensor make no lens, and how far the keys are off."""
    (near_focal, _, focal_mm), (near_sensor, _, sensor_mm) = lens
    is_odd = focal_mm * sensor_mm > 0 and not (
        _LENSES[0] * sensor_mm <= focal_mm <= _LENSES[1] * sensor_mm
    )
    return is_odd, -near_focal - near_sensor


def _length(table: str, place: str, value: float, unit: str, as_: str) -> _Length:
    """Return a candidate for a length."""
    printed = BUILT_IN.numbers[table].places[0]
    near = difflib.SequenceMatcher(None, printed.lower(), place.lower()).ratio()
    values = {"place": place} | ({"as": as_} if as_ else {}) | ({"unit": unit} if unit else {})
    mm = 0.0 if as_ else value * UNITS_M.get(unit, 1e-3) * 1000
    return near, Candidate(table, values, f"{value:g} stands there"), mm


def _pairs(
    baseline: bytes, document: dict[str, Any], moves: dict[str, Any] | None, *, where: str
) -> list[Candidate]:
    """Return rows that may be the baselines; those that are distances of the poses come first."""
    apart = _distances(moves, where=where)
    ranked: list[tuple[float, Candidate]] = []
    for path, name, node in _nodes(document):
        if not (isinstance(node, dict | list) and len(node) >= CAMERA_COUNT - 1):
            continue
        with suppress(SchemaError, LookupError):
            pairs = _rows_below(document, path, node)
            rig, _, _ = parse_rig(baseline, where=where, declared=_with_rows(pairs))
            lengths = np.array(rig.baselines_cm)
            off, why = 1.0, "15 lengths of pairs of cameras"
            for each, unit_m in apart:
                ratio = lengths / each
                if np.ptp(ratio) <= _ALIKE * ratio.min():
                    off, why = 0.0, "they are the distances of the poses"
                    stated_m = float(np.median(each * unit_m / lengths)) * UNITS_M[pairs.unit] * 100
                    units = (u for u in ("cm", "m", "mm", "inch", "ft")
                             if abs(stated_m / UNITS_M[u] - 1) < _ALIKE)  # fmt: skip
                    pairs = replace(pairs, unit=next(units, pairs.unit))
            near = difflib.SequenceMatcher(None, "pairwise_pairs", name).ratio()
            values = {key: getattr(pairs, key) for key in ("rows", "a", "b", "length", "unit")}
            kept = {key: value for key, value in values.items() if value}
            ranked.append((off - near, Candidate("pairs", kept, why)))
    return [candidate for _, candidate in sorted(ranked, key=lambda each: each[0])]


def _rows_below(document: dict[str, Any], path: str, node: Any) -> PairsAt:
    """Return how rows below a place may be read.

    Raises:
        SchemaError: If they do not tell.
        LookupError: If there are none.
    """
    if isinstance(node, list) and all(isinstance(row, list) and len(row) == CAMERA_COUNT
                                      for row in node):  # fmt: skip
        unit = without_unit(words(path))[1]
        return PairsAt(rows=f"{path}[][]", a="#0", b="#1", unit=unit if unit in UNITS_M else "cm")
    return found_pairs(document, PairsAt(rows=path, unit=""))


def _distances(moves: dict[str, Any] | None, *, where: str) -> list[tuple[np.ndarray, float]]:
    """Return the distances of cameras in the first frame, by each recorded place, and its unit."""
    if moves is None:
        return []
    with suppress(SchemaError):
        recorded = recorded_in(moves, where=where)
        blocks = [block for block in recorded.blocks if block.values.shape[2:] in ((3,), (4, 4))]
        places = [(block.values[0, :, :3, 3] if block.values.ndim == 4 else block.values[0], block)
                  for block in blocks]  # fmt: skip
        found = [
            (np.linalg.norm(place[_RIGHT] - place[_LEFT], axis=-1),
             UNITS_M.get(block.unit, recorded.unit_m or UNITS_M["cm"]))
            for place, block in places
        ]  # fmt: skip
        return [(each, unit_m) for each, unit_m in found if each.min() > 0]
    return []


def _primary_pairs(document: dict[str, Any]) -> Iterator[Candidate]:
    """Yield where the left and the right camera may stand."""
    for path, name, node in _nodes(document):
        about = {*name.split("_")}
        if isinstance(node, list) and len(node) == 2 and None not in map(camera_named, node):
            values = {"left": f"{path}[0]", "right": f"{path}[1]"}
            yield Candidate("primary_pair", values, f"{node[0]!r} and {node[1]!r} stand there")
        elif "left" in about and camera_named(node) is not None:
            right = path.replace("left", "right").replace("Left", "Right")
            at, other = first_value(document, [right])
            if at and camera_named(other) is not None:
                values = {"left": path, "right": right}
                yield Candidate("primary_pair", values, f"{node!r} and {other!r} stand there")
    values = {"left": "$.primary_stereo_pair[0]", "right": "$.primary_stereo_pair[1]"}
    told = "without one, cameras 0 and 1 are taken"
    yield Candidate("primary_pair", values | {"optional": True}, told)


def _poses(trajectory: bytes, rig: Rig, *, where: str) -> Iterator[list[Candidate]]:
    """Yield the forms of poses that fit a rig, if those that are settled do not."""
    with suppress(SchemaError):
        found = every_fitting(trajectory, rig, where=where)
        if found is not None:
            yield [
                Candidate("poses", {part.name: getattr(at, part.name) for part in fields(at)
                                    if getattr(at, part.name) is not None}, why)
                for at, why in found
            ]  # fmt: skip
