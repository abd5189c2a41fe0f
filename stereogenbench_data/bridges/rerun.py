"""A scene for Rerun's viewer: cameras, pictures, depth and disparity over time.

    /scene                  a text: the scene's key, facts and caption
    /world                  x right, y down, z forward, metres; the origin is camera 0 in the first
                            frame that is shown
    /world/cam_00           Transform3D (world from camera) and Pinhole
    /world/cam_00/rgb       the picture
    /world/cam_00/depth     metres along the optical axis, 0 where not measured
    /pair/disparity         pixels of the pair's left view, 0 where not valid

The timeline ``frame`` counts frames, ``time`` tells their seconds. The principal point is that of
pixel centres at 0.5, which Rerun's pictures have; its cloud of depth lies half a pixel beside it.

Source: rerun-io/rerun, docs/snippets, crates/viewer/re_renderer/shader/depth_cloud.wgsl.
"""

import re
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Final

from stereogenbench_data.bridges.posed_images import (
    PosedImage,
    PosedImageReader,
    index_of,
    origin_at,
)
from stereogenbench_data.datasets.mapped import Data, StereoPairs
from stereogenbench_data.engine import Progress
from stereogenbench_data.errors import (
    ExtraError,
    SelectionError,
    explain_os_errors,
    missing_extra,
)
from stereogenbench_data.schema.records import DepthEncoding, Scene
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.schema.text import markdown_text
from stereogenbench_data.selection.filters import find_scene
from stereogenbench_data.selection.windows import FramesSpec, parse_frames
from stereogenbench_data.sources.files import open_output

USUAL_WIDTH_PX: Final = 512
"""How wide pictures are at most, unless a size is asked for."""

_JPEG_QUALITY: Final = 90
_OF_VIEWER: Final = re.compile(r"Viewer|gRPC")
"""What Rerun's errors name if its viewer does not start or does not answer."""


def write_recording(
    path: str | Path,
    data: Data,
    scene: str | None = None,
    *,
    progress: Progress | None = None,
    **options: Any,
) -> str:
    """Write a scene as an ``.rrd`` file, whole or not at all; return the scene's key.

    The recording is held in memory until it is written: some 100 MB for a scene of 81 frames at the
    usual width.

    Args:
        path: The file.
        data: What `StereoPairs` takes.
        scene: Key of the scene, or a part of it that no other has; None for the first.
        progress: Called with (frames done, frames in all).
        **options: pair, frames, size and depth, as for `log_scene`.

    Raises:
        ExtraError: If ``rerun-sdk`` is not installed.
        SelectionError: If there is no such scene, pair or frame.
        StorageError: If a file is missing or altered, or the recording cannot be written; a file
            that was there stays.
        MediaError: If a video does not decode to what the index says.
    """
    # Rerun's own writer of files may wait for ever once a disk is full.
    with _recording() as recording:
        stream = recording.binary_stream()
        key = log_scene(recording, data, scene, progress=progress, **options)
        content = stream.read() or b""
    cannot = f"{path}: cannot be written"
    with explain_os_errors(cannot, "Choose another place."), open_output(Path(path)) as file:
        file.write(content)
    return key


def view_live(
    data: Data, scene: str | None = None, *, progress: Progress | None = None, **options: Any
) -> str:
    """Open Rerun's viewer, or the one that is open, and send it a scene; return the scene's key.

    Args:
        data: As for `write_recording`.
        scene: As for `write_recording`.
        progress: As for `write_recording`.
        **options: As for `write_recording`.

    Raises:
        ExtraError: If ``rerun-sdk`` is not installed, or its viewer does not start.
        StereoGenBenchError: As `write_recording` does.
    """
    here = Path(sys.executable).with_name("rerun")
    viewer = str(here) if here.is_file() else None  # else it is looked for in PATH
    with _recording() as recording:
        try:
            _rerun().spawn(recording=recording, executable_path=viewer)
            return log_scene(recording, data, scene, progress=progress, **options)
        except RuntimeError as error:
            if not _OF_VIEWER.search(str(error)):
                raise
            reason = str(error).partition("\n")[0]
            raise ExtraError(
                f"Rerun's viewer cannot be reached ({reason}). Write an .rrd file instead, and "
                "open it where there is a screen."
            ) from error


