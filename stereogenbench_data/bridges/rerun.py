"""A scene for Rerun's viewer: cameras, pictures, depth and disparity over time.

    /scene                  a text: the scene's key and caption
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

from contextlib import closing
from pathlib import Path
from typing import Any, Final

from stereogenbench_data.bridges.multiview import VIEW_FIELDS, origin_at, posed_images
from stereogenbench_data.datasets.mapped import Data, SceneViews, StereoPairs
from stereogenbench_data.engine import Progress
from stereogenbench_data.errors import (
    SelectionError,
    explain_os_errors,
    needs_extra,
)
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.schema.text import markdown_text
from stereogenbench_data.selection.filters import find_scene
from stereogenbench_data.selection.plan import FramesSpec
from stereogenbench_data.sources.files import open_output

USUAL_WIDTH_PX: Final = 512
"""How wide pictures are at most, unless a size is asked for."""

_JPEG_QUALITY: Final = 90


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
    with _rerun().RecordingStream("stereogenbench") as recording:
        stream = recording.binary_stream()
        key = log_scene(recording, data, scene, progress=progress, **options)
        content = stream.read() or b""
    cannot = f"{path}: cannot be written"
    with explain_os_errors(cannot, "Choose another place."), open_output(Path(path)) as file:
        file.write(content)
    return key


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
        depth: A depth encoding instead of the one that files and release state.
        progress: Called with (frames done, frames in all).

    Raises:
        ExtraError: If ``rerun-sdk`` is not installed.
        SelectionError: If there is no such scene, pair or frame.
        StorageError: If a file is missing or altered.
        MediaError: If a video does not decode to what the index says.
    """
    rerun = _rerun()
    index = data if isinstance(data, SceneIndex) else SceneIndex.open(data)
    facts = index.scene(0 if scene is None else find_scene(index, scene))
    key, rig = facts.id.key, facts.rig
    if size is None:
        shrunk = min(1.0, USUAL_WIDTH_PX / rig.image_width_px)
        sides = (rig.image_height_px, rig.image_width_px)
        size = (max(1, round(sides[0] * shrunk)), max(1, round(sides[1] * shrunk)))
    read: dict[str, Any] = {"scenes": key, "frames": frames, "size": size, "depth": depth}
    views = SceneViews(index, fields=VIEW_FIELDS, **read)
    pairs = StereoPairs(index, pairs=[pair or rig.primary_pair], fields=("disparity",), **read)
    if views.plan.windows.is_clip:
        raise SelectionError(f"frames={frames!r} are clips: give 'all', a step or numbers.")
    recording.log("world", rerun.ViewCoordinates.RDF, static=True)
    about = f"# {markdown_text(key)}\n\n{markdown_text(facts.caption)}"
    recording.log("scene", rerun.TextDocument(about, media_type="text/markdown"), static=True)
    shift = None
    with closing(views), closing(pairs):
        for number in range(len(views)):
            images = posed_images(views[number])
            shift = origin_at(images[0]) if shift is None else shift
            recording.set_time("frame", sequence=images[0].frame)
            recording.set_time("time", duration=images[0].frame / facts.frame_rate_hz)
            disparity = pairs[number]["disparity"][0].numpy()
            recording.log("pair/disparity", rerun.DepthImage(disparity, colormap="turbo"))
            for image in images:
                place, pose = f"world/cam_{image.camera:02d}", image.in_world(shift).world_from_cam
                if number == 0:
                    lens = rerun.Pinhole(
                        image_from_camera=image.intrinsics,
                        resolution=image.size[::-1],
                        camera_xyz=rerun.ViewCoordinates.RDF,
                    )
                    recording.log(place, lens, static=True)
                recording.log(
                    place, rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])
                )
                picture = rerun.Image(image.rgb).compress(jpeg_quality=_JPEG_QUALITY)
                recording.log(f"{place}/rgb", picture)
                recording.log(f"{place}/depth", rerun.DepthImage(image.depth_m, meter=1.0))
            recording.flush()
            if progress is not None:
                progress(number + 1, len(views))
    return key


def _rerun() -> Any:
    with needs_extra("recordings for Rerun", "rerun"):
        import rerun
    return rerun
