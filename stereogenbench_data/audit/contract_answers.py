"""An answer for each question, from what the scenes with one contract say."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from stereogenbench_data.audit.contract_diagnosis import (
    LEAST_LOG_SCALE,
    LEAST_OFFSET_PX,
    Rival,
    SceneDiagnosis,
    allowed_log_scale,
)
from stereogenbench_data.audit.contract_hypotheses import Question
from stereogenbench_data.audit.contract_statistics import (
    LEAST_DB,
    LEAST_ERRORS,
    Gain,
    interval,
    pooled,
)

Status = Literal["confirmed", "wrong", "cannot tell", "does not matter"]

TOPICS: Final[dict[Question, str]] = {
    "kind": "depth along",
    "form": "stored is",
    "frame_lag": "frame lag",
    "order": "left and right",
    "flip": "flip of depth",
}
_WORDS: Final[dict[Any, str]] = {
    "planar": "the optical axis",
    "ray": "the ray",
    "inverse": "inverse depth",
}
_BIAS: Final = 0.002
"""Share by which units may be off however many pixels agree: interpolation, rounding of depth."""
_BIAS_PX: Final = 0.05
"""The same in pixels of disparity; measured up to that on small pictures with little parallax."""
_OFFSET_SPREAD: Final = 0.1
"""Share by which one camera's shift may differ from pair to pair."""
_VAGUE: Final = 0.05
"""Half the 95 % interval of log(unit) beyond which the unit is not told."""

_UNIT: Final = "metres a unit"
_FOCAL: Final = "focal length"
_WIDTH: Final = "from the width"


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to one question.

    Attributes:
        topic: What is asked.
        declared: What the data declare.
        found: What the pictures say; empty where they do not tell.
        status: Whether that confirms what is declared.
        behind: By how much the next best answer is worse, where that can be said in dB.
        note: Why, in words; may be empty.
    """

    topic: str
    declared: str
    found: str
    status: Status
    behind: Gain | None = None
    note: str = ""


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


def structure_answer(scenes: Sequence[SceneDiagnosis], question: Question) -> Answer:
    """Return the answer to one question of structure, and how far the next best is behind."""
    first = scenes[0]
    topic = TOPICS[question]
    declared, best = (getattr(part, question) for part in (first.declared, first.best))
    if first.problem:
        return Answer(topic, said(declared), "", "cannot tell", note=first.problem)
    rivals = {rival.answer: _behind(scenes, rival) for rival in first.rivals
              if rival.question == question}  # fmt: skip
    untested = [answer for answer, gain in rivals.items() if math.isnan(gain.mean_db)]
    close = [
        answer for answer, gain in rivals.items() if answer not in untested and not gain.is_clear
    ]
    nearest = min(
        (gain for answer, gain in rivals.items() if answer not in untested),
        key=lambda gain: gain.mean_db,
        default=None,
    )
    note = ""
    if untested and question == "frame_lag":
        note = f"not tested, for want of frames: {', '.join(map(said, untested))}"
    if nearest is not None and nearest.by_shape and nearest.mean_db < LEAST_DB:
        note = "told by how disparity grows towards the corners, not by the dB"
    if best == declared and close:
        told = ", ".join(said(answer) for answer in [best, *close])
        return Answer(topic, said(declared), "", "cannot tell", nearest, f"fit alike: {told}")
    if question == "order" and best == "as recorded" and first.recorded_pair is not None:
        left, right = first.recorded_pair
        named, told = f"primary: left {left}, right {right}", f"left {right}, right {left}"
        return Answer(topic, named, told, "wrong", nearest, "by poses and pictures alike")
    if best == declared:
        return Answer(topic, said(declared), said(best), "confirmed", nearest, note)
    if close:
        note = f"fit alike: {', '.join(said(answer) for answer in [best, *close])}"
    if declared in close:
        note += ", each with its own unit"
        return Answer(topic, said(declared), "", "cannot tell", rivals[declared], note)
    found = " or ".join(said(answer) for answer in [best, *close])
    return Answer(topic, said(declared), found, "wrong", rivals.get(declared), note)


def _behind(scenes: Sequence[SceneDiagnosis], rival: Rival) -> Gain:
    return pooled([
        other.behind
        for scene in scenes
        for other in scene.rivals
        if (other.question, other.answer) == (rival.question, rival.answer)
        and scene.best == scenes[0].best
    ])  # fmt: skip


def said(answer: Any) -> str:
    """Return an answer in words."""
    return _WORDS.get(answer, f"{answer}")


def common_unit(scenes: Sequence[SceneDiagnosis]) -> Unit:
    """Return the unit that scenes agree on, weighted by how sure each is."""
    told = [scene for scene in scenes if math.isfinite(scene.scale_error)]
    coarse = max(allowed_log_scale(scene.depth_step) for scene in scenes)
    seen_px = max(scene.disparity_px for scene in scenes)
    bias = coarse if coarse > LEAST_LOG_SCALE else max(_BIAS, _BIAS_PX / seen_px)
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
    """Return the answers on the unit and on the focal length, of which one product is seen."""
    first = scenes[0]
    where = {"tag": "by the files' tag", "default": "by default", "user": "as given"}
    declared = f"{first.unit_m:g} m, {where.get(first.unit_source, 'tags unreadable')}"
    note = first.problem
    if not note and unit.uncertainty > _VAGUE and not changes(first, "scale"):
        coarse = allowed_log_scale(first.depth_step) > _VAGUE
        why = "depth is stored in too large steps" if coarse else "too little parallax"
        note = f"known to {unit.uncertainty:.0%} alone: {why}"
    if note:
        blank = Answer(_UNIT, declared, "", "cannot tell", note=note)
        return blank, _focal(first, status="cannot tell", note=note)
    found = f"{unit.metres:.5g} m ± {unit.uncertainty:.2%}"
    if first.best.form == "inverse":
        found = f"depth = {found} / stored"
    if changes(first, "scale"):
        return _wrong_length(scenes, unit, declared=declared, found=found)
    if first.unit_source == "unreadable":
        return Answer(_UNIT, declared, found, "wrong"), _focal(first, status="cannot tell")
    off = abs(math.log(unit.metres / first.unit_m))
    if off > LEAST_LOG_SCALE and allowed_log_scale(first.depth_step) > LEAST_LOG_SCALE:
        note = f"{found} fits best; depth is stored in too large steps to tell"
        unsure = Answer(_UNIT, declared, "", "cannot tell", note=note)
        return unsure, _focal(first, status="cannot tell", note=note)
    known = Answer(_UNIT, declared, found, "confirmed")
    return known, _focal(first, status="confirmed", note="with the declared unit")


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
    reading = _focal_reading(scenes, unit)
    if reading is None:
        note = "no other reading of the sensor explains the factor"
        kept = _focal(first, status="confirmed", note=note)
        return Answer(_UNIT, declared, found, "wrong", gain), kept
    alike = f"the same as a unit of {unit.metres:.5g} m: only focal length / unit is seen"
    if first.unit_source in ("tag", "user"):
        return (
            Answer(_UNIT, declared, "", "cannot tell", note="right if the focal length is wrong"),
            Answer(_FOCAL, _WIDTH, reading, "wrong", gain, f"{alike}, and the unit is stated"),
        )
    return (
        Answer(_UNIT, declared, found, "wrong", gain, f"or the focal length is {reading}"),
        Answer(_FOCAL, _WIDTH, "", "cannot tell", note=f"{reading} is {alike}"),
    )


def kind_explains_scale(scenes: Sequence[SceneDiagnosis]) -> bool:
    """Tell whether the other kind of depth explains all that a scale does, and is not ruled out."""
    first = scenes[0]
    if first.best != first.declared or first.changed != "scale":
        return False
    if any(_behind(scenes, rival).is_clear for rival in first.rivals if rival.question == "kind"):
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


def changes(scene: SceneDiagnosis, length: str) -> bool:
    """Tell whether a scene's best contract fits the scale, or the offset."""
    return scene.changed in (length, "both")


