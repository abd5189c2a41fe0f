"""``stereogenbench pack``, ``verify``, ``unpack``: released trees into tar shards, and back."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from stereogenbench_data.cli.errors import FINDINGS
from stereogenbench_data.cli.options import (
    CamerasOption,
    DataOptions,
    JsonOption,
    OutArgument,
    OutOption,
    PartOption,
    SceneOptions,
    ShardsArgument,
    ShareOptions,
    SizeOption,
    WorkOptions,
    flag,
    grouped,
    option,
)
from stereogenbench_data.cli.progress import progress_bar
from stereogenbench_data.cli.screen import Part
from stereogenbench_data.cli.writing import print_and_write
from stereogenbench_data.schema.text import counted, plain_line

if TYPE_CHECKING:
    from stereogenbench_data.index.table import SceneIndex
    from stereogenbench_data.shards.training import TrainingSettings
    from stereogenbench_data.shards.verify import Problem


@grouped
def pack(  # noqa: PLR0913 - one parameter an option
    source: DataOptions,
    out: OutArgument,
    *,
    shard_size: Annotated[
        str, option("Largest shard, such as 500MB or 2GiB; a scene is never divided.")
    ] = "2GB",
    part: PartOption = "1/1",
    size: SizeOption = None,
    quality: Annotated[
        Literal["small", "balanced", "high"] | None,
        option("With --size: fewest bytes, or least error [balanced]."),
    ] = None,
    cameras: CamerasOption = None,
    chosen: SceneOptions,
    share: ShareOptions,
    work: WorkOptions,
    depth_codec: Annotated[
        Literal["released", "blosc2"],
        option("As released, or lossless and ten times as fast to decode."),
    ] = "released",
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

    Example: `stereogenbench pack scenes/ packed/ --shard-size 2GB`
    """
    from stereogenbench_data.selection.filters import filter_scenes
    from stereogenbench_data.shards.pack import pack as packed_by
    from stereogenbench_data.shards.plan import packed_bytes, parse_bytes

    for name, value in (("--quality", quality), ("--cameras", cameras)):
        if value and size is None:
            raise typer.BadParameter("is of training shards: give --size.", param_hint=name)
    if size is not None and depth_codec != "released":
        raise typer.BadParameter(
            "training shards have depth of their own: leave it out.", param_hint="--depth-codec"
        )
    target_bytes = parse_bytes(shard_size)
    index = source.open()
    training = None if size is None else _training(index, size, quality, cameras)
    filters: Any = chosen.filters()
    rows = filter_scenes(index, filters).tolist() if filters or share.is_given else None
    if rows is not None and share.is_given:
        sizes = [
            packed_bytes(index.indexed_scene(row), depth_codec=depth_codec, training=training)
            for row in rows
        ]
        rows = share.rows(index, rows, sizes)
    with progress_bar("packing", unit="MB") as progress:
        report = packed_by(
            index,
            out,
            target_bytes=target_bytes,
            depth_codec=depth_codec,
            training=training,
            rows=rows,
            part=part,
            **work.options(),
            progress=progress,
        )
    kept = len(report.part) - len(report.packed)
    typer.echo(f"{out}: {counted(len(report.packed), 'shard')} packed, {kept} kept")
    if report.index is None:
        typer.echo(
            f"{counted(len(report.missing), 'shard')} of the plan to be packed yet, from "
            f"{report.missing[0]} on: the part that packs the last one writes the index"
        )
    else:
        typer.echo(f"{report.index}: {counted(report.scenes, 'scene')}")


def _training(
    index: "SceneIndex", size: tuple[int, int], quality: Any, cameras: tuple[int, ...] | None
) -> "TrainingSettings":
    from stereogenbench_data.schema.records import DepthEncoding
    from stereogenbench_data.shards.training import TrainingSettings

    stated = [shape.depth.encoding.accept for shape in index.shapes if shape.depth is not None]
    depth = DepthEncoding(accept=frozenset().union(*stated))
    return TrainingSettings(size, quality or "balanced", cameras, depth)


@grouped
def verify(
    shards: ShardsArgument,
    *,
    deep: Annotated[bool, flag("--deep", "Decode every video, and count its frames.")] = False,
    out: OutOption = None,
    as_json: JsonOption = False,
    work: WorkOptions,
) -> None:
    """Read every byte of shards, and list what is wrong.

    --out also writes the list to a file (as JSON if the name ends with .json).
    The exit status is 0 if nothing is wrong, 1 if something is, 2 if they cannot be verified.

    Example: `stereogenbench verify shards/ --deep`
    """
    from stereogenbench_data.shards.verify import verify as verified

    with progress_bar("verifying", unit="MB") as progress:
        report = verified(
            shards, mode="decode" if deep else "bytes", **work.options(), progress=progress
        )
    decoded = f", {counted(report.videos_decoded, 'video')} decoded" if deep else ""
    told = [
        f"{report.root}: {counted(report.shards, 'shard')}, {counted(report.scenes, 'scene')}, "
        f"{counted(report.members, 'member')}, {report.bytes / 1e6:.1f} MB{decoded}; "
        f"{counted(len(report.problems), 'problem')}",
        *([f"{report.root}: {report.derived}"] if report.derived else []),
    ]
    print_and_write(
        (". ".join(told), _problems_by_kind(report.problems)),
        text="\n".join(map(plain_line, [*told, *map(str, report.problems)])),
        document=json.dumps(asdict(report), indent=2),
        out=out,
        as_json=as_json,
    )
    if report.problems:
        raise typer.Exit(FINDINGS)


def _problems_by_kind(problems: "Sequence[Problem]") -> list[Part]:
    """Return the table of what is wrong, a row a kind; none if nothing is."""
    kinds: dict[str, list[Problem]] = {}
    for each in problems:
        kinds.setdefault(each.kind, []).append(each)
    rows = [(kind, str(len(found)), str(found[0])) for kind, found in kinds.items()]
    return [("", [("problem", "count", "the first"), *rows])] if rows else []


def unpack(shards: ShardsArgument, out: OutArgument) -> None:
    """Turn shards back into scenes.

    Each file is checked against the index. Files that were packed unchanged come out byte for byte.
    Depth that blosc2 packed becomes FFV1 video again, with the same numbers, times and tags.
    Nothing is overwritten. To continue a stopped run, run it again: it keeps the files that exist.

    Example: `stereogenbench unpack shards/ scenes/`
    """
    from stereogenbench_data.shards.unpack import unpack as unpacked

    with progress_bar("unpacking", unit="MB") as progress:
        report = unpacked(shards, out, progress=progress)
    unpacked_now = counted(len(report.unpacked), "scene")
    typer.echo(f"{out}: {unpacked_now} unpacked, {len(report.kept)} kept")
