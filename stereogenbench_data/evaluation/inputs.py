"""Export the inputs of a tier to disk, without anything that its methods must not know.

    OUT/inputs.json                 the tier, the size, the frames, a digest of the data's index
    OUT/<item>/left/000.png         8-bit RGB, one a frame
    OUT/<item>/warped_right/000.png G0: the left view splatted by the true disparity, 0 in holes
    OUT/<item>/hole/000.png         G0: 255 where nothing landed
    OUT/<item>/disparity/000.npy    G0: float32 (h, w), px; x_right = x_left - d; 0: not measured
    OUT/<item>/camera.json          G1: the baseline in metres, the intrinsics in pixels

An item is a pair of a scene, its name a digest (`item_name`) that tells neither. What a method
makes of it is to be called the same: ``PREDICTIONS/<item>/000.png ...`` or ``<item>.mp4``.
"""

import json
import shutil
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Final, Unpack

import numpy as np
from PIL import Image

from stereogenbench_data.datasets.mapped import Data
from stereogenbench_data.engine import LOCAL, Advance, Engine
from stereogenbench_data.errors import EvaluationError, StorageError, cure_of
from stereogenbench_data.evaluation.predictions import PairFrames, frame_name, item_name
from stereogenbench_data.evaluation.protocol import PAPER_SIZE, EvaluationProtocol
from stereogenbench_data.evaluation.running import (
    Progress,
    frame_counter,
    no_progress,
    select_workload,
)
from stereogenbench_data.evaluation.tiers import Tier, require_tier
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.load import SampleLoader
from stereogenbench_data.samples.request import Request
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.selection.plan import Address, Selection
from stereogenbench_data.sources.files import write_atomic

INPUTS_JSON: Final = "inputs.json"
CAMERA_JSON: Final = "camera.json"
_FAST: Final = 1
"""zlib's level of the PNGs: three times as fast as the default, a tenth larger."""


class ExportOptions(Selection, total=False):
    """Which scenes, pairs and frames (`Selection`), and how they are written.

    Attributes:
        workers: How many processes, None for one a core.
        engine: Where they are: `engine.LOCAL`, or an `engine.RayCluster`.
        progress: Called with (frames done, frames in all).
    """

    workers: int | None
    engine: Engine
    progress: Progress


@dataclass(frozen=True, slots=True)
class _ItemWork:
    index: SceneIndex
    wanted: PairFrames
    tier: Tier
    depth: DepthEncoding | None
    folder: Path


def export_inputs(
    data: Data,
    out: str | Path,
    *,
    tier: str,
    size: tuple[int, int] = PAPER_SIZE,
    depth: DepthEncoding | None = None,
    **options: Unpack[ExportOptions],
) -> list[str]:
    """Write what methods of a tier are given, and return the items' names.

    Items that were written before are kept, so that a stopped run goes on.

    Args:
        data: What `StereoPairs` takes.
        out: The folder to write into.
        tier: "G0", "G1" or "G2".
        size: (height, width) in pixels.
        depth: A depth contract instead of the one that files and release state.
        **options: Which scenes, pairs and frames, and how they are written (`ExportOptions`).

    Raises:
        EvaluationError: If the folder holds other inputs, naming what differs.
        StorageError: If something cannot be read or written.
        SelectionError: If nothing matches the selection.
    """
    known, root = require_tier(tier), Path(out)
    protocol = EvaluationProtocol(metrics=("psnr",), size=size, depth=depth)
    workload = select_workload(data, protocol, inputs=known.inputs, options=options)
    wanted = [pair for pairs in workload.pairs for pair in pairs]
    _begin(
        root,
        {
            "tier": known.name,
            "size": f"{size[1]}x{size[0]}",
            "frames": [list(each) for each in sorted({each.frames for each in wanted})],
            "data": workload.index.digest,
        },
    )
    works = [
        _ItemWork(workload.index_of([row]), pair, known, depth, root / item_name(*pair.place))
        for row, pairs in zip(workload.rows, workload.pairs, strict=True)
        for pair in pairs
        if not (root / item_name(*pair.place)).is_dir()
    ]
    progress = options.get("progress", no_progress)
    total = workload.frames
    done = total - sum(len(work.wanted.frames) for work in works)
    after_frames = frame_counter(progress, done=done, total=total)
    with closing(
        options.get("engine", LOCAL).map(
            _write_item,
            works,
            name=lambda work: f"{work.wanted.scene}, pair {work.wanted.pair}",
            workers=options.get("workers"),
            advance=after_frames,
        )
    ) as written:
        for _ in written:
            after_frames(0)
    progress(total, total)
    return [item_name(*pair.place) for pair in wanted]


