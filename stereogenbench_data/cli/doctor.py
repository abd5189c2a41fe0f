"""``stereogenbench doctor``: find the depth contract from the pictures."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stereogenbench_data.cli.errors import FINDINGS
from stereogenbench_data.cli.options import (
    DataOptions,
    JsonOption,
    OutOption,
    SceneOptions,
    WorkOptions,
    grouped,
)
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.writing import writing
from stereogenbench_data.schema.text import counted

if TYPE_CHECKING:
    from stereogenbench_data.audit.contract.doctor import DoctorReport
    from stereogenbench_data.audit.contract.scoring import Gain
    from stereogenbench_data.audit.contract.verdict import Answer, Verdict


QUOTIENT_MEANS = (
    "Disparity shows only the quotient unit / (focal length x baseline). No picture tells which of "
    "the three is wrong, or whether two of them cancel out."
)
NOT_TESTED = (
    "Not tested here, see `stereogenbench audit`: the sensor's height, the baselines recorded "
    "beside the poses, colours, depth that is off by a pixel or lies where there is no texture, "
    "and all other frames."
)
_DB_NOTE = (
    "dB of the quotient, kind and offset count small differences under a tight cap: they "
    "are not comparable with dB of flips, lags and orders."
)


@grouped
def doctor(  # noqa: PLR0913 - one parameter an option
    source: DataOptions,
    *,
    scenes: Annotated[int, typer.Option(min=1, help="Scenes to look at.")] = 6,
    per_scene: Annotated[int, typer.Option(min=1, help="Frames of each scene.")] = 4,
    chosen: SceneOptions,
    out: OutOption = None,
    as_json: JsonOption = False,
    work: WorkOptions,
) -> None:
    """Find from the pictures how stored depth becomes metres.

    The doctor compares what the cameras of a scene see with what depth predicts: planar or ray,
    inverse, frame lag, camera order, flips, offset, unit / (focal length x baseline), and each
    camera beside the others. The declared contract is that of the files and of --conventions
    FILE. -o writes a picture. The exit status is 0 if the declared contract
    fits or the pictures cannot tell, 1 if another one is clearly better or a camera does not fit,
    2 if the command failed.

    Example: `stereogenbench doctor scenes/ -o doctor.png`
    """
    from stereogenbench_data.audit.contract.doctor import diagnose
    from stereogenbench_data.audit.contract.picture import draw_report, require_picture_file

    if out is not None:
        require_picture_file(out)
    filters: Any = chosen.filters()
    index = source.open()
    with progress_bar("examining", unit="scenes") as progress:
        report = diagnose(
            index,
            scenes=scenes,
            frames=per_scene,
            **work.options(),
            progress=progress,
            filters=filters,
        )
    if out is not None:
        with writing(out):
            draw_report(out, report, index)
    typer.echo(_json(report) if as_json else "\n".join(_lines(report)))
    if out is not None and not as_json:
        typer.echo(f"\npicture: {out}")
    if report.is_wrong:
        raise typer.Exit(FINDINGS)


def _lines(report: "DoctorReport") -> list[str]:
    matches = sum(scene.matches for scene in report.scenes)
    views = sum(scene.views for scene in report.scenes)
    lines = [
        _headline(report),
        f"{report.data}: {counted(len(report.scenes), 'scene')}, {counted(views, 'view')}, "
        f"{matches:,} pixels found in both pictures",
    ]
    for key, reason in report.left_out.items():
        lines.append(f"left out: {key}: {reason}")
    if len(report.verdicts) > 1:
        lines.append(
            f"SCENES DIFFER: {len(report.verdicts)} verdicts follow."
            if report.is_wrong
            else f"{len(report.verdicts)} verdicts follow, as the pictures fit best by different "
            f"contracts; none contradicts the declared one."
        )
    silent = [scene for scene in report.scenes if scene.problem]
    if silent and len(silent) < len(report.scenes):
        lines += [f"{scene.key}: cannot tell: {scene.problem}" for scene in silent]
    for verdict in report.verdicts:
        lines.append("")
        if len(report.verdicts) > 1:
            lines.append(f"{counted(len(verdict.scenes), 'scene')}: {', '.join(verdict.scenes)}")
        rows = [("question", "declared", "pictures say", "", "next best")]
        rows += [_row(answer) for answer in verdict.answers]
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines += ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
        lines += ["", *_conclusion(verdict), *_tested_lines(verdict), *verdict.beside]
    if any(math.isfinite(scene.gain.mean_db) for scene in report.scenes):
        lines += ["", QUOTIENT_MEANS, _DB_NOTE]
    return lines + _world_lines(report)


def _headline(report: "DoctorReport") -> str:
    """Return the verdict on all scenes in one line."""
    if not report.verdicts:
        return "NOT TESTED: no scene could be judged. Run `stereogenbench audit`."
    if report.is_wrong:
        keys = {key for verdict in report.verdicts if verdict.is_wrong for key in verdict.scenes}
        return (
            f"WRONG: pictures contradict the declared contract or a camera's files in {len(keys)} "
            f"of {counted(len(report.scenes), 'scene')}."
        )
    if all(verdict.fits for verdict in report.verdicts):
        return "FITS: pictures confirm the declared contract, with all cameras tested."
    problems = {scene.problem for scene in report.scenes}
    if "" not in problems:
        return f"CANNOT TELL: {'; '.join(sorted(problems))}."
    return "CANNOT TELL everything: nothing contradicts the declared contract."


def _world_lines(report: "DoctorReport") -> list[str]:
    """Return which of several readings of the poses depth confirms from frame to frame."""
    head = "Several readings of the poses fit the rigs; pixels whose depth is found in other frames"
    return [line for each in report.worlds for line in ("", f"{head}:", *each.lines)]


def _conclusion(verdict: "Verdict") -> list[str]:
    from stereogenbench_data.audit.contract.verdict import encoding_line

    lines = [f"WRONG: {problem}." for problem in verdict.problems]
    if any(answer.status == "wrong" for answer in verdict.answers):
        lines.append(
            f"Another contract is {_gain_words(verdict.gain)} better than the declared one."
        )
    if verdict.choices:
        lines.append("One of these explains the quotient; the pictures cannot tell which:")
        lines += [f"  - {choice}" for choice in verdict.choices]
    if verdict.encoding is not None:
        lines.append(f"Paste: {encoding_line(verdict.encoding)}")
    elif verdict.is_wrong:
        lines.append("Nothing to paste: no DepthEncoding is certain to correct this.")
    elif verdict.fits:
        lines.append(f"The declared contract fits: {encoding_line(verdict.declared)}")
    elif math.isfinite(verdict.agreement) and not verdict.unexplained_cameras:
        open_topics = [a.topic for a in verdict.answers if a.status == "cannot tell"]
        undecided = f" Undecided: {', '.join(open_topics)}." if open_topics else ""
        lines.append(f"Cannot tell: nothing contradicts the declared contract.{undecided}")
    else:
        lines.append("Cannot tell: the pictures do not decide about the declared contract.")
    return lines


def _tested_lines(verdict: "Verdict") -> list[str]:
    """Return which cameras were tested, how much is explained, and what is not tested here."""
    lines = []
    if math.isfinite(verdict.agreement):
        lines.append(
            f"It explains {verdict.agreement:.0%} of the matches of neighbouring cameras to a "
            "pixel."
        )
    if verdict.unexplained_cameras:
        lines.append(
            f"Depth explains less than half of the matches of "
            f"{_cameras(verdict.unexplained_cameras)}. Matches are often false in small pictures "
            f"and across wide baselines; wrong depth looks alike. `stereogenbench audit` tells "
            f"them apart."
        )
    if verdict.tested_cameras:
        lines.append(f"Depth and pictures tested: {_cameras(verdict.tested_cameras)}.")
    if verdict.untested_cameras:
        lines.append(
            f"NOT TESTED, too few matches: {_cameras(verdict.untested_cameras)}. "
            "Run `stereogenbench audit`."
        )
    return [*lines, NOT_TESTED]


def _cameras(cameras: Sequence[int]) -> str:
    words = ", ".join(map(str, cameras))
    return f"camera {words}" if len(cameras) == 1 else f"cameras {words}"


def _row(answer: "Answer") -> tuple[str, str, str, str, str]:
    notes = [answer.note] if answer.note else []
    is_wrong = "wrong" in answer.status
    if answer.behind is not None and math.isfinite(answer.behind.mean_db):
        notes.insert(0, f"{'declared is ' * is_wrong}{_gain_words(answer.behind)} worse")
    status = answer.status.upper() if is_wrong else answer.status
    return answer.topic, answer.declared, answer.found or "?", status, "; ".join(notes)


def _gain_words(gain: "Gain") -> str:
    return f"{gain.mean_db:.2f} dB (95 %: {gain.low_db:.2f} to {gain.high_db:.2f})"


def _json(report: "DoctorReport") -> str:
    from stereogenbench_data.audit.contract.verdict import encoding_line
    from stereogenbench_data.audit.geometry.records import plain

    verdicts = []
    for verdict in report.verdicts:
        paste = None if verdict.encoding is None else encoding_line(verdict.encoding)
        verdicts.append(asdict(verdict) | {"paste": paste})
    scenes = []
    for scene in report.scenes:
        offsets_px = [{"pair": pair, "px": px} for pair, px in scene.offsets_px.items()]
        scenes.append(asdict(scene) | {"offsets_px": offsets_px})
    document = {
        "data": report.data,
        "is_wrong": report.is_wrong,
        "quotient_means": QUOTIENT_MEANS,
        "not_tested": NOT_TESTED,
        "verdicts": verdicts,
        "scenes": scenes,
        "left_out": report.left_out,
    }
    return json.dumps(plain(document), indent=2)
