"""The records of an audit: figures of each scene and camera, in types that JSON has.

A figure is nan where it could not be measured; `plain` turns nan into JSON's null.
"""

import math
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from typing import Any, Final, get_args, get_origin, get_type_hints

from stereogenbench_data.errors import SelectionError
from stereogenbench_data.schema.release import CAMERA_COUNT

QUANTILES: Final = tuple(step / 40 for step in range(41))
"""The quantiles of each scene's errors that are kept: 0, 2.5 %, 5 % ... 100 %."""


@dataclass(frozen=True, slots=True)
class AuditLimits:
    """The limits beyond which a figure of a scene is a finding.

    Attributes:
        intrinsics_px: Largest deviation of recorded intrinsics.
        baseline_cm: Largest difference between recorded and pose-derived baselines.
        rectified_px: Largest displacement by unequal rotations, or by cameras off the line.
        reprojection_px: Largest median error of the primary pair, at the widest tolerance.
        frames: Frames that every video must have; 0 for as many as the scene has poses.
        valid_depth: Least share of measured pixels in any depth picture.
        depth_levels: Least number of different depths in a camera's pictures.
        depth_step: Largest step of stored numbers, in units: a larger one means that depth was
            rounded or stretched before it was stored.
        brightness: Least 95th percentile of luma (0 to 255) in any picture.
        contrast: Least distance between the 5th and 95th percentile of luma.
        change: Least mean change of luma to the next audited frame while the camera moves.
        occluder: Largest share of a picture hidden from its border.
        see_through: Largest share of one camera's points on smooth surfaces that another camera
            sees through, in any compared pair.
        moved_through: The same from one audited frame to the next; moving objects cause it too.
        depth_shift_px: Largest shift of one camera's depth against the other cameras.
        depth_scale: Largest factor, less 1, by which one camera's depth differs.
        depth_ray: Largest deviation from depth along the axis (0) towards depth along the ray (1).
        focal: Largest factor, less 1, by which a focal length or the unit of depth differs from
            what depth shows while the cameras move.
        picture_odd: Largest difference between the median correlation of other cameras' pictures
            and the best of a camera's, after a warp by depth.
        picture_lag: Largest gain of that correlation by pictures of another frame.
    """

    intrinsics_px: float = 1e-3
    baseline_cm: float = 1e-3
    rectified_px: float = 0.05
    reprojection_px: float = 0.5
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
    picture_odd: float = 0.15
    picture_lag: float = 0.02

    @classmethod
    def parse(cls, settings: list[str]) -> "AuditLimits":
        """Return the limits, some of them set by texts such as ``baseline_cm=0.01``.

        Raises:
            SelectionError: If a text does not name a limit and a number.
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
    """A figure and the frame where it was found; the frame is -1 if there is no figure."""

    value: float = math.nan
    frame: int = -1


@dataclass(frozen=True, slots=True)
class CameraAudit:
    """The audit of one camera.

    Attributes:
        rgb_frames: Number of frames of the colour video; -1 if it cannot be opened.
        depth_frames: The same for the depth video.
        depth_unit_m: Metres in a stored unit, by the contract.
        depth_step_units: The step between stored numbers; nan for fewer than two numbers.
        depth_levels: How many different numbers were found.
        valid_depth: Mean share of measured pixels over all audited pictures.
        least_valid_depth: The least share of any picture.
        brightness: The least 95th percentile of luma.
        contrast: The least distance between the 5th and 95th percentile of luma.
        change: The least mean change of luma to the next audited frame while the camera moves.
        still_depth: The frame whose depth equals that of the next audited frame bit for bit
            although the camera moves; -1 for none.
        occluder: The largest share of a picture that something near hides from its border.
        occluder_side: "left", "right", "top" or "all"; empty for none.
        twin: Another camera with the same pictures bit for bit; -1 for none.
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


@dataclass(frozen=True, slots=True)
class ToleranceAudit:
    """Reprojection errors of one pair at one tolerance: how many, and their quantiles in px."""

    tolerance: str
    kept: int
    errors_px: tuple[float, ...]

    @property
    def median_px(self) -> float:
        """The median error, nan if no pixel was kept."""
        return self.errors_px[QUANTILES.index(0.5)] if self.errors_px else math.nan


