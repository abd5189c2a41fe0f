"""A scene's findings: which of its figures are beyond the limits."""

import math
from collections.abc import Iterator
from statistics import median
from typing import Final

from stereogenbench_data.audit.geometry.alignment import CERTAIN
from stereogenbench_data.audit.geometry.picture_check import ENOUGH_LEVELS
from stereogenbench_data.audit.geometry.records import (
    QUANTITIES,
    AuditLimits,
    CameraAudit,
    Estimate,
    Finding,
    PairFit,
    SceneAudit,
)
from stereogenbench_data.schema.release import CAMERA_COUNT, depth_name, rgb_name


def findings_of(scene: SceneAudit, limits: AuditLimits) -> list[Finding]:
    """Return the files of a scene that cannot be read, and its figures beyond a limit."""
    found = []
    for name, text in scene.problems:
        # The file's path stands in front of some messages.
        place, colon, rest = text.partition(f"{name}: ")
        text = rest if colon and " " not in place else text
        found.append(Finding(scene.key, name, "unreadable", text))
    unreadable = {name for name, _ in scene.problems}
    found += _rig_findings(scene, limits)
    found += _alignment_findings(scene, limits)
    for number, camera in enumerate(scene.cameras):
        frames = int(limits.frames) or scene.frames
        for name, of_file in (
            (rgb_name(number), _rgb_findings(camera, frames, limits)),
            (depth_name(number), _depth_findings(camera, frames, limits)),
        ):
            if name not in unreadable:
                found += [Finding(scene.key, name, check, text) for check, text in of_file]
    return found


def _rig_findings(scene: SceneAudit, limits: AuditLimits) -> Iterator[Finding]:
    rig, (primary, *_) = scene.rig, scene.pairs
    for check, value, limit, unit, what in (
        ("intrinsics", rig.intrinsics_px, limits.intrinsics_px, "px",
         "recorded intrinsics deviate from focal length and sensor by"),
        ("pose/baseline", rig.pairs_max_cm, limits.baseline_cm, "cm",
         "pose-derived and recorded baselines differ by"),
        ("rig rotation", rig.rotation_px, limits.rectified_px, "px",
         f"cameras are turned against camera 0 by {rig.rotation_deg:.3g} deg: points move by"),
        ("lateral residual", rig.lateral_px, limits.rectified_px, "px",
         "cameras stand off the rig's line: points move by"),
        ("reprojection", primary.tolerances[-1].median_px, limits.reprojection_px, "px",
         f"median error of pair {primary.left}-{primary.right} is"),
    ):  # fmt: skip
        if value > limit:
            text = f"{what} {value:.3g} {unit} (limit {limit:g})"
            yield Finding(scene.key, "", check, text)


_LEAST_EXPLAINED: Final = 0.35
"""Least share of the squares that a cause must explain."""
_GROSS: Final = 0.2
"""A factor of a length and a share of the squares that moving things do not cause."""
_NEXT_BEST: Final = 0.85
"""A cause is named if no other one explains this share of what it explains."""
_MOST_FACTOR: Final = 0.5
"""Larger factors explain depth that has nothing to do with the poses or baselines."""
_FITS: Final = "from frame to frame, depth and poses fit if"
_OWN_MOTION_PX: Final = 0.03
_CAUSES: Final = {
    ("depth", "scale"): "depth of {of} differs from that of the others by {share}",
    ("depth", "ray"): "depth of {of} is {part} of the way from the axis to along the ray",
    ("depth", "shift_x"): "depth of {of} is {pixels} to the right of where the others see it",
    ("depth", "shift_y"): "depth of {of} is {pixels} down of where the others see it",
    ("depth", "focal"): "between cameras, depth fits if the focal length, or all baselines, are "
    "corrected {factor}",
    ("motion", "scale"): f"{_FITS} the unit of depth or of poses is corrected {{factor}}",
    ("motion", "focal"): f"{_FITS} the focal length is corrected {{factor}}",
    ("motion", "focal_x"): f"{_FITS} the horizontal focal length (sensor width) is corrected "
    "{factor}",
    ("motion", "focal_y"): f"{_FITS} the vertical focal length (sensor height) is corrected "
    "{factor}",
}  # fmt: skip
"""What an estimate says, by its check and parameter."""


