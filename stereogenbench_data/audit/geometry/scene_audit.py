"""The audit of one scene: each video is decoded once, forwards, and only at the audited frames.

A file that cannot be read does not stop the audit: it is noted, and the rest is measured.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Final, Literal, TypeVar

import numpy as np

from stereogenbench_data.audit.geometry.alignment import AlignmentCheck
from stereogenbench_data.audit.geometry.picture_check import (
    FLAT,
    MOVED_SHARE,
    LightCheck,
    PayloadCheck,
    band_passed,
    border_occluder,
    luma_of,
    reduced_size,
    subject_m,
)
from stereogenbench_data.audit.geometry.records import Figure, SceneAudit
from stereogenbench_data.audit.geometry.reprojection import (
    MeasuredDepth,
    PairErrors,
    pair_audit,
    reproject,
)
from stereogenbench_data.audit.geometry.rig_check import motion_px, rig_figures
from stereogenbench_data.engine import Advance
from stereogenbench_data.errors import MediaError, StereoGenBenchError, StorageError
from stereogenbench_data.geometry.camera import rig_intrinsics
from stereogenbench_data.geometry.pose import CameraPoses
from stereogenbench_data.index.evidence import poses_as
from stereogenbench_data.media.depth import NO_DEPTH_UNIT, depth_frame_index
from stereogenbench_data.media.video import probe
from stereogenbench_data.samples.streams import Streams
from stereogenbench_data.schema.conventions import depth_of
from stereogenbench_data.schema.document import parse_document
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
    """

    def __init__(self, scene: Scene, source: MemberSource, *, contract: DepthEncoding) -> None:
        """Prepare to read; nothing is opened yet."""
        self.problems: dict[str, str] = {}
        self.scene, self.source = scene, source
        self.contract = contract
        self.streams = Streams(self.source)
        self.intrinsics = rig_intrinsics(self.scene.rig)

    def attempt(
        self, name: str, read: Callable[..., Result], *args: Any, **kwargs: Any
    ) -> Result | None:
        """Return what ``read`` returns for a file, None if it or an earlier attempt failed."""
        if name in self.problems:
            return None
        try:
            return read(*args, **kwargs)
        except (StereoGenBenchError, OSError) as error:
            self.problems[name] = str(error)
            return None

    def text(self, name: str) -> bytes:
        """Return a metadata file's bytes."""
        self._require_member(name)
        return self.source.read(self.scene, name)

    def _require_member(self, name: str) -> None:
        if self.scene.held_name(name) not in self.scene.members:
            reason = self.scene.remark("videos" if name in VIDEO_FILES else "poses")
            raise StorageError(reason or "is missing: the index has no such file of this scene")

    def frames_of(self, name: str) -> int | None:
        """Return the number of frames of a video, None for one that does not open."""
        return self.attempt(name, self._probed, name, "later" if "rgb" in name else "needed")

    def _probed(self, name: str, pixel_format: Literal["needed", "later"]) -> int:
        self._require_member(name)
        held = self.scene.held_name(name)
        opened = self.source.open(self.scene, held)
        label = self.source.label(self.scene, held)
        try:
            return probe(opened, name=label, pixel_format=pixel_format).frames
        finally:
            close = getattr(opened, "close", None)
            if close is not None:
                close()

    def picture(self, camera: int, frame: int) -> Any:
        """Return a frame as (3, h, w) uint8, at the reduced size that the checks use."""
        rig = self.scene.rig
        size = reduced_size(rig.image_height_px, rig.image_width_px)
        return self.streams.rgb(self.scene, rgb_name(camera), frame, size=size)

    def depth(self, camera: int, frame: int) -> tuple[Any, MeasuredDepth] | None:
        """Return stored numbers and depth, None if the frame lag leaves the frame without depth."""
        encoding = self._encoding(camera)
        index = depth_frame_index(frame, encoding=encoding, frames=self.scene.frames)
        if index is None:
            return None
        stored = self.streams.read_stored_depth(
            self.scene, depth_name(camera), index, encoding=encoding
        )
        return stored.units, MeasuredDepth.of(
            stored.units, stored.measured, encoding=encoding, intrinsics=self.intrinsics
        )

    def _encoding(self, camera: int) -> DepthEncoding:
        encoding = self.scene.depth_encoding(camera, self.contract)
        if encoding.unit_m is None:
            raise MediaError(self.scene.remark("depth") or NO_DEPTH_UNIT)
        return encoding

    def unit_m(self, camera: int) -> float:
        """Return the metres in a stored unit of a camera's depth, nan if its tags contradict."""
        try:
            return self._encoding(camera).known_unit_m
        except MediaError:
            return math.nan


