"""The audit's table, and the report as Markdown: our figures, the paper's, and the limits."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from operator import attrgetter
from typing import Any, Final

import numpy as np

from stereogenbench_data.audit.geometry.alignment import CERTAIN
from stereogenbench_data.audit.geometry.records import (
    QUANTILES,
    QUANTITIES,
    AuditLimits,
    AuditReport,
    AuditRow,
    CameraAudit,
    Finding,
    RigAudit,
    SceneAudit,
    ToleranceAudit,
)
from stereogenbench_data.audit.geometry.reprojection import TOLERANCES
from stereogenbench_data.audit.geometry.scene_audit import LONG_PAIR
from stereogenbench_data.audit.paper_numbers import AUDIT, AUDIT_TABLE, FRAMES_A_SCENE
from stereogenbench_data.schema.text import counted, markdown_table, markdown_text

_LISTED: Final = 500
_CHECKS: Final = (
    "broken", "unreadable", "missing frames", "invalid depth", "too dark", "flat", "frozen",
    "copied view", "occluder",
)  # fmt: skip


def table_rows(
    scenes: Sequence[SceneAudit],
    limits: AuditLimits,
    *,
    findings: Sequence[Finding],
    untested: Sequence[Finding],
) -> tuple[AuditRow, ...]:
    """Return the table of an audit over scenes."""
    checks = dict.fromkeys([*_CHECKS, *(finding.check for finding in findings)])
    counts = [
        f"{check} {count}"
        for check in checks
        if (count := len({each.scene for each in findings if each.check == check}))
    ]
    return (
        *_rig_rows([scene.rig for scene in scenes], limits),
        *_reprojection_rows(scenes, limits),
        *_alignment_rows(scenes, limits, untested),
        *_frame_rows(scenes, limits),
        *_camera_rows([camera for scene in scenes for camera in scene.cameras], limits),
        AuditRow("findings", "scenes with", ", ".join(counts) or "none", "none", "none"),
    )


def _rig_rows(rigs: Sequence[RigAudit], limits: AuditLimits) -> Iterator[AuditRow]:
    def most(name: str, unit: str) -> str:
        return f"{_number(_over(max, map(attrgetter(name), rigs)))} {unit}"

    def mean_cm(name: str) -> str:
        return f"{_number(_over(np.mean, map(attrgetter(name), rigs)))} cm"

    recorded = sum(rig.intrinsics_recorded for rig in rigs)
    source = f"{recorded} numbers recorded in px" if recorded else "none recorded in px"
    baseline, rectified = f"{limits.baseline_cm:g} cm", f"{limits.rectified_px:g} px"
    between = "pose-derived less recorded"
    yield AuditRow(
        "intrinsics", f"largest deviation of fx, fy, cx, cy from f / s W ({source})",
        most("intrinsics_px", "px"), AUDIT["intrinsics"], f"{limits.intrinsics_px:g} px",
    )  # fmt: skip
    yield AuditRow(
        "pose/baseline", f"{between}, adjacent: mean / largest",
        f"{mean_cm('adjacent_mean_cm')} / {most('adjacent_max_cm', 'cm')}", "", baseline,
    )  # fmt: skip
    yield AuditRow(
        "pose/baseline", f"{between}, all 15 pairs: mean / largest",
        f"{mean_cm('pairs_mean_cm')} / {most('pairs_max_cm', 'cm')}", AUDIT["baseline"], baseline,
    )  # fmt: skip
    yield AuditRow(
        "rig rotation", "largest turn of a camera against camera 0, and what it moves",
        f"{most('rotation_deg', 'deg')} / {most('rotation_px', 'px')}", "", rectified,
    )  # fmt: skip
    yield AuditRow(
        "lateral residual", "largest shift by cameras off the rig's line",
        most("lateral_px", "px"), "", rectified,
    )  # fmt: skip


def _reprojection_rows(scenes: Sequence[SceneAudit], limits: AuditLimits) -> Iterator[AuditRow]:
    primary = [scene.pairs[0] for scene in scenes]
    long = [scene.pairs[-1] for scene in scenes]
    both = [pair for scene in scenes for pair in scene.pairs]
    of = {"both pairs": both, "primary pair": primary, f"{LONG_PAIR[0]}-{LONG_PAIR[1]}": long}
    for name, pairs in of.items():
        comparable = sum(pair.comparable for pair in pairs)
        for place, tolerance in enumerate(TOLERANCES):
            audits = [pair.tolerances[place] for pair in pairs]
            median_px, p95_px = pooled_px(audits, 0.5), pooled_px(audits, 0.95)
            kept = _percent(_ratio(sum(each.kept for each in audits), comparable))
            is_limited = name == "primary pair" and tolerance is TOLERANCES[-1]
            yield AuditRow(
                "reprojection",
                f"{name}, {tolerance.name}: median / 95th percentile (pixels kept)",
                f"{_number(median_px)} px / {_number(p95_px)} px ({kept})",
                AUDIT["reprojection"] if name == "both pairs" else "",
                f"median {limits.reprojection_px:g} px" if is_limited else "",
            )
    for name, pairs in of.items():
        agreement = _ratio(sum(p.agreeing for p in pairs), sum(p.unhidden for p in pairs))
        yield AuditRow(
            "agreement",
            f"{name}: pixels that nothing hides whose two depths agree (least of a scene)",
            f"{_percent(agreement)} ({_percent(_over(min, (p.agreement for p in pairs)))})",
        )


_SIZES: Final = (
    ("depth", "of one camera against the others: factor", ("scale",), "depth_scale"),
    ("depth", "of one camera: shift, px", ("shift_x", "shift_y"), "depth_shift_px"),
    ("depth", "share of the way to depth along the ray", ("ray",), "depth_ray"),
    ("depth", "focal length or all baselines between cameras: factor", ("focal",), "focal"),
    ("motion", "focal length or unit of depth from frame to frame: factor",
     ("scale", "focal", "focal_x", "focal_y"), "focal"),
)  # fmt: skip


def _alignment_rows(
    scenes: Sequence[SceneAudit], limits: AuditLimits, untested: Sequence[Finding]
) -> Iterator[AuditRow]:
    found = [scene.alignment for scene in scenes]
    pairs = [pair for each in found for pair in each.pairs]

    def row(
        check: str, quantity: str, ours: str, limit: str, whats: Sequence[str] = ()
    ) -> AuditRow:
        names = tuple(QUANTITIES[what] for what in whats) or ("",)
        blind = {
            each.scene for each in untested
            if each.check == check and each.found.startswith(names)
        }  # fmt: skip
        if blind:
            ours = f"{ours}; not testable in {len(blind)} of {counted(len(scenes), 'scene')}"
        return AuditRow(check, quantity, ours, "", limit)

    yield row(
        "depth consistency", "points of smooth surfaces that another camera sees through, most",
        _percent(_over(max, (pair.see_through for pair in pairs))), _percent(limits.see_through),
    )  # fmt: skip
    for check, quantity, whats, name in _SIZES:
        sizes = [
            (abs(each.value), each.error) for of_scene in found for each in of_scene.estimates
            if each.check == check and each.what in whats and abs(each.value) > CERTAIN * each.error
        ]  # fmt: skip
        size, error = max(sizes, default=(0.0, 0.0))
        ours = f"{size:.2g} ± {1.96 * error:.2g}" if sizes else "none"
        limit = f"{getattr(limits, name):g}"
        yield row(f"{check} fit", f"{quantity}, largest that is certain", ours, limit, whats)
    moved = _over(max, (_ratio(each.moved_through, each.moved_smooth) for each in found))
    yield row(
        "motion", "the same share from one audited frame to the next, most",
        _percent(moved), _percent(limits.moved_through),
    )  # fmt: skip
    yield row(
        "picture time", "gain of correlation by pictures of a frame beside, most",
        _number(_over(max, (gain for each in found for _, _, gain in each.lags))),
        f"{limits.picture_lag:g}",
    )  # fmt: skip
    yield row(
        "picture content", "correlation of two cameras' pictures, taken there by depth, least",
        _number(_over(min, (pair.correlation for pair in pairs))),
        f"{limits.picture_odd:g} less than others",
    )  # fmt: skip


def _frame_rows(scenes: Sequence[SceneAudit], limits: AuditLimits) -> Iterator[AuditRow]:
    expected = [int(limits.frames) or scene.frames for scene in scenes for _ in scene.cameras]
    for name in ("RGB", "depth"):
        count_of = attrgetter(f"{name.lower()}_frames")
        found = [count_of(camera) for scene in scenes for camera in scene.cameras]
        counts = [count for count in found if count >= 0] or [0]
        missing = sum(max(0, most - max(0, got)) for most, got in zip(expected, found, strict=True))
        low, high = min(counts), max(counts)
        span = f"{low}" if low == high else f"{low} to {high}"
        yield AuditRow(
            "frames",
            f"{name} frames in all (of a video), missing",
            f"{sum(counts):,} ({span}), {missing:,} missing",
            f"{FRAMES_A_SCENE} of a video, 0 missing",
            f"{limits.frames:g}" if limits.frames else "as poses",
        )


def _camera_rows(cameras: Sequence[CameraAudit], limits: AuditLimits) -> Iterator[AuditRow]:
    valid = _percent(_over(np.mean, (camera.valid_depth for camera in cameras)))
    least = _percent(_over(min, (camera.least_valid_depth.value for camera in cameras)))
    yield AuditRow(
        "depth validity",
        "mean valid-depth ratio over audited frames and cameras (least of a picture)",
        f"{valid} ({least})", AUDIT["valid_depth"], _percent(limits.valid_depth),
    )  # fmt: skip
    units = _distinct(camera.depth_unit_m for camera in cameras)
    steps = _distinct(camera.depth_step_units * camera.depth_unit_m for camera in cameras)
    yield AuditRow(
        "depth quantum", f"step of stored depth, estimated from the numbers (unit: {units})",
        steps, "0.1 m without a tag",
    )  # fmt: skip
    for check, what, figure in (
        ("too dark", "least 95th percentile of luma", "brightness"),
        ("flat", "least span of luma (5th to 95th percentile)", "contrast"),
        ("frozen", "least mean change of luma while the camera moves", "change"),
    ):
        value = _number(_over(min, (getattr(camera, figure).value for camera in cameras)))
        limit = f"{getattr(limits, figure):g}"
        yield AuditRow("pictures", f"{check}: {what}", f"{value} of 255", "", limit)
    yield AuditRow(
        "pictures", "occluder: largest share of a picture hidden from its border",
        _percent(_over(max, (camera.occluder.value for camera in cameras))), "",
        _percent(limits.occluder),
    )  # fmt: skip


def pooled_px(audits: Iterable[ToleranceAudit], share: float) -> float:
    """Return a quantile of the errors of several scenes together, nan for no errors.

    The scenes' own quantile functions are mixed, weighted by their numbers of pixels.
    """
    kept = [each for each in audits if each.kept]
    if not kept:
        return math.nan
    if len(kept) == 1:
        return float(np.interp(share, QUANTILES, kept[0].errors_px))
    values = np.array([each.errors_px for each in kept])
    middles = ((values[:, 1:] + values[:, :-1]) / 2).ravel()
    weights = np.repeat([each.kept for each in kept], values.shape[1] - 1)
    order = np.argsort(middles)
    reached = np.cumsum(weights[order]) / weights.sum()
    place = min(int(np.searchsorted(reached, share)), len(order) - 1)
    return float(middles[order][place])


def audit_markdown(report: AuditReport) -> str:
    """Return a report as Markdown: the verdict, the table, its definitions, and the findings."""
    frames = "all frames" if report.frames == 0 else f"up to {counted(report.frames, 'frame')}"
    lines = [
        f"# {_verdict(report)}: audit of {markdown_text(str(report.root))}",
        "",
        f"{report.scenes_audited} of {counted(report.scenes_there, 'scene')}, {frames} of "
        f"each. Under paper: {AUDIT_TABLE}.",
        "",
        *markdown_table(
            ("check", "quantity", "here", "paper", "limit"),
            *((row.check, row.quantity, row.ours, row.paper, row.limit) for row in report.rows),
        ),
        "",
        "What pictures say of depth: `stereogenbench doctor`.",
        "",
        "Reprojection: left depth to the right camera, and back by the right depth; pixels whose "
        "two depths differ by more than the tolerance (share of depth + steps of stored depth) "
        "count as occluded. The paper does not state its tolerance.",
    ]
    lines += _listed("Findings", [str(finding) for finding in report.findings])
    lines += _listed("Not testable", [str(each) for each in report.untested])
    lines += _listed("Notes", list(report.notes))
    return "\n".join(lines) + "\n"


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


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else math.nan


def _number(value: float) -> str:
    """Return three significant digits; a dash for nan."""
    return "-" if math.isnan(value) else f"{value:.3g}"


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{value * 100:.4g} %"


def _distinct(values: Iterable[float]) -> str:
    """Return lengths in m, each once; their range if they are many."""
    found = sorted({float(f"{value:.6g}") for value in values if not math.isnan(value)})
    if not found:
        return "-"
    if len(found) > 4:
        return f"{found[0]:g} to {found[-1]:g} m"
    return ", ".join(f"{value:g}" for value in found) + " m"