def _alignment_findings(scene: SceneAudit, limits: AuditLimits) -> Iterator[Finding]:
    """Yield the misfits between cameras, frames and pictures."""
    found = scene.alignment
    through = [pair for pair in found.pairs if pair.see_through > limits.see_through]
    if through:
        worst = max(through, key=lambda pair: pair.see_through)
        pairs = ", ".join(f"{pair.left}-{pair.right}" for pair in through)
        text = (
            f"the depths of cameras {pairs} contradict each other: in pair "
            f"{worst.left}-{worst.right}, {worst.see_through:.1%} of the points on smooth surfaces "
            f"lie in front of what the other camera sees there (limit {limits.see_through:.0%})"
        )
        yield Finding(scene.key, "", "depth consistency", text)
    moved = found.moved_through / found.moved_smooth if found.moved_smooth >= 1000 else 0.0
    if moved > limits.moved_through:
        text = (
            f"by the recorded poses, depth of one frame contradicts that of the next audited one "
            f"at {moved:.0%} of its points (limit {limits.moved_through:.0%})"
        )
        yield Finding(scene.key, "", "motion", text)
    first = [each for each in found.estimates if each.is_first]
    has_wrong_depth = bool(through) or any(
        each.check == "depth" and each.what != "focal" for each in first
    )
    for each in first:
        # Depth that contradicts itself or the poses cannot confirm a length.
        is_explained = each.check == "motion" and (has_wrong_depth or moved > limits.moved_through)
        limit = limit_of(scene, each, limits)
        if not is_explained and abs(each.value) > max(limit, CERTAIN * each.error):
            yield from _estimate_finding(scene, each, limit)
    for camera, lag, gained in found.lags:
        if gained > limits.picture_lag:
            of = "all cameras" if camera < 0 else f"camera {camera}"
            text = (
                f"pictures of {of} fit better if those of the frame "
                f"{'before' if lag < 0 else 'after'} are taken: correlation grows by {gained:.3f} "
                f"(limit {limits.picture_lag:g})"
            )
            name = "" if camera < 0 else rgb_name(camera)
            yield Finding(scene.key, name, "picture time", text)
    seen = [pair for pair in found.pairs if not math.isnan(pair.correlation)]
    for camera in range(CAMERA_COUNT):
        own = [pair.correlation for pair in seen if camera in (pair.left, pair.right)]
        others = [pair.correlation for pair in seen if camera not in (pair.left, pair.right)]
        if own and others and median(others) - max(own) > limits.picture_odd:
            text = (
                f"pictures of camera {camera}, warped by depth to the others, have a correlation "
                f"with theirs of {max(own):.2f} or less, and the others {median(others):.2f} with "
                f"each other (limit {limits.picture_odd:g} less)"
            )
            yield Finding(scene.key, rgb_name(camera), "picture content", text)


def limit_of(scene: SceneAudit, each: Estimate, limits: AuditLimits) -> float:
    """Return the size beyond which an estimate is a finding."""
    if each.check == "motion":
        # The less the camera moves, the more do moving objects disturb the estimate.
        return max(limits.focal, _OWN_MOTION_PX / max(scene.alignment.moved_px, 1e-6))
    by_name = {"scale": limits.depth_scale, "ray": limits.depth_ray, "focal": limits.focal}
    return by_name.get(each.what, limits.depth_shift_px)


_STILL_PX: Final = 1.0
_ENOUGH: Final = 1000


def untested_of(scene: SceneAudit, limits: AuditLimits) -> list[Finding]:
    """Return the checks of `alignment` that the content of a scene does not allow."""
    found = scene.alignment
    untested: list[tuple[str, str]] = []
    blind = _cameras_without(found.pairs, "see_through")
    if blind:
        why = f"{_cameras(blind)}: too few points of smooth surfaces"
        untested.append(("depth consistency", why))
    if found.moved_smooth < _ENOUGH:
        untested.append(("motion", "too few points of smooth surfaces, or one frame"))
    elif found.moved_px < _STILL_PX:
        why = f"points move by {found.moved_px:.2f} px from one audited frame to the next"
        untested.append(("motion", why))
    blind = _cameras_without(found.pairs, "correlation")
    if blind:
        untested.append(("picture content", f"{_cameras(blind)}: no texture, or no depth"))
    late = [
        camera for camera in range(CAMERA_COUNT)
        if min((gain for of, _, gain in found.lags if of == camera), default=0.0)
        > -limits.picture_lag
    ]  # fmt: skip
    if late:
        why = "pictures of the neighbouring frames fit as well, or there are none"
        untested.append(("picture time", f"{_cameras(late)}: {why}"))
    untested += _untested_fits(scene, limits)
    return [Finding(scene.key, "", *each) for each in untested]


