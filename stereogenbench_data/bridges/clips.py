"""Clips of stereo pairs as video files, in the layouts that trainers of video models read.

    OUT/export.json          what the folder holds; a run with other settings is refused
    OUT/<kind>/<clip>.mp4    the videos of each clip: right, left, warped, mask; or grid and right
    OUT/clips/<clip>.json    what is known of a finished clip; written after its videos
    OUT/clips.jsonl          the same of all clips, one a line
    OUT/...                  the manifests of the layout (`LAYOUTS`); written last

The right view is what is to be generated. ``warped`` is the left view splatted into the right one,
black in holes; ``mask`` is white in holes, and lossless. ``grid``, StereoCrafter's input, has left
and black above mask and warped.
"""

import csv
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass
from io import StringIO
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, Unpack, cast

import numpy as np

from stereogenbench_data.bridges.exports import depth_setting, training_filters
from stereogenbench_data.bridges.generation import Captions, describe_pair
from stereogenbench_data.datasets.mapped import Data, StereoPairs
from stereogenbench_data.engine import Advance
from stereogenbench_data.errors import MediaError, SelectionError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.jobs import (
    WORK_DEFAULTS,
    WorkOptions,
    do_items,
    job_folder,
    json_bytes,
    named_errors,
    read_json,
)
from stereogenbench_data.media.encoder import Encoding, VideoEncoder
from stereogenbench_data.samples.fields import Request, Sample
from stereogenbench_data.samples.load import SampleDecoder
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.selection.filters import SceneFilters, filter_scenes
from stereogenbench_data.selection.options import require_options
from stereogenbench_data.selection.plan import (
    SELECTION_DEFAULTS,
    Address,
    FramesSpec,
    PairOptions,
    parse_frames,
)
from stereogenbench_data.selection.signatures import list_options
from stereogenbench_data.sources.files import open_atomic, write_atomic

Kind = Literal["right", "left", "warped", "mask", "grid"]
"""What a video of a clip shows: see `clips`."""

LayoutName = Literal["diffsynth", "finetrainers", "musubi", "stereocrafter"]

Record = Mapping[str, Any]
"""What is known of a finished clip: scene, split, pair, frames, frame_rate_hz, baseline_m, caption,
height, width, and ``videos``, the file of each kind, relative to the folder of the export."""


@dataclass(frozen=True, slots=True)
class ClipLayout:
    """What a trainer is given, and what it takes.

    Attributes:
        manifests: Makes the manifests of a folder and its clips.
        kinds: The videos of every clip.
        frames_step: Clips have a multiple of this many frames, and one more: the trainer cuts
            others.
    """

    manifests: Callable[[Path, Sequence[Record]], dict[str, str]]
    kinds: tuple[Kind, ...] = ("right", "left", "warped", "mask")
    frames_step: int = 4


def lines(texts: Iterable[str]) -> str:
    """Return texts as lines."""
    return "".join(f"{text}\n" for text in texts)


_DIFFSYNTH: Final[Mapping[str, Kind]] = {
    "video": "right",
    "vace_video": "warped",
    "vace_video_mask": "mask",
    "control_video": "warped",
    "left_video": "left",
}
"""The columns of videos, which are inputs of the pipelines."""


