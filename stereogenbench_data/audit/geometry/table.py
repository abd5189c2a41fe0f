"""The audit's table, and the report as Markdown: our figures, the paper's, and the limits."""

import math
from collections.abc import Iterable, Iterator, Sequence
from operator import attrgetter
from typing import Final

import numpy as np

from stereogenbench_data.audit.geometry.alignment import CERTAIN
from stereogenbench_data.audit.geometry.records import (
    QUANTILES,
    QUANTITIES,
    AuditLimits,
    AuditReport,
    AuditRow,
    Finding,
    PairAudit,
    SceneAudit,
    ToleranceAudit,
)
from stereogenbench_data.audit.geometry.reprojection import TOLERANCES
from stereogenbench_data.audit.geometry.scene_audit import LONG_PAIR
from stereogenbench_data.audit.paper_numbers import AUDIT, AUDIT_TABLE, FRAMES_A_SCENE
from stereogenbench_data.schema.release import ADJACENT_PAIRS
from stereogenbench_data.schema.text import counted, markdown_text

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
    return (
        *_rig_rows(scenes, limits),
        *_depth_rows(scenes, limits),
        *_reprojection_rows(scenes, limits),
        *_alignment_rows(scenes, limits, untested),
        *_frame_rows(scenes, limits),
        *_picture_rows(scenes, limits),
        *_finding_rows(findings),
    )


def _rig_rows(scenes: Sequence[SceneAudit], limits: AuditLimits) -> Iterator[AuditRow]:
    rigs = [scene.rig for scene in scenes]
    recorded = sum(rig.intrinsics_recorded for rig in rigs)
    source = f"{recorded} numbers recorded in px" if recorded else "none recorded in px"
    yield AuditRow(
        "intrinsics",
        f"largest deviation of fx, fy, cx, cy from f / s W ({source})",
        f"{_number(_largest(rig.intrinsics_px for rig in rigs))} px",
        AUDIT["intrinsics"],
        f"{limits.intrinsics_px:g} px",
    )
    for name, mean, most, paper in (
        ("adjacent", "adjacent_mean_cm", "adjacent_max_cm", ""),
        ("all 15 pairs", "pairs_mean_cm", "pairs_max_cm", AUDIT["baseline"]),
    ):
        mean_cm = _mean(getattr(rig, mean) for rig in rigs)
        largest_cm = _largest(getattr(rig, most) for rig in rigs)
        yield AuditRow(
            "pose/baseline",
            f"pose-derived less recorded, {name}: mean / largest",
            f"{_number(mean_cm)} cm / {_number(largest_cm)} cm",
            paper,
            f"{limits.baseline_cm:g} cm",
        )
    turned_deg = _number(_largest(rig.rotation_deg for rig in rigs))
    turned_px = _number(_largest(rig.rotation_px for rig in rigs))
    lateral_px = _number(_largest(rig.lateral_px for rig in rigs))
    for check, quantity, ours in (
        ("rig rotation", "largest turn of a camera against camera 0, and what it moves",
         f"{turned_deg} deg / {turned_px} px"),
        ("lateral residual", "largest shift by cameras off the rig's line", f"{lateral_px} px"),
    ):  # fmt: skip
        yield AuditRow(check, quantity, ours, "", f"{limits.rectified_px:g} px")


def _depth_rows(scenes: Sequence[SceneAudit], limits: AuditLimits) -> Iterator[AuditRow]:
    cameras = [camera for scene in scenes for camera in scene.cameras]
    valid = _mean(camera.valid_depth for camera in cameras)
    least = _least(camera.least_valid_depth.value for camera in cameras)
    yield AuditRow(
        "depth validity",
        "mean valid-depth ratio over audited frames and cameras (least of a picture)",
        f"{_percent(valid)} ({_percent(least)})",
        AUDIT["valid_depth"],
        _percent(limits.valid_depth),
    )
    units = _distinct(camera.depth_unit_m for camera in cameras)
    steps = _distinct(camera.depth_step_units * camera.depth_unit_m for camera in cameras)
    yield AuditRow(
        "depth quantum",
        f"step of stored depth, estimated from the numbers (unit: {units})",
        steps,
        "0.1 m without a tag",
    )