def _untested_fits(scene: SceneAudit, limits: AuditLimits) -> Iterator[tuple[str, str]]:
    """Yield the quantities of which an error as large as the limit would not be certain."""
    for check, what in _CAUSES:
        if (check, what) == ("depth", "focal"):
            continue
        least = limit_of(scene, Estimate(check, what, -1), limits)
        limit = limits.focal if check == "motion" else least
        seen = {
            each.camera: max(least, math.inf if math.isnan(each.error) else CERTAIN * each.error)
            for each in scene.alignment.estimates
            if (each.check, each.what) == (check, what)
        }
        blind = [camera for camera, size in seen.items() if size > limit]
        if blind or not seen:
            from_on = max((seen[camera] for camera in blind), default=math.inf)
            why = f"seen from {from_on:.2g} on" if math.isfinite(from_on) else "no estimate"
            of = _cameras([camera for camera in blind if camera >= 0])
            subject = f"{QUANTITIES[what]}{f' of {of}' if of else ''}"
            yield f"{check} fit", f"{subject}: {why} (limit {limit:.2g})"


def _cameras_without(pairs: tuple[PairFit, ...], figure: str) -> list[int]:
    known = {
        camera for pair in pairs for camera in (pair.left, pair.right)
        if not math.isnan(getattr(pair, figure))
    }  # fmt: skip
    return [camera for camera in range(CAMERA_COUNT) if camera not in known]


def _cameras(numbers: list[int]) -> str:
    if len(numbers) == CAMERA_COUNT:
        return "all cameras"
    return f"camera {', '.join(map(str, sorted(numbers)))}" if numbers else ""


def _estimate_finding(scene: SceneAudit, each: Estimate, limit: float) -> Iterator[Finding]:
    """Yield the finding of an estimate that explains what it is blamed for, with its interval."""
    is_gross = each.check == "motion" and min(abs(each.value), each.share) > _GROSS
    is_explained = each.share >= _LEAST_EXPLAINED
    if not (is_explained or is_gross):
        return
    half = 1.96 * each.error
    excess = abs(each.value - 1) if each.what == "ray" else abs(each.value)
    if each.what.startswith("shift") or (each.check == "depth" and each.what == "scale"):
        excess = 0.0
    cause = _CAUSES[each.check, each.what].format(
        of="all cameras" if each.camera < 0 else f"camera {each.camera}",
        share=f"{each.value:+.2%} ± {half:.2%}",
        factor=f"{-each.value:+.2%} ± {half:.2%}",
        part=f"{each.value:.0%} ± {half:.0%}",
        pixels=f"{each.value:+.2f} ± {half:.2f} px",
    )
    if not is_explained or each.next_best > _NEXT_BEST or excess > _MOST_FACTOR:
        where = "audited frames" if each.check == "motion" else "cameras"
        cause = f"{each.check} does not fit between {where}, and no single cause explains it"
    name = "" if each.camera < 0 else depth_name(each.camera)
    yield Finding(scene.key, name, f"{each.check} fit", f"{cause} (limit {limit:.3g})")


def _rgb_findings(
    camera: CameraAudit, expected: int, limits: AuditLimits
) -> Iterator[tuple[str, str]]:
    is_flat = camera.contrast.value < limits.contrast
    if camera.rgb_frames != expected:
        yield "missing frames", f"has {camera.rgb_frames} frames of {expected}"
    if camera.brightness.value < limits.brightness:
        yield (
            "too dark",
            f"frame {camera.brightness.frame}: 95 % of the picture are darker than "
            f"{camera.brightness.value:.0f} of 255 (limit {limits.brightness:g})",
        )
    elif is_flat:
        yield (
            "flat",
            f"frame {camera.contrast.frame}: the picture's grey levels span "
            f"{camera.contrast.value:.0f} of 255 (limit {limits.contrast:g})",
        )
    if camera.change.value < limits.change and not is_flat:
        yield (
            "frozen",
            f"from frame {camera.change.frame} to the next audited one the camera moves and the "
            f"picture changes by {camera.change.value:.2g} grey levels (limit {limits.change:g})",
        )
    if camera.twin >= 0 and not is_flat:
        yield "copied view", f"shows the same pictures as {rgb_name(camera.twin)}, bit for bit"


def _depth_findings(
    camera: CameraAudit, expected: int, limits: AuditLimits
) -> Iterator[tuple[str, str]]:
    if camera.depth_frames != expected:
        yield "missing frames", f"has {camera.depth_frames} frames of {expected}"
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


def broken_finding(key: str, text: str) -> Finding:
    """Return the finding for a scene that could not be indexed.

    Args:
        key: The scene's key.
        text: What is wrong with it; a path at its beginning becomes the finding's place.
    """
    before, found, rest = text.partition(key)
    if not found or " " in before:
        return Finding(key, "", "broken", text)
    place, _, rest = rest.partition(": ")
    return Finding(key, place.lstrip("/"), "broken", rest)
