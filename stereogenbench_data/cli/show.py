"""``stereogenbench show``: one scene as a picture, a clip or a recording of Rerun."""

from pathlib import Path
from typing import Annotated, Any

import typer

from stereogenbench_data.cli.options import (
    AcceptOption,
    DataOptions,
    DepthUnitOption,
    complete_scene,
    depth_of,
    grouped,
    pair_of,
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
            help="Key of a scene, or a part of it that is unique [the first].",
            autocompletion=complete_scene,
        ),
    ] = None,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="File to write: .png a sheet, .mp4 or .gif a clip, .rrd for Rerun [KEY.png].",
        ),
    ] = None,
    pair: Annotated[
        str | None, typer.Option(help="Two cameras, such as 0-5 [as recorded].")
    ] = None,
    frame: Annotated[int, typer.Option(min=0, help="Number of the frame.")] = 0,
    size: Annotated[
        int | None,
        typer.Option(min=1, max=2048, help="Width of each drawn picture, px [320]."),
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="Open Rerun's viewer; write no file.")
    ] = False,
    depth_unit_m: DepthUnitOption = None,
    accept: AcceptOption = None,
) -> None:
    """Draw one scene with the disparity of a pair.

    A sheet shows the six views, and a pair's disparity, depth, visibility and warp. The bar of
    disparity shows pixels and metres, of the stored pictures. A clip shows left, right, disparity
    and anaglyph over time. A recording for Rerun's viewer has all six cameras over time.
    """
    from stereogenbench_data.audit.pictures import scene_pictures
    from stereogenbench_data.audit.pictures.scene_reader import SceneReader
    from stereogenbench_data.samples.picture import write_png
    from stereogenbench_data.selection.filters import find_scene

    cameras = None if pair is None else pair_of(pair, option="--pair")
    ending = ".png" if out is None else out.suffix.lower()
    if live or ending == ".rrd":
        shown: dict[str, Any] = {
            "pair": cameras,
            "depth": {"unit_m": depth_unit_m, "accept": accept},
        }
        _show_in_rerun(source, scene, out, width_px=size, is_live=live, **shown)
        return
    if ending not in (".png", *_CLIPS):
        raise typer.BadParameter(
            f"{out}: a sheet is .png, a clip .mp4 or .gif, a recording .rrd.", param_hint="--out"
        )
    index = source.open()
    row = 0 if scene is None else find_scene(index, scene)
    recorded = index.scene(row)
    key = recorded.id.key
    target = out or Path(key.replace("/", "_") + ".png")
    reader = SceneReader(index, depth=depth_of(index, unit_m=depth_unit_m, accept=accept))
    with writing(target):
        if ending in _CLIPS:
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


def _show_in_rerun(
    source: DataOptions,
    scene: str | None,
    out: Path | None,
    *,
    width_px: int | None,
    is_live: bool,
    depth: dict[str, Any],
    **shown: Any,
) -> None:
    from stereogenbench_data.bridges.rerun import view_live, write_recording
    from stereogenbench_data.selection.filters import find_scene

    if is_live and out is not None:
        raise typer.BadParameter(f"{out}: --live writes no file.", param_hint="--out")
    index = source.open()
    found = index.scene(0 if scene is None else find_scene(index, scene))
    key, rig = found.id.key, found.rig
    shown["depth"] = depth_of(index, **depth)
    if width_px is not None:
        shown["size"] = (
            max(1, round(rig.image_height_px * width_px / rig.image_width_px)),
            width_px,
        )
    target = out or Path(key.replace("/", "_") + ".rrd")
    with progress_bar("logging", unit="frames") as progress, writing(target):
        if is_live:
            view_live(index, key, progress=progress, **shown)
        else:
            write_recording(target, index, key, progress=progress, **shown)
    typer.echo(f"{'live' if is_live else target}: {key}")
