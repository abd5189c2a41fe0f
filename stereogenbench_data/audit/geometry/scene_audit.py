"""The audit of one scene: each video is decoded once, forwards, and only at the audited frames.

A file that cannot be read does not stop the audit: it is noted, and the rest is measured.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import closing, nullcontext
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from stereogenbench_data.audit.geometry.alignment import AlignmentCheck
from stereogenbench_data.audit.geometry.picture_check import (
    MOVED_SHARE,
    band_passed,
    border_occluder,
    light_figures,
    luma_of,
    payload_figures,
    reduced_size,
    stored_figures,
    subject_m,
)
from stereogenbench_data.audit.geometry.picture_limits import FLAT_SD
from stereogenbench_data.audit.geometry.records import CHECKS, Figure, SceneAudit
from stereogenbench_data.audit.geometry.reprojection import (
    MeasuredDepth,
    PairErrors,
    pair_audit,
    reproject,
)
from stereogenbench_data.audit.geometry.rig_check import motion_px, recorded_px, rig_figures
from stereogenbench_data.audit.scene_access import spread
from stereogenbench_data.engine import Advance
from stereogenbench_data.errors import MediaError, SchemaError, StereoGenBenchError, StorageError
from stereogenbench_data.geometry.camera import rig_intrinsics
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.geometry.pose_evidence import poses_of
from stereogenbench_data.media.depth import NO_DEPTH_UNIT, depth_frame_index
from stereogenbench_data.media.video import probe
from stereogenbench_data.samples.load import Streams
from stereogenbench_data.schema.conventions import declaration_of, depth_of
from stereogenbench_data.schema.document import parse_object
from stereogenbench_data.schema.records import DepthEncoding, Scene
from stereogenbench_data.schema.release import (
    BASELINE_JSON,
    CAMERA_COUNT,
    TRAJECTORY_JSON,
    VIDEO_FILES,
    depth_name,
    rgb_name,
)
from stereogenbench_data.sources.members import MemberSource

LONG_PAIR: Final = (0, CAMERA_COUNT - 1)
"""The non-adjacent pair that the paper audits beside the primary one."""


Result = TypeVar("Result")


class AuditedFiles:
    """A scene's metadata, frame counts and decoded frames.

    Attributes:
        problems: Maps the name of a file that cannot be read to the reason; it is not tried again.
        not_fetched: The videos that only a whole release has: nothing is remarked about them.
    """

    def __init__(self, scene: Scene, source: MemberSource) -> None:
        """Prepare to read; nothing is opened yet."""
        self.problems: dict[str, str] = {}
        self.scene, self.source = scene, source
        self.streams = Streams(self.source)
        self.intrinsics = rig_intrinsics(self.scene.rig)
        self.not_fetched = {
            name for name in VIDEO_FILES
            if scene.held_name(name) not in scene.members and name not in scene.remark("videos")
        }  # fmt: skip

    def attempt(self, name: str, read: Callable[..., Result], *args: Any) -> Result | None:
        """Return what ``read`` returns for a file, None if it or an earlier attempt failed."""
        if name in self.problems or name in self.not_fetched:
            return None
        try:
            return read(*args)
        except (StereoGenBenchError, OSError) as error:
            self.problems[name] = str(error)
            return None

    def recorded_px(self) -> list[tuple[str, float]]:
        """Return what ``baseline.json`` records in pixels, by the names of `Intrinsics`."""
        self._require_member(BASELINE_JSON)
        document = parse_object(self.source.read(self.scene, BASELINE_JSON), where=BASELINE_JSON)
        return list(recorded_px(document, declaration_of(self.scene)))

    def poses(self) -> CameraPoses:
        """Return the poses of at least as many frames as the scene has."""
        self._require_member(TRAJECTORY_JSON)
        text = self.source.read(self.scene, TRAJECTORY_JSON)
        poses = poses_of(self.scene, text, where=TRAJECTORY_JSON)
        if poses.frame_count < self.scene.frames:
            told = f"has poses of {poses.frame_count} frames, and the index says"
            raise SchemaError(f"{told} {self.scene.frames}")
        return poses

    def _require_member(self, name: str) -> None:
        if self.scene.held_name(name) not in self.scene.members:
            reason = self.scene.remark("videos" if name in VIDEO_FILES else "poses")
            raise StorageError(reason or "is missing: the index has no such file of this scene")

    def frame_count(self, name: str) -> int:
        """Return the number of frames of a video."""
        self._require_member(name)
        held = self.scene.held_name(name)
        opened = self.source.open(self.scene, held)
        label = self.source.label(self.scene, held)
        with nullcontext() if isinstance(opened, Path) else closing(opened):
            facts = probe(opened, name=label, pixel_format="later" if "rgb" in name else "needed")
        return facts.frames

    def picture(self, camera: int, frame: int) -> Any:
        """Return a frame as (3, h, w) uint8, at the reduced size that the checks use."""
        rig = self.scene.rig
        size = reduced_size(rig.image_height_px, rig.image_width_px)
        return self.streams.rgb(self.scene, rgb_name(camera), frame, size=size)

    def depth(self, camera: int, frame: int) -> tuple[Any, MeasuredDepth] | None:
        """Return stored numbers and depth, None if the frame lag leaves the frame without depth."""
        encoding = self.encoding(camera)
        if encoding.unit_m is None:
            raise MediaError(self.scene.remark("depth") or NO_DEPTH_UNIT)
        index = depth_frame_index(frame, encoding=encoding, frames=self.scene.frames)
        if index is None:
            return None
        stored = self.streams.read_stored_depth(
            self.scene, depth_name(camera), index, encoding=encoding
        )
        return stored.units, MeasuredDepth.of(
            stored.units, stored.measured, encoding=encoding, intrinsics=self.intrinsics
        )

    def encoding(self, camera: int) -> DepthEncoding:
        """Return the contract of a camera's depth; its unit is None if tags contradict it."""
        return self.scene.depth_encoding(camera, depth_of(self.scene))


