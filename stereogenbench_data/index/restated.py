"""Conventions for data that have an index: its rows are compared with them and take them over.

The rows were described before, so that only what they say can be confirmed: the metadata files of
some scenes are read again by the conventions. The depth contract is taken over by all rows.
"""

from dataclasses import replace
from typing import Any, Final

import numpy as np
import pyarrow as pa

from stereogenbench_data.errors import StorageError
from stereogenbench_data.index.parquet import IndexHead, made_again
from stereogenbench_data.index.rows import SCHEMA, scene_of
from stereogenbench_data.index.scene_folder import metadata_differences
from stereogenbench_data.schema.conventions import Conventions
from stereogenbench_data.schema.release import BASELINE_JSON, CAMERA_COUNT, TRAJECTORY_JSON
from stereogenbench_data.sources.location import shown
from stereogenbench_data.sources.members import MemberSource
from stereogenbench_data.sources.retry import RetryPolicy

_OF_DEPTH: Final = ("key", "depth_unit_m", "depth_offset_m", "depth_unit_source")
_READ_AGAIN: Final = 3
"""How many scenes' files are read again by the conventions."""


def restated(
    table: pa.Table, head: IndexHead, conventions: Conventions, *, retry: RetryPolicy | None
) -> pa.Table:
    """Return the rows of an index with conventions, which must be those of its scenes.

    Raises:
        StorageError: If the rows were described by other conventions, or files contradict these.
    """
    texts = [shape.text() for shape in conventions.shapes]
    if {*table.column("conventions").to_pylist()} <= {*texts}:
        return table
    where, shape = shown(head.root), conventions.shapes[0]
    if shape.has:
        raise StorageError(
            f"{where}: which of the {len(texts)} shapes of {conventions.where} a scene has is not "
            f"in its index. Name the conventions where it is made: `stereogenbench index ROOT "
            f"--conventions FILE`, and pack again."
        )
    source = MemberSource(head.root, shards=head.shards, revision=head.digest, retry=retry)
    rows = np.unique(np.linspace(0, table.num_rows - 1, _READ_AGAIN).astype(int))
    for row in rows.tolist():
        scene = replace(scene_of(table.slice(row, 1).to_pylist()[0]), conventions=texts[0])
        names = [name for name in (BASELINE_JSON, TRAJECTORY_JSON) if name in scene.members]
        found = metadata_differences(scene, {name: source.read(scene, name) for name in names})
        if found:
            name, difference = found[0]
            raise StorageError(
                f"{where}: {scene.id.key}/{name}: {difference}; so it is by {conventions.where}. "
                f"Correct the conventions. If the index is wrong: {made_again(where)}"
            )
    replaced: dict[str, Any] = {"conventions": texts[0]}
    encoding = None if shape.depth is None else shape.depth.encoding
    if shape.depth is not None and encoding is not None and encoding.unit_m is not None:
        columns = (table.column(name).to_pylist() for name in _OF_DEPTH)
        for key, units_m, offsets_m, sources in zip(*columns, strict=True):
            stated = zip(units_m, offsets_m or [0.0] * CAMERA_COUNT, sources, strict=True)
            for unit_m, stored_m, source in stated:
                if source not in ("default", "unreadable"):
                    shape.depth.require(unit_m, stored_m, where=f"{where}: {key}")
        offset_m = encoding.offset_m
        replaced["depth_unit_m"] = [encoding.unit_m] * CAMERA_COUNT
        replaced["depth_unit_source"] = ["conventions"] * CAMERA_COUNT
        replaced["depth_offset_m"] = [offset_m] * CAMERA_COUNT if offset_m else None
    for name, value in replaced.items():
        column = pa.array([value] * table.num_rows, type=SCHEMA.field(name).type)
        table = table.set_column(SCHEMA.get_field_index(name), SCHEMA.field(name), column)
    return table.combine_chunks()
