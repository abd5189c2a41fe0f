"""Export the inputs of a tier to disk, without anything that its methods must not know.

    OUT/inputs.json                 the tier, the size, the frames, a digest of the data's index
    OUT/<item>/left/000.png         8-bit RGB, one a frame
    OUT/<item>/warped_right/000.png G0: the left view splatted by the true disparity, 0 in holes
    OUT/<item>/hole/000.png         G0: 255 where nothing landed
    OUT/<item>/disparity/000.npy    G0: float32 (h, w), px; x_right = x_left - d; 0: not measured
    OUT/<item>/camera.json          G1: the baseline in metres, the intrinsics in pixels

An item is a pair of a scene. Its name is a digest (`item_name`) that reveals neither, and what a
method makes of it takes the same name: ``PREDICTIONS/<item>/000.png ...`` or ``<item>.mp4``.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Unpack

import numpy as np
from PIL import Image

from stereogenbench_data.datasets.mapped import Data
from stereogenbench_data.engine import Advance
from stereogenbench_data.errors import EvaluationError
from stereogenbench_data.evaluation.evaluate import select_pairs
from stereogenbench_data.evaluation.predictions import PairFrames, frame_name, open_frames
from stereogenbench_data.evaluation.protocol import (
    PAPER_SIZE,
    EvaluationProtocol,
    Tier,
    require_tier,
)
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.jobs import (
    WORK_DEFAULTS,
    JobKind,
    WorkOptions,
    atomic_folder,
    do_items,
    job_folder,
    named_errors,
)
from stereogenbench_data.schema.conventions import Conventions
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.selection.options import require_options
from stereogenbench_data.selection.plan import SELECTION_DEFAULTS, Selection
from stereogenbench_data.selection.signatures import list_options

INPUTS: Final = JobKind("inputs", "inputs.json", ".inputs.lock", EvaluationError)
_FAST: Final = 1
"""zlib's level of the PNGs: three times as fast as the default, a tenth larger."""


class ExportOptions(WorkOptions, Selection, total=False):
    """How inputs are written (`WorkOptions`; progress is in frames), and which (`Selection`)."""


@dataclass(frozen=True, slots=True)
class _ItemWork:
    index: SceneIndex
    wanted: PairFrames
    tier: Tier
    depth: DepthEncoding | None
    folder: Path


@list_options(SELECTION_DEFAULTS, WORK_DEFAULTS, {"frames": "all"})
def export_inputs(
    data: Data,
    out: str | Path,
    *,
    tier: str,
    size: tuple[int, int] = PAPER_SIZE,
    depth: DepthEncoding | None = None,
    conventions: str | Path | Conventions | None = None,
    **options: Unpack[ExportOptions],
) -> list[str]:
    """Write what methods of a tier are given, and return the items' names.

    Items that were written before are kept, so that a stopped run goes on.

    Args:
        data: What `StereoPairs` takes.
        out: The folder to write into.
        tier: "G0", "G1" or "G2".
        size: (height, width) in pixels.
        depth: A depth encoding instead of the one that files and release state.
        conventions: How the files of a folder are read, as for `StereoPairs`.
        **options: Which scenes, pairs and frames, and how they are written (`ExportOptions`).

    Raises:
        EvaluationError: If the folder holds other inputs, naming what differs.
        StorageError: If something cannot be read or written.
        SelectionError: If nothing matches the selection.
    """
    require_options(export_inputs, options)
    known, root = require_tier(tier), Path(out)
    protocol = EvaluationProtocol(size=size, depth=depth)
    index, scenes = select_pairs(
        data, known.inputs, protocol, options=options, conventions=conventions
    )
    wanted = [pair for pairs in scenes.values() for pair in pairs]
    settings = {
        "tier": known.name,
        "size": f"{protocol.size[1]}x{protocol.size[0]}",
        "frames": sorted({each.frames for each in wanted}),
        "data": index.digest,
    }
    with job_folder(root, settings, kind=INPUTS):
        works = [
            _ItemWork(index.only([row]), pair, known, depth, root / pair.item)
            for row, pairs in scenes.items()
            for pair in pairs
            if not (root / pair.item).is_dir()
        ]
        total = sum(len(pair.frames) for pair in wanted)
        do_items(
            _write_item,
            works,
            name=lambda work: work.wanted.label,
            options=options,
            done=total - sum(len(work.wanted.frames) for work in works),
            total=total,
        )
    return [pair.item for pair in wanted]


def _write_item(work: _ItemWork, after_frames: Advance) -> None:
    """Write one item, whole or not at all."""
    fields, wanted = (*work.tier.inputs, "frame_index"), work.wanted
    with (
        named_errors(work.folder),
        atomic_folder(work.folder) as unfinished,
        open_frames(work.index, fields, size=wanted.size, depth=work.depth) as load,
    ):
        for frame in wanted.frames:
            sample = load(0, wanted.pair, frame)
            inputs = {name: sample[name] for name in work.tier.inputs}
            _write_frame(unfinished, inputs, name=frame_name(frame))
            after_frames(1)


def _write_frame(folder: Path, inputs: Mapping[str, Any], *, name: str) -> None:
    """Write pictures and masks as PNG without any metadata, maps as npy, cameras as JSON."""
    camera = {}
    for field, given in inputs.items():
        values = np.asarray(given)
        path = folder / field / name
        if values.ndim != 3:
            camera[field] = values.tolist()
            continue
        path.parent.mkdir(exist_ok=True)
        if values.dtype == np.float32:
            np.save(path.with_suffix(".npy"), values[0], allow_pickle=False)
            continue
        pixels = values.transpose(1, 2, 0)
        if len(values) == 1:
            pixels = pixels[..., 0] * np.uint8(255)
        picture = Image.fromarray(np.ascontiguousarray(pixels))
        picture.save(path, format="PNG", compress_level=_FAST)
    if camera and not (folder / "camera.json").exists():
        (folder / "camera.json").write_text(json.dumps(camera), encoding="utf-8")