def _reprojection_rows(scenes: Sequence[SceneAudit], limits: AuditLimits) -> Iterator[AuditRow]:
    primary = [scene.pairs[0] for scene in scenes]
    long = _named_pairs(scenes, [LONG_PAIR])
    long_name = f"{LONG_PAIR[0]}-{LONG_PAIR[1]}"
    both = [pair for scene in scenes for pair in scene.pairs if pair.tolerances]
    for name, pairs in (("both pairs", both), ("primary pair", primary), (long_name, long)):
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
    adjacent = _named_pairs(scenes, ADJACENT_PAIRS)
    for name, pairs in (("primary pair", primary), ("adjacent pairs", adjacent), (long_name, long)):
        agreement = _ratio(sum(p.agreeing for p in pairs), sum(p.unhidden for p in pairs))
        yield AuditRow(
            "agreement",
            f"{name}: pixels that nothing hides whose two depths agree (least of a scene)",
            f"{_percent(agreement)} ({_percent(_least(p.agreement for p in pairs))})",
            "",
            _percent(limits.agreement_long if pairs is long else limits.agreement),
        )


def _named_pairs(
    scenes: Sequence[SceneAudit], cameras: Sequence[tuple[int, int]]
) -> list[PairAudit]:
    return [pair for scene in scenes for pair in scene.pairs if (pair.left, pair.right) in cameras]


_SIZES: Final = (
    ("depth fit", "depth", "of one camera against the others: factor", ("scale",), "depth_scale"),
    ("depth fit", "depth", "of one camera: shift, px", ("shift_x", "shift_y"), "depth_shift_px"),
    ("depth fit", "depth", "share of the way to depth along the ray", ("ray",), "depth_ray"),
    ("depth fit", "depth", "focal length or all baselines between cameras: factor", ("focal",),
     "focal"),
    ("motion fit", "motion", "focal length or unit of depth from frame to frame: factor",
     ("scale", "focal", "focal_x", "focal_y"), "focal"),
    ("pictures fit", "pictures", "of one camera: shift, px", ("shift_x", "shift_y"),
     "picture_shift_px"),
    ("pictures fit", "pictures", "disparity of pictures against that of depth: factor",
     ("scale",), "picture_scale"),
)  # fmt: skip


def _alignment_rows(
    scenes: Sequence[SceneAudit], limits: AuditLimits, untested: Sequence[Finding]
) -> Iterator[AuditRow]:
    found = [scene.alignment for scene in scenes]
    pairs = [pair for each in found for pair in each.pairs]
    moved = [_ratio(each.moved_through, each.moved_smooth) for each in found]
    gains = [gain for each in found for _, _, gain in each.lags]

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
        _percent(_largest(pair.see_through for pair in pairs)), _percent(limits.see_through),
    )  # fmt: skip
    for check, kind, quantity, whats, name in _SIZES:
        sizes = [
            (abs(each.value), each.error) for of_scene in found for each in of_scene.estimates
            if each.check == kind and each.what in whats and abs(each.value) > CERTAIN * each.error
        ]  # fmt: skip
        size, error = max(sizes, default=(0.0, 0.0))
        ours = f"{size:.2g} ± {1.96 * error:.2g}" if sizes else "none"
        limit = f"{getattr(limits, name):g}"
        yield row(check, f"{quantity}, largest that is certain", ours, limit, whats)
    yield row(
        "motion", "the same share from one audited frame to the next, most",
        _percent(_largest(moved)), _percent(limits.moved_through),
    )  # fmt: skip
    yield row(
        "picture time", "gain of correlation by pictures of a frame beside, most",
        _number(_largest(gains)), f"{limits.picture_lag:g}",
    )  # fmt: skip
    yield row(
        "picture content", "correlation of two cameras' pictures, taken there by depth, least",
        _number(_least(pair.correlation for pair in pairs)),
        f"{limits.picture_fit:g} of a camera's best",
    )  # fmt: skip


