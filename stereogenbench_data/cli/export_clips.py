"""``stereogenbench export clips``: stereo video for the trainers of video models."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import typer

from stereogenbench_data.cli.options import (
    DataOptions,
    ExportedOptions,
    OutArgument,
    PairsOption,
    SizeOption,
    WorkOptions,
    flag,
    grouped,
    option,
)
from stereogenbench_data.cli.progress import progress_bar


@dataclass(frozen=True, kw_only=True)
class ClipOptions:
    """What a clip is, and of which pairs."""

    pairs: PairsOption = "primary"
    length: Annotated[int | None, option("Frames of a clip [the most that fit].")] = None
    stride: Annotated[int, option("Take one of this many frames.")] = 1
    step: Annotated[int | None, option("Frames from clip to clip [no overlap].")] = None
    size: SizeOption = None
    baseline_in_caption: Annotated[
        bool, flag("--baseline-in-caption", "Tell the baseline in the captions.")
    ] = False


@grouped
def clips(
    source: DataOptions,
    out: OutArgument,
    *,
    layout: Annotated[
        Literal["diffsynth", "finetrainers", "musubi", "stereocrafter"],
        option("Whose manifests to write: the trainer's."),
    ],
    chosen: ExportedOptions,
    clip: ClipOptions,
    work: WorkOptions,
) -> None:
    """Write stereo clips with captions and manifest for video trainers.

    Of each pair: the right view, the left one, the left one warped into the right, and a lossless
    mask of its holes. A stopped run goes on if it is run again; manifests are written last.

    Example: `stereogenbench export clips shards/ clips/ --layout musubi --size 832x480`
    """
    from stereogenbench_data.bridges.clips import export_clips
    from stereogenbench_data.schema.text import counted

    form: dict[str, Any] = dict(vars(clip))
    captions: Any = "with baseline" if form.pop("baseline_in_caption") else "plain"
    filters, index = chosen.filters(), source.open()
    with progress_bar("writing", unit="frames") as progress:
        report = export_clips(
            index,
            out,
            layout=layout,
            captions=captions,
            progress=progress,
            **form,
            **work.options(),
            **filters,
        )
    if report.without_caption:
        typer.echo(f"{counted(report.without_caption, 'clip')} without a caption", err=True)
    names = [path.name for path in report.manifests]
    clips_now = counted(len(report.written), "clip")
    typer.echo(f"{out}: {clips_now} written, {len(report.kept)} kept; {', '.join(names)}")