@dataclass(frozen=True, slots=True)
class AuditTask:
    """One scene to audit; can be sent to worker processes.

    Attributes:
        scene: The scene.
        source: Its files.
        frames: How many frames to audit, evenly spread; 0 for all.
    """

    scene: Scene
    source: MemberSource
    frames: int


def audit_scene(task: AuditTask, after_bytes: Advance) -> SceneAudit:
    """Return the audit of a scene; errors in its files become findings and are not raised.

    Args:
        task: The scene, and how to audit it.
        after_bytes: Called with 1 after each frame; the work may be interrupted there.
    """
    return _SceneCheck(task).run(after_bytes)


class _SceneCheck:
    """The state of one scene's audit: open videos, and the results so far."""

    def __init__(self, task: AuditTask) -> None:
        self.scene = task.scene
        self.frames = spread(self.scene.frames, task.frames)
        self.files = AuditedFiles(task.scene, task.source)
        self.intrinsics = self.files.intrinsics
        self.of_frames: list[Figure] = []
        self.last: dict[str, tuple[int, Any]] = {}
        self.numbers = np.zeros((CAMERA_COUNT, 1 << 16), dtype=np.bool_)
        self.copies: dict[tuple[int, int], list[bool]] = {}
        self.errors: dict[tuple[int, int], list[PairErrors]] = {
            self.scene.rig.primary_pair: [], LONG_PAIR: [],
        }  # fmt: skip
        self.alignment = AlignmentCheck(self.intrinsics)
        self.seen: dict[tuple[int, int], tuple[Any, Any]] = {}

    def run(self, after_bytes: Advance) -> SceneAudit:
        """Audit the scene."""
        try:
            figures, poses = self._metadata()
            for name in VIDEO_FILES:
                count = self.files.attempt(name, self.files.frame_count, name)
                figures += [] if count is None else [Figure("frames", name, count)]
            for frame in self.frames:
                self._frame(frame, poses)
                after_bytes(1)
        finally:
            self.files.streams.close()
        pairs = tuple(pair_audit(found) for found in self.errors.values())
        figures.append(Figure("reprojection_px", "", pairs[0].median_px(-1)))
        figures += self.alignment.figures()
        figures += self._of_files()
        return SceneAudit(
            key=self.scene.id.key,
            frames=self.scene.frames,
            audited_frames=self.frames,
            figures=tuple(figures),
            pairs=pairs,
            problems=dict(sorted(self.files.problems.items())),
            contradiction=self.scene.remark("left"),
        )

    def _metadata(self) -> tuple[list[Figure], CameraPoses | None]:
        recorded = self.files.attempt(BASELINE_JSON, self.files.recorded_px)
        poses = self.files.attempt(TRAJECTORY_JSON, self.files.poses)
        if poses is None:
            return [], None
        of_rig = rig_figures(self.scene.rig, poses, recorded or [])
        return [Figure(quantity, "", value) for quantity, value in of_rig.items()], poses

    def _frame(self, frame: int, poses: CameraPoses | None) -> None:
        """Decode one frame of all cameras, and add it to the checks."""
        depths: dict[int, MeasuredDepth] = {}
        stored: dict[int, Any] = {}
        # Units that contradict one another are no single file's.
        no_unit = all(self.files.encoding(c).unit_m is None for c in range(CAMERA_COUNT))
        for camera in range(CAMERA_COUNT):
            name = "cam_*_depth.mkv" if no_unit else depth_name(camera)
            read = self.files.attempt(name, self.files.depth, camera, frame)
            if read is not None:
                stored[camera], depths[camera] = read
        far_m = subject_m([(each.depth_m, each.measured) for each in depths.values()])
        for camera, depth in depths.items():
            name, units = depth_name(camera), stored[camera]
            before = self._must_differ(name, camera, frame, poses, far_m=far_m)
            self.of_frames += payload_figures(name, frame, units, depth.measured, before=before)
            share, side = border_occluder(depth.depth_m, depth.measured, far_m=far_m)
            where = f"frame {frame}, {side or 'no'} border"
            self.of_frames.append(Figure("occluder", name, share, where))
            self.numbers[camera, units[depth.measured]] = True
            self.last[name] = (frame, units)
        self._see(frame)
        lumas = {camera: luma for (camera, at), (luma, _) in self.seen.items() if at == frame}
        for camera, luma in lumas.items():
            name = rgb_name(camera)
            before = self._must_differ(name, camera, frame, poses, far_m=far_m)
            self.of_frames += light_figures(name, frame, luma, before=before)
            self.last[name] = (frame, luma)
        for pair in combinations(sorted(lumas), 2):
            is_copy = np.array_equal(lumas[pair[0]], lumas[pair[1]])
            self.copies.setdefault(pair, []).append(is_copy)
        if poses is not None:
            self._reproject(frame, depths, poses)
            bands = {place: band for place, (_, band) in self.seen.items()}
            self.alignment.take(frame, depths, bands, poses)

    def _must_differ(
        self, name: str, camera: int, frame: int, poses: CameraPoses | None, *, far_m: float
    ) -> tuple[int, Any] | None:
        """Return what a file showed last if its camera has moved since, so that it must differ."""
        before = self.last.get(name)
        if before is None or poses is None:
            return None
        moved_px = motion_px(
            poses, camera, (before[0], frame), intrinsics=self.intrinsics, far_m=far_m
        )
        return before if moved_px >= MOVED_SHARE * self.intrinsics.width_px else None

    def _see(self, frame: int) -> None:
        """Decode a frame's pictures and, of an inner one, its neighbours'; forget all others."""
        is_inner = 0 < frame < self.scene.frames - 1
        near = range(frame - is_inner, frame + is_inner + 1)
        self.seen = {place: each for place, each in self.seen.items() if place[1] in near}
        for place in product(range(CAMERA_COUNT), near):
            if place not in self.seen:
                picture = self.files.attempt(rgb_name(place[0]), self.files.picture, *place)
                if picture is not None:
                    luma = luma_of(picture)
                    self.seen[place] = luma, band_passed(luma)

    def _reproject(self, frame: int, depths: dict[int, MeasuredDepth], poses: CameraPoses) -> None:
        for (left, right), found in self.errors.items():
            if left in depths and right in depths:
                motion = poses.cam_from_cam(frame, target=right, source=left)
                both, camera = (depths[left], depths[right]), self.intrinsics
                found.append(reproject(*both, intrinsics=camera, right_from_left=motion))

    def _of_files(self) -> Iterator[Figure]:
        """Yield the worst figure of all frames of each file, and figures of whole files."""
        worst: dict[tuple[str, str], Figure] = {}
        for figure in self.of_frames:
            found = worst.setdefault((figure.quantity, figure.member), figure)
            if CHECKS[figure.quantity].worst(found.value, figure.value) != found.value:
                worst[figure.quantity, figure.member] = figure
        shows_much = {
            member for (quantity, member), figure in worst.items()
            if quantity == "contrast" and figure.value >= FLAT_SD
        }  # fmt: skip
        for (quantity, member), figure in worst.items():
            if quantity != "change" or member in shows_much:
                yield figure
        for camera in range(CAMERA_COUNT):
            name = depth_name(camera)
            valid = [each.value for each in self.of_frames
                     if (each.quantity, each.member) == ("valid_depth", name)]  # fmt: skip
            yield Figure("mean_valid_depth", name, float(np.mean(valid)) if valid else math.nan)
            yield from stored_figures(name, self.numbers[camera])
            yield Figure("depth_unit_m", name, self.files.encoding(camera).unit_m or math.nan)
        for (other, camera), copies in self.copies.items():
            if rgb_name(camera) in shows_much:
                where = f"as in {rgb_name(other)}"
                yield Figure("copied", rgb_name(camera), float(np.mean(copies)), where)
