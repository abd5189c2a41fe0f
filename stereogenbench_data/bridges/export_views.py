"""Export scenes to what reads several views: COLMAP, nerfstudio and gsplat, PLY, MoGe.

    OUT/export.json                            the layout and the settings, the same for all of OUT
    OUT/<key of a scene>/frame_000/...         the views of one moment
    OUT/<key of a scene>/...                   with ``group="scene"``: those of all chosen frames
    OUT/.index.txt                             of MoGe: its folders

Each of these folders is written beside its place and renamed, so that a stopped run goes on and a
killed one leaves nothing that is incomplete. `view_formats` has what is in them.
"""

import json
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal, Unpack, get_args

from stereogenbench_data.bridges.posed_images import PosedImageReader, index_of, training_filters
from stereogenbench_data.bridges.view_formats import (
    INDEX_TXT,
    ColmapWriter,
    MogeWriter,
    PlyWriter,
    TransformsWriter,
    ViewWriter,
)
from stereogenbench_data.datasets.mapped import Data
from stereogenbench_data.engine import LOCAL, Advance, Progress, advance_of
from stereogenbench_data.errors import SelectionError, StorageError, describe_os_error
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.checks import check_samples
from stereogenbench_data.schema.conventions import depth_of
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.selection.filters import SceneFilters
from stereogenbench_data.selection.options import require_options
from stereogenbench_data.selection.plan import plan_views
from stereogenbench_data.selection.windows import FramesSpec
from stereogenbench_data.sources.files import try_locked, write_atomic

Layout = Literal["colmap", "transforms", "ply", "moge"]
Group = Literal["moment", "scene"]

EXPORT_JSON: Final = "export.json"
USUAL_POINTS: Final[dict[str, int]] = {"colmap": 5_000, "transforms": 5_000, "ply": 100_000}
"""How many points are taken from each picture, unless another number is asked for."""

