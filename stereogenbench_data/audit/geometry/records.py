"""What an audit measures, in types that JSON has, its limits, and which figures are beyond them."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from stereogenbench_data.audit.geometry.picture_limits import (
    BORDER_SHARE,
    DARK_MEAN,
    FLAT_SD,
    INVALID_SHARE,
)
from stereogenbench_data.audit.paper_numbers import AUDIT
from stereogenbench_data.media.decoder import MOST_EXTRA_FRAMES

QUANTILES: Final = tuple(step / 40 for step in range(41))
"""The quantiles of each scene's errors that are kept: 0, 2.5 %, 5 % ... 100 %."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured figure of a scene.

    Attributes:
        quantity: Its name in `CHECKS`.
        member: The file that it is about; empty for the whole scene.
        value: The figure, nan if the scene's content does not allow the check.
        where: Where in the file it was found; for nan, why it was not measured. A figure that is
            nan without a reason was not looked for.
    """

    quantity: str
    member: str = ""
    value: float = math.nan
    where: str = ""


@dataclass(frozen=True, slots=True)
class PairAudit:
    """Reprojection of one pair over the audited frames.

    Attributes:
        comparable: Pixels that land inside the right picture where depth was measured.
        kept: For each of `reprojection.TOLERANCES`, the pixels kept.
        errors_px: For each of them the `QUANTILES` of the errors; empty if no pixel was kept.
    """

    comparable: int
    kept: Sequence[int]
    errors_px: Sequence[Sequence[float]]

    def median_px(self, tolerance: int) -> float:
        """Return the median error at a tolerance, by its place; nan if no pixel was kept."""
        errors_px = self.errors_px[tolerance]
        return errors_px[QUANTILES.index(0.5)] if errors_px else math.nan


@dataclass(frozen=True, slots=True)
class SceneAudit:
    """The audit of one scene.

    Attributes:
        key: The scene's key.
        frames: Number of frames by the index.
        audited_frames: The frames that were decoded.
        figures: What was measured of its metadata, its files and how they fit together.
        pairs: Reprojection of the primary pair and of cameras 0 and 5.
        problems: Maps files that could not be read to the reason.
        contradiction: What metadata files state of the rig in two ways; "" for nothing.
    """

    key: str
    frames: int
    audited_frames: tuple[int, ...]
    figures: tuple[Figure, ...]
    pairs: tuple[PairAudit, ...]
    problems: Mapping[str, str]
    contradiction: str = ""

    @classmethod
    def revived(cls, record: Mapping[str, Any]) -> "SceneAudit":
        """Return the audit that `dataclasses.asdict` made a record of.

        Raises:
            TypeError: If a field is missing or unknown.
        """
        figures = tuple(Figure(**each) for each in record["figures"])
        pairs = tuple(PairAudit(**each) for each in record["pairs"])
        frames = tuple(record["audited_frames"])
        return cls(**{**record, "figures": figures, "pairs": pairs, "audited_frames": frames})


@dataclass(frozen=True, slots=True)
class Finding:
    """A figure beyond its limit, a file that cannot be read, or a check that was not testable.

    Attributes:
        scene: The scene's key.
        member: The file; empty for none.
        check: The check.
        found: What was found, or why the scene's content does not allow the check.
    """

    scene: str
    member: str
    check: str
    found: str

    def __str__(self) -> str:
        """Return it as one line."""
        where = "/".join(part for part in (self.scene, self.member) if part)
        found = " ".join(self.found.split())
        return f"{where}: {self.check}: {found}"


@dataclass(frozen=True, slots=True)
class AuditRow:
    """A row of the audit's table."""

    check: str
    quantity: str
    ours: str
    paper: str = ""
    limit: str = ""


