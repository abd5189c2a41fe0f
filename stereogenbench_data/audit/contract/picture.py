"""The doctor's picture: one pair warped by two contracts, and the scores of the others."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from stereogenbench_data.audit.contract.diagnosis import SceneDiagnosis
from stereogenbench_data.audit.contract.doctor import DiagnosisTask, DoctorReport
from stereogenbench_data.audit.contract.hypotheses import Hypothesis
from stereogenbench_data.audit.contract.matching import FrameMatch, SceneFrames
from stereogenbench_data.audit.contract.scoring import score_hypothesis
from stereogenbench_data.audit.pictures.drawing import figure_class
from stereogenbench_data.audit.scene_access import SceneAccess
from stereogenbench_data.errors import SelectionError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.selection.filters import filter_scenes
from stereogenbench_data.sources.files import open_output

_ENDINGS: Final = (".png", ".pdf", ".svg", ".jpg")
_NOT_KNOWN: Final = 255
_WIDE_M: Final = np.logspace(-6, 6, 121)
_NEAR: Final = np.exp(np.linspace(-0.15, 0.15, 41))
_FLOOR: Final = 1e-4
_LONGEST_PX: Final = 640
_MOST_RIVALS: Final = 22
"""Names that a panel has room for."""


def require_picture_file(path: Path) -> None:
    """Refuse a file to which no picture can be written, before anything is read.

    Raises:
        SelectionError: If the name's ending is not one of a picture.
        ExtraError: If matplotlib is not installed.
    """
    if path.suffix.lower() not in _ENDINGS:
        raise SelectionError(f"{path}: name a picture: one of *{', *'.join(_ENDINGS)}.")
    figure_class()


def draw_report(path: Path, report: DoctorReport, index: SceneIndex) -> None:
    """Write the picture of the scene with the most to report.

    It shows the left and right pictures, the right one warped to the left by the declared and by
    the best contract, the differences, the score over the unit, and how far each other answer is
    behind.

    Raises:
        SelectionError: If no scene was judged.
        ExtraError: If matplotlib is not installed.
    """
    if not report.scenes:
        raise SelectionError(
            f"{report.data}: no scene was judged, so there is nothing to draw. Choose other scenes."
        )
    diagnosis = max(
        report.scenes,
        key=lambda each: (
            not each.problem, bool(each.check.problems), each.gain.mean_db, each.matches
        ),
    )  # fmt: skip
    (row,) = filter_scenes(index, {"scenes": diagnosis.key})
    (verdict,) = [each for each in report.verdicts if diagnosis.key in each.scenes]
    task = DiagnosisTask(SceneAccess.of(index, index.scene(int(row))), 1, verdict.declared)
    figure = figure_class()(figsize=(14, 13.5), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(2, 1))
    with task.scene_frames() as views:
        matches = views.frame_matches(frames=task.frames)
        figure.suptitle(f"{diagnosis.key}: {_title(diagnosis)}", fontsize=12)
        _draw_views(above.subplots(2, 3).ravel(), views, matches, diagnosis)
        wide, near, others = below.subplots(1, 3)
        found_m = diagnosis.unit_m / diagnosis.scale
        _draw_curves(wide, views, matches, diagnosis, units_m=np.sort([*_WIDE_M, *found_m * _NEAR]))
        _draw_curves(near, views, matches, diagnosis, units_m=found_m * _NEAR)
        _draw_rivals(others, diagnosis)
    with open_output(path) as file:
        figure.savefig(file, format=path.suffix.lower().removeprefix("."), dpi=90)


def _title(diagnosis: SceneDiagnosis) -> str:
    if diagnosis.problem:
        return f"cannot tell ({diagnosis.problem})"
    if diagnosis.check.problems:
        return "; ".join(diagnosis.check.problems)
    changes = [
        f"{question} {getattr(diagnosis.best, question)}"
        for question in diagnosis.best.changes_from(diagnosis.declared)
    ]
    if diagnosis.fits_scale:
        changes.append(f"unit / (focal length x baseline) {1 / diagnosis.scale:.4g} x declared")
    if diagnosis.changed in ("offset", "both"):
        changes.append("an offset")
    if not changes:
        return "nothing contradicts the declared contract"
    return f"{', '.join(changes)}: {diagnosis.gain.mean_db:.2f} dB better than declared"


def _draw_views(
    axes: Sequence[Any],
    views: SceneFrames,
    matches: Sequence[FrameMatch],
    diagnosis: SceneDiagnosis,
) -> None:
    match = max(matches, key=lambda match: (match.left, match.right) == views.primary)
    left, right = (
        views.rgb(match.frame, file).transpose(1, 2, 0) for file in (match.left, match.right)
    )
    best_scale = diagnosis.scale if diagnosis.fits_scale else 1.0
    shift_px = 0.0
    if diagnosis.changed in ("offset", "both"):
        shift_px = match.shift_px(diagnosis.offsets_px)
    by_declared = _warped(views, match, diagnosis.declared, right, scale=1.0, shift_px=0.0)
    by_best = _warped(views, match, diagnosis.best, right, scale=best_scale, shift_px=shift_px)
    pair = f"frame {match.frame}, cam {match.left} and {match.right}"
    pictures: list[tuple[str, Any]] = [
        (f"left ({pair})", left),
        ("right, warped by the declared contract", by_declared[0]),
        ("|left - warped|, declared", _difference(left, *by_declared)),
        ("right", right),
        ("right, warped by the best contract", by_best[0]),
        ("|left - warped|, best", _difference(left, *by_best)),
    ]
    for axis, (title, picture) in zip(axes, pictures, strict=True):
        step = -(-max(picture.shape[:2]) // _LONGEST_PX)
        axis.imshow(picture[::step, ::step], cmap="magma", vmin=0, vmax=80)
        axis.set_title(title, fontsize=10)
        axis.set_axis_off()


def _warped(
    views: SceneFrames,
    match: FrameMatch,
    hypothesis: Hypothesis,
    right: UInt8[np.ndarray, "h w 3"],
    *,
    scale: float,
    shift_px: float,
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Return the right picture warped to the left, and where depth and picture are known."""
    height, width = right.shape[:2]
    rows, columns = np.divmod(np.arange(height * width), width)
    everywhere = FrameMatch(
        frame=match.frame, left=match.left, right=match.right,
        rows=rows, columns=columns,
        matched_px=np.zeros(0), brightness=np.zeros(0, np.float32),
        slope=np.zeros(0, np.float32), cells=np.zeros(0, np.int64), cap=1.0, textured=0,
    )  # fmt: skip
    white = np.full((height * width, 3), _NOT_KNOWN, dtype=np.uint8)
    predicted = views.predicted(everywhere, hypothesis)
    if predicted is None:
        return white.reshape(height, width, 3), np.zeros((height, width), dtype=bool)
    disparity_px, known = predicted
    place = columns - scale * disparity_px - shift_px
    inside = known & (place >= 0) & (place <= width - 1)
    place = np.clip(place, 0, width - 2)
    low = place.astype(np.int64)
    part = (place - low)[:, None]
    flat = right[rows, low] * (1 - part) + right[rows, low + 1] * part
    white[inside] = flat[inside].round()
    return white.reshape(height, width, 3), inside.reshape(height, width)


