"""The two videos of a camera: H.264 pictures and FFV1 depth.

One thread encodes, and the bytes depend only on frames and options, so the same frames give the
same bytes on any number of processors.
"""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import av
import numpy as np
from jaxtyping import Float64, UInt16

from stereogenbench_data.media.depth_packing import grey_frame
from stereogenbench_data.media.encoder import VideoWriter
from stereogenbench_data.schema.release import FRAME_RATE_HZ, depth_name, rgb_name
from stereogenbench_data.synthesis.checks import CameraStatistics, FrameStatistics
from stereogenbench_data.synthesis.filters import Limits
from stereogenbench_data.synthesis.plan import ScenePlan
from stereogenbench_data.synthesis.renderer import Renderer
from stereogenbench_data.synthesis.request import LARGEST_UNITS, ExportContract

_H264: Final = {"crf": "18", "x264-params": "cpu-independent=1"}
DEPTH_FORMAT: Final = "gray16le"
"""FFV1's pixel format of depth."""
_FFV1: Final = {"level": "3", "slices": "4", "slicecrc": "1"}


def write_cameras(
    plan: ScenePlan,
    *,
    renderer: Renderer,
    cameras: tuple[int, ...],
    folder: Path,
    limits: Limits,
    after_frame: Callable[[], None],
) -> list[CameraStatistics]:
    """Write the two videos of some cameras into a folder, and return what they look like.

    Args:
        plan: The scene.
        renderer: What draws it.
        cameras: Numbers of the cameras.
        folder: Where the videos go.
        limits: Limits of near occluders and of depth.
        after_frame: Called after each frame of each camera; an exception from it ends the work.
    """
    contract = plan.request.contract
    statistics = [FrameStatistics(plan, camera=camera, limits=limits) for camera in cameras]
    with ExitStack() as stack:
        videos = [
            (
                stack.enter_context(picture_video(folder / rgb_name(camera))),
                stack.enter_context(depth_video(folder / depth_name(camera), contract)),
            )
            for camera in cameras
        ]
        views = renderer.views(plan, cameras=cameras)
        for _ in range(plan.request.frames):
            for (rgb, depth), seen in zip(videos, statistics, strict=True):
                view = next(views)
                shown = av.VideoFrame.from_ndarray(view.picture, format="rgb24")
                rgb.write(shown.reformat(format="yuv420p", threads=1))
                units = depth_units(view.depth_m, unit_m=contract.depth_unit_m)
                depth.write(grey_frame(units, pixel_format=DEPTH_FORMAT))
                seen.add(view)
                after_frame()
    return [seen.check() for seen in statistics]


def picture_video(path: Path) -> VideoWriter:
    """Begin a camera's video of pictures."""
    return VideoWriter(path, container="mp4", codec="libx264", rate_hz=FRAME_RATE_HZ, options=_H264)


def depth_video(path: Path, contract: ExportContract) -> VideoWriter:
    """Begin a camera's video of depth, tagged with its unit where the contract says so."""
    tag = contract.depth_tag
    tags = None if tag is None else {tag: repr(contract.depth_unit_m)}
    return VideoWriter(
        path,
        container="matroska",
        codec="ffv1",
        rate_hz=FRAME_RATE_HZ,
        options=_FFV1,
        tags=tags,
    )


def depth_units(depth_m: Float64[np.ndarray, "h w"], *, unit_m: float) -> UInt16[np.ndarray, "h w"]:
    """Return depth in stored units: rounded, and limited to the largest number."""
    return np.minimum(np.rint(depth_m / unit_m), LARGEST_UNITS).astype(np.uint16)