@dataclass(frozen=True, slots=True)
class AuditReport:
    """The audit of a data set.

    Attributes:
        root: Where the data are.
        scenes_there: Number of scenes of the index.
        scenes_audited: How many of them were audited.
        frames: Number of frames audited of each scene; 0 for all.
        rows: The table.
        findings: The findings, in the order of scenes.
        untested: Checks that the content of a scene does not allow.
        notes: Remarks that are not findings.
        scenes: Each scene's figures.
    """

    root: str
    scenes_there: int
    scenes_audited: int
    frames: int
    rows: tuple[AuditRow, ...]
    findings: tuple[Finding, ...]
    untested: tuple[Finding, ...]
    notes: tuple[str, ...]
    scenes: tuple[SceneAudit, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the report as values for `json.dumps`, with None for nan."""
        document: dict[str, Any] = plain(asdict(self))
        return document


def plain(value: Any) -> Any:
    """Return a value as JSON has it, with None in place of every nan and infinity in it."""
    if isinstance(value, dict):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple | frozenset):
        return [plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


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
        causes: Every cause that would look so, where the figure does not show it.
    """

    name: str
    what: str
    limit: float
    worst: Callable[..., float] = max
    unit: str = ""
    paper: str = ""
    causes: str = ""

    def text(self, value: float) -> str:
        """Return a figure with its unit, a dash for nan."""
        return with_unit(value, self.unit)


def with_unit(value: float, unit: str = "") -> str:
    """Return a number with its unit, a share in per cent, a dash for nan."""
    if math.isnan(value):
        return "-"
    return f"{value * 100:.4g} %" if unit == "%" else f"{value:.3g} {unit}".rstrip()


_DOCTOR: Final = "`stereogenbench doctor` looks for the cause"
_UNFIT: Final = "depth, a camera's place, or the lens"
_RIG: Final = "the rig is not rectified, or the poses are wrong"
_FROZEN: Final = "frames are repeated, or the poses are those of another scene"

CHECKS: Final = {
    "intrinsics_px": Check(
        "intrinsics", "largest deviation of fx, fy, cx, cy from f / s W", 1e-3, unit="px",
        paper=AUDIT["intrinsics"]),
    "baseline_cm": Check(
        "pose/baseline", "pose-derived less recorded, all 15 pairs", 1e-3, unit="cm",
        paper=AUDIT["baseline"],
        causes="baseline.json or trajectory.json is wrong"),
    "rotation_px": Check(
        "rig rotation", "what the turn of a camera against camera 0 moves", 0.05, unit="px",
        causes=_RIG),
    "lateral_px": Check(
        "lateral residual", "what a camera off the rig's line moves", 0.05, unit="px",
        causes=_RIG),
    "reprojection_px": Check(
        "reprojection", "median error of the primary pair at the last tolerance", 0.5, unit="px",
        causes=f"{_DOCTOR}: {_UNFIT}"),
    "see_through": Check(
        "depth consistency",
        "share of points on smooth surfaces that another camera sees through", 0.02, unit="%",
        causes=f"{_DOCTOR}: {_UNFIT}"),
    "depth_residual": Check(
        "depth residual",
        "90th percentile of what inverse depth differs between cameras, beyond one step", 0.0005,
        unit="%",
        causes=f"{_DOCTOR}: {_UNFIT}"),
    "depth_agreement": Check(
        "depth agreement",
        "share of points whose depths in two cameras agree to 2 %, but not to 0.5 %", 0.2,
        unit="%",
        causes=f"noise, or wrong: {_UNFIT}"),
    "motion_residual": Check(
        "motion residual",
        "median of what inverse depth differs from frame to frame, beyond one step", 0.001,
        unit="%",
        causes=f"{_DOCTOR}: depth, the poses, or the lens"),
    "picture_lag": Check(
        "picture time", "gain of correlation by pictures of a frame beside", 0.02,
        causes=f"late or early, or wrong: the pictures, {_UNFIT}"),
    "picture_odd": Check(
        "picture content",
        "correlation with other cameras' pictures, taken there by depth, below that of others",
        0.15,
        causes=(
            "of another camera (`stereogenbench doctor` tests exchanges) or another moment, or "
            f"wrong: the pictures, {_UNFIT}")),
    "copied": Check(
        "copied view", "share of pictures that another camera shows bit for bit", 0.5, unit="%",
        causes="either may be the copy"),
    "brightness": Check("too dark", "mean luma, of 255", DARK_MEAN, min),
    "contrast": Check("flat", "standard deviation of luma, of 255", FLAT_SD, min),
    "change": Check(
        "frozen", "change of luma to the next audited frame while the camera moves", 0.25, min,
        causes=_FROZEN),
    "depth_change": Check(
        "frozen", "share of depth that changes to the next audited frame while the camera moves",
        1e-6, min, "%",
        causes=_FROZEN),
    "valid_depth": Check(
        "invalid depth", "share of pixels with depth", 1e-6, min, "%"),
    "mean_valid_depth": Check(
        "invalid depth", "mean share of pixels with depth", 1 - INVALID_SHARE, min, "%"),
    "depth_levels": Check("invalid depth", "count of different depths", 8, min),
    "depth_step": Check("depth quantum", "distance of stored numbers", 4, unit="units"),
    "occluder": Check(
        "occluder", "share of a picture's border that something near covers", BORDER_SHARE,
        unit="%"),
}  # fmt: skip
"""By quantity, in the order of the table."""


def findings_of(scene: SceneAudit) -> Iterator[Finding]:
    """Yield what cannot be read of a scene, what is stated twice, and figures beyond a limit."""
    for name, text in scene.problems.items():
        # The file's path stands in front of some messages.
        place, colon, rest = text.partition(f"{name}: ")
        yield Finding(scene.key, name, "unreadable", rest if colon and " " not in place else text)
    if scene.contradiction:
        yield Finding(scene.key, "", "contradiction", scene.contradiction)
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
    causes = f"; {check.causes}" if check.causes else ""
    value, limit = check.text(figure.value), check.text(check.limit)
    return check.name, f"{check.what} is {value}{place} (limit {limit}){causes}"


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