def log_scene(  # noqa: PLR0913 - each names one thing that a user chooses
    recording: Any,
    data: Data,
    scene: str | None = None,
    *,
    pair: tuple[int, int] | None = None,
    frames: FramesSpec = "all",
    size: tuple[int, int] | str | None = None,
    depth: DepthEncoding | None = None,
    progress: Progress | None = None,
) -> str:
    """Log a scene into a recording of yours; return the scene's key.

    Args:
        recording: A ``rerun.RecordingStream``.
        data: What `StereoPairs` takes.
        scene: Key of the scene, or a part of it that no other has; None for the first.
        pair: Cameras (left, right) of the disparity, None for the pair that the scene records.
        frames: Which frames, but no clips.
        size: (height, width) in pixels, or a text WIDTHxHEIGHT; None for the stored size, or as
            much smaller as it takes to be at most `USUAL_WIDTH_PX` wide.
        depth: A depth contract instead of the one that files and release state.
        progress: Called with (frames done, frames in all).

    Raises:
        ExtraError: If ``rerun-sdk`` is not installed.
        SelectionError: If there is no such scene, pair or frame.
        StorageError: If a file is missing or altered.
        MediaError: If a video does not decode to what the index says.
    """
    rerun = _rerun()
    index = index_of(data)
    row = 0 if scene is None else find_scene(index, scene)
    facts = index.scene(row)
    if size is None:
        width, height = facts.rig.image_width_px, facts.rig.image_height_px
        shrunk = min(1.0, USUAL_WIDTH_PX / width)
        size = (max(1, round(height * shrunk)), max(1, round(width * shrunk)))
    pair = pair or facts.rig.primary_pair
    windows = parse_frames(frames)
    if windows.is_clip:
        raise SelectionError(f"frames={frames!r} are clips: give 'all', a step or numbers.")
    disparities = StereoPairs(
        index, scenes=facts.id.key, fields=("disparity", "frame_index"),
        pairs=[pair], frames=frames, size=size, depth=depth,
    )  # fmt: skip
    recording.log("world", rerun.ViewCoordinates.RDF, static=True)
    recording.send_blueprint(_blueprint(pair))
    shift = None
    with closing(PosedImageReader(index, size=size, depth=depth)) as reader, closing(disparities):
        for number in range(len(disparities)):
            sample = disparities[number]
            frame = int(sample["frame_index"])
            recording.set_time("frame", sequence=frame)
            recording.set_time("time", duration=frame / facts.frame_rate_hz)
            disparity = rerun.DepthImage(sample["disparity"][0].numpy(), colormap="turbo")
            recording.log("pair/disparity", disparity)
            for camera in range(CAMERA_COUNT):
                image = reader.read(row, camera, frame)
                if shift is None:
                    shift = origin_at(image)
                    about = _about(facts, pair=pair, origin_m=-shift[:3, 3])
                    text = rerun.TextDocument(about, media_type="text/markdown")
                    recording.log("scene", text, static=True)
                if number == 0:
                    lens = rerun.Pinhole(
                        image_from_camera=image.intrinsics,
                        resolution=image.size[::-1],
                        camera_xyz=rerun.ViewCoordinates.RDF,
                    )
                    recording.log(f"world/cam_{camera:02d}", lens, static=True)
                _log_view(rerun, recording, image.in_world(shift))
            recording.flush()
            if progress is not None:
                progress(number + 1, len(disparities))
    return facts.id.key


def _log_view(rerun: Any, recording: Any, image: PosedImage) -> None:
    place = f"world/cam_{image.camera:02d}"
    rotation, centre = image.world_from_cam[:3, :3], image.world_from_cam[:3, 3]
    recording.log(place, rerun.Transform3D(translation=centre, mat3x3=rotation))
    picture = rerun.Image(image.rgb).compress(jpeg_quality=_JPEG_QUALITY)
    recording.log(f"{place}/rgb", picture)
    recording.log(f"{place}/depth", rerun.DepthImage(image.depth_m, meter=1.0))


def _about(scene: Scene, *, pair: tuple[int, int], origin_m: Any) -> str:
    """Return what the viewer tells of a scene, as Markdown."""
    baseline_cm = scene.rig.baseline_cm(*pair)
    lines = [
        f"# {markdown_text(scene.id.key)}",
        f"- {scene.frames} frames at {scene.frame_rate_hz:g} Hz",
        f"- focal length {scene.rig.focal_mm:g} mm",
        f"- disparity of cameras {pair[0]}-{pair[1]}, baseline {baseline_cm:.2f} cm",
        f"- origin at {', '.join(f'{each:.6f}' for each in origin_m)} m of the scene's world",
    ]
    return "\n".join([*lines, "", markdown_text(scene.caption)])


def _blueprint(pair: tuple[int, int]) -> Any:
    """Return how the viewer arranges a scene."""
    import rerun.blueprint as layout

    left, right = (f"world/cam_{camera:02d}" for camera in pair)
    return layout.Blueprint(
        layout.Horizontal(
            layout.Spatial3DView(origin="world", name="cameras and depth"),
            layout.Vertical(
                layout.Spatial2DView(origin=f"{left}/rgb", name=f"camera {pair[0]}"),
                layout.Spatial2DView(origin=f"{right}/rgb", name=f"camera {pair[1]}"),
                layout.Spatial2DView(origin="pair/disparity", name="disparity, px"),
                layout.TextDocumentView(origin="scene", name="scene"),
            ),
            column_shares=[2, 1],
        ),
        collapse_panels=True,
    )


@contextmanager
def _recording() -> Iterator[Any]:
    """Yield a new recording, which is closed when the block ends."""
    recording = _rerun().RecordingStream("stereogenbench")
    try:
        yield recording
    finally:
        recording.disconnect()


def _rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise missing_extra("recordings for Rerun", "rerun", error) from error
    return rerun
