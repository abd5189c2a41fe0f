"""From the diagnoses of scenes to an answer for each question, and the contract to paste.

The questions concern the hypothesis (kind, form, lag, order, flip) and the lengths, of which
disparity shows one quotient: unit / (focal length x baseline). `judge` answers them all;
`group_by_contract` decides which scenes are judged together.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Final, Literal, get_args

import numpy as np

from stereogenbench_data.audit.contract import limits
from stereogenbench_data.audit.contract.diagnosis import SceneDiagnosis, allowed_log_scale
from stereogenbench_data.audit.contract.hypotheses import LAGS, QUESTIONS, Question
from stereogenbench_data.audit.contract.scoring import (
    NORMAL_975,
    Gain,
    is_ruled_out,
    pooled,
    weighted_mean,
)
from stereogenbench_data.audit.contract.stretch import STRETCH_MARGIN
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.schema.release import CAMERA_COUNT, DEFAULT_DEPTH_UNIT_M

Status = Literal["confirmed", "not contradicted", "wrong", "cannot tell"]
"""Confirmed: in every scene a 95 % interval excludes every tested rival by a stated margin. Not
contradicted: the declared answer fits best, but some rival is not excluded."""

TOPICS: Final[dict[Question, str]] = {
    "kind": "depth along",
    "form": "stored is",
    "frame_lag": "frame lag",
    "order": "left and right",
    "flip": "flip of depth",
}
CAMERAS_DIFFER: Final = "not answered while cameras do not fit, see below"
_WORDS: Final[dict[Any, str]] = {
    "planar": "the optical axis",
    "ray": "the ray",
    "inverse": "inverse depth",
}
_OR_PICTURES: Final = "or the pictures are flipped"
_MOST_NAMED: Final = 4


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to one question.

    Attributes:
        topic: The question.
        declared: What the data declare.
        found: What the pictures show; empty if they show nothing.
        status: Whether that confirms what is declared.
        note: The reason, in words; may be empty.
        is_sure: Whether every tested rival is excluded by the margin.
    """

    topic: str
    declared: str
    found: str
    status: Status
    note: str = ""
    is_sure: bool = False


def has_camera_problems(scenes: Sequence[SceneDiagnosis]) -> bool:
    """Tell whether some camera of some scene does not fit, so that no contract is reported."""
    return any(scene.check.problems or scene.check.unexplained for scene in scenes)


def _no_answer(scenes: Sequence[SceneDiagnosis], topic: str, declared: str) -> Answer:
    """Return the answer "cannot tell", with a note if no question can be answered."""
    note = scenes[0].problem or (CAMERAS_DIFFER if has_camera_problems(scenes) else "")
    return Answer(topic, declared, "", "cannot tell", note=note)


def _question_answer(scenes: Sequence[SceneDiagnosis], question: Question) -> Answer:
    """Return the answer to one question."""
    first = scenes[0]
    declared, best = (getattr(part, question) for part in (first.declared, first.best))
    blank = _no_answer(scenes, TOPICS[question], describe(declared))
    if blank.note:
        return blank
    gains = gains_of(scenes, question)
    states = {answer: _state(each) for answer, each in gains.items()}
    untested = [answer for answer, state in states.items() if state == "untested"]
    if question == "frame_lag":
        states = _lag_states(states, declared=declared, best=best)
    left = [
        answer for answer, state in states.items() if state != "excluded" and answer != declared
    ]
    worst: State = max(states.values(), key=_STATES.index, default="untested")
    is_changed, of_declared = best != declared, pooled(gains.get(declared, ()))
    decides = worst if not is_changed else states.get(declared, "untested")
    if is_changed and not of_declared.low_db > 0:
        decides = "close"
    status = _STATUS.get((is_changed, decides), "cannot tell")
    at_end = question == "frame_lag" and abs(best) == max(LAGS)
    want = "frames or of motion" if question == "frame_lag" else "depth where it would be"
    close = [answer for answer, state in states.items() if state == "close"]
    notes = {
        f"{describe(best)} fits best, but not surely better": is_changed and status != "wrong",
        f"not excluded by the margin: {_named(left)}": status == "not contradicted",
        f"fit alike: {_named([best, *close])}": close,
        f"not tested, for lack of {want}: {', '.join(map(describe, untested))}": untested,
        f"lags beyond {max(LAGS)} frames are not examined": at_end,
        _OR_PICTURES: question == "flip" and is_changed,
    }
    found = " or ".join(map(describe, [best, *left] if is_changed else [best]))
    return Answer(
        blank.topic,
        blank.declared,
        found="" if status == "cannot tell" else f"{found} or beyond" if at_end else found,
        status=status,
        note="; ".join(note for note, is_said in notes.items() if is_said),
        is_sure=worst == "excluded" and not at_end,
    )  # fmt: skip


