"""From a scene's figures to what is beyond the limits."""

import math
from collections.abc import Iterator

from stereogenbench_data.audit.audit_records import (
    At,
    AuditLimits,
    CameraAudit,
    Finding,
    SceneAudit,
)
from stereogenbench_data.audit.picture_check import ENOUGH_LEVELS
from stereogenbench_data.schema.release import ADJACENT_PAIRS, CAMERA_COUNT, depth_name, rgb_name


def findings_of(scene: SceneAudit, limits: AuditLimits) -> list[Finding]:
    """Return what is wrong with a scene, or beyond a limit; nothing is said twice."""
    found = [
        Finding(scene.key, name, "unreadable", _without_place(text, name))
        for name, text in scene.problems
    ]
    unreadable = {name for name, _ in scene.problems}
    found += _rig_findings(scene, limits)
    for number in range(CAMERA_COUNT):
        for name, of_camera in (
            (rgb_name(number), _rgb_findings),
            (depth_name(number), _depth_findings),
        ):
            if name not in unreadable:
                told = of_camera(scene, number, limits)
                found += [Finding(scene.key, name, check, text) for check, text in told]
    return found


def _without_place(text: str, name: str) -> str:
    """Return a message without the path of the file, which stands before it."""
    place, colon, rest = text.partition(f"{name}: ")
    return rest if colon and " " not in place else text


def _rig_findings(scene: SceneAudit, limits: AuditLimits) -> Iterator[Finding]:
    rig, (primary, *_) = scene.rig, scene.pairs
    for check, value, limit, unit, what in (
        ("intrinsics", rig.intrinsics_px, limits.intrinsics_px, "px",
         "recorded intrinsics deviate from focal length and sensor by"),
        ("pose/baseline", rig.pairs_max_cm, limits.baseline_cm, "cm",
         "pose-derived and recorded baselines differ by"),
        ("rig rotation", rig.rotation_px, limits.rectified_px, "px",
         f"cameras are turned against camera 0 by {rig.rotation_deg:.3g} deg, which is"),
        ("lateral residual", rig.lateral_px, limits.rectified_px, "px",
         "cameras stand off the rig's line, which is"),
        ("reprojection", primary.tolerances[-1].median_px, limits.reprojection_px, "px",
         f"median error of pair {primary.left}-{primary.right} is"),
    ):  # fmt: skip
        if value > limit:
            text = f"{what} {value:.3g} {unit} (limit {limit:g})"
            yield Finding(scene.key, "", check, text)
    for pair in scene.pairs:
        is_limited = pair is primary or (pair.left, pair.right) in ADJACENT_PAIRS
        if is_limited and pair.agreement < limits.agreement:
            text = (
                f"of the pixels of camera {pair.left} that nothing hides from camera "
                f"{pair.right}, the two depths agree at {pair.agreement:.1%} "
                f"(limit {limits.agreement:.0%})"
            )
            yield Finding(scene.key, "", "agreement", text)


def _expected_frames(scene: SceneAudit, limits: AuditLimits) -> int:
    return int(limits.frames) or scene.frames


def _rgb_findings(scene: SceneAudit, number: int, limits: AuditLimits) -> Iterator[tuple[str, str]]:
    camera = scene.cameras[number]
    expected = _expected_frames(scene, limits)
    if camera.rgb_frames != expected:
        yield "missing frames", f"has {camera.rgb_frames} frames of {expected}"
    if camera.brightness.value < limits.brightness:
        what = "95 % of the picture are darker than"
        yield "too dark", _told(camera.brightness, limits.brightness, what)
    elif camera.contrast.value < limits.contrast:
        what = "the picture's grey levels span"
        yield "flat", _told(camera.contrast, limits.contrast, what)
    if camera.change.value < limits.change and not camera.contrast.value < limits.contrast:
        yield (
            "frozen",
            f"from frame {camera.change.frame} to the next audited one the camera moves and the "
            f"picture changes by {camera.change.value:.2g} grey levels (limit {limits.change:g})",
        )
    if camera.twin >= 0 and not camera.contrast.value < limits.contrast:
        yield "copied view", f"shows the same pictures as {rgb_name(camera.twin)}, bit for bit"


def _depth_findings(
    scene: SceneAudit, number: int, limits: AuditLimits
) -> Iterator[tuple[str, str]]:
    camera = scene.cameras[number]
    expected = _expected_frames(scene, limits)
    if camera.depth_frames != expected:
        yield "missing frames", f"has {camera.depth_frames} frames of {expected}"
    yield from _payload_findings(camera, limits)
    if camera.still_depth >= 0:
        yield (
            "frozen",
            f"from frame {camera.still_depth} to the next audited one the camera moves and depth "
            f"stays the same",
        )
    if camera.occluder.value > limits.occluder:
        side = "everywhere" if camera.occluder_side == "all" else f"from the {camera.occluder_side}"
        yield (
            "occluder",
            f"in frame {camera.occluder.frame} something near hides {camera.occluder.value:.0%} of "
            f"the picture, {side} (limit {limits.occluder:.0%})",
        )


def _payload_findings(camera: CameraAudit, limits: AuditLimits) -> Iterator[tuple[str, str]]:
    least = camera.least_valid_depth
    if least.value < limits.valid_depth:
        yield (
            "invalid depth",
            f"frame {least.frame} has depth at {least.value:.1%} of its pixels "
            f"(limit {limits.valid_depth:.0%})",
        )
    elif camera.depth_levels < limits.depth_levels and not math.isnan(least.value):
        yield (
            "invalid depth",
            f"holds {camera.depth_levels} different depths (limit {limits.depth_levels:g})",
        )
    if camera.depth_step_units > limits.depth_step and camera.depth_levels >= ENOUGH_LEVELS:
        step_m = camera.depth_step_units * camera.depth_unit_m
        yield (
            "depth quantum",
            f"its numbers are {camera.depth_step_units:g} units apart, so that depth was rounded "
            f"to {step_m:g} m before it was stored (limit {limits.depth_step:g} units)",
        )


def _told(least: At, limit: float, what: str) -> str:
    return f"frame {least.frame}: {what} {least.value:.0f} of 255 (limit {limit:g})"


def broken_finding(key: str, text: str) -> Finding:
    """Return the finding that a scene which could not be indexed is.

    Args:
        key: The scene's key.
        text: What is wrong with it; the place that it may begin with, a scene's or a file's, is
            not said again.
    """
    before, found, rest = text.partition(key)
    if not found or " " in before:
        return Finding(key, "", "broken", text)
    place, _, rest = rest.partition(": ")
    return Finding(key, place.lstrip("/"), "broken", rest)