def _begin(root: Path, content: Mapping[str, Any]) -> None:
    """Write what the folder holds, or refuse one that holds something else."""
    path = root / INPUTS_JSON
    try:
        root.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            if any(root.iterdir()):
                raise EvaluationError(
                    f"{root}: is not empty and holds no {INPUTS_JSON}: choose a new folder."
                )
            write_atomic(path, json.dumps(content).encode())
        there = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        if isinstance(error, EvaluationError):
            raise
        cure = cure_of(error, _ELSEWHERE) if isinstance(error, OSError) else _ELSEWHERE
        raise StorageError(f"{path}: cannot be read or written ({error}). {cure}") from error
    differing = [
        name for name in content if not isinstance(there, dict) or there.get(name) != content[name]
    ]
    if differing:
        raise EvaluationError(
            f"{root}: holds inputs of another {differing[0]}: choose another folder, or remove it."
        )


def _write_item(work: _ItemWork, after_frames: Advance) -> None:
    """Write one item, whole or not at all."""
    unfinished = work.folder.with_name(f".{work.folder.name}")
    request = Request(
        kind="pairs",
        fields=(*work.tier.inputs, "frame_index"),
        layout="single",
        size=work.wanted.size,
        depth=work.depth,
    )
    source, target = work.wanted.pair
    try:
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir()
        with closing(SampleLoader(work.index, request)) as loader:
            for frame in work.wanted.frames:
                address = Address(0, source, (target,), (frame,))
                sample = loader.load(address, clip="frame", generator=np.random.default_rng(0))
                _write_frame(unfinished, work.tier.inputs_of(sample), frame=frame)
                after_frames(1)
        unfinished.replace(work.folder)
    except OSError as error:
        if isinstance(error, StorageError):
            raise
        raise StorageError(
            f"{work.folder}: cannot be written ({error.strerror or error}). "
            + cure_of(error, "Choose another folder.")
        ) from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _write_frame(folder: Path, inputs: Mapping[str, Any], *, frame: int) -> None:
    camera = {name: np.asarray(inputs[name]).tolist() for name in inputs if name in _OF_CAMERA}
    if camera and not (folder / CAMERA_JSON).exists():
        (folder / CAMERA_JSON).write_text(json.dumps(camera), encoding="utf-8")
    for name, values in inputs.items():
        if name not in _OF_CAMERA:
            suffix, write = _WRITERS[name]
            place = folder / name / f"{frame_name(frame).removesuffix('.png')}{suffix}"
            place.parent.mkdir(exist_ok=True)
            place.write_bytes(write(np.asarray(values)))


def _png(values: Any) -> bytes:
    """Return an RGB picture or a mask, (3, h, w) or (1, h, w), as PNG without any metadata."""
    pixels = values.transpose(1, 2, 0)
    if pixels.shape[2] == 1:
        pixels = pixels[..., 0] * np.uint8(255)
    out = BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(out, format="PNG", compress_level=_FAST)
    return out.getvalue()


def _npy(values: Any) -> bytes:
    out = BytesIO()
    np.save(out, values[0], allow_pickle=False)
    return out.getvalue()


_ELSEWHERE: Final = "Choose another folder."
_OF_CAMERA: Final = frozenset({"baseline_m", "intrinsics"})
_WRITERS: Final[dict[str, tuple[str, Callable[[Any], bytes]]]] = {
    "left": (".png", _png),
    "warped_right": (".png", _png),
    "hole": (".png", _png),
    "disparity": (".npy", _npy),
}
