"""The doctor's report: as lines of text, the verdict first, as JSON, and as a picture."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, UInt8

from stereogenbench_data.audit.contract.diagnosis import SceneDiagnosis
from stereogenbench_data.audit.contract.doctor import DiagnosisTask, DoctorReport
from stereogenbench_data.audit.contract.hypotheses import Hypothesis
from stereogenbench_data.audit.contract.matching import FrameMatch, SceneFrames
from stereogenbench_data.audit.contract.scoring import Gain
from stereogenbench_data.audit.contract.verdict import QUOTIENT, Answer, Verdict, encoding_line
from stereogenbench_data.audit.geometry.records import plain
from stereogenbench_data.audit.scene_access import source_of
from stereogenbench_data.bridges.picture import (
    ColourScale,
    Tile,
    channels_last,
    draw_sheet,
    write_png,
)
from stereogenbench_data.errors import SelectionError
from stereogenbench_data.geometry.projection import Projection, backward_warp
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.text import counted
from stereogenbench_data.selection.filters import filter_scenes

QUOTIENT_MEANS: Final = (
    "Disparity shows only the quotient unit / (focal length x baseline). No picture tells which of "
    "the three is wrong, or whether two of them cancel out."
)
NOT_TESTED: Final = (
    "Not tested here, see `stereogenbench audit`: the sensor's height, the baselines recorded "
    "beside the poses, noise in depth, depth of one camera that is off by a pixel or lies where "
    "there is no texture, and all other frames."
)
_DB_NOTE: Final = (
    "dB of the quotient and the kind count small differences under a tight cap: they "
    "are not comparable with dB of flips, lags and orders."
)
_NAMED: Final = 6
_READINGS: Final = (
    "Several readings of the poses fit the rigs; pixels whose depth is found in other frames:"
)


def doctor_lines(report: DoctorReport) -> list[str]:
    """Return a report as lines of text."""
    views = sum(scene.views for scene in report.scenes)
    matches = sum(scene.matches for scene in report.scenes)
    lines = [
        _headline(report),
        f"{report.data}: {counted(len(report.scenes), 'scene')}, {counted(views, 'view')}, "
        f"{matches:,} pixels found in both pictures",
        *(f"left out: {key}: {reason}" for key, reason in [*report.left_out.items()][:_NAMED]),
        *([f"left out: {more} more"] if (more := len(report.left_out) - _NAMED) > 0 else []),
    ]
    silent = [scene for scene in report.scenes if scene.problem]
    if len(silent) < len(report.scenes):
        lines += [f"{scene.key}: cannot tell: {scene.problem}" for scene in silent]
    for verdict in report.verdicts:
        lines.append("")
        if len(report.verdicts) > 1:
            lines.append(f"{counted(len(verdict.scenes), 'scene')}: {', '.join(verdict.scenes)}")
        rows = [("question", "declared", "pictures say", "", "next best")]
        rows += [_row(answer) for answer in verdict.answers]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines += ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
        lines += ["", *_conclusion(verdict), *_tested(verdict), NOT_TESTED]
    if len(silent) < len(report.scenes):
        lines += ["", QUOTIENT_MEANS, _DB_NOTE]
    return lines + [line for each in report.worlds for line in ("", _READINGS, *each.lines)]


def _headline(report: DoctorReport) -> str:
    """Return the verdict on all scenes in one line."""
    if not report.verdicts:
        return "NOT TESTED: no scene could be judged. Run `stereogenbench audit`."
    if report.is_wrong:
        keys = {key for verdict in report.verdicts if verdict.is_wrong for key in verdict.scenes}
        count = f"{len(keys)} of {counted(len(report.scenes), 'scene')}"
        differ = f"; scenes differ, {len(report.verdicts)} verdicts follow"
        return (
            f"WRONG: pictures contradict the declared contract or a camera's files in {count}"
            f"{differ if len(report.verdicts) > 1 else ''}."
        )
    if all(verdict.fits for verdict in report.verdicts):
        return "FITS: pictures confirm the declared contract, with all cameras tested."
    problems = {scene.problem for scene in report.scenes}
    if "" not in problems:
        return f"CANNOT TELL: {'; '.join(sorted(problems))}."
    left = [part for verdict in report.verdicts for part in _open(verdict)]
    verdict_word = "CANNOT TELL" if QUOTIENT in left else "FITS as far as pictures tell"
    named = ", ".join(dict.fromkeys(left))
    return f"{verdict_word}: nothing contradicts the declared contract; undecided: {named}."


def _open(verdict: Verdict) -> Iterator[str]:
    """Yield what pictures do not decide."""
    yield from (answer.topic for answer in verdict.answers if answer.status == "cannot tell")
    cameras = sorted({*verdict.untested_cameras, *verdict.unexplained_cameras})
    if cameras:
        yield _cameras(cameras)


def _conclusion(verdict: Verdict) -> Iterator[str]:
    """Yield what follows from a verdict's answers."""
    yield from (f"WRONG: {problem}." for problem in verdict.problems)
    if any(answer.status == "wrong" for answer in verdict.answers):
        yield f"Another contract is {_gain_words(verdict.gain)} better than the declared one."
    if verdict.choices:
        yield "One of these explains the quotient; the pictures cannot tell which:"
        yield from (f"  - {choice}" for choice in verdict.choices)
    if verdict.encoding is not None:
        yield f"Paste: {encoding_line(verdict.encoding)}"
    elif verdict.is_wrong:
        yield "Nothing to paste: no DepthEncoding is certain to correct this."
    elif verdict.fits:
        yield f"The declared contract fits: {encoding_line(verdict.declared)}"
    else:
        yield f"Nothing contradicts the declared contract. Undecided: {', '.join(_open(verdict))}."