State = Literal["excluded", "behind", "close", "untested"]
"""How an answer that is not the best stands: excluded by the margin in every scene, or clearly
behind, or not clearly behind, or not compared."""
_STATES: Final = get_args(State)
_STATUS: Final[dict[tuple[bool, State], Status]] = {
    (False, "excluded"): "confirmed",
    (False, "behind"): "not contradicted",
    (True, "excluded"): "wrong",
    (True, "behind"): "wrong",
}
"""By whether another answer than the declared one is best, and by how the declared one stands, or
of the others the one that stands best. Of any other state, pictures cannot tell."""


def _state(scenes: Sequence[Gain]) -> State:
    """Return how an answer stands by how far it is behind in each scene."""
    tested = [gain for gain in scenes if not math.isnan(gain.mean_db)]
    if not tested:
        return "untested"
    if not is_ruled_out(tested):
        return "close"
    # The whole interval must be beyond the margin.
    return "excluded" if all(gain.low_db >= gain.least_db for gain in tested) else "behind"


def _lag_states(states: Mapping[int, State], *, declared: int, best: int) -> dict[int, State]:
    """Return how lags stand: the further one is from the right one, the worse it fits.

    So a lag that was not tested matters only beside one that fits. The declared lag is not excluded
    where lags on both sides of it are not.
    """
    fitting = [best, *(lag for lag, state in states.items() if state == "close")]
    kept = {
        lag: state for lag, state in states.items()
        if state != "untested" or lag == declared
        or min(abs(lag - other) for other in fitting) == 1
    }  # fmt: skip
    possible = [best, *(lag for lag, state in states.items() if state in ("behind", "close"))]
    sides = {lag > declared for lag in possible if lag != declared}
    return kept | ({declared: "close"} if len(sides) > 1 and best != declared else {})


def _named(answers: Sequence[Any]) -> str:
    words = ", ".join(describe(answer) for answer in answers[:_MOST_NAMED])
    more = len(answers) - _MOST_NAMED
    return f"{words} and {more} more" if more > 0 else words


def gains_of(scenes: Sequence[SceneDiagnosis], question: Question) -> dict[Any, list[Gain]]:
    """Return by how much the scenes' common best contract is better than each other answer."""
    gains: dict[Any, list[Gain]] = {}
    for rival in (rival for scene in scenes if scene.best == scenes[0].best
                  for rival in scene.rivals if rival.question == question):  # fmt: skip
        gains.setdefault(rival.answer, []).append(rival.lead_of_best)
    return gains


def describe(answer: Any) -> str:
    """Return an answer in words."""
    return _WORDS.get(answer, f"{answer}")


QUOTIENT: Final = "depth scale"
"""Unit / (focal length x baseline), which is all that disparity shows of the three."""
DEFAULT: Final = "beside the release's default"
STRETCH: Final = "unit and focal length along the axis"
_SOURCES: Final = {
    "tag": "by the files' tag", "metadata": "by the scene's JSON", "default": "by default",
    "user": "as given", "conventions": "by the conventions",
}  # fmt: skip


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


def _common_unit(scenes: Sequence[SceneDiagnosis]) -> Unit:
    """Return the unit that scenes agree on, weighted by how sure each is."""
    coarse = max(allowed_log_scale(scene.depth_step) for scene in scenes)
    seen_px = max(scene.disparity_px for scene in scenes)
    bias = (
        coarse
        if coarse > limits.LEAST_LOG_SCALE
        else max(limits.SCALE_BIAS, limits.BIAS_PX / seen_px)
    )
    logs = [math.log(scene.unit_m / scene.scale) for scene in scenes]
    log, error = weighted_mean(logs, [scene.scale_error for scene in scenes], least=1e-4)
    return Unit(math.exp(log), math.hypot(NORMAL_975 * error, bias))


