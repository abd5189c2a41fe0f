"""What the Hub's viewer shows of shards: one row a scene, with a small picture.

The viewer and `datasets` read all configs of a card in the format of its first one. The first is
of tars, so the rows are tars too: one sample a scene, a member for each column.

    viewer/train.tar              train/Uniform/Town/scene_000001.preview.jpg, ...map.txt, ...
    viewer/eval_seen_map.tar      eval/MapSeenInTrain/Uniform/Town/scene_000000.preview.jpg, ...
"""

import io
import json
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import Image

from stereogenbench_data.datasets.mapped import StereoPairs
from stereogenbench_data.engine import Advance, Progress, advance_of
from stereogenbench_data.errors import DescriptorError, StorageError, describe_os_error
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.samples.picture import contact_sheet
from stereogenbench_data.schema.records import Scene, SceneId
from stereogenbench_data.schema.release import depth_name, rgb_name
from stereogenbench_data.sources.files import open_atomic

_FOLDER: Final = "viewer"
FEATURES: Final[dict[str, str]] = {
    "preview.jpg": "image",
    "map.txt": "string",
    "family.txt": "string",
    "description.txt": "string",
    "shard.txt": "string",
    "frames.json": "int64",
    "width_px.json": "int64",
    "height_px.json": "int64",
    "focal_mm.json": "float64",
    "shortest_baseline_cm.json": "float64",
    "longest_baseline_cm.json": "float64",
    "__key__": "string",
    "__url__": "string",
}
"""Columns and their types, as `datasets` writes them."""
_WIDEST_PX: Final = 240
_MARK: Final = "stereogenbench.index"


def split_name(scene: SceneId) -> str:
    """Return the name of a scene's split on the Hub, which has no subsets."""
    return scene.split if scene.subset is None else f"{scene.split}_{scene.subset}"


def viewer_tars(index: SceneIndex) -> dict[str, list[int]]:
    """Return the scenes' rows of the index for each tar, by its path below the shards."""
    rows: dict[str, list[int]] = {}
    for row in range(len(index)):
        path = viewer_tar(split_name(index.scene(row).id))
        rows.setdefault(path, []).append(row)
    return rows


def viewer_tar(split: str) -> str:
    """Return the path of a split's tar below the shards."""
    return f"{_FOLDER}/{split}.tar"


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
    place = folder / _FOLDER
    paths = []
    advance = advance_of(progress, total=len(index))
    try:
        place.mkdir(parents=True, exist_ok=True)
        for name, chosen in viewer_tars(index).items():
            path = folder / name
            if _digest_of(path) == index.digest:
                advance(len(chosen))
            else:
                _write(index, chosen, path, advance=advance)
            paths.append(path)
    except StorageError:
        raise
    except OSError as error:
        raise DescriptorError(
            describe_os_error(f"{place}: cannot be written", error, "Check the disk.")
        ) from error
    return paths


def _digest_of(path: Path) -> str:
    """Return the digest of the index that a tar was written from, empty if there is no such tar."""
    try:
        with tarfile.open(path) as tar:
            return tar.pax_headers.get(_MARK, "")
    except (FileNotFoundError, tarfile.TarError):
        return ""


def _write(index: SceneIndex, rows: list[int], path: Path, *, advance: Advance) -> None:
    previews = _previews(index, rows)
    with (
        open_atomic(path) as file,
        tarfile.open(
            fileobj=file, mode="w", format=tarfile.PAX_FORMAT, pax_headers={_MARK: index.digest}
        ) as tar,
    ):
        for row, preview in zip(rows, previews, strict=True):
            scene = index.scene(row)
            for name, content in {"preview.jpg": preview, **_columns(scene)}.items():
                member = tarfile.TarInfo(f"{scene.id.key}.{name}")
                member.size = len(content)
                tar.addfile(member, io.BytesIO(content))
            advance(1)


def _columns(scene: Scene) -> dict[str, bytes]:
    values: dict[str, Any] = {
        "map.txt": scene.id.map_name,
        "family.txt": scene.id.family,
        "description.txt": scene.caption,
        "shard.txt": next(iter(scene.members.values())).path,
        "frames.json": scene.frames,
        "width_px.json": scene.rig.image_width_px,
        "height_px.json": scene.rig.image_height_px,
        "focal_mm.json": scene.rig.focal_mm,
        "shortest_baseline_cm.json": min(scene.rig.baselines_cm),
        "longest_baseline_cm.json": max(scene.rig.baselines_cm),
    }
    return {
        name: (value if name.endswith(".txt") else json.dumps(value)).encode()
        for name, value in values.items()
    }


def _previews(index: SceneIndex, rows: list[int]) -> Iterator[bytes]:
    """Yield the first pictures of each scene's primary pair, with disparity, as JPEG.

    Scenes without these videos, as of a partial download, have an empty picture.
    """
    first = index.scene(rows[0])
    left, right = first.rig.primary_pair
    held = set(first.held_videos)
    fields = ["left", "right"] if {rgb_name(left), rgb_name(right)} <= held else []
    if fields and first.held_name(depth_name(left)) in held:
        fields.append("disparity")
    width = min(_WIDEST_PX, first.rig.image_width_px)
    height = round(first.rig.image_height_px * width / first.rig.image_width_px)
    pairs = (
        StereoPairs(
            index,
            pairs="primary",
            frames=[0],
            size=(height, width),
            fields=fields,
            check="metadata",
        )
        if fields
        else None
    )
    for row in rows:
        picture = (
            np.full((height, width, 3), 255, dtype=np.uint8)
            if pairs is None
            else contact_sheet([pairs[row]])
        )
        file = io.BytesIO()
        Image.fromarray(picture).save(file, format="JPEG", quality=85)
        yield file.getvalue()
