"""Whether the depth that samples need can have been stored whole, known before any is read."""

from collections.abc import Iterator
from typing import NoReturn

import numpy as np

from stereogenbench_data.errors import MediaError
from stereogenbench_data.index.table import SceneIndex
from stereogenbench_data.media.depth import require_depth_stream
from stereogenbench_data.samples.request import Request
from stereogenbench_data.schema.records import DepthEncoding, Scene
from stereogenbench_data.schema.release import depth_name
from stereogenbench_data.selection.plan import Plan


def require_whole_depth(index: SceneIndex, plan: Plan, request: Request) -> None:
    """Refuse, before anything is read, depth that cannot have been stored whole.

    Raises:
        MediaError: Naming the first file that a sample needs whose codec or pixel format loses
            depth, unless the request's depth contract accepts it.
    """
    if not request.streams & {"source_depth", "target_depth"}:
        return
    encoding = request.depth or DepthEncoding()
    units_told = index.column("depth_unit_source") != "unreadable"
    stored = np.stack([index.column("depth_codec"), index.column("depth_pixel_format")], axis=-1)
    whole = np.zeros(units_told.shape, dtype=bool)
    for codec, pixel_format in set(map(tuple, stored.reshape(-1, 2))):
        try:
            require_depth_stream(
                codec=codec, pixel_format=pixel_format, encoding=encoding, name="depth"
            )
        except MediaError:
            continue
        whole |= (stored == (codec, pixel_format)).all(axis=-1)
    usable = whole & (units_told | (encoding.unit_m is not None))
    if usable.all():
        return
    for row, camera in _depth_reads(plan, request):
        if not usable[row, camera]:
            _refuse_depth(index.scene(row), camera, encoding=encoding)


def _refuse_depth(scene: Scene, camera: int, *, encoding: DepthEncoding) -> NoReturn:
    held = scene.held_name(depth_name(camera))
    name = scene.members[held].path
    if not name.endswith(held):
        name = f"{name}: {scene.id.key}.{held}"
    require_depth_stream(
        codec=scene.depth_codec[camera],
        pixel_format=scene.depth_pixel_format[camera],
        encoding=encoding,
        name=name,
    )
    raise MediaError(
        f"{name}: its tags do not tell one positive number of metres in a stored unit of depth. "
        "Correct the tags, or pass DepthEncoding(unit_m=...)."
    )


def _depth_reads(plan: Plan, request: Request) -> Iterator[tuple[int, int]]:
    """Yield the (row, camera) of every depth video that samples need."""
    pairs = plan.pairs
    if "source_depth" in request.streams:
        yield from zip(pairs.row.tolist(), pairs.source.tolist(), strict=True)
    if "target_depth" in request.streams:
        for row, targets in zip(pairs.row.tolist(), pairs.targets.tolist(), strict=True):
            yield from ((row, target) for target in targets if target >= 0)
