"""One scene's diagnosis: the declared contract, changed as little as the pictures ask for.

`ContractSearch` fits each hypothesis once and returns the contract with the fewest changes that no
further change clearly improves. `diagnose_scene` reports how well that contract fits.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any, Final

import numpy as np

from stereogenbench_data.audit.contract import limits
from stereogenbench_data.audit.contract.cameras import CameraCheck, CameraComparison
from stereogenbench_data.audit.contract.hypotheses import QUESTIONS, Hypothesis, Question
from stereogenbench_data.audit.contract.row_matches import (
    FrameMatch,
    SceneFrames,
    disparity_px,
    relative_step,
)
from stereogenbench_data.audit.contract.scoring import (
    NOTHING,
    SURE,
    Gain,
    ScoredContract,
    Scorer,
)
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.schema.release import CAMERA_COUNT, DEFAULT_DEPTH_UNIT_M


@dataclass(frozen=True, slots=True)
class Rival:
    """Another answer to one question, with a scale of its own."""

    question: Question
    answer: Any
    lead_of_best: Gain
    scale: float = 1.0


@dataclass(frozen=True, slots=True)
class SceneDiagnosis:
    """What one scene's pictures show about its depth encoding.

    Attributes:
        key: The scene.
        views: How many views (a pair in a frame) were compared.
        matches: Pixels that were found in both pictures of a view.
        unit_m: The declared unit of the primary pair's left depth, in metres.
        unit_source: Where it comes from: "tag", "default", "conventions", "user" or "unreadable".
        encoding: The contract under test; its unit is None if files state it.
        declared: Its answers.
        best: The answers of the best contract.
        problem: Why the scene could not be judged; empty if it could.
        is_scaled: Whether the best contract has another scale too.
        scale: Found over declared disparity, fitted with the best contract's answers.
        scale_error: Standard error of log(scale).
        rivals: The other answers.
        disparity_px: Root mean square of the disparities found.
        depth_step: The `relative_step` of stored depths.
        check: How well each camera fits the best contract.
        beside: By how much the declared contract is better than the release's default, 0.1 m a
            unit without an offset; None where that is what is declared.
        default_fits: Whether the default's own scale is that of the pictures.
        stretch: By what factor unit and focal length explain the depth of other frames best, the
            unit as pictures have it; nan where the clip does not tell.
    """

    key: str
    views: int
    matches: int
    unit_m: float
    unit_source: str
    encoding: DepthEncoding
    declared: Hypothesis
    best: Hypothesis
    problem: str = ""
    is_scaled: bool = False
    scale: float = 1.0
    scale_error: float = math.inf
    rivals: tuple[Rival, ...] = ()
    disparity_px: float = math.inf
    depth_step: float = 0.0
    check: CameraCheck = field(default_factory=CameraCheck)
    beside: Gain | None = None
    default_fits: bool = False
    stretch: float = math.nan


def allowed_log_scale(depth_step: float) -> float:
    """Return the error of log(unit) that is not called wrong.

    Rounding to coarse steps moves the mean of 1 / depth by about the step squared; a quarter of a
    step allows for truncation.
    """
    return max(limits.LEAST_LOG_SCALE, depth_step / 4 + depth_step**2)


_MOST_CHANGES: Final = 4
_PROMISING: Final = 4
"""How many exchanges of cameras are tried with a scale of their own."""


class ContractSearch:
    """The search for the best contract of a scene; fits each hypothesis once.

    Hypotheses are compared at the scale that suits each best. Whether the declared scale fits is
    asked last, of the best one.
    """

    def __init__(
        self,
        views: SceneFrames,
        matches: Sequence[FrameMatch],
        *,
        least_log_scale: float = limits.LEAST_LOG_SCALE,
    ) -> None:
        """Take frame matches, and the error of log(unit) that is not called wrong."""
        self._views = views
        self._least_log_scale = least_log_scale
        self._every = matches
        near = views.neighbours(Hypothesis())
        # The pairs next but one serve the comparison of cameras.
        self._matches = [match for match in matches if match.pair in near] or list(matches)
        self._bias = limits.BIAS_PX / max(disparity_px(matches), 1e-6)
        self._scorer = Scorer(views, self._matches)
        self.fitted = cache(self._scorer.fitted)
        self._promising = cache(self._find_promising)
        # The power of the ray's length, for a hypothesis of any kind and scale.
        self._power = cache(lambda planar: self._scorer.ray_power(self.fitted(planar)))
        self._moved_px = cache(self._find_moved_px)
        self.declared = Hypothesis.declared(views.encoding)

    def best(self) -> ScoredContract:
        """Return the contract with the fewest changes that no further change clearly improves."""
        current = self.fitted(self.declared)
        for _ in range(_MOST_CHANGES):
            others = map(self.fitted, self._others(current.hypothesis))
            better = [each for each in others if self.gain(each, current).is_clear()]
            if not better:
                break
            current = max(better, key=lambda other: self.gain(other, current).mean_db)
        return self.with_scale(self._pruned(current).hypothesis)

    def _others(self, current: Hypothesis) -> Iterator[Hypothesis]:
        """Yield hypotheses that change one answer; of orders those that explain most."""
        for question in QUESTIONS:
            is_order = question == "order"
            yield from self._promising(current) if is_order else current.alternatives(question)

    def _find_promising(self, current: Hypothesis) -> tuple[Hypothesis, ...]:
        """Return the orders that explain most matches, at any scale."""
        orders = current.alternatives("order")
        few = [match for match in self._matches if match.frame == self._matches[0].frame]
        scorer = Scorer(self._views, few)
        shares = {order: scorer.most_explained(order) for order in orders}
        return tuple(sorted(orders, key=lambda order: -shares[order])[:_PROMISING])

    def _pruned(self, current: ScoredContract) -> ScoredContract:
        """Undo changes that another change has made unnecessary."""
        hypothesis = current.hypothesis
        for question in hypothesis.changes_from(self.declared):
            simpler = self.fitted(hypothesis.changed(question, getattr(self.declared, question)))
            if not self.gain(current, simpler).is_clear():
                return self._pruned(simpler)
        return current

    def with_scale(self, hypothesis: Hypothesis) -> ScoredContract:
        """Return a contract with its declared scale, or a fitted one if that is clearly better."""
        fitted = self.fitted(hypothesis)
        if hypothesis.form != self.declared.form:
            return fitted
        declared = self._scorer.score(hypothesis)
        least = max(self._least_log_scale, self._bias) + limits.LEAST_ERRORS * min(
            fitted.scale_error, 1e3
        )
        is_clear = partial(
            Gain.is_clear, least_db=limits.LEAST_SCALE_DB, errors=limits.SCALE_ERRORS
        )
        if abs(math.log(fitted.scale)) <= least or not is_clear(
            self._scorer.gain(fitted, declared)
        ):
            return declared
        # A camera elsewhere than recorded gives its own pairs another scale, and no others.
        opposite = (
            self._scorer.gain(declared, fitted, left_out=camera) for camera in range(CAMERA_COUNT)
        )
        return declared if any(map(is_clear, opposite)) else fitted

    def cameras(self, contract: ScoredContract, *, depth_step: float) -> CameraCheck:
        """Return how well each camera fits a contract, its scale fitted."""
        hypothesis = contract.hypothesis
        matches = self._every
        if hypothesis.order != self.declared.order:
            # Other files are neighbours.
            frames = len({match.frame for match in matches})
            matches = self._views.frame_matches(frames=frames, hypothesis=hypothesis)
        fitted = self.fitted(hypothesis)
        return CameraComparison(self._views, matches, fitted, depth_step).check()

    def rivals(self, best: ScoredContract) -> tuple[Rival, ...]:
        """Return the other answers to every question, each with its own scale."""
        likely = self._promising(best.hypothesis)
        found = []
        for question in QUESTIONS:
            for hypothesis in best.hypothesis.alternatives(question):
                if question == "order" and hypothesis not in likely:
                    # An exchange of two cameras leaves the others, and so the scale, as they are.
                    other = self._scorer.score(hypothesis, scale=best.scale)
                else:
                    other = self.fitted(hypothesis)
                answer, lead = getattr(hypothesis, question), self.gain(best, other)
                found.append(Rival(question, answer, lead, other.scale))
        return tuple(found)

    def beside_default(self) -> tuple[Gain | None, bool]:
        """Return by how much the declared contract beats the release's default, and if that fits.

        None where the default is what is declared.
        """
        views = self._views
        now = views.scene.depth_encoding(views.primary[0], views.encoding)
        if (views.unit_m(views.primary[0]), now.offset_m, now.form) == (
            DEFAULT_DEPTH_UNIT_M, 0.0, "depth"
        ):  # fmt: skip
            return None, False
        default = views.read_as(
            replace(views.encoding, unit_m=DEFAULT_DEPTH_UNIT_M, offset_m=0.0, form="depth")
        )
        hypothesis = replace(self.declared, form="depth")
        scorer = Scorer(default, self._matches)
        other, scaled = scorer.score(hypothesis), scorer.fitted(hypothesis)
        least = self._least_log_scale + limits.LEAST_ERRORS * min(scaled.scale_error, 1.0)
        declared = self._scorer.score(self.declared)
        return self._scorer.gain(declared, other), abs(math.log(scaled.scale)) <= least

    def without_parallax(self, best: ScoredContract) -> Gain:
        """Return by how much a contract is better than infinite depth everywhere."""
        return self._scorer.gain(best, self._scorer.score(best.hypothesis, scale=1e-12))

    def gain(self, better: ScoredContract, worse: ScoredContract) -> Gain:
        """Return by how much one contract is better than another.

        A lag that moves predictions by less than `limits.BIAS_PX` was not tested.
        """
        if better.hypothesis.changes_from(worse.hypothesis) == ("frame_lag",):
            moved_px = self._moved_px(better.hypothesis, worse.hypothesis.frame_lag)
            if better.scale * moved_px < limits.BIAS_PX:
                return NOTHING
        found = self._scorer.gain(better, worse)
        kind = better.hypothesis.kind
        only_kind = better.hypothesis.changes_from(worse.hypothesis) == ("kind",)
        # Coarse depth has a shape of its own.
        is_fine = self._least_log_scale <= limits.LEAST_LOG_SCALE
        if is_fine and only_kind:
            shape_kind = self._power(better.hypothesis.changed("kind", "planar")).kind
            if shape_kind is not None and (shape_kind != kind or found.mean_db > 0):
                sure_db = max(SURE.mean_db, found.mean_db)
                return replace(SURE, mean_db=sure_db if shape_kind == kind else -sure_db)
        return found

    def _find_moved_px(self, hypothesis: Hypothesis, lag: int) -> float:
        """Return by how much another lag moves predictions on average, in a middling view."""
        other, moved_px = hypothesis.changed("frame_lag", lag), []
        for match in self._matches:
            here, there = (self._views.predicted(match, each) for each in (hypothesis, other))
            if here is not None and there is not None and (known := here[1] & there[1]).any():
                moved_px.append(float(np.abs(here[0] - there[0])[known].mean()))
        return float(np.median(moved_px)) if moved_px else 0.0


def _checked(
    search: ContractSearch, best: ScoredContract, *, depth_step: float
) -> tuple[ScoredContract, CameraCheck]:
    """Return the contract to report, and how well each camera fits it.

    Single wrong files may have bent the best contract to them. Then the declared contract, with
    another scale if that is clearly better, is checked instead.
    """
    check = search.cameras(best, depth_step=depth_step)
    plain = search.with_scale(search.declared)
    if not (check.problems or check.unexplained) or best.hypothesis == search.declared:
        return best, check
    other = search.cameras(plain, depth_step=depth_step)
    if (
        len(other.problems) <= max(len(check.problems), 2)
        and not other.agreement < check.agreement / 2
    ):
        return plain, other
    return best, check


def diagnose_scene(views: SceneFrames, *, frames: int) -> SceneDiagnosis:
    """Return what a scene's pictures show about its declared contract.

    Raises:
        MediaError: If a video does not decode, or has another size than the scene's metadata say.
    """
    matches = views.frame_matches(frames=frames)
    file = views.primary[0]
    units, known = views.depth(matches[0].frame, file)
    declared = Hypothesis.declared(views.encoding)
    scene = SceneDiagnosis(
        key=views.scene.id.key,
        views=len(matches) // 2,
        matches=sum(len(match.rows) for match in matches[::2]),
        unit_m=views.unit_m(file),
        unit_source=(
            views.encoding.source if views.encoding.unit_m else views.scene.depth_unit_source[file]
        ),
        encoding=views.encoding,
        declared=declared,
        best=declared,
        disparity_px=disparity_px(matches),
        depth_step=relative_step(units[known]),
    )
    problem = _too_little(scene)
    if problem:
        return replace(scene, problem=problem)
    search = ContractSearch(views, matches, least_log_scale=allowed_log_scale(scene.depth_step))
    best, check = _checked(search, search.best(), depth_step=scene.depth_step)
    if math.isnan(check.agreement):
        problem = "no depth: too few of the pixels that were found in both pictures have any"
        return replace(scene, problem=problem)
    if not search.without_parallax(best).is_clear():
        problem = (
            f"nothing fits: of disparities of {scene.disparity_px:.1f} px the best contract "
            f"explains {check.agreement:.0%} to a pixel, and pictures no better than none does"
        )
        return replace(scene, problem=problem)
    fitted = search.fitted(best.hypothesis)
    beside, default_fits = search.beside_default()
    return replace(
        scene,
        beside=beside,
        default_fits=default_fits,
        best=best.hypothesis,
        is_scaled=best.is_scaled,
        scale=fitted.scale,
        scale_error=fitted.scale_error,
        check=check,
        rivals=search.rivals(best),
    )


def _too_little(scene: SceneDiagnosis) -> str:
    """Return why a scene shows too little to be judged; empty if it shows enough."""
    if scene.matches < limits.FEWEST_MATCHES:
        return (
            f"only {scene.matches:,} pixels were found in both pictures: they have no texture, or "
            f"show different things"
        )
    if scene.depth_step > limits.COARSEST_STEP:
        return f"stored depth is too coarse: its steps are {scene.depth_step:.0%} of it"
    if scene.disparity_px < limits.LEAST_PARALLAX_PX:
        return f"too little parallax: disparities are of {scene.disparity_px:.2f} px"
    return ""
