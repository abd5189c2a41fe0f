"""An answer for each question of structure, and on a constant offset, from scenes that agree."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np

from stereogenbench_data.audit.contract_diagnosis import LEAST_OFFSET_PX, Rival, SceneDiagnosis
from stereogenbench_data.audit.contract_hypotheses import LAGS, Question
from stereogenbench_data.audit.contract_statistics import Gain, pooled

Status = Literal["confirmed", "not contradicted", "wrong", "cannot tell", "not seen alone"]
"""Confirmed: a 95 % interval keeps every rival that was asked about away by a stated margin, in
every scene. Not contradicted: the declared answer fits best, and some rival is not kept away."""

TOPICS: Final[dict[Question, str]] = {
    "kind": "depth along",
    "form": "stored is",
    "frame_lag": "frame lag",
    "order": "left and right",
    "flip": "flip of depth",
}
CAMERAS_DIFFER: Final = "not told while cameras do not fit, see below"
_WORDS: Final[dict[Any, str]] = {
    "planar": "the optical axis",
    "ray": "the ray",
    "inverse": "inverse depth",
}
_OFFSET_SPREAD: Final = 0.1
"""Share by which one camera's shift may differ from pair to pair."""
_MOST_NAMED: Final = 4


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to one question.

    Attributes:
        topic: What is asked.
        declared: What the data declare.
        found: What the pictures say; empty where they do not tell.
        status: Whether that confirms what is declared.
        behind: By how much the next best answer is worse, where that can be said in dB: in the
            scene in which it comes nearest.
        note: Why, in words; may be empty.
        is_sure: Whether every rival that was asked about is kept away by the margin.
    """

    topic: str
    declared: str
    found: str
    status: Status
    behind: Gain | None = None
    note: str = ""
    is_sure: bool = False


def has_doubts(scenes: Sequence[SceneDiagnosis]) -> bool:
    """Tell whether some camera of some scene does not fit, so that no contract is told."""
    return any(scene.check.faults or scene.check.unexplained for scene in scenes)


def structure_answer(scenes: Sequence[SceneDiagnosis], question: Question) -> Answer:
    """Return the answer to one question of structure, and how far the next best is behind.

    What is declared is confirmed only where the other answers were tested, and lost, in every
    scene. Of lags the two next to it are enough: how well a lag fits falls with its distance from
    the right one.
    """
    first = scenes[0]
    declared, best = (getattr(part, question) for part in (first.declared, first.best))
    blank = Answer(TOPICS[question], said(declared), "", "cannot tell", note=first.problem)
    if first.problem:
        return blank
    if has_doubts(scenes):
        return replace(blank, note=CAMERAS_DIFFER)
    rivals = [rival for rival in first.rivals if rival.question == question]
    gains = {rival.answer: behind(scenes, rival) for rival in rivals}
    tested = {answer: gain for answer, gain in gains.items() if not math.isnan(gain.mean_db)}
    close = [answer for answer, gain in tested.items() if not gain.is_clear]
    untested = [answer for answer in gains if answer not in tested]
    lacking = [
        answer for answer in untested
        if question != "frame_lag" or min(abs(answer - lag) for lag in [best, *close]) == 1
    ]  # fmt: skip
    every = {rival.answer: _each(scenes, rival) for rival in rivals if rival.answer in tested}
    nearest = min(
        (gain for each in every.values() for gain in each), key=lambda gain: gain.low_db,
        default=None,
    )  # fmt: skip
    doubtful = [answer for answer, each in every.items() if not all(g.is_excluded for g in each)]
    is_sure = not (close or lacking or doubtful) and bool(tested)
    words = _words_beside(best, close, untested, question=question)
    if best == "as recorded" and question == "order" and first.recorded_pair is not None:
        left, right = first.recorded_pair
        named, told = f"primary: left {left}, right {right}", f"left {right}, right {left}"
        note = "by poses and pictures alike"
        return Answer(TOPICS[question], named, told, "wrong", nearest, note)
    if question == "order" and best.startswith("depth of") and changes(first, "offset"):
        note = f"a shifted picture, which is not where its depth is, looks like {said(best)}"
        return replace(blank, behind=gains.get(declared), note=note)
    if best == declared:
        if close or lacking or not tested:
            return replace(blank, behind=nearest, note=words)
        if not is_sure:
            note = f"not kept away by the margin: {_named(doubtful)}"
            note = f"{note}; {words}" if words else note
            return replace(
                blank, found=said(best), status="not contradicted", behind=nearest, note=note
            )
        shape = next(
            (g.shape for each in every.values() for g in each if g.by_shape and g.shape), None
        )
        if shape is not None:
            words = f"by shape: the ray's power is {shape[0]:.2f} ± {shape[1]:.2f} (0 axis, 1 ray)"
        return replace(
            blank, found=said(best), status="confirmed", behind=nearest, note=words, is_sure=True
        )
    # To be called wrong the declared answer must be behind; to be pasted, by the margin too.
    if declared in close or not (declared in gains and _is_behind(gains[declared])):
        note = f"{said(best)} fits best, but not surely better"
        return replace(blank, behind=gains[declared], note=f"{note}; {words}" if words else note)
    others = [answer for answer in [*close, *lacking, *doubtful] if answer != declared]
    found = " or ".join(said(answer) for answer in dict.fromkeys([best, *others]))
    at_end = question == "frame_lag" and abs(best) == max(LAGS)
    return replace(
        blank, found=f"{found} or beyond" if at_end else found, status="wrong",
        behind=gains.get(declared), note=words, is_sure=is_sure and not at_end,
    )  # fmt: skip


def _each(scenes: Sequence[SceneDiagnosis], rival: Rival) -> list[Gain]:
    """Return by how much each scene's own best contract is better than another answer."""
    return [
        pooled([other.behind])
        for scene in scenes
        for other in scene.rivals
        if (other.question, other.answer) == (rival.question, rival.answer)
    ]


