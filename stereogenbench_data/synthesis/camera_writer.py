"""The two videos of a camera: H.264 pictures and FFV1 depth.

One thread encodes, and the bytes depend only on frames and options, so the same frames give the
same bytes on any number of processors.
"""

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Final, cast

import av
import numpy as np
from av.video.stream import VideoStream
from jaxtyping import Float64, UInt16

from stereogenbench_data.media.depth_packing import grey_frame
from stereogenbench_data.schema.release import FRAME_RATE_HZ, depth_name, rgb_name
from stereogenbench_data.synthesis.plan import ScenePlan
from stereogenbench_data.synthesis.ray_casting import View
from stereogenbench_data.synthesis.render import (
    SceneState,
    render_depth,
    render_frame,
    static_light,
)
from stereogenbench_data.synthesis.request import ExportContract

_LARGEST: Final = {"gray16le": 65535, "gray12le": 4095, "gray10le": 1023}
_RATE_HZ: Final = int(FRAME_RATE_HZ)
_OPTIONS: Final = {
    "libx264": {"crf": "18", "x264-params": "cpu-independent=1"},
    "ffv1": {"level": "3", "slices": "4", "slicecrc": "1"},
}


def write_camera(
    plan: ScenePlan, *, camera: int, folder: Path, after_frame: Callable[[], None]
) -> None:
    """Write a camera's two videos into a folder.

    ``after_frame`` is called after each frame; an exception from it ends the work.
    """
    contract, size_px = plan.request.contract, plan.request.picture_px
    tag = contract.depth_tag
    light = static_light(plan.scene)

    def moment(frame: int) -> tuple[SceneState, View]:
        state = SceneState(plan.scene, moment_s=plan.moment_s(frame), static_light=light)
        return state, plan.view(camera=camera, frame=frame)

    with (
        VideoWriter(
            folder / rgb_name(camera), size_px=size_px, codec="libx264", pixel_format="yuv420p"
        ) as rgb,
        VideoWriter(
            folder / depth_name(camera),
            size_px=size_px,
            codec="ffv1",
            pixel_format=contract.depth_format,
            tags=None if tag is None else {tag: repr(contract.depth_unit_m)},
        ) as depth,
    ):
        for frame in range(plan.request.frames):
            state, view = moment(frame)
            picture, depth_m = render_frame(state, view=view)
            shown = av.VideoFrame.from_ndarray(picture, format="rgb24")
            rgb.write(shown.reformat(format="yuv420p", threads=1))
            if contract.frame_lag:
                state, view = moment(frame - contract.frame_lag)
                depth_m = render_depth(state, view=view)
            units = depth_units(depth_m, view=view, contract=contract)
            depth.write(grey_frame(units, pixel_format=contract.depth_format))
            after_frame()


class VideoWriter:
    """A video to write, as a context manager; the file is complete after an exit without error."""

    def __init__(
        self,
        path: Path,
        *,
        size_px: tuple[int, int],
        codec: str,
        pixel_format: str,
        tags: dict[str, str] | None = None,
    ) -> None:
        self._container = av.open(path, "w", container_options={"fflags": "+bitexact"})
        self._container.metadata.update(tags or {})
        self._stream = cast(
            VideoStream, self._container.add_stream(codec, rate=_RATE_HZ, options=_OPTIONS[codec])
        )
        self._stream.width, self._stream.height = size_px
        self._stream.pix_fmt = pixel_format
        self._stream.codec_context.thread_count = 1
        self._frames = 0

    def write(self, frame: av.VideoFrame) -> None:
        """Append a frame."""
        frame.pts, frame.time_base = self._frames, Fraction(1, _RATE_HZ)
        self._frames += 1
        self._container.mux(self._stream.encode(frame))

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if error is None:
                self._container.mux(self._stream.encode(None))
        finally:
            self._container.close()


def depth_units(
    depth_m: Float64[np.ndarray, "h w"], *, view: View, contract: ExportContract
) -> UInt16[np.ndarray, "h w"]:
    """Return depth in stored units: rounded, and limited to the largest number of the format."""
    if contract.depth_kind == "ray":
        width_px, height_px = view.size_px
        right = view.right_of_axis(np.arange(width_px) + 0.5)
        below = view.below_axis(np.arange(height_px)[:, None] + 0.5)
        depth_m = depth_m * np.sqrt(1 + right**2 + below**2)
    largest = _LARGEST[contract.depth_format]
    return np.minimum(np.rint(depth_m / contract.depth_unit_m), largest).astype(np.uint16)
