"""What an audit checks: each figure, its limit, and which figures of a scene are beyond theirs."""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from operator import attrgetter
from statistics import median
from typing import Any, Final

from stereogenbench_data.audit.geometry.alignment import CERTAIN
from stereogenbench_data.audit.geometry.picture_check import ENOUGH_LEVELS
from stereogenbench_data.audit.geometry.records import (
    AuditLimits,
    CameraAudit,
    Estimate,
    Finding,
    SceneAudit,
)
from stereogenbench_data.audit.paper_numbers import AUDIT
from stereogenbench_data.schema.release import CAMERA_COUNT, depth_name, rgb_name

Figures = Iterable[tuple[str, float, str]]
"""(file or "", figure, where in it) of a scene; the figure is nan where it was not measured."""


@dataclass(frozen=True, slots=True)
class Check:
    """A figure with a limit.

    Attributes:
        name: The check's name.
        what: The figure, in words.
        limit: The limit's name in `AuditLimits`.
        of: Returns a scene's figures.
        worst: `max` where large figures are wrong, `min` where small ones are.
        unit: Such as "px"; "%" for a share.
        paper: The paper's figure.
    """

    name: str
    what: str
    limit: str
    of: Callable[[SceneAudit], Figures]
    worst: Callable[..., float] = max
    unit: str = "px"
    paper: str = ""

    def text(self, value: float) -> str:
        """Return a figure with its unit, a dash for nan."""
        if math.isnan(value):
            return "-"
        return f"{value * 100:.4g} %" if self.unit == "%" else f"{value:.3g} {self.unit}".rstrip()

    def findings(self, scene: SceneAudit, limits: AuditLimits) -> Iterator[Finding]:
        """Yield the figures of a scene that are beyond the limit."""
        limit = getattr(limits, self.limit)
        for member, value, where in self.of(scene):
            if value != limit and self.worst(value, limit) == value:
                place = f", {where}" if where else ""
                text = f"{self.what} is {self.text(value)}{place} (limit {self.text(limit)})"
                yield Finding(scene.key, member, self.name, text)


def _of_rig(name: str) -> Callable[[SceneAudit], Figures]:
    return lambda scene: [("", getattr(scene.rig, name), "")]


def _of_cameras(
    file: Callable[[int], str], figure: Callable[[CameraAudit], Any]
) -> Callable[[SceneAudit], Figures]:
    """Return a function to the figures of each camera: numbers, or `At` with their frames."""

    def of(scene: SceneAudit) -> Figures:
        for number, camera in enumerate(scene.cameras):
            value = figure(camera)
            if isinstance(value, float | int):
                yield file(number), value, ""
            else:
                yield file(number), value.value, f"frame {value.frame}"

    return of


def _see_through(scene: SceneAudit) -> Figures:
    pairs = [pair for pair in scene.alignment.pairs if not math.isnan(pair.see_through)]
    most = max((pair.see_through for pair in pairs), default=math.nan)
    among = [f"{each.left}-{each.right}" for each in pairs if each.see_through > most / 2]
    yield "", most, f"most in {', '.join(among)}"


def _moved_through(scene: SceneAudit) -> Figures:
    found = scene.alignment
    if found.moved_smooth >= _ENOUGH:
        yield "", found.moved_through / found.moved_smooth, ""


def _other_moment(scene: SceneAudit) -> Figures:
    for camera, lag, gained in scene.alignment.lags:
        beside = f"by those of the frame {'before' if lag < 0 else 'after'}"
        yield "" if camera < 0 else rgb_name(camera), gained, beside


def _other_content(scene: SceneAudit) -> Figures:
    seen = [pair for pair in scene.alignment.pairs if not math.isnan(pair.correlation)]
    for camera in range(CAMERA_COUNT):
        own = [pair.correlation for pair in seen if camera in (pair.left, pair.right)]
        others = [pair.correlation for pair in seen if camera not in (pair.left, pair.right)]
        if own and others:
            yield rgb_name(camera), median(others) - max(own), f"its best is {max(own):.2f}"


def _occluders(scene: SceneAudit) -> Figures:
    for number, camera in enumerate(scene.cameras):
        where = f"frame {camera.occluder.frame}, {camera.occluder_side or 'no'} border"
        yield depth_name(number), camera.occluder.value, where