def _quotient(scenes: Sequence[SceneDiagnosis], unit: Unit) -> Answer:
    """Return the answer for the quotient; unit, focal length and baselines are not seen alone."""
    first = scenes[0]
    source = _SOURCES.get(first.unit_source, "as files are not understood")
    blank = _no_answer(scenes, QUOTIENT, f"{first.unit_m:g} m a unit, {source}")
    if blank.note:
        return blank
    found = f"{unit.metres / first.unit_m:.5g} x declared ± {unit.uncertainty:.2%}"
    if first.best.form != first.declared.form:
        note = f"numbers of another form: {describe(first.best.form)} has a unit of its own"
        return replace(blank, found=found, note=note)
    if first.is_scaled:
        if _kind_explains_scale(scenes):
            kind = describe(first.best.kind)
            note = f"{found} if depth is along {kind}, as declared if it is not"
            return replace(blank, note=note)
        if unit.uncertainty > abs(math.log(unit.metres / first.unit_m)):
            return replace(blank, note=f"{found} fits best, but may be equal")
        note = "the unit, the focal length or the baselines: the pictures do not show which"
        return replace(blank, found=found, status="wrong", note=note)
    doubt = _doubt(first, unit, found=found)
    if doubt:
        return replace(blank, note=doubt)
    if first.unit_source == "unreadable":
        return replace(blank, declared="files not understood", found=found)
    note = f"the 95 % interval lies within {limits.MARGIN:.0%} of what is declared"
    return replace(blank, found=found, status="confirmed", note=note)


def _beside_default(scenes: Sequence[SceneDiagnosis]) -> Iterator[Answer]:
    """Yield how the declared contract does beside the release's default, if it is another."""
    if scenes[0].beside is None:
        return
    gain = pooled([scene.beside for scene in scenes if scene.beside is not None])
    declared = f"{scenes[0].unit_m:g} m a unit"
    blank = _no_answer(scenes, DEFAULT, declared)
    against = replace(gain, mean_db=-gain.mean_db)
    default = f"{DEFAULT_DEPTH_UNIT_M:g} m a unit"
    if blank.note:
        yield blank
    elif scenes[0].best != scenes[0].declared:
        yield replace(blank, note="not answered while another answer is wrong")
    elif gain.is_clear():
        yield replace(blank, found=f"it is {declared}, not {default}", status="confirmed")
    elif against.low_db > 0 and all(scene.default_fits for scene in scenes):
        yield replace(blank, found=default, status="wrong")
    else:
        yield blank


def _along_axis(scenes: Sequence[SceneDiagnosis], quotient: Answer, unit: Unit) -> Answer:
    """Return whether unit and focal length are wrong by one factor, which no pair shows."""
    blank = _no_answer(scenes, STRETCH, "as recorded")
    found = [scene.stretch for scene in scenes if math.isfinite(scene.stretch)]
    if blank.note or quotient.status not in ("confirmed", "wrong"):
        return replace(blank, note=blank.note or "not answered while the quotient is open")
    if not found:
        return replace(blank, note="no camera turns or advances by poses that are understood")
    logs = np.log(found)
    if logs.max() - logs.min() > STRETCH_MARGIN:
        return replace(blank, note=f"scenes differ: {min(found):.3g} to {max(found):.3g} x")
    focal, far = math.exp(float(np.median(logs))), abs(float(np.median(logs))) > STRETCH_MARGIN
    if not far:
        # Where the quotient is wrong, that is said once: there.
        status: Status = "confirmed" if quotient.status == "confirmed" else "not contradicted"
        told, note = f"{focal:.3g} x recorded", f"to {STRETCH_MARGIN:.0%}"
        return replace(blank, found=told, status=status, note=note)
    told = f"unit {focal * unit.metres / scenes[0].unit_m:.3g} x and focal length {focal:.3g} x"
    note = "by depth from frame to frame; a focal length is as wrong as a sensor's width, inversely"
    return replace(blank, found=told, status="wrong", note=note)


def _doubt(first: SceneDiagnosis, unit: Unit, *, found: str) -> str:
    """Return why the declared quotient is not confirmed although none is clearly better, if so."""
    off = abs(math.log(unit.metres / first.unit_m))
    is_coarse = allowed_log_scale(first.depth_step) > limits.LEAST_LOG_SCALE
    why = "depth is stored in too large steps" if is_coarse else "too little parallax"
    if off + unit.uncertainty > limits.MARGIN:
        return f"{found}: the 95 % interval reaches beyond {limits.MARGIN:.0%}: {why}"
    if off > max(unit.uncertainty, limits.LEAST_TOLERANCE):
        return f"{found} fits best, but is not clearly better"
    return ""


