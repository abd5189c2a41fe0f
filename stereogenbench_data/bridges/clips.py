"""Clips of stereo pairs as video files, in the layouts that trainers of video models read.

    OUT/export.json          what the folder holds; a run with other settings is refused
    OUT/<kind>/<clip>.mp4    the videos of each clip: right, left, warped, mask, depth, disparity
    OUT/clips/<clip>.json    what is known of a finished clip; written after its videos
    OUT/clips.jsonl          the same of all clips, one a line
    OUT/...                  the manifests of the layout (`clip_layouts`); written last

The right view is what is to be generated. ``warped`` is the left view splatted into the right one,
black in holes; ``mask`` is white in holes, and lossless. ``depth`` is grey by inverse depth, white
at the clip's nearest point; ``disparity`` is grey by pixels, white at the clip's largest. ``grid``,
StereoCrafter's input, has left and depth above mask and warped.
"""

import json
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, Unpack, cast, get_args

import numpy as np

from stereogenbench_data.bridges.clip_layouts import (
    LAYOUTS,
    ClipLayout,
    Kind,
    LayoutName,
    lines,
)
from stereogenbench_data.bridges.exports import alone, scene_filters, training_selection
from stereogenbench_data.bridges.generation import Captions, describe_pair
from stereogenbench_data.datasets.mapped import Data, StereoPairs
from stereogenbench_data.engine import LOCAL, Advance, Engine, Progress
from stereogenbench_data.errors import (
    MediaError,
    SelectionError,
)
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.jobs import (
    do_items,
    job_folder,
    json_bytes,
    named_errors,
    read_json,
)
from stereogenbench_data.media.encoder import Encoding, VideoEncoder
from stereogenbench_data.samples.fields import Sample
from stereogenbench_data.samples.load import SampleLoader
from stereogenbench_data.samples.request import Request
from stereogenbench_data.samples.size import require_size
from stereogenbench_data.samples.transforms import Crop
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.selection.filters import SceneFilters, filter_scenes
from stereogenbench_data.selection.options import require_options
from stereogenbench_data.selection.plan import Address, PairOptions, Plan
from stereogenbench_data.selection.windows import FramesSpec, parse_frames
from stereogenbench_data.sources.files import open_atomic, write_atomic

_FORMAT: Final = 1
_CLIPS_JSONL: Final = "clips.jsonl"
_CLIPS: Final = "clips"

_FIELDS: Final[Mapping[Kind, tuple[str, ...]]] = {
    "right": ("right",),
    "left": ("left",),
    "warped": ("warped_right",),
    "mask": ("hole",),
    "depth": ("depth", "valid"),
    "disparity": ("disparity", "valid"),
    "grid": ("left", "warped_right", "hole", "depth", "valid"),
}
_FACTS: Final = ("scene", "split", "pair", "caption", "baseline_m", "frame_rate_hz")


Fit = Literal["stretch", "crop"]


class ClipSizeWarning(UserWarning):
    """Pictures of this size are cut or scaled by the trainer."""


@dataclass(frozen=True, slots=True)
class ClipForm:
    """What a clip is.

    Attributes:
        length: Its frames; None for the longest that every scene has and the layout takes.
        stride: Every so many frames of the video is one of the clip.
        step: Frames of the video from one clip's first to the next one's; None for no overlap.
        size: (height, width) in pixels, or a text "WIDTHxHEIGHT"; None for the stored size.
        fit: What becomes of pictures of another shape than the size: "stretch", or "crop" to scale
            them until they cover it and cut to the middle.
        rate_hz: The rate that the files state; None for the video's own, divided by the stride. No
            frame is dropped or repeated for it.
        length_rule: "layout" for lengths that the trainer takes whole (4N+1, of StereoCrafter
            any), or "any".
        also: Kinds of videos besides those of the layout, such as "depth" and "disparity".
        control: The kind that the manifest names as control; "layout" for the layout's own, or
            "none".
        captions: "plain", or "with baseline" for captions that tell it.
        encoding: How videos are encoded; masks are lossless in any case.
    """

    length: int | None = None
    stride: int = 1
    step: int | None = None
    size: tuple[int, int] | str | None = None
    fit: Fit = "stretch"
    rate_hz: float | None = None
    length_rule: Literal["layout", "any"] = "layout"
    also: tuple[Kind, ...] = ()
    control: str = "layout"
    captions: Captions = "plain"
    encoding: Encoding = field(default_factory=Encoding)


