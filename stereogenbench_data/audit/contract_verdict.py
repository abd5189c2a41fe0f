"""From what single scenes say to an answer for each question, and the contract to paste."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from stereogenbench_data.audit.contract_answers import (
    TOPICS,
    Answer,
    changes,
    has_doubts,
    offset_answer,
    offset_words,
    said,
    structure_answer,
)
from stereogenbench_data.audit.contract_cameras import LEAST_SHARE
from stereogenbench_data.audit.contract_diagnosis import (
    LEAST_LOG_SCALE,
    SceneDiagnosis,
    allowed_log_scale,
)
from stereogenbench_data.audit.contract_hypotheses import QUESTIONS, Structure
from stereogenbench_data.audit.contract_lengths import (
    QUOTIENT,
    common_unit,
    kind_explains_scale,
    length_answers,
    length_choices,
)
from stereogenbench_data.audit.contract_statistics import LEAST_ERRORS, Gain, pooled
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.schema.release import CAMERA_COUNT


@dataclass(frozen=True, slots=True)
class Verdict:
    """What scenes with the same contract say together.

    Attributes:
        scenes: Their keys.
        answers: One for each question.
        gain: By how much the best contract is better than the declared one.
        agreement: Share of the matches of neighbouring cameras that the best contract explains.
        encoding: The contract to use in place of the declared one; None where there is none, or
            none that is sure: nothing is given for what explains less than half of the matches, for
            a unit (the quotient of lengths alone is seen), or while single cameras do not fit.
        quotient: Unit / (focal length x baseline) over what is declared; nan where not told.
        quotient_error: Half its 95 % interval, as a share.
        choices: What would each by itself explain that quotient, in words; empty where it is right.
        faults: What is wrong with single cameras, in words.
        tested_cameras: Those whose depth was tested in every scene.
        untested_cameras: Those whose depth was not, in some scene.
        unexplained_cameras: Those whose depth explains less than half of their matches somewhere.
        beside: What a `DepthEncoding` cannot express, and other words of advice.
        is_wrong: Whether another contract is clearly better, or a camera does not fit.
        fits: Whether the declared contract was found to fit, all cameras tested.
    """

    scenes: tuple[str, ...]
    answers: tuple[Answer, ...]
    gain: Gain
    agreement: float
    encoding: DepthEncoding | None
    quotient: float
    quotient_error: float
    choices: tuple[str, ...]
    faults: tuple[str, ...]
    tested_cameras: tuple[int, ...]
    untested_cameras: tuple[int, ...]
    unexplained_cameras: tuple[int, ...]
    beside: tuple[str, ...]
    is_wrong: bool
    fits: bool


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
    quotient, *lengths = length_answers(scenes, unit)
    offset = offset_answer(scenes)
    answers = (quotient, *lengths, *structure, offset)
    faults = tuple(
        f"{scene.key}: {fault}" if len(scenes) > 1 else fault
        for scene in scenes
        for fault in scene.check.faults
    )
    untested = {camera for scene in scenes for camera in scene.check.untested}
    unexplained = {camera for scene in scenes for camera in scene.check.unexplained}
    wrong = [answer for answer in answers if answer.status == "wrong"]
    explains = not (first.problem or unexplained) and all(
        scene.check.agreement >= LEAST_SHARE for scene in scenes
    )
    is_told = bool(quotient.found)
    pasted = _pasted(first, declared, unit_m=declared.unit_m)
    is_sure = (
        bool(wrong)
        and explains
        and not (faults or untested)
        and all(answer.is_sure for answer in wrong)
        and quotient.status == "confirmed"
        and pasted != declared
    )
    choices: tuple[str, ...] = ()
    if is_told and quotient.status != "confirmed" and explains and not faults:
        with_unit = _pasted(first, declared, unit_m=unit.rounded_m)
        choices = length_choices(scenes, unit, encoding_line(with_unit))
    return Verdict(
        scenes=tuple(scene.key for scene in scenes),
        answers=answers,
        gain=pooled([scene.gain for scene in scenes]),
        agreement=float(np.nanmean([scene.agreement for scene in scenes]))
        if not first.problem
        else math.nan,
        encoding=pasted if is_sure else None,
        quotient=unit.metres / first.unit_m if is_told else math.nan,
        quotient_error=unit.uncertainty if is_told else math.nan,
        choices=choices,
        faults=faults,
        tested_cameras=tuple(c for c in range(CAMERA_COUNT) if c not in untested),
        untested_cameras=tuple(sorted(untested)),
        unexplained_cameras=tuple(sorted(unexplained)),
        beside=tuple(_beside(scenes, answers)),
        is_wrong=bool(wrong or faults),
        fits=explains and not (wrong or faults or untested)
        and all(answer.status != "cannot tell" for answer in (quotient, *structure)),
    )  # fmt: skip


def _pasted(
    first: SceneDiagnosis, declared: DepthEncoding, *, unit_m: float | None
) -> DepthEncoding:
    """Return the contract with the answers that were found, and a unit where one is given."""
    return replace(
        declared, unit_m=unit_m, kind=first.best.kind, form=first.best.form,
        frame_lag=first.best.frame_lag,
    )  # fmt: skip


def encoding_line(encoding: DepthEncoding) -> str:
    """Return the Python expression of a contract, defaults left out."""
    default = replace(encoding, unit_m=None, kind="planar", form="depth", frame_lag=0)
    told = [
        f"{field.name}={getattr(encoding, field.name)!r}"
        for field in fields(encoding)
        if getattr(encoding, field.name) != getattr(default, field.name)
    ]
    return f"DepthEncoding({', '.join(told)})"


def _beside(scenes: Sequence[SceneDiagnosis], answers: Sequence[Answer]) -> list[str]:
    """Return what is to be said that no `DepthEncoding` says."""
    first = scenes[0]
    wrong = {answer.topic for answer in answers if answer.status == "wrong"}
    lines = []
    if TOPICS["flip"] in wrong:
        lines.append(f"Depth is flipped ({first.best.flip}ly turned over): store it anew.")
    if first.best.order != first.declared.order and TOPICS["order"] in wrong:
        lines.append(f"Files: {first.best.order}. Rename the files, or correct the metadata.")
    if first.recorded_pair is not None and TOPICS["order"] in wrong:
        lines.append("baseline.json names the primary pair's cameras the wrong way round.")
    if "disparity offset" in wrong:
        lines.append(
            f"Constant disparity: {offset_words(first.offsets_px)}. Shift the pictures, or record "
            "each camera's principal point."
        )
    if not first.problem and allowed_log_scale(first.depth_step) > LEAST_LOG_SCALE:
        lines.append(
            f"Stored depth is coarse: its steps are {first.depth_step:.1%} of it or more in a "
            "quarter of the picture, and the quotient is no better known."
        )
    if kind_explains_scale(scenes):
        (other,) = first.best.alternatives("kind")
        lines.append(f"Fits alike: depth along {said(other.kind)}, the unit as declared.")
    if has_doubts(scenes):
        return lines
    for structure, free, scale in dict.fromkeys(
        other for scene in scenes[:1] for other in scene.equals
    ):
        lines.append(f"Fits alike: {_contract_words(structure, first, free=free, scale=scale)}.")
    return lines


def _contract_words(structure: Structure, first: SceneDiagnosis, *, free: str, scale: float) -> str:
    words = [
        f"{TOPICS[question]} {said(getattr(structure, question))}"
        for question in structure.changes_from(first.declared)
    ]
    if free in ("scale", "both"):
        words.append(f"{QUOTIENT} {1 / scale:.4g} x declared")
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
    if has_doubts([scene, leader]):
        # What is wrong with single cameras of a scene is its own.
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