def _focal_reading(scenes: Sequence[SceneDiagnosis], unit: Unit) -> str | None:
    """Return the reading of the focal length that explains all the scale, if one does."""
    tolerance = min(max(LEAST_ERRORS * unit.uncertainty / 1.96, 0.005), LEAST_LOG_SCALE)
    for words in scenes[0].focal_ratios:
        if all(
            abs(math.log(scene.scale / scene.focal_ratios.get(words, 1.0))) <= tolerance
            for scene in scenes
        ):
            return words
    return None


def offset_answer(scenes: Sequence[SceneDiagnosis]) -> Answer:
    """Return whether disparity is off by a constant, and by which."""
    first = scenes[0]
    topic = "disparity offset"
    if first.problem:
        return Answer(topic, "0 px", "", "cannot tell", note=first.problem)
    if changes(first, "offset"):
        gain = pooled([scene.gain for scene in scenes])
        return Answer(topic, "0 px", offset_words(first.offsets_px), "wrong", gain)
    largest_px = max((abs(px) for scene in scenes for px in scene.offsets_px.values()), default=0.0)
    if largest_px > 4 * LEAST_OFFSET_PX or math.isnan(first.agreement):
        note = f"fits up to {largest_px:.2g} px, none clearly better than 0"
        return Answer(topic, "0 px", "", "cannot tell", note=note)
    return Answer(topic, "0 px", f"0 px (all pairs within {largest_px:.2f})", "confirmed")


def offset_words(offsets_px: dict[tuple[int, int], float]) -> str:
    """Return constant disparities in words: of all pairs, of one camera, or pair by pair."""
    values = list(offsets_px.values())
    if max(values) - min(values) < LEAST_OFFSET_PX:
        return f"{np.mean(values):+.2f} px for every pair"
    for camera in range(6):
        # A picture shifted to the right by s adds s to the disparity of its own pixels, and takes
        # s from pairs in which it is the right one.
        shifts = [
            px * (1 if pair[0] == camera else -1)
            for pair, px in offsets_px.items()
            if camera in pair
        ]
        others = [px for pair, px in offsets_px.items() if camera not in pair]
        alike = bool(shifts) and max(shifts) - min(shifts) < max(
            LEAST_OFFSET_PX, _OFFSET_SPREAD * abs(float(np.mean(shifts)))
        )
        if alike and max(map(abs, others), default=0.0) < LEAST_OFFSET_PX:
            return f"camera {camera}'s picture is {np.mean(shifts):+.2f} px to the right"
    return ", ".join(f"{px:+.2f} px for {a}-{b}" for (a, b), px in offsets_px.items())
