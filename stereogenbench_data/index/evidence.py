"""Which readings of a trajectory are those of a rig: what must be true of the numbers decides.

Distances between the cameras must be the recorded baselines in every frame, the cameras must stand
side by side along the axis that points to their right, and the primary pair's left camera must be
on the left. Evidence rejects, it does not choose: the form that the file names stays if it passes.
Where none is named, or it fails, the other forms are tried; where several pass and differ, the
fields on which they differ are refused.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from stereogenbench_data.errors import GeometryError, SchemaError
from stereogenbench_data.geometry.camera import recorded_intrinsics
from stereogenbench_data.geometry.pose import OPENCV_FROM_UNREAL, CameraPoses
from stereogenbench_data.geometry.pose_forms import Reading, readings
from stereogenbench_data.geometry.rig import lateral_offsets_m, rectification_residual_px
from stereogenbench_data.schema.conventions import PosesAs
from stereogenbench_data.schema.quantities import UNITS_M
from stereogenbench_data.schema.records import Rig
from stereogenbench_data.schema.release import CAMERA_PAIRS
from stereogenbench_data.schema.text import shortened
from stereogenbench_data.schema.trajectory import RecordedPoses, record_poses

_DEVIATION_CM: Final = 0.1
_DEVIATION_SHARE: Final = 0.001
_LEAST_BESIDE: Final = 0.9
"""How much of a baseline must lie along a camera's x axis; in a lateral rig the cameras turn by at
most 25 degrees from the line on which they stand."""
_EXACT: Final = 1e-3
"""How far the line of the cameras may be from their x axis, as a sine, in a form that no name
supports; a rig that is recorded without rounding has 1e-9 or less."""
_SAME: Final = 1e-4
_UNREAL_M: Final = 0.01
"""Metres in the unit of poses whose file names none: Unreal's."""
_LEFT, _RIGHT = (list(cameras) for cameras in zip(*CAMERA_PAIRS, strict=True))
_SHOWN: Final = 4


@dataclass(frozen=True, slots=True, eq=False)
class Understood:
    """The poses of a scene, and how they were read.

    Attributes:
        poses: The poses.
        names: The readings that pass, the one that was taken first; () where that is the one that
            the file itself names.
        differ: Whether poses in the world differ between these readings.
        note: How the poses contradict the primary pair; "" where they do not.
        form: The reading that was taken, with its unit.
    """

    poses: CameraPoses
    names: tuple[str, ...]
    differ: bool
    note: str = ""
    form: str = ""


def understood_poses(
    text: bytes, rig: Rig, *, where: str, named: PosesAs | None = None
) -> Understood:
    """Return the poses of a ``trajectory.json`` that fit a rig.

    Args:
        text: The file's bytes.
        rig: The rig of the scene.
        where: The file's path, for messages.
        named: How conventions read them, which must pass as well as the best other reading.

    Raises:
        SchemaError: If no reading of its numbers passes, or several pass and disagree about where
            the cameras stand to each other, or another one than the named; it says what was tried.
    """
    recorded = record_poses(text, where=where)
    failures: dict[str, str] = {}
    passed: list[tuple[Reading, CameraPoses, float]] = []
    for reading in _readings(recorded, named):
        is_found = passed and _is_exact(passed) and not _is_reversed(passed[0][1], rig)
        if is_found and reading.tier > passed[0][0].tier:
            break
        poses, off, reason = _checked(reading, rig)
        if poses is None:
            failures.setdefault(reason, reading.name)
        else:
            passed.append((reading, poses, off))
    all_passed = list(passed)
    left, right = rig.primary_pair
    reversed_ = [each for each in passed if _is_reversed(each[1], rig)]
    note = ""
    if len(reversed_) < len(passed):
        passed = [each for each in passed if not _is_reversed(each[1], rig)]
    elif passed:
        note = (
            f"baseline.json says that camera {left} is the left one of the primary pair, and by "
            f"the poses it is to the right of camera {right}. The poses count: correct one of them"
        )
    exact = [each for each in passed if each[2] <= _EXACT]
    if exact:
        passed = [each for each in exact if each[0].tier == exact[0][0].tier]
    else:
        passed = [each for each in passed if each[0].tier == 0][:1]
    if not passed:
        tried = "; ".join(f"{reason} ({name})" for reason, name in list(failures.items())[:_SHOWN])
        raise SchemaError(
            f"{where}: no reading of its poses fits the rig of baseline.json: "
            f"{tried or 'it has no location with a rotation'}. Is it another scene's, or its "
            f"unit wrong?"
        )
    taken = passed[0]
    _require_named(
        named, taken, recorded, rig, failures=failures, all_passed=all_passed, where=where
    )
    others = [each for each in passed[1:] if not _same_rig(each[1], taken[1])]
    if others:
        listed = ", ".join(shortened(each[0].name, 120) for each in (taken, *others)[:_SHOWN])
        raise SchemaError(
            f"{where}: several readings of its poses fit the rig and differ in how its cameras "
            f"stand to each other: {listed}. Name the right one in the file."
        )
    worlds = [taken, *(each for each in passed[1:] if not _same_world(each[1], taken[1]))]
    names = tuple(_full_name(reading, poses) for reading, poses, _ in worlds)
    is_plain = len(worlds) == 1 and taken[0].tier == 0 and taken[1].unit_m in (
        taken[0].trajectory.unit_m, _UNREAL_M,
    )  # fmt: skip
    return Understood(
        taken[1],
        () if is_plain and named is None else names,
        differ=len(worlds) > 1,
        note=note,
        form=names[0],
    )


