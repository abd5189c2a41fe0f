"""Which readings of a trajectory are those of a rig: what must be true of the numbers decides.

Distances between the cameras must be the recorded baselines in every frame, the cameras must stand
side by side along the axis that points to their right, and the primary pair's left camera must be
on the left. Evidence rejects, it does not choose: the form that the file names stays if it passes.
Where it fails, the other forms that are settled are tried; where several pass and differ, the
fields on which they differ are refused. Pictures tell more: see `audit.contract.worlds`.

`settled_poses` may search, and ends in a `PosesAt` with every place; `declared_poses` and
`poses_of` read by one.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Final

import numpy as np

from stereogenbench_data.errors import GeometryError, SchemaError
from stereogenbench_data.geometry.camera import recorded_intrinsics
from stereogenbench_data.geometry.pose import OPENCV_FROM_UNREAL, CameraPoses
from stereogenbench_data.geometry.pose_forms import AXES, Reading, poses_at, poses_named, readings
from stereogenbench_data.geometry.rig import lateral_offsets_m, rectification_residual_px
from stereogenbench_data.schema.conventions import declaration_of
from stereogenbench_data.schema.declaration import PosesAt
from stereogenbench_data.schema.pose_search import RecordedPoses, recorded_in
from stereogenbench_data.schema.records import Rig, Scene
from stereogenbench_data.schema.release import CAMERA_PAIRS
from stereogenbench_data.schema.text import shortened
from stereogenbench_data.schema.trajectory import first_frame, parse_trajectory, require_order
from stereogenbench_data.schema.units import UNITS_M

_DEVIATION_CM: Final = 0.1
_DEVIATION_SHARE: Final = 0.001
_LEAST_BESIDE: Final = 0.9
"""How much of a baseline must lie along a camera's x axis; in a lateral rig the cameras turn by at
most 25 degrees from the line on which they stand."""
_EXACT: Final = 1e-3
"""How far the line of the cameras may be from their x axis, as a sine, in a form that no name
supports; a rig that is recorded without rounding has 1e-9 or less."""
_OFF_AXIS: Final = 0.0044
"""The sine of a quarter of a degree: so far cameras that are parallel may stand off their x axis,
where rotations are rounded to three digits."""
_SAME: Final = 1e-4
_UNREAL_M: Final = 0.01
"""Metres in the unit of poses whose file names none: Unreal's."""
_LEFT, _RIGHT = (list(cameras) for cameras in zip(*CAMERA_PAIRS, strict=True))
_SHOWN: Final = 4


class SidesError(SchemaError):
    """What a trajectory says of baselines, lens or the left camera contradicts the rig.

    Attributes:
        scale: By how many times all distances of its cameras are the recorded baselines; None where
            they differ otherwise.
    """

    scale: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MatchedPoses:
    """The poses of a scene, and how they were read.

    Attributes:
        poses: The poses.
        names: The readings that pass and move the cameras differently in the world, the one that
            was taken first.
        at: Where they stand and in which form.
        form: What the index keeps of it, for `poses_of`: None for the first form that the file
            itself names, if it is the only one to pass.
    """

    poses: CameraPoses
    names: tuple[str, ...]
    at: PosesAt
    form: str | None


def settled_poses(
    text: bytes, rig: Rig, *, where: str, named: PosesAt | None = None, frames: int = 0
) -> MatchedPoses:
    """Return the poses of a ``trajectory.json`` that fit a rig, and where they stand in which form.

    Args:
        text: The file's bytes.
        rig: The rig of the scene.
        where: The file's path, for messages.
        named: How conventions read them; what it leaves open is settled.
        frames: How many frames the videos have. Of several lists of poses, such as key frames
            beside all frames, those of so many count.

    Raises:
        SchemaError: If no reading of its numbers passes, or several pass and disagree about where
            the cameras stand to each other; it says what was tried.
        SidesError: If its own form fits but for the side of the primary pair's left camera or one
            factor of all baselines.
    """
    document = parse_trajectory(text, where=where)
    odd: tuple[str, ...] = ()
    try:
        if named is not None and named.is_settled:
            name, poses = poses_at(document, named, where=where)
            found = iter([Reading(name, 0, poses, named)])
        else:
            recorded = recorded_in(document, where=where)
            odd = recorded.odd
            of_all = tuple(each for each in recorded.blocks if len(each.values) == frames)
            recorded = replace(recorded, blocks=of_all or recorded.blocks)
            found = readings(recorded) if named is None else _readings_as(recorded, named)
        settled = _fitting(found, rig, where=where)
    except SchemaError as error:
        if named is not None:
            reason = str(error).rstrip(".?")
            raise SchemaError(f"{reason}. Correct [poses], or leave it out.") from error
        if isinstance(error, SidesError) or not odd:
            raise
        raise SchemaError(f"{where}: {odd[0]}.") from error
    if settled.at.frame is None and named is None:
        require_order(document, settled.at, where=where)
    first = first_frame(document, settled.at)
    form = settled.form if named is None else "|".join(settled.names)
    return replace(settled, at=replace(settled.at, first=first), form=form)


