"""From what single scenes say to an answer for each question, and the contract to paste."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from stereogenbench_data.audit.contract_answers import (
    TOPICS,
    Answer,
    changes,
    offset_answer,
    offset_words,
    said,
    structure_answer,
)
from stereogenbench_data.audit.contract_diagnosis import (
    LEAST_LOG_SCALE,
    SceneDiagnosis,
    allowed_log_scale,
)
from stereogenbench_data.audit.contract_hypotheses import QUESTIONS, Structure
from stereogenbench_data.audit.contract_lengths import (
    Unit,
    common_unit,
    kind_explains_scale,
    length_answers,
)
from stereogenbench_data.audit.contract_statistics import LEAST_ERRORS, Gain, pooled
from stereogenbench_data.schema.records import DepthEncoding

_SHARE_TOLD: Final = 0.4
"""With a smaller share of matches explained, even the best contract does not fit."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What scenes with the same contract say together.

    Attributes:
        scenes: Their keys.
        answers: One for each question.
        gain: By how much the best contract is better than the declared one.
        agreement: Share of matches that the best contract explains to a pixel.
        encoding: The contract to use.
        unit_m: Metres in a stored unit as measured, nan where it is not told.
        beside: What a `DepthEncoding` cannot express, and other words of advice.
        is_wrong: Whether another contract is clearly better than the declared one.
    """

    scenes: tuple[str, ...]
    answers: tuple[Answer, ...]
    gain: Gain
    agreement: float
    encoding: DepthEncoding
    unit_m: float
    beside: tuple[str, ...]
    is_wrong: bool


def judge(scenes: Sequence[SceneDiagnosis], *, declared: DepthEncoding) -> Verdict:
    """Return the verdict on scenes that have one best contract.

    Args:
        scenes: One or more scenes with the same changes; of those without a word to say
            (``problem``) there must be no other.
        declared: The contract that was asked about; its unit is None where files tell it.
    """
    first = scenes[0]
    unit = common_unit(scenes)
    structure = [structure_answer(scenes, question) for question in QUESTIONS]
    unit_answer, focal_answer = length_answers(scenes, unit)
    offset = offset_answer(scenes)
    answers = (unit_answer, *structure, focal_answer, offset)
    is_wrong = any(answer.status == "wrong" for answer in answers) or any(
        scene.best != scene.declared or scene.changed != "nothing" for scene in scenes
    )
    return Verdict(
        scenes=tuple(scene.key for scene in scenes),
        answers=answers,
        gain=pooled([scene.gain for scene in scenes]),
        agreement=float(np.nanmean([scene.agreement for scene in scenes]))
        if not first.problem
        else math.nan,
        encoding=_encoding(first, unit, declared, unit_answer=unit_answer),
        unit_m=unit.metres if not first.problem else math.nan,
        beside=tuple(_beside(scenes, unit, answers)),
        is_wrong=is_wrong,
    )


def _encoding(
    first: SceneDiagnosis, unit: Unit, declared: DepthEncoding, *, unit_answer: Answer
) -> DepthEncoding:
    """Return the contract to paste: with a unit where the files' own is not right."""
    # A unit that is right for the other kind alone is pasted with the kind that it is fitted to.
    keep_unit = unit_answer.status in ("confirmed", "cannot tell") and unit_answer.behind is None
    unit_m = first.unit_m if keep_unit else unit.rounded_m
    return DepthEncoding(
        unit_m=unit_m,
        kind=first.best.kind,
        form=first.best.form,
        frame_lag=first.best.frame_lag,
        no_depth=declared.no_depth,
        accept=declared.accept,
    )