_ENOUGH: Final = 1000
CHECKS: Final = (
    Check("intrinsics", "largest deviation of fx, fy, cx, cy from f / s W", "intrinsics_px",
          _of_rig("intrinsics_px"), paper=AUDIT["intrinsics"]),
    Check("pose/baseline", "pose-derived less recorded, adjacent cameras", "baseline_cm",
          _of_rig("adjacent_max_cm"), unit="cm"),
    Check("pose/baseline", "pose-derived less recorded, all 15 pairs", "baseline_cm",
          _of_rig("pairs_max_cm"), unit="cm", paper=AUDIT["baseline"]),
    Check("rig rotation", "what the turn of a camera against camera 0 moves", "rectified_px",
          _of_rig("rotation_px")),
    Check("lateral residual", "what a camera off the rig's line moves", "rectified_px",
          _of_rig("lateral_px")),
    Check("reprojection", "median error of the primary pair at the last tolerance",
          "reprojection_px", lambda scene: [("", scene.pairs[0].tolerances[-1].median_px, "")]),
    Check("depth consistency", "share of points on smooth surfaces that another camera sees "
          "through", "see_through", _see_through, unit="%"),
    Check("motion", "share of points on smooth surfaces that the next audited frame sees through",
          "moved_through", _moved_through, unit="%"),
    Check("picture time", "gain of correlation by pictures of a frame beside", "picture_lag",
          _other_moment, unit=""),
    Check("picture content", "correlation with other cameras' pictures, taken there by depth, "
          "below that of others", "picture_odd", _other_content, unit=""),
    Check("too dark", "95th percentile of luma, of 255", "brightness",
          _of_cameras(rgb_name, attrgetter("brightness")), min, unit=""),
    Check("flat", "span of luma (5th to 95th percentile), of 255", "contrast",
          _of_cameras(rgb_name, attrgetter("contrast")), min, unit=""),
    Check("frozen", "change of luma to the next audited frame while the camera moves", "change",
          _of_cameras(rgb_name, lambda camera: camera.change
                      if camera.contrast.value >= AuditLimits().contrast else math.nan),
          min, unit=""),
    Check("invalid depth", "share of pixels with depth", "valid_depth",
          _of_cameras(depth_name, attrgetter("least_valid_depth")), min, unit="%"),
    Check("invalid depth", "count of different depths", "depth_levels",
          _of_cameras(depth_name, lambda camera: camera.depth_levels
                      if camera.valid_depth > 0 else math.nan), min, unit=""),
    Check("depth quantum", "distance of stored numbers", "depth_step",
          _of_cameras(depth_name, lambda camera: camera.depth_step_units
                      if camera.depth_levels >= ENOUGH_LEVELS else math.nan), unit="units"),
    Check("occluder", "share of a picture that something near hides from its border", "occluder",
          _occluders, unit="%"),
)  # fmt: skip
"""The figures that have a limit, in the order of the table."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter that `alignment` estimates: in words, as a cause, and its limit's name."""

    what: str
    cause: str
    limit: str


_FITS: Final = "from frame to frame, depth and poses fit if"
PARAMETERS: Final = {
    ("depth", "scale"): Parameter(
        "depth of one camera against the others: a factor",
        "depth of {of} differs from that of the others by {share}", "depth_scale"),
    ("depth", "ray"): Parameter(
        "share of the way to depth along the ray",
        "depth of {of} is {part} of the way from the axis to along the ray", "depth_ray"),
    ("depth", "shift_x"): Parameter(
        "depth of one camera: a shift to the side, px",
        "depth of {of} is {pixels} to the right of where the others see it", "depth_shift_px"),
    ("depth", "shift_y"): Parameter(
        "depth of one camera: a shift up or down, px",
        "depth of {of} is {pixels} down of where the others see it", "depth_shift_px"),
    ("depth", "focal"): Parameter(
        "focal length or all baselines between cameras: a factor",
        "between cameras, depth fits if the focal length, or all baselines, are corrected {factor}",
        "focal"),
    ("motion", "scale"): Parameter(
        "unit of depth or of poses from frame to frame: a factor",
        f"{_FITS} the unit of depth or of poses is corrected {{factor}}", "focal"),
    ("motion", "focal"): Parameter(
        "focal length from frame to frame: a factor",
        f"{_FITS} the focal length is corrected {{factor}}", "focal"),
    ("motion", "focal_x"): Parameter(
        "sensor's width from frame to frame: a factor",
        f"{_FITS} the horizontal focal length (sensor width) is corrected {{factor}}", "focal"),
    ("motion", "focal_y"): Parameter(
        "sensor's height from frame to frame: a factor",
        f"{_FITS} the vertical focal length (sensor height) is corrected {{factor}}", "focal"),
}  # fmt: skip
"""By check and name of an `Estimate`, in the order of the table."""


def findings_of(scene: SceneAudit, limits: AuditLimits) -> list[Finding]:
    """Return the files of a scene that cannot be read, and its figures beyond a limit."""
    found = []
    for name, text in scene.problems:
        # The file's path stands in front of some messages.
        place, colon, rest = text.partition(f"{name}: ")
        text = rest if colon and " " not in place else text
        found.append(Finding(scene.key, name, "unreadable", text))
    beyond = [each for check in CHECKS for each in check.findings(scene, limits)]
    beyond += _file_findings(scene, limits)
    unreadable = {name for name, _ in scene.problems}
    found += [each for each in beyond if each.member not in unreadable]
    return found + list(_fit_findings(scene, limits, beyond={each.check for each in found}))