def _readings_as(recorded: RecordedPoses, named: PosesAt) -> Iterator[Reading]:
    """Yield the readings that conventions name, in the unit that they name."""
    axes = [named.axes] if named.axes in AXES else ()
    for reading in readings(recorded, forms="all" if named.form else "settled", axes=axes):
        if named.fits(reading.name):
            unit_m = reading.poses.unit_m if named.unit is None else UNITS_M[named.unit]
            yield replace(reading, tier=0, poses=replace(reading.poses, unit_m=unit_m))


def declared_poses(text: bytes, rig: Rig, *, where: str, settled: MatchedPoses) -> MatchedPoses:
    """Return the poses of a ``trajectory.json`` as another scene's settled them.

    Raises:
        SchemaError: If they do not stand there, or do not fit the rig.
    """
    document = parse_trajectory(text, where=where)
    name, poses = poses_at(document, settled.at, where=where)
    found = _fitting([Reading(name, 0, poses, settled.at)], rig, where=where)
    return replace(settled, poses=found.poses)


def every_fitting(text: bytes, rig: Rig, *, where: str) -> list[tuple[PosesAt, str]] | None:
    """Return how the numbers of a ``trajectory.json`` may be poses of a rig, in any form and axes.

    Args:
        text: The file's bytes.
        rig: The rig.
        where: The file's path, for messages.

    Returns:
        Each form that fits and moves the cameras differently, with the name of its reading; None
        where one is settled without being stated, or fits but for the side of the left camera.

    Raises:
        SchemaError: If it has no numbers of six cameras.
    """
    document = parse_trajectory(text, where=where)
    recorded = recorded_in(document, where=where)
    most = max(len(each.values) for each in recorded.blocks)
    blocks = tuple(each for each in recorded.blocks if len(each.values) == most)
    recorded = replace(recorded, blocks=blocks)
    try:
        if len(_fitting(readings(recorded), rig, where=where).names) == 1:
            return None
    except SidesError:
        return None
    except SchemaError:
        pass
    fitting: list[Reading] = []
    for reading in readings(recorded, forms="all", axes=[*AXES]):
        with suppress(GeometryError, SchemaError):
            checked, off = _checked(reading, rig)
            is_new = not any(same_poses(checked.poses, each.poses) for each in fitting)
            fitting += [checked] if off <= _EXACT and is_new else []
    names = {metres: name for name, metres in reversed(UNITS_M.items()) if len(name) < 3}
    return [(replace(each.at, unit=names[each.poses.unit_m], first=first_frame(document, each.at)),
             f"{each.name} @ {each.poses.unit_m!r}") for each in fitting]  # fmt: skip


