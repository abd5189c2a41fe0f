"""The layouts in which clips are exported: their videos, and the manifests that trainers read.

Each layout turns the records of finished clips into the text of its manifests. A record has the
keys scene, split, pair, frames, frame_rate_hz, baseline_m, caption, height, width, and ``videos``:
the file of each kind of video, relative to the folder of the export.
"""

import csv
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any, Final, Literal

Kind = Literal["right", "left", "warped", "mask", "depth", "disparity", "grid"]
"""What a video of a clip shows: see `clips`."""

LayoutName = Literal["diffsynth", "finetrainers", "musubi", "stereocrafter"]

Record = Mapping[str, Any]
Manifests = Callable[[Path, Sequence[Record], Kind | None], dict[str, str]]
"""Returns the text of each manifest by its path, of a folder, its clips and the control's kind."""

_USUAL: Final[tuple[Kind, ...]] = ("right", "left", "warped", "mask")


@dataclass(frozen=True, slots=True)
class ClipLayout:
    """What a trainer is given, and what it takes.

    Attributes:
        manifests: Makes the manifests.
        kinds: The videos of every clip.
        controls: Kinds that the manifest can name as control, what conditions the model.
        control: The control unless another is asked for; None for none.
        frames_step: Clips have a multiple of this many frames, and one more: the trainer cuts
            others.
        side_px: The trainer takes pictures whose sides are multiples of this as they are.
    """

    manifests: Manifests
    kinds: tuple[Kind, ...] = _USUAL
    controls: tuple[Kind, ...] = ("left", "warped", "mask", "depth", "disparity")
    control: Kind | None = None
    frames_step: int = 4
    side_px: int = 16


def lines(texts: Iterable[str]) -> str:
    """Return texts as lines."""
    return "".join(f"{text}\n" for text in texts)


def _diffsynth(root: Path, clips: Sequence[Record], control: Kind | None) -> dict[str, str]:
    """Return metadata.csv, whose columns are inputs of the pipelines.

    Source: modelscope/DiffSynth-Studio, diffsynth/core/data/unified_dataset.py.
    """
    del root
    columns = {"video": "right", "vace_video": "warped", "vace_video_mask": "mask"}
    columns |= {} if control is None else {"control_video": control}
    columns |= {
        f"{kind}_video": kind for kind in clips[0]["videos"] if kind not in columns.values()
    }
    rows = [
        {name: clip["videos"][kind] for name, kind in columns.items()}
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


def _finetrainers(root: Path, clips: Sequence[Record], control: Kind | None) -> dict[str, str]:
    """Return two lists of captions and files, or with a control one table; and the configuration.

    Source: a-r-r-o-w/finetrainers, finetrainers/data/dataset.py and docs/dataset/README.md.
    """
    sizes = {(len(clip["frames"]), clip["height"], clip["width"]) for clip in clips}
    dataset = {
        "data_root": str(root.resolve()),
        "dataset_type": "video",
        "video_resolution_buckets": sorted(map(list, sizes)),
        "reshape_mode": "bicubic",
    }
    texts = {"dataset.json": json.dumps({"datasets": [dataset]}, indent=1) + "\n"}
    if control is None:
        texts["prompt.txt"] = lines(clip["caption"] for clip in clips)
        texts["videos.txt"] = lines(clip["videos"]["right"] for clip in clips)
        return texts
    rows = (
        {
            "file_name": clip["videos"]["right"],
            "control_video_file_name": clip["videos"][control],
            "caption": clip["caption"],
            "baseline_m": clip["baseline_m"],
            "frame_rate_hz": clip["frame_rate_hz"],
        }
        for clip in clips
    )
    texts["metadata.jsonl"] = lines(json.dumps(row, ensure_ascii=False) for row in rows)
    return texts


def _musubi(root: Path, clips: Sequence[Record], control: Kind | None) -> dict[str, str]:
    """Return the dataset's configuration, and a caption beside each video.

    Source: kohya-ss/musubi-tuner, docs/dataset_config.md.
    """
    folder = root.resolve()
    first = clips[0]
    lengths = sorted({len(clip["frames"]) for clip in clips})
    dataset = {
        "video_directory": str(folder / "right"),
        **({} if control is None else {"control_directory": str(folder / control)}),
        "cache_directory": str(folder / "cache"),
        "target_frames": lengths,
        "frame_extraction": "head",
    }
    general = {
        "resolution": [first["width"], first["height"]],
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


def _stereocrafter(root: Path, clips: Sequence[Record], control: Kind | None) -> dict[str, str]:
    """Return nothing: the grids are the input, one by one.

    Source: TencentARC/StereoCrafter, depth_splatting_inference.py and inpainting_inference.py.
    """
    del root, clips, control
    return {}


LAYOUTS: Final[Mapping[LayoutName, ClipLayout]] = {
    "diffsynth": ClipLayout(_diffsynth, control="warped"),
    "finetrainers": ClipLayout(_finetrainers),
    "musubi": ClipLayout(_musubi, control="warped"),
    "stereocrafter": ClipLayout(
        _stereocrafter, kinds=("grid", "right"), controls=(), frames_step=1, side_px=128
    ),
}
