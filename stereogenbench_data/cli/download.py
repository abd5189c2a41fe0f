"""``stereogenbench download``: copy the part of a release that a selection needs to this disk."""

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
    from stereogenbench_data.index.table import SceneIndex
    from stereogenbench_data.selection.filters import filter_scenes
    from stereogenbench_data.shards.download import download as fetched
    from stereogenbench_data.shards.download import download_sizes, plan_download

    numbers = list(cameras or range(CAMERA_COUNT))
    filters: Any = chosen.filters()
    index = SceneIndex.open(source.data, root=source.data_root, conventions=source.stated())
    rows = filter_scenes(index, filters).tolist()
    kinds = ("rgb", "depth") if streams == "both" else (streams,)
    if share.is_given:
        sizes = download_sizes(index, rows, cameras=numbers, streams=kinds)
        rows = share.rows(index, [*sizes], [*sizes.values()])
    wanted = plan_download(index, rows, cameras=numbers, streams=kinds)
    size = wanted.size_bytes / 1e6
    scenes, files = counted(len(rows), "scene"), counted(len(wanted.files), "file")
    typer.echo(f"{scenes}, {files}, {size:,.1f} MB", err=True)
    if not dry_run:
        with progress_bar("downloading", unit="MB") as progress:
            fetched(index, wanted, out, progress=progress)
        typer.echo(f"{out}: {scenes}, {size:,.1f} MB")
