"""``stereogenbench export colmap``, ``transforms``, ``ply``: several views, as files."""

from dataclasses import dataclass
from typing import Annotated, Any

import typer

from stereogenbench_data.cli.options import (
    CamerasOption,
    DataOptions,
    ExportedOptions,
    FramesOption,
    OutArgument,
    SizeOption,
    WorkOptions,
    grouped,
    option,
)
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.schema.text import counted


def _points_of(text: str) -> int | str:
    """Return a number of points, or "all"."""
    if text != "all" and not text.isdecimal():
        raise typer.BadParameter(f"{text!r} is not a number or all.")
    return text if text == "all" else int(text)


@dataclass(frozen=True, kw_only=True)
class ViewOptions(ExportedOptions):
    """Which views of which scenes are exported, and how many points are in a folder."""

    cameras: CamerasOption = None
    frames: FramesOption = "first"
    size: SizeOption = None
    points: Annotated[
        Any,
        option("3D points of a picture [5000; clouds 100000].", parser=_points_of, metavar="N|all"),
    ] = None


@grouped
def colmap(
    source: DataOptions, out: OutArgument, *, chosen: ViewOptions, work: WorkOptions
) -> None:
    """Write COLMAP's text model with points from depth.

    COLMAP, gsplat and 3D Gaussians read it. In each folder: images/ and sparse/0/ (cameras.txt,
    images.txt, points3D.txt), poses and points in metres, exact; the world's origin is the first
    camera. A stopped run goes on if it is run again.

    Example: `stereogenbench export colmap shards/ colmap/ --frames 0,40`
    """
    _export(source, out, chosen, work, layout="colmap")


@grouped
def transforms(
    source: DataOptions, out: OutArgument, *, chosen: ViewOptions, work: WorkOptions
) -> None:
    """Write transforms.json for nerfstudio, with depth and points.

    Cameras have OpenGL's axes, the world's z points up, depth is in millimetres in .npy files. A
    stopped run goes on if it is run again.

    Example: `stereogenbench export transforms shards/ nerfstudio/ --size 640x640`
    """
    _export(source, out, chosen, work, layout="transforms")


@grouped
def ply(source: DataOptions, out: OutArgument, *, chosen: ViewOptions, work: WorkOptions) -> None:
    """Write coloured point clouds from depth as PLY.

    Points are in metres, x right, y down, z forward. Each folder has points.ply, and
    stereogenbench.json with the way back to the scene's world. A stopped run goes on if it is run
    again.

    Example: `stereogenbench export ply shards/ clouds/ --points all`
    """
    _export(source, out, chosen, work, layout="ply")


def _export(
    source: DataOptions, out: OutArgument, chosen: ViewOptions, work: WorkOptions, *, layout: Any
) -> None:
    from stereogenbench_data.bridges.export_views import export_views

    cameras: Any = "all" if chosen.cameras is None else chosen.cameras
    filters, index = chosen.filters(), source.open()
    with progress_bar("writing", unit="pictures") as progress:
        folders = export_views(
            index,
            out,
            layout=layout,
            cameras=cameras,
            frames=chosen.frames,
            size=chosen.size,
            points=chosen.points,
            progress=progress,
            **work.options(),
            **filters,
        )
    typer.echo(f"{out}: {counted(len(folders), 'folder')}")
