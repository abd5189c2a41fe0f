"""An answer for each question of structure, and on a constant offset, from scenes that agree."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np

from stereogenbench_data.audit.contract_diagnosis import LEAST_OFFSET_PX, Rival, SceneDiagnosis
from stereogenbench_data.audit.contract_hypotheses import LAGS, Question
from stereogenbench_data.audit.contract_statistics import LEAST_DB, Gain, pooled

Status = Literal["confirmed", "wrong", "one is wrong", "cannot tell", "does not matter"]
"""One is wrong: the unit or the focal length, of which the pictures show the quotient alone."""

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
_OFFSET_SPREAD: Final = 0.1
"""Share by which one camera's shift may differ from pair to pair."""


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


def structure_answer(scenes: Sequence[SceneDiagnosis], question: Question) -> Answer:
    """Return the answer to one question of structure, and how far the next best is behind.

    What is declared is confirmed only where the other answers were tested, and lost. Of lags the
    two next to it are enough: how well a lag fits falls with its distance from the right one.
    """
    first = scenes[0]
    declared, best = (getattr(part, question) for part in (first.declared, first.best))
    blank = Answer(TOPICS[question], said(declared), "", "cannot tell", note=first.problem)
    if first.problem:
        return blank
    rivals = {rival.answer: behind(scenes, rival) for rival in first.rivals
              if rival.question == question}  # fmt: skip
    tested = {answer: gain for answer, gain in rivals.items() if not math.isnan(gain.mean_db)}
    close = [answer for answer, gain in tested.items() if not gain.is_clear]
    nearest = min(tested.values(), key=lambda gain: gain.mean_db, default=None)
    untested = [answer for answer in rivals if answer not in tested]
    lacking = [
        answer for answer in untested
        if question != "frame_lag" or min(abs(answer - lag) for lag in [best, *close]) == 1
    ]  # fmt: skip
    words = _words_beside(best, close, untested, question=question)
    if best == declared and (close or lacking):
        return replace(blank, behind=nearest, note=words)
    if best == "depth of the primary pair swapped" and changes(first, "offset"):
        note = f"a shifted picture, which is not where its depth is, looks like {said(best)}"
        return replace(blank, behind=rivals.get(declared), note=note)
    if question == "order" and best == "as recorded" and first.recorded_pair is not None:
        left, right = first.recorded_pair
        named, told = f"primary: left {left}, right {right}", f"left {right}, right {left}"
        note = "by poses and pictures alike"
        return Answer(TOPICS[question], named, told, "wrong", nearest, note)
    if best == declared:
        if nearest is not None and nearest.by_shape and nearest.mean_db < LEAST_DB:
            words = "told by how disparity grows towards the corners, not by the dB"
        return replace(blank, found=said(best), status="confirmed", behind=nearest, note=words)
    if declared in close:
        note = f"{words}, each with its own unit"
        return replace(blank, behind=rivals[declared], note=note)
    found = " or ".join(said(answer) for answer in [best, *close, *lacking])
    return replace(blank, found=found, status="wrong", behind=rivals.get(declared), note=words)


def _words_beside(
    best: Any, close: Sequence[Any], untested: Sequence[Any], *, question: Question
) -> str:
    """Return which answers fit as well as the best one, and of which nothing is known."""
    words = []
    if close:
        words.append(f"fit alike: {', '.join(said(answer) for answer in [best, *close])}")
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
    """Return whether disparity is off by a constant, and by which."""
    first = scenes[0]
    topic = "disparity offset"
    if first.problem:
        return Answer(topic, "0 px", "", "cannot tell", note=first.problem)
    if changes(first, "offset"):
        gain = pooled([scene.gain for scene in scenes])
        return Answer(topic, "0 px", offset_words(first.offsets_px), "wrong", gain)
    largest_px = max((abs(px) for scene in scenes for px in scene.offsets_px.values()), default=0.0)
    if largest_px > LEAST_OFFSET_PX or math.isnan(first.agreement):
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