def _beside(scenes: Sequence[SceneDiagnosis], unit: Unit, answers: Sequence[Answer]) -> list[str]:
    """Return what is to be said that no `DepthEncoding` says."""
    first = scenes[0]
    lines = []
    if first.best.flip != "none":
        lines.append(f"Depth is flipped ({first.best.flip}ly turned over): store it anew.")
    order_told = any(a.topic == TOPICS["order"] and a.status == "wrong" for a in answers)
    if first.best.order != first.declared.order and order_told:
        lines.append(f"Cameras: {first.best.order}. Rename the files, or correct the metadata.")
    if first.recorded_pair is not None and not first.problem:
        lines.append("baseline.json names the primary pair's cameras the wrong way round.")
    if any(answer.topic == "disparity offset" and answer.status == "wrong" for answer in answers):
        lines.append(
            f"Constant disparity: {offset_words(first.offsets_px)}. Shift the pictures, or record "
            "each camera's principal point."
        )
    lines += [
        _focal_line(answer, first, unit) for answer in answers
        if answer.topic == "focal length" and answer.status in ("wrong", "one is wrong")
    ]  # fmt: skip
    if not first.problem and allowed_log_scale(first.depth_step) > LEAST_LOG_SCALE:
        lines.append(
            f"Stored depth is coarse: its steps are {first.depth_step:.1%} of it or more in a "
            "quarter of the picture, and the unit is no better known."
        )
    if kind_explains_scale(scenes):
        (other,) = first.best.alternatives("kind")
        lines.append(f"Fits alike: depth along {said(other.kind)}, the unit as declared.")
    for structure, free, scale in dict.fromkeys(
        other for scene in scenes[:1] for other in scene.equals
    ):
        lines.append(f"Fits alike: {_contract_words(structure, first, free=free, scale=scale)}.")
    if not first.problem and np.nanmean([scene.agreement for scene in scenes]) < _SHARE_TOLD:
        lines.append(
            "Even the best contract explains few of the matches: poses, baselines or something "
            "else that is not asked here may be wrong."
        )
    return lines


def _focal_line(answer: Answer, first: SceneDiagnosis, unit: Unit) -> str:
    """Return what to do about a focal length that is wrong, or may be."""
    cure = "correct the sensor's size or the focal length in baseline.json"
    if answer.status == "wrong":
        return (
            f"{cure.capitalize()}; until then DepthEncoding(unit_m={unit.rounded_m:g}) gives right "
            "disparity, but wrong metres."
        )
    return (
        f"Unit or focal length: if the unit is wrong, DepthEncoding(unit_m={unit.rounded_m:g}); if "
        f"the focal length is {answer.found}, DepthEncoding(unit_m={first.unit_m:g}), and {cure}. "
        "Disparity is the same, metres are not."
    )


def _contract_words(structure: Structure, first: SceneDiagnosis, *, free: str, scale: float) -> str:
    words = [
        f"{TOPICS[question]} {said(getattr(structure, question))}"
        for question in structure.changes_from(first.declared)
    ]
    if free in ("scale", "both"):
        words.append(f"{first.unit_m / scale:.5g} m a unit")
    if free in ("offset", "both"):
        words.append("an offset for each pair")
    return ", ".join(words)


def grouped(scenes: Sequence[SceneDiagnosis]) -> list[list[SceneDiagnosis]]:
    """Return scenes in groups with one contract, the largest first; what tells nothing joins.

    Scenes for which the declared contract holds join those for which another is better where
    their own pictures do not rule that one out.
    """
    told = [scene for scene in scenes if not scene.problem]
    if not told:
        return [list(scenes)] if scenes else []
    groups: list[list[SceneDiagnosis]] = []
    by_gain = sorted(told, key=lambda scene: (not _is_changed(scene), -scene.gain.mean_db))
    for scene in by_gain:
        home = next((group for group in groups if _fits(scene, group[0])), None)
        if home is None:
            groups.append([scene])
        else:
            home.append(scene)
    return sorted(groups, key=len, reverse=True)


def _is_changed(scene: SceneDiagnosis) -> bool:
    return scene.best != scene.declared or scene.changed != "nothing"


def _fits(scene: SceneDiagnosis, leader: SceneDiagnosis) -> bool:
    """Tell whether a scene may have the contract of another."""
    if scene.declared != leader.declared:
        return False
    error = allowed_log_scale(max(scene.depth_step, leader.depth_step))
    error += LEAST_ERRORS * min(scene.scale_error, 1.0)
    if _is_changed(scene):
        units = (found.unit_m / found.scale for found in (scene, leader))
        same_unit = abs(math.log(next(units) / next(units))) <= error
        return scene.best == leader.best and scene.changed == leader.changed and same_unit
    if not _is_changed(leader):
        return True
    if changes(leader, "offset"):
        return False
    ruled_out = {
        (rival.question, rival.answer) for rival in scene.rivals if rival.behind.is_clear()
    }
    changed = leader.best.changes_from(leader.declared)
    if any((question, getattr(leader.best, question)) in ruled_out for question in changed):
        return False
    return bool(changed) or abs(math.log(scene.scale / leader.scale)) <= error
