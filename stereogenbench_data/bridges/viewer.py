"""What the Hub's viewer shows of shards: one row a scene, with a small picture.

The viewer and `datasets` read all configs of a card in the format of its first one. The first is
of tars, so the rows are tars too: one sample a scene, a member for each column.

    viewer/train.tar              train/Uniform/Town/scene_000001.preview.jpg, ...map.txt, ...
    viewer/eval_seen_map.tar      eval/MapSeenInTrain/Uniform/Town/scene_000000.preview.jpg, ...
"""

import io
import json
import tarfile
from collections.abc import Callable
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import Image

from stereogenbench_data.datasets.mapped import StereoPairs
from stereogenbench_data.engine import Advance, Progress, advance_of
from stereogenbench_data.errors import DescriptorError, explain_os_errors
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.picture import contact_sheet
from stereogenbench_data.schema.records import Scene, SceneId
from stereogenbench_data.schema.release import depth_name, rgb_name
from stereogenbench_data.sources.files import open_atomic

_COLUMNS: Final[dict[str, tuple[str, Callable[[Scene], Any]]]] = {
    "map.txt": ("string", lambda scene: scene.id.map_name),
    "family.txt": ("string", lambda scene: scene.id.family),
    "description.txt": ("string", lambda scene: scene.caption),
    "shard.txt": ("string", lambda scene: next(iter(scene.members.values())).path),
    "frames.json": ("int64", lambda scene: scene.frames),
    "width_px.json": ("int64", lambda scene: scene.rig.image_width_px),
    "height_px.json": ("int64", lambda scene: scene.rig.image_height_px),
    "focal_mm.json": ("float64", lambda scene: scene.rig.focal_mm),
    "shortest_baseline_cm.json": ("float64", lambda scene: min(scene.rig.baselines_cm)),
    "longest_baseline_cm.json": ("float64", lambda scene: max(scene.rig.baselines_cm)),
}
FEATURES: Final[dict[str, str]] = {
    "preview.jpg": "image",
    **{name: kind for name, (kind, _) in _COLUMNS.items()},
    "__key__": "string",
    "__url__": "string",
}
"""Columns and their types, as `datasets` writes them."""
_WIDEST_PX: Final = 240
_MARK: Final = "stereogenbench.index"


def split_name(scene: SceneId) -> str:
    """Return the name of a scene's split on the Hub, which has no subsets."""
    return scene.split if scene.subset is None else f"{scene.split}_{scene.subset}"


def viewer_tar(split: str) -> str:
    """Return the path of a split's tar below the shards."""
    return f"viewer/{split}.tar"


def viewer_tars(index: SceneIndex) -> dict[str, list[int]]:
    """Return the scenes' rows of the index for each tar, by its path below the shards."""
    rows: dict[str, list[int]] = {}
    for row in range(len(index)):
        path = viewer_tar(split_name(index.scene(row).id))
        rows.setdefault(path, []).append(row)
    return rows


def write_viewer_rows(
    index: SceneIndex, folder: Path, *, progress: Progress | None = None
) -> list[Path]:
    """Write a tar of rows for each split below a folder of shards, and return their paths.

    A tar that was written from the same index is left as it is.

    Args:
        index: The index of the shards.
        folder: The folder below which ``viewer/`` is written.
        progress: Called with (scenes done, scenes in all).

    Raises:
        DescriptorError: If a file cannot be written.
        StorageError, MediaError: If a scene's pictures cannot be read.
    """
    rows_of = {folder / name: rows for name, rows in viewer_tars(index).items()}
    advance = advance_of(progress, total=len(index))
    cannot = f"{folder / 'viewer'}: cannot be written"
    with explain_os_errors(cannot, "Check the disk.", kind=DescriptorError):
        for path, rows in rows_of.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            if _digest_of(path) == index.digest:
                advance(len(rows))
            else:
                _write(index, rows, path, advance=advance)
    return [*rows_of]


def _digest_of(path: Path) -> str:
    """Return the digest of the index that a tar was written from, empty if there is no such tar."""
    try:
        with tarfile.open(path) as tar:
            return tar.pax_headers.get(_MARK, "")
    except (FileNotFoundError, tarfile.TarError):
        return ""


def _write(index: SceneIndex, rows: list[int], path: Path, *, advance: Advance) -> None:
    rig = index.scene(rows[0]).rig
    width = min(_WIDEST_PX, rig.image_width_px)
    size = (round(rig.image_height_px * width / rig.image_width_px), width)
    blank = np.full((*size, 3), 255, dtype=np.uint8)
    pairs = _previewed(index, rows[0], size)
    options: dict[str, Any] = {"format": tarfile.PAX_FORMAT, "pax_headers": {_MARK: index.digest}}
    with (
        nullcontext() if pairs is None else closing(pairs),
        open_atomic(path) as file,
        tarfile.open(fileobj=file, mode="w", **options) as tar,
    ):
        for row in rows:
            scene, picture = index.scene(row), io.BytesIO()
            sheet = blank if pairs is None else contact_sheet([pairs[row]])
            Image.fromarray(sheet).save(picture, format="JPEG", quality=85)
            contents = {"preview.jpg": picture.getvalue()}
            for name, (kind, value) in _COLUMNS.items():
                text = value(scene) if kind == "string" else json.dumps(value(scene))
                contents[name] = text.encode()
            for name, content in contents.items():
                member = tarfile.TarInfo(f"{scene.id.key}.{name}")
                member.size = len(content)
                tar.addfile(member, io.BytesIO(content))
            advance(1)


def _previewed(index: SceneIndex, row: int, size: tuple[int, int]) -> StereoPairs | None:
    """Return each scene's primary pair, with disparity where there is depth.

    None if a scene lacks its pictures, as of a partial download.
    """
    scene = index.scene(row)
    held, (left, right) = set(scene.held_videos), scene.rig.primary_pair
    if not {rgb_name(left), rgb_name(right)} <= held:
        return None
    has_depth = scene.held_name(depth_name(left)) in held
    fields = ("left", "right", *(("disparity",) if has_depth else ()))
    return StereoPairs(
        index, pairs="primary", frames=[0], size=size, fields=fields, check="metadata"
    )
