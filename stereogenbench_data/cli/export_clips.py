"""``stereogenbench export clips``: stereo video for the trainers of video models."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import typer

from stereogenbench_data.cli.errors import resumable
from stereogenbench_data.cli.options import (
    AcceptOption,
    DataOptions,
    DepthUnitOption,
    JsonOption,
    WorkOptions,
    complete_from,
    depth_of,
    grouped,
    out_folder,
)
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.samples import (
    BaselineOption,
    ExportedSceneOptions,
    PairsOption,
    pairs_option,
    parse_picture_size,
)

if TYPE_CHECKING:
    from stereogenbench_data.bridges.clips import ClipForm
    from stereogenbench_data.media.encoder import Encoding


_ENCODING: Final = "How videos are encoded"
"""Panel of the help for the options of the encoder."""


@dataclass(frozen=True, kw_only=True)
class ExportedPairOptions(ExportedSceneOptions):
    """Which pairs of which scenes are exported."""

    pairs: PairsOption = "primary"
    baseline_cm: BaselineOption = None

    def selection(self) -> dict[str, Any]:
        """Return the options of `StereoPairs` that select.

        Raises:
            typer.BadParameter: If the text of the pairs cannot be parsed.
        """
        baseline = {} if self.baseline_cm is None else {"baseline_cm": self.baseline_cm}
        return self.filters() | baseline | {"pairs": pairs_option(self.pairs)}


@dataclass(frozen=True, kw_only=True)
class EncodingOptions:
    """How videos are encoded."""

    crf: Annotated[
        int,
        typer.Option(
            help="Constant rate factor, 0 to 51; fewer is better.", rich_help_panel=_ENCODING
        ),
    ] = 12
    preset: Annotated[
        str,
        typer.Option(help="Effort, ultrafast to veryslow.", rich_help_panel=_ENCODING),
    ] = "medium"
    pixel_format: Annotated[
        Literal["yuv420p", "yuv444p"],
        typer.Option(help="yuv444p keeps colours at full size.", rich_help_panel=_ENCODING),
    ] = "yuv420p"
    key_frame_every: Annotated[
        int | None,
        typer.Option(
            help="Most frames between key frames [the codec's].", rich_help_panel=_ENCODING
        ),
    ] = None

    def encoding(self) -> "Encoding":
        """Return how videos are encoded.

        Raises:
            MediaError: If a value is out of range.
        """
        from stereogenbench_data.media.encoder import Encoding

        return Encoding(
            crf=self.crf,
            preset=self.preset,
            pixel_format=self.pixel_format,
            key_frame_every=self.key_frame_every,
        )


@dataclass(frozen=True, kw_only=True)
class ClipOptions(EncodingOptions):
    """What a clip is."""

    length: Annotated[
        int | None,
        typer.Option(help="Frames of a clip [the most that fit]."),
    ] = None
    stride: Annotated[int, typer.Option(help="Take every so many frames.")] = 1
    step: Annotated[
        int | None, typer.Option(help="Start a clip every so many frames [no overlap].")
    ] = None
    any_length: Annotated[
        bool, typer.Option("--any-length", help="Allow lengths that the trainer cuts to 4N+1.")
    ] = False
    size: Annotated[
        str | None,
        typer.Option("--size", metavar="WxH", help="Width x height of pictures [as stored]."),
    ] = None
    fit: Annotated[
        Literal["stretch", "crop"],
        typer.Option(help="crop: scale until the size is covered, and cut to the middle."),
    ] = "stretch"
    rate_hz: Annotated[
        float | None,
        typer.Option(help="Frames a second that files state [the video's, by the stride]."),
    ] = None
    also: Annotated[
        list[str] | None,
        typer.Option(
            "--also",
            metavar="VIDEO",
            help="Write depth or disparity too. May be repeated.",
            autocompletion=complete_from(("depth", "disparity")),
        ),
    ] = None
    control: Annotated[
        str,
        typer.Option(
            help="What the manifest names as control: left, warped, mask, depth, disparity, none, "
            "or the layout's own."
        ),
    ] = "layout"
    baseline_in_caption: Annotated[
        bool, typer.Option("--baseline-in-caption", help="Tell the baseline in the captions.")
    ] = False

    def form(self) -> "ClipForm":
        """Return what a clip is.

        Raises:
            typer.BadParameter: If the size is not WIDTHxHEIGHT.
            MediaError: If a value of the encoding is out of range.
        """
        from stereogenbench_data.bridges.clips import ClipForm

        also: Any = tuple(self.also or ())
        return ClipForm(
            length=self.length,
            stride=self.stride,
            step=self.step,
            size=None if self.size is None else parse_picture_size(self.size),
            fit=self.fit,
            rate_hz=self.rate_hz,
            length_rule="any" if self.any_length else "layout",
            also=also,
            control=self.control,
            captions="with baseline" if self.baseline_in_caption else "plain",
            encoding=self.encoding(),
        )


@grouped
@resumable()
def export_clips(  # noqa: PLR0913 - one parameter an option
    source: DataOptions,
    out: Annotated[Path, typer.Argument(parser=out_folder, help="Folder to write into.")],
    *,
    layout: Annotated[
        Literal["diffsynth", "finetrainers", "musubi", "stereocrafter"],
        typer.Option(help="Whose manifests to write: the trainer's."),
    ],
    chosen: ExportedPairOptions,
    clip: ClipOptions,
    depth_unit_m: DepthUnitOption = None,
    accept: AcceptOption = None,
    work: WorkOptions,
    as_json: JsonOption = False,
) -> None:
    """Write stereo clips with captions and manifest for video trainers.

    Of each pair: the right view, the left one, the left one warped into the right, and a lossless
    mask of its holes. A stopped run goes on if it is run again; manifests are written last.
    """
    from stereogenbench_data.bridges.clips import ExportRun
    from stereogenbench_data.bridges.clips import export_clips as exported
    from stereogenbench_data.schema.text import counted

    form, selection = clip.form(), chosen.selection()
    index = source.open()
    with progress_bar("writing", unit="frames") as progress:
        report = exported(
            index,
            out,
            layout=layout,
            form=form,
            run=ExportRun(
                depth=depth_of(index, unit_m=depth_unit_m, accept=accept),
                progress=progress,
                **work.options(),
            ),
            **selection,
        )
    if report.evaluation_scenes:
        left_out = counted(report.evaluation_scenes, "evaluation scene")
        typer.echo(f"{left_out} left out: --split eval exports them", err=True)
    if report.without_caption:
        typer.echo(f"{counted(report.without_caption, 'clip')} without a caption", err=True)
    names = [path.name for path in report.manifests]
    if as_json:
        clips_of = {"written": list(report.written), "kept": list(report.kept)}
        typer.echo(json.dumps({"out": str(out), "manifests": names} | clips_of, indent=2))
        return
    were = "was" if len(report.kept) == 1 else "were"
    typer.echo(
        f"{out}: {counted(len(report.written), 'clip')} written, {len(report.kept)} {were} there "
        f"before; {', '.join(names)}"
    )


EXPORTS: Final[tuple[tuple[str, Callable[..., None], str], ...]] = (
    ("clips", export_clips, "export clips shards/ clips/ --layout musubi --size 832x480"),
)
"""Name, function and example of each command of the group ``export``."""