@dataclass(frozen=True, slots=True)
class ExportRun:
    """How clips are exported; it changes nothing in a file, but for the depth contract.

    Attributes:
        depth: A depth contract instead of the one that files and release state.
        workers: How many processes write, None for one a core.
        engine: Where they are: `engine.LOCAL`, or an `engine.RayCluster`.
        progress: Called with (frames written, frames in all).
    """

    depth: DepthEncoding | None = None
    workers: int | None = None
    engine: Engine = LOCAL
    progress: Progress | None = None


_USUAL_FORM: Final = ClipForm()
_USUAL_RUN: Final = ExportRun()


class ClipReport(NamedTuple):
    """What an export did.

    Attributes:
        written: Names of the clips that were written now.
        kept: Names of those that were there before.
        manifests: The manifests that were written.
        evaluation_scenes: How many scenes of the split eval were left out.
        without_caption: How many clips have an empty caption.
    """

    written: tuple[str, ...]
    kept: tuple[str, ...]
    manifests: tuple[Path, ...]
    evaluation_scenes: int
    without_caption: int


class ClipSelection(SceneFilters, PairOptions, total=False):
    """Which pairs of which scenes clips are made of; ``seed`` is that of a balanced subsample."""

    seed: int


def export_clips(
    data: Data,
    out: str | Path,
    *,
    layout: LayoutName,
    form: ClipForm = _USUAL_FORM,
    run: ExportRun = _USUAL_RUN,
    **selection: Unpack[ClipSelection],
) -> ClipReport:
    """Write clips and the manifests of a layout.

    Each video is written whole or not at all, and finished clips are kept, so that a stopped run
    goes on if it is run again. The manifests are written when all clips are there. Evaluation
    scenes are exported only where ``split`` names them: a model that was trained on them cannot be
    evaluated on them.

    Args:
        data: As for `StereoPairs`.
        out: A new or empty folder, or one that this export was begun in.
        layout: "diffsynth", "finetrainers", "musubi" or "stereocrafter".
        form: What a clip is.
        run: How the export is run.
        **selection: Filters on scenes (`SceneFilters`), pairs, baseline_cm, balance and limit.

    Raises:
        SelectionError: If nothing matches; if there is no such layout or kind of video; if the
            trainer would cut a clip of this length; or if all that match are evaluation scenes,
            and ``split`` does not name them.
        StorageError: If the folder holds something else, another process exports into it, or
            something cannot be read or written.
        MediaError: If a video cannot be decoded, or not be encoded as asked.
    """
    require_options(export_clips, selection)
    root = Path(out)
    if layout not in LAYOUTS:
        raise SelectionError(f"layout must be one of {', '.join(LAYOUTS)}, got {layout!r}.")
    rules = LAYOUTS[layout]
    kinds, control = _require_kinds(form, rules=rules, layout=layout)
    size = None if form.size is None else require_size(form.size)
    index = data if isinstance(data, SceneIndex) else SceneIndex.open(data)
    chosen, evaluation_scenes = training_selection(index, selection)
    chosen["frames"] = _windows(index, form, rules=rules, layout=layout, selection=chosen)
    fields = dict.fromkeys(name for kind in kinds for name in _FIELDS[kind])
    stretched = size if form.fit == "stretch" else None
    plan = StereoPairs(index, fields=fields, size=stretched, depth=run.depth, **chosen).plan
    _require_left_to_right(plan)
    _warn_of_sizes(index, plan, size=size, rules=rules, layout=layout)
    settings = {
        "format": _FORMAT,
        "layout": layout,
        "videos": list(kinds),
        "control": control,
        "form": asdict(form) | {"size": size and list(size), "also": None, "control": None},
        "depth": repr(run.depth),
        "data": index.digest,
        "selection": plan.digest,
    }
    facts = StereoPairs(index, fields=_FACTS, **chosen)
    works = _works(facts, _Export(root, form, kinds, size, run.depth))
    with job_folder(root, settings):
        due = [work for work in works if not _is_finished(work)]
        still, total = (sum(len(work.address.frames) for work in each) for each in (due, works))
        do_items(
            _write_clip,
            due,
            name=lambda work: work.name,
            workers=run.workers,
            engine=run.engine,
            progress=run.progress,
            done=total - still,
            total=total,
        )
        clips = [read_json(work.record) for work in works]
        texts = {_CLIPS_JSONL: lines(json.dumps(clip, ensure_ascii=False) for clip in clips)}
        texts |= rules.manifests(root, clips, control)
        with named_errors(root):
            for name, text in texts.items():
                write_atomic(root / name, text.encode())
    written = {work.name for work in due}
    return ClipReport(
        written=tuple(work.name for work in due),
        kept=tuple(work.name for work in works if work.name not in written),
        manifests=tuple(root / name for name in texts if "/" not in name),
        evaluation_scenes=evaluation_scenes,
        without_caption=sum(not clip["caption"] for clip in clips),
    )