def _readings(recorded: RecordedPoses, named: PosesAs | None) -> Iterator[Reading]:
    """Yield readings, those that conventions name first, in the unit that they name."""
    if named is None:
        yield from readings(recorded)
        return
    for reading in readings(recorded, named=named.fits):
        if named.unit is not None and named.fits(reading.name):
            unit_m = UNITS_M[named.unit]
            yield replace(reading, trajectory=replace(reading.trajectory, unit_m=unit_m))
        else:
            yield reading


def _own_form(recorded: RecordedPoses, rig: Rig, named: PosesAs, poses: CameraPoses) -> str:
    """Return the form that a file itself names, if it passes and moves the cameras otherwise."""
    for reading in readings(recorded):
        if reading.tier > 0:
            break
        own, off, _ = (None, 0.0, "") if named.fits(reading.name) else _checked(reading, rig)
        if own is not None and off <= _EXACT and not (
            _same_world(own, poses) and _same_rig(own, poses)
        ):  # fmt: skip
            return reading.name
    return ""


def _require_named(  # noqa: PLR0913 - what the message tells
    named: PosesAs | None,
    taken: tuple[Reading, CameraPoses, float],
    recorded: RecordedPoses,
    rig: Rig,
    *,
    failures: Mapping[str, str],
    all_passed: Sequence[tuple[Reading, CameraPoses, float]],
    where: str,
) -> None:
    """Refuse poses that are not as conventions read them, or that the file's own form contradicts.

    Args:
        named: How conventions read the poses; None if they do not say.
        taken: What fits best.
        recorded: The numbers.
        rig: The rig of the scene.
        failures: Reasons to readings that fail.
        all_passed: The readings that pass, also those that fit less well.
        where: The file's path, for messages.
    """
    if named is None:
        return
    other, why = taken[0].name, "no numbers of the file have this form"
    if named.fits(other):
        other = _own_form(recorded, rig, named, taken[1])
        why = "the file names another form, which fits as well and moves the cameras otherwise"
    if not other:
        return
    reasons = [f"{reason} ({name})" for reason, name in failures.items() if named.fits(name)]
    reasons += [
        "the left camera of the primary pair stands on the right"
        if _is_reversed(poses, rig)
        else f"the line of the cameras is {np.degrees(np.arcsin(min(1.0, off))):.3g} degrees off "
        f"their x axis, and {np.degrees(np.arcsin(taken[2])):.3g} by the other form"
        for reading, poses, off in all_passed
        if named.fits(reading.name) and not named.fits(taken[0].name)
    ]
    raise SchemaError(
        f"{where}: the conventions read its poses as {shortened(_described(named), 300)}, and that "
        f"does not fit: {'; '.join(reasons[:_SHOWN]) or why}. What fits is: "
        f"{shortened(other, 300)}. Correct [poses], or leave it out."
    )


def _described(named: PosesAs) -> str:
    stated = ((name, getattr(named, name)) for name in ("rotation", "form", "axes", "unit"))
    return ", ".join(f"{name} {value!r}" for name, value in stated if value is not None)


def _is_reversed(poses: CameraPoses, rig: Rig) -> bool:
    """Return whether the left camera of the primary pair stands to the right of the other."""
    lateral_m = lateral_offsets_m(poses)
    left, right = rig.primary_pair
    return bool(lateral_m[left] > lateral_m[right])


def poses_as(text: bytes, form: str | None, *, where: str) -> CameraPoses:
    """Return the poses of a ``trajectory.json`` by the form that an index row names.

    Args:
        text: The file's bytes.
        form: `Scene.pose_form`; None takes the form that the file itself names.
        where: The file's path, for messages.

    Raises:
        SchemaError: If the file has no poses of this form.
    """
    recorded = record_poses(text, where=where)
    name, _, unit_m = (form or "").split("|")[0].rpartition(" @ ")
    for reading in readings(recorded, only=name or None):
        trajectory = reading.trajectory
        if name:
            trajectory = replace(trajectory, unit_m=float(unit_m))
        elif not np.isfinite(trajectory.unit_m):
            trajectory = replace(trajectory, unit_m=_UNREAL_M)
        return CameraPoses.from_trajectory(trajectory)
    raise SchemaError(
        f"{where}: has no poses {f'of the form {shortened(name, 200)}' if name else 'at all'}. "
        f"Run `stereogenbench index` again."
    )


