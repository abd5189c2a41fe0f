"""What an audit finds out: plain numbers for each scene and camera, made of JSON's own types.

Numbers are nan where they could not be measured; `plain` turns them into JSON's null.
"""

import math
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Final

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.schema.release import CAMERA_COUNT

QUANTILES: Final = tuple(step / 40 for step in range(41))
"""Where each scene's errors are kept, from the least to the largest: 0, 2.5 %, 5 % ... 100 %."""
MEDIAN, P95 = QUANTILES.index(0.5), QUANTILES.index(0.95)


@dataclass(frozen=True, slots=True)
class AuditLimits:
    """Beyond which figures a scene is listed as a finding.

    Attributes:
        intrinsics_px: Largest deviation of recorded intrinsics.
        baseline_cm: Largest difference between recorded and pose-derived baselines.
        rectified_px: Largest displacement by unequal rotations, or by cameras off the line.
        reprojection_px: Largest median error of the primary pair, at the widest tolerance.
        agreement: Least share of unhidden pixels whose depths agree, of the primary pair and of
            any adjacent one.
        agreement_long: The same of cameras 0 and 5; in pictures narrower than 128 px the share
            that may disagree grows as they shrink, as more pixels lie at edges.
        frames: Frames that every video must have; 0 for as many as the scene has poses.
        valid_depth: Least share of measured pixels in any depth picture.
        depth_levels: Least number of different depths in a camera's pictures.
        depth_step: Largest step of stored numbers, in units: more says that depth was rounded
            or stretched before it was stored.
        brightness: Least 95th percentile of luma (0 to 255) in any picture.
        contrast: Least distance between the 5th and 95th percentile of luma.
        change: Least mean change of luma from one audited frame to the next, where the camera
            moves.
        occluder: Largest share of a picture hidden from its border.
        see_through: Largest share of points of smooth surfaces of one camera that another sees
            through, of any compared pair.
        moved_through: The same from one audited frame to the next; things that move cause it.
        depth_shift_px: Largest shift of one camera's depth against that of the others.
        depth_scale: Largest factor, less 1, by which one camera's depth differs.
        depth_ray: How far depth may be from depth along the axis towards depth along the ray,
            from 0 to 1.
        focal: Largest factor, less 1, by which a focal length, or the unit of depth, differs from
            what depth says while the cameras move.
        picture_shift_px: Largest shift of one camera's pictures against the others, in pixels of
            the picture that is looked at, which is at most 320 a side. Along the rows, where
            disparity is, more is allowed of pictures narrower than 256 px: 0.3 px at 128.
        picture_scale: Largest factor, less 1, between disparity in the pictures and by depth.
        picture_fit: Least correlation of a camera's pictures with those of the camera that they
            fit best, taken there by depth.
        picture_odd: By how much that of each of a camera's pairs may be less than that of the
            other cameras' pairs of as much disparity.
        picture_lag: By how much that may grow if another frame's pictures are taken.
    """

    intrinsics_px: float = 1e-3
    baseline_cm: float = 1e-3
    rectified_px: float = 0.05
    reprojection_px: float = 0.5
    agreement: float = 0.85
    agreement_long: float = 0.7
    frames: float = 0
    valid_depth: float = 0.1
    depth_levels: float = 8
    depth_step: float = 4
    brightness: float = 25
    contrast: float = 8
    change: float = 0.25
    occluder: float = 0.1
    see_through: float = 0.02
    moved_through: float = 0.35
    depth_shift_px: float = 0.25
    depth_scale: float = 0.005
    depth_ray: float = 0.25
    focal: float = 0.01
    picture_shift_px: float = 0.15
    picture_scale: float = 0.01
    picture_fit: float = 0.5
    picture_odd: float = 0.15
    picture_lag: float = 0.02

    @classmethod
    def parse(cls, settings: list[str]) -> "AuditLimits":
        """Return the limits with some set by texts such as ``baseline_cm=0.01``.

        Raises:
            SelectionError: If a text names no limit or no number.
        """
        names = [each.name for each in fields(cls)]
        given: dict[str, float] = {}
        for setting in settings:
            name, _, number = setting.partition("=")
            try:
                value = float(number)
            except ValueError:
                value = math.nan
            if name not in names or math.isnan(value):
                raise SelectionError(
                    f"limit {setting!r} is not NAME=NUMBER with a name of {', '.join(names)}."
                )
            given[name] = value
        return cls(**given)