# What is asked for.


def _require_kinds(
    form: ClipForm, *, rules: ClipLayout, layout: LayoutName
) -> tuple[tuple[Kind, ...], Kind | None]:
    """Return the kinds of videos of each clip, and which of them is the control."""
    known = [kind for kind in get_args(Kind) if kind != "grid"]
    if form.fit not in get_args(Fit):
        raise SelectionError(f"fit must be one of {get_args(Fit)}, got {form.fit!r}.")
    for kind in form.also:
        if kind not in known:
            raise SelectionError(f"also: videos are {', '.join(known)}; got {kind!r}.")
    control: Any = {"layout": rules.control, "none": None}.get(form.control, form.control)
    if control is not None and control not in rules.controls:
        raise SelectionError(
            f"control={control!r}: the layout {layout} takes {', '.join(rules.controls) or 'none'}."
        )
    kinds = (*rules.kinds, *form.also, *([control] if control else []))
    return tuple(dict.fromkeys(kinds)), control


def _windows(
    index: SceneIndex,
    form: ClipForm,
    *,
    rules: ClipLayout,
    layout: LayoutName,
    selection: Mapping[str, Any],
) -> FramesSpec:
    """Return the frames of clips, as `StereoPairs` takes them."""
    unit = 1 if form.length_rule == "any" else rules.frames_step
    length = form.length
    if length is None:
        parse_frames(("clips", 1, form.stride))
        rows = filter_scenes(index, scene_filters(selection))
        shortest = int(index.column("frames")[rows].min())
        length = (shortest - 1) // form.stride // unit * unit + 1
    elif (length - 1) % unit:
        below = max(0, length - 1) // unit * unit + 1
        raise SelectionError(
            f"length={length}: {layout} takes clips of {unit}N+1 frames and cuts others: give "
            f"{below} or {below + unit}, or length_rule='any'."
        )
    step = () if form.step is None else (form.step,)
    spec = cast("FramesSpec", ("clips", length, form.stride, *step))
    parse_frames(spec)
    return spec


def _require_left_to_right(plan: Plan) -> None:
    pairs = plan.pairs
    if pairs.targets.shape[1] != 1 or (pairs.source > pairs.targets[:, 0]).any():
        raise SelectionError(
            "a right view is generated from the view to its left: choose pairs='primary', "
            "'adjacent', 'all' or (left, right) numbers."
        )


def _warn_of_sizes(
    index: SceneIndex,
    plan: Plan,
    *,
    size: tuple[int, int] | None,
    rules: ClipLayout,
    layout: LayoutName,
) -> None:
    side = rules.side_px
    columns = (index.column(f"image_{name}_px")[plan.scene_rows] for name in ("height", "width"))
    for height, width in [size] if size is not None else sorted(set(zip(*columns, strict=True))):
        if height % side or width % side:
            cut = f"{max(1, width // side) * side}x{max(1, height // side) * side}"
            warnings.warn(
                f"pictures of {width}x{height} pixels: the trainer of the layout {layout} takes "
                f"sides that are multiples of {side} and cuts or scales others. Give a size such "
                f"as {cut}.",
                ClipSizeWarning,
                stacklevel=3,
            )


# One clip.


