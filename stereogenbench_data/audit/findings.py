"""A scene's findings: which of its figures are beyond the limits."""

import math
from collections.abc import Iterator
from statistics import median
from typing import Final

from stereogenbench_data.audit.alignment import CERTAIN
from stereogenbench_data.audit.audit_records import (
    QUANTITIES,
    AuditLimits,
    CameraAudit,
    Estimate,
    Finding,
    PairFit,
    SceneAudit,
    Untested,
)
from stereogenbench_data.audit.picture_check import ENOUGH_LEVELS
from stereogenbench_data.schema.release import ADJACENT_PAIRS, CAMERA_COUNT, depth_name, rgb_name


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
    for pair in scene.pairs:
        limit = limits.agreement
        if pair is not primary and (pair.left, pair.right) not in ADJACENT_PAIRS:
            narrow = max(1.0, _NARROW_PX / scene.alignment.width_px)
            limit = 1 - (1 - limits.agreement_long) * narrow
        if pair.agreement < limit:
            text = (
                f"the two depths agree at {pair.agreement:.1%} of the pixels of camera {pair.left} "
                f"that nothing hides from camera {pair.right} (limit {limit:.0%})"
            )
            yield Finding(scene.key, "", "agreement", text)


_NARROW_PX: Final = 128
"""In narrower pictures a larger share of the pixels lies at edges."""
_SHARP_PX: Final = 256
"""In narrower pictures, sampling between pixels is less accurate."""
_OWN_MOTION_PX: Final = 0.03
_SHIFTS: Final = {"shift_x": "to the right", "shift_y": "down"}


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
    has_wrong_depth = bool(through) or any(
        each.is_first and each.check == "depth" and each.what != "focal" for each in found.estimates
    )
    for each in found.estimates:
        # Depth that contradicts itself cannot confirm a focal length.
        if each.is_first and not (has_wrong_depth and each.check == "motion"):
            yield from _estimate_findings(scene, each, limits)
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
    yield from _content_findings(scene, limits)


def _content_findings(scene: SceneAudit, limits: AuditLimits) -> Iterator[Finding]:
    """Yield the cameras whose pictures show something else than the others do."""
    found = scene.alignment
    for camera in range(CAMERA_COUNT):
        fits = [pair.correlation for pair in found.pairs if camera in (pair.left, pair.right)
                and not math.isnan(pair.correlation)]  # fmt: skip
        if fits and max(fits) < limits.picture_fit:
            text = (
                f"pictures of camera {camera}, warped by depth to any other camera, have a "
                f"correlation of {max(fits):.2f} or less with its pictures "
                f"(limit {limits.picture_fit:g})"
            )
            yield Finding(scene.key, rgb_name(camera), "picture content", text)
        elif (less := _correlated_less(scene, camera)) > limits.picture_odd:
            text = (
                f"pictures of camera {camera}, warped by depth to the others, have a correlation "
                f"with theirs that is at least {less:.2f} less than that of the others with each "
                f"other (limit {limits.picture_odd:g})"
            )
            yield Finding(scene.key, rgb_name(camera), "picture content", text)


def _correlated_less(scene: SceneAudit, camera: int) -> float:
    """Return the least by which a camera's pairs correlate less than other pairs.

    Each is compared with pairs of at least its disparity, because wider pairs differ more. 0 if
    fewer than two of the camera's pairs can be compared.
    """
    pairs = [pair for pair in scene.alignment.pairs if not math.isnan(pair.correlation)]
    less = []
    for pair in pairs:
        others = [
            each.correlation for each in pairs
            if camera not in (each.left, each.right) and each.disparity_px >= pair.disparity_px
        ]  # fmt: skip
        if camera in (pair.left, pair.right) and others:
            less.append(median(others) - pair.correlation)
    return min(less) if len(less) > 1 else 0.0


def limit_of(scene: SceneAudit, each: Estimate, limits: AuditLimits) -> float:
    """Return the size beyond which an estimate is a finding."""
    if each.check == "depth":
        by_name = {
            "scale": limits.depth_scale, "ray": limits.depth_ray, "focal": limits.focal,
        }  # fmt: skip
        return by_name.get(each.what, limits.depth_shift_px)
    if each.check == "motion":
        if each.what == "ray":
            return limits.depth_ray
        # The less the camera moves, the more do moving objects disturb the estimate.
        return max(limits.focal, _OWN_MOTION_PX / max(scene.alignment.moved_px, 1e-6))
    if each.what == "shift_y":
        return limits.picture_shift_px
    shift_px = limits.picture_shift_px * max(1.0, _SHARP_PX / scene.alignment.width_px)
    # A factor cannot be known better than the shift that it causes.
    least = shift_px / max(scene.alignment.disparity_px, 1e-6)
    return shift_px if each.what == "shift_x" else max(limits.picture_scale, least)


_STILL_PX: Final = 1.0
_ENOUGH: Final = 1000