def _fitting(found: Iterable[Reading], rig: Rig, *, where: str) -> MatchedPoses:
    """Return the poses of the first tier of readings that fit a rig, as `settled_poses` says."""
    failures: dict[str, str] = {}
    sides: list[SidesError] = []
    loose: list[Reading] = []
    exact: list[Reading] = []
    first = None
    for tier, group in groupby(found, key=lambda each: each.tier):
        for reading in group:
            first = first or reading
            try:
                checked, off = _checked(reading, rig)
            except (GeometryError, SchemaError) as error:
                failures.setdefault(str(error), reading.name)
                sides += [error] if tier == 0 and isinstance(error, SidesError) else []
                continue
            if off <= _EXACT:
                exact.append(checked)
            elif tier == 0:
                loose.append(checked)
        if exact or sides:
            break
    passed = exact or loose[:1]
    if sides and not passed:
        told = SidesError(f"{where}: {sides[0]}. Correct one of them.")
        told.scale = sides[0].scale
        raise told
    if first is None or not passed:
        tried = "; ".join(f"{reason} ({name})" for reason, name in list(failures.items())[:_SHOWN])
        misfit = f"{tried}. It may be another scene's, or in another unit"
        why = misfit if tried else "it has no location with a rotation"
        raise SchemaError(f"{where}: no reading of its poses fits the rig of baseline.json: {why}.")
    taken = passed[0]
    others = [each for each in passed[1:] if not _same(each.poses, taken.poses, _rig_at)]
    if others:
        listed = ", ".join(shortened(each.name, 120) for each in (taken, *others)[:_SHOWN])
        raise SchemaError(
            f"{where}: several readings of its poses fit the rig and differ in how its cameras "
            f"stand to each other: {listed}. Name the right one in the file."
        )
    worlds = [taken, *(each for each in passed[1:]
                       if not _same(each.poses, taken.poses, _moved))]  # fmt: skip
    names = tuple(f"{each.name} @ {each.poses.unit_m!r}".replace("|", "/") for each in worlds)
    unit_m = taken.poses.unit_m
    is_own = taken.name == first.name and len(names) == 1 and (
        np.isfinite(first.poses.unit_m) or unit_m == _UNREAL_M
    )  # fmt: skip
    unit = next(name for name, metres in UNITS_M.items() if metres == unit_m)
    form = None if is_own else "|".join(names)
    return MatchedPoses(taken.poses, names, replace(taken.at, unit=unit), form)


def shape_of(form: str) -> str:
    """Return the keys of the numbers that a form reads: scenes of one writer have them alike."""
    return form.split(": ")[0]


def poses_of(scene: Scene, text: bytes, *, where: str, form: str | None = None) -> CameraPoses:
    """Return the poses of a scene's ``trajectory.json`` as its row of the index says.

    Args:
        scene: The row.
        text: The file's bytes.
        where: The file's path, for messages.
        form: Another reading than the row's, by its name.

    Raises:
        SchemaError: If the file has no such poses.
    """
    at, own = declaration_of(scene).poses, (scene.pose_form or "").split("|")[0]
    name, _, unit_m = (form or own).rpartition(" @ ")
    if at is not None and at.is_settled and (form or own) == own:
        _, poses = poses_at(parse_trajectory(text, where=where), at, where=where)
    elif name:
        poses = poses_named(parse_trajectory(text, where=where), name, where=where)
    else:
        return settled_poses(text, scene.rig, where=where, frames=scene.frames).poses
    return replace(poses, unit_m=float(unit_m)) if unit_m else poses


