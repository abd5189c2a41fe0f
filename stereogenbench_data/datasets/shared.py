"""What worker processes have in common with the process that starts them, in shared memory.

Workers that are forked see all of it anyway. To those that are started afresh (spawn, forkserver)
the rows of an index travel as memory that all map; it is given back when the last of them ends.
"""

from multiprocessing.reduction import ForkingPickler
from typing import Any, Final
from weakref import WeakKeyDictionary

import pyarrow as pa
import torch

from stereogenbench_data.index.table import SceneIndex

_rows: Final[WeakKeyDictionary[SceneIndex, torch.Tensor]] = WeakKeyDictionary()
"""The rows of each index that was sent to other processes, laid out once."""


def shared_full(size: tuple[int, ...], value: int) -> torch.Tensor:
    """Return an int64 tensor of which workers see every change."""
    numbers = torch.full(size, value, dtype=torch.int64)
    numbers.share_memory_()
    return numbers


def _shared_rows(index: SceneIndex, table: pa.Table) -> torch.Tensor:
    if index not in _rows:
        sink = pa.BufferOutputStream()
        with pa.ipc.new_stream(sink, table.schema) as stream:
            stream.write_table(table)
        rows = torch.frombuffer(bytearray(sink.getvalue()), dtype=torch.uint8)
        rows.share_memory_()
        _rows[index] = rows
    return _rows[index]


def _parted(index: SceneIndex) -> tuple[Any, ...]:
    table, rest = index.parted()
    return _joined, (_shared_rows(index, table), rest)


def _joined(rows: torch.Tensor, rest: dict[str, Any]) -> SceneIndex:
    with pa.ipc.open_stream(pa.py_buffer(rows.numpy())) as stream:
        return SceneIndex.of_parts(stream.read_all(), rest)


# For processes of this machine alone: a plain pickle of an index holds its rows.
ForkingPickler.register(SceneIndex, _parted)