@dataclass(frozen=True, slots=True)
class PairAudit:
    """Reprojection of one pair over the audited frames; counts are of pixels.

    ``comparable`` pixels land inside the right picture where depth was measured. Of these, nothing
    in the left view hides the ``unhidden`` ones; of these, the two depths agree at the ``agreeing``
    ones.
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
        """Share of the unhidden pixels whose depths agree, nan if there are no such pixels."""
        return self.agreeing / self.unhidden if self.unhidden else math.nan


@dataclass(frozen=True, slots=True)
class RigAudit:
    """The audit of a scene's cameras by its metadata alone.

    Attributes:
        fx_px: Focal length by the paper's equation.
        fy_px: The same, vertically.
        intrinsics_px: Largest deviation from the paper's equation, of the intrinsics recorded in
            pixels for any camera and frame, and of those in samples.
        adjacent_max_cm: Largest difference of recorded and pose-derived adjacent baselines.
        pairs_max_cm: Largest difference over all 15 pairs.
        rotation_px: Largest displacement of a picture's point by turns against camera 0.
        lateral_px: Largest displacement by cameras off the line of the rig.
    """

    fx_px: float = math.nan
    fy_px: float = math.nan
    intrinsics_px: float = math.nan
    adjacent_max_cm: float = math.nan
    pairs_max_cm: float = math.nan
    rotation_px: float = math.nan
    lateral_px: float = math.nan


@dataclass(frozen=True, slots=True)
class Estimate:
    """The estimate of one parameter that explains residuals between cameras, frames or pictures.

    Attributes:
        check: "depth" (cameras at one moment) or "motion" (one camera over time).
        what: "scale", "ray", "shift_x", "shift_y", "focal", "focal_x" or "focal_y"; factors are
            less 1, shifts in pixels to the right or down of what was compared.
        camera: The camera; -1 for all.
        value: The estimate, nan if it cannot be estimated.
        error: Its standard error.
        explained: The weighted sum of squares that it explains.
        share: The share of all squares at these points.
        is_first: Whether it explained most in its round of `alignment`.
        next_best: What the next best parameter explains alone, over what this one does.
    """

    check: str
    what: str
    camera: int
    value: float = math.nan
    error: float = math.nan
    explained: float = math.nan
    share: float = math.nan
    is_first: bool = False
    next_best: float = 0.0


@dataclass(frozen=True, slots=True)
class PairFit:
    """How well two cameras fit, by points taken in both directions.

    Attributes:
        left: One camera.
        right: The other camera.
        smooth: Number of points on smooth surfaces that land on smooth surfaces.
        through: How many of them lie in front of what the other camera sees there.
        correlation: Correlation of the pictures at the same points; nan without texture.
    """

    left: int
    right: int
    smooth: int
    through: int
    correlation: float

    @property
    def see_through(self) -> float:
        """The share of points that is seen through, nan for fewer than 100 points."""
        return self.through / self.smooth if self.smooth >= 100 else math.nan


@dataclass(frozen=True, slots=True)
class Alignment:
    """How well pictures, depth, poses and focal length fit together, see `alignment`.

    Attributes:
        pairs: The cameras that were compared.
        estimates: What may be off, and by how much.
        lags: (camera, lag, gain): the gain in correlation if a camera's (-1: all cameras')
            pictures of frame t + lag replace those of frame t.
        moved_smooth: Number of points on smooth surfaces taken from one audited frame to the next.
        moved_through: How many of them are seen through there.
        moved_px: How far these points move, the mean of the frames' medians.
    """

    pairs: tuple[PairFit, ...] = ()
    estimates: tuple[Estimate, ...] = ()
    lags: tuple[tuple[int, int, float], ...] = ()
    moved_smooth: int = 0
    moved_through: int = 0
    moved_px: float = math.nan


@dataclass(frozen=True, slots=True)
class SceneAudit:
    """The audit of one scene.

    Attributes:
        key: The scene's key.
        frames: Number of frames by the index.
        audited_frames: The frames that were decoded.
        rig: Figures of the metadata.
        cameras: Figures of each camera.
        pairs: Reprojection of the primary pair and of cameras 0 and 5.
        problems: (file, reason) of files that could not be read.
        alignment: How well pictures, depth, poses and focal length fit together.
    """

    key: str
    frames: int
    audited_frames: tuple[int, ...]
    rig: RigAudit
    cameras: tuple[CameraAudit, ...]
    pairs: tuple[PairAudit, ...]
    problems: tuple[tuple[str, str], ...]
    alignment: Alignment = field(default_factory=Alignment)

    def __post_init__(self) -> None:
        """Refuse a record of another number of cameras."""
        if len(self.cameras) != CAMERA_COUNT:
            raise ValueError(f"{self.key}: {len(self.cameras)} cameras, not {CAMERA_COUNT}")


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
        seed: Seed of the random choice of scenes.
        limits: The limits beyond which a figure is a finding.
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
    seed: int
    limits: AuditLimits
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


def revived(kind: Any, value: Any) -> Any:
    """Return the record, or the part of one, that `plain` made ``value`` of.

    Raises:
        TypeError: If ``value`` is not such a record, or of other types.
        ValueError: If it has other fields or another length, or is not a whole record.
    """
    found: Any = value
    if isinstance(kind, type) and is_dataclass(kind):
        hints = get_type_hints(kind)
        if value.keys() != hints.keys():
            raise ValueError(f"{kind.__name__} has fields {', '.join(hints)}; got {list(value)}")
        found = kind(**{name: revived(hints[name], each) for name, each in value.items()})
    elif get_origin(kind) is tuple:
        kinds = get_args(kind)
        kinds = kinds[:1] * len(value) if kinds[-1] is Ellipsis else kinds
        found = tuple(revived(*pair) for pair in zip(kinds, value, strict=True))
    elif kind is float:
        found = math.nan if value is None else float(value)
    elif type(value) is not kind:
        raise TypeError(f"a value of {kind.__name__} is stored as {value!r}")
    return found