_LOCK: Final = ".lock"
_ELSEWHERE: Final = "Choose another folder."


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
        progress: Called with (pictures done, pictures in all).
    """

    group: Group
    cameras: Sequence[int] | Literal["all"]
    frames: FramesSpec
    size: tuple[int, int] | str | None
    points: int | Literal["all"] | None
    depth: DepthEncoding | None
    workers: int | None
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
    root, selected = Path(out), _Selected(layout, options)
    index = index_of(data)
    frames_of = selected.frames_of(index)
    _begin(root, selected.description(index, frames_of))
    folders = {
        folder: (row, chosen)
        for row, frames in frames_of.items()
        for folder, chosen in selected.folders_of(root / index.scene(row).id.key, frames).items()
    }
    with try_locked(root / _LOCK) as is_ours:
        if not is_ours:
            raise StorageError(
                f"{root}: another process exports into this folder. Wait for it, or choose another "
                "folder."
            )
        missing: dict[int, dict[Path, tuple[int, ...]]] = {}
        for folder, (row, chosen) in folders.items():
            if not folder.is_dir():
                missing.setdefault(row, {})[folder] = chosen
        works = [_SceneWork(_alone(index, row), found, selected) for row, found in missing.items()]
        total = len(selected.cameras) * sum(len(chosen) for _, chosen in folders.values())
        done = total - sum(work.pictures for work in works)
        advance = advance_of(selected.progress, done=done, total=total)
        selected.progress = None  # it stays here, the rest goes to other processes
        advance(0)
        with closing(
            LOCAL.map(
                _export_scene,
                works,
                name=lambda work: str(work.index.column("key")[0]),
                workers=selected.workers,
                advance=advance,
            )
        ) as exported:
            for _ in exported:
                advance(0)
        if layout == "moge":
            _list_pictures(root, folders, selected.cameras)
    return [*folders]


class _Selected:
    """What is exported and how, with the defaults of what was not said.

    Attributes:
        cameras: Numbers, or "all" until `frames_of` was called.
        points: How many points are taken from each picture, None for all.
    """

    def __init__(self, layout: Layout, options: Mapping[str, Any]) -> None:
        if layout not in get_args(Layout):
            known = ", ".join(map(repr, get_args(Layout)))
            raise SelectionError(f"layout must be one of {known}, got {layout!r}.")
        rest = dict(options)
        self.layout: Layout = layout
        self.group: Group = rest.pop("group", "moment")
        if self.group not in get_args(Group):
            raise SelectionError(f"group must be 'moment' or 'scene', got {self.group!r}.")
        self.points = _points(layout, rest.pop("points", None))
        if layout == "moge" and self.group != "moment":
            raise SelectionError(f"layout='moge' has no group={self.group!r}: leave it out.")
        self.cameras: Any = rest.pop("cameras", "all")
        self.frames: Any = rest.pop("frames", "first")
        self.size: Any = rest.pop("size", None)
        self.depth: DepthEncoding | None = rest.pop("depth", None)
        self.workers: int | None = rest.pop("workers", None)
        self.progress: Progress | None = rest.pop("progress", None)
        self.filters: Any = rest

    def frames_of(self, index: SceneIndex) -> dict[int, tuple[int, ...]]:
        """Return the frames of each selected row, after checking that they can be exported."""
        self.filters = training_filters(index, self.filters)
        plan = plan_views(
            index, cameras=self.cameras, frames=self.frames, seed=0, filters=self.filters
        )
        if plan.windows.is_clip:
            raise SelectionError(
                f"frames={self.frames!r} are clips: exports take 'all', 'first', ('every', k) or "
                "numbers of frames; group='scene' puts the chosen frames of a scene together."
            )
        request = PosedImageReader(index, size=self.size, depth=self.depth).request
        check_samples(index, plan, request)
        self.size = request.size
        found: dict[int, tuple[int, ...]] = {}
        for number in range(len(plan)):
            address = plan.locate(number, epoch=0)
            self.cameras = (address.source, *address.targets)
            found[address.row] = (*found.get(address.row, ()), *address.frames)
        return found

    def folders_of(self, place: Path, frames: tuple[int, ...]) -> dict[Path, tuple[int, ...]]:
        """Return the folders of a scene, with the frames of each."""
        if self.group == "scene":
            return {place: frames}
        return {place / f"frame_{frame:03d}": (frame,) for frame in frames}

    def description(
        self, index: SceneIndex, frames_of: Mapping[int, tuple[int, ...]]
    ) -> dict[str, Any]:
        """Return what all of a folder has in common, as JSON holds it."""
        split, depth = self.filters["split"], None
        if self.depth is not None:
            lists = {"no_depth": list(self.depth.no_depth), "accept": sorted(self.depth.accept)}
            depth = asdict(self.depth) | lists
        common = {
            "layout": self.layout,
            "split": sorted([split] if isinstance(split, str) else split),
            "group": self.group,
            "cameras": list(self.cameras),
            "size": None if self.size is None else list(self.size),
            "points": self.points,
            "depth": depth,
            "data": index.digest,
        }
        if self.group == "moment":
            return common
        return common | {"frames": sorted(map(list, set(frames_of.values())))}


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
    """The folders of one scene that are yet to be written, with the frames of each."""

    index: SceneIndex
    frames_of: Mapping[Path, tuple[int, ...]]
    selected: _Selected

    @property
    def pictures(self) -> int:
        return len(self.selected.cameras) * sum(map(len, self.frames_of.values()))


def _alone(index: SceneIndex, row: int) -> SceneIndex:
    """Return an index of one scene, small enough to be sent to a process with its work."""
    scene = index.scene(row)
    return SceneIndex.from_scenes([scene], index.root, shards=index.shards, retry=index.retry)


def _begin(root: Path, settings: Mapping[str, Any]) -> None:
    """Write what the folder holds, or refuse one that holds something else."""
    path = root / EXPORT_JSON
    try:
        root.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            if any(root.iterdir()):
                raise StorageError(
                    f"{root}: is not empty and holds no {EXPORT_JSON}: choose a new folder."
                )
            write_atomic(path, json.dumps(settings, indent=1).encode())
        there = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise StorageError(
            f"{path}: is not the description of an export ({error}). {_ELSEWHERE}"
        ) from error
    except OSError as error:
        if isinstance(error, StorageError):
            raise
        what = f"{path}: cannot be read or written"
        raise StorageError(describe_os_error(what, error, _ELSEWHERE)) from error
    found = there if isinstance(there, dict) else {}
    for name, wanted in settings.items():
        if found.get(name) != wanted:
            raise StorageError(
                f"{root}: holds an export of other {name}: {found.get(name)!r}, where {wanted!r} "
                "is asked for. Choose another folder, or remove it."
            )


def _export_scene(work: _SceneWork, advance: Advance) -> None:
    """Write the missing folders of one scene, each whole or not at all."""
    scene, selected = work.index.scene(0), work.selected
    points, contract = selected.points, selected.depth or depth_of(scene)
    encodings = dict.fromkeys(selected.cameras, contract)
    for camera in selected.cameras:
        source = scene.depth_unit_source[camera]
        if source != "unreadable":
            encodings[camera] = contract.with_file_unit(scene.depth_unit_m[camera], source=source)
    writers: dict[Layout, Callable[[Path], ViewWriter]] = {
        "colmap": lambda folder: ColmapWriter(folder, points=points, encodings=encodings),
        "transforms": lambda folder: TransformsWriter(folder, points=points),
        "ply": lambda folder: PlyWriter(folder, points=points),
        "moge": MogeWriter,
    }
    reader = PosedImageReader(work.index, size=selected.size, depth=selected.depth)
    with closing(reader):
        for folder, frames in work.frames_of.items():
            unfinished = folder.with_name(f".{folder.name}.unfinished")
            try:
                shutil.rmtree(unfinished, ignore_errors=True)
                unfinished.mkdir(parents=True)
                writer = writers[selected.layout](unfinished)
                for frame in frames:
                    writer.add([reader.read(0, camera, frame) for camera in selected.cameras])
                    advance(len(selected.cameras))
                writer.finish()
                unfinished.replace(folder)
            except OSError as error:
                if isinstance(error, StorageError):
                    raise
                what = f"{folder}: cannot be written"
                raise StorageError(describe_os_error(what, error, _ELSEWHERE)) from error
            finally:
                shutil.rmtree(unfinished, ignore_errors=True)


def _list_pictures(root: Path, folders: Iterable[Path], cameras: Sequence[int]) -> None:
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
