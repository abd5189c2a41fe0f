"""Export scenes to what reads several views: COLMAP, nerfstudio and gsplat, PLY, MoGe.

    OUT/export.json                            the layout and the settings, the same for all of OUT
    OUT/<key of a scene>/frame_000/...         the views of one moment
    OUT/<key of a scene>/...                   with ``group="scene"``: those of all chosen frames
    OUT/.index.txt                             of MoGe: its folders

Each of these folders is written beside its place and renamed, so that a stopped run goes on and a
killed one leaves nothing that is incomplete. `view_formats` has what is in them.
"""

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal, Unpack, get_args

from stereogenbench_data.bridges.exports import alone, scene_filters, training_selection
from stereogenbench_data.bridges.posed_images import PosedImageReader, index_of
from stereogenbench_data.bridges.view_formats import INDEX_TXT, WRITERS, Layout
from stereogenbench_data.datasets.mapped import Data
from stereogenbench_data.engine import LOCAL, Advance, Engine, Progress
from stereogenbench_data.errors import SelectionError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.jobs import atomic_folder, do_items, job_folder, named_errors
from stereogenbench_data.samples.checks import check_samples
from stereogenbench_data.schema.conventions import depth_of
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.selection.filters import SceneFilters
from stereogenbench_data.selection.options import require_options
from stereogenbench_data.selection.plan import plan_views
from stereogenbench_data.selection.windows import FramesSpec
from stereogenbench_data.sources.files import write_atomic

Group = Literal["moment", "scene"]

USUAL_POINTS: Final[dict[str, int]] = {"colmap": 5_000, "transforms": 5_000, "ply": 100_000}
"""How many points are taken from each picture, unless another number is asked for."""


class ViewExportOptions(SceneFilters, total=False):
    """Which scenes and views are exported, and how.

    Attributes:
        group: "moment" (the default): a folder for each frame, in which nothing moves; "scene": one
            for all the chosen frames, between which characters move.
        cameras: Numbers of cameras, or "all" (the default).
        frames: As for `StereoPairs`, but no clips.
        size: (height, width) in pixels, or a text WIDTHxHEIGHT; None for the stored size.
        points: How many points are taken from each picture, "all" for every measured pixel; None
            for `USUAL_POINTS`.
        depth: A depth contract instead of the one that files and release state.
        workers: How many processes, None for one a core.
        engine: Where they are: `engine.LOCAL`, or an `engine.RayCluster`.
        progress: Called with (pictures done, pictures in all).
    """

    group: Group
    cameras: Sequence[int] | Literal["all"]
    frames: FramesSpec
    size: tuple[int, int] | str | None
    points: int | Literal["all"] | None
    depth: DepthEncoding | None
    workers: int | None
    engine: Engine
    progress: Progress | None


def export_views(
    data: Data, out: str | Path, *, layout: Layout, **options: Unpack[ViewExportOptions]
) -> list[Path]:
    """Export views of scenes, and return the folders that hold them, in the order of the scenes.

    Evaluation scenes are exported only where ``split`` names them. What was exported before is
    kept, so that a stopped run goes on.

    Args:
        data: What `StereoPairs` takes.
        out: The folder to write into.
        layout: "colmap": COLMAP's text model, which gsplat reads too; "transforms": nerfstudio's
            ``transforms.json``; "ply": point clouds; "moge": the training folders of MoGe.
        **options: Which scenes and views, and how (`ViewExportOptions`).

    Raises:
        SelectionError: If nothing matches the selection, or an option is not one.
        FieldError: If the size is not one.
        StorageError: If the folder holds another export, another process exports into it, or
            something cannot be read or written.
        MediaError: If depth cannot have been stored whole, or a video does not decode.
    """
    require_options(export_views, options)
    root, group = Path(out), options.get("group", "moment")
    _require_layout(layout, group)
    points = _points(layout, options.get("points"))
    size, depth = options.get("size"), options.get("depth")
    index = index_of(data)
    filters = scene_filters(training_selection(index, options)[0])
    frames = options.get("frames", "first")
    plan = plan_views(
        index, cameras=options.get("cameras", "all"), frames=frames, seed=0, filters=filters
    )
    if plan.windows.is_clip:
        raise SelectionError(
            f"frames={frames!r} are clips: exports take 'all', 'first', ('every', k) or numbers of "
            "frames; group='scene' puts the chosen frames of a scene together."
        )
    request = PosedImageReader(index, size=size, depth=depth).request
    check_samples(index, plan, request)
    folders: dict[Path, tuple[int, tuple[int, ...]]] = {}
    for number in range(len(plan)):
        address = plan.locate(number, epoch=0)
        folder = root / index.scene(address.row).id.key
        if group == "moment":
            folder /= f"frame_{address.frames[0]:03d}"
        chosen = (*folders.get(folder, (0, ()))[1], *address.frames)
        folders[folder] = (address.row, chosen)
    cameras = (address.source, *address.targets)
    split = filters["split"]
    settings: dict[str, Any] = {
        "layout": layout,
        "split": sorted([split] if isinstance(split, str) else split or ()),
        "group": group,
        "cameras": cameras,
        "size": request.size,
        "points": points,
        "depth": depth
        and asdict(depth) | {"no_depth": depth.no_depth, "accept": sorted(depth.accept)},
        "data": index.digest,
    }
    if group == "scene":
        settings["frames"] = sorted({chosen for _, chosen in folders.values()})
    with job_folder(root, settings):
        missing: dict[int, dict[Path, tuple[int, ...]]] = {}
        for folder, (row, chosen) in folders.items():
            if not folder.is_dir():
                missing.setdefault(row, {})[folder] = chosen
        works = [
            _SceneWork(alone(index, row), found, layout, cameras, request.size, depth, points)
            for row, found in missing.items()
        ]
        total = len(cameras) * sum(len(chosen) for _, chosen in folders.values())
        do_items(
            _export_scene,
            works,
            name=lambda work: str(work.index.column("key")[0]),
            workers=options.get("workers"),
            engine=options.get("engine", LOCAL),
            progress=options.get("progress"),
            done=total - sum(work.pictures for work in works),
            total=total,
        )
        if layout == "moge":
            with named_errors(root):
                _list_pictures(root, [*folders], cameras)
    return [*folders]


