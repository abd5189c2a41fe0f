"""``stereogenbench show``: one scene as a picture or a clip."""

from pathlib import Path
from typing import Annotated

import typer

from stereogenbench_data.cli.options import (
    DataOptions,
    DepthUnitOption,
    complete_scene,
    depth_of,
    grouped,
)
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.writing import writing

_CLIPS = (".mp4", ".gif")


@grouped
def show(  # noqa: PLR0913 - one parameter an option
    source: DataOptions,
    scene: Annotated[
        str | None,
        typer.Argument(
            help="Key of a scene, or a part that no other key has [the first scene].",
            autocompletion=complete_scene,
        ),
    ] = None,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="File to write: .png, or .mp4 or .gif for a clip [KEY.png]."
        ),
    ] = None,
    pair: Annotated[
        str | None, typer.Option(help="Two cameras, such as 0-5 [the recorded pair].")
    ] = None,
    frame: Annotated[int, typer.Option(min=0, help="Number of the frame.")] = 0,
    size: Annotated[
        int | None,
        typer.Option(min=1, max=2048, help="Width of each drawn picture, px [320]."),
    ] = None,
    clip: Annotated[
        bool, typer.Option("--clip", help="Write all frames as a clip, .mp4 or .gif [KEY.mp4].")
    ] = False,
    depth_unit_m: DepthUnitOption = None,
) -> None:
    """Draw one scene: its six views, and a pair's disparity, depth, visibility and warp.

    The bar of disparity shows pixels and metres, of the stored pictures. A clip shows left, right,
    disparity and anaglyph over time.
    """
    from stereogenbench_data.audit import scene_pictures
    from stereogenbench_data.audit.scene_reader import SceneReader
    from stereogenbench_data.samples.picture import write_png
    from stereogenbench_data.selection.filters import find_scene

    cameras = None
    if pair is not None:
        left, _, right = pair.replace(",", "-").partition("-")
        if not (left.strip().isdecimal() and right.strip().isdecimal()):
            raise typer.BadParameter(
                f"{pair!r} is not a pair: write two cameras, such as 0-5.", param_hint="--pair"
            )
        cameras = int(left), int(right)
    clip = clip or (out is not None and out.suffix.lower() in _CLIPS)
    if out is not None and out.suffix.lower() not in (_CLIPS if clip else (".png",)):
        wanted = "a clip is .mp4 or .gif" if clip else "a sheet is .png"
        raise typer.BadParameter(f"{out}: {wanted}, by its ending.", param_hint="--out")
    index = source.open()
    row = 0 if scene is None else find_scene(index, scene)
    recorded = index.scene(row)
    key = recorded.id.key
    target = out or Path(key.replace("/", "_") + (".mp4" if clip else ".png"))
    reader = SceneReader(index, depth=depth_of(depth_unit_m))
    with writing(target):
        if clip:
            with progress_bar("drawing", unit="frames") as progress:
                scene_pictures.write_clip(
                    target,
                    scene_pictures.clip_pages(reader, row, pair=cameras, tile_px=size),
                    frames=recorded.frames,
                    rate_hz=recorded.frame_rate_hz,
                    progress=progress,
                )
        else:
            sheet = scene_pictures.scene_sheet(reader, row, pair=cameras, frame=frame, tile_px=size)
            write_png(target, sheet)
    typer.echo(f"{target}: {key}")