def _diffsynth(root: Path, clips: Sequence[Record]) -> dict[str, str]:
    """Return metadata.csv.

    Source: modelscope/DiffSynth-Studio, diffsynth/core/data/unified_dataset.py.
    """
    rows = [
        {name: clip["videos"][kind] for name, kind in _DIFFSYNTH.items()}
        | {"prompt": _csv_text(clip["caption"])}
        | {name: clip[name] for name in ("baseline_m", "frame_rate_hz", "height", "width", "scene")}
        | {"num_frames": len(clip["frames"])}
        for clip in clips
    ]
    text = StringIO()
    writer = csv.DictWriter(text, fieldnames=[*rows[0]], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return {"metadata.csv": text.getvalue()}


def _csv_text(text: str) -> str:
    """Return a text that pandas reads as one: an empty cell, or "NA", would become a number."""
    return text if " " in text else f"{text} "


def _finetrainers(root: Path, clips: Sequence[Record]) -> dict[str, str]:
    """Return two lists of captions and files, and the configuration.

    Source: a-r-r-o-w/finetrainers, finetrainers/data/dataset.py and docs/dataset/README.md.
    """
    sizes = {(len(clip["frames"]), clip["height"], clip["width"]) for clip in clips}
    dataset = {
        "data_root": str(root.resolve()),
        "dataset_type": "video",
        "video_resolution_buckets": sorted(map(list, sizes)),
        "reshape_mode": "bicubic",
    }
    return {
        "dataset.json": json.dumps({"datasets": [dataset]}, indent=1) + "\n",
        "prompt.txt": lines(clip["caption"] for clip in clips),
        "videos.txt": lines(clip["videos"]["right"] for clip in clips),
    }


def _musubi(root: Path, clips: Sequence[Record]) -> dict[str, str]:
    """Return the dataset's configuration, and a caption beside each video.

    Source: kohya-ss/musubi-tuner, docs/dataset_config.md.
    """
    folder = root.resolve()
    dataset = {
        "video_directory": str(folder / "right"),
        "control_directory": str(folder / "warped"),
        "cache_directory": str(folder / "cache"),
        "target_frames": sorted({len(clip["frames"]) for clip in clips}),
        "frame_extraction": "head",
    }
    general = {
        "resolution": [clips[0]["width"], clips[0]["height"]],
        "caption_extension": ".txt",
        "batch_size": 1,
        "enable_bucket": True,
        "bucket_no_upscale": False,
    }
    # JSON writes such texts, numbers and lists as TOML does, but for one control character.
    texts = []
    for header, values in (("[general]", general), ("[[datasets]]", dataset)):
        pairs = (
            f"{name} = {json.dumps(each, ensure_ascii=False)}" for name, each in values.items()
        )
        texts += [header, *pairs, ""]
    toml = lines(texts).replace("\x7f", "\\u007f")
    captions = {
        str(Path(clip["videos"]["right"]).with_suffix(".txt")): lines([clip["caption"]])
        for clip in clips
    }
    return captions | {"dataset.toml": toml}


LAYOUTS: Final[Mapping[LayoutName, ClipLayout]] = {
    "diffsynth": ClipLayout(_diffsynth),
    "finetrainers": ClipLayout(_finetrainers),
    "musubi": ClipLayout(_musubi),
    # It takes the grids one by one, and ignores the quarter at the top right.
    # Source: TencentARC/StereoCrafter, inpainting_inference.py.
    "stereocrafter": ClipLayout(lambda root, clips: {}, kinds=("grid", "right"), frames_step=1),
}

_FORMAT: Final = 5
_CLIPS_JSONL: Final = "clips.jsonl"
_CLIPS: Final = "clips"

_FIELDS: Final[Mapping[Kind, tuple[str, ...]]] = {
    "right": ("right",),
    "left": ("left",),
    "warped": ("warped_right",),
    "mask": ("hole",),
    "grid": ("left", "warped_right", "hole"),
}
_FACTS: Final = ("scene", "split", "pair", "caption", "baseline_m", "frame_rate_hz")


class ClipOptions(WorkOptions, SceneFilters, PairOptions, total=False):
    """What a clip is, which pairs of which scenes clips are made of, and how they are written.

    Progress is in frames.

    Attributes:
        length: Its frames; the longest that every scene has and the layout takes unless given.
        stride: Frames of the video from one frame of the clip to the next.
        step: Frames of the video from one clip's first to the next one's; no overlap unless given.
        size: (height, width) in pixels, or a text "WIDTHxHEIGHT"; None for the stored size.
        captions: "plain", or "with baseline" for captions that tell it.
        encoding: How videos are encoded; masks are lossless in any case.
        seed: That of a balanced subsample.
        depth: A depth encoding instead of the one that files and release state.
    """

    length: int | None
    stride: int
    step: int | None
    size: tuple[int, int] | str | None
    captions: Captions
    encoding: Encoding
    seed: int
    depth: DepthEncoding | None


CLIP_DEFAULTS: Final = {
    **WORK_DEFAULTS, "stride": 1, "captions": "plain", "encoding": Encoding(), "seed": 0,
}  # fmt: skip


class ClipReport(NamedTuple):
    """What an export did.

    Attributes:
        written: Names of the clips that were written now.
        kept: Names of those that were there before.
        manifests: The manifests that were written.
        without_caption: How many clips have an empty caption.
    """

    written: tuple[str, ...]
    kept: tuple[str, ...]
    manifests: tuple[Path, ...]
    without_caption: int


@list_options(SELECTION_DEFAULTS, CLIP_DEFAULTS)
def export_clips(
    data: Data, out: str | Path, *, layout: LayoutName, **options: Unpack[ClipOptions]
) -> ClipReport:
    """Write clips and the manifests of a layout.

    Each video is written whole or not at all, and finished clips are kept, so that a stopped run
    goes on if it is run again. The manifests are written when all clips are there. Evaluation
    scenes are exported only where ``split`` names them or is "all": a model that was trained on
    them cannot be evaluated on them.

    Args:
        data: As for `StereoPairs`.
        out: A new or empty folder, or one that this export was begun in.
        layout: "diffsynth", "finetrainers", "musubi" or "stereocrafter".
        **options: What clips are, of what they are made, and how (`ClipOptions`).

    Raises:
        SelectionError: If nothing matches; if there is no such layout or option; if the trainer
            would cut a clip of this length.
        StorageError: If the folder holds something else, another process exports into it, or
            something cannot be read or written.
        MediaError: If a video cannot be decoded, or not be encoded as asked.
    """
    require_options(export_clips, options)
    root = Path(out)
    if layout not in LAYOUTS:
        raise SelectionError(f"layout must be one of {', '.join(LAYOUTS)}, got {layout!r}.")
    rules = LAYOUTS[layout]
    index = data if isinstance(data, SceneIndex) else SceneIndex.open(data)
    filters, names = training_filters(options), {*PairOptions.__annotations__, "seed"}
    chosen: dict[str, Any] = {name: value for name, value in options.items() if name in names}
    chosen |= {**filters, "frames": _windows(index, layout, options, filters=filters)}
    fields = dict.fromkeys(name for kind in rules.kinds for name in _FIELDS[kind])
    pairs = StereoPairs(
        index, fields=fields, size=options.get("size"), depth=options.get("depth"), **chosen
    )
    targets = pairs.plan.pairs.targets
    if targets.shape[1] != 1 or (pairs.plan.pairs.source > targets[:, 0]).any():
        raise SelectionError(
            "a right view is generated from the view to its left: choose pairs='primary', "
            "'adjacent', 'all' or (left, right) numbers."
        )
    encoding = options.get("encoding", Encoding())
    settings = {
        "format": _FORMAT,
        "layout": layout,
        "frames": chosen["frames"],
        "size": pairs.request.size,
        "captions": options.get("captions", "plain"),
        "encoding": asdict(encoding),
        "depth": depth_setting(options.get("depth")),
        "data": index.digest,
        "selection": pairs.plan.digest,
    }
    clips_facts = StereoPairs(index, fields=_FACTS, **chosen)
    scenes: dict[int, SceneIndex] = {}
    works = []
    for number in range(len(clips_facts)):
        address = clips_facts.plan.locate(number, epoch=0)
        if address.row not in scenes:
            scenes = {address.row: index.only([address.row])}
        facts = _facts(clips_facts[number], address.frames, options)
        name, scene, place = _clip_name(number, facts), scenes[address.row], address._replace(row=0)
        works.append(
            _ClipWork(root, rules.kinds, pairs.request, encoding, scene, place, facts, name)
        )
    with job_folder(root, settings):
        due = [work for work in works if not _is_finished(work)]
        still, total = (sum(len(work.address.frames) for work in each) for each in (due, works))
        do_items(
            _write_clip,
            due,
            name=lambda work: work.name,
            options=options,
            done=total - still,
            total=total,
        )
        clips = [read_json(work.record) for work in works]
        texts = {_CLIPS_JSONL: lines(json.dumps(clip, ensure_ascii=False) for clip in clips)}
        texts |= rules.manifests(root, clips)
        with named_errors(root):
            for name, text in texts.items():
                write_atomic(root / name, text.encode())
    written = tuple(work.name for work in due)
    return ClipReport(
        written=written,
        kept=tuple(work.name for work in works if work.name not in written),
        manifests=tuple(root / name for name in texts if "/" not in name),
        without_caption=sum(not clip["caption"] for clip in clips),
    )


def _windows(
    index: SceneIndex, layout: LayoutName, options: ClipOptions, *, filters: SceneFilters
) -> FramesSpec:
    """Return the frames of clips, as `StereoPairs` takes them."""
    unit, stride = LAYOUTS[layout].frames_step, options.get("stride", 1)
    length, step = options.get("length"), options.get("step")
    if length is None:
        parse_frames(("clips", 1, stride))
        rows = filter_scenes(index, filters)
        shortest = int(index.column("frames")[rows].min())
        length = (shortest - 1) // stride // unit * unit + 1
    elif (length - 1) % unit:
        below = max(0, length - 1) // unit * unit + 1
        raise SelectionError(
            f"length={length}: {layout} takes clips of {unit}N+1 frames and cuts others: give "
            f"{below} or {below + unit}."
        )
    return cast("FramesSpec", ("clips", length, stride, *(() if step is None else (step,))))


def _facts(sample: Sample, frames: tuple[int, ...], options: ClipOptions) -> dict[str, Any]:
    """Return what is known of a clip before its videos are read."""
    # Trainers read captions by line: all that Python takes to end one becomes a space.
    caption = " ".join(sample["caption"].split())
    baseline_m = float(sample["baseline_m"])
    if options.get("captions") == "with baseline":
        caption = describe_pair(caption, baseline_m=baseline_m)
    rate_hz = float(sample["frame_rate_hz"])
    if not 0 < rate_hz < math.inf:
        raise MediaError(
            f"{sample['scene']}: its videos state {rate_hz:g} frames a second: leave it out."
        )
    return {
        "scene": sample["scene"],
        "split": sample["split"],
        "pair": sample["pair"].tolist(),
        "frames": list(frames),
        "frame_rate_hz": rate_hz,
        "baseline_m": baseline_m,
        "caption": caption,
    }


@dataclass(frozen=True, slots=True)
class _ClipWork:
    """One clip to be written, by whatever process.

    Attributes:
        root: The folder of the export.
        kinds: The videos of the clip.
        request: What is read of every frame.
        encoding: How videos are encoded.
        index: An index of its scene alone.
        address: Its cameras and frames, of row 0.
        facts: What is known of it before its videos are read.
        name: The name of its files.
    """

    root: Path
    kinds: tuple[Kind, ...]
    request: Request
    encoding: Encoding
    index: SceneIndex
    address: Address
    facts: dict[str, Any]
    name: str

    @property
    def record(self) -> Path:
        """The file that says that the clip is finished."""
        return self.root / _CLIPS / f"{self.name}.json"

    @property
    def videos(self) -> dict[Kind, str]:
        """The file of each kind of video, relative to the folder."""
        # The ending of a grid is StereoCrafter's own.
        ends = {"grid": "_splatting_results"}
        return {kind: f"{kind}/{self.name}{ends.get(kind, '')}.mp4" for kind in self.kinds}


def _clip_name(number: int, facts: Mapping[str, Any]) -> str:
    """Return the name of a clip: its number, scene, cameras and frames.

    The split is not in it: Hugging Face datasets divides files by words such as "train" in names.
    """
    scene = "_".join(facts["scene"].split("/")[-3:])
    (left, right), frames = facts["pair"], facts["frames"]
    return f"{number:06d}_{scene}_{left:02d}-{right:02d}_{frames[0]:03d}-{frames[-1]:03d}"


def _is_finished(work: _ClipWork) -> bool:
    """Return whether a clip's videos are there, with the sizes that its record notes after them."""
    if not work.record.is_file():
        return False
    sizes = read_json(work.record).get("bytes", {})
    paths = {kind: work.root / path for kind, path in work.videos.items()}
    return all(
        path.is_file() and path.stat().st_size == sizes.get(kind) for kind, path in paths.items()
    )


def _write_clip(work: _ClipWork, advance: Advance) -> None:
    """Write the videos of a clip, then its record."""
    with named_errors(work.root), ExitStack() as stack:
        encoders = {}
        for kind, path in work.videos.items():
            (work.root / path).parent.mkdir(exist_ok=True)
            file = stack.enter_context(open_atomic(work.root / path))
            encoders[kind] = stack.enter_context(
                VideoEncoder(
                    file,
                    rate_hz=work.facts["frame_rate_hz"],
                    encoding=work.encoding,
                    quality="lossless" if kind == "mask" else "as set",
                )
            )
        loader = stack.enter_context(
            closing(SampleDecoder(work.index, work.request, check="opened"))
        )
        for frame in work.address.frames:
            sample = loader.load(work.address._replace(frames=(frame,)), clip="frame")
            for kind, encoder in encoders.items():
                encoder.write_picture(_picture(kind, sample))
            advance(1)
    height, width = sample["right"].shape[-2:]
    record = work.facts | {
        "height": height,
        "width": width,
        "videos": work.videos,
        "bytes": {kind: (work.root / path).stat().st_size for kind, path in work.videos.items()},
    }
    with named_errors(work.record):
        work.record.parent.mkdir(exist_ok=True)
        write_atomic(work.record, json_bytes(record))


def _picture(kind: Kind, sample: Sample) -> Any:
    """Return one frame of a kind of video as (h, w, 3) uint8."""
    if kind == "grid":
        mask, warped, left = (_picture(each, sample) for each in ("mask", "warped", "left"))
        return np.block([[[left], [np.zeros_like(left)]], [[mask], [warped]]])
    if kind == "mask":
        return np.repeat((sample["hole"][0] * np.uint8(255))[..., None], 3, axis=-1)
    name = "warped_right" if kind == "warped" else kind
    return np.ascontiguousarray(sample[name].transpose(1, 2, 0))