def _file_findings(scene: SceneAudit, limits: AuditLimits) -> Iterator[Finding]:
    """Yield what is wrong with single videos beside their figures."""
    expected = int(limits.frames) or scene.frames
    for number, camera in enumerate(scene.cameras):
        rgb, depth = rgb_name(number), depth_name(number)
        for name, frames in ((rgb, camera.rgb_frames), (depth, camera.depth_frames)):
            if frames != expected:
                text = f"has {frames} frames of {expected}"
                yield Finding(scene.key, name, "missing frames", text)
        if camera.twin >= 0 and camera.contrast.value >= limits.contrast:
            text = f"shows the same pictures as {rgb_name(camera.twin)}, bit for bit"
            yield Finding(scene.key, rgb, "copied view", text)
        if camera.still_depth >= 0:
            text = (
                f"from frame {camera.still_depth} to the next audited one the camera moves and "
                f"depth stays the same"
            )
            yield Finding(scene.key, depth, "frozen", text)


_LEAST_EXPLAINED: Final = 0.35
"""Least share of the squares that a cause must explain."""
_GROSS: Final = 0.2
"""A factor of a length and a share of the squares that moving things do not cause."""
_NEXT_BEST: Final = 0.85
"""A cause is named if no other one explains this share of what it explains."""
_MOST_FACTOR: Final = 0.5
"""Larger factors explain depth that has nothing to do with the poses or baselines."""
_OWN_MOTION_PX: Final = 0.03
_STILL_PX: Final = 1.0


def _fit_findings(scene: SceneAudit, limits: AuditLimits, *, beyond: set[str]) -> Iterator[Finding]:
    """Yield the misfits between cameras and between frames, ``beyond`` the checks that failed."""
    first = [each for each in scene.alignment.estimates if each.is_first]
    # Depth that contradicts itself or the poses cannot confirm a length.
    is_wrong = bool(beyond & {"depth consistency", "motion"}) or any(
        each.check == "depth" and each.what != "focal" for each in first
    )
    for each in first:
        limit = limit_of(scene, each.check, each.what, limits)
        if not (each.check == "motion" and is_wrong) and abs(each.value) > max(
            limit, CERTAIN * each.error
        ):
            yield from _estimate_finding(scene, each, limit)


def limit_of(scene: SceneAudit, check: str, what: str, limits: AuditLimits) -> float:
    """Return the size beyond which an estimate is a finding."""
    limit: float = getattr(limits, PARAMETERS[check, what].limit)
    if check == "motion":
        # The less the camera moves, the more do moving objects disturb the estimate.
        limit = max(limit, _OWN_MOTION_PX / max(scene.alignment.moved_px, 1e-6))
    return limit


def untested_of(scene: SceneAudit, limits: AuditLimits) -> list[Finding]:
    """Return the checks of `alignment` that the content of a scene does not allow."""
    found = scene.alignment
    untested: list[tuple[str, str]] = []
    for check, figure, why in (
        ("depth consistency", "see_through", "too few points of smooth surfaces"),
        ("picture content", "correlation", "no texture, or no depth"),
    ):
        known = {
            camera for pair in found.pairs for camera in (pair.left, pair.right)
            if not math.isnan(getattr(pair, figure))
        }  # fmt: skip
        untested.append((check, _of_cameras_but(known, why)))
    if found.moved_smooth < _ENOUGH:
        untested.append(("motion", "too few points of smooth surfaces, or one frame"))
    elif found.moved_px < _STILL_PX:
        why = f"points move by {found.moved_px:.2f} px from one audited frame to the next"
        untested.append(("motion", why))
    gains = {
        camera: [gain for of, _, gain in found.lags if of == camera]
        for camera in range(CAMERA_COUNT)
    }
    timed = {camera for camera, of in gains.items() if min(of, default=0.0) <= -limits.picture_lag}
    why = "pictures of the neighbouring frames fit as well, or there are none"
    untested.append(("picture time", _of_cameras_but(timed, why)))
    for check, what in PARAMETERS:
        limit = limit_of(scene, check, what, limits)
        sizes = [
            max(limit, math.inf if math.isnan(each.error) else CERTAIN * each.error)
            for each in found.estimates
            if (each.check, each.what) == (check, what)
        ]
        most = max(sizes, default=math.inf)
        if most > getattr(limits, PARAMETERS[check, what].limit):
            why = f"seen from {most:.2g} on" if math.isfinite(most) else "no estimate"
            untested.append((f"{check} fit", f"{PARAMETERS[check, what].what}: {why}"))
    return [Finding(scene.key, "", check, why) for check, why in untested if why]


def _of_cameras_but(known: set[int], why: str) -> str:
    """Return the reason for the other cameras, empty if there are none."""
    others = sorted(set(range(CAMERA_COUNT)) - known)
    if len(others) == CAMERA_COUNT:
        return f"all cameras: {why}"
    return f"camera {', '.join(map(str, others))}: {why}" if others else ""


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
    cause = PARAMETERS[each.check, each.what].cause.format(
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