def _tested(verdict: Verdict) -> Iterator[str]:
    """Yield which cameras were tested, and how much is explained."""
    if math.isfinite(verdict.agreement):
        share = f"{verdict.agreement:.0%} of the matches of neighbouring cameras"
        yield f"It explains {share} to a pixel."
    if verdict.unexplained_cameras:
        yield (
            f"Depth explains less than half of the matches of "
            f"{_cameras(verdict.unexplained_cameras)}. Matches are often false in small pictures "
            f"and across wide baselines; wrong depth looks alike. `stereogenbench audit` tells "
            f"them apart."
        )
    if verdict.tested_cameras:
        yield f"Depth and pictures tested: {_cameras(verdict.tested_cameras)}."
    if verdict.untested_cameras:
        untested = _cameras(verdict.untested_cameras)
        yield f"NOT TESTED, too few matches: {untested}. Run `stereogenbench audit`."


def _cameras(cameras: Sequence[int]) -> str:
    words = ", ".join(map(str, cameras))
    return f"camera {words}" if len(cameras) == 1 else f"cameras {words}"


def _row(answer: Answer) -> tuple[str, str, str, str, str]:
    notes = [answer.note] if answer.note else []
    is_wrong = answer.status == "wrong"
    if answer.behind is not None and math.isfinite(answer.behind.mean_db):
        by_shape = ", told by the shape of disparity" if answer.behind.by_shape else ""
        notes.insert(0, f"{'declared is ' * is_wrong}{_gain_words(answer.behind)} worse{by_shape}")
    status = answer.status.upper() if is_wrong else answer.status
    return answer.topic, answer.declared, answer.found or "?", status, "; ".join(notes)


def _gain_words(gain: Gain) -> str:
    return f"{gain.mean_db:.2f} dB (95 %: {gain.low_db:.2f} to {gain.high_db:.2f})"


def doctor_json(report: DoctorReport) -> dict[str, Any]:
    """Return a report as values for `json.dumps`, with None for nan."""
    verdicts = [
        {
            **asdict(each),
            "is_wrong": each.is_wrong,
            "tested_cameras": each.tested_cameras,
            "paste": None if each.encoding is None else encoding_line(each.encoding),
        }
        for each in report.verdicts
    ]
    document: dict[str, Any] = plain({
        "data": report.data,
        "verdict": _headline(report),
        "is_wrong": report.is_wrong,
        "quotient_means": QUOTIENT_MEANS,
        "not_tested": NOT_TESTED,
        "verdicts": verdicts,
        "scenes": [asdict(scene) for scene in report.scenes],
        "left_out": report.left_out,
    })  # fmt: skip
    return document


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