def _full_name(reading: Reading, poses: CameraPoses) -> str:
    return f"{reading.name} @ {poses.unit_m!r}".replace("|", "/")


def _is_exact(passed: Sequence[tuple[Reading, CameraPoses, float]]) -> bool:
    return any(off <= _EXACT for _, _, off in passed)


def _checked(reading: Reading, rig: Rig) -> tuple[CameraPoses | None, float, str]:
    """Return the poses of a reading that passes, how far the rig is from its axis, or why not."""
    try:
        poses = CameraPoses.from_trajectory(reading.trajectory)
    except GeometryError as error:
        return None, 0.0, str(error)
    steps = poses.centres[:, _RIGHT] - poses.centres[:, _LEFT]
    baselines_cm = np.array(rig.baselines_cm)
    distances = np.linalg.norm(steps, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = float(np.median(baselines_cm / 100 / distances))
    unit_m = _unit_of(ratio, reading.trajectory.unit_m)
    if unit_m is None:
        posed_cm = distances[0] * 100 * np.nan_to_num(reading.trajectory.unit_m, nan=0.01)
        a, b = CAMERA_PAIRS[0]
        return None, 0.0, (
            f"baseline.json says that cameras {a} and {b} are {baselines_cm[0]:.6g} cm apart, "
            f"and by the poses they are {posed_cm[0]:.6g} cm apart"
        )  # fmt: skip
    allowed_cm = _DEVIATION_CM + _DEVIATION_SHARE * baselines_cm
    away_cm = np.abs(distances * unit_m * 100 - baselines_cm)
    if not (away_cm <= allowed_cm).all():
        worst = int(np.argmax(away_cm - allowed_cm))
        frame, pair = divmod(worst, len(CAMERA_PAIRS))
        a, b = CAMERA_PAIRS[pair]
        return None, 0.0, (
            f"baseline.json says that cameras {a} and {b} are {baselines_cm[pair]:.6g} cm apart, "
            f"and by the poses they are {distances[frame, pair] * unit_m * 100:.6g} cm apart in "
            f"frame {frame}"
        )  # fmt: skip
    poses = replace(poses, unit_m=unit_m)
    lateral_m = lateral_offsets_m(poses)
    beside_cm = np.abs(lateral_m[_RIGHT] - lateral_m[_LEFT]) * 100
    residual_px = rectification_residual_px(poses, recorded_intrinsics(rig))
    if not (beside_cm >= _LEAST_BESIDE * baselines_cm).all() or not np.isfinite(residual_px):
        pair = int(np.argmin(beside_cm / baselines_cm))
        a, b = CAMERA_PAIRS[pair]
        return None, 0.0, (
            f"cameras {a} and {b} are {beside_cm[pair]:.6g} cm beside each other as camera 0 "
            f"looks, and {baselines_cm[pair]:.6g} cm apart; or a camera looks away from what the "
            f"others see"
        )  # fmt: skip
    axes = poses.world_from_cam_rotations[..., 0][:, _LEFT]
    along = np.sum((steps @ OPENCV_FROM_UNREAL.T) * axes, axis=-1) / distances
    return poses, float(np.sqrt(np.maximum(0.0, 1 - np.square(along))).max()), ""


def _unit_of(ratio: float, stated_m: float) -> float | None:
    """Return the metres in the unit of poses; a stated one must be that of the distances."""
    known = [stated_m] if np.isfinite(stated_m) else sorted(set(UNITS_M.values()))
    for unit_m in known:
        if abs(ratio / unit_m - 1) <= _ROUGH:
            return unit_m
    return None


_ROUGH: Final = 0.1
"""How far the median of distances may be from a unit before they are compared one by one."""


def _same_rig(first: CameraPoses, other: CameraPoses) -> bool:
    """Return whether two readings agree about how cameras stand to each other, in some frames."""
    frames = sorted({0, first.frame_count // 2, first.frame_count - 1})
    return all(
        np.allclose(
            first.cam_from_cam(frame, target=target, source=source),
            other.cam_from_cam(frame, target=target, source=source),
            atol=_SAME,
        )
        for frame in frames
        for source, target in ((0, 5), (2, 3))
    )


def _same_world(first: CameraPoses, other: CameraPoses) -> bool:
    """Return whether two readings move the cameras alike, seen from their first place."""
    return all(
        np.allclose(_moved(first, frame), _moved(other, frame), atol=_SAME)
        for frame in _frames(first)
    ) and np.allclose(_forward(first), _forward(other), atol=_SAME)


def _frames(poses: CameraPoses) -> Iterable[int]:
    return sorted({0, poses.frame_count // 2, poses.frame_count - 1})


def _moved(poses: CameraPoses, frame: int) -> np.ndarray:
    first, later = poses.world_from_cam(0, 0), poses.world_from_cam(frame, 0)
    return np.asarray(np.linalg.inv(first) @ later)


def _forward(poses: CameraPoses) -> np.ndarray:
    return np.asarray(poses.world_from_cam_rotations[0, 0])
