"""``stereogenbench pack``, ``verify``, ``unpack``: released trees into tar shards, and back."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from stereogenbench_data.cli.data import open_index
from stereogenbench_data.cli.errors import FINDINGS, resumable
from stereogenbench_data.cli.help import RARE
from stereogenbench_data.cli.options import (
    AcceptOption,
    ConventionsOption,
    JsonOption,
    RootOption,
    SceneOptions,
    ShardsOptions,
    ShareOptions,
    WorkOptions,
    grouped,
    out_folder,
)
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.schema.text import counted, plain_line

if TYPE_CHECKING:
    from stereogenbench_data.index.table import SceneIndex
    from stereogenbench_data.shards.training import TrainingSettings

_TRAINING = "Training shards"
"""Panel of the help for the options that training shards have."""


@grouped
@resumable()
def pack(  # noqa: PLR0913 - one parameter an option
    root: Annotated[
        str,
        typer.Argument(
            help="Folder of scenes or its index file; with --size also shards or a URL."
        ),
    ],
    out: Annotated[
        Path, typer.Argument(parser=out_folder, help="Folder for the shards and their index.")
    ],
    *,
    data_root: RootOption = None,
    conventions: ConventionsOption = None,
    shard_size: Annotated[
        str,
        typer.Option(help="Largest shard, such as 500MB or 2GiB; a scene is never divided."),
    ] = "2GB",
    part: Annotated[
        str,
        typer.Option(
            metavar="I/N",
            help="Every N-th shard from the I-th on: a part for each machine.",
            rich_help_panel=RARE,
        ),
    ] = "1/1",
    size: Annotated[
        str | None,
        typer.Option(
            metavar="WxH",
            help="Width x height, such as 832x480; makes training shards.",
            rich_help_panel=_TRAINING,
        ),
    ] = None,
    quality: Annotated[
        Literal["small", "balanced", "high"] | None,
        typer.Option(help="Fewest bytes, or least error [balanced].", rich_help_panel=_TRAINING),
    ] = None,
    cameras: Annotated[
        str | None,
        typer.Option(help="Such as 0,1 [all that a scene has].", rich_help_panel=_TRAINING),
    ] = None,
    accept: AcceptOption = None,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Estimate bytes and core-hours; write nothing.",
            rich_help_panel=_TRAINING,
        ),
    ] = False,
    chosen: SceneOptions,
    share: ShareOptions,
    work: WorkOptions,
    depth_codec: Annotated[
        Literal["released", "blosc2"],
        typer.Option(
            help="As released, or lossless and ten times as fast to decode.",
            rich_help_panel=RARE,
        ),
    ] = "released",
    as_json: JsonOption = False,
) -> None:
    """Pack scenes into WebDataset shards.

    The same scenes give the same bytes each time. To continue a stopped run, run it again: it keeps
    finished shards by their sizes, times of change and metadata. `stereogenbench verify` reads
    every byte. With --part, run the same command once for each I; the last one to finish writes the
    index. --max-bytes 10GB packs a share that is balanced over families and maps, the same each
    time; of training shards about so much.

    With --size the shards are derived for training: smaller pictures, a key frame every few frames,
    depth bit for bit as `size=` gives it. --quality small and balanced encode H.264, high encodes
    JPEG. The error of each video is in the index. Evaluation and audit refuse such data.
    """
    from stereogenbench_data.selection.filters import filter_scenes
    from stereogenbench_data.shards.pack import pack as packed_by
    from stereogenbench_data.shards.plan import packed_bytes, parse_bytes

    number, _, count = part.partition("/")
    if not (number.isdecimal() and count.isdecimal()):
        raise typer.BadParameter(
            f"{part!r} is not a part: write I/N, such as 1/4.", param_hint="--part"
        )
    target_bytes = parse_bytes(shard_size)
    training = _training(
        size, quality=quality, cameras=cameras, depth_codec=depth_codec, accept=accept
    )
    if dry_run and training is None:
        raise typer.BadParameter("estimates training shards: give --size.", param_hint="--dry-run")
    index = open_index(root, root=data_root, conventions=conventions)
    filters: Any = chosen.filters()
    rows = filter_scenes(index, filters).tolist() if filters or share.is_given else None
    if rows is not None and share.is_given:
        sizes = [
            packed_bytes(index.indexed_scene(row), depth_codec=depth_codec, training=training)
            for row in rows
        ]
        rows = share.rows(index, rows, sizes)
    if dry_run and training is not None:
        _print_estimate(index, rows or range(len(index)), training, as_json=as_json)
        return
    with progress_bar("packing", unit="MB") as progress:
        report = packed_by(
            index,
            out,
            target_bytes=target_bytes,
            depth_codec=depth_codec,
            training=training,
            rows=rows,
            part=(int(number), int(count)),
            **work.options(),
            progress=progress,
        )
    if as_json:
        document = {
            "index": None if report.index is None else str(report.index),
            "packed": report.packed,
            "part": report.part,
            "missing": report.missing,
            "scenes": report.scenes,
        }
        typer.echo(json.dumps(document, indent=2))
        return
    kept = len(report.part) - len(report.packed)
    were = "was" if kept == 1 else "were"
    typer.echo(
        f"{out}: {counted(len(report.packed), 'shard')} packed, {kept} {were} finished before"
    )
    if report.index is None:
        typer.echo(
            f"{counted(len(report.missing), 'shard')} of the plan to be packed yet, from "
            f"{report.missing[0]} on: the part that packs the last one writes the index"
        )
    else:
        typer.echo(f"{report.index}: {counted(report.scenes, 'scene')}")


def _training(
    size: str | None,
    *,
    quality: Any,
    cameras: str | None,
    depth_codec: str,
    accept: list[str] | None,
) -> "TrainingSettings | None":
    """Return the settings of training shards; None without a size."""
    if size is None:
        for option, value in (
            ("--quality", quality), ("--cameras", cameras), ("--accept", accept),
        ):  # fmt: skip
            if value:
                raise typer.BadParameter("is of training shards: give --size.", param_hint=option)
        return None
    from stereogenbench_data.cli.samples import parse_picture_size
    from stereogenbench_data.schema.records import DepthEncoding
    from stereogenbench_data.shards.training import TrainingSettings

    if depth_codec != "released":
        raise typer.BadParameter(
            "training shards have depth of their own: leave it out.", param_hint="--depth-codec"
        )
    numbers = None
    if cameras is not None:
        parts = [part.strip() for part in cameras.split(",")]
        if not all(part in set("012345") for part in parts):
            raise typer.BadParameter(
                f"{cameras!r}: write numbers from 0 to 5, such as 0,1", param_hint="--cameras"
            )
        numbers = tuple(sorted({int(part) for part in parts}))
    losses: Any = frozenset(accept or ())
    return TrainingSettings(
        parse_picture_size(size), quality or "balanced", numbers, DepthEncoding(accept=losses)
    )


def _print_estimate(
    index: "SceneIndex", rows: Sequence[int], training: "TrainingSettings", *, as_json: bool
) -> None:
    from tempfile import TemporaryDirectory

    from stereogenbench_data.shards.training import estimate

    with TemporaryDirectory() as folder:
        found = estimate(index, rows, training, folder=Path(folder))
    if as_json:
        typer.echo(json.dumps(asdict(found), indent=2))
        return
    typer.echo(
        f"{counted(found.scenes, 'scene')}, {counted(found.videos, 'video')}: about "
        f"{found.bytes / 1e6:,.1f} MB from {found.source_bytes / 1e6:,.1f} MB, in about "
        f"{found.core_hours:,.2g} core-hours (by one camera of {len(found.sampled)} scenes)"
    )


@grouped
def verify(
    source: ShardsOptions,
    *,
    deep: Annotated[
        bool, typer.Option("--deep", help="Decode every video, and count its frames.")
    ] = False,
    comparison: Annotated[
        str | None,
        typer.Option(
            "--source",
            metavar="DATA",
            help="With --deep: released data to compare training shards with.",
            rich_help_panel=RARE,
        ),
    ] = None,
    as_json: JsonOption = False,
    work: WorkOptions,
) -> None:
    """Read every byte of shards, and list what is wrong.

    The exit status is 0 if nothing is wrong, 1 if something is, 2 if they cannot be verified.
    """
    from stereogenbench_data.shards.verify import verify as verified

    if comparison is not None and not deep:
        raise typer.BadParameter("compares frames: add --deep.", param_hint="--source")
    with progress_bar("verifying", unit="MB") as progress:
        report = verified(
            source.shards,
            root=source.data_root,
            mode="decode" if deep else "bytes",
            source=None if comparison is None else open_index(comparison),
            **work.options(),
            progress=progress,
        )
    if as_json:
        typer.echo(json.dumps(asdict(report), indent=2))
    else:
        for problem in report.problems:
            typer.echo(plain_line(str(problem)))
        decoded = f", {counted(report.videos_decoded, 'video')} decoded" if deep else ""
        if comparison is not None:
            decoded += f", {report.videos_compared} compared with {comparison}"
        if report.derived:
            typer.echo(plain_line(f"{report.root}: {report.derived}"))
        typer.echo(
            f"{report.root}: {counted(report.shards, 'shard')}, {counted(report.scenes, 'scene')}, "
            f"{counted(report.members, 'member')}, {report.bytes / 1e6:.1f} MB{decoded}; "
            f"{counted(len(report.problems), 'problem')}"
        )
    if report.problems:
        raise typer.Exit(FINDINGS)


@grouped
@resumable()
def unpack(
    source: ShardsOptions,
    out: Annotated[Path, typer.Argument(parser=out_folder, help="Folder for the scenes.")],
    *,
    work: WorkOptions,
    as_json: JsonOption = False,
) -> None:
    """Turn shards back into scenes.

    Each file is checked against the index. Files that were packed unchanged come out byte for byte.
    Depth that blosc2 packed becomes FFV1 video again, with the same numbers, times and tags.
    Nothing is overwritten. To continue a stopped run, run it again: it keeps the scenes that exist.
    """
    from stereogenbench_data.shards.unpack import unpack as unpacked

    with progress_bar("unpacking", unit="MB") as progress:
        report = unpacked(
            source.shards,
            out,
            root=source.data_root,
            **work.options(),
            progress=progress,
        )
    if as_json:
        typer.echo(json.dumps(asdict(report) | {"out": str(out)}, indent=2))
        return
    were = "was" if len(report.kept) == 1 else "were"
    typer.echo(
        f"{out}: {counted(len(report.unpacked), 'scene')} unpacked, {len(report.kept)} {were} "
        f"there before"
    )
