"""``stereogenbench export colmap``, ``transforms``, ``ply``, ``moge``: several views, as files."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import typer

from stereogenbench_data.cli.errors import resumable
from stereogenbench_data.cli.help import SCENES
from stereogenbench_data.cli.options import (
    AcceptOption,
    DataOptions,
    DepthUnitOption,
    WorkOptions,
    depth_of,
    grouped,
    out_folder,
)
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.samples import (
    ExportedSceneOptions,
    FramesOption,
    frames_option,
    parse_picture_size,
)
from stereogenbench_data.schema.text import counted

OutArgument = Annotated[Path, typer.Argument(parser=out_folder, help="Folder to write into.")]


@dataclass(frozen=True, kw_only=True)
class ViewOptions(ExportedSceneOptions):
    """Which views of which scenes are exported."""

    cameras: Annotated[
        str,
        typer.Option("--cameras", help="all, or numbers such as 0,2,5.", rich_help_panel=SCENES),
    ] = "all"
    frames: FramesOption = "first"
    size: Annotated[
        str | None,
        typer.Option(
            "--size", metavar="WxH", help="Width x height of what is written [as stored]."
        ),
    ] = None
    depth_unit_m: DepthUnitOption = None
    accept: AcceptOption = None

    def selection(self) -> dict[str, Any]:
        """Return the options of `export_views` that were given.

        Raises:
            typer.BadParameter: If a text cannot be parsed.
        """
        cameras: Any = self.cameras
        if cameras != "all":
            if not all(map(str.isdecimal, cameras.split(","))):
                raise typer.BadParameter(
                    f"{cameras!r} is not all or numbers such as 0,2,5.", param_hint="--cameras"
                )
            cameras = tuple(map(int, cameras.split(",")))
        return self.filters() | {
            "cameras": cameras,
            "frames": frames_option(self.frames),
            "size": None if self.size is None else parse_picture_size(self.size),
        }


@dataclass(frozen=True, kw_only=True)
class FolderOptions(ViewOptions):
    """The same, with what makes a folder and how many points are in it."""

    group: Annotated[
        Literal["moment", "scene"],
        typer.Option(
            "--group",
            help="A folder for each moment, in which nothing moves, or for each scene.",
        ),
    ] = "moment"
    points: Annotated[
        str | None,
        typer.Option(
            "--points",
            help="3D points of a picture, or all [5000; clouds 100000].",
        ),
    ] = None

    def selection(self) -> dict[str, Any]:
        """Return the options of `export_views` that were given.

        Raises:
            typer.BadParameter: If a text cannot be parsed.
        """
        points: Any = self.points
        if points not in (None, "all"):
            if not points.isdecimal():
                raise typer.BadParameter(
                    f"{points!r} is not a number or all.", param_hint="--points"
                )
            points = int(points)
        return super().selection() | {"group": self.group, "points": points}


@grouped
@resumable()
def export_colmap(
    source: DataOptions, out: OutArgument, *, chosen: FolderOptions, work: WorkOptions
) -> None:
    """Write COLMAP's text model with points from depth.

    COLMAP, gsplat and 3D Gaussians read it. In each folder: images/ and sparse/0/ (cameras.txt,
    images.txt, points3D.txt), poses and points in metres, exact; the world's origin is the first
    camera. A stopped run goes on if it is run again.
    """
    _export(source, out, chosen, work, layout="colmap")


@grouped
@resumable()
def export_transforms(
    source: DataOptions, out: OutArgument, *, chosen: FolderOptions, work: WorkOptions
) -> None:
    """Write transforms.json for nerfstudio, with depth and points.

    Cameras have OpenGL's axes, the world's z points up, depth is in millimetres in .npy files. A
    stopped run goes on if it is run again.
    """
    _export(source, out, chosen, work, layout="transforms")


@grouped
@resumable()
def export_ply(
    source: DataOptions, out: OutArgument, *, chosen: FolderOptions, work: WorkOptions
) -> None:
    """Write coloured point clouds from depth as PLY.

    Points are in metres, x right, y down, z forward. Each folder has points.ply, and
    stereogenbench.json with the cameras. A stopped run goes on if it is run again.
    """
    _export(source, out, chosen, work, layout="ply")


@grouped
@resumable()
def export_moge(
    source: DataOptions, out: OutArgument, *, chosen: ViewOptions, work: WorkOptions
) -> None:
    """Write the training folders of MoGe.

    Each holds image.jpg, depth.png and meta.json; .index.txt lists them. In MoGe's configuration of
    this dataset set "depth_unit": 1.0, as depth is metric, and "finite_depth_mask": "only_known". A
    stopped run goes on if it is run again.
    """
    _export(source, out, chosen, work, layout="moge")


EXPORTS: Final[tuple[tuple[str, Callable[..., None], str], ...]] = (
    ("colmap", export_colmap, "export colmap shards/ colmap/ --frames 0,40"),
    ("transforms", export_transforms, "export transforms shards/ nerfstudio/ --size 640x640"),
    ("ply", export_ply, "export ply shards/ clouds/ --points all"),
    ("moge", export_moge, "export moge shards/ moge/ --frames every:10"),
)
"""Name, function and example of each command of the group ``export``."""


def _export(
    source: DataOptions, out: Path, chosen: ViewOptions, work: WorkOptions, *, layout: Any
) -> None:
    from stereogenbench_data.bridges.export_views import export_views
    from stereogenbench_data.bridges.exports import training_selection

    index = source.open()
    with progress_bar("writing", unit="pictures") as progress:
        folders = export_views(
            index,
            out,
            layout=layout,
            progress=progress,
            depth=depth_of(index, unit_m=chosen.depth_unit_m, accept=chosen.accept),
            **chosen.selection(),
            **work.options(),
        )
    _, for_evaluation = training_selection(index, chosen.filters())
    if for_evaluation:
        typer.echo(
            f"{counted(for_evaluation, 'evaluation scene')} left out: --split eval exports them",
            err=True,
        )
    typer.echo(f"{out}: {counted(len(folders), 'folder')}")
