"""The doctor's report: as text, the verdict first, as one screen, and as JSON."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any, Final

from stereogenbench_data.audit.contract.doctor import DoctorReport
from stereogenbench_data.audit.contract.verdict import QUOTIENT, Answer, Verdict, encoding_line
from stereogenbench_data.audit.geometry.records import plain
from stereogenbench_data.schema.text import counted

QUOTIENT_MEANS: Final = (
    "Depth scale is unit / (focal length x baseline), which is all that disparity shows of the "
    "three: a scene that is stretched along the axis looks right from the side. Depth from frame "
    "to frame tells unit and focal length apart where a camera turns or advances; baselines and "
    "poses that are wrong alike show nowhere."
)
NOT_TESTED: Final = (
    "Not tested here, see `stereogenbench audit`: the sensor's height, the baselines recorded "
    "beside the poses, noise in depth, depth of one camera that is off by a pixel or lies where "
    "there is no texture, and all other frames."
)
_READINGS: Final = (
    "Several readings of the poses fit the rigs; pixels whose depth is found in other frames:"
)
Part = tuple[str, list[Sequence[str]]]
"""A table: its title, and its rows, the first one its head."""


def doctor_lines(report: DoctorReport) -> list[str]:
    """Return a report as lines of text."""
    verdict, parts = screen(report)
    lines = [verdict]
    for title, rows in parts:
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines += ["", *([title] if title else [])]
        lines += ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    return lines


def screen(report: DoctorReport) -> tuple[str, list[Part]]:
    """Return the verdict, and tables of everything else, the most important first."""
    several = len(report.verdicts) > 1
    rows = [(_scenes(each), each.in_a_line) for each in report.verdicts]
    parts: list[Part] = [("", [("scenes", "pictures say"), *rows])] if several else []
    for verdict in report.verdicts:
        follows = [*_conclusion(verdict), *_tested(verdict)]
        title = ", ".join(verdict.scenes) if several else ""
        parts.append((title, [("what follows",), *([line] for line in follows)]))
        parts.append(("", [_HEAD, *map(_row, verdict.answers)]))
    for each in report.worlds:
        parts.append((_READINGS, [("explained",), *([line] for line in each.lines)]))
    unjudged = report.left_out | {each.key: each.problem for each in report.scenes if each.problem}
    if unjudged:
        parts.append(("", [("not judged", "why"), *unjudged.items()]))
    views = sum(scene.views for scene in report.scenes)
    matches = sum(scene.matches for scene in report.scenes)
    looked = (
        f"{report.data}: {counted(len(report.scenes), 'scene')}, {counted(views, 'view')}, "
        f"{matches:,} pixels found in both pictures"
    )
    parts.append(("", [("notes",), [looked], [QUOTIENT_MEANS], [NOT_TESTED]]))
    return _headline(report), parts


def _scenes(verdict: Verdict) -> str:
    more = len(verdict.scenes) - 1
    return f"{verdict.scenes[0]}{f' and {more} more' if more else ''}"


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
    if verdict.choices:
        yield "One of these explains the depth scale; the pictures cannot tell which:"
        yield from (f"  - {choice}" for choice in verdict.choices)
    if verdict.encoding is not None:
        yield f"Paste: {encoding_line(verdict.encoding)}"
    elif verdict.is_wrong:
        yield "Nothing to paste: no DepthEncoding is certain to correct this."
    else:
        yield f"Nothing contradicts the declared contract: {encoding_line(verdict.declared)}"


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


_HEAD: Final = ("question", "declared", "pictures say", "", "why")


def _row(answer: Answer) -> tuple[str, str, str, str, str]:
    status = answer.status.upper() if answer.status == "wrong" else answer.status
    return answer.topic, answer.declared, answer.found or "?", status, answer.note


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