def _difference(
    left: UInt8[np.ndarray, "h w 3"],
    warped: UInt8[np.ndarray, "h w 3"],
    is_known: Bool[np.ndarray, "h w"],
) -> Float32[np.ndarray, "h w"]:
    """Return the mean absolute difference, nan where unknown."""
    away: Float32[np.ndarray, "h w"] = np.abs(left.astype(np.float32) - warped).mean(axis=-1)
    away[~is_known] = np.nan
    return away


def _draw_curves(
    axis: Any,
    views: SceneFrames,
    matches: Sequence[FrameMatch],
    diagnosis: SceneDiagnosis,
    *,
    units_m: Float64[np.ndarray, " k"],
) -> None:
    """Draw how well the pictures agree over the unit, for planar, ray and inverse depth."""
    best = diagnosis.best
    for name, hypothesis in {
        "along the axis": best.changed("kind", "planar").changed("form", "depth"),
        "along the ray": best.changed("kind", "ray").changed("form", "depth"),
        "inverse": best.changed("kind", "planar").changed("form", "inverse"),
    }.items():
        scores_db = [
            _score_db(views, matches, hypothesis, scale=diagnosis.unit_m / unit_m)
            for unit_m in units_m
        ]
        axis.plot(units_m, scores_db, label=name, linewidth=1.2)
    if units_m[0] <= diagnosis.unit_m <= units_m[-1]:
        axis.axvline(diagnosis.unit_m, color="grey", linestyle=":", label="declared unit")
    axis.set(
        xscale="log",
        xlabel="metres a unit, if focal length and baselines are right",
        ylabel="dB better than no agreement",
    )
    axis.set_xlim(units_m[0], units_m[-1])
    axis.legend(fontsize=8)


def _score_db(
    views: SceneFrames, matches: Sequence[FrameMatch], hypothesis: Hypothesis, *, scale: float
) -> float:
    errors = score_hypothesis(views, matches, hypothesis, scale=scale).errors
    shares = [
        max(float(np.nanmean(part)) / match.cap, _FLOOR)
        for part, match in zip(errors, matches, strict=True)
        if np.isfinite(part).any()
    ]
    return -10 * float(np.mean(np.log10(shares))) if shares else math.nan


def _draw_rivals(axis: Any, diagnosis: SceneDiagnosis) -> None:
    """Draw how far the nearest other answers are behind the best contract."""
    finite = [rival for rival in diagnosis.rivals if math.isfinite(rival.behind.mean_db)]
    tested = sorted(finite, key=lambda rival: rival.behind.mean_db)[:_MOST_RIVALS]
    if not tested:
        axis.set_axis_off()
        axis.text(0.5, 0.5, diagnosis.problem or "no other answers", ha="center", wrap=True)
        return
    names = [f"{rival.question}: {rival.answer}" for rival in tested]
    heights = [rival.behind.mean_db for rival in tested]
    errors = [min(1.96 * rival.behind.error_db, 50.0) for rival in tested]
    count = f"the nearest {len(tested)} of {len(finite)} " if len(finite) > len(tested) else ""
    axis.set_title(f"{count}other answers", fontsize=10)
    axis.barh(names, heights, xerr=errors, color="tab:grey", error_kw={"linewidth": 0.8})
    axis.axvline(0, color="black", linewidth=0.8)
    axis.tick_params(axis="y", labelsize=7)
    axis.set(xlabel="dB worse than the best contract")
    axis.invert_yaxis()