@dataclass(frozen=True, slots=True)
class _Export:
    """What all clips of an export have in common.

    Attributes:
        root: The folder of the export.
        form: What a clip is.
        kinds: The videos of a clip.
        size: (height, width) in pixels, or None.
        depth: A depth contract that overrides what the index says, or None.
    """

    root: Path
    form: ClipForm
    kinds: tuple[Kind, ...]
    size: tuple[int, int] | None
    depth: DepthEncoding | None


@dataclass(frozen=True, slots=True)
class _ClipWork:
    """One clip to be written, by whatever process.

    Attributes:
        export: What it has in common with others.
        index: An index of its scene alone.
        address: Its cameras and frames, of row 0.
        facts: What is known of it before its videos are read.
        name: The name of its files.
    """

    export: _Export
    index: SceneIndex
    address: Address
    facts: dict[str, Any]
    name: str

    @property
    def record(self) -> Path:
        """The file that says that the clip is finished."""
        return self.export.root / _CLIPS / f"{self.name}.json"

    @property
    def videos(self) -> dict[Kind, str]:
        """The file of each kind of video, relative to the folder."""
        # The ending of a grid is StereoCrafter's own.
        ends = {"grid": "_splatting_results"}
        return {kind: f"{kind}/{self.name}{ends.get(kind, '')}.mp4" for kind in self.export.kinds}

    def request(self, fields: Sequence[str]) -> Request:
        """Return what is read of every frame."""
        size, transform = self.export.size, None
        if size is not None and self.export.form.fit == "crop":
            rig, (height, width) = self.index.scene(0).rig, size
            scale = max(height / rig.image_height_px, width / rig.image_width_px)
            size = (
                max(height, round(rig.image_height_px * scale)),
                max(width, round(rig.image_width_px * scale)),
            )
            top, left = (size[0] - height) // 2, (size[1] - width) // 2
            transform = Crop(top, left, height, width)
        depth = self.export.depth
        return Request(
            "pairs", tuple(fields), "single", size=size, depth=depth, transform=transform
        )


def _works(clips: StereoPairs, export: _Export) -> list[_ClipWork]:
    """Return all clips of a selection with the fields `_FACTS`, in its order."""
    index, works, scenes = clips.index, [], {}
    for number in range(len(clips)):
        row, source, targets, frames, _ = clips.plan.locate(number, epoch=0)
        if row not in scenes:
            scenes = {row: alone(index, row)}
        facts = _facts(clips[number], frames=frames, form=export.form)
        address = Address(0, source, targets, frames)
        works.append(_ClipWork(export, scenes[row], address, facts, _clip_name(number, facts)))
    return works


