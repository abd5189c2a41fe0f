"""What must hold between the calibration controls, if metrics and data are what they are for."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from stereogenbench_data.evaluation.aggregate import cell
from stereogenbench_data.evaluation.columns import COLUMNS, HEAVY_TAILED
from stereogenbench_data.evaluation.controls import (
    COPIED_LEFT,
    RANDOM_RIGHT,
    TARGET,
    WRONG_BASELINE,
    wrong_camera,
)
from stereogenbench_data.evaluation.results import Scores

_SLOPE_TOLERANCE: Final = 0.1
"""How far from the ratio of baselines a matcher may put the wrong baseline's slope."""
_TRUSTED_R2: Final = 0.8
"""The least share of variance that a fit must explain for its slope to be judged: a matcher that
searches too few disparities for a wide baseline answers with others."""


@dataclass(frozen=True, slots=True)
class Relation:
    """One relation between controls, over all scenes that were scored.

    Attributes:
        what: The relation, in words.
        holds: Whether it does; None where it cannot be told.
        found: The numbers that it was judged by.
    """

    what: str
    holds: bool | None
    found: str


def relations(results: Sequence[Scores]) -> list[Relation]:
    """Return the relations between the four controls that their metrics allow to judge.

    Args:
        results: The scores of all of `CONTROLS`.
    """
    by_name = {one.name: one for one in results}
    target, copied = by_name[TARGET], by_name[COPIED_LEFT]
    wrong, random = by_name[WRONG_BASELINE], by_name[RANDOM_RIGHT]
    metrics = target.protocol.metrics
    judged: list[Relation] = []
    if "psnr" in metrics:
        judged.append(_identical(target))
        judged.append(_ordered("psnr", [random], below=[copied, wrong]))
    if "ssim" in metrics:
        judged.append(_ordered("ssim", [copied, wrong, random], below=[target]))
        judged.append(_ordered("ssim", [random], below=[copied, wrong]))
    if "p_psnr" in metrics:
        judged.append(_ordered("p_psnr", [random], below=[target, copied, wrong]))
    if "e_match" in metrics:
        judged.append(_of("e_match", target, "is 0", lambda mean: mean == 0))
        judged.append(_of("e_match", copied, "is above 0", lambda mean: mean > 0))
        judged.append(_ordered("e_match", [target, copied, wrong], below=[random]))
    if "sd" in metrics:
        sd = f"sd_{target.protocol.fit}"
        judged.append(_ordered(sd, [target], below=[copied]))
        judged.append(_ordered(sd, [target], below=[wrong]))
        judged.append(_slope(wrong))
    return judged


def _identical(target: Scores) -> Relation:
    found = cell(target.pairs, "psnr")
    frames = sum(pair.frames for pair in target.pairs)
    return Relation(
        f"every frame of the {TARGET} is identical",
        found.infinite == frames,
        f"{found.infinite} of {frames}",
    )


def _of(column: str, one: Scores, what: str, holds: Callable[[float], bool]) -> Relation:
    mean = _middle(column, one)
    return Relation(
        f"{_label(column)} of {one.name} {what}",
        None if mean is None else holds(mean),
        _told(column, [one]),
    )


def _ordered(column: str, lower: Sequence[Scores], *, below: Sequence[Scores]) -> Relation:
    means = [[_middle(column, one) for one in side] for side in (lower, below)]
    names = [", ".join(one.name for one in side) for side in (lower, below)]
    low, high = ([mean for mean in side if mean is not None] for side in means)
    whole = len(low) == len(lower) and len(high) == len(below)
    return Relation(
        f"{_label(column)} of {names[0]} is below that of {names[1]}",
        max(low) < min(high) if whole else None,
        _told(column, [*lower, *below]),
    )


def _slope(wrong: Scores) -> Relation:
    """Judge whether the wrong camera's disparity is too large by the ratio of the baselines."""
    sd = f"sd_{wrong.protocol.fit}"
    what = (
        f"the slope {_label(f'{sd}_slope')} of {WRONG_BASELINE} is the ratio of the two baselines"
    )
    expected = []
    for pair in wrong.pairs:
        rig = wrong.index.scene(pair.row).rig
        other = rig.baseline_cm(pair.pair[0], wrong_camera(*pair.pair))
        expected.append(pair.baseline_cm / other)
    found = [pair.tallies[f"{sd}_slope"] for pair in wrong.pairs]
    explained = [pair.tallies[f"{sd}_r2"] for pair in wrong.pairs]
    off = sorted(
        abs(slope.mean - ratio)
        for slope, r2, ratio in zip(found, explained, expected, strict=True)
        if slope.finite and r2.mean >= _TRUSTED_R2
    )
    if not off:
        return Relation(what, None, "no fit explains enough of the variance")
    middle = off[len(off) // 2]
    return Relation(
        what,
        middle <= _SLOPE_TOLERANCE,
        f"off by {middle:.3f} in the middle of {len(off)} pairs, {off[-1]:.3f} at most",
    )


def _middle(column: str, one: Scores) -> float | None:
    """Return the mean over scenes; of SD, whose tail is heavy, the median."""
    found = cell(one.pairs, column)
    return found.median if column in HEAVY_TAILED else found.mean


def _label(column: str) -> str:
    label = COLUMNS[column].label
    return f"median {label}" if column in HEAVY_TAILED else label


def _told(column: str, sides: Sequence[Scores]) -> str:
    digits = COLUMNS[column].digits
    texts = []
    for one in sides:
        mean = _middle(column, one)
        texts.append(f"{one.name} {'undefined' if mean is None else format(mean, f'.{digits}f')}")
    return ", ".join(texts)