@dataclass(frozen=True, slots=True)
class At:
    """A figure and the frame in which it was found; frame -1 where there is none."""

    value: float = math.nan
    frame: int = -1


@dataclass(frozen=True, slots=True)
class CameraAudit:
    """What was found of one camera.

    Attributes:
        rgb_frames: Frames that the colour video has; -1 where it cannot be opened.
        depth_frames: The same of the depth video.
        depth_unit_m: Metres in a stored unit, as the contract says.
        depth_step_units: The step in which stored numbers are spaced; nan if fewer than two.
        depth_levels: How many different numbers were met.
        valid_depth: Share of measured pixels, mean of all audited pictures.
        least_valid_depth: The least of any picture.
        brightness: The least 95th percentile of luma.
        contrast: The least distance between 5th and 95th percentile of luma.
        change: The least mean change of luma to the next audited frame, among those between
            which the camera moved.
        still_depth: Frame from which on to the next depth stays the same bit for bit although the
            camera moves, -1 where there is none.
        occluder: The largest share of a picture that something near hides from its border.
        occluder_side: "left", "right", "top" or "all"; empty where nothing does.
        twin: Another camera with the same pictures bit for bit, -1 where there is none.
    """

    rgb_frames: int = -1
    depth_frames: int = -1
    depth_unit_m: float = math.nan
    depth_step_units: float = math.nan
    depth_levels: int = 0
    valid_depth: float = math.nan
    least_valid_depth: At = field(default_factory=At)
    brightness: At = field(default_factory=At)
    contrast: At = field(default_factory=At)
    change: At = field(default_factory=At)
    still_depth: int = -1
    occluder: At = field(default_factory=At)
    occluder_side: str = ""
    twin: int = -1

    @classmethod
    def revived(cls, plain: dict[str, Any]) -> "CameraAudit":
        """Return the record that `plain` turned into JSON."""
        values = _numbers(plain)
        for name in ("least_valid_depth", "brightness", "contrast", "change", "occluder"):
            values[name] = At(**_numbers(plain[name]))
        return cls(**values)


@dataclass(frozen=True, slots=True)
class ToleranceAudit:
    """Reprojection errors of one pair at one tolerance: how many, and their quantiles in px."""

    tolerance: str
    kept: int
    errors_px: tuple[float, ...]

    @property
    def median_px(self) -> float:
        """The median error, nan where no pixel was kept."""
        return self.errors_px[MEDIAN] if self.errors_px else math.nan

    @property
    def p95_px(self) -> float:
        """The 95th percentile, nan where no pixel was kept."""
        return self.errors_px[P95] if self.errors_px else math.nan


@dataclass(frozen=True, slots=True)
class PairAudit:
    """Reprojection of one pair over the audited frames; counts are of pixels.

    ``comparable`` land inside the right picture where depth was measured; ``unhidden`` are those
    of them that nothing in the left view hides, ``agreeing`` those whose depths agree. Errors
    are kept of the primary and the long pair.
    """

    left: int
    right: int
    frames: int
    measured: int
    comparable: int
    unhidden: int
    agreeing: int
    tolerances: tuple[ToleranceAudit, ...]

    @property
    def agreement(self) -> float:
        """Share of the unhidden pixels whose depths agree, nan where there is none."""
        return self.agreeing / self.unhidden if self.unhidden else math.nan

    @classmethod
    def revived(cls, plain: dict[str, Any]) -> "PairAudit":
        """Return the record that `plain` turned into JSON."""
        tolerances = tuple(
            ToleranceAudit(each["tolerance"], each["kept"], tuple(each["errors_px"]))
            for each in plain["tolerances"]
        )
        return cls(**{**plain, "tolerances": tolerances})


