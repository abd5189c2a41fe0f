"""``stereogenbench show``: one scene as a picture, a clip or a recording of Rerun."""

from pathlib import Path
from typing import Annotated, Any

import typer

from stereogenbench_data.cli.options import DataOptions, grouped, option, pair_of
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.writing import writing


@grouped
def show(
    source: DataOptions,
    scene: Annotated[
        str | None,
        typer.Argument(help="Key of a scene, or a part of it that is unique [the first]."),
    ] = None,
    *,
    out: Annotated[
        Path | None,
        option(
            "--out",
            "-o",
            "File to write: .png a sheet, .mp4 a clip, .rrd for Rerun [KEY.png].",
        ),
    ] = None,
    pair: Annotated[
        Any, option("Two cameras, such as 0-5 [as recorded].", parser=pair_of, metavar="LEFT-RIGHT")
    ] = None,
    frame: Annotated[int, option("Number of the frame.", min=0)] = 0,
) -> None:
    """Draw one scene with the disparity of a pair.

    A sheet shows the six views, and a pair's disparity, depth, visibility and warp. The bar of
    disparity shows pixels and metres, of the stored pictures. A clip shows left, right, disparity
    and anaglyph over time. A recording for Rerun's viewer has all six cameras over time.

    Example: `stereogenbench show shards/ scene_000001 --pair 0-5 -o sheet.png`
    """
    from stereogenbench_data.audit.pictures import SceneReader, clip_pages, scene_sheet, write_clip
    from stereogenbench_data.bridges.picture import write_png
    from stereogenbench_data.selection.filters import find_scene

    ending = ".png" if out is None else out.suffix.lower()
    if ending not in (".png", ".mp4", ".rrd"):
        raise typer.BadParameter(
            f"{out}: a sheet is .png, a clip .mp4, a recording .rrd.", param_hint="--out"
        )
    index = source.open()
    row = 0 if scene is None else find_scene(index, scene)
    recorded = index.scene(row)
    key = recorded.id.key
    target = out or Path(key.replace("/", "_") + ".png")
    with writing(target):
        if ending == ".png":
            sheet = scene_sheet(SceneReader(index), row, pair=pair, frame=frame)
            write_png(target, sheet)
        elif ending == ".rrd":
            from stereogenbench_data.bridges.rerun import write_recording

            with progress_bar("logging", unit="frames") as progress:
                write_recording(target, index, key, pair=pair, progress=progress)
        else:
            with progress_bar("drawing", unit="frames") as progress:
                write_clip(
                    target,
                    clip_pages(SceneReader(index), row, pair=pair),
                    frames=recorded.frames,
                    rate_hz=recorded.frame_rate_hz,
                    progress=progress,
                )
    typer.echo(f"{target}: {key}")