@dataclass(frozen=True, slots=True)
class AuditTask:
    """One scene to audit; can be sent to worker processes.

    Attributes:
        scene: The scene.
        source: Its files.
        frames: How many frames to audit, evenly spread; 0 for all.
        depth: The depth contract, None for what the files state.
    """

    scene: Scene
    source: MemberSource
    frames: int
    depth: DepthEncoding | None = None


def spread_frames(frames: int, wanted: int) -> tuple[int, ...]:
    """Return the numbers of ``wanted`` frames, evenly spread from first to last; 0 means all.

    >>> spread_frames(81, 5), spread_frames(2, 5)
    ((0, 20, 40, 60, 80), (0, 1))
    """
    if wanted == 0 or wanted >= frames:
        return tuple(range(frames))
    if wanted == 1:
        return (frames // 2,)
    return tuple(round(step * (frames - 1) / (wanted - 1)) for step in range(wanted))


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
        self.frames = spread_frames(self.scene.frames, task.frames)
        self.files = AuditedFiles(
            task.scene, task.source, contract=task.depth or depth_of(task.scene)
        )
        self.intrinsics = self.files.intrinsics
        self.light = [LightCheck() for _ in range(CAMERA_COUNT)]
        self.payload = [PayloadCheck() for _ in range(CAMERA_COUNT)]
        self.occluders = [Figure("occluder", depth_name(each)) for each in range(CAMERA_COUNT)]
        self.copies: dict[tuple[int, int], list[bool]] = {}
        self.errors: dict[tuple[int, int], list[PairErrors]] = {
            self.scene.rig.primary_pair: [], LONG_PAIR: [],
        }  # fmt: skip
        self.alignment = AlignmentCheck(self.intrinsics, frames=len(self.frames))
        self.seen: dict[tuple[int, int], tuple[Any, Any]] = {}

    def run(self, after_bytes: Advance) -> SceneAudit:
        """Audit the scene."""
        try:
            figures, poses = self._metadata()
            for name in VIDEO_FILES:
                count = self.files.frames_of(name)
                figures += [] if count is None else [Figure("frames", name, count)]
            before: int | None = None
            for frame in self.frames:
                self._frame(frame, before, poses)
                before = frame
                after_bytes(1)
        finally:
            self.files.streams.close()
        pairs = tuple(pair_audit(pair, found) for pair, found in self.errors.items())
        figures.append(Figure("reprojection_px", "", pairs[0].tolerances[-1].median_px))
        figures += self.alignment.figures()
        for camera in range(CAMERA_COUNT):
            figures += self._of_camera(camera)
        if stated_twice := self.scene.remark("left"):
            self.files.problems.setdefault(TRAJECTORY_JSON, stated_twice)
        return SceneAudit(
            key=self.scene.id.key,
            frames=self.scene.frames,
            audited_frames=self.frames,
            figures=tuple(figures),
            pairs=pairs,
            problems=dict(sorted(self.files.problems.items())),
        )

    def _metadata(self) -> tuple[list[Figure], CameraPoses | None]:
        documents = []
        poses: CameraPoses | None = None
        for name in (BASELINE_JSON, TRAJECTORY_JSON):
            text = self.files.attempt(name, self.files.text, name)
            if text is None:
                continue
            document = self.files.attempt(name, parse_document, text, where=name)
            documents += [document] if isinstance(document, dict) else []
            if name == TRAJECTORY_JSON:
                poses = self.files.attempt(name, poses_as, text, self.scene.pose_form, where=name)
        if poses is None:
            return [], None
        of_rig = rig_figures(self.scene.rig, poses, documents)
        figures = [Figure(quantity, "", value) for quantity, value in of_rig.items()]
        if poses.frame_count >= self.scene.frames:
            return figures, poses
        self.files.problems[TRAJECTORY_JSON] = (
            f"has poses of {poses.frame_count} frames, and the index says {self.scene.frames}"
        )
        return figures, None

    def _frame(self, frame: int, before: int | None, poses: CameraPoses | None) -> None:
        """Decode one frame of all cameras, and add it to the checks."""
        depths: dict[int, MeasuredDepth] = {}
        stored: dict[int, Any] = {}
        for camera in range(CAMERA_COUNT):
            name = depth_name(camera)
            read = self.files.attempt(name, self.files.depth, camera, frame)
            if read is not None:
                stored[camera], depths[camera] = read
        far_m = subject_m([(each.depth_m, each.measured) for each in depths.values()])
        pictures: dict[int, np.ndarray] = {}
        for camera in range(CAMERA_COUNT):
            # A camera that moved this far must show another picture.
            moved = (
                before is not None
                and poses is not None
                and motion_px(
                    poses, camera, (before, frame), intrinsics=self.intrinsics, far_m=far_m
                )
                >= MOVED_SHARE * self.intrinsics.width_px
            )
            depth = depths.get(camera)
            if depth is not None:
                share, side = border_occluder(depth.depth_m, depth.measured, far_m=far_m)
                if not share <= self.occluders[camera].value:
                    where = f"frame {frame}, {side or 'no'} border"
                    self.occluders[camera] = replace(
                        self.occluders[camera], value=share, where=where
                    )
                self.payload[camera].take(stored[camera], depth.measured, frame, moved=moved)
            picture = self._seen(camera, frame)
            if picture is not None:
                pictures[camera] = picture
                self.light[camera].take(picture, frame, moved=moved)
        for pair in combinations(pictures, 2):
            is_copy = np.array_equal(pictures[pair[0]], pictures[pair[1]])
            self.copies.setdefault(pair, []).append(is_copy)
        if poses is not None:
            self._reproject(frame, depths, poses)
            bands = {place: found[1] for place, found in self.seen.items()}
            self.alignment.take(frame, depths, bands, poses)

    def _seen(self, camera: int, frame: int) -> Any:
        """Return a picture, None if it cannot be read; its neighbours in time are kept with it."""
        near = [
            at for at in range(max(0, frame - 1), min(frame + 2, self.scene.frames))
            if at in self.frames or frame in self.frames[1::max(2, len(self.frames) - 3)]
        ]  # fmt: skip
        kept = {at: self.seen.get((camera, at)) for at in near}
        self.seen = {place: each for place, each in self.seen.items() if place[0] != camera}
        for at in near:
            found = kept[at]
            if found is None:
                picture = self.files.attempt(rgb_name(camera), self.files.picture, camera, at)
                found = None if picture is None else (picture, band_passed(luma_of(picture)))
            if found is not None:
                self.seen[camera, at] = found
        shown = self.seen.get((camera, frame))
        return None if shown is None else shown[0]

    def _reproject(self, frame: int, depths: dict[int, MeasuredDepth], poses: CameraPoses) -> None:
        for (left, right), found in self.errors.items():
            if left in depths and right in depths:
                motion = poses.cam_from_cam(frame, target=right, source=left)
                both, camera = (depths[left], depths[right]), self.intrinsics
                found.append(reproject(*both, intrinsics=camera, right_from_left=motion))

    def _of_camera(self, camera: int) -> Iterator[Figure]:
        light, rgb, depth = self.light[camera], rgb_name(camera), depth_name(camera)
        yield from light.figures(rgb)
        yield from self.payload[camera].figures(depth)
        yield self.occluders[camera]
        yield Figure("depth_unit_m", depth, self.files.unit_m(camera))
        shares = {
            other: float(np.mean(same)) for (other, copy), same in self.copies.items()
            if copy == camera and light.contrast.value >= FLAT
        }  # fmt: skip
        if shares:
            other = max(shares, key=lambda other: shares[other])
            yield Figure("copied", rgb, shares[other], f"as in {rgb_name(other)}")