@dataclass(frozen=True, slots=True)
class RigAudit:
    """What was found of a scene's cameras by its metadata alone.

    Attributes:
        fx_px: Focal length that the paper's equation gives.
        fy_px: The same, vertically.
        intrinsics_px: Largest deviation of any intrinsics recorded in pixels, of any camera and
            frame, and of those that samples come with, from that.
        intrinsics_recorded: How many numbers were recorded in pixels.
        adjacent_mean_cm: Mean difference of recorded and pose-derived adjacent baselines.
        adjacent_max_cm: The largest one.
        pairs_mean_cm: Mean over all 15 pairs.
        pairs_max_cm: The largest one.
        rotation_deg: Largest angle between camera 0 and another in the same frame.
        rotation_px: How far that moves a point of the picture at most.
        lateral_px: How far cameras off the line of the rig move one at most.
    """

    fx_px: float = math.nan
    fy_px: float = math.nan
    intrinsics_px: float = math.nan
    intrinsics_recorded: int = 0
    adjacent_mean_cm: float = math.nan
    adjacent_max_cm: float = math.nan
    pairs_mean_cm: float = math.nan
    pairs_max_cm: float = math.nan
    rotation_deg: float = math.nan
    rotation_px: float = math.nan
    lateral_px: float = math.nan


@dataclass(frozen=True, slots=True)
class Estimate:
    """One parameter that explains what is left between cameras, frames or pictures.

    Attributes:
        check: "depth" (cameras of one moment), "motion" (one camera over time) or "pictures".
        what: "scale", "ray", "shift_x", "shift_y", "focal", "focal_x" or "focal_y"; factors are
            less 1, shifts in pixels to the right or down of what was compared.
        camera: Of which camera; -1 for all.
        value: The estimate, nan where nothing tells.
        error: Its standard error.
        explained: How much of what is left it explains, the more the better.
        is_first: Whether it explains more than any other, once the first ones before are left out.
    """

    check: str
    what: str
    camera: int
    value: float = math.nan
    error: float = math.nan
    explained: float = math.nan
    is_first: bool = False

    def as_first(self) -> "Estimate":
        """Return it as one that explains more than any other."""
        return replace(self, is_first=True)


@dataclass(frozen=True, slots=True)
class PairFit:
    """How well two cameras fit, points taken both ways.

    Attributes:
        left: One camera.
        right: The other.
        smooth: Points of smooth surfaces that land on smooth surfaces.
        through: Those of them that lie before what the other camera sees there.
        contrast: Standard deviation of compared pictures, grey levels; nan where none was.
        correlation: Of the pictures at the same points; nan where they have no texture.
        disparity_px: Mean disparity of those points, in pixels of the pictures compared.
    """

    left: int
    right: int
    smooth: int
    through: int
    contrast: float
    correlation: float
    disparity_px: float

    @property
    def see_through(self) -> float:
        """The share that is seen through, nan where fewer than 100 points tell."""
        return self.through / self.smooth if self.smooth >= 100 else math.nan


@dataclass(frozen=True, slots=True)
class Alignment:
    """Whether pictures, depth, poses and focal length fit together, see `alignment`.

    Attributes:
        pairs: The cameras that were compared.
        estimates: What may be off, and by how much.
        lags: (camera, lag, gain): by how much the correlation of pictures grows if a camera's
            (-1: all cameras') pictures of frame t + lag are taken.
        moved_smooth: Points of smooth surfaces taken from one audited frame to the next.
        moved_through: Those of them that are seen through there.
        moved_px: How far those points move, the mean of the frames' medians.
        picture_px: Pixels of the scene's pictures to one of those compared.
        width_px: Width of the pictures compared; nan where none was.
        disparity_px: Mean disparity of compared points, in pixels of the pictures compared.
    """

    pairs: tuple[PairFit, ...] = ()
    estimates: tuple[Estimate, ...] = ()
    lags: tuple[tuple[int, int, float], ...] = ()
    moved_smooth: int = 0
    moved_through: int = 0
    moved_px: float = math.nan
    picture_px: float = 1.0
    width_px: float = math.nan
    disparity_px: float = math.nan

    @classmethod
    def revived(cls, plain: dict[str, Any]) -> "Alignment":
        """Return the record that `plain` turned into JSON."""
        return cls(
            **{
                **_numbers(plain),
                "pairs": tuple(PairFit(**_numbers(each)) for each in plain["pairs"]),
                "estimates": tuple(Estimate(**_numbers(each)) for each in plain["estimates"]),
                "lags": tuple((camera, lag, gain) for camera, lag, gain in plain["lags"]),
            }
        )


