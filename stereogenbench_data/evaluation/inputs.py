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
import shutil
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Unpack

import numpy as np
from PIL import Image

from stereogenbench_data.datasets.mapped import Data
from stereogenbench_data.engine import LOCAL, Advance, Engine, Progress, advance_of
from stereogenbench_data.errors import EvaluationError, StorageError, describe_os_error
from stereogenbench_data.evaluation.evaluate import select_workload
from stereogenbench_data.evaluation.predictions import PairFrames, frame_name, open_frames
from stereogenbench_data.evaluation.protocol import (
    PAPER_SIZE,
    EvaluationProtocol,
    Tier,
    require_tier,
)
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.schema.records import DepthEncoding
from stereogenbench_data.selection.options import require_options
from stereogenbench_data.selection.plan import Selection
from stereogenbench_data.sources.files import write_atomic

INPUTS_JSON: Final = "inputs.json"
_FAST: Final = 1
"""zlib's level of the PNGs: three times as fast as the default, a tenth larger."""
_ELSEWHERE: Final = "Choose another folder."


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
    require_options(export_inputs, options)
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
        _ItemWork(workload.index_of([row]), pair, known, depth, root / pair.item)
        for row, pairs in zip(workload.rows, workload.pairs, strict=True)
        for pair in pairs
        if not (root / pair.item).is_dir()
    ]
    total = workload.frames
    done = total - sum(len(work.wanted.frames) for work in works)
    advance = advance_of(options.get("progress"), done=done, total=total)
    advance(0)
    with closing(
        options.get("engine", LOCAL).map(
            _write_item,
            works,
            name=lambda work: work.wanted.label,
            workers=options.get("workers"),
            advance=advance,
        )
    ) as written:
        for _ in written:
            advance(0)
    return [pair.item for pair in wanted]


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
    except OSError as error:
        what = f"{path}: cannot be read or written"
        raise StorageError(describe_os_error(what, error, _ELSEWHERE)) from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise StorageError(f"{path}: cannot be read ({error}). {_ELSEWHERE}") from error
    differing = [
        name for name in content if not isinstance(there, dict) or there.get(name) != content[name]
    ]
    if differing:
        raise EvaluationError(
            f"{root}: holds inputs of another {differing[0]}: choose another folder, or remove it."
        )


def _write_item(work: _ItemWork, after_frames: Advance) -> None:
    """Write one item, whole or not at all."""
    temporary = work.folder.with_name(f".{work.folder.name}")
    fields, wanted = (*work.tier.inputs, "frame_index"), work.wanted
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir()
        with open_frames(work.index, fields, size=wanted.size, depth=work.depth) as load:
            for frame in wanted.frames:
                inputs = work.tier.inputs_of(load(0, wanted.pair, frame))
                _write_frame(temporary, inputs, name=frame_name(frame))
                after_frames(1)
        temporary.replace(work.folder)
    except OSError as error:
        if isinstance(error, StorageError):
            raise
        what = f"{work.folder}: cannot be written"
        raise StorageError(describe_os_error(what, error, _ELSEWHERE)) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


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