def _kind_explains_scale(scenes: Sequence[SceneDiagnosis]) -> bool:
    """Tell whether the other kind of depth explains as much as a scale, and is not ruled out."""
    if scenes[0].best != scenes[0].declared:
        return False
    if any(map(is_ruled_out, gains_of(scenes, "kind").values())):
        return False
    return all(
        abs(math.log(rival.scale))
        <= allowed_log_scale(scene.depth_step) + limits.LEAST_ERRORS * min(scene.scale_error, 1.0)
        for scene in scenes
        for rival in scene.rivals
        if rival.question == "kind"
    )


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict on scenes with the same contract.

    Attributes:
        scenes: Their keys.
        declared: The contract under test.
        answers: One for each question.
        agreement: Share of the matches of neighbouring cameras that the best contract explains.
        encoding: The contract to use instead of the declared one; None if none is certain. None is
            given if it explains less than half of the matches, for another unit (only the quotient
            of lengths is seen), or while single cameras do not fit.
        quotient: Unit / (focal length x baseline) over the declared one; nan if not known.
        quotient_error: Half its 95 % interval, as a share.
        choices: The lengths that would explain that quotient, each by itself, in words.
        problems: What is wrong with single cameras, in words.
        untested_cameras: Cameras whose depth was not tested in some scene.
        unexplained_cameras: Cameras whose depth explains less than half of their matches in some
            scene.
        fits: Whether the declared contract fits, with all cameras tested.
    """

    scenes: tuple[str, ...]
    declared: DepthEncoding
    answers: tuple[Answer, ...]
    agreement: float
    encoding: DepthEncoding | None
    quotient: float
    quotient_error: float
    choices: tuple[str, ...]
    problems: tuple[str, ...]
    untested_cameras: tuple[int, ...]
    unexplained_cameras: tuple[int, ...]
    fits: bool

    @property
    def contradicted(self) -> list[str]:
        """What pictures contradict, in words: what is declared, and files of single cameras."""
        answers = [
            f"{answer.topic} {answer.found}"
            # The unit that is declared is one of three lengths of which any may be wrong.
            + (f", not {answer.declared}" if answer.topic != QUOTIENT else "")
            + (f" ({_OR_PICTURES})" if answer.topic == TOPICS["flip"] else "")
            for answer in self.answers
            if answer.status == "wrong"
        ]
        return [*answers, *self.problems]

    @property
    def is_wrong(self) -> bool:
        """Whether another contract is clearly better, or a camera does not fit."""
        return bool(self.contradicted)

    @property
    def in_a_line(self) -> str:
        """The verdict with its figures."""
        if self.is_wrong:
            return f"{encoding_line(self.declared)} is WRONG: {'; '.join(self.contradicted)}"
        told: dict[Status, list[str]] = {
            "confirmed": [], "not contradicted": [], "cannot tell": []
        }  # fmt: skip
        for answer in self.answers:
            found = "" if answer.status == "cannot tell" else f" {answer.found}"
            told[answer.status].append(answer.topic + found)
        return "; ".join(f"{status}: {', '.join(each)}" for status, each in told.items() if each)

    @property
    def tested_cameras(self) -> tuple[int, ...]:
        """Cameras whose depth was tested in every scene."""
        return tuple(c for c in range(CAMERA_COUNT) if c not in self.untested_cameras)


def judge(scenes: Sequence[SceneDiagnosis]) -> Verdict:
    """Return the verdict on scenes that have one best contract.

    Args:
        scenes: One or more scenes with the same changes, or only scenes with a ``problem``.
    """
    first = scenes[0]
    declared = first.encoding
    unit = _common_unit(scenes)
    hypothesis = [_question_answer(scenes, question) for question in QUESTIONS]
    quotient = _quotient(scenes, unit)
    answers = (quotient, *_beside_default(scenes), *hypothesis, _along_axis(scenes, quotient, unit))
    problems = tuple(
        f"{scene.key}: {problem}" if len(scenes) > 1 else problem
        for scene in scenes
        for problem in scene.check.problems
    )
    untested = {camera for scene in scenes for camera in scene.check.untested}
    unexplained = {camera for scene in scenes for camera in scene.check.unexplained}
    wrong = [answer for answer in answers if answer.status == "wrong"]
    explains = not (first.problem or unexplained) and all(
        scene.check.agreement >= limits.LEAST_SHARE for scene in scenes
    )
    is_measured = bool(quotient.found)
    pasted = _pasted(first, declared, unit_m=declared.unit_m)
    is_sure = (
        bool(wrong)
        and explains
        and not (problems or untested)
        and all(answer.is_sure for answer in wrong)
        and quotient.status == "confirmed"
        and pasted != declared
    )
    choices: tuple[str, ...] = ()
    if is_measured and quotient.status != "confirmed" and explains and not problems:
        line = encoding_line(_pasted(first, declared, unit_m=unit.rounded_m))
        factor = first.unit_m / unit.metres
        choices = (
            f"if focal length and baselines are right: {line}",
            f"if unit and baselines are right: a focal length of {factor:.4g} x what is recorded",
            f"if unit and focal length are right: baselines of {factor:.4g} x what is recorded",
        )[: 3 if first.best.form == first.declared.form else 1]
    return Verdict(
        scenes=tuple(scene.key for scene in scenes),
        declared=declared,
        answers=answers,
        agreement=float(np.mean([scene.check.agreement for scene in scenes])),
        encoding=pasted if is_sure else None,
        quotient=unit.metres / first.unit_m if is_measured else math.nan,
        quotient_error=unit.uncertainty if is_measured else math.nan,
        choices=choices,
        problems=problems,
        untested_cameras=tuple(sorted(untested)),
        unexplained_cameras=tuple(sorted(unexplained)),
        fits=explains and not (wrong or problems or untested)
        and all(answer.status != "cannot tell" for answer in answers),
    )  # fmt: skip


def _pasted(
    first: SceneDiagnosis, declared: DepthEncoding, *, unit_m: float | None
) -> DepthEncoding:
    """Return the contract with the answers found, and with the given unit."""
    return replace(
        declared, unit_m=unit_m, kind=first.best.kind, form=first.best.form,
        frame_lag=first.best.frame_lag,
    )  # fmt: skip


def encoding_line(encoding: DepthEncoding) -> str:
    """Return the Python expression of a contract, without defaults."""
    default = DepthEncoding(source=encoding.source)
    arguments = [
        f"{field.name}={getattr(encoding, field.name)!r}"
        for field in fields(encoding)
        if getattr(encoding, field.name) != getattr(default, field.name)
    ]
    return f"DepthEncoding({', '.join(arguments)})"


def group_by_contract(scenes: Sequence[SceneDiagnosis]) -> list[list[SceneDiagnosis]]:
    """Return scenes in groups with one contract, the largest first.

    Scenes whose files declare different units are never judged together. Scenes with the declared
    contract join a group with another one unless their own pictures rule that one out.
    """
    judged = [scene for scene in scenes if not scene.problem]
    if not judged:
        return [list(scenes)] if scenes else []
    groups: list[list[SceneDiagnosis]] = []
    for scene in sorted(judged, key=lambda each: (not _is_changed(each), each.scale_error)):
        home = next((group for group in groups if _fits(scene, group[0])), None)
        if home is None:
            groups.append([scene])
        else:
            home.append(scene)
    return sorted(groups, key=len, reverse=True)


def _is_changed(scene: SceneDiagnosis) -> bool:
    return scene.best != scene.declared or scene.is_scaled


def _fits(scene: SceneDiagnosis, leader: SceneDiagnosis) -> bool:
    """Tell whether a scene may have the contract of another."""
    if (scene.encoding, scene.unit_m) != (leader.encoding, leader.unit_m):
        return False
    if has_camera_problems([scene, leader]):
        # Problems of single cameras are the scene's own.
        return False
    error = allowed_log_scale(max(scene.depth_step, leader.depth_step))
    error += limits.LEAST_ERRORS * min(scene.scale_error, 1.0)
    if _is_changed(scene):
        units = (found.unit_m / found.scale for found in (scene, leader))
        same_unit = abs(math.log(next(units) / next(units))) <= error
        return scene.best == leader.best and scene.is_scaled == leader.is_scaled and same_unit
    if not _is_changed(leader):
        return True
    ruled_out = {
        (rival.question, rival.answer) for rival in scene.rivals if rival.lead_of_best.is_clear()
    }
    changed = leader.best.changes_from(leader.declared)
    if any((question, getattr(leader.best, question)) in ruled_out for question in changed):
        return False
    return bool(changed) or abs(math.log(scene.scale / leader.scale)) <= error