@dataclass(frozen=True, slots=True)
class SceneAudit:
    """What was found of one scene.

    Attributes:
        key: The scene's key.
        frames: Frames that the index gives it.
        audited_frames: Which frames were decoded.
        rig: The metadata's figures.
        cameras: Those of each camera.
        pairs: Reprojection of the primary pair, of cameras 0 and 5, and, of fewer pixels, of the
            other adjacent pairs.
        problems: File (or empty) and what could not be read of it.
        alignment: Whether pictures, depth, poses and focal length fit together.
    """

    key: str
    frames: int
    audited_frames: tuple[int, ...]
    rig: RigAudit
    cameras: tuple[CameraAudit, ...]
    pairs: tuple[PairAudit, ...]
    problems: tuple[tuple[str, str], ...]
    alignment: Alignment = field(default_factory=Alignment)

    @classmethod
    def revived(cls, plain: dict[str, Any]) -> "SceneAudit":
        """Return the record that `plain` turned into JSON.

        Raises:
            ValueError: If it is not such a record; or another error of Python's, the same way.
        """
        cameras = tuple(CameraAudit.revived(each) for each in plain["cameras"])
        if len(cameras) != CAMERA_COUNT:
            raise ValueError(f"{len(cameras)} cameras")
        return cls(
            key=plain["key"],
            frames=plain["frames"],
            audited_frames=tuple(plain["audited_frames"]),
            rig=RigAudit(**_numbers(plain["rig"])),
            cameras=cameras,
            pairs=tuple(PairAudit.revived(each) for each in plain["pairs"]),
            problems=tuple((name, text) for name, text in plain["problems"]),
            alignment=Alignment.revived(plain["alignment"]),
        )


@dataclass(frozen=True, slots=True)
class Finding:
    """Something beyond a limit, or that could not be read: where, which check, what was found."""

    scene: str
    member: str
    check: str
    found: str

    def __str__(self) -> str:
        """Return it as one line."""
        where = "/".join(part for part in (self.scene, self.member) if part)
        found = " ".join(self.found.split())
        return f"{where}: {self.check}: {found}"


QUANTITIES: Final = {
    "scale": "a factor", "ray": "along the ray", "shift_x": "a shift to the side",
    "shift_y": "a shift up or down", "focal": "a factor of the focal length",
    "focal_x": "the sensor's width", "focal_y": "the sensor's height",
}  # fmt: skip
"""What an `Estimate` is of, in words."""


@dataclass(frozen=True, slots=True)
class Untested:
    """A check that the content of a scene did not allow.

    Attributes:
        scene: The scene's key.
        check: The check.
        quantity: Which of `QUANTITIES` could not be told; empty for the whole check.
        of: Of which cameras; empty for all.
        why: Why, or from which size on it is seen.
    """

    scene: str
    check: str
    quantity: str
    of: str
    why: str

    @property
    def what(self) -> str:
        """What was not tested, of which cameras."""
        return " of ".join(part for part in (self.quantity, self.of) if part) or "all cameras"

    def __str__(self) -> str:
        """Return it as one line."""
        return f"{self.scene}: {self.check}: {self.what}: {self.why}"


@dataclass(frozen=True, slots=True)
class AuditRow:
    """A line of the audit's table: texts, in the paper's words where it has the line."""

    check: str
    quantity: str
    ours: str
    paper: str = ""
    limit: str = ""


@dataclass(frozen=True, slots=True)
class AuditReport:
    """What an audit of some data found.

    Attributes:
        root: Where the data are.
        scenes_there: Scenes of the index.
        scenes_audited: How many of them were audited.
        frames: Frames audited of each scene; 0 for all.
        seed: What the sample of scenes was drawn with.
        limits: Beyond which figures a scene is a finding.
        rows: The table.
        findings: What is beyond a limit, in the order of scenes.
        untested: Checks that the content of a scene did not allow.
        notes: What is no finding and should be known.
        scenes: Each scene's figures.
    """

    root: str
    scenes_there: int
    scenes_audited: int
    frames: int
    seed: int
    limits: AuditLimits
    rows: tuple[AuditRow, ...]
    findings: tuple[Finding, ...]
    untested: tuple[Untested, ...]
    notes: tuple[str, ...]
    scenes: tuple[SceneAudit, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the report as values that `json.dumps` takes, nan as null."""
        document: dict[str, Any] = plain(asdict(self))
        return document


def plain(value: Any) -> Any:
    """Return a value with every nan and infinity in it as None."""
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _numbers(values: dict[str, Any]) -> dict[str, Any]:
    return {name: math.nan if value is None else value for name, value in values.items()}