def untested_of(scene: SceneAudit, limits: AuditLimits) -> list[Untested]:
    """Return the checks of `alignment` that the content of a scene does not allow."""
    found = scene.alignment
    untested: list[tuple[str, str, str, str]] = []
    blind = _cameras_without(found.pairs, "see_through")
    if blind:
        untested.append(
            ("depth consistency", "", _cameras(blind), "too few points of smooth surfaces")
        )
    if found.moved_smooth < _ENOUGH:
        untested.append(("motion", "", "", "too few points of smooth surfaces, or one frame"))
    elif found.moved_px < _STILL_PX:
        why = f"points move by {found.moved_px:.2f} px from one audited frame to the next"
        untested.append(("motion", "", "", why))
    blind = _cameras_without(found.pairs, "correlation")
    if blind:
        untested.append(("picture content", "", _cameras(blind), "no texture, or no depth"))
    late = [
        camera for camera in range(CAMERA_COUNT)
        if min((gain for of, _, gain in found.lags if of == camera), default=0.0)
        > -limits.picture_lag
    ]  # fmt: skip
    if late:
        why = "pictures of the neighbouring frames fit as well, or there are none"
        untested.append(("picture time", "", _cameras(late), why))
    untested += _untested_fits(scene, limits)
    return [Untested(scene.key, *each) for each in untested]


def _untested_fits(scene: SceneAudit, limits: AuditLimits) -> Iterator[tuple[str, str, str, str]]:
    """Yield the quantities whose limit is below what can be seen in this scene."""
    for check, whats in (
        ("depth", ("scale", "ray", "shift_x", "shift_y")),
        ("motion", ("scale", "focal", "focal_x", "focal_y")),
        ("pictures", ("scale", "shift_x", "shift_y")),
    ):
        of_check = [each for each in scene.alignment.estimates if each.check == check]
        for what in whats:
            limit = least = limit_of(scene, Estimate(check, what, -1), limits)
            if (check, what) == ("pictures", "scale"):
                limit = limits.picture_scale
            if check == "motion":
                limit = limits.focal
            seen = {
                each.camera: max(least, CERTAIN * each.error)
                for each in of_check if each.what == what and not math.isnan(each.error)
            }  # fmt: skip
            wanted = {each.camera for each in of_check if each.what == what} or {-1}
            blind = sorted(camera for camera in wanted if not seen.get(camera, math.inf) <= limit)
            if blind:
                from_on = max(seen.get(camera, math.inf) for camera in blind)
                why = "no estimate" if math.isinf(from_on) else f"seen from {from_on:.2g} on"
                of = _cameras([camera for camera in blind if camera >= 0])
                yield f"{check} fit", QUANTITIES[what], of, f"{why} (limit {limit:.2g})"


def _cameras_without(pairs: tuple[PairFit, ...], figure: str) -> list[int]:
    known = {
        camera for pair in pairs for camera in (pair.left, pair.right)
        if not math.isnan(getattr(pair, figure))
    }  # fmt: skip
    return [camera for camera in range(CAMERA_COUNT) if camera not in known]


def _cameras(numbers: list[int]) -> str:
    some = 0 < len(numbers) < CAMERA_COUNT
    return f"camera {', '.join(map(str, numbers))}" if some else ""


def _estimate_findings(scene: SceneAudit, each: Estimate, limits: AuditLimits) -> Iterator[Finding]:
    of, name = "all cameras", ""
    if each.camera >= 0:
        of = f"camera {each.camera}"
        name = depth_name(each.camera) if each.check == "depth" else rgb_name(each.camera)
    if each.check == "depth":
        what = {
            "scale": f"differs from that of the others by {each.value:+.2%}",
            "ray": f"is {each.value:.0%} of the way from the axis to along the ray",
        }.get(
            each.what,
            f"is {each.value:+.2f} px {_SHIFTS.get(each.what, '')} of where the others see it",
        )
        text = f"depth of {of} {what}"
        if each.what == "focal":
            text = (
                f"between cameras, depth fits if the focal length, or all baselines, are corrected "
                f"{-each.value:+.2%}"
            )
    elif each.check == "motion":
        what = {
            "scale": "the unit of depth or of poses",
            "ray": "depth along the ray, by",
            "focal": "the focal length",
            "focal_x": "the horizontal focal length (sensor width)",
            "focal_y": "the vertical focal length (sensor height)",
        }[each.what]
        text = f"from frame to frame, depth and poses fit if {what} is corrected {-each.value:+.2%}"
    else:
        text = (
            f"pictures of {of} are {each.value * scene.alignment.picture_px:+.2f} px "
            f"{_SHIFTS[each.what]} of where depth and the others put them"
            if each.what in _SHIFTS
            else f"disparity of the pictures differs from that of depth by {each.value:+.2%}"
        )
    limit = limit_of(scene, each, limits)
    if abs(each.value) > limit and abs(each.value) > CERTAIN * each.error:
        yield Finding(scene.key, name, f"{each.check} fit", f"{text} (limit {limit:.3g})")


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