def _facts(sample: Sample, *, frames: tuple[int, ...], form: ClipForm) -> dict[str, Any]:
    # Trainers read captions by line: all that Python takes to end one becomes a space.
    caption = " ".join(sample["caption"].split())
    baseline_m = float(sample["baseline_m"])
    if form.captions == "with baseline":
        caption = describe_pair(caption, baseline_m=baseline_m)
    rate_hz = float(sample["frame_rate_hz"] if form.rate_hz is None else form.rate_hz)
    if not 0 < rate_hz < math.inf:
        raise MediaError(
            f"{sample['scene']}: the clip's rate is {rate_hz:g} frames a second: give rate_hz "
            "above 0."
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


def _clip_name(number: int, facts: Mapping[str, Any]) -> str:
    """Return the name of a clip: its number, scene, cameras and frames.

    The split is not in it: Hugging Face datasets divides files by words such as "train" in names.
    """
    scene = "_".join(facts["scene"].split("/")[-3:])
    (left, right), frames = facts["pair"], facts["frames"]
    return f"{number:06d}_{scene}_{left:02d}-{right:02d}_{frames[0]:03d}-{frames[-1]:03d}"


def _is_finished(work: _ClipWork) -> bool:
    """Return whether a clip's videos are there, with the sizes that were noted."""
    if not work.record.is_file():
        return False
    sizes = read_json(work.record).get("bytes", {})
    paths = {kind: work.export.root / path for kind, path in work.videos.items()}
    return all(
        path.is_file() and path.stat().st_size == sizes.get(kind) for kind, path in paths.items()
    )


def _write_clip(work: _ClipWork, advance: Advance) -> None:
    """Write the videos of a clip, then its record."""
    fields = dict.fromkeys(name for kind in work.videos for name in _FIELDS[kind])
    draws_maps = {"depth", "disparity", "grid"} & work.videos.keys()
    ranges = _map_ranges(work) if draws_maps else _MapRanges(0.0, 0.0, 0.0)
    with (
        named_errors(work.export.root),
        closing(SampleLoader(work.index, work.request([*fields]), check="opened")) as loader,
        ExitStack() as stack,
    ):
        encoders = {kind: stack.enter_context(_encoder(work, kind)) for kind in work.videos}
        for sample in _frames(work, loader):
            for kind, encoder in encoders.items():
                encoder.write_picture(_picture(kind, sample, ranges))
            advance(1)
        height, width = sample["right"].shape[-2:]
    record: dict[str, Any] = work.facts | {"height": height, "width": width}
    if draws_maps:
        record["depth_m"] = [1 / each if each else None for each in ranges[:2][::-1]]
        record["disparity_max_px"] = ranges.largest_px
    record["videos"] = work.videos
    record["bytes"] = {
        kind: (work.export.root / path).stat().st_size for kind, path in work.videos.items()
    }
    with named_errors(work.record):
        work.record.parent.mkdir(exist_ok=True)
        write_atomic(work.record, json_bytes(record))


def _frames(work: _ClipWork, loader: SampleLoader) -> Iterator[Sample]:
    for frame in work.address.frames:
        address = Address(0, work.address.source, work.address.targets, (frame,))
        yield loader.load(address, clip="frame")


@contextmanager
def _encoder(work: _ClipWork, kind: Kind) -> Iterator[VideoEncoder]:
    path = work.export.root / work.videos[kind]
    path.parent.mkdir(exist_ok=True)
    with (
        open_atomic(path) as file,
        VideoEncoder(
            file,
            rate_hz=work.facts["frame_rate_hz"],
            encoding=work.export.form.encoding,
            quality="lossless" if kind == "mask" else "as set",
        ) as encoder,
    ):
        yield encoder


class _MapRanges(NamedTuple):
    """What of a clip is drawn black and white: inverse depth in 1/m, disparity in px."""

    farthest: float
    nearest: float
    largest_px: float


def _map_ranges(work: _ClipWork) -> _MapRanges:
    inverse, disparity = [], [0.0]
    request = work.request(("depth", "disparity", "valid"))
    with closing(SampleLoader(work.index, request)) as loader:
        for sample in _frames(work, loader):
            if sample["valid"].any():
                found = 1 / sample["depth"][sample["valid"]]
                inverse += [float(found.min()), float(found.max())]
                disparity.append(float(np.abs(sample["disparity"]).max()))
    return _MapRanges(min(inverse, default=0.0), max(inverse, default=0.0), max(disparity))


def _picture(kind: Kind, sample: Sample, ranges: _MapRanges) -> Any:
    """Return one frame of a kind of video as (h, w, 3) uint8."""
    if kind == "grid":
        rows: tuple[tuple[Kind, Kind], ...] = (("left", "depth"), ("mask", "warped"))
        cells = [[_picture(each, sample, ranges) for each in row] for row in rows]
        return np.concatenate([np.concatenate(row, axis=1) for row in cells], axis=0)
    if kind in ("left", "right", "warped"):
        name = "warped_right" if kind == "warped" else kind
        return np.ascontiguousarray(sample[name].transpose(1, 2, 0))
    is_mask = kind == "mask"
    grey = sample["hole"][0] * np.uint8(255) if is_mask else _grey_map(kind, sample, ranges)
    return np.repeat(grey[..., None], 3, axis=-1)


def _grey_map(kind: Kind, sample: Sample, ranges: _MapRanges) -> Any:
    valid = sample["valid"][0]
    if kind == "depth":
        inverse = 1 / np.where(valid, sample["depth"][0], 1)
        low, high = ranges.farthest, ranges.nearest
        share = (inverse - low) / (high - low) if high > low else np.ones_like(inverse)
    else:
        share = np.abs(sample["disparity"][0]) / (ranges.largest_px or 1.0)
    return np.rint(np.where(valid, share, 0).clip(0, 1) * 255).astype(np.uint8)
