"""The doctor's picture: one pair warped by the declared and by the best contract."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Bool, UInt8

from stereogenbench_data.audit.contract.diagnosis import SceneDiagnosis
from stereogenbench_data.audit.contract.doctor import DiagnosisTask, DoctorReport
from stereogenbench_data.audit.contract.hypotheses import Hypothesis
from stereogenbench_data.audit.contract.matching import FrameMatch, SceneFrames
from stereogenbench_data.audit.scene_access import source_of
from stereogenbench_data.errors import SelectionError
from stereogenbench_data.geometry.projection import Projection, backward_warp
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.picture import (
    ColourScale,
    Tile,
    channels_last,
    draw_sheet,
    write_png,
)
from stereogenbench_data.selection.filters import filter_scenes

_NOT_KNOWN: Final = 255
_TILE_PX: Final = 400
_DIFFERENCES: Final = ColourScale(0.0, 80.0)


def draw_report(path: Path, report: DoctorReport, index: SceneIndex) -> None:
    """Write the picture of the scene with the most to report.

    It shows the left and right pictures, the right one warped to the left by the declared and by
    the best contract, and the differences.

    Raises:
        SelectionError: If no scene was judged.
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
    scene = index.scene(int(row))
    task = DiagnosisTask(scene, source_of(index, scene), 1, verdict.declared)
    with task.scene_frames() as views:
        matches = views.frame_matches(frames=task.frames)
        rows = _view_tiles(views, matches, diagnosis)
    told = "; ".join(verdict.contradicted) or "nothing contradicts the declared contract"
    if diagnosis.problem:
        told = f"cannot tell ({diagnosis.problem})"
    write_png(path, draw_sheet([f"{diagnosis.key}: {told}"], rows, width_px=_TILE_PX))


def _view_tiles(
    views: SceneFrames, matches: Sequence[FrameMatch], diagnosis: SceneDiagnosis
) -> list[list[Tile]]:
    match = max(matches, key=lambda match: (match.left, match.right) == views.primary)
    left, right = (
        channels_last(views.rgb(match.frame, file)) for file in (match.left, match.right)
    )
    is_scaled = diagnosis.is_scaled or diagnosis.best.form != diagnosis.declared.form
    best_scale = diagnosis.scale if is_scaled else 1.0
    rows = []
    for name, picture, words, hypothesis, scale in (
        ("left", left, "declared", diagnosis.declared, 1.0),
        ("right", right, "best", diagnosis.best, best_scale),
    ):
        warped, known = _warped(views, match, hypothesis, scale)
        away = np.abs(left.astype(np.float32) - warped).mean(axis=-1)
        painted = _DIFFERENCES.paint(away, measured=known)
        rows.append([
            Tile(f"{name} (frame {match.frame}, cam {match.left} and {match.right})", picture),
            Tile(f"right, warped by the {words} contract", warped),
            Tile(f"|left - warped|, {words}", painted, shrink="nearest"),
        ])  # fmt: skip
    return rows


def _warped(
    views: SceneFrames, match: FrameMatch, hypothesis: Hypothesis, scale: float
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Return the right picture warped to the left, and where depth and picture are known."""
    size = views.intrinsics.height_px, views.intrinsics.width_px
    rows, columns = np.indices(size).reshape(2, -1)
    predicted = views.predicted(replace(match, rows=rows, columns=columns), hypothesis)
    if predicted is None:
        return np.full((*size, 3), _NOT_KNOWN, dtype=np.uint8), np.zeros(size, dtype=bool)
    disparity_px, known = predicted
    landing_px = (columns + 0.5 - scale * disparity_px).reshape(size)
    landing = Projection(u_px=landing_px, v_px=None, depth_m=np.ones(size))
    warped, inside = backward_warp(views.rgb(match.frame, match.right), landing)
    shown = known.reshape(size) & inside
    pixels = channels_last(warped.round().astype(np.uint8))
    return np.where(shown[..., None], pixels, np.uint8(_NOT_KNOWN)), shown
