"""Checks of rendered scenes, before they take their place among accepted ones."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import av
import numpy as np

from stereogenbench_data.audit.contract.doctor import diagnose
from stereogenbench_data.audit.geometry.audit import AuditRequest, audit, open_for_audit
from stereogenbench_data.errors import StereoGenBenchError
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.schema.release import CAMERA_COUNT, depth_name, rgb_name
from stereogenbench_data.synthesis.filters import Limits, Reason, Refusal
from stereogenbench_data.synthesis.plan import ScenePlan
from stereogenbench_data.synthesis.renderer import RenderedView

_THIN: Final = 4
"""Brightness is measured on every fourth row and column."""
_BORDER_PART: Final = 0.02
_LUMA: Final = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True, slots=True)
class CameraStatistics:
    """What a camera's frames looked like while they were written.

    Attributes:
        camera: Its number.
        invalid_share: Share of its pixels without depth, over all frames.
        dark_mean: The mean brightness of its darkest frame, of 255.
        flat_sd: The least standard deviation of the brightness of a frame.
        border_share: The largest share of a frame's border that near occluders cover.
    """

    camera: int
    invalid_share: float
    dark_mean: float
    flat_sd: float
    border_share: float


class FrameStatistics:
    """Adds up the frames of a camera to a `CameraStatistics`."""

    def __init__(self, plan: ScenePlan, *, camera: int, limits: Limits) -> None:
        self._plan, self._camera, self._limits = plan, camera, limits
        self._rows: list[tuple[float, float, float, float]] = []

    def add(self, view: RenderedView) -> None:
        """Measure the next frame."""
        subject_m = self._plan.subject_m[len(self._rows)]
        brightness = view.picture[::_THIN, ::_THIN].astype(np.float32) @ _LUMA
        height, width = view.depth_m.shape
        rim = max(1, round(_BORDER_PART * min(height, width)))
        border = [
            view.depth_m[:rim].ravel(),
            view.depth_m[-rim:].ravel(),
            view.depth_m[:, :rim].ravel(),
            view.depth_m[:, -rim:].ravel(),
        ]
        near = np.concatenate(border) < self._limits.near_share * subject_m
        self._rows.append(
            (
                float((view.depth_m >= self._limits.farthest_m).mean()),
                float(brightness.mean()),
                float(brightness.std()),
                float(near.mean()),
            )
        )

    def check(self) -> CameraStatistics:
        """Return what the frames so far looked like."""
        invalid, mean, sd, near = np.array(self._rows).T
        return CameraStatistics(
            self._camera,
            float(invalid.mean()),
            float(mean.min()),
            float(sd.min()),
            float(near.max()),
        )


def check_pictures(checks: Sequence[CameraStatistics], *, limits: Limits) -> Refusal | None:
    """Return why the pictures or depths of a scene are refused, if they are."""
    for each in sorted(checks, key=lambda check: check.camera):
        found: list[tuple[Reason, float, float, bool, str]] = [
            ("invalid_depth", each.invalid_share, limits.invalid_share, True,
             f"{each.invalid_share:.0%} of its pixels have no depth"),
            ("dark", each.dark_mean, limits.dark_mean, False,
             f"a frame has the mean brightness {each.dark_mean:.3g} of 255"),
            ("flat", each.flat_sd, limits.flat_sd, False,
             f"the brightness of a frame varies by {each.flat_sd:.3g} of 255"),
            ("border_occluder", each.border_share, limits.border_share, True,
             f"near things cover {each.border_share:.0%} of a frame's border"),
        ]  # fmt: skip
        for reason, value, limit, is_most, text in found:
            if (value > limit) if is_most else (value < limit):
                return Refusal(reason, value, limit, f"camera {each.camera}: {text}")
    return None


def check_files(folder: Path, *, frames: int) -> Refusal | None:
    """Return which video of a scene lacks frames, if one does."""
    for camera in range(CAMERA_COUNT):
        for name in (rgb_name(camera), depth_name(camera)):
            try:
                with av.open(folder / name) as container:
                    found = sum(packet.size > 0 for packet in container.demux(video=0))
            except (OSError, IndexError, av.error.FFmpegError):
                found = 0
            if found != frames:
                return Refusal(
                    "missing_frames", found, frames, f"{name}: {found} of {frames} frames"
                )
    return None


def check_scene(root: Path, *, key: str, unit_m: float) -> Refusal | None:
    """Return what the audit or the doctor finds in a complete scene, if they find something.

    Args:
        root: The root of a tree with the scene.
        key: The scene's whole path below it.
        unit_m: Metres in one stored unit of its depth.
    """
    depth = DepthEncoding(unit_m=unit_m)
    try:
        index = open_for_audit(root, workers=1, scenes=(key,))
        report = audit(index, AuditRequest(depth=depth), workers=1, scenes=(key,))
        diagnosis = diagnose(index, scenes=1, depth=depth, workers=1, filters={"scenes": (key,)})
    except StereoGenBenchError as error:
        return Refusal("audit", 1, 0, str(error))
    if report.findings:
        first = report.findings[0]
        text = f"{first.member}: {first.check}: {first.found}"
        return Refusal("audit", len(report.findings), 0, text)
    if diagnosis.is_wrong:
        problems = [text for verdict in diagnosis.verdicts for text in verdict.problems]
        return Refusal("doctor", len(problems), 0, "; ".join(problems))
    return None