def _is_behind(gain: Gain) -> bool:
    return gain.by_shape or gain.low_db > 0


def _named(answers: Sequence[Any]) -> str:
    words = ", ".join(said(answer) for answer in answers[:_MOST_NAMED])
    more = len(answers) - _MOST_NAMED
    return f"{words} and {more} more" if more > 0 else words


def _words_beside(
    best: Any, close: Sequence[Any], untested: Sequence[Any], *, question: Question
) -> str:
    """Return which answers fit as well as the best one, and of which nothing is known."""
    words = []
    if close:
        words.append(f"fit alike: {_named([best, *close])}")
    if untested:
        want = "frames" if question == "frame_lag" else "depth where it would be"
        words.append(f"not tested, for want of {want}: {', '.join(map(said, untested))}")
    if question == "frame_lag" and abs(best) == max(LAGS):
        words.append("lags beyond are not asked about")
    return "; ".join(words)


def behind(scenes: Sequence[SceneDiagnosis], rival: Rival) -> Gain:
    """Return by how much the scenes' best contract is better than another answer."""
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


def changes(scene: SceneDiagnosis, length: str) -> bool:
    """Tell whether a scene's best contract fits the scale, or the offset."""
    return scene.changed in (length, "both")


def offset_answer(scenes: Sequence[SceneDiagnosis]) -> Answer:
    """Return whether disparity is off by a constant, and by which.

    No interval is known for it, so that nothing is confirmed.
    """
    first = scenes[0]
    topic = "disparity offset"
    if first.problem:
        return Answer(topic, "0 px", "", "cannot tell", note=first.problem)
    if has_doubts(scenes):
        return Answer(topic, "0 px", "", "cannot tell", note=CAMERAS_DIFFER)
    if changes(first, "offset"):
        gain = pooled([scene.gain for scene in scenes])
        note = "or pictures of another moment, which look alike where little moves"
        return Answer(topic, "0 px", offset_words(first.offsets_px), "wrong", gain, note)
    largest_px = max((abs(px) for scene in scenes for px in scene.offsets_px.values()), default=0.0)
    if largest_px > LEAST_OFFSET_PX or math.isnan(first.agreement):
        note = f"fits up to {largest_px:.2g} px, none clearly better than 0"
        return Answer(topic, "0 px", "", "cannot tell", note=note)
    return Answer(topic, "0 px", f"0 px (all pairs within {largest_px:.2f})", "not contradicted")


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
