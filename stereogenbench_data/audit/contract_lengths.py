"""Answers on what disparity shows of lengths: unit / (focal length x baseline), one quotient."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from stereogenbench_data.audit.contract_answers import (
    CAMERAS_DIFFER,
    Answer,
    behind,
    changes,
    has_doubts,
    said,
)
from stereogenbench_data.audit.contract_diagnosis import (
    BIAS_PX,
    LEAST_LOG_SCALE,
    SceneDiagnosis,
    allowed_log_scale,
)
from stereogenbench_data.audit.contract_statistics import LEAST_ERRORS, interval, pooled

_BIAS: Final = 0.002
"""Share by which quotients may be off however many pixels agree: interpolation, rounding."""
MARGIN: Final = 0.02
"""A quotient is confirmed if its 95 % interval lies within this share of what is declared."""
_LEAST_TOLERANCE: Final = 0.005

QUOTIENT: Final = "unit / (focal length x baseline)"
UNIT: Final = "metres a unit"
FOCAL: Final = "focal length"
_ALONE: Final = "not seen alone: only the quotient above is"


@dataclass(frozen=True, slots=True)
class Unit:
    """Metres in a stored unit of depth, if focal length and baselines are right.

    Attributes:
        metres: The value.
        uncertainty: Half its 95 % interval, as a share.
    """

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


def length_answers(scenes: Sequence[SceneDiagnosis], unit: Unit) -> tuple[Answer, ...]:
    """Return the answers on the quotient, on the unit and on the focal length.

    Of the last two nothing is ever told by itself.
    """
    first = scenes[0]
    where = {"tag": "by the files' tag", "default": "by default", "user": "as given"}
    declared = f"{first.unit_m:g} m, {where.get(first.unit_source, 'tags unreadable')}"
    quotient = _quotient(scenes, unit)
    if first.problem:
        blank = (
            Answer(topic, "", "", "cannot tell", note=first.problem) for topic in (UNIT, FOCAL)
        )
        return quotient, *blank
    found = ""
    if quotient.found:
        found = f"{unit.metres:.5g} m ± {unit.uncertainty:.2%} if the rest is right"
    return (
        quotient,
        Answer(UNIT, declared, found, "not seen alone", note=_ALONE),
        Answer(FOCAL, "from the sensor's width", "", "not seen alone", note=_ALONE),
    )


def _quotient(scenes: Sequence[SceneDiagnosis], unit: Unit) -> Answer:
    first = scenes[0]
    blank = Answer(QUOTIENT, "1 x declared", "", "cannot tell", note=first.problem)
    if first.problem:
        return blank
    if has_doubts(scenes):
        return Answer(QUOTIENT, "1 x declared", "", "cannot tell", note=CAMERAS_DIFFER)
    found = f"{unit.metres / first.unit_m:.5g} x declared ± {unit.uncertainty:.2%}"
    if first.best.form != first.declared.form:
        note = f"numbers of another form: {said(first.best.form)} has a unit of its own"
        return Answer(QUOTIENT, "1 x declared", found, "cannot tell", note=note)
    if changes(first, "scale"):
        gain = pooled([scene.gain for scene in scenes])
        if kind_explains_scale(scenes):
            note = f"{found} if depth is along {said(first.best.kind)}, as declared if it is not"
            return Answer(QUOTIENT, "1 x declared", "", "cannot tell", gain, note)
        if unit.uncertainty > abs(math.log(unit.metres / first.unit_m)):
            note = f"{found} fits best, but is not surely another"
            return Answer(QUOTIENT, "1 x declared", "", "cannot tell", gain, note)
        note = "the unit, the focal length or the baselines: they are not told apart"
        return Answer(QUOTIENT, "1 x declared", found, "wrong", gain, note)
    doubt = _doubt(first, unit, found=found)
    if doubt:
        return Answer(QUOTIENT, "1 x declared", "", "cannot tell", note=doubt)
    if first.unit_source == "unreadable":
        return Answer(QUOTIENT, "tags unreadable", found, "cannot tell")
    note = f"the 95 % interval lies within {MARGIN:.0%} of what is declared"
    return Answer(QUOTIENT, "1 x declared", found, "confirmed", note=note)


def _doubt(first: SceneDiagnosis, unit: Unit, *, found: str) -> str:
    """Return why a quotient that nothing is clearly better than is not confirmed, if so."""
    off = abs(math.log(unit.metres / first.unit_m))
    is_coarse = allowed_log_scale(first.depth_step) > LEAST_LOG_SCALE
    why = "depth is stored in too large steps" if is_coarse else "too little parallax"
    if unit.uncertainty > MARGIN:
        return f"known to {unit.uncertainty:.0%} alone: {why}"
    if off > LEAST_LOG_SCALE:
        return f"{found} fits best, but is not clearly better{': ' + why if is_coarse else ''}"
    if off > max(unit.uncertainty, _LEAST_TOLERANCE):
        return f"{found} fits best; less than {LEAST_LOG_SCALE:.0%} is not called wrong"
    if off + unit.uncertainty > MARGIN:
        return f"{found}: the 95 % interval reaches beyond {MARGIN:.0%}"
    return ""


def length_choices(scenes: Sequence[SceneDiagnosis], unit: Unit, pasted: str) -> tuple[str, ...]:
    """Return what would each by itself explain the quotient, none of them certain.

    ``pasted`` is the contract with the unit that it would take if the rest is right.
    """
    first = scenes[0]
    factor = first.unit_m / unit.metres
    words = [f"if focal length and baselines are right: {pasted}"]
    if first.best.form == first.declared.form:
        focal = (
            f"if unit and baselines are right: a focal length of {factor:.4g} x what is recorded"
        )
        reading = _focal_reading(scenes, unit)
        if reading:
            focal += f", as {reading} gives"
        words += [
            focal,
            f"if unit and focal length are right: baselines of {factor:.4g} x those of the poses",
        ]
    return tuple(words)


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


def _focal_reading(scenes: Sequence[SceneDiagnosis], unit: Unit) -> str | None:
    """Return another reading of the sensor that gives the quotient found, if one does."""
    first = scenes[0]
    tolerance = max(LEAST_ERRORS * unit.uncertainty / 1.96, _LEAST_TOLERANCE)
    may_be = [
        words
        for words in first.focal_ratios
        if all(
            abs(math.log(scene.scale / scene.focal_ratios.get(words, 1.0))) <= tolerance
            for scene in scenes
        )
    ]
    return min(
        may_be,
        key=lambda words: abs(math.log(first.scale / first.focal_ratios[words])),
        default=None,
    )