def _frame_rows(scenes: Sequence[SceneAudit], limits: AuditLimits) -> Iterator[AuditRow]:
    expected = [int(limits.frames) or scene.frames for scene in scenes for _ in scene.cameras]
    for name, count_of in (
        ("RGB", attrgetter("rgb_frames")),
        ("depth", attrgetter("depth_frames")),
    ):
        found = [count_of(camera) for scene in scenes for camera in scene.cameras]
        counts = [count for count in found if count >= 0]
        missing = sum(max(0, most - max(0, got)) for most, got in zip(expected, found, strict=True))
        span = "-"
        if counts:
            low, high = min(counts), max(counts)
            span = f"{low}" if low == high else f"{low} to {high}"
        yield AuditRow(
            "frames",
            f"{name} frames in all (of a video), missing",
            f"{sum(counts):,} ({span}), {missing:,} missing",
            f"{FRAMES_A_SCENE} of a video, 0 missing",
            f"{limits.frames:g}" if limits.frames else "as poses",
        )


def _picture_rows(scenes: Sequence[SceneAudit], limits: AuditLimits) -> Iterator[AuditRow]:
    cameras = [camera for scene in scenes for camera in scene.cameras]
    for check, what, figure, limit in (
        ("too dark", "least 95th percentile of luma", "brightness", limits.brightness),
        ("flat", "least span of luma (5th to 95th percentile)", "contrast", limits.contrast),
        ("frozen", "least mean change of luma while the camera moves", "change", limits.change),
    ):
        value = _number(_least(getattr(camera, figure).value for camera in cameras))
        yield AuditRow("pictures", f"{check}: {what}", f"{value} of 255", "", f"{limit:g}")
    yield AuditRow(
        "pictures", "occluder: largest share of a picture hidden from its border",
        _percent(_largest(camera.occluder.value for camera in cameras)), "",
        _percent(limits.occluder),
    )  # fmt: skip


def _finding_rows(findings: Sequence[Finding]) -> Iterator[AuditRow]:
    checks = dict.fromkeys([*_CHECKS, *(finding.check for finding in findings)])
    counts = [
        f"{check} {count}"
        for check in checks
        if (count := len({each.scene for each in findings if each.check == check}))
    ]
    yield AuditRow("findings", "scenes with", ", ".join(counts) or "none", "none", "none")


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
        "| check | quantity | here | paper | limit |",
        "|---|---|---|---|---|",
        *(
            f"| {row.check} | {row.quantity} | {row.ours} | {row.paper or '-'} "
            f"| {row.limit or '-'} |"
            for row in report.rows
        ),
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


def _finite(values: Iterable[float]) -> list[float]:
    return [value for value in values if not math.isnan(value)]


def _largest(values: Iterable[float]) -> float:
    return max(_finite(values), default=math.nan)


def _least(values: Iterable[float]) -> float:
    return min(_finite(values), default=math.nan)


def _mean(values: Iterable[float]) -> float:
    finite = _finite(values)
    return float(np.mean(finite)) if finite else math.nan


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else math.nan


def _number(value: float) -> str:
    """Return three significant digits; a dash for nan."""
    return "-" if math.isnan(value) else f"{value:.3g}"


def _percent(value: float) -> str:
    return "-" if math.isnan(value) else f"{value * 100:.4g} %"


def _distinct(values: Iterable[float]) -> str:
    """Return lengths in m, each once; their range if they are many."""
    found = sorted({float(f"{value:.6g}") for value in _finite(values)})
    if not found:
        return "-"
    if len(found) > 4:
        return f"{found[0]:g} to {found[-1]:g} m"
    return ", ".join(f"{value:g}" for value in found) + " m"