def _checked(reading: Reading, rig: Rig) -> tuple[Reading, float]:
    """Return a reading that fits a rig, in its unit, and how far that is off its x axis, as a sine.

    Raises:
        GeometryError: If the rig has no intrinsics.
        SchemaError: If it does not fit; `SidesError` if all distances differ by one scale, or the
            primary pair's left camera is to the right of the right one.
    """
    poses = reading.poses
    steps = poses.centres[:, _RIGHT] - poses.centres[:, _LEFT]
    baselines_cm = np.array(rig.baselines_cm)
    distances = np.linalg.norm(steps, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = float(np.median(baselines_cm / 100 / distances))
        scaled_cm = distances * ratio * 100
    stated_m = poses.unit_m
    # A stated unit must be that of the distances.
    units_m = [stated_m] if np.isfinite(stated_m) else sorted(set(UNITS_M.values()))
    other_m = stated_m if np.isfinite(stated_m) else _UNREAL_M
    unit_m = next((each for each in units_m if abs(ratio / each - 1) <= _ROUGH), other_m)
    allowed_cm = _DEVIATION_CM + _DEVIATION_SHARE * baselines_cm
    away_cm = np.abs(distances * unit_m * 100 - baselines_cm)
    if not (away_cm <= allowed_cm).all():
        worst = int(np.argmax(away_cm - allowed_cm))
        frame, pair = divmod(worst, len(CAMERA_PAIRS))
        a, b = CAMERA_PAIRS[pair]
        is_scaled = bool((np.abs(scaled_cm - baselines_cm) <= allowed_cm).all())
        # One ratio in all pairs and frames is no rounding: it is a unit, or a scale.
        is_one = bool((np.abs(scaled_cm - baselines_cm) <= _DEVIATION_SHARE * baselines_cm).all())
        is_told = np.isfinite(stated_m) and (is_one or (is_scaled and not 0.5 < ratio / unit_m < 2))
        told = (
            f"baseline.json says that cameras {a} and {b} are {baselines_cm[pair]:.6g} cm apart, "
            f"and by the poses they are {distances[frame, pair] * unit_m * 100:.6g} cm apart in "
            f"frame {frame}"
        )
        if not is_told:
            raise SchemaError(told)
        error = SidesError(f"{told}, as if one of the two were in another unit or scaled")
        error.scale = unit_m / ratio
        raise error
    poses = replace(poses, unit_m=unit_m)
    lateral_m = lateral_offsets_m(poses)
    beside_cm = np.abs(lateral_m[_RIGHT] - lateral_m[_LEFT]) * 100
    residual_px = rectification_residual_px(poses, recorded_intrinsics(rig))
    if not (beside_cm >= _LEAST_BESIDE * baselines_cm).all() or not np.isfinite(residual_px):
        pair = int(np.argmin(beside_cm / baselines_cm))
        a, b = CAMERA_PAIRS[pair]
        raise SchemaError(
            f"cameras {a} and {b} are {beside_cm[pair]:.6g} cm beside each other as camera 0 "
            f"looks, and {baselines_cm[pair]:.6g} cm apart; or a camera looks away from what the "
            f"others see"
        )
    axes = poses.world_from_cam_rotations[..., 0][:, _LEFT]
    along = np.sum((steps @ OPENCV_FROM_UNREAL.T) * axes, axis=-1) / distances
    sines = np.sqrt(np.maximum(0.0, 1 - np.square(along)))
    off, turns = float(sines.max()), poses.world_from_cam_rotations
    is_off = (sines * baselines_cm > _OFF_AXIS * baselines_cm + _DEVIATION_CM).any()
    if is_off and np.abs(turns - turns[:, :1]).max() <= _EXACT:
        raise SchemaError(
            f"the cameras look one way, and stand {np.degrees(np.arcsin(off)):.3g} degrees off "
            f"the axis to their right"
        )
    left, right = rig.primary_pair
    if lateral_m[left] > lateral_m[right]:
        raise SidesError(
            f"by its poses ({reading.name}), camera {left} is to the right of camera {right}, and "
            f"by baseline.json it is the left one (in a right-handed world, [poses] with "
            f'axes = "ros" says so)'
        )
    return replace(reading, poses=poses), off


_ROUGH: Final = 0.1
"""How far the median of distances may be from a unit before they are compared one by one."""


def same_poses(first: CameraPoses, other: CameraPoses) -> bool:
    """Return whether two readings are the same poses, seen from the first place of camera 0."""
    return _same(first, other, _rig_at) and _same(first, other, _moved)


def _same(
    first: CameraPoses, other: CameraPoses, seen: Callable[[CameraPoses, int], np.ndarray]
) -> bool:
    """Return whether two readings look alike in the first, a middle and the last frame."""
    frames = (0, first.frame_count // 2, first.frame_count - 1)
    return first.frame_count == other.frame_count and all(
        np.allclose(seen(first, each), seen(other, each), atol=_SAME) for each in frames
    )


def _rig_at(poses: CameraPoses, frame: int) -> np.ndarray:
    """Return how some cameras stand to each other."""
    ends = ((0, 5), (2, 3))
    return np.array([poses.cam_from_cam(frame, target=b, source=a) for a, b in ends])


def _moved(poses: CameraPoses, frame: int) -> np.ndarray:
    """Return where camera 0 stands as seen from its first place, and how it is turned there."""
    moved = poses.later_from_cam(frame, 0, camera=0)
    return np.hstack([moved[:3], poses.world_from_cam_rotations[0, 0]])
