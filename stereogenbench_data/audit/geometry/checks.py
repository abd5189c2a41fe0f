"""What an audit checks: each quantity, its limit, and which figures of a scene are beyond it."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

from stereogenbench_data.audit.geometry.picture_check import FLAT
from stereogenbench_data.audit.geometry.records import Figure, Finding, SceneAudit
from stereogenbench_data.audit.paper_numbers import AUDIT
from stereogenbench_data.media.clock import MOST_EXTRA_FRAMES


@dataclass(frozen=True, slots=True)
class Check:
    """A quantity with a limit.

    Attributes:
        name: The check's name.
        what: The quantity, in words.
        limit: A figure beyond it is a finding.
        worst: `max` where large figures are wrong, `min` where small ones are.
        unit: Such as "px"; "%" for a share.
        paper: The paper's figure.
    """

    name: str
    what: str
    limit: float
    worst: Callable[..., float] = max
    unit: str = ""
    paper: str = ""

    def text(self, value: float) -> str:
        """Return a figure with its unit, a dash for nan."""
        if math.isnan(value):
            return "-"
        return f"{value * 100:.4g} %" if self.unit == "%" else f"{value:.3g} {self.unit}".rstrip()


_DOCTOR: Final = "; `stereogenbench doctor` looks for the cause"
CHECKS: Final = {
    "intrinsics_px": Check(
        "intrinsics", "largest deviation of fx, fy, cx, cy from f / s W", 1e-3, unit="px",
        paper=AUDIT["intrinsics"]),
    "adjacent_cm": Check(
        "pose/baseline", "pose-derived less recorded, adjacent cameras", 1e-3, unit="cm"),
    "baseline_cm": Check(
        "pose/baseline", "pose-derived less recorded, all 15 pairs", 1e-3, unit="cm",
        paper=AUDIT["baseline"]),
    "rotation_px": Check(
        "rig rotation", "what the turn of a camera against camera 0 moves", 0.05, unit="px"),
    "lateral_px": Check(
        "lateral residual", "what a camera off the rig's line moves", 0.05, unit="px"),
    "reprojection_px": Check(
        "reprojection", "median error of the primary pair at the last tolerance", 0.5, unit="px"),
    "see_through": Check(
        "depth consistency",
        "share of points on smooth surfaces that another camera sees through", 0.02, unit="%"),
    "depth_residual": Check(
        "depth residual",
        "90th percentile of what inverse depth differs between cameras, beyond one step", 0.0005,
        unit="%"),
    "motion_residual": Check(
        "motion residual",
        "median of what inverse depth differs from frame to frame, beyond one step", 0.001,
        unit="%"),
    "picture_lag": Check(
        "picture time", "gain of correlation by pictures of a frame beside", 0.02),
    "picture_odd": Check(
        "picture content",
        "correlation with other cameras' pictures, taken there by depth, below that of others",
        0.15),
    "copied": Check(
        "copied view", "share of pictures that another camera shows bit for bit", 0.5, unit="%"),
    "brightness": Check("too dark", "95th percentile of luma, of 255", 25, min),
    "contrast": Check("flat", "span of luma (5th to 95th percentile), of 255", FLAT, min),
    "change": Check(
        "frozen", "change of luma to the next audited frame while the camera moves", 0.25, min),
    "depth_change": Check(
        "frozen", "share of depth that changes to the next audited frame while the camera moves",
        1e-6, min, "%"),
    "valid_depth": Check("invalid depth", "share of pixels with depth", 0.1, min, "%"),
    "depth_levels": Check("invalid depth", "count of different depths", 8, min),
    "depth_step": Check("depth quantum", "distance of stored numbers", 4, unit="units"),
    "occluder": Check(
        "occluder", "share of a picture that something near hides from its border", 0.1,
        unit="%"),
}  # fmt: skip
"""By quantity, in the order of the table."""


def findings_of(scene: SceneAudit) -> Iterator[Finding]:
    """Yield the files of a scene that cannot be read, and its figures beyond a limit."""
    for name, text in scene.problems.items():
        # The file's path stands in front of some messages.
        place, colon, rest = text.partition(f"{name}: ")
        yield Finding(scene.key, name, "unreadable", rest if colon and " " not in place else text)
    for figure in scene.figures:
        found = None if figure.member in scene.problems else _beyond(scene, figure)
        if found is not None:
            yield Finding(scene.key, figure.member, *found)


def _beyond(scene: SceneAudit, figure: Figure) -> tuple[str, str] | None:
    """Return the check and what a figure beyond its limit says, None for any other."""
    if figure.quantity == "frames":
        more = figure.value - scene.frames
        # Opening tells of a few more than the scene uses.
        kind = "missing frames" if more < 0 else "more frames"
        found = f"has {figure.value} frames of {scene.frames}"
        return None if 0 <= more <= MOST_EXTRA_FRAMES else (kind, found)
    check = CHECKS.get(figure.quantity)
    if check is None or figure.value == check.limit:
        return None
    if check.worst(figure.value, check.limit) != figure.value:  # nan is not beyond it either
        return None
    place = f", {figure.where}" if figure.where else ""
    cause = _DOCTOR if figure.quantity in ("depth_residual", "motion_residual") else ""
    value, limit = check.text(figure.value), check.text(check.limit)
    return check.name, f"{check.what} is {value}{place} (limit {limit}){cause}"


def untested_of(scene: SceneAudit) -> Iterator[Finding]:
    """Yield the checks that the content of a scene does not allow."""
    for figure in scene.figures:
        if math.isnan(figure.value) and figure.where:
            name = CHECKS[figure.quantity].name
            yield Finding(scene.key, figure.member, name, figure.where)


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
