"""``stereogenbench download``: copy the part of a release that a selection needs to this disk."""

from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from stereogenbench_data.cli.options import (
    CamerasOption,
    SceneOptions,
    ShareOptions,
    SourceOptions,
    flag,
    grouped,
    option,
)
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.schema.release import CAMERA_COUNT
from stereogenbench_data.schema.text import counted


@grouped
def download(  # noqa: PLR0913 - one parameter an option
    source: SourceOptions,
    *,
    out: Annotated[Path, option("--out", "-o", "Folder to write into.", metavar="DIR")],
    cameras: CamerasOption = None,
    streams: Annotated[Literal["both", "rgb", "depth"], option("Which videos.")] = "both",
    chosen: SceneOptions,
    share: ShareOptions,
    dry_run: Annotated[bool, flag("--dry-run", "Print the size and fetch nothing.")] = False,
) -> None:
    """Fetch only what a selection needs, in the released layout.

    Every file is checked as it arrives. To continue a stopped run, run it again. The folder opens
    with `StereoPairs(OUT)`, for the cameras that were fetched. --max-bytes 10GB takes a share that
    is balanced over families and maps; the same share each time.

    Example: `stereogenbench download hf://datasets/ORG/NAME --split eval --cameras 0,1 -o data/`
    """
    from stereogenbench_data.errors import StorageError
    from stereogenbench_data.index.table import SceneIndex
    from stereogenbench_data.selection.filters import filter_scenes
    from stereogenbench_data.shards.download import download as fetched
    from stereogenbench_data.shards.download import size_bytes, wanted_files

    filters: Any = chosen.filters()
    index = SceneIndex.open(source.data, root=source.data_root, conventions=source.stated())
    rows = filter_scenes(index, filters).tolist()
    files: Any = {
        "cameras": list(cameras or range(CAMERA_COUNT)),
        "streams": ("rgb", "depth") if streams == "both" else (streams,),
    }
    if share.is_given:
        sizes: dict[int, int] = {}
        for row in rows:
            with suppress(StorageError):  # it lacks a wanted file
                sizes[row] = size_bytes(wanted_files(index.indexed_scene(row), **files))
        rows = share.rows(index, [*sizes], [*sizes.values()]) if sizes else rows
    wanted = [wanted_files(index.scene(row), **files) for row in rows]
    size = f"{size_bytes(*wanted) / 1e6:,.1f} MB"
    scenes = counted(len(wanted), "scene")
    count = counted(sum(len(scene.members) for scene in wanted), "file")
    typer.echo(f"{scenes}, {count}, {size}", err=True)
    if not dry_run:
        with progress_bar("downloading", unit="MB") as progress:
            fetched(index, wanted, out, progress=progress)
        typer.echo(f"{out}: {scenes}, {size}")
