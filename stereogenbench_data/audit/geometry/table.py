"""The audit's table, and the report as Markdown: our figures, the paper's, and the limits."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from textwrap import shorten
from typing import Any, Final

import numpy as np

from stereogenbench_data.audit.geometry.records import (
    CHECKS,
    QUANTILES,
    AuditReport,
    AuditRow,
    Finding,
    SceneAudit,
    with_unit,
)
from stereogenbench_data.audit.geometry.reprojection import TOLERANCES
from stereogenbench_data.audit.paper_numbers import AUDIT
from stereogenbench_data.schema.text import counted, markdown_table, markdown_text

_LISTED: Final = 500
_SHORT: Final = 50


def table_rows(scenes: Sequence[SceneAudit], findings: Sequence[Finding]) -> tuple[AuditRow, ...]:
    """Return the table of an audit over scenes."""
    counts = [
        f"{check} {len({each.scene for each in findings if each.check == check})}"
        for check in dict.fromkeys(finding.check for finding in findings)
    ]
    return (
        *_check_rows(scenes),
        *_reprojection_rows(scenes),
        *_depth_rows(scenes),
        AuditRow("findings", "scenes with", ", ".join(counts) or "none", "none", "none"),
    )


def _values(scenes: Sequence[SceneAudit], quantity: str) -> list[float]:
    return [each.value for scene in scenes for each in scene.figures if each.quantity == quantity]


def _check_rows(scenes: Sequence[SceneAudit]) -> Iterator[AuditRow]:
    for quantity, check in CHECKS.items():
        ours = check.text(_over(check.worst, _values(scenes, quantity)))
        blind = {
            scene.key for scene in scenes for each in scene.figures
            if each.quantity == quantity and math.isnan(each.value) and each.where
        }  # fmt: skip
        if blind:
            ours += f"; not testable in {len(blind)} of {counted(len(scenes), 'scene')}"
        yield AuditRow(check.name, check.what, ours, check.paper, check.text(check.limit))


def _reprojection_rows(scenes: Sequence[SceneAudit]) -> Iterator[AuditRow]:
    pairs = [pair for scene in scenes for pair in scene.pairs]
    comparable = sum(pair.comparable for pair in pairs)
    for place, tolerance in enumerate(TOLERANCES):
        counts = [pair.kept[place] for pair in pairs]
        errors_px = [pair.errors_px[place] for pair in pairs]
        median_px, p95_px = (
            with_unit(pooled_px(counts, errors_px, share)) for share in (0.5, 0.95)
        )
        kept = with_unit(sum(counts) / comparable if comparable else math.nan, "%")
        yield AuditRow(
            "reprojection",
            f"both pairs, {tolerance.name}: median / 95th percentile (pixels kept)",
            f"{median_px} px / {p95_px} px ({kept})",
            AUDIT["reprojection"],
        )


def _depth_rows(scenes: Sequence[SceneAudit]) -> Iterator[AuditRow]:
    valid = with_unit(_over(np.mean, _values(scenes, "mean_valid_depth")), "%")
    quantity = "mean valid-depth ratio over audited frames and cameras"
    yield AuditRow("depth validity", quantity, valid, AUDIT["valid_depth"])
    units_m = sorted(
        {f"{each:.6g}" for each in _values(scenes, "depth_unit_m")} - {"nan"}, key=float
    )
    span = ", ".join(units_m) if len(units_m) < 5 else f"{units_m[0]} to {units_m[-1]}"
    ours = f"{span} m" if units_m else "-"
    yield AuditRow("depth unit", "metres in a stored unit", ours, "0.1 m without a tag")


def pooled_px(counts: Sequence[int], errors_px: Sequence[Sequence[float]], share: float) -> float:
    """Return a quantile of the errors of several scenes together, nan for no errors.

    The scenes' own quantile functions are mixed, weighted by their numbers of pixels.
    """
    kept = [(count, each) for count, each in zip(counts, errors_px, strict=True) if count]
    if not kept:
        return math.nan
    if len(kept) == 1:
        return float(np.interp(share, QUANTILES, kept[0][1]))
    values = np.array([each for _, each in kept])
    middles = (values[:, 1:] + values[:, :-1]) / 2
    weights = np.repeat([count for count, _ in kept], middles.shape[1])
    return float(np.quantile(middles.ravel(), share, weights=weights, method="inverted_cdf"))


def audit_markdown(report: AuditReport) -> str:
    """Return a report as Markdown: the verdict, the table, its definitions, and the findings."""
    frames = "all frames" if report.frames == 0 else f"up to {counted(report.frames, 'frame')}"
    lines = [
        f"# {_verdict(report)}: audit of {markdown_text(str(report.root))}",
        "",
        f"{report.scenes_audited} of {counted(report.scenes_there, 'scene')}, {frames} of "
        f"each. Under paper: table of the geometry consistency audit.",
        "",
        *markdown_table(
            ("check", "quantity", "here", "paper", "limit"),
            *((row.check, row.quantity, row.ours, row.paper, row.limit) for row in report.rows),
        ),
        "",
        "A row with a limit shows the worst figure of all scenes. What pictures say of depth, and "
        "the cause of a residual: `stereogenbench doctor`.",
        "",
        "Reprojection: left depth of the primary pair and of cameras 0 and 5 to the right camera, "
        "and back by the right depth; pixels whose "
        "two depths differ by more than the tolerance (share of depth + steps of stored depth) "
        "count as occluded. The paper does not state its tolerance.",
    ]
    lines += _listed("Findings", [str(finding) for finding in report.findings])
    lines += _listed("Not testable", [str(each) for each in report.untested])
    lines += _listed("Notes", list(report.notes))
    return "\n".join(lines) + "\n"


def screen(report: AuditReport) -> tuple[str, list[tuple[str, list[Sequence[str]]]]]:
    """Return what a screen shows of a report: the verdict, what was found, and what has a limit."""
    audited = f"{report.scenes_audited} of {counted(report.scenes_there, 'scene')}"
    checks: dict[str, list[Finding]] = {}
    for each in report.findings:
        checks.setdefault(each.check, []).append(each)
    found: list[Sequence[str]] = [("finding", "scenes", "the first")]
    for check, findings in checks.items():
        first = findings[0]
        where = "/".join(part for part in (first.scene, first.member) if part)
        scenes = len({each.scene for each in findings})
        found.append((check, str(scenes), f"{where}: {' '.join(first.found.split())}"))
    limits: list[Sequence[str]] = [("check", "quantity", "here", "limit")]
    limits += [
        (row.check, shorten(row.quantity, _SHORT, placeholder="..."), row.ours, row.limit)
        for row in report.rows
        if row.limit
    ]
    parts = [("Findings", found)] if checks else []
    return f"{_verdict(report)}. {audited} audited.", [*parts, ("Worst of all scenes", limits)]


def _verdict(report: AuditReport) -> str:
    """Return in words whether anything is wrong."""
    untested = counted(len(report.untested), "check") + " not testable"
    if report.findings:
        scenes = len({finding.scene for finding in report.findings})
        found = counted(len(report.findings), "finding")
        return f"WRONG: {found} in {counted(scenes, 'scene')}"
    return f"Nothing wrong found{f', {untested}' if report.untested else ''}"


def _listed(title: str, texts: list[str]) -> list[str]:
    if not texts:
        return []
    more = [f"- and {len(texts) - _LISTED} more"] if len(texts) > _LISTED else []
    return [
        "",
        f"## {title} ({len(texts)})",
        "",
        # Commands in our own messages stay quoted.
        *(f"- {markdown_text(each)}".replace(r"\`", "`") for each in texts[:_LISTED]),
        *more,
    ]


def _over(which: Callable[[list[float]], Any], values: Iterable[float]) -> float:
    """Return the largest, the least or the mean of values that are known, nan for none."""
    known = [value for value in values if not math.isnan(value)]
    return float(which(known)) if known else math.nan