def _require_layout(layout: Layout, group: Group) -> None:
    if layout not in WRITERS:
        known = ", ".join(map(repr, WRITERS))
        raise SelectionError(f"layout must be one of {known}, got {layout!r}.")
    if group not in get_args(Group):
        raise SelectionError(f"group must be 'moment' or 'scene', got {group!r}.")
    if layout == "moge" and group != "moment":
        raise SelectionError(f"layout='moge' has no group={group!r}: leave it out.")


def _points(layout: Layout, points: Any) -> int | None:
    """Return how many points are taken from each picture, None for all."""
    if layout == "moge":
        if points is not None:
            raise SelectionError(f"layout='moge' has no points={points!r}: leave them out.")
        return None
    if points == "all":
        return None
    points = USUAL_POINTS[layout] if points is None else points
    if isinstance(points, bool) or not isinstance(points, int) or points < 1:
        raise SelectionError(f"points must be a number from 1, or 'all', got {points!r}.")
    return points


@dataclass(frozen=True, slots=True)
class _SceneWork:
    """The folders of one scene that are yet to be written, with the frames of each.

    Attributes:
        index: An index of the scene alone.
        frames_of: The frames of each folder.
        layout: The format.
        cameras: Numbers of cameras.
        size: (height, width) in pixels, None for the stored size.
        depth: A depth contract instead of the one that files and release state.
        points: How many points are taken from each picture, None for all.
    """

    index: SceneIndex
    frames_of: Mapping[Path, tuple[int, ...]]
    layout: Layout
    cameras: tuple[int, ...]
    size: tuple[int, int] | str | None
    depth: DepthEncoding | None
    points: int | None

    @property
    def pictures(self) -> int:
        return len(self.cameras) * sum(map(len, self.frames_of.values()))


def _export_scene(work: _SceneWork, advance: Advance) -> None:
    """Write the missing folders of one scene, each whole or not at all."""
    scene = work.index.scene(0)
    encodings = {
        camera: scene.depth_encoding(camera, work.depth or depth_of(scene))
        for camera in work.cameras
    }
    with closing(PosedImageReader(work.index, size=work.size, depth=work.depth)) as reader:
        for folder, frames in work.frames_of.items():
            with named_errors(folder), atomic_folder(folder) as unfinished:
                writer = WRITERS[work.layout](unfinished, points=work.points, encodings=encodings)
                for frame in frames:
                    writer.add([reader.read(0, camera, frame) for camera in work.cameras])
                    advance(len(work.cameras))
                writer.finish()


def _list_pictures(root: Path, folders: Sequence[Path], cameras: Sequence[int]) -> None:
    """Write MoGe's list of folders: those of this export, and those that it named before."""
    path = root / INDEX_TXT
    lines = {
        f"{folder.relative_to(root).as_posix()}/cam_{camera:02d}"
        for folder in folders
        for camera in cameras
    }
    if path.is_file():
        lines.update(path.read_text(encoding="utf-8").splitlines())
    write_atomic(path, "".join(f"{line}\n" for line in sorted(lines)).encode())
