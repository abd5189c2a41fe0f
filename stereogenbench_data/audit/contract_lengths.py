"""Answers on the two lengths that disparity shows as one: metres a unit, and the focal length."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from stereogenbench_data.audit.contract_answers import Answer, Status, behind, changes, said
from stereogenbench_data.audit.contract_diagnosis import (
    BIAS_PX,
    LEAST_LOG_SCALE,
    SceneDiagnosis,
    allowed_log_scale,
)
from stereogenbench_data.audit.contract_statistics import LEAST_ERRORS, interval, pooled

_BIAS: Final = 0.002
"""Share by which units may be off however many pixels agree: interpolation, rounding of depth."""
_VAGUE: Final = 0.02
"""Half the 95 % interval of log(unit) beyond which the unit is not told."""
_LEAST_TOLERANCE: Final = 0.005
_COMMON_SLIP: Final = 0.12
"""Units are taken to be off by as much, as a share, or by as much more or less than twofold."""

_UNIT: Final = "metres a unit"
_FOCAL: Final = "focal length"
_WIDTH: Final = "from the width"


@dataclass(frozen=True, slots=True)
class Unit:
    """Metres in a stored unit of depth: value, and half its 95 % interval as a share."""

    metres: float
    uncertainty: float

    @property
    def rounded_m(self) -> float:
        """The shortest decimal number within 0.2 %."""
        for digits in range(1, 5):
            short = float(f"{self.metres:.{digits - 1}e}")
            if abs(short / self.metres - 1) <= 0.002:
                return short
        return float(f"{self.metres:.4e}")


def common_unit(scenes: Sequence[SceneDiagnosis]) -> Unit:
    """Return the unit that scenes agree on, weighted by how sure each is."""
    told = [scene for scene in scenes if math.isfinite(scene.scale_error)]
    coarse = max(allowed_log_scale(scene.depth_step) for scene in scenes)
    seen_px = max(
        # An offset leaves to the scale what is no offset.
        scene.spread_px if changes(scene, "offset") else scene.disparity_px
        for scene in scenes
    )
    bias = coarse if coarse > LEAST_LOG_SCALE else max(_BIAS, BIAS_PX / seen_px)
    if not told:
        return Unit(scenes[0].unit_m / scenes[0].scale, math.inf)
    logs = np.array([math.log(scene.unit_m / scene.scale) for scene in told])
    errors = np.array([max(scene.scale_error, 1e-4) for scene in told])
    weights = errors**-2.0 / (errors**-2.0).sum()
    half = 1.96 * float(np.sqrt((weights**2 * errors**2).sum()))
    if len(told) > 2:
        _, low, high = interval([float(log) for log in logs])
        half = max(half, (high - low) / 2)
    return Unit(math.exp(float(weights @ logs)), math.hypot(half, bias))


def length_answers(scenes: Sequence[SceneDiagnosis], unit: Unit) -> tuple[Answer, Answer]:
    """Return the answers on the unit and on the focal length, of which one quotient is seen."""
    first = scenes[0]
    where = {"tag": "by the files' tag", "default": "by default", "user": "as given"}
    declared = f"{first.unit_m:g} m, {where.get(first.unit_source, 'tags unreadable')}"
    found = f"{unit.metres:.5g} m ± {unit.uncertainty:.2%}"
    if first.best.form == "inverse":
        found = f"depth = {found} / stored"
    if not first.problem and changes(first, "scale"):
        return _wrong_length(scenes, unit, declared=declared, found=found)
    note = first.problem or _doubt(first, unit, found=found)
    if note:
        blank = Answer(_UNIT, declared, "", "cannot tell", note=note)
        return blank, _focal(first, status="cannot tell", note=note)
    if first.unit_source == "unreadable":
        return Answer(_UNIT, declared, found, "wrong"), _focal(first, status="cannot tell")
    known = Answer(_UNIT, declared, found, "confirmed")
    reading = _focal_reading(scenes, unit, least=0.0)
    if reading is not None:
        note = f"{reading} is within the error of the unit"
        return known, _focal(first, status="cannot tell", note=note)
    return known, _focal(first, status="confirmed", note="with the declared unit")


def _doubt(first: SceneDiagnosis, unit: Unit, *, found: str) -> str:
    """Return why a unit that nothing is clearly better than is not confirmed either, if so."""
    off = abs(math.log(unit.metres / first.unit_m))
    is_coarse = allowed_log_scale(first.depth_step) > LEAST_LOG_SCALE
    why = "depth is stored in too large steps" if is_coarse else "too little parallax"
    if unit.uncertainty > _VAGUE:
        return f"known to {unit.uncertainty:.0%} alone: {why}"
    if off > LEAST_LOG_SCALE:
        return f"{found} fits best, but is not clearly better{': ' + why if is_coarse else ''}"
    if off > max(unit.uncertainty, _LEAST_TOLERANCE):
        return f"{found} fits best; less than {LEAST_LOG_SCALE:.0%} is not called wrong"
    return ""


def _wrong_length(
    scenes: Sequence[SceneDiagnosis], unit: Unit, *, declared: str, found: str
) -> tuple[Answer, Answer]:
    """Return the same where disparity is off by a factor."""
    first = scenes[0]
    gain = pooled([scene.gain for scene in scenes])
    if kind_explains_scale(scenes):
        note = f"{found} if depth is along {said(first.best.kind)}, as declared if it is not"
        return Answer(_UNIT, declared, "", "cannot tell", gain, note), _focal(
            first, status="cannot tell"
        )
    if first.best.form != first.declared.form:
        note = "numbers of another form: no factor is left to compare"
        unknown = _focal(first, status="cannot tell", note=note)
        return Answer(_UNIT, declared, found, "wrong", gain), unknown
    reading = _focal_reading(scenes, unit, least=_LEAST_TOLERANCE)
    if reading is None:
        note = "no other reading of the sensor explains the factor; wrong millimetres would"
        kept = _focal(first, status="confirmed", note=note)
        return Answer(_UNIT, declared, found, "wrong", gain), kept
    if _is_blamed(scenes, unit, reading):
        alike = f"the same as a unit of {unit.metres:.5g} m: only focal length / unit is seen"
        return (
            Answer(_UNIT, declared, "", "cannot tell", note="right if the focal length is wrong"),
            Answer(_FOCAL, _WIDTH, reading, "wrong", gain, f"{alike}, and the unit is stated"),
        )
    note = "or it is right and the focal length wrong: these two cannot be told apart"
    other = "or it is right and the unit wrong: these two cannot be told apart"
    return (
        Answer(_UNIT, declared, found, "one is wrong", gain, note),
        Answer(_FOCAL, _WIDTH, reading, "one is wrong", gain, other),
    )


def _is_blamed(scenes: Sequence[SceneDiagnosis], unit: Unit, reading: str) -> bool:
    """Tell whether a reading of the focal length is to blame rather than the unit.

    The pictures show focal length / unit alone. What decides is that the unit is stated, and that
    the reading explains the very factor, which is none that units are commonly off by.
    """
    if scenes[0].unit_source not in ("tag", "user"):
        return False
    ratio = scenes[0].focal_ratios[reading]
    if any(abs(math.log(ratio / slip)) < _COMMON_SLIP for slip in (1.0, 2.0, 0.5)):
        return False
    return _explains(reading, scenes, min(LEAST_LOG_SCALE, _tolerance(unit, _LEAST_TOLERANCE)))


def kind_explains_scale(scenes: Sequence[SceneDiagnosis]) -> bool:
    """Tell whether the other kind of depth explains all that a scale does, and is not ruled out."""
    first = scenes[0]
    if first.best != first.declared or first.changed != "scale":
        return False
    if any(behind(scenes, rival).is_clear for rival in first.rivals if rival.question == "kind"):
        return False
    return all(
        abs(math.log(scene.other_kind_scale))
        <= allowed_log_scale(scene.depth_step) + LEAST_ERRORS * min(scene.scale_error, 1.0)
        for scene in scenes
        if scene.other_kind_scale > 0
    )


def _focal(first: SceneDiagnosis, *, status: Status, note: str = "") -> Answer:
    """Return the answer on the focal length, which does not matter where all readings agree."""
    if not first.focal_ratios:
        same = "width and height say the same"
        return Answer(_FOCAL, _WIDTH, _WIDTH, "does not matter", note=same)
    return Answer(_FOCAL, _WIDTH, _WIDTH if status == "confirmed" else "", status, note=note)


def _focal_reading(scenes: Sequence[SceneDiagnosis], unit: Unit, *, least: float) -> str | None:
    """Return the reading of the focal length that explains all the scale, if one may.

    ``least`` is the smallest difference in log(scale) that rules a reading out.
    """
    first = scenes[0]
    tolerance = _tolerance(unit, least)
    may_be = [words for words in first.focal_ratios if _explains(words, scenes, tolerance)]
    return min(
        may_be,
        key=lambda words: abs(math.log(first.scale / first.focal_ratios[words])),
        default=None,
    )


def _tolerance(unit: Unit, least: float) -> float:
    return max(LEAST_ERRORS * unit.uncertainty / 1.96, least)


def _explains(words: str, scenes: Sequence[SceneDiagnosis], tolerance: float) -> bool:
    return all(
        abs(math.log(scene.scale / scene.focal_ratios.get(words, 1.0))) <= tolerance
        for scene in scenes
    )
